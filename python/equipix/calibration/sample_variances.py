"""Variances that are sample variances of few frames: recognised, and replaced by a noise model."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from equipix.calibration.weights import weighted_fit
from equipix.noise import NoiseModel, photon_transfer

if TYPE_CHECKING:
    from equipix._types import Array
    from equipix.calibration.options import Options
    from equipix.calibration.weights import Weighted
    from equipix.exposures.exposures import Exposures

_MOST_FRAMES = 30
"""Frames from which the scatter of sample variances does little: error bars are off by 3 %."""

_FEWEST_PIXELS = 1000
"""Least number of pairs of neighbours in an exposure."""

_SLOPE = 0.5
"""Slope of squared residuals against variances, above which these are no sample variances."""

_LIKE = 0.1
"""Relative difference of the fourth moment from that of sample variances."""


def sampled_frames(variance: Array | None) -> float | None:
    """Number of frames whose sample variances these seem to be; None if they do not.

    Parameters
    ----------
    variance : ndarray, shape (n, rows, cols) or (n,), or None
        Variances of the values.

    Notes
    -----
    For v₁ and v₂ of two neighbours with the same expectation, each following χ² of N − 1 degrees of
    freedom, x = (v₁ − v₂)/(v₁ + v₂) has the mean square 1/N and the fourth moment 3/(N(N + 2)).
    What belongs to the pixels is common to the exposures: its mean square, from products of
    different exposures, is subtracted.
    """
    if variance is None or variance.ndim != 3:
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        pairs = np.diff(variance, axis=2) / (variance[:, :, 1:] + variance[:, :, :-1])
    pairs = pairs[:, np.isfinite(pairs).all(axis=0)]
    count = len(pairs)
    if count < 2 or pairs.shape[1] < _FEWEST_PIXELS:
        return None
    squares = np.square(pairs, dtype=np.float64)
    total = np.square(pairs.sum(axis=0, dtype=np.float64))
    common = float(np.mean(total - squares.sum(axis=0))) / (count * (count - 1))
    square = float(squares.mean()) - max(common, 0.0)
    if not square > 1 / _MOST_FRAMES:
        return None
    frames = 1 / square
    fourth = float(np.mean(squares**2)) * frames * (frames + 2) / 3
    return frames if abs(fourth - 1) < _LIKE else None


def steadied(
    exposures: Exposures, weighted: Weighted, options: Options
) -> tuple[Weighted, float | None]:
    """Fit with a noise model of each exposure, where the variances scatter like sample variances.

    Also returns the number of frames that they seem to be of; None where they are left as they are.
    """
    is_given = exposures.knows_noise and not exposures.offset
    frames = sampled_frames(exposures.variance) if is_given else None
    variance = exposures.variance
    if frames is None or variance is None or _explains_residuals(weighted, options.fit.workers):
        return weighted, None
    usable, number, response = exposures.usable(), max(2, round(frames)), exposures.response
    period = (1, 1) if exposures.filters is None else exposures.filters.colours.period
    in_dn = (
        (y * response, v * response**2) for y, v in zip(exposures.values, variance, strict=True)
    )
    models = tuple(
        NoiseModel.fit(photon_transfer(signal, each, usable[k], number, period=period))
        for k, (signal, each) in enumerate(in_dn)
    )
    exposures = dataclasses.replace(exposures, variance=None, noise=models)
    return weighted_fit(exposures, options, weighted.fit), frames


def _explains_residuals(weighted: Weighted, workers: int | None) -> bool:
    """Whether squared residuals r² follow the scatter of the variances v, as they do true ones.

    The slope of r² against v, from differences of neighbours, is near 1 for true variances, and
    near 0 for sample variances, whose scatter is independent of that of the mean.
    """
    exposures, fit = weighted.exposures, weighted.fit
    variance = exposures.variance
    if variance is None or variance.ndim != 3:
        return True
    along = square = 0.0
    for k in range(len(exposures)):
        residual = exposures.residual(fit, k, workers)
        residual[~exposures.used(fit, k)] = np.nan
        of_residuals = np.diff(np.square(residual, dtype=np.float64), axis=1)
        of_variances = np.diff(variance[k].astype(np.float64), axis=1)
        known = np.isfinite(of_residuals) & np.isfinite(of_variances)
        along += float(np.sum(of_residuals[known] * of_variances[known]))
        square += float(np.sum(np.square(of_variances[known])))
    return along >= _SLOPE * square


def words(frames: float) -> str:
    """What is wrong, the value, the limit and the remedy."""
    return (
        f"'variance' scatters from pixel to pixel like sample variances of {frames:.1f} frames "
        f"(limit {_MOST_FRAMES}): as weights these bias the result and its error bars. They were "
        "replaced by a noise model fitted over all pixels of each exposure: give a NoiseModel, or "
        "FrameStatistics"
    )

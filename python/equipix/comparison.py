"""How far several calibrations of one sensor agree, and how far they should."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from equipix._check import Array, ArrayLike, Bools, Ints, as_array, check_count
from equipix.calibration.result import Calibration
from equipix.errors import InputError
from equipix.findings import determined, usable
from equipix.measured.noise import BLOCK
from equipix.metrics.maps import block_means, relative_error, rms

_MOST_BLOCKS = 16
"""Blocks whose uncertainty represents all: each takes about as long as a calibration."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Agreement of several calibrations of one sensor: the result of `compare`.

    Attributes
    ----------
    sensitivities : ndarray, shape (n, rows, cols), float64
        The sensitivities in one gauge, mean 1 over the pixels that are good in all; NaN elsewhere.
    agreement : ndarray, shape (rows, cols), float64
        Standard deviation of the sensitivity over the calibrations, of one of them.
    pairs : ndarray, shape (pairs, 2), int64
        Which two calibrations, from 0, are compared.
    rms : ndarray, shape (pairs,), float64
        Root mean square over the pixels of the relative difference of two sensitivities.
    block_rms : ndarray, shape (pairs,), float64
        The same of means over blocks of 16×16 pixels: what is left at large scales.
    largest : ndarray, shape (pairs,), float64
        Largest absolute relative difference of a pixel.
    open_tilt : ndarray of bool, shape (pairs,)
        Whether free fluxes leave the tilt of one of the two undetermined: then the slope of ln of
        their ratio is no difference, and is left out of all figures.
    predicted_rms, predicted_block_rms : ndarray, shape (pairs,), float64, or None
        What the uncertainties of two independent calibrations predict for `rms` and `block_rms`.
    """

    sensitivities: Array
    agreement: Array
    pairs: Ints
    rms: Array
    block_rms: Array
    largest: Array
    open_tilt: Bools
    predicted_rms: Array | None = None
    predicted_block_rms: Array | None = None

    def difference(self, pair: int) -> Array:
        """Relative difference of the sensitivities of a pair, (M₁ − M₂)/M₂, shape (rows, cols).

        Without its slope where `open_tilt` is true.
        """
        first, second = self.sensitivities[self.pairs[pair]]
        return _difference(first, second, bool(self.open_tilt[pair]))


def compare(
    calibrations: Sequence[Calibration], *, predicted: ArrayLike | None = None
) -> Comparison:
    """Compare calibrations of one sensor, from experiments independent of each other.

    Parameters
    ----------
    calibrations : sequence of Calibration
        Two or more, of sensors of one shape.
    predicted : array_like, shape (n, 2), optional
        Of each calibration the root mean square of its relative error that is expected in single
        pixels and in means over blocks of 16×16, as `equipix.simulate.noise_prediction` gives.
        Unless given it is computed from `sensitivity_std` where all have one; that of the blocks
        by `Calibration.std_of` of 16 of them, where none was read from a file.

    Returns
    -------
    Comparison
        Agreement map and, for each pair, how far the two are from each other.

    Raises
    ------
    InputError
        If there are fewer than two calibrations, of different shapes, without a common good
        pixel, or smaller than a block of 16×16 pixels.

    Notes
    -----
    Common errors of two calibrations, such as a wrong dark level, leave no difference. A shift
    error or lamp drift does: it differs between experiments and changes M at large scales, so it
    dominates the block means. A tilt that free fluxes leave undetermined is no difference, and is
    left out (`Comparison.open_tilt`).

    References
    ----------
    .. [1] S. E. Stukachev, I. E. Kozhevatov, "Calibration method for spatial distribution of light
       sensitivity of matrix photo receivers", Radiophysics and Quantum Electronics, 2011, figure 5.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import calibrate, compare, cross_pattern, simulate
    >>> rng = np.random.default_rng(1)
    >>> truth = simulate.paper_sensitivity((48, 64), rng=rng)
    >>> beam = simulate.gaussian_beam(truth.shape)
    >>> calibrations = []
    >>> for arms in ((5, 7), (7, 11)):
    ...     shifts = cross_pattern(*arms)
    ...     frames = simulate.exposures(truth, beam, shifts)
    ...     calibrations.append(calibrate(frames + rng.normal(0, 1e-3, frames.shape), shifts))
    >>> result = compare(calibrations, predicted=[(5.5e-4, 5.3e-5), (5.7e-4, 5.6e-5)])
    >>> bool(0.9 < result.rms[0] / result.predicted_rms[0] < 1.1)
    True
    """
    several = isinstance(calibrations, list | tuple)
    if not several or not all(hasattr(each, "sensitivity") for each in calibrations):
        raise InputError("'calibrations' is not a list of results of calibrate")
    count = len(calibrations)
    if count < 2:
        raise InputError(f"'calibrations' has {count} entries, expected two or more")
    shapes = [calibration.shape for calibration in calibrations]
    if len(set(shapes)) > 1:
        raise InputError(f"'calibrations' are of sensors of shapes {shapes}, expected one shape")
    sensitivities = _in_one_gauge(calibrations)
    pairs = np.array(list(combinations(range(count), 2)))
    is_open = np.array([_leaves_tilt(each) for each in calibrations])
    open_tilt = is_open[pairs].any(axis=1)
    differences = [
        _difference(sensitivities[i], sensitivities[j], bool(left))
        for (i, j), left in zip(pairs, open_tilt, strict=True)
    ]
    compared = sensitivities
    if is_open.any():
        compared = np.stack([_levelled(each, sensitivities[0]) for each in sensitivities])
    return Comparison(
        sensitivities=sensitivities,
        agreement=compared.std(axis=0, ddof=1),
        pairs=pairs,
        open_tilt=open_tilt,
        rms=np.array([rms(each) for each in differences]),
        block_rms=np.array([rms(block_means(each)) for each in differences]),
        largest=np.array([np.nanmax(np.abs(each)) for each in differences]),
        **_predictions(_expected(calibrations) if predicted is None else predicted, pairs, count),
    )


def _leaves_tilt(calibration: Calibration) -> bool:
    """Whether free fluxes leave the tilt of a calibration undetermined."""
    std = calibration.tilt_std
    if std is not None and not np.isfinite(std).all():
        return True
    return any(finding.kind == "tilt" for finding in calibration.findings)


def _difference(first: Array, second: Array, open_tilt: bool) -> Array:
    """Relative difference of two sensitivities, without its slope where a tilt is open."""
    return relative_error(_levelled(first, second) if open_tilt else first, second)


def _levelled(sensitivity: Array, like: Array) -> Array:
    """Sensitivity times the tilt that brings the slope of ln of the ratio to another to 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(sensitivity / like)
    valid = np.isfinite(ratio)
    places = np.indices(ratio.shape)[:, valid].T
    places = places - places.mean(axis=0)
    slope = np.linalg.lstsq(places, ratio[valid] - ratio[valid].mean())[0]
    levelled = sensitivity.copy()
    levelled[valid] *= np.exp(-places @ slope)
    return np.asarray(levelled * (np.nanmean(like) / np.nanmean(levelled)))


def _in_one_gauge(calibrations: Sequence[Calibration]) -> Array:
    """Sensitivities of mean 1 over the pixels that are good in all, NaN elsewhere."""
    maps = np.stack([each.sensitivity.astype(np.float64) for each in calibrations])
    good = np.isfinite(maps).all(axis=0)
    for each in calibrations:
        good &= usable(each.flags)
    if not good.any():
        raise InputError("'calibrations' have no pixel that is good in all of them")
    maps[:, ~good] = np.nan
    return np.asarray(maps / np.nanmean(maps, axis=(1, 2), keepdims=True))


def _expected(calibrations: Sequence[Calibration]) -> Array | None:
    """Rms of the relative error in pixels and in block means, by the uncertainties, if known."""
    expected = []
    for each in calibrations:
        if each.sensitivity_std is None:
            return None
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = each.sensitivity_std / each.sensitivity
        pixels = rms(relative[np.isfinite(relative) & usable(each.flags)])
        blocks = (
            np.nan if each.weighted is None else rms(np.asarray(each.std_of(_some_blocks(each))))
        )
        expected.append((pixels, blocks))
    return np.array(expected)


def _some_blocks(calibration: Calibration) -> Array:
    """Weights of the means over some blocks, each less the mean over all: shape (m, rows, cols)."""
    good = determined(calibration.sensitivity, calibration.flags)
    rows, cols = (size // BLOCK for size in calibration.shape)
    chosen = np.unique(np.linspace(0, rows * cols - 1, _MOST_BLOCKS).round().astype(int))
    weights = []
    for row, col in zip(*np.divmod(chosen, cols), strict=True):
        block = np.zeros(calibration.shape, bool)
        block[BLOCK * row : BLOCK * (row + 1), BLOCK * col : BLOCK * (col + 1)] = True
        block &= good
        if block.any():
            weights.append(block / block.sum() - good / good.sum())
    return np.array(weights)


def _predictions(predicted: ArrayLike | None, pairs: Ints, count: int) -> dict[str, Array]:
    """Errors of two calibrations in quadrature, in pixels and in blocks."""
    if predicted is None:
        return {}
    errors = as_array("predicted", predicted, ndim=2).astype(np.float64)
    check_count("predicted", len(errors), count)
    if errors.shape[1] != 2:
        raise InputError(f"'predicted' has shape {errors.shape}, expected ({count}, 2)")
    rms, block_rms = np.sqrt((errors[pairs] ** 2).sum(axis=1)).T
    return {"predicted_rms": rms, "predicted_block_rms": block_rms}

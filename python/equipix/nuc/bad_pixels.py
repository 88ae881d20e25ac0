"""Bad pixels of a response and of frames: criteria, their limits, and what was found."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from equipix._check import number
from equipix._readonly import ReadOnly
from equipix.errors import InputError
from equipix.flags import set_bits, usable
from equipix.frames import FrameStatistics
from equipix.metrics.moments import stack_of
from equipix.noise import scatter_limit
from equipix.nuc.curve import response_at

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from equipix._types import Array, Bools, Floats
    from equipix.nuc.response import Response

PERCENTILES = (0.1, 1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0, 99.9)
"""Percentiles that describe the distribution of K."""


@dataclass(frozen=True)
class DefectLimits:
    """Limits of `find_defects`, each adjustable.

    Attributes
    ----------
    response : float
        Response below which a pixel is dead, over the mean response: 1/2 in GB/T 17444-2013 [1]_.
    gain : float
        1/(1 + K) above which a pixel does not respond: K → −1 has no bound.
    noise : float
        Noise above which a pixel is noisy (overheated), over the mean noise: 2 in GB/T 17444-2013.
    correlation : float
        Standard deviations by which von Neumann's ratio of a noisy pixel must lie below that of
        white noise for flicker.
    range : float
        Share of the array's range of levels in which a pixel must have values.
    misfit : float
        Standard deviations that reduced χ² may exceed 1 by, as a normal variable.

    References
    ----------
    .. [1] GB/T 17444-2013, "Measuring methods for parameters of infrared focal plane arrays".
    """

    response: float = 0.5
    gain: float = 10.0
    noise: float = 2.0
    correlation: float = 5.0
    range: float = 0.5
    misfit: float = 6.0

    def __post_init__(self) -> None:
        """Refuse limits that are not above 0."""
        for name, value in vars(self).items():
            if not number(name, value) > 0:
                raise InputError(f"'{name}' is {value!r}, expected a number above 0")


@dataclass(frozen=True, eq=False)
class Defects(ReadOnly):
    """Bad pixels, the result of `find_defects`.

    Attributes
    ----------
    flags : ndarray, shape (rows, cols), uint32
        Bits of `equipix.Flag`: those of the response, and those found.
    counts : dict of str to int
        Pixels of each kind; one pixel may be of several. ``"unusable"`` counts all that are flagged
        ``DO_NOT_USE``.
    gain_percentiles : dict of str to float
        Distribution of K over the pixels that are determined: percentiles by their names.
    limits : DefectLimits
        The limits that were used.
    """

    flags: Array
    counts: dict[str, int]
    gain_percentiles: dict[str, float]
    limits: DefectLimits = field(default_factory=DefectLimits)


def find_defects(
    response: Response,
    frames: ArrayLike | FrameStatistics | None = None,
    *,
    limits: DefectLimits | None = None,
) -> Defects:
    """Find bad pixels by their response curves and by frames of one steady level.

    Parameters
    ----------
    response : Response
        Response curves.
    frames : array_like of shape (n, rows, cols), or FrameStatistics, optional
        Raw frames of one steady even level, or their average; without them noise is not judged, and
        of an average flicker is not.
    limits : DefectLimits, optional
        Limits of the criteria.

    Returns
    -------
    Defects
        ``response.with_flags(defects.flags)`` is a response that has them.

    Raises
    ------
    InputError
        If the frames are of another shape, or fewer than two.

    Notes
    -----
    ============== =================================================================== =========
    kind           criterion                                                           flag
    ============== =================================================================== =========
    dead           mean slope of the curve below `limits.response` of the mean         DEAD
    non_responding 1/(1 + K) above `limits.gain` or negative, K the mean slope less 1  DEAD
    noisy          noise above `limits.noise` times the mean, and beyond chance        HOT
    flickering     noise beyond chance, and slower than white noise                    TELEGRAPH
    out_of_range   values in less than `limits.range` of the range of levels           OTHER
    nonlinear      reduced χ² beyond chance: the curve is of another order             NONLINEAR
    ============== =================================================================== =========

    All come with ``DO_NOT_USE``. Beyond chance is six standard deviations of the scatter of a
    sample variance. Von Neumann's ratio is Σ(x_k+1 − x_k)²/Σ(x_k − x̄)², which is 2 for white noise
    with a standard deviation of 2·√((n − 2)/(n² − 1)) [1]_; the mean of each frame is subtracted
    before.

    References
    ----------
    .. [1] J. von Neumann, "Distribution of the ratio of the mean square successive difference to
       the variance", Annals of Mathematical Statistics 12 (1941) 367-395.
    """
    limits = limits or DefectLimits()
    found = _of_response(response, limits)
    if frames is not None:
        found |= _of_frames(frames, response.shape, usable(response.flags), limits)
    flags = response.flags.copy()
    for kind, pixels in found.items():
        set_bits(flags, kind, pixels)
    counts = {kind: int(np.count_nonzero(pixels)) for kind, pixels in found.items()}
    counts["unusable"] = int(np.count_nonzero(~usable(flags)))
    gain = mean_slope(response) - 1
    known = gain[np.isfinite(gain)]
    percentiles = np.percentile(known, PERCENTILES) if known.size else np.full(len(PERCENTILES), 0)
    named = {f"{name:g}": float(each) for name, each in zip(PERCENTILES, percentiles, strict=True)}
    return Defects(flags, counts, named, limits)


def mean_slope(response: Response) -> Floats:
    """Mean slope 1 + K of each curve between its limits; of one level 1 + K of the fit."""
    low, high = response.limits
    if response.order == 0:
        return np.where(np.isnan(response.deviation[0]), np.nan, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        rise = response_at(response.deviation, high) - response_at(response.deviation, low)
        slope = rise / (high - low)
    return np.asarray(np.where(high > low, slope, 1 + response.deviation[1]))


def _of_response(response: Response, limits: DefectLimits) -> dict[str, Bools]:
    """Bad pixels by their curves."""
    slope = mean_slope(response)
    good = usable(response.flags) & np.isfinite(slope)
    usual = float(np.mean(slope[good])) if good.any() else 1.0
    low, high = response.limits
    whole = float(response.levels.max() - response.levels.min())
    found = {
        "dead": slope < limits.response * usual,
        "non_responding": slope * limits.gain < 1,
        "out_of_range": ~(high - low >= limits.range * whole),
    }
    if response.metadata.get("options", {}).get("weights") == "variances":
        freedom = len(response.levels) - response.order - 1
        if freedom > 0:
            found["nonlinear"] = response.reduced_chi2 > scatter_limit(
                freedom + 1, sigmas=limits.misfit
            )
    return found


def _of_frames(
    frames: ArrayLike | FrameStatistics, shape: tuple[int, int], good: Bools, limits: DefectLimits
) -> dict[str, Bools]:
    """Bad pixels by their noise."""
    if isinstance(frames, FrameStatistics):
        _check_shape(frames.variance.shape, shape)
        variance, count = frames.variance, int(frames.count.max())
        slow = None
    else:
        stack = stack_of("frames", frames)
        _check_shape(stack.shape[1:], shape)
        good = good & np.isfinite(stack).all(axis=0)
        stack -= np.mean(stack, axis=(1, 2), keepdims=True, where=good)
        variance, count = stack.var(axis=0, ddof=1), len(stack)
        slow = _von_neumann(stack) < -limits.correlation
    if count < 2:
        raise InputError("'frames' holds one frame, expected two or more: one shows no noise")
    noise = np.sqrt(variance)
    usual = float(np.nanmean(noise[good])) if good.any() else float(np.nanmean(noise))
    beyond = variance > scatter_limit(count) * usual**2
    found = {"noisy": beyond & (noise > limits.noise * usual)}
    if slow is not None:
        found["flickering"] = beyond & slow
    return found


def _check_shape(found: tuple[int, ...], shape: tuple[int, int]) -> None:
    if found != shape:
        raise InputError(f"'frames' has frames of {found}, the sensor {shape}")


def _von_neumann(stack: Floats) -> Floats:
    """Von Neumann's ratio of each pixel less 2, in its standard deviations."""
    n = len(stack)
    squares = np.sum((stack - stack.mean(axis=0)) ** 2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sum(np.diff(stack, axis=0) ** 2, axis=0) / squares
    return np.asarray((ratio - 2) / 2 * np.sqrt((n**2 - 1) / max(1, n - 2)))

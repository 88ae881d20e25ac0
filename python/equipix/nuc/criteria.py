"""Criteria of bad pixels: by response curves, and by frames of one steady level."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.colour import planes_of
from equipix.defects import noisy_pixels, often_rejected, response_outliers
from equipix.errors import InputError
from equipix.frames import FrameStatistics
from equipix.light import Light, light_of
from equipix.metrics.moments import stack_of, temporal_of, warn_of_drift
from equipix.noise import MEDIAN_SQUARE, NoiseModel, photon_transfer, scatter_limit
from equipix.nuc.curve import response_at
from equipix.rounding import step_of

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from equipix._types import Array, Bools, Floats
    from equipix.colour import Colours
    from equipix.mosaic import Filters
    from equipix.nuc.limits import DefectLimits
    from equipix.nuc.response import Response

_SAMPLED = 4096
"""Pixels that show the step between values."""

_CORRELATED = 0.5
"""Correlation of successive frames from which flicker must be found."""


def mean_slope(response: Response) -> Floats:
    """Mean slope 1 + K of each curve between its limits; of one level 1 + K of the fit."""
    low, high = response.limits
    if response.order == 0:
        return np.where(np.isnan(response.deviation[0]), np.nan, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        rise = response_at(response.deviation, high) - response_at(response.deviation, low)
        slope = rise / (high - low)
    return np.asarray(np.where(high > low, slope, 1 + response.deviation[1]))


def of_response(
    response: Response,
    slope: Floats,
    limits: DefectLimits,
    misfit: float,
    filters: Filters | None,
) -> dict[str, Bools]:
    """Bad pixels by their curves of this mean slope; `misfit` is that of the array.

    `filters` are those of slopes that are not over the mean of a colour.
    """
    usual: Floats | float = 1.0
    if filters is not None:
        usual = filters.map_of(response.shape)
        slope = slope / usual
    known = np.isfinite(slope)
    low, high = response.limits
    whole = _range(response)
    found = {
        "dead": _dead(response, slope, usual, limits.response),
        "non_responding": slope * limits.gain < 1,
        "out_of_range": known & (high - low < limits.range * whole),
    }
    if not np.isnan(misfit):
        found["nonlinear"] = _nonlinear(response, limits.misfit, misfit)
    return found


def _range(response: Response) -> Floats:
    """Range of the levels, in which those of a colour are its own."""
    low, high = response.limits
    whole = np.zeros(response.shape)
    for plane in planes_of(response.cfa, response.shape):
        known = plane & np.isfinite(high - low)
        if known.any():
            whole[plane] = high[known].max() - low[known].min()
    return whole


def of_frames(
    frames: ArrayLike | FrameStatistics,
    good: Bools,
    limits: DefectLimits,
    cfa: Colours | None = None,
) -> dict[str, Bools]:
    """Bad pixels by their noise; `good` are those whose curves are usable."""
    slow, light = None, Light()
    if isinstance(frames, FrameStatistics):
        _check_shape(frames.mean.shape, good.shape)
        mean, variance, count = frames.mean, frames.variance, int(frames.count.max())
        step, light = frames.step, light_of(frames)
    else:
        stack = stack_of("frames", frames)
        _check_shape(stack.shape[1:], good.shape)
        over_time = temporal_of(stack, ~good)
        warn_of_drift(over_time)
        mean, variance, count = over_time.mean, over_time.variance, over_time.frames
        step = step_of(stack.reshape(len(stack), -1)[:, :: -(-stack[0].size // _SAMPLED)])
        slow = _von_neumann(over_time.steps, variance, count) < -limits.correlation
    if count < 2:
        raise InputError("'frames' holds one frame, expected two or more: one shows no noise")
    common = light.variance(mean)
    period = (1, 1) if cfa is None else cfa.period
    model = _common_noise(mean, variance, good, count, step, common, period)
    noisy = flickering = np.zeros(good.shape, bool)
    if model is not None:
        of_level = mean[None], variance[None], [count], model
        flickering = noisy_pixels(*of_level)
        noisy = noisy_pixels(*of_level, times=limits.noise, light=[common])
    if isinstance(frames, FrameStatistics) and frames.reject is not None:
        missing = np.where(frames.count > 0, count - frames.count.astype(np.int64), 0)
        noisy = noisy | often_rejected(missing, count)
    return {"noisy": noisy} if slow is None else {"noisy": noisy, "flickering": flickering & slow}


def too_few_for_flicker(frames: object, limits: DefectLimits) -> dict[str, str]:
    """Say that frames are too few to find flicker, if they are."""
    needed = int(np.ceil((limits.correlation / _CORRELATED) ** 2 - 2))
    count = len(np.asarray(frames))
    return {"flickering": f"below {needed} frames"} if count < needed else {}


def _dead(response: Response, slope: Floats, usual: Floats | float, least: float) -> Bools:
    """Pixels that rise less than their neighbours, by more than the error of their slope."""
    if response.order == 0 or not np.isfinite(slope).any():
        return np.zeros(slope.shape, bool)
    # Of a line; that of a higher order at 0, which is larger than that of the mean slope.
    std = np.sqrt(np.nan_to_num(response.variances[1])) / usual
    return response_outliers(slope, lambda: std, least=least)[0]


def _nonlinear(response: Response, sigmas: float, misfit: float) -> Bools:
    """Pixels whose curve fits worse than noise, and the misfit of the array, explain."""
    found = np.zeros(response.shape, bool)
    common = sigmas**2 * max(0.0, misfit - 1) / MEDIAN_SQUARE
    for freedom in np.unique(response.freedom[response.freedom > 0]):
        limit = scatter_limit(int(freedom) + 1, sigmas=sigmas) + common
        found |= (response.freedom == freedom) & (response.reduced_chi2 > limit)
    return found


def _common_noise(
    mean: Array,
    variance: Array,
    good: Bools,
    count: int,
    step: float,
    light: Array,
    period: tuple[int, int],
) -> NoiseModel | None:
    """Noise that pixels of a signal have in common; None of equal frames that are not rounded."""
    known = good & np.isfinite(mean) & np.isfinite(variance)
    if not known.any():
        known = np.isfinite(mean) & np.isfinite(variance)
    points = photon_transfer(mean, variance, known, count, step, light, period)
    if not len(points):
        raise InputError("'frames' hold no value: they show no noise")
    if step == 0 and not points[:, 1].any():
        return None
    return NoiseModel.fit(points, step=step)


def _check_shape(found: tuple[int, ...], shape: tuple[int, ...]) -> None:
    if found != shape:
        raise InputError(f"'frames' has frames of {found}, the sensor {shape}")


def _von_neumann(steps: Floats, variance: Floats, count: int) -> Floats:
    """Von Neumann's ratio of each pixel less 2, in its standard deviations."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = steps / (variance * (count - 1))
    return np.asarray((ratio - 2) / 2 * np.sqrt((count**2 - 1) / max(1, count - 2)))

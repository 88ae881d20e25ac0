"""The one way from what a caller gives, arrays or averaged frames, to `Exposures`."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, cast

import numpy as np

from equipix._check import as_array, as_floats, check_count, naming_memory, number
from equipix.defects import Findings, noisy_pixels
from equipix.errors import InputError
from equipix.exposures.exposures import Exposures
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Positions
from equipix.frames import FrameStatistics
from equipix.noise import NoiseModel, fit_frames, models_of_means
from equipix.shifts import round_shifts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from equipix._types import Array, Bools, FluxModel


def exposures_of(
    frames: ArrayLike | Sequence[FrameStatistics],
    shifts: ArrayLike,
    *,
    variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None = None,
    mask: ArrayLike | None = None,
    saturation: float | None = None,
    flux: ArrayLike | FluxModel | None = None,
    flux_std: ArrayLike | None = None,
    time: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    shift_std: ArrayLike | None = None,
    offset: bool = False,
    whole: bool = False,
) -> Exposures:
    """Check what the caller gave; the arguments are those of `equipix.calibrate`.

    With `whole` the shifts are rounded to whole pixels, with a warning where that matters.
    """
    statistics = as_statistics(frames)
    noise = fit_frames(statistics) if variance is None and statistics else None
    noisy = noisy_pixels(statistics, noise) if noise is not None else None
    with naming_memory("calibrating"):
        values = as_values(cast("ArrayLike", frames), statistics)
        models = as_models(variance if noise is None else noise, statistics, len(values))
        saturated = as_saturated(saturation, values, statistics)
        given = None if mask is None else as_mask(mask, values.shape)
        return Exposures(
            values=values,
            positions=Positions.of(
                round_shifts(shifts) if whole else shifts,
                rotation=rotation,
                std=shift_std,
                count=len(values),
            ),
            flux=Flux.of(flux, flux_std, time, len(values)),
            mask=union(given, saturated, noisy),
            variance=None
            if variance is None or models
            else as_variances(cast("ArrayLike", variance), values),
            noise=tuple(models),
            offset=offset,
            findings=Findings(saturated=_ever(statistics, saturated), noisy=noisy),
        )


def _ever(statistics: Sequence[FrameStatistics], saturated: Bools | None) -> Bools | None:
    """Which pixels saturate in any exposure."""
    maps: list[Bools] = [np.asarray(each.saturated > 0) for each in statistics]
    if saturated is not None:
        maps.append(saturated.any(axis=0))
    return union(*maps)


def as_statistics(frames: object) -> list[FrameStatistics]:
    """The frames as a list, if that is what they are; an empty one for arrays."""
    if not isinstance(frames, list | tuple):
        return []
    statistics = [each for each in frames if isinstance(each, FrameStatistics)]
    if statistics and len(statistics) != len(frames):
        raise InputError("'frames' mixes FrameStatistics and arrays, expected either")
    shapes = [each.mean.shape for each in statistics]
    if len(set(shapes)) > 1:
        raise InputError(f"'frames' holds means of shapes {shapes}, expected one shape")
    for k, each in enumerate(statistics):
        if each.saturated.all():
            raise InputError(
                f"'frames': every pixel of exposure {k} saturates: expose less, or correct the "
                "'saturation' that they were averaged with"
            )
    return statistics


def as_values(frames: ArrayLike, statistics: Sequence[FrameStatistics]) -> Array:
    """Frames as (n, rows, cols); NaN, which counts as masked, where averaged samples saturated."""
    if statistics:
        frames = np.stack([np.where(f.saturated > 0, np.nan, f.mean) for f in statistics])
    values = as_floats("frames", frames, ndim=3)
    if 0 in values.shape:
        raise InputError(
            f"'frames' has shape {values.shape}, expected at least one exposure and one pixel"
        )
    return values


def as_models(
    variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None,
    statistics: Sequence[FrameStatistics],
    count: int,
) -> list[NoiseModel]:
    """Noise model of each of the values given; none if variances are given as numbers, or not."""
    if variance is None and statistics:
        variance = fit_frames(statistics)
    if isinstance(variance, NoiseModel):
        return models_of_means(statistics, variance) if statistics else [variance] * count
    if not isinstance(variance, list | tuple):
        return []
    models = [each for each in variance if isinstance(each, NoiseModel)]
    if models:
        if len(models) != len(variance):
            raise InputError("'variance' mixes noise models and numbers, expected either")
        check_count("variance", len(models), count)
    return models


def as_saturated(
    saturation: float | None, values: Array, statistics: Sequence[FrameStatistics]
) -> Bools | None:
    """Which values reach the level `saturation`."""
    if saturation is None:
        return None
    if statistics:
        raise InputError(
            "'saturation' is for arrays, but 'frames' are averages: their saturated samples are "
            "counted where equipix.average is given the level"
        )
    level = number("saturation", saturation)
    if not level > 0:
        raise InputError(f"'saturation' is {saturation!r}, expected a level above 0")
    saturated: Bools = values >= level
    for k, each in enumerate(saturated):
        if each.all():
            raise InputError(
                f"'frames': every pixel of exposure {k} reaches the 'saturation' level {level:g}: "
                "expose less, or correct the level"
            )
    return saturated


def as_variances(variance: ArrayLike, values: Array) -> Array:
    """Variances in the shape and dtype that the solver takes."""
    variances = as_array("variance", variance, ndim=(1, 3))
    if variances.ndim == 1:
        check_count("variance", len(variances), len(values))
        return variances.astype(np.float64)
    if variances.shape != values.shape:
        raise InputError(f"'variance' has shape {variances.shape}, expected {values.shape}")
    with np.errstate(over="ignore"):  # the solver refuses what becomes infinite
        return variances.astype(values.dtype, copy=False)


def union(*masks: Bools | None) -> Bools | None:
    """Mask of what any of several masks, of one exposure or of all, hides."""
    given = [mask for mask in masks if mask is not None]
    return functools.reduce(np.logical_or, given) if given else None


def as_mask(mask: ArrayLike, shape: tuple[int, ...]) -> Bools:
    """Mask of one exposure or of all, of frames of that shape."""
    array = as_array("mask", mask, ndim=(2, 3))
    if array.dtype != np.bool_:
        raise InputError(f"'mask' has dtype {array.dtype}, expected bool: True = do not use")
    if array.shape not in (shape[1:], shape):
        raise InputError(f"'mask' has shape {array.shape}, expected {shape[1:]} or {shape}")
    return array

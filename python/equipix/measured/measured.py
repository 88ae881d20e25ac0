"""Mean frames and what is known of them: checks of arrays and averages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import (
    EXPOSURES,
    Array,
    Bools,
    Floats,
    Words,
    as_array,
    as_floats,
    as_level,
    check_count,
    union,
)
from equipix.errors import InputError
from equipix.measured.colour import Colours
from equipix.measured.defects import BadPixels
from equipix.measured.means import Averaged
from equipix.measured.noise import NoiseModel
from equipix.measured.saturation import Clipping, _largest, _saturated, clipping, highest, plateau
from equipix.measured.statistics import FrameStatistics


class Measured(NamedTuple):
    """Mean frames and what is known of them, from arrays or averages."""

    values: Array
    mask: Bools | None
    variance: Array | None
    models: Sequence[NoiseModel]
    bad_pixels: BadPixels
    dark: Array | None = None
    dark_variance: Floats | None = None
    clipped: Clipping | None = None
    raw: bool = False
    unsteady: str = ""
    colours: Colours | None = None
    names: tuple[str, ...] = ()

    def variance_of(self, exposure: int, signal: Array) -> Array | None:
        """Variance of the values of an exposure, where a model needs it at this signal."""
        if self.models:
            return self.models[exposure].variance(signal)
        return None if self.variance is None else np.asarray(self.variance[exposure])


def measured_of(
    frames: ArrayLike | Sequence[FrameStatistics] | Averaged,
    variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None = None,
    saturation: float | None = None,
    *,
    words: Words = EXPOSURES,
    colours: Colours | None = None,
) -> Measured:
    """Check frames and what is known of their noise.

    `words` are what messages call them, `colours` the filters of arrays or `FrameStatistics`.
    """
    averaged = frames if isinstance(frames, Averaged) else _averaged(frames, words, colours)
    if averaged is None:
        measured = _of_arrays(cast("ArrayLike", frames), variance, saturation, words)
        return measured._replace(colours=colours)
    return _of_averaged(averaged, variance, saturation, words)


def _of_averaged(
    averaged: Averaged,
    variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None,
    saturation: float | None,
    words: Words,
) -> Measured:
    """Averaged frames: their noise model, or the variances that the caller gives."""
    if saturation is not None:
        raise InputError(
            f"'saturation' is for arrays, but {words.argument} are averages: their saturated "
            "samples are counted where equipix.average is given the level"
        )
    noise = averaged.noise if variance is None else variance
    if isinstance(noise, NoiseModel):
        noise = averaged.rounded(noise)
    models = as_models(noise, averaged.count)
    if isinstance(noise, NoiseModel):
        models = averaged.models(noise)
    variances = None
    if variance is not None and not models:
        variances = as_variances(cast("ArrayLike", variance), averaged.values)
    model = noise if isinstance(noise, NoiseModel) else None
    bad_pixels = averaged.bad_pixels(model)
    dark = averaged.dark
    return Measured(
        averaged.values,
        union(bad_pixels.dead, bad_pixels.hot, bad_pixels.noisy),
        variances,
        models,
        bad_pixels,
        None if dark is None else dark.mean.astype(averaged.values.dtype),
        None if model is None else averaged.dark_variance(model),
        averaged.clipped,
        averaged.raw,
        averaged.unsteady,
        averaged.colours,
        averaged.names,
    )


def _of_arrays(
    frames: ArrayLike,
    variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None,
    saturation: float | None,
    words: Words,
) -> Measured:
    """Arrays: only what the caller gives is known of them."""
    values = as_floats(words.argument.strip("'"), frames, ndim=3)
    if 0 in values.shape:
        raise InputError(
            f"{words.argument} has shape {values.shape}, expected at least one {words.one} and one "
            "pixel"
        )
    models = as_models(variance, len(values))
    variances = None
    if variance is not None and not models:
        variances = as_variances(cast("ArrayLike", variance), values)
    level = _largest(frames) if saturation is None else as_level(saturation)
    if level is None:
        clipped = highest(clipping(each) or plateau(each) for each in values)
        return Measured(values, None, variances, models, BadPixels(), clipped=clipped)
    saturated = _saturated(values, level, words)
    clipped = highest(clipping(np.where(each < level, each, np.nan)) for each in values)
    if saturation is None and not saturated.any():
        return Measured(values, None, variances, models, BadPixels(), clipped=clipped)
    bad_pixels = BadPixels(saturated=np.any(saturated, axis=0))
    return Measured(values, saturated, variances, models, bad_pixels, clipped=clipped)


def _averaged(frames: object, words: Words, colours: Colours | None) -> Averaged | None:
    """Statistics of all exposures, reduced; None for arrays."""
    if not isinstance(frames, list | tuple):
        return None
    statistics = [each for each in frames if isinstance(each, FrameStatistics)]
    if statistics and len(statistics) != len(frames):
        raise InputError(f"{words.argument} mixes FrameStatistics and arrays, expected either")
    return Averaged.of(statistics, words=words, colours=colours) if statistics else None


def as_models(variance: object, count: int) -> list[NoiseModel]:
    """Noise model of each of the values; none if variances are given as numbers, or not."""
    if isinstance(variance, NoiseModel):
        return [variance] * count
    if not isinstance(variance, list | tuple):
        return []
    models = [each for each in variance if isinstance(each, NoiseModel)]
    if models:
        if len(models) != len(variance):
            raise InputError("'variance' mixes noise models and numbers, expected either")
        check_count("variance", len(models), count)
    return models


def as_variances(variance: ArrayLike, values: Array) -> Array:
    """Variances in the shape and dtype that the solver takes."""
    variances = as_array("variance", variance, ndim=(0, 1, 2, 3))
    shape = np.shape(variance)  # as_array makes one number an array of one
    if len(shape) == 1:
        check_count("variance", len(variances), len(values))
        return variances.astype(np.float64)
    if shape != values.shape:
        raise InputError(
            f"'variance' has shape {shape}, expected {(len(values),)} or {values.shape}"
        )
    with np.errstate(over="ignore"):  # the solver refuses what becomes infinite
        return variances.astype(values.dtype, copy=False)


_FURTHER = 5.0
"""Range of the means along the last axis, over that along the first, from which they are levels."""


def check_levels(levels: object) -> None:
    """Refuse stacks of raw frames, and levels of several shapes, before they become one array."""
    if isinstance(levels, FrameStatistics):
        raise InputError("'levels' is one average, expected a list of them: one a level")
    arrays = levels if isinstance(levels, list | tuple) else [levels]
    if any(not hasattr(each, "dtype") and hasattr(each, "__next__") for each in arrays):
        raise InputError("'levels' holds iterators of frames: average each with equipix.average")
    known = [each for each in arrays if isinstance(each, np.ndarray)]
    frames_of_one = 3 if isinstance(levels, list | tuple) else 4
    stacks = [each.shape for each in known if each.ndim == frames_of_one]
    if stacks:
        raise InputError(
            f"'levels' holds raw frames, of shape {stacks[0]}: give one mean frame for each level, "
            "by equipix.average(frames)"
        )
    if isinstance(levels, np.ndarray):
        _refuse_last_axis(levels)
    shapes = list(dict.fromkeys(each.shape for each in known))
    if len(shapes) > 1:
        named = " and ".join(map(str, shapes[:2]))
        raise InputError(f"'levels' holds arrays of shapes {named}, expected one (rows, cols)")


def _refuse_last_axis(levels: Array) -> None:
    """Refuse levels along the last axis: it is the shortest, and its means differ most."""
    if (
        levels.ndim != 3
        or levels.shape[2] >= min(levels.shape[:2])
        or levels.dtype.kind not in "fiu"
    ):
        return
    first, last = (np.ptp(np.mean(levels, axis=axes)) for axes in ((1, 2), (0, 1)))
    if last > _FURTHER * first:
        raise InputError(
            f"'levels' has shape {levels.shape}, {len(levels)} levels of {levels.shape[1]} x "
            f"{levels.shape[2]} pixels, whose means differ by {first:.4g} DN, and by {last:.4g} DN "
            "along the last axis: expected levels along the first one, numpy.moveaxis(levels, -1, "
            "0)"
        )


def check_variance(variance: Any, count: int) -> None:
    """Refuse what is not one noise model, or one of them or one number above 0 for each level."""
    if variance is None or isinstance(variance, NoiseModel):
        return
    if isinstance(variance, list | tuple) and any(isinstance(e, NoiseModel) for e in variance):
        _check_count(len(variance), count)
        return
    numbers = as_array("variance", variance, ndim=(0, 1, 2, 3)).astype(np.float64)
    shape = np.shape(variance)  # as_array makes one number an array of one
    if len(shape) != 1:
        raise InputError(
            f"'variance' has shape {shape}, expected ({count},), one number a level, or a "
            "NoiseModel: a pixel's own sample variance makes weights noisy"
        )
    _check_count(len(numbers), count)
    _refuse_below(numbers)


def _check_count(got: int, count: int) -> None:
    if got != count:
        raise InputError(f"'variance' has {got} entries, expected {count}: one a level")


def _refuse_below(numbers: Array) -> None:
    wrong = numbers[~(np.isfinite(numbers) & (numbers > 0))]
    if wrong.size:
        raise InputError(f"'variance' holds {wrong[0]:g}, expected finite numbers above 0, in DN²")

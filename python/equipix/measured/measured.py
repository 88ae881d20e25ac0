"""Mean frames and what is known of them: checks of arrays and averages."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Self, cast

import numpy as np

from equipix._check import (
    EXPOSURES,
    Array,
    ArrayLike,
    Bools,
    Floats,
    Ints,
    Pixels,
    ReadOnly,
    Words,
    as_array,
    as_floats,
    as_level,
    check_count,
    union,
)
from equipix.errors import InputError
from equipix.measured.colour import Colours, Filters
from equipix.measured.defects import BadPixels
from equipix.measured.means import Averaged
from equipix.measured.noise import NoiseModel
from equipix.measured.saturation import (
    Clipping,
    clipping_at,
    highest,
    is_unsigned,
    saturated_values,
    saturation_level,
)
from equipix.measured.statistics import FrameStatistics


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured(ReadOnly):
    """Mean frames of several exposures or levels, as read-only arrays, and what is known of them.

    Attributes
    ----------
    values : ndarray, shape (n, rows, cols), float32 or float64
        Mean frames, the dark subtracted unless an offset is sought, in DN; what is not finite is
        not used.
    mask : ndarray of bool, shape (rows, cols) or (n, rows, cols), or None
        True = do not use.
    variance : ndarray, shape (n,) or (n, rows, cols), or None
        Variance of the values, in DN²; None: all weights are 1.
    noise : tuple of NoiseModel
        Noise model of each mean frame, where the variance is to be evaluated at what a fit expects.
    bad_pixels : BadPixels
        Bad pixels found before the last fit.
    saturation : float or None
        Level of saturation in DN, where it was given.
    clipped : Clipping or None
        A saturation level that was not given, if the values show one.
    dark : ndarray, shape (rows, cols), or None
        The dark frame that was subtracted from all, in DN, where it is known.
    dark_variance : ndarray, shape (rows, cols), float64, or None
        Its variance, in DN²: an error common to all exposures, so `variance` and `noise` are
        without it. None where it is unknown, or where an offset is sought, which takes all of it.
    raw : bool
        Whether no dark was subtracted: from averages of whole numbers, or arrays of unsigned ones.
    unsteady : str
        Which exposure has light that varied between its frames, and by how much; empty if none has.
    colours : Colours or None
        Colour filters of the pixels, where they are given.
    filters : Filters or None
        Colour filters of the pixels with their responses, where they are given or stand out of the
        values; None until they are looked for.
    names : tuple of str
        What the user calls each exposure, if anything.
    """

    values: Array
    mask: Bools | None = None
    variance: Array | None = None
    noise: tuple[NoiseModel, ...] = ()
    bad_pixels: BadPixels = field(default_factory=BadPixels)
    saturation: float | None = None
    clipped: Clipping | None = None
    dark: Array | None = None
    dark_variance: Floats | None = None
    raw: bool = False
    unsteady: str = ""
    colours: Colours | None = None
    filters: Filters | None = None
    names: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of exposures."""
        return len(self.values)

    @property
    def shape(self) -> tuple[int, int]:
        """Sizes of the sensor (rows, cols)."""
        rows, cols = self.values.shape[1:]
        return rows, cols

    @property
    def cfa(self) -> Colours | None:
        """The colour filters that were given."""
        return self.filters.colours if self.filters is not None and self.filters.given else None

    def usable(self, exposure: int | slice = slice(None)) -> Bools:
        """Return which measurements may be used, of all exposures or of one."""
        usable: Bools = np.isfinite(self.values[exposure])
        if self.mask is not None:
            usable &= ~(self.mask[exposure] if self.mask.ndim == 3 else self.mask)
        return usable

    def variance_of(self, exposure: int, signal: Array) -> Array | None:
        """Variance of the values of an exposure, where a model needs it at this signal."""
        if self.noise:
            return self.noise[exposure].variance(signal)
        return None if self.variance is None else np.asarray(self.variance[exposure])

    def raw_values(self, exposure: int, pixels: Pixels = ...) -> Array:
        """Values of an exposure, or of some of its pixels, before the dark was subtracted.

        NaN where they saturate.
        """
        values: Array = self.values[exposure][pixels]
        if self.mask is not None and self.mask.ndim == 3:
            values = np.where(self.mask[exposure][pixels], np.nan, values)
        return values if self.dark is None else values + self.dark[pixels]

    def weighted(self, variance: Array | None) -> Self:
        """Return the exposures with other variances."""
        return dataclasses.replace(self, variance=variance)

    def without(self, mask: Bools) -> Self:
        """Return the exposures without some measurements, besides those masked before."""
        return dataclasses.replace(self, mask=union(mask, self.mask))

    def chosen(self, exposures: Ints) -> Self:
        """Return some of the exposures."""
        variance, mask = self.variance, self.mask
        return dataclasses.replace(
            self,
            values=self.values[exposures],
            variance=None if variance is None else variance[exposures],
            mask=mask[exposures] if mask is not None and mask.ndim == 3 else mask,
            noise=tuple(self.noise[k] for k in exposures) if self.noise else (),
            names=tuple(self.names[k] for k in exposures) if self.names else (),
        )


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
    averaged = averaged_of(frames, words, colours)
    if averaged is None:
        return _of_arrays(cast("ArrayLike", frames), variance, saturation, words, colours)
    if saturation is not None:
        raise InputError(
            f"'saturation' is for arrays, but {words.argument} are averages: their saturated "
            "samples are counted where equipix.average is given the level"
        )
    return _of_averaged(averaged, variance, words)


def averaged_of(frames: object, words: Words, colours: Colours | None) -> Averaged | None:
    """Statistics of all exposures, reduced; None for arrays."""
    if isinstance(frames, Averaged):
        return frames
    if isinstance(frames, FrameStatistics):
        raise InputError(
            f"{words.argument} is one FrameStatistics, expected a list: one for each {words.one}"
        )
    if not isinstance(frames, list | tuple):
        return None
    statistics = [each for each in frames if isinstance(each, FrameStatistics)]
    if statistics and len(statistics) != len(frames):
        raise InputError(f"{words.argument} mixes FrameStatistics and arrays, expected either")
    return Averaged.of(statistics, words=words, colours=colours) if statistics else None


def _of_averaged(
    averaged: Averaged, variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None, words: Words
) -> Measured:
    """Averaged frames: their noise model, or the variances that the caller gives."""
    model = averaged.noise if variance is None else variance
    if isinstance(model, NoiseModel):
        if model.step == 0:
            model = dataclasses.replace(model, step=averaged.step)
        noise, variances = averaged.models(model), None
    else:
        noise, variances = _noise_of(variance, averaged.values, words)
        model = None
    bad_pixels = averaged.bad_pixels(model)
    dark = averaged.black if averaged.dark is None else averaged.dark.mean
    known = variance is None or model is not None
    of_dark = averaged.dark_variance(model) if known else None
    return Measured(
        values=averaged.values,
        mask=union(bad_pixels.dead, bad_pixels.hot, bad_pixels.noisy),
        variance=variances,
        noise=noise,
        bad_pixels=bad_pixels,
        saturation=averaged.saturation,
        clipped=averaged.clipped,
        dark=None if dark is None else dark.astype(averaged.values.dtype, copy=False),
        dark_variance=of_dark,
        raw=averaged.raw,
        unsteady=averaged.unsteady,
        colours=averaged.colours,
        names=tuple(averaged.names),
    )


def _of_arrays(
    frames: ArrayLike,
    variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None,
    saturation: float | None,
    words: Words,
    colours: Colours | None,
) -> Measured:
    """Arrays: only what the caller gives is known of them."""
    _refuse_shapes(frames, words)
    values = as_floats(words.argument.strip("'"), frames, ndim=3)
    if 0 in values.shape:
        raise InputError(
            f"{words.argument} has shape {values.shape}, expected at least one {words.one} and one "
            "pixel"
        )
    noise, variances = _noise_of(variance, values, words)
    given = frames if isinstance(frames, list | tuple) else [frames] * len(values)
    levels = [saturation_level(each, saturation) for each in given]
    saturated = saturated_values(values, levels, words)
    return Measured(
        values=values,
        mask=saturated,
        variance=variances,
        noise=noise,
        bad_pixels=BadPixels(saturated=None if saturated is None else np.any(saturated, axis=0)),
        saturation=as_level(saturation),
        clipped=highest(map(clipping_at, values, levels)),
        raw=is_unsigned(frames),
        colours=colours,
    )


def _refuse_shapes(frames: object, words: Words) -> None:
    """Refuse arrays of several shapes, before they become one array."""
    arrays = frames if isinstance(frames, list | tuple) else []
    shapes = list(dict.fromkeys(each.shape for each in arrays if isinstance(each, np.ndarray)))
    if len(shapes) > 1:
        named = " and ".join(map(str, shapes[:2]))
        raise InputError(f"{words.argument} holds arrays of shapes {named}, expected one shape")


def _noise_of(
    variance: Any, values: Array, words: Words
) -> tuple[tuple[NoiseModel, ...], Array | None]:
    """Noise model of each of the values, or their variances as the solver takes them."""
    if variance is None:
        return (), None
    if isinstance(variance, NoiseModel):
        return (variance,) * len(values), None
    if isinstance(variance, list | tuple):
        models = tuple(each for each in variance if isinstance(each, NoiseModel))
        if models and len(models) != len(variance):
            raise InputError("'variance' mixes noise models and numbers, expected either")
        if models:
            check_count("variance", len(models), len(values), words.one)
            return models, None
    numbers = as_array("variance", variance, ndim=(0, 1, 2, 3))
    shape = np.shape(variance)  # as_array makes one number an array of one
    if len(shape) == 1:
        check_count("variance", len(numbers), len(values), words.one)
        return (), numbers.astype(np.float64)
    if shape != values.shape or not words.pixel_variances:
        others = values.shape if words.pixel_variances else "a NoiseModel"
        raise InputError(
            f"'variance' has shape {shape}, expected {(len(values),)}, one number for each "
            f"{words.one}, or {others}"
        )
    with np.errstate(over="ignore"):  # the solver refuses what becomes infinite
        return (), numbers.astype(values.dtype, copy=False)


_FURTHER = 5.0
"""Range of the means along the last axis, over that along the first, from which they are levels."""


def check_levels(levels: object) -> None:
    """Refuse stacks of raw frames, and levels of several shapes, before they become one array."""
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

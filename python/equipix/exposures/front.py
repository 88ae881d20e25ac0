"""The one function that makes `Exposures` of arrays or averaged frames, and its checks."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from equipix._check import as_array, as_floats, as_level, check_count, naming_memory
from equipix.colour import Colours
from equipix.defects import Findings, refuse_saturated
from equipix.errors import InputError
from equipix.exposures.averaged import EXPOSURES, Averaged, Words
from equipix.exposures.clipping import Clipping, clipping, highest, plateau
from equipix.exposures.exposures import Exposures
from equipix.exposures.flux import Flux
from equipix.exposures.nothing import refuse_nothing
from equipix.exposures.positions import Positions
from equipix.exposures.reach import check_reach
from equipix.frames import FrameStatistics
from equipix.mosaic import Filters, mean_signal
from equipix.noise import NoiseModel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from equipix._types import Array, Bools, Floats, FluxModel


def exposures_of(
    frames: ArrayLike | Sequence[FrameStatistics] | Averaged,
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
    dark_variance: ArrayLike | None = None,
    cfa: ArrayLike | Colours | None = None,
) -> Exposures:
    """Check what the caller gave; the arguments are those of `equipix.calibrate`."""
    with naming_memory("calibrating"):
        measured = measured_of(frames, variance, saturation, colours=Colours.of(cfa))
        count = len(measured.values)
        given = None if mask is None else as_mask(mask, measured.values.shape)
        positions = Positions.of(shifts, rotation=rotation, std=shift_std, count=count)
        rows, cols = measured.values.shape[1:]
        check_reach(shifts, positions, (rows, cols))
        exposures = Exposures(
            values=measured.values,
            positions=positions,
            flux=Flux.of(flux, flux_std, time, count),
            mask=union(given, measured.mask),
            variance=measured.variance,
            noise=tuple(measured.models),
            offset=offset,
            findings=measured.findings,
            dark=measured.dark,
            dark_variance=_of_dark(dark_variance, measured, offset=offset),
            clipped=measured.clipped,
            raw=(measured.raw or _is_unsigned(frames)) and not offset,
            unsteady=measured.unsteady,
            names=measured.names,
        )
        refuse_nothing(exposures, given)
        shown = mean_signal(exposures.values, exposures.mask)
        return exposures.behind(Filters.of(measured.colours, *shown))


def _of_dark(given: ArrayLike | None, measured: Measured, *, offset: bool) -> Floats | None:
    """Variance of the dark that was subtracted from all, given or that of the averages."""
    if given is not None and offset:
        raise InputError(
            "'dark_variance' is that of a dark that was subtracted, but 'dark' is 'fit': give one "
            "of the two"
        )
    if offset:
        return None
    if given is None:
        return measured.dark_variance
    shape = measured.values.shape[1:]
    variance = as_array("dark_variance", given, ndim=(0, 2)).astype(np.float64)
    if variance.shape not in ((1,), shape):  # as_array makes one number an array of one
        raise InputError(
            f"'dark_variance' has shape {variance.shape}, expected {shape} or one number"
        )
    wrong = variance[~(np.isfinite(variance) & (variance >= 0))]
    if wrong.size:
        raise InputError(f"'dark_variance' holds {wrong[0]:g}, expected finite numbers not below 0")
    return np.array(np.broadcast_to(variance, shape))


class Measured(NamedTuple):
    """Mean frames and what is known of them, from arrays or averages."""

    values: Array
    mask: Bools | None
    variance: Array | None
    models: Sequence[NoiseModel]
    findings: Findings
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
    findings = averaged.findings(model)
    dark = averaged.dark
    return Measured(
        averaged.values,
        union(findings.dead, findings.hot, findings.noisy),
        variances,
        models,
        findings,
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
        return Measured(values, None, variances, models, Findings(), clipped=clipped)
    saturated = _saturated(values, level, words)
    clipped = highest(clipping(np.where(each < level, each, np.nan)) for each in values)
    if saturation is None and not saturated.any():
        return Measured(values, None, variances, models, Findings(), clipped=clipped)
    findings = Findings(saturated=np.any(saturated, axis=0))
    return Measured(values, saturated, variances, models, findings, clipped=clipped)


def _largest(frames: ArrayLike) -> float | None:
    """Largest value of arrays of whole numbers, which counts as saturated unless given."""
    dtype = _dtype(frames)
    return float(np.iinfo(dtype).max) if dtype is not None and dtype.kind in "iu" else None


def _is_unsigned(frames: object) -> bool:
    """Whether frames are arrays as cameras write them: a subtracted dark leaves values below 0."""
    dtype = _dtype(frames)
    return dtype is not None and dtype.kind == "u"


def _dtype(frames: object) -> np.dtype[Any] | None:
    """Return the dtype that arrays have in common."""
    arrays = frames if isinstance(frames, list | tuple) else [frames]
    dtypes = {getattr(each, "dtype", None) for each in arrays}
    return dtypes.pop() if len(dtypes) == 1 else None


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


def _saturated(values: Array, level: float, words: Words) -> Bools:
    """Which values reach the saturation level."""
    saturated: Bools = values >= level
    for k, each in enumerate(saturated):
        refuse_saturated(words.place(k), values[k], each, level)
    return saturated


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


def union(*masks: Bools | None) -> Bools | None:
    """Union of several masks, of one exposure or of all."""
    given = [mask for mask in masks if mask is not None]
    return functools.reduce(np.logical_or, given) if given else None


def as_mask(mask: ArrayLike, shape: tuple[int, ...]) -> Bools:
    """Mask of one exposure or of all, of frames of that shape."""
    array = as_array("mask", mask, ndim=(2, 3))
    if array.dtype != np.bool_:
        raise InputError(
            f"'mask' has dtype {array.dtype}, expected bool, True = do not use: give mask != 0"
        )
    if array.shape not in (shape[1:], shape):
        raise InputError(f"'mask' has shape {array.shape}, expected {shape[1:]} or {shape}")
    return array

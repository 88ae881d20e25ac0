"""The level of saturation: given, of the dtype, or found by clipped values."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from equipix._check import Array, Bools, Words, as_level
from equipix.errors import InputError
from equipix.measured.part import blocks
from equipix.measured.statistics import FrameStatistics

_MANY = 16
"""Fewest values at the highest one."""

_CROWDED = 2.0
"""How many times as many values are at the highest one as just below, where it is a level."""

_BELOW = 0.0025
"""Width of "just below" over the highest value; at least one step between values."""

_PLATEAU, _SPREAD = 4.0, 3.0
"""How many times as many values are on a plateau as just below, and how wide it is, in DN."""

_FINE = 1000.0
"""Highest value from which a plateau of so many DN is narrow: an even patch of a scene is wider."""

_RARE = 0.05
"""Largest share of pixels without scatter where its absence shows a level."""

ROUNDING = 1e-9
"""Relative rounding of means from which a dark was subtracted, and added again."""

_SIGMAS = 6
"""Distance from a level, in standard deviations, at which no sample reaches it."""

_FEWEST_BITS = 8
"""Fewest bits of a camera."""


class Clipping(NamedTuple):
    """A probable saturation level, in the units of the frames, and the values found at it.

    `top` is the highest value where the level is one of several: noise of the electronics behind
    the saturation spreads it.
    """

    level: float
    values: int
    top: float | None = None


def clipping(values: Array, crowded: float = _CROWDED, step: float = 0.0) -> Clipping | None:
    """Find the level that values of one exposure are clipped at; what is NaN does not count.

    At the level must be more than `crowded` times as many values as just below: within `step`, the
    step between the values of frames, at least, since frames without noise have their means there.

    Notes
    -----
    The number of values per step of the scale changes little near the highest one, unless a level
    clips them: then all above it are at it. Where most values are at it, an even scene does the
    same, and only the largest number of some bits is taken for a level.
    """
    known = _known(values)
    if known.size <= _MANY:
        return None
    top = float(known.max())
    rounding = ROUNDING * abs(top)
    count = int(np.count_nonzero(known >= top - rounding))
    if count < _MANY or top <= 0:
        return None
    below = known[known < top - rounding]
    if not below.size:
        return None
    width = max(_BELOW * top, top - float(below.max()), step) + rounding
    if count <= crowded * np.count_nonzero(below >= top - width):
        return None
    level = whole(top)
    return Clipping(level, count) if 2 * count < known.size or is_of_bits(level) else None


def _known(values: Array) -> Array:
    """Values that are finite: of most exposures all, of which no copy is made."""
    finite = values.size > 0 and np.isfinite([values.min(), values.max()]).all()
    return values if finite else values[np.isfinite(values)]


def whole(top: float) -> float:
    """The whole number that a mean is but for rounding, or the mean."""
    return float(np.rint(top)) if abs(top - np.rint(top)) <= ROUNDING * abs(top) else top


def clipping_at(values: Array, level: float | None) -> Clipping | None:
    """Find the level that values of one exposure are clipped at, below one that is known."""
    if level is None:
        return clipping(values) or plateau(values)
    return clipping(np.where(values < level, values, np.nan))


def plateau(values: Array) -> Clipping | None:
    """Find a level that noise of ± 1 DN spreads over three values; values of one exposure, in DN.

    What an even scene does is none: most values are in a plateau then, or it is wider.
    """
    known = _known(values)
    top = float(known.max()) if known.size > _MANY else 0.0
    if top < _FINE:
        return None
    level = float(np.rint(top)) - _SPREAD + 1
    count = int(np.count_nonzero(known >= level))
    low = level - max(_SPREAD, _BELOW * top)
    below = int(np.count_nonzero(known >= low)) - count
    # A scene that is clipped reaches its level; stuck pixels are far above all others.
    reached = bool(((known < low) & (known >= 2 * low - level)).any())
    is_level = count >= _MANY and count > _PLATEAU * below and 2 * count < known.size and reached
    return Clipping(level, count, top) if is_level else None


def clipping_of(frames: FrameStatistics) -> Clipping | None:
    """Find the level that averaged frames are clipped at, before the dark was subtracted.

    A pixel that saturates in every frame has the level as its mean and no scatter. Where scatter is
    missing from few other pixels, those at the level need not be compared with those just below,
    which contain the pixels that saturate in some frames only.
    """
    if _few_near_highest(frames):
        return None  # usually: then no map is made
    raw = _raw_mean(frames)
    known = raw[frames.saturated == 0] if frames.saturated.any() else raw
    found = clipping(known, crowded=0.0)
    if found is None:
        return plateau(known)
    raw = np.where(frames.saturated > 0, np.nan, raw)
    steady = frames.variance == 0
    others = np.isfinite(raw) & (raw < found.level * (1 - ROUNDING))
    if np.count_nonzero(steady & ~others) >= _MANY and np.mean(steady[others]) < _RARE:
        return found
    return clipping(raw, step=frames.step) or plateau(raw)


def _few_near_highest(frames: FrameStatistics) -> bool:
    """Whether too few values are as high as the highest, or on a plateau with it, for a level."""

    def values(rows: slice) -> Array:
        raw = _raw_mean(frames, rows)
        return np.where((frames.saturated[rows] == 0) & np.isfinite(raw), raw, -np.inf)

    highest = {rows.start: values(rows).max() for rows in blocks(frames.mean.shape)}
    level = np.rint(max(highest.values())) - _SPREAD + 1
    near = (rows for rows in blocks(frames.mean.shape) if highest[rows.start] >= level)
    return bool(sum(np.count_nonzero(values(rows) >= level) for rows in near) < _MANY)


def unclipped(frames: FrameStatistics, clipped: Clipping) -> Bools:
    """Find pixels whose samples all lie below a level: only their scatter is that of the camera.

    The limit is six standard deviations of a sample below the level, those of pixels at 50 to 90 %
    of it: near the level they have up to √2 times that.
    """
    raw = _raw_mean(frames)
    bright = (raw > 0.5 * clipped.level) & (raw < 0.9 * clipped.level)
    variances = frames.variance[bright & np.isfinite(frames.variance)]
    scatter = float(np.sqrt(np.median(variances))) if variances.size else 0.0
    below: Bools = raw < clipped.level - _SIGMAS * scatter
    return below


def _raw_mean(frames: FrameStatistics, rows: slice = slice(None)) -> Array:
    """Mean before the dark was subtracted, of some rows."""
    mean: Array = frames.mean[rows]
    return mean if frames.dark is None else mean + frames.dark.mean[rows]


def clipping_advice(
    clipped: Clipping, file: str = "experiment.toml", function: str = "calibrate"
) -> str:
    """Say what was found and what to write, in a file or to a function of arrays."""
    level = f"{clipped.level:.10g}"
    where = f"exactly {level}, the highest one"
    if clipped.top is not None:
        where = f"between {level} and {clipped.top:.10g}, the highest one, with few just below"
    return (
        f"{clipped.values} values are {where}: they probably saturate and "
        f"count as valid. Write saturation = {level} in [sensor] of {file}, or give it as "
        f"'saturation' to equipix.average or, of arrays, to {function}"
    )


def highest(found: Iterable[Clipping | None]) -> Clipping | None:
    """Return the highest level of several exposures, with the values of all of them there."""
    levels = [each for each in found if each is not None]
    if not levels:
        return None
    level = max(each.level for each in levels)
    same = [each for each in levels if each.level == level]
    return Clipping(level, sum(each.values for each in same), same[0].top)


def is_of_bits(level: float) -> bool:
    """Whether a level is 2^bits − 1."""
    bits = np.log2(level + 1)
    return bool(bits >= _FEWEST_BITS and bits == np.rint(bits))


def refuse_saturated(
    which: str, values: Array, saturates: Bools, level: float | None, key: str = "saturation"
) -> None:
    """Refuse a frame whose saturated values leave none to measure with.

    Parameters
    ----------
    which : str
        The argument, and which of its frames.
    values : ndarray, shape (rows, cols)
        Its values.
    saturates : ndarray of bool, shape (rows, cols)
        Which of them saturate.
    level : float or None
        The saturation level in DN, where it is known.
    key : str
        The argument or key of a file that gives the level.

    Raises
    ------
    InputError
        If pixels saturate, and no other one holds a finite value.
    """
    if saturates.any() and not (np.isfinite(values) & ~saturates).any():
        raise InputError(
            f"{which}: {np.mean(saturates):.1%} of the pixels reach the saturation "
            f"level{'' if level is None else f' of {level:g} DN'} and none is left to measure "
            f"with: expose less, or correct '{key}'"
        )


def saturation_level(frames: object, given: float | None) -> float | None:
    """Level given, or the largest value of the whole numbers that arrays hold."""
    return level_of(_dtype(frames), as_level(given))


def level_of(dtype: np.dtype[Any] | None, given: float | None) -> float | None:
    """Level given, or the largest value of whole numbers of a dtype."""
    if given is not None or dtype is None or dtype.kind not in "iu":
        return given
    return float(np.iinfo(dtype).max)


def is_unsigned(frames: object) -> bool:
    """Whether frames are arrays as cameras write them: a subtracted dark leaves values below 0."""
    dtype = _dtype(frames)
    return dtype is not None and dtype.kind == "u"


def _dtype(frames: object) -> np.dtype[Any] | None:
    """Return the dtype that arrays have in common."""
    arrays = frames if isinstance(frames, list | tuple) else [frames]
    dtypes = {getattr(each, "dtype", None) for each in arrays}
    return dtypes.pop() if len(dtypes) == 1 else None


def saturated_values(values: Array, levels: Sequence[float | None], words: Words) -> Bools | None:
    """Which values of frames (n, rows, cols) reach the level of their frame; None if none does."""
    known = [(k, level) for k, level in enumerate(levels) if level is not None]
    reached = [(k, level) for k, level in known if np.fmax.reduce(values[k], axis=None) >= level]
    if not reached:
        return None  # usually: then no map of all values is made
    saturated = np.zeros(values.shape, bool)
    for k, level in reached:
        saturated[k] = values[k] >= level
        refuse_saturated(words.place(k), values[k], saturated[k], level)
    return saturated

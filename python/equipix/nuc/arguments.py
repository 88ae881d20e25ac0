"""Checks of what the caller of a fit of response curves gives, with the words of levels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix._check import as_array
from equipix.errors import InputError
from equipix.frames import FrameStatistics
from equipix.noise import NoiseModel

if TYPE_CHECKING:
    from equipix._types import Array


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

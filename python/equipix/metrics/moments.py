"""Mean image and temporal variance of frames of a steady even scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix._check import as_array
from equipix.errors import InputError
from equipix.frames import FrameStatistics, refuse_subtracted

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from equipix._types import Floats


class Moments(NamedTuple):
    """Mean image, temporal variance of one frame in the mean of all pixels, number of frames."""

    mean: Floats
    variance: float
    frames: int


def signed_root(square: float) -> float:
    """Root of a variance estimate; of a negative one the negative root of its size."""
    return float(np.sign(square) * np.sqrt(abs(square)))


def stack_of(name: str, frames: ArrayLike) -> Floats:
    """Return two or more frames of two pixels or more as float64 of shape (n, rows, cols)."""
    stack = as_array(name, frames, ndim=3).astype(np.float64)
    if len(stack) < 2 or stack[0].size < 2:
        raise InputError(
            f"'{name}' has shape {stack.shape}, expected two or more frames of two or more pixels"
        )
    return stack


def moments(name: str, frames: ArrayLike | FrameStatistics) -> Moments:
    """Mean and noise of raw frames of which every pixel counts.

    Notes
    -----
    The mean of each frame is subtracted before its noise is taken, so a drift of the light does
    not count: for two frames the variance is ½⟨(y₀ − y₁)²⟩ − ½(μ₀ − μ₁)², ⟨⟩ over all pixels.
    Averages do not know the means of their frames, so there a drift counts as noise.
    """
    if isinstance(frames, FrameStatistics):
        refuse_subtracted(frames, f"'{name}'")
        count, found = int(frames.count.min()), (frames.mean, frames.variance)
        if count < 2 or int(frames.count.max()) != count:
            raise InputError(
                f"'{name}' has {count} to {frames.count.max()} samples a pixel, expected as many "
                "everywhere, two or more"
            )
        return Moments(found[0], float(found[1].mean()), count)
    stack = stack_of(name, frames)
    if not np.isfinite(stack).all():
        lost = np.count_nonzero(~np.isfinite(stack))
        raise InputError(f"'{name}' holds {lost} values that are not finite, expected none")
    free = stack - stack.mean(axis=(1, 2), keepdims=True)
    return Moments(stack.mean(axis=0), float(free.var(axis=0, ddof=1).mean()), len(stack))

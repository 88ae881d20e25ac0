"""Mean image and temporal variance of frames of a steady even scene, in one pass over them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix._check import as_array
from equipix.errors import DriftWarning, EquipixWarning, InputError, warn
from equipix.frames import FrameStatistics, refuse_subtracted

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from equipix._types import Array, Bools, Floats


_SIGMAS = 6.0
"""Standard errors above chance from which noise is common to a line."""

_MOST_DRIFT = 5.0
"""Scatter of frame means over the noise of a pixel, up to which they are of one level. Where gains
differ by 5 % the drift then adds 6 % to the variance."""


class Moments(NamedTuple):
    """Mean image, temporal variance of one frame in the mean of all pixels, number of frames."""

    mean: Floats
    variance: float
    frames: int


class Temporal(NamedTuple):
    """Each pixel over time, the drift of the frame mean removed; NaN where a sample is missing."""

    mean: Floats
    """Mean image."""
    variance: Floats
    """Unbiased variance of one frame."""
    steps: Floats
    """Sum of the squared differences of successive frames."""
    used: Bools
    """Pixels that are finite in all frames and not masked: the frame means are taken over them."""
    frames: int
    drift: float
    """Standard deviation of the frame means."""


def signed_root(square: float) -> float:
    """Root of a variance estimate; of a negative one the negative root of its size."""
    return float(np.sign(square) * np.sqrt(abs(square)))


def stack_of(name: str, frames: ArrayLike) -> Array:
    """Return two or more frames of two pixels or more in their own dtype.

    Warns
    -----
    EquipixWarning
        If the last axis seems to be that of the frames.
    """
    stack = as_array(name, frames, ndim=3)
    if len(stack) < 2 or stack[0].size < 2:
        raise InputError(
            f"'{name}' has shape {stack.shape}, expected two or more frames of two or more pixels"
        )
    if stack.shape[2] < min(stack.shape[:2]):
        _warn_of_axes(name, stack)
    return stack


def _warn_of_axes(name: str, stack: Array) -> None:
    """Warn if values along the last axis have in common what differs between frames.

    Of frames (rows, cols, n) this is the pattern: a row is taken for a frame, and its n values of a
    pixel for a line of pixels.
    """
    with np.errstate(invalid="ignore"):
        mean = stack.mean(axis=0, dtype=np.float64)
    lines, every = 0.0, 0.0
    for frame in stack:
        with np.errstate(invalid="ignore"):
            free = np.nan_to_num(frame - mean, posinf=0, neginf=0)
        lines += float(np.sum(free.mean(axis=1) ** 2))
        every += float(np.sum(free**2))
    length, count = stack.shape[2], stack.shape[0] * stack.shape[1]
    within = (every - length * lines) / (count * (length - 1)) if length > 1 else 0.0
    if length * lines / count > (1 + _SIGMAS * np.sqrt(2 / count)) * within:
        warn(
            f"'{name}' has shape {stack.shape}, {len(stack)} frames of "
            f"{stack.shape[1]} x {length} pixels, and the noise of pixels is common along the last "
            "axis, which is the shortest: if it is that of the frames, give "
            "numpy.moveaxis(frames, -1, 0)",
            EquipixWarning,
        )


def temporal_of(stack: Array, mask: Bools | None = None) -> Temporal:
    """Mean, variance and steps of each pixel.

    Parameters
    ----------
    stack : ndarray, shape (n, rows, cols)
        Frames of any real dtype: one frame at a time is converted to float64.
    mask : ndarray of bool, shape (rows, cols), optional
        True = does not count in the frame means.

    Returns
    -------
    Temporal
        By Welford's recurrence, of frames less their means.
    """
    used = ~mask if mask is not None else np.ones(stack.shape[1:], bool)
    if stack.dtype.kind == "f":
        for frame in stack:
            used &= np.isfinite(frame)
    mean, squares, steps = (np.zeros(stack.shape[1:]) for _ in range(3))
    levels, before = np.zeros(len(stack)), mean
    with np.errstate(invalid="ignore"):
        for index, frame in enumerate(stack, start=1):
            free = frame.astype(np.float64)
            own = float(free[used].mean()) if used.any() else 0.0
            free -= own
            levels[index - 1] = own
            deviation = free - mean
            mean = mean + deviation / index
            squares += deviation * (free - mean)
            if index > 1:
                steps += (free - before) ** 2
            before = free
    variance, drift = squares / (len(stack) - 1), float(levels.std(ddof=1))
    return Temporal(mean + levels.mean(), variance, steps, used, len(stack), drift)


def warn_of_drift(found: Temporal) -> None:
    """Warn of frame means that differ by so much that they are hardly of one level."""
    noise = float(np.sqrt(np.median(found.variance[found.used]))) if found.used.any() else 0.0
    if found.drift > _MOST_DRIFT * noise:
        warn(
            f"the means of 'frames' scatter by {found.drift:.3g} DN, the noise of a pixel is "
            f"{noise:.3g} DN: frames of one steady level are expected. Give those of one level, or "
            "let the source settle; its gains make each pixel scatter with the light",
            DriftWarning,
        )


def moments(name: str, frames: ArrayLike | FrameStatistics) -> Moments:
    """Mean and noise of raw frames of which every pixel counts.

    Notes
    -----
    The mean of each frame is subtracted before its noise is taken, so a drift of the light does
    not count: for two frames the variance is ½⟨(y₀ − y₁)²⟩ − ½(μ₀ − μ₁)², ⟨⟩ over all pixels.
    Averages keep the variance of the means of their frames, which is subtracted: the same number.
    """
    if isinstance(frames, FrameStatistics):
        return _of_average(name, frames)
    stack = stack_of(name, frames)
    refuse_missing(name, stack)
    found = temporal_of(stack)
    return Moments(found.mean, float(found.variance.mean()), found.frames)


def refuse_missing(name: str, stack: Array) -> None:
    """Refuse frames with values that are not finite."""
    lost = sum(int(np.count_nonzero(~np.isfinite(frame))) for frame in stack)
    if lost:
        raise InputError(f"'{name}' holds {lost} values that are not finite, expected none")


def _of_average(name: str, frames: FrameStatistics) -> Moments:
    """Mean and noise of an average of as many samples everywhere."""
    refuse_subtracted(frames, f"'{name}'")
    count = int(frames.count.min())
    if count < 2 or int(frames.count.max()) != count:
        raise InputError(
            f"'{name}' has {count} to {frames.count.max()} samples a pixel, expected as many "
            "everywhere, two or more"
        )
    noise = float(frames.variance.mean()) - (frames.light_variance or 0.0)
    return Moments(frames.mean, noise, count)

"""Noise of a stack of frames: moments of each pixel over time."""

import math
from typing import NamedTuple

import numpy as np

from equipix._check import Array, ArrayLike, Bools, Floats, as_array
from equipix.errors import InputError
from equipix.findings import Finding, Rule, say
from equipix.io.frames import FrameFiles
from equipix.measured.part import blocks, chosen
from equipix.measured.statistics import FrameStatistics, refuse_subtracted

Frames = Array | FrameFiles
"""Frames in memory or in files."""

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


class Steadiness(NamedTuple):
    """Whether frames are of one level."""

    drift: float
    """Standard deviation of the frame means."""
    noise: float
    """Noise of one frame of half of the pixels."""


_OUTLYING = 0.1
"""Share of pixels whose changes are none of the pattern: cosmic rays, telegraph noise."""


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
    changes: Floats
    """Mean absolute difference of each two successive frames, of a part of many pixels, without the
    largest ones."""

    @property
    def steadiness(self) -> Steadiness:
        """Drift of the frame means, and the noise of half of the pixels, of a part of many."""
        part = self.variance.reshape(-1)[chosen(self.used)]
        return Steadiness(self.drift, float(np.sqrt(np.median(part))) if part.size else 0.0)


def signed_root(square: float) -> float:
    """Root of a variance estimate; of a negative one the negative root of its size."""
    return float(np.sign(square) * np.sqrt(abs(square)))


def stack_of(name: str, frames: ArrayLike | FrameFiles) -> Frames:
    """Return two or more frames of two pixels or more in their own dtype.

    Those of files stay there.

    Warns
    -----
    InputWarning
        If the last axis seems to be that of the frames.
    """
    stack = frames if isinstance(frames, FrameFiles) else as_array(name, frames, ndim=3)
    if len(stack) < 2 or math.prod(stack.shape[1:]) < 2:
        raise InputError(
            f"'{name}' has shape {stack.shape}, expected two or more frames of two or more pixels"
        )
    if stack.shape[2] < min(stack.shape[:2]):
        _warn_of_axes(name, stack)
    return stack


def _warn_of_axes(name: str, stack: Frames) -> None:
    """Warn if values along the last axis have in common what differs between frames.

    Of frames (rows, cols, n) this is the pattern: a row is taken for a frame, and its n values of a
    pixel for a line of pixels.
    """
    mean: Floats = np.zeros(stack.shape[1:])
    with np.errstate(invalid="ignore"):
        for frame in stack:
            mean += frame
    mean /= len(stack)
    lines, every = 0.0, 0.0
    for frame in stack:
        with np.errstate(invalid="ignore"):
            free = np.nan_to_num(frame - mean, posinf=0, neginf=0)
        lines += float(np.sum(free.mean(axis=1) ** 2))
        every += float(np.sum(free**2))
    length, count = stack.shape[2], stack.shape[0] * stack.shape[1]
    within = (every - length * lines) / (count * (length - 1)) if length > 1 else 0.0
    if length * lines / count > (1 + _SIGMAS * np.sqrt(2 / count)) * within:
        words = (
            f"'{name}' has shape {stack.shape}, {len(stack)} frames of "
            f"{stack.shape[1]} x {length} pixels, and the noise of pixels is common along the last "
            "axis, which is the shortest: if it is that of the frames, give "
            "numpy.moveaxis(frames, -1, 0)"
        )
        say(Finding("axis", words, "input"))


def used_in(stack: Frames, mask: Bools | None = None) -> Bools:
    """Pixels that are finite in all frames, and not masked."""
    used = ~mask if mask is not None else np.ones(stack.shape[1:], bool)
    if stack.dtype.kind == "f":
        for frame in stack:
            used &= np.isfinite(frame)
    return used


def temporal_of(stack: Frames, mask: Bools | None = None) -> Temporal:
    """Mean, variance and steps of each pixel.

    Parameters
    ----------
    stack : ndarray or FrameFiles, shape (n, rows, cols)
        Frames of any real dtype: a block of rows at a time is converted to float64.
    mask : ndarray of bool, shape (rows, cols), optional
        True = does not count in the frame means.

    Returns
    -------
    Temporal
        By Welford's recurrence, of frames less their means.
    """
    used = used_in(stack, mask)
    mean, squares, steps = (np.zeros(stack.shape[1:]) for _ in range(3))
    levels: list[float] = []
    changes: list[float] = []
    part = chosen(used)
    before: Array = np.zeros(0)
    for index, frame in enumerate(stack, start=1):
        levels.append(float(frame[used].astype(np.float64).mean()) if used.any() else 0.0)
        for rows in blocks(frame.shape):
            with np.errstate(invalid="ignore"):
                free = frame[rows].astype(np.float64) - levels[-1]
                deviation = free - mean[rows]
                mean[rows] += deviation / index
                squares[rows] += deviation * (free - mean[rows])
                if index > 1:
                    steps[rows] += (free - (before[rows].astype(np.float64) - levels[-2])) ** 2
        if index > 1 and part.size:
            change = frame.reshape(-1)[part].astype(np.float32)
            change -= before.reshape(-1)[part]
            change -= np.median(change)
            np.abs(change, out=change)
            kept = change.size - int(_OUTLYING * change.size)
            change.partition(kept - 1)
            changes.append(float(change[:kept].mean(dtype=np.float64)))
            del change
        before = frame
    squares /= len(levels) - 1
    mean += np.mean(levels)
    drift = float(np.std(levels, ddof=1))
    return Temporal(mean, squares, steps, used, len(levels), drift, np.array(changes))


def _on_drift(found: Steadiness) -> str | None:
    """Say that frame means differ by so much that they are hardly of one level."""
    if not found.drift > _MOST_DRIFT * found.noise:
        return None
    return (
        f"the means of 'frames' scatter by {found.drift:.3g} DN, the noise of a pixel is "
        f"{found.noise:.3g} DN: frames of one steady level are expected. Give those of one level, "
        "or let the source settle; its gains make each pixel scatter with the light"
    )


STEADY: tuple[Rule[Steadiness], ...] = (Rule("light", "misfit", _on_drift),)
"""What is asked of frames of one level."""


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


def refuse_missing(name: str, stack: Frames) -> None:
    """Refuse frames with values that are not finite."""
    refuse_lost(name, sum(int(np.count_nonzero(~np.isfinite(frame))) for frame in stack))


def refuse_lost(name: str, lost: int) -> None:
    """Refuse so many values that are not finite."""
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

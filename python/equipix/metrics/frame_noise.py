"""Noise of a stack of frames: moments, and its seven components."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from equipix._check import Array, ArrayLike, Bools, Floats, as_array, naming_memory
from equipix.errors import InputError
from equipix.findings import Finding, Rule, say
from equipix.measured.statistics import FrameStatistics, refuse_subtracted
from equipix.shown import Brief

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
    InputWarning
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
        words = (
            f"'{name}' has shape {stack.shape}, {len(stack)} frames of "
            f"{stack.shape[1]} x {length} pixels, and the noise of pixels is common along the last "
            "axis, which is the shortest: if it is that of the frames, give "
            "numpy.moveaxis(frames, -1, 0)"
        )
        say(Finding("axis", words, "input"))


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


def _on_drift(found: Temporal) -> str | None:
    """Say that frame means differ by so much that they are hardly of one level."""
    noise = float(np.sqrt(np.median(found.variance[found.used]))) if found.used.any() else 0.0
    if not found.drift > _MOST_DRIFT * noise:
        return None
    return (
        f"the means of 'frames' scatter by {found.drift:.3g} DN, the noise of a pixel is "
        f"{noise:.3g} DN: frames of one steady level are expected. Give those of one level, or "
        "let the source settle; its gains make each pixel scatter with the light"
    )


STEADY: tuple[Rule[Temporal], ...] = (Rule("light", "misfit", _on_drift),)
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


@dataclass(frozen=True)
class ThreeDNoise(Brief):
    """Variances of the seven components of noise, the result of `three_d_noise`.

    Each is an unbiased estimate, which may be negative; in the square of the frames' unit.

    Attributes
    ----------
    t : float
        Change of all pixels from frame to frame: flicker.
    v : float
        Differences of the rows that do not change with time: lines.
    h : float
        Differences of the columns that do not change: stripes.
    tv : float
        Differences of the rows that change from frame to frame: streaks.
    th : float
        Differences of the columns that change: rain.
    vh : float
        Differences of the pixels that do not change: the fixed pattern.
    tvh : float
        Noise of each pixel in each frame.
    """

    t: float
    v: float
    h: float
    tv: float
    th: float
    vh: float
    tvh: float

    @property
    def total(self) -> float:
        """Sum of all variances."""
        return self.t + self.v + self.h + self.tv + self.th + self.vh + self.tvh


@naming_memory("three-dimensional noise")
def three_d_noise(frames: ArrayLike) -> ThreeDNoise:
    r"""Noise of frames of an even scene by time (t), rows (v) and columns (h).

    Parameters
    ----------
    frames : array_like, shape (n, rows, cols)
        Frames of an even scene, corrected or not, all finite; two or more along each axis.

    Returns
    -------
    ThreeDNoise
        Seven variances.

    Raises
    ------
    InputError
        If an axis is shorter than two, or a value is not finite: replace bad pixels before.

    Notes
    -----
    The model is y = μ + N_t + N_v + N_h + N_tv + N_th + N_vh + N_tvh [1]_. The variances are those
    of the analysis of variance with random effects [2]_: mean squares, solved for their
    expectations. Without that step each variance contains part of those below it.

    References
    ----------
    .. [1] J. A. D'Agostino, C. M. Webb, "Three-dimensional analysis framework and measurement
       methodology for imaging system noise", Proc. SPIE 1488 (1991) 110-121.
    .. [2] D. P. Haefner, S. D. Burks, "Confidence intervals for 3-D noise", Optical Engineering 55
       (2016) 073108; H. Scheffé, "The analysis of variance", Wiley 1959, chapter 7.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import metrics
    >>> rng = np.random.default_rng(1)
    >>> frames = rng.standard_normal((20, 60, 80)) + 2 * rng.standard_normal((60, 80))
    >>> found = metrics.three_d_noise(frames)
    >>> round(found.tvh, 1), round(found.vh)
    (1.0, 4)
    """
    y = stack_of("frames", frames)
    if min(y.shape) < 2:
        raise InputError(f"'frames' has shape {y.shape}, expected two or more along each axis")
    refuse_missing("frames", y)
    sizes, squares = dict(zip("tvh", y.shape, strict=True)), _squares(y)
    repeats = {
        axes: math.prod(sizes[axis] for axis in "tvh" if axis not in axes) for axes in squares
    }
    found: dict[str, float] = {}
    for axes in sorted(squares, key=len, reverse=True):
        mean_square = squares[axes] * repeats[axes] / math.prod(sizes[axis] - 1 for axis in axes)
        above = sum(found[other] * repeats[other] for other in found if set(axes) < set(other))
        found[axes] = (mean_square - above) / repeats[axes]
    return ThreeDNoise(**found)


def _squares(y: Array) -> dict[str, float]:
    """Sum of the squared effects of each set of axes: means over the others, less the subsets'.

    Two passes over the frames: one for the means, one for what they leave.
    """
    count, rows, cols = y.shape
    whole = float(np.mean([frame.mean(dtype=np.float64) for frame in y]))
    of_rows, of_cols = np.empty((count, rows)), np.empty((count, cols))
    image: Floats = np.zeros((rows, cols))
    for index, frame in enumerate(y):
        free = frame.astype(np.float64) - whole
        image += free / count
        of_rows[index], of_cols[index] = free.mean(axis=1), free.mean(axis=0)
    t, v, h = of_rows.mean(axis=1), image.mean(axis=1), image.mean(axis=0)
    tv, th = of_rows - t[:, None] - v, of_cols - t[:, None] - h
    vh = image - v[:, None] - h
    rest = 0.0
    for index, frame in enumerate(y):
        lines = t[index] + v + tv[index]
        free = frame.astype(np.float64) - whole
        rest += float(np.sum((free - lines[:, None] - (h + th[index]) - vh) ** 2))
    effects = {"t": t, "v": v, "h": h, "tv": tv, "th": th, "vh": vh}
    return {axes: float(np.sum(effect**2)) for axes, effect in effects.items()} | {"tvh": rest}

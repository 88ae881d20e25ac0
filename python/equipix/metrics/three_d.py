"""Noise by time, rows and columns: the three-dimensional noise model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from equipix._check import naming_memory
from equipix.errors import InputError
from equipix.metrics.moments import refuse_missing, stack_of

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from equipix._types import Array, Floats


@dataclass(frozen=True)
class ThreeDNoise:
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
    sizes = np.array(y.shape)
    mean_squares = {}
    for axes, squares in _squares(y).items():
        degrees = np.prod([sizes[axis] - 1 for axis in axes])
        repeats = np.prod([sizes[axis] for axis in range(3) if axis not in axes])
        mean_squares[axes] = float(squares * repeats / degrees)
    found: dict[tuple[int, ...], float] = {}
    for axes in sorted(mean_squares, key=len, reverse=True):
        above = sum(
            variance * np.prod([sizes[axis] for axis in range(3) if axis not in other])
            for other, variance in found.items()
            if set(axes) < set(other)
        )
        repeats = np.prod([sizes[axis] for axis in range(3) if axis not in axes])
        found[axes] = float((mean_squares[axes] - above) / repeats)
    names = {"".join("tvh"[axis] for axis in axes): value for axes, value in found.items()}
    return ThreeDNoise(**names)


def _squares(y: Array) -> dict[tuple[int, ...], float]:
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
    effects = {(0,): t, (1,): v, (2,): h, (0, 1): tv, (0, 2): th, (1, 2): vh}
    return {axes: float(np.sum(effect**2)) for axes, effect in effects.items()} | {(0, 1, 2): rest}

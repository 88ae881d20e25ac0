"""Seven components of the noise of frames: by time, rows and columns."""

import math
from dataclasses import dataclass

import numpy as np

from equipix._check import ArrayLike, naming_memory
from equipix.errors import InputError
from equipix.metrics.frame_noise import refuse_missing, stack_of
from equipix.metrics.sums import Sums
from equipix.shown import Brief


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
    refuse_missing("frames", y)
    sums = Sums(np.ones(y.shape[1:], bool))
    for frame in y:
        sums.add(frame)
    return components(sums)


def components(sums: Sums) -> ThreeDNoise:
    """Seven variances from the sums over frames of which every pixel is used."""
    shape = (len(sums.levels), *sums.mean.shape)
    if min(shape) < 2:
        raise InputError(f"'frames' has shape {shape}, expected two or more along each axis")
    squares, sizes = _squares(sums), dict(zip("tvh", shape, strict=True))
    repeats = {
        axes: math.prod(sizes[axis] for axis in "tvh" if axis not in axes) for axes in squares
    }
    found: dict[str, float] = {}
    for axes in sorted(squares, key=len, reverse=True):
        mean_square = squares[axes] * repeats[axes] / math.prod(sizes[axis] - 1 for axis in axes)
        above = sum(found[other] * repeats[other] for other in found if set(axes) < set(other))
        found[axes] = (mean_square - above) / repeats[axes]
    return ThreeDNoise(**found)


def _squares(sums: Sums) -> dict[str, float]:
    """Sum of the squared effects of each set of axes: means over the others, less the subsets'.

    Over time the squares of pixels are those of all effects with t, each as often as it occurs, and
    those of the means of rows and of columns likewise.
    """
    (rows, cols), count = sums.mean.shape, len(sums.levels)
    t = count * float(np.var(sums.levels))
    tv = float(sums.rows.squares.sum()) - rows * t
    th = float(sums.cols.squares.sum()) - cols * t
    tvh = sums.squares - rows * cols * t - cols * tv - rows * th
    total, ((between_cols, _), (between_rows, _)) = sums.between_lines()
    v, h, vh = between_rows / cols, between_cols / rows, total - between_rows - between_cols
    return {"t": t, "v": v, "h": h, "tv": tv, "th": th, "vh": vh, "tvh": tvh}

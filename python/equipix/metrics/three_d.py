"""Noise by time, rows and columns: the three-dimensional noise model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import InputError
from equipix.metrics.moments import stack_of

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


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
    if min(y.shape) < 2 or not np.isfinite(y).all():
        lost = np.count_nonzero(~np.isfinite(y))
        raise InputError(
            f"'frames' has shape {y.shape} and {lost} values that are not finite, expected two or "
            "more along each axis, all finite"
        )
    sizes = np.array(y.shape)
    effects = _effects(y - y.mean())
    mean_squares = {}
    for axes, effect in effects.items():
        degrees = np.prod([sizes[axis] - 1 for axis in axes])
        repeats = np.prod([sizes[axis] for axis in range(3) if axis not in axes])
        mean_squares[axes] = float(np.sum(effect**2) * repeats / degrees)
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


def _effects(y: np.ndarray) -> dict[tuple[int, ...], np.ndarray]:
    """Means over the other axes of each set of axes, less those of its subsets."""
    sets = [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)]
    effects: dict[tuple[int, ...], np.ndarray] = {}
    for axes in sets:
        others = tuple(axis for axis in range(3) if axis not in axes)
        effect = y.mean(axis=others, keepdims=True) if others else y
        for smaller, value in effects.items():
            if set(smaller) < set(axes):
                effect = effect - value
        effects[axes] = effect
    return effects

"""How good a correction is: spatial over temporal noise, and for how long."""

from dataclasses import dataclass
from functools import cache
from statistics import NormalDist

import numpy as np

from equipix._check import ArrayLike, as_array, as_mask, naming_memory, number
from equipix.errors import InputError
from equipix.findings import Finding, Findings, ask, say
from equipix.metrics.frame_noise import STEADY, signed_root, stack_of, used_in
from equipix.metrics.sums import Sums
from equipix.shown import Brief


@dataclass(frozen=True)
class Correctability(Brief):
    """Spatial noise of corrected frames over their temporal noise, the result of `correctability`.

    Attributes
    ----------
    ratio : float
        C = σ_spatial/σ_temporal; negative where the estimate of the spatial variance is.
    low, high : float
        Ends of its confidence interval, with the same sign rule.
    spatial_variance : float
        Variance over the pixels, temporal noise removed: an unbiased estimate, which may be
        negative. In the square of the frames' unit.
    temporal_variance : float
        Variance of one frame, drift of the frame mean removed.
    pixels, frames : int
        Numbers that count.
    level : float
        Mean of the frames over these pixels.
    findings : tuple of Finding
        What limits the result, each also a warning.
    """

    ratio: float
    low: float
    high: float
    spatial_variance: float
    temporal_variance: float
    pixels: int
    frames: int
    level: float
    findings: tuple[Finding, ...] = ()


@naming_memory("correctability")
def correctability(
    frames: ArrayLike, *, mask: ArrayLike | None = None, confidence: float = 0.95
) -> Correctability:
    r"""Spatial over temporal noise of corrected frames of a uniform source.

    Parameters
    ----------
    frames : array_like, shape (n, rows, cols)
        Corrected frames of one level, two or more. Pixels with a value that is not finite do not
        count: frames corrected with ``flagged="nan"`` leave out bad pixels.
    mask : array_like of bool, shape (rows, cols), optional
        True = do not use.
    confidence : float
        Probability of the confidence interval, between 0 and 1.

    Returns
    -------
    Correctability
        C with its interval; C below 1 is the aim of a correction.

    Raises
    ------
    InputError
        If fewer than two frames or pixels are left, or none has noise.

    Warns
    -----
    MisfitWarning
        If frame means scatter by more than five times the noise of a pixel: they are then hardly
        frames of one level.

    Notes
    -----
    The mean of each frame over the pixels is subtracted, so drift of the source does not count.
    With N pixels and n frames, σ_t² the mean of the pixels' sample variances and s² the variance of
    the mean image over the pixels,

    .. math:: \sigma_s^2 = s^2 - \sigma_t^2 / n, \qquad C^2 = \sigma_s^2 / \sigma_t^2 .

    n s²/σ_t² is (1 + n C²) times a value of Fisher's distribution with f and (N − 1)(n − 1)
    degrees of freedom where the pattern is normally distributed, which gives the interval; its
    quantiles are Paulson's [2]_. Pixels of a column or a row may have a pattern in common, and few
    columns determine its variance less well than many pixels. So the sum S of squares of the mean
    image is divided into that between columns, between rows and the rest, and

    .. math:: f = S^2 / \sum_i S_i^2 / f_i

    with the degrees of freedom f_i of the parts (Satterthwaite [3]_): N − 1 where pixels are
    independent, the number of columns less one where columns alone differ. A pattern of larger
    areas, and few pixels far off, as bad ones are, make the interval too narrow. The ratio is that
    of [1]_.

    References
    ----------
    .. [1] "Correction of the non-uniformity of parameters of focal plane arrays", in a course on
       staring infrared systems (in Russian).
    .. [2] E. Paulson, "An approximate normalization of the analysis of variance distribution",
       Annals of Mathematical Statistics 13 (1942) 233-235.
    .. [3] F. E. Satterthwaite, "An approximate distribution of estimates of variance components",
       Biometrics Bulletin 2 (1946) 110-114.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import metrics
    >>> rng = np.random.default_rng(1)
    >>> frames = 0.5 * rng.standard_normal((60, 80)) + rng.standard_normal((16, 60, 80))
    >>> found = metrics.correctability(frames)
    >>> found.low < 0.5 < found.high
    True
    """
    stack = stack_of("frames", frames)
    sums = Sums(used_in(stack, as_mask(mask, stack.shape[1:])))
    for frame in stack:
        sums.add(frame)
    return judged(sums, confidence, say(*ask(STEADY, sums.steadiness)))


def judged(sums: Sums, confidence: float = 0.95, said: Findings = ()) -> Correctability:
    """Spatial over temporal noise from sums over frames; `said` are its findings."""
    if not 0 < number("confidence", confidence) < 1:
        raise InputError(f"'confidence' is {confidence!r}, expected a number between 0 and 1")
    n, pixels = len(sums.levels), sums.pixels
    if pixels < 2:
        raise InputError(f"'frames' has {pixels} pixels that are finite and not masked, expected 2")
    # A frame's own mean takes one of N degrees of freedom.
    temporal = sums.noise_squares / (n - 1) / (pixels - 1)
    if temporal <= 0:
        raise InputError("'frames' are all equal: they show no temporal noise")
    spatial = sums.spatial_variance() - temporal / n
    ratio = n * spatial / temporal + 1
    degrees = _freedom(sums), (pixels - 1) * (n - 1)
    tail = (1 - confidence) / 2
    low, high = (
        signed_root((ratio / fisher_quantile(p, *degrees) - 1) / n) for p in (1 - tail, tail)
    )
    figures = signed_root(spatial / temporal), low, high, spatial, temporal, pixels, n
    return Correctability(*figures, sums.centre, said)


def validity_interval(times: ArrayLike, ratios: ArrayLike) -> float:
    """Time at which C first exceeds 1, by linear interpolation.

    Parameters
    ----------
    times : array_like, shape (n,)
        Times since the calibration, rising, in any unit.
    ratios : array_like, shape (n,)
        C at these times, as `correctability` gives it; with and without flagged pixels give two
        intervals.

    Returns
    -------
    float
        In the unit of `times`: the first time if C is above 1 then, infinite if it never is.

    Raises
    ------
    InputError
        If the shapes differ, a value is not finite, or the times do not rise.

    Examples
    --------
    >>> from equipix import metrics
    >>> metrics.validity_interval([0, 10, 20], [0.2, 0.8, 1.2])
    15.0
    """
    when = as_array("times", times, ndim=1).astype(np.float64)
    values = as_array("ratios", ratios, ndim=1).astype(np.float64)
    if when.shape != values.shape or not len(when):
        raise InputError(f"'ratios' has {len(values)} values, expected {len(when)}, one a time")
    if not (np.isfinite(when).all() and np.isfinite(values).all() and (np.diff(when) > 0).all()):
        raise InputError("'times' and 'ratios' must be finite, and the times must rise")
    above = np.flatnonzero(values > 1)
    if not len(above):
        return float("inf")
    first = int(above[0])
    if first == 0:
        return float(when[0])
    share = (1 - values[first - 1]) / (values[first] - values[first - 1])
    return float(when[first - 1] + share * (when[first] - when[first - 1]))


def _freedom(sums: Sums) -> float:
    """Degrees of freedom f of the variance over pixels, as of `correctability`."""
    total, parts = sums.between_lines()
    left = sums.pixels - 1
    if total == 0:
        return float(left)
    rest = max(0.0, total - sum(square for square, _ in parts))
    parts.append((rest, left - sum(freedom for _, freedom in parts)))
    return total**2 / sum(square**2 / freedom for square, freedom in parts if freedom > 0)


def fisher_quantile(probability: float, first: float, second: float) -> float:
    """Quantile of F by Paulson's normal approximation, whose equation in F^(1/3) is quadratic."""
    z = NormalDist().inv_cdf(probability)
    a, b = 2 / (9 * first), 2 / (9 * second)
    # (1 − b)u − (1 − a) = z √(b u² + a)
    square, middle, rest = (1 - b) ** 2 - z**2 * b, (1 - a) * (1 - b), (1 - a) ** 2 - z**2 * a
    root = float(np.sqrt(max(0.0, middle**2 - square * rest)))
    return float(((middle + np.sign(z) * root) / square) ** 3)


@cache
def student_quantile(probability: float, freedom: int) -> float:
    """Quantile of Student's t above the median; of the normal distribution for a freedom of 0."""
    if not freedom:
        return NormalDist().inv_cdf(probability)
    # With t = √f tan θ the density of θ is cos^(f − 1) θ.
    angles = np.linspace(0, np.pi / 2, 10_001)
    density = np.cos(angles) ** (freedom - 1)
    area = np.concatenate([[0], np.cumsum(density[1:] + density[:-1])])
    angle = np.interp(2 * probability - 1, area / area[-1], angles)
    return float(np.sqrt(freedom) * np.tan(angle))

r"""Noise of frames: its model, what rounding leaves of it, robust scales, tails of χ².

Rounding: a value y = μ + σ n, n normal, is rounded to x, a multiple of q. Where μ is as likely
anywhere between two steps, the error x − y is uniform and does not correlate with n [1]_, so

.. math:: \langle (x - \mu)^2 \rangle = \sigma^2 + q^2/12 .

A part of it is the same in every frame of a pixel, since x has the mean μ + β(μ) with

.. math::
    \beta = \frac{q}{\pi} \sum_{k \ge 1} \frac{(-1)^k}{k} e^{-2\pi^2 k^2 v} \sin(2\pi k\mu/q),
    \qquad
    B = \langle \beta^2 \rangle
      = q^2 \sum_{k \ge 1} \frac{e^{-4\pi^2 k^2 v}}{2\pi^2 k^2} , \qquad v = \sigma^2/q^2 .

So frames scatter by s² = σ² + q²/12 − B, and the mean of n frames is off by s²/n + B.

References
----------
.. [1] B. Widrow, I. Kollár, "Quantization Noise", Cambridge University Press, 2008, chapters
   4 and 5.
"""

import dataclasses
import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np

from equipix._check import Array, ArrayLike, Bools, Floats, Ints, number, positive
from equipix.errors import InputError
from equipix.measured.part import blocks, chosen, known_part
from equipix.shown import Brief

MEDIAN_SQUARE = 0.4549
"""Median of the square of a standard normal variable."""

_BINS = 64
"""Most points of an exposure."""

_FEWEST = 16
"""Fewest pixels of a point, where an exposure has them."""

_FLOOR = 1e-6
"""Least variance of a model, as a fraction of the largest that it was fitted to."""

_FAR = 6.0
"""Distance from the median, in its median or in steps, beyond which a mean is no usual one."""

_ROUNDS = 100
"""Most rounds of weights."""

_STEADY = 1e-13
"""Relative change of the model at which weights are final."""

_LEAST_V = 1e-8
"""Least variance of noise, in squared steps, at which a slope is taken: at 0 it is infinite."""


@dataclass(frozen=True)
class NoiseModel(Brief):
    """Variance of a value as a function of its mean signal.

    Attributes
    ----------
    read_noise : float
        Standard deviation of a frame without light, quantisation included, in DN.
    gain : float
        Slope of the photon noise, in DN per electron.
    step : float
        Step between the whole numbers that frames are rounded to, in DN; 0 if they are not, or if
        their noise is far above it.
    frames : int
        Number of frames of which the value is the mean.
    dark_variance : float
        Variance of a dark that was subtracted from the mean, in DN².

    Notes
    -----
    At mean signal μ (in DN, dark subtracted) the variance of one frame is ``read_noise² + gain ·
    μ``: noise without light and photon noise. Rounding to whole DN adds its 1/12 DN² to the former;
    since no other number has a unit, frames in any unit give the same weights. Two parameters
    fitted over all pixels weight a pixel better than its own sample variance, whose scatter would
    enter the weights.

    A part B of the rounding is the same in all frames of a pixel: see `unaveraged`. So frames
    scatter by s² = read_noise² + gain · μ − B, and the mean of n frames has the variance s²/n + B.
    At a noise of half a step B is 3e-6 of a squared step, at none it is all of its 1/12.

    `signal` should be an expectation, not a noisy value: with a model evaluated on the values
    themselves those that are low by chance have larger weights, which at N electrons lowers a
    weighted mean by 1/N of itself, and raises χ² with five exposures by about 2/(3N). A value
    darkened by a grain of dust would have the largest weight of all. `equipix.calibrate` evaluates
    it on its own fit, whose residuals do not correlate with it.

    Examples
    --------
    >>> import equipix
    >>> float(equipix.NoiseModel(read_noise=2.0, gain=0.25).variance(1000.0))
    254.0
    """

    read_noise: float
    gain: float
    step: float = 0.0
    frames: int = 1
    dark_variance: float = 0.0

    def __post_init__(self) -> None:
        """Refuse parameters that give no variance."""
        for name in ("read_noise", "gain", "step", "dark_variance"):
            positive(name, getattr(self, name), zero=True)
        if not number("frames", self.frames) >= 1:
            raise InputError(f"'frames' is {self.frames!r}, expected 1 or more")
        if self.read_noise == self.gain == 0:
            raise InputError("'read_noise' and 'gain' are both 0, expected some noise")

    def variance(self, signal: ArrayLike) -> Array:
        """Variance of the value, in DN², at the mean `signal`, in DN."""
        variance = self.scatter(signal)
        variance /= self.frames  # in place: images are large
        variance += self.rounding(signal) + self.dark_variance
        return variance

    def scatter(self, signal: ArrayLike) -> Array:
        """Mean variance s² between frames, in DN²."""
        found = np.asarray(self._of_frame(signal))
        return found if self.step == 0 else np.asarray(found - self.rounding(signal))

    def rounding(self, signal: ArrayLike) -> Array:
        """Variance B of the rounding that frames do not average out, in DN²."""
        if self.step == 0:
            return np.zeros(())
        return self.step**2 * unaveraged(self._in_steps(signal))

    def rounding_apart(self, signal: float, means: Array, *, raw: bool = False) -> float:
        """Part of the rounding B that differs between pixels of one signal, with these means.

        Where the means are less than a step apart pixels have a part of it in common. If they are
        `raw`, no dark subtracted, they show where in a step they lie. Of many, 2¹⁹ are asked.
        """
        every = float(self.rounding(signal))
        if every == 0:
            return 0.0
        means = known_part(means)
        middle = float(np.nanmedian(means))
        off = (means - middle) / self.step
        near = off[np.abs(off) <= _FAR * max(1.0, float(np.nanmedian(np.abs(off))))]
        between = float(np.mean(near**2))
        if between > 1:
            return every
        of_noise = float(self.scatter(signal)) / self.frames / self.step**2
        v = float(self._in_steps(signal))
        if raw:
            place = middle / self.step + float(near.mean())
            return self.step**2 * unaveraged_at(v, place, float(near.var()) - of_noise)
        return self.step**2 * unaveraged_apart(v, between, of_noise)

    def largest_scatter(self, signal: ArrayLike) -> Array:
        """Variance between frames of a pixel half-way between two steps, in DN²."""
        if self.step == 0:
            return self._of_frame(signal)
        return self.step**2 * largest_scatter(self._in_steps(signal))

    def of_mean(self, frames: int, *, dark_variance: float = 0.0) -> Self:
        """Model of the mean of so many frames, minus a dark of that variance."""
        added = self.dark_variance / frames + dark_variance
        return dataclasses.replace(self, frames=frames * self.frames, dark_variance=added)

    def _of_frame(self, signal: ArrayLike) -> Array:
        """Variance of one frame."""
        return self.read_noise**2 + self.gain * np.maximum(signal, 0)

    def _in_steps(self, signal: ArrayLike) -> Array:
        """Variance of one frame before it is rounded, in squared steps."""
        return np.maximum(self._of_frame(signal) / self.step**2 - UNIFORM, 0)

    @classmethod
    def fit(cls, points: Array, *, gain: float | None = None, step: float = 0.0) -> Self:
        """Model that fits the photon-transfer curve best.

        Parameters
        ----------
        points : ndarray, shape (points, 3)
            Signal, variance and degrees of freedom, of the dark frames (signal 0) and of every
            exposure, as `photon_transfer` gives them.
        gain : float, optional
            The gain where it is known, in DN per electron.
        step : float
            Step between the values of frames, in DN; 0 if they are not rounded.

        Returns
        -------
        NoiseModel
            Least squares with the weights of the model itself: a variance s² of f degrees of
            freedom has variance 2s⁴/f. The gain is not below 0. The variance without light is not
            below that of the rounding, nor below a millionth of the largest variance.

        Raises
        ------
        InputError
            If no variance is above 0, of values that are not rounded.

        Notes
        -----
        Weights by the variances found, 1/s⁴, would let those win that are low by chance: of bins
        with f degrees of freedom the mean is low by 2/f, and all of it where a bin scatters by 0.
        Weights by the model start from equal ones and follow it until they are steady. They are
        those of half the mean variance of the darkest tenth of the points, or less. Where rounding
        is as large as the noise, s² depends on where in a step the means lie, which light of one
        level does not average out: half the square of that deviation is part of the variance of a
        point.
        """
        signal, variance, degrees = points.T
        least = max(_FLOOR * variance.max(), UNIFORM * step**2)
        if not least > 0:
            raise InputError("repeated frames are all equal, which gives no noise model")
        darkest = np.argsort(signal, kind="stable")[: -(-len(signal) // 10)]
        lowest = max(least, variance[darkest].mean() / 2)
        found = _bounded_line(signal, variance, degrees, least, gain)
        for _ in range(_ROUNDS):
            model = cls(read_noise=float(np.sqrt(found[0])), gain=found[1], step=step)
            former, linear = found, model._linearised(signal, variance, degrees, lowest)
            found = _bounded_line(signal, *linear, least, gain)
            if np.allclose(found, former, rtol=_STEADY, atol=0):
                break
        return cls(read_noise=float(np.sqrt(found[0])), gain=found[1], step=step)

    def _linearised(
        self, signal: Array, variance: Array, degrees: Array, lowest: float
    ) -> tuple[Array, Array]:
        """Variances of one frame that the scatter found stands for, near the model, and weights."""
        expected, slope = self.scatter(signal), np.ones(())
        phase = self.largest_scatter(signal) - expected
        if self.step > 0:
            slope = scatter_slope(np.maximum(self._in_steps(signal), _LEAST_V))
        error = 2 * np.maximum(expected, lowest) ** 2 / degrees + phase**2 / 2
        return self._of_frame(signal) + (variance - expected) / slope, slope**2 / error


def _bounded_line(
    signal: Array, variance: Array, weight: Array, least: float, gain: float | None
) -> tuple[float, float]:
    """Intercept, at least `least`, and slope, at least 0 unless given, of a weighted fit."""
    given = gain
    if gain is None:
        x = signal - np.average(signal, weights=weight)
        spread = np.sum(weight * x**2)
        gain = max(0.0, float(np.sum(weight * x * variance) / spread)) if spread > 0 else 0.0
    intercept = float(np.average(variance - gain * signal, weights=weight))
    if intercept < least:
        intercept = least
        # At its bound the other parameter is fitted again: else every variance is too large.
        energy = np.sum(weight * signal**2)
        if given is None and energy > 0:
            gain = max(0.0, float(np.sum(weight * signal * (variance - least)) / energy))
    return intercept, gain


def photon_transfer(
    signal: Array,
    variance: Array,
    usable: Array,
    frames: int,
    step: float = 0.0,
    common: Array | None = None,
    period: tuple[int, int] = (1, 1),
) -> Array:
    """Give the points of the photon-transfer curve that one exposure contributes.

    The usable pixels, of more than 2¹⁹ so many evenly over the sensor, are put in the order of the
    mean signal of their neighbours and cut into bins of equal numbers. A pixel whose variance is
    above `scatter_limit` is left out of its bin's mean.

    Parameters
    ----------
    signal, variance : ndarray, shape (rows, cols)
        Mean and sample variance of the frames, in DN and DN².
    usable : ndarray of bool, shape (rows, cols)
        Which pixels count.
    frames : int
        Number of frames averaged; fewer than two give no point.
    step : float
        Step between the values of frames, in DN; 0 if they are not rounded.
    common : ndarray, shape (rows, cols), optional
        Part of the variance that is no noise but that of the light, in DN².
    period : tuple of int
        Rows and columns after which a pattern of colour filters repeats: neighbours are those of
        one place in it.

    Returns
    -------
    ndarray, shape (points, 3)
        Mean signal, mean variance and degrees of freedom of each bin.

    Notes
    -----
    A pixel's own mean would not do for the order, since it correlates with its scatter: where two
    rounded frames have a whole mean, they are equal.

    The part C of the light leaves σ² of a variance σ² + C, with the scatter of more than σ² alone:
    degrees of freedom are fewer by the square of σ²/(σ² + C), the mean over the exposure.

    2¹⁹ pixels of n frames determine a common variance to √(2/(2¹⁹(n − 1))): 0.2 % of two frames,
    0.07 % of eight.
    """
    if frames < 2:
        return np.empty((0, 3))
    pixels = chosen(usable)
    order = np.argsort(_of_neighbours(signal, usable, pixels, period), kind="stable")
    signal, variance = (each.reshape(-1)[pixels] for each in (signal, variance))
    common = None if common is None else common.reshape(-1)[pixels]
    limit = scatter_limit(frames)
    points = []
    bins = min(_BINS, max(1, len(pixels) // _FEWEST))
    for chunk in np.array_split(order, bins):
        # A pixel half-way between two steps scatters by a quarter of a squared step.
        kept = inliers(variance[chunk], limit, least=step**2 / 4)
        if kept.any():
            bin_ = chunk[kept]
            mean = (signal[bin_].mean(), variance[bin_].mean())
            light = 0.0 if common is None else common[bin_].mean()
            points.append((*mean, light, len(bin_) * (frames - 1)))
    return _without_light(np.array(points).reshape(-1, 4))


def _without_light(points: Array) -> Array:
    """Points of signal, variance and degrees of freedom, of those with the part of the light."""
    signal, variance, light, degrees = points.T
    left = max(_FLOOR, 1 - light.sum() / variance.sum()) if light.any() else 1.0
    return np.stack([signal, variance - light, left**2 * degrees], axis=1)


def _of_neighbours(image: Array, usable: Bools, pixels: Ints, period: tuple[int, int]) -> Array:
    """Mean of the usable ones of the eight neighbours of some pixels; NaN where there is none.

    Neighbours are a period away; pixels are flat indices.
    """
    down, right = period
    lines = [_of_line(image, usable, pixels, down, step) for step in (-right, 0, right)]
    itself = usable.take(pixels)
    total, count = (sum(each) for each in zip(*lines, strict=True))
    total -= np.where(itself, image.take(pixels), 0.0)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / (count - itself))


def _of_line(
    image: Array, usable: Bools, pixels: Ints, down: int, right: int
) -> tuple[Array, Array]:
    """Sum and number of three usable pixels in a column: above, beside and below each pixel."""
    total, count = np.zeros((2, pixels.size))
    col = pixels % image.shape[1] + right
    in_row = (col >= 0) & (col < image.shape[1])
    for step in (-down, 0, down):
        at = pixels + (step * image.shape[1] + right)
        counted = in_row & (at >= 0) & (at < image.size)
        counted &= usable.take(at, mode="clip")
        total += np.where(counted, image.take(at, mode="clip"), 0.0)
        count += counted
    return total, count


def modelled_variances(
    models: Sequence[NoiseModel], expected: Iterable[Array], variances: Array
) -> None:
    """Write the variance of every value, shape (n, rows, cols), where its model expects `expected`.

    Where no signal is expected the least variance is a millionth of the largest, so that a model
    without read noise gives a number there.
    """
    for variance, model, signal in zip(variances, models, expected, strict=True):
        for rows in blocks(signal.shape):
            variance[rows] = model.variance(np.nan_to_num(signal[rows]))
        np.maximum(variance, _FLOOR * variance.max(), out=variance)


def scatter_limit(frames: int, *, sigmas: float = 6.0) -> float:
    """Largest ratio of a sample variance to the true one that its scatter explains.

    Notes
    -----
    The quantile of χ²/f at `sigmas` standard deviations of a normal variable, f = frames − 1, in
    the approximation of Wilson and Hilferty (1931): (1 − 2/(9f) + z·√(2/(9f)))³.
    """
    width = 2 / (9 * (frames - 1))
    return float((1 - width + sigmas * np.sqrt(width)) ** 3)


def inliers(values: Array, limit: float, *, least: float = 0.0) -> Array:
    """Which values are at most `limit` times the mean of those that are; found in a few rounds.

    They are compared with `least` where the mean is below it.
    """
    keep: Array = np.isfinite(values)
    for _ in range(5):
        if keep.any():
            keep &= values <= limit * max(least, values[keep].mean())
    return keep


UNIFORM = 1 / 12
"""Variance of a value that is uniform over one step."""

_SMALL = 0.02
"""Variance in squared steps below which series are taken of what is left by Poisson's formula."""

_FINE = 1.0
"""Variance in squared steps above which rounding averages out: B is below 1e-18 there."""

_TERMS = range(1, 8)
"""Numbers of the terms of a series: at `_SMALL` the eighth is below 1e-11."""

_GRID = 1001
"""Spreads between 0 and one step that are compared."""

_LEAST_APART = 0.1
"""Least part of B that counts as different between pixels."""

_PLACES = 256
"""Places in a step, and spreads between 0 and one step, that are compared."""

_LEAST_SEEN = 1e-4
"""Least variance of noise in squared steps that they resolve."""

_NEAR = 0.01
"""Distance of a mean in steps, and relative one of a variance, at which they agree."""

_FEWEST_VALUES = 8
"""Different values that must all be multiples of a step before it is one."""


def unaveraged(v: ArrayLike) -> Array:
    """Variance B of the rounding that a mean keeps, at noise of variance `v`, both in q².

    Notes
    -----
    Below v = 0.02 the series converges slowly, and Poisson's formula of its derivative in v,
    1 − Σ exp(−m²/4v)/√(4πv), leaves B = 1/12 + v − √(v/π) with an error below 3e-8.
    """
    v = np.asarray(v, np.float64)
    left, coarse = np.zeros(v.shape), ~(v > _FINE)  # of NaN it is NaN
    if coarse.any():
        v = v[coarse]
        few = np.maximum(v, _SMALL)
        total = sum(np.exp(-4 * np.pi**2 * k**2 * few) / (2 * np.pi**2 * k**2) for k in _TERMS)
        left[coarse] = np.where(v < _SMALL, UNIFORM + v - np.sqrt(v / np.pi), total)
    return left


def scatter(v: ArrayLike) -> Array:
    """Mean variance s² between frames at noise of variance `v`, both in q²."""
    v = np.asarray(v, np.float64)
    return np.asarray(v + UNIFORM - unaveraged(v))


def scatter_slope(v: ArrayLike) -> Array:
    """Derivative of `scatter`; infinite at 0."""
    v = np.asarray(v, np.float64)
    few = np.maximum(v, _SMALL)
    total = 1 + 2 * sum(np.exp(-4 * np.pi**2 * k**2 * few) for k in _TERMS)
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(v < _SMALL, 0.5 / np.sqrt(np.pi * v), total))


def largest_scatter(v: ArrayLike) -> Array:
    """Variance between frames of a pixel half-way between two steps, where it is largest, in q².

    Notes
    -----
    There the mean of x is μ, and ⟨(x − μ)²⟩ = v + 1/12 + Σ exp(−2π²k²v) (1/(π²k²) + 4v). Below
    v = 0.02 only two values occur: 1/4.
    """
    v = np.asarray(v, np.float64)
    largest, coarse = np.asarray(v + UNIFORM), ~(v > _FINE)
    if coarse.any():
        v = v[coarse]
        few = np.maximum(v, _SMALL)
        waves = sum(
            np.exp(-2 * np.pi**2 * k**2 * few) * (1 / (np.pi * k) ** 2 + 4 * few) for k in _TERMS
        )
        largest[coarse] = np.where(v < _SMALL, 0.25, few + UNIFORM + waves)
    return largest


def unaveraged_apart(v: float, between: float, of_noise: float) -> float:
    """Part of B that differs between pixels whose means are less than a step apart, in q².

    Parameters
    ----------
    v : float
        Variance of the noise of one frame.
    between : float
        Variance of the means between pixels.
    of_noise : float
        Part of it that is noise of the means.

    Returns
    -------
    float
        At least a tenth of B: means that are all equal do not show how far apart the light was.

    Notes
    -----
    Over pixels whose light is spread normally by w, β has the mean that it has at a noise of v + w.
    That part, B(v + w) on average, is common to them, and B(v) − B(v + w) is left. The means are
    spread by w + B(v) − B(v + w) and their noise, which gives w.
    """
    w = np.linspace(0, 1, _GRID) ** 2
    whole = float(unaveraged(v))
    left = whole - unaveraged(v + w)
    return max(_LEAST_APART * whole, float(np.interp(between - of_noise, w + left, left)))


def unaveraged_at(v: float, mean: float, between: float) -> float:
    """Variance between pixels of the rounding β of their means, at one place in a step, in q².

    Parameters
    ----------
    v : float
        Variance of the noise of one frame.
    mean, between : float
        Mean of the means, in steps, and their variance between pixels without their noise.

    Notes
    -----
    Of light μ that is spread normally by w about m, the mean of a periodic f(μ) is that of f, each
    wave k of it times exp(−2π²k²w). So m + ⟨β⟩ and w + 2w⟨β'⟩ + ⟨β²⟩ − ⟨β⟩², the mean and the
    variance of the means, follow for all m and w, and those that agree with what was found give
    ⟨β²⟩ − ⟨β⟩². On average over m that is `unaveraged_apart`.
    """
    k, m = np.arange(1, _PLACES // 2), np.arange(_PLACES) / _PLACES
    # Noise of a hundredth of a step leaves waves that the grid of places holds.
    waves = (-1.0) ** k / (np.pi * k) * np.exp(-2 * np.pi**2 * k**2 * max(v, _LEAST_SEEN))
    angle = 2 * np.pi * np.multiply.outer(k, m)
    beta, slope = waves @ np.sin(angle), (2 * np.pi * k * waves) @ np.cos(angle)
    w = np.linspace(0, 1, _PLACES + 1)[:, None] ** 2
    damped = np.exp(-2 * np.pi**2 * np.arange(_PLACES // 2 + 1) ** 2 * w)
    mean_of, slope_of, square_of = (
        np.fft.irfft(damped * np.fft.rfft(each)) for each in (beta, slope, beta**2)
    )
    apart = square_of - mean_of**2
    off = np.remainder(m + mean_of - mean + 0.5, 1) - 0.5
    wide = w + 2 * w * slope_of + apart - between
    misfit = (off**2 + (wide / max(abs(between), _NEAR)) ** 2) / _NEAR**2 / 2
    likely = np.exp(misfit.min() - misfit)
    return float(np.sum(likely * apart) / likely.sum())


def step_of(values: Array) -> float:
    """Step of which all values are multiples: 0 of values that are not whole, else 1 or more.

    Parameters
    ----------
    values : ndarray
        Values of frames, or their sums over frames.

    Returns
    -------
    float
        The greatest common divisor of the whole numbers; 1 of less than eight different ones,
        which may have one by chance.
    """
    known = values[np.isfinite(values)]
    whole = np.rint(known)
    rounding = 4 * np.finfo(np.float64).eps * np.abs(known) + 1e-9
    # Beyond some 5e14 a float64 does not tell whether it is whole.
    if not known.size or np.any((np.abs(known - whole) > rounding) | (rounding > 0.5)):
        return 0.0
    different = np.unique(whole)
    if len(different) < _FEWEST_VALUES:
        return 1.0
    return float(np.gcd.reduce(different.astype(np.int64)))


def chi2_tail(value: float, freedom: int) -> float:
    """Probability that χ² of so many degrees of freedom is above a value.

    Notes
    -----
    With y = value/2 it is e^{−y} Σ_{j<f/2} y^j/j! for even f; for odd f it is erfc(√y) +
    e^{−y} Σ_{j<(f−1)/2} y^{j+1/2}/Γ(j + 3/2).
    """
    half = max(value, 0.0) / 2
    if half == 0:
        return 1.0
    odd = freedom % 2
    tail = math.erfc(math.sqrt(half)) if odd else 0.0
    powers = (j + odd / 2 for j in range(freedom // 2))
    return tail + sum(math.exp(p * math.log(half) - half - math.lgamma(p + 1)) for p in powers)


ROBUST = 1.4826
"""Standard deviation over median absolute deviation, for normal noise."""


def nanmedian(values: Array, axis: int | tuple[int, ...]) -> Array:
    """Median of the values that are numbers; NaN where there is none."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN", RuntimeWarning)
        return np.asarray(np.nanmedian(values, axis=axis))


BLOCK = 16
"""Side of the blocks of pixels whose median or mean is what is usual there."""


def block_medians(image: Array, size: int = BLOCK) -> Array:
    """Medians of blocks; those at the far edges are filled up by mirrored pixels."""
    rows, cols = (
        np.pad(np.arange(each), (0, -each % size), mode="symmetric") for each in image.shape
    )
    dtype = image.dtype if image.dtype.kind == "f" else np.float64
    found = np.empty((len(rows) // size, len(cols) // size), dtype)
    for medians, band in zip(found, rows.reshape(-1, size), strict=True):
        lines = image[band] if len(cols) == image.shape[1] else image[band[:, None], cols]
        sorted_ = lines.reshape(size, -1, size).swapaxes(0, 1).reshape(len(medians), -1)
        sorted_.sort(axis=1)  # NaN come last
        count = sorted_.shape[1] - np.isnan(sorted_).sum(axis=1)
        middle = [(count - 1) // 2, np.minimum(count // 2, sorted_.shape[1] - 1)]
        low, high = (sorted_[np.arange(len(count)), each] for each in middle)
        np.divide(low + high, 2, out=medians)
    return found


def of_blocks(values: Array, shape: tuple[int, ...], size: int = BLOCK) -> Array:
    """Give each pixel of a sensor of that shape the value of its block."""
    return values.repeat(size, axis=0).repeat(size, axis=1)[: shape[0], : shape[1]]


def nanmedian_abs(residuals: Array) -> Floats:
    """Median absolute residual of each exposure, the first axis; 0 without any."""
    found = []
    for each in residuals:
        known = each[np.isfinite(each)]
        found.append(float(np.median(np.abs(known))) if known.size else 0.0)
    return np.array(found)


def median_of_noise(freedom: Array) -> Array:
    """Median of reduced χ² with so many degrees of freedom; NaN of none.

    That of Wilson and Hilferty, (1 − 2/9f)³, is 3 % too large for f = 1.
    """
    each, places = np.unique(freedom, return_inverse=True)
    medians = [_median_of_chi2(f) / f if f > 0 else np.nan for f in each.tolist()]
    return np.array(medians)[places].reshape(np.shape(freedom))


@cache
def _median_of_chi2(freedom: int) -> float:
    """Find the value that half of χ² is above, between 0 and the mean."""
    low, high = 0.0, float(freedom)
    while (middle := (low + high) / 2) not in (low, high):
        low, high = (middle, high) if chi2_tail(middle, freedom) > 0.5 else (low, middle)
    return middle

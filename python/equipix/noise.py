"""Noise of a pixel at a given signal: the source of the weights of a calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from equipix._check import number
from equipix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import ArrayLike, NDArray

MEDIAN_SQUARE = 0.4549
"""Median of the square of a standard normal variable."""

_BINS = 64

_FLOOR = 1e-6
"""Least variance of a model, as a fraction of the largest that it was fitted to."""


@dataclass(frozen=True)
class NoiseModel:
    """Variance of one frame as a function of its mean signal.

    Attributes
    ----------
    read_noise : float
        Standard deviation of a frame without light, quantisation included, in DN.
    gain : float
        Slope of the photon noise, in DN per electron.

    Notes
    -----
    At mean signal μ (in DN, dark subtracted) the variance is ``read_noise² + gain · μ``: noise
    without light and photon noise. Rounding to whole DN adds its 1/12 DN² to the former; since no
    other number has a unit, frames in any unit give the same weights. Two parameters fitted over
    all pixels weight a pixel better than its own sample variance, whose scatter would enter the
    weights.

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

    def __post_init__(self) -> None:
        """Refuse parameters that give no variance."""
        for name, value in (("read_noise", self.read_noise), ("gain", self.gain)):
            if not 0 <= number(name, value) < np.inf:
                raise InputError(f"'{name}' is {value!r}, expected a number not below 0")
        if self.read_noise == self.gain == 0:
            raise InputError("'read_noise' and 'gain' are both 0, expected some noise")

    def variance(self, signal: ArrayLike) -> NDArray[Any]:
        """Variance of one frame, in DN², at the mean `signal`, in DN."""
        return self.read_noise**2 + self.gain * np.maximum(signal, 0)

    def of_mean(self, frames: int, *, dark_variance: float = 0.0) -> Self:
        """Model of the mean of so many frames, minus a dark of that variance."""
        variance = self.read_noise**2 / frames + dark_variance
        return type(self)(read_noise=float(np.sqrt(variance)), gain=self.gain / frames)

    @classmethod
    def fit(cls, points: NDArray[Any], *, gain: float | None = None) -> Self:
        """Model that fits the photon-transfer curve best.

        Parameters
        ----------
        points : ndarray, shape (points, 3)
            Signal, variance and degrees of freedom, of the dark frames (signal 0) and of every
            exposure, as `photon_transfer` gives them.
        gain : float, optional
            The gain where it is known, in DN per electron.

        Returns
        -------
        NoiseModel
            Weighted least squares; a variance s² of f degrees of freedom has variance 2s⁴/f.
            The gain is not below 0, the variance without light not below a millionth of the
            largest variance.

        Raises
        ------
        InputError
            If no variance is above 0.
        """
        signal, variance, degrees = points.T
        floor = _FLOOR * variance.max()
        if not floor > 0:
            raise InputError(
                "repeated frames are all equal, which gives no noise model: give one of them"
            )
        weight = degrees / np.maximum(variance, floor) ** 2
        given = gain
        if gain is None:
            x = signal - np.average(signal, weights=weight)
            spread = np.sum(weight * x**2)
            gain = max(0.0, float(np.sum(weight * x * variance) / spread)) if spread > 0 else 0.0
        read_variance = np.average(variance - gain * signal, weights=weight)
        if read_variance < floor:
            read_variance = floor
            # At its bound the other parameter is fitted again: else every variance is too large.
            energy = np.sum(weight * signal**2)
            if given is None and energy > 0:
                gain = max(0.0, float(np.sum(weight * signal * (variance - floor)) / energy))
        return cls(read_noise=float(np.sqrt(read_variance)), gain=gain)


def photon_transfer(
    signal: NDArray[Any], variance: NDArray[Any], usable: NDArray[Any], frames: int
) -> NDArray[Any]:
    """Give the points of the photon-transfer curve that one exposure contributes.

    The usable pixels, in the order of their signal, are cut into bins of equal numbers. A pixel
    whose variance is above `scatter_limit` is left out of its bin's mean.

    Parameters
    ----------
    signal, variance : ndarray, shape (rows, cols)
        Mean and sample variance of the frames, in DN and DN².
    usable : ndarray of bool, shape (rows, cols)
        Which pixels count.
    frames : int
        Number of frames averaged; fewer than two give no point.

    Returns
    -------
    ndarray, shape (points, 3)
        Mean signal, mean variance and degrees of freedom of each bin.
    """
    if frames < 2:
        return np.empty((0, 3))
    pixels = np.flatnonzero(usable)
    pixels = pixels[np.argsort(signal.ravel()[pixels])]
    limit = scatter_limit(frames)
    points = []
    for chunk in np.array_split(pixels, min(_BINS, len(pixels)) or 1):
        kept = inliers(variance.ravel()[chunk], limit)
        if kept.any():
            bin_ = chunk[kept]
            mean = (signal.ravel()[bin_].mean(), variance.ravel()[bin_].mean())
            points.append((*mean, len(bin_) * (frames - 1)))
    return np.array(points).reshape(-1, 3)


def modelled_variances(
    models: Sequence[NoiseModel], expected: Iterable[NDArray[Any]], like: NDArray[Any]
) -> NDArray[Any]:
    """Variance of every value of `like`, shape (n, rows, cols), where its model expects `expected`.

    Where no signal is expected the least variance is a millionth of the largest, so that a model
    without read noise gives a number there.
    """
    variances = np.empty_like(like)
    for variance, model, signal in zip(variances, models, expected, strict=True):
        variance[:] = model.variance(np.nan_to_num(signal))
        np.maximum(variance, _FLOOR * variance.max(), out=variance)
    return variances


def scatter_limit(frames: int, *, sigmas: float = 6.0) -> float:
    """Largest ratio of a sample variance to the true one that its scatter explains.

    Notes
    -----
    The quantile of χ²/f at `sigmas` standard deviations of a normal variable, f = frames − 1, in
    the approximation of Wilson and Hilferty (1931): (1 − 2/(9f) + z·√(2/(9f)))³.
    """
    width = 2 / (9 * (frames - 1))
    return float((1 - width + sigmas * np.sqrt(width)) ** 3)


def inliers(values: NDArray[Any], limit: float) -> NDArray[Any]:
    """Which values are at most `limit` times the mean of those that are; found in a few rounds."""
    keep: NDArray[Any] = np.isfinite(values)
    for _ in range(5):
        if keep.any():
            keep &= values <= limit * values[keep].mean()
    return keep

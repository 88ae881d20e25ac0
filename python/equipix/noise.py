"""How noisy a pixel is at a given signal: the weights of a calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from equipix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from equipix.results import FrameStatistics

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
    """

    read_noise: float
    gain: float

    def variance(self, signal: ArrayLike) -> NDArray[Any]:
        """Variance of one frame, in DN², at the mean `signal`, in DN."""
        return self.read_noise**2 + self.gain * np.maximum(signal, 0)

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
                "repeated frames are all equal, which shows no scatter: give a single one of them"
            )
        weight = degrees / np.maximum(variance, floor) ** 2
        if gain is None:
            x = signal - np.average(signal, weights=weight)
            spread = np.sum(weight * x**2)
            gain = max(0.0, float(np.sum(weight * x * variance) / spread)) if spread > 0 else 0.0
        read_variance = max(floor, np.average(variance - gain * signal, weights=weight))
        return cls(read_noise=float(np.sqrt(read_variance)), gain=gain)


def photon_transfer(
    signal: NDArray[Any], variance: NDArray[Any], usable: NDArray[Any], frames: int
) -> NDArray[Any]:
    """Give the points of the photon-transfer curve that one exposure contributes.

    The usable pixels, in the order of their signal, are cut into bins of equal numbers. A pixel
    whose variance lies beyond chance (`scatter_limit`) stays out of its bin's mean.

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
        inliers = _inliers(variance.ravel()[chunk], limit)
        if inliers.any():
            bin_ = chunk[inliers]
            mean = (signal.ravel()[bin_].mean(), variance.ravel()[bin_].mean())
            points.append((*mean, len(bin_) * (frames - 1)))
    return np.array(points).reshape(-1, 3)


def smoothed_variances(frames: Sequence[FrameStatistics]) -> NDArray[Any]:
    """Variance of each mean by a noise model fitted over all pixels of all exposures.

    Parameters
    ----------
    frames : sequence of FrameStatistics
        The exposures, dark subtracted. What the dark adds to `variance_of_mean` is taken as the
        same in all pixels of an exposure: its median.

    Returns
    -------
    ndarray, shape (n, rows, cols), float64
        Variances in DN².

    Raises
    ------
    InputError
        If no exposure has two frames, so that nothing shows the scatter.
    """
    counts = [int(statistics.count.max()) for statistics in frames]
    points = [
        photon_transfer(statistics.mean, statistics.variance, statistics.saturated == 0, count)
        for statistics, count in zip(frames, counts, strict=True)
    ]
    if not any(map(len, points)):
        raise InputError(
            "'frames' are single frames, which show no scatter: give their 'variance', or the "
            "means alone for unit weights"
        )
    model = NoiseModel.fit(np.concatenate(points))
    variances = np.empty((len(frames), *frames[0].mean.shape))
    for variance, statistics, count in zip(variances, frames, counts, strict=True):
        added = statistics.variance_of_mean - statistics.variance / count
        dark = np.nanmedian(added) if count > 1 else 0.0
        variance[:] = model.variance(statistics.mean) / count + max(0.0, float(dark))
    return variances


def scatter_limit(frames: int, *, sigmas: float = 6.0) -> float:
    """Largest ratio of a sample variance to the true one that chance explains.

    Notes
    -----
    The quantile of χ²/f at `sigmas` standard deviations of a normal variable, f = frames − 1, in
    the approximation of Wilson and Hilferty (1931): (1 − 2/(9f) + z·√(2/(9f)))³.
    """
    width = 2 / (9 * (frames - 1))
    return float((1 - width + sigmas * np.sqrt(width)) ** 3)


def _inliers(values: NDArray[Any], limit: float) -> NDArray[Any]:
    """Which values are at most `limit` times the mean of those that are; found in a few rounds."""
    keep: NDArray[Any] = np.isfinite(values)
    for _ in range(5):
        if keep.any():
            keep &= values <= limit * values[keep].mean()
    return keep

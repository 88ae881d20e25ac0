"""Mean and variance of frames, in two passes over all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Average:
    """Statistics of each pixel, all of shape (rows, cols)."""

    mean: NDArray[Any]
    variance: NDArray[Any]
    variance_of_mean: NDArray[Any]
    count: NDArray[Any]
    saturated: NDArray[Any]


def average(
    frames: ArrayLike, *, dark: ArrayLike | None = None, saturation: float | None = None
) -> Average:
    """Mean and unbiased variance of each pixel over the finite samples.

    Parameters
    ----------
    frames : array, shape (n, rows, cols)
        Frames, in DN.
    dark : array, shape (rows, cols), optional
        Dark mean to subtract, in DN.
    saturation : float, optional
        Samples at or above it count as saturated; by default an integer dtype's largest value.

    Returns
    -------
    Average
        Mean (NaN of no samples), variance (NaN of fewer than two), and counts.
    """
    frames = np.asarray(frames)
    if saturation is None:
        saturation = np.iinfo(frames.dtype).max if frames.dtype.kind in "iu" else np.inf
    saturated = np.sum(frames >= saturation, axis=0)
    samples = frames.astype(np.float64)
    counts = np.isfinite(samples)
    n = counts.sum(axis=0)
    with np.errstate(invalid="ignore"):
        mean = np.where(counts, samples, 0).sum(axis=0) / np.where(n > 0, n, np.nan)
        scatter = (np.where(counts, samples - mean, 0) ** 2).sum(axis=0)
    variance = scatter / np.where(n > 1, n - 1, np.nan)
    offset = 0.0 if dark is None else np.asarray(dark, dtype=np.float64)
    return Average(mean - offset, variance, variance / n.clip(1), n, saturated)

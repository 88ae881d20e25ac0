"""Measures of maps of a sensor: rms, block means, relative error, tilt."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix import _native
from equipix._check import as_array
from equipix.colour import Colours, planes_of
from equipix.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from equipix._types import Bools, Floats

BLOCK = 16
"""Edge of the blocks, in pixels, whose means show errors at large scales."""


def rms(values: NDArray[Any]) -> float:
    """Root mean square of the values that are finite."""
    return float(np.sqrt(np.mean(np.square(values[np.isfinite(values)]))))


def rms_at_both_scales(error: NDArray[Any]) -> tuple[float, float]:
    """Root mean square over pixels, and of means over 16×16 pixels: NaN without a whole block."""
    return rms(error), rms(block_means(error)) if min(error.shape) >= BLOCK else np.nan


def relative_error(
    sensitivity: ArrayLike, truth: ArrayLike, *, cfa: ArrayLike | None = None
) -> Floats:
    """Relative error of a measured sensitivity, both in the gauge mean 1.

    Parameters
    ----------
    sensitivity : array_like, shape (rows, cols)
        The measured sensitivity; NaN where undetermined.
    truth : array_like, shape (rows, cols)
        The true one; NaN in pixels that are not to count.
    cfa : str or array_like of labels, optional
        Colour filters of the pixels, as for `equipix.calibrate`: means are then those of the
        pixel's colour.

    Returns
    -------
    ndarray, shape (rows, cols), float64
        (M − M₀)/M₀ after both are divided by their means over the pixels where both are
        finite; NaN elsewhere.

    Examples
    --------
    >>> from equipix import simulate
    >>> simulate.relative_error([[2.0, 2.0]], [[3.0, 3.0]])
    array([[0., 0.]])
    """
    measured = as_array("sensitivity", sensitivity, ndim=2)
    true = as_array("truth", truth, ndim=2)
    ratio = measured / true
    valid = np.isfinite(ratio)
    error = np.full(ratio.shape, np.nan)
    for plane in planes_of(Colours.of(cfa), ratio.shape):
        counted = valid & plane
        scale = np.mean(measured, where=counted) / np.mean(true, where=counted)
        error[counted] = ratio[counted] / scale - 1
    return error


def block_means(image: ArrayLike, size: int = BLOCK) -> Floats:
    """Average over square blocks: what is left of an error at large scales.

    Parameters
    ----------
    image : array_like, shape (rows, cols)
        The image; NaN pixels do not count.
    size : int
        Edge of a block in pixels.

    Returns
    -------
    ndarray, shape (rows // size, cols // size), float64
        The means of all whole blocks, counted from the first row and column; NaN for a block
        without a valid pixel.

    Raises
    ------
    InputError
        If the image holds no whole block.
    """
    pixels = as_array("image", image, ndim=2).astype(np.float64)
    rows, cols = pixels.shape[0] // size, pixels.shape[1] // size
    if rows == 0 or cols == 0:
        raise InputError(f"'image' has shape {pixels.shape}, smaller than one block of {size}")
    blocks = pixels[: rows * size, : cols * size].reshape(rows, size, cols, size)
    valid = np.isfinite(blocks)
    count = valid.sum(axis=(1, 3))
    total = np.sum(blocks, axis=(1, 3), where=valid)
    means: Floats = np.divide(total, count, where=count > 0, out=np.full((rows, cols), np.nan))
    return means


def slope_pixels(sensitivity: NDArray[Any], flags: NDArray[Any]) -> Bools:
    """Find the pixels that count for the slope of ln M.

    They are those of which M is determined, that are not flagged ``UNRELIABLE_FLAT``, and whose M
    is from half to twice the mean of such.

    Parameters
    ----------
    sensitivity : ndarray, shape (rows, cols)
        M; NaN where undetermined.
    flags : ndarray, shape (rows, cols), uint32
        Bits of `equipix.Flag`.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        Where a pixel counts.
    """
    return _native.slope_pixels(
        np.ascontiguousarray(sensitivity, np.float64), np.ascontiguousarray(flags, np.uint32)
    )


def tilt_weights(valid: NDArray[np.bool_]) -> Floats:
    """Weights whose sums with ln M are its least-squares slopes, edge to edge.

    Parameters
    ----------
    valid : ndarray of bool, shape (rows, cols)
        The pixels that count; at least three, not in one line.

    Returns
    -------
    ndarray, shape (2, rows, cols), float64
        For the slopes along rows and columns, each times the size of the sensor along it. NaN
        where the valid pixels determine no slope.
    """
    count = max(int(np.count_nonzero(valid)), 1)
    coordinates = np.indices(valid.shape) / np.reshape(valid.shape, (2, 1, 1))
    means = np.sum(coordinates, axis=(1, 2), where=valid) / count
    centred = np.where(valid, coordinates - means[:, None, None], 0)
    normal = np.einsum("arc,brc->ab", centred, centred)
    if np.linalg.matrix_rank(normal, tol=1e-12 * count) < 2:
        return np.full((2, *valid.shape), np.nan)
    return np.asarray(np.einsum("ab,brc->arc", np.linalg.inv(normal), centred))


def tilt(sensitivity: NDArray[Any], valid: NDArray[np.bool_]) -> Floats:
    """Least-squares slope of ln M over valid pixels, edge to edge, (row, col).

    Parameters
    ----------
    sensitivity : ndarray, shape (rows, cols)
        M.
    valid : ndarray of bool, shape (rows, cols)
        The pixels that count.

    Returns
    -------
    ndarray, shape (2,), float64
        How much ln M grows from one edge of the sensor to the other.
    """
    logarithm = np.log(sensitivity, where=valid, out=np.zeros(valid.shape))
    return np.asarray(np.einsum("arc,rc->a", tilt_weights(valid), logarithm))

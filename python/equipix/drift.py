"""Lamp drift: the tilt of ln M that leaves no residual, and the part of a trend that leaves one.

The one home of both, since the error budget, the search for patterns, the error bars and the
warnings must agree. Errors of ln c that are affine in the shifts d, a + s·d, leave no residual: the
beam takes a and one slope, and M the slope s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from equipix._types import Floats

_ON_A_LINE = 1e-12
"""Share of the variance of shifts along an axis, 1 − ρ², below which only rounding is left."""


def slope_std(shifts: NDArray[Any], flux_std: ArrayLike) -> Floats:
    r"""Standard deviation of the slope of ln M, per pixel, that errors of the fluxes leave.

    Parameters
    ----------
    shifts : ndarray, shape (..., n, 2)
        Shifts (row, col) in pixels, of one pattern or many.
    flux_std : array_like, shape () or (n,)
        Standard deviation of ln c of each exposure about the flux that is taken as known.

    Returns
    -------
    ndarray, shape (..., 2), float64
        Along rows and columns; infinite where the shifts do not determine the slope along an axis:
        nothing moves along it, or all shifts lie on one slanting line.

    Notes
    -----
    The slope is the least-squares one. With a the shifts along an axis less their mean, b those
    along the other, and a' = a − b (a·b)/(b·b),

    .. math:: \mathrm{Var}(s) = \sum_k a_k'^2 ε_k^2 \Big/ \Big(\sum_k a_k'^2\Big)^2,

    which are the diagonal elements of (DᵀD)⁻¹Dᵀ diag(ε²) D(DᵀD)⁻¹, D being both columns. Where all
    ε are equal it is (ε²/n)·Σ⁻¹ with Σ the covariance of the shifts: ε²/(n·var·(1 − ρ²)).
    """
    away = shifts - shifts.mean(axis=-2, keepdims=True)
    squares = np.sum(away**2, axis=-2)
    product = np.sum(away[..., 0] * away[..., 1], axis=-1)[..., None]
    others = squares[..., ::-1]
    share = np.divide(product, others, where=others > 0, out=np.zeros(squares.shape))
    rest = away - away[..., ::-1] * share[..., None, :]
    length = np.sum(rest**2, axis=-2)
    errors = np.broadcast_to(np.asarray(flux_std, np.float64), shifts.shape[-2:-1])
    spread = np.sqrt(np.sum((rest * errors[:, None]) ** 2, axis=-2))
    determined = length > _ON_A_LINE * squares
    found = np.divide(spread, length, where=determined, out=np.full(squares.shape, np.inf))
    return np.asarray(found)


def slope_covariance(shifts: NDArray[Any], flux_std: float, times: ArrayLike | None) -> Floats:
    """Covariance of the slope of ln M, per pixel, that independent errors of the fluxes leave.

    Parameters
    ----------
    shifts : ndarray, shape (n, 2)
        Shifts (row, col) in pixels; both columns and 1 must be linearly independent.
    flux_std : float
        Standard deviation of ln c of each exposure.
    times : array_like, shape (n,), or None
        When each exposure was taken, where a trend of ln c linear in time was fitted.

    Returns
    -------
    ndarray, shape (2, 2), float64
        Part of ε² (XᵀX)⁻¹ for the shifts, the columns of X being 1, the shifts, and the times.
    """
    columns = affine_columns(shifts, times)
    return np.asarray(flux_std**2 * np.linalg.inv(columns.T @ columns)[1:3, 1:3])


def affine_columns(shifts: NDArray[Any], times: ArrayLike | None) -> Floats:
    """Columns of ln c that leave no residual: 1, the shifts, and times if a trend is fitted."""
    columns = [np.ones(len(shifts)), *shifts.T]
    if times is not None:
        columns.append(unit_times(np.asarray(times, np.float64)))
    return np.stack(columns, axis=1)


def tilt_std(shape: tuple[int, int], shifts: NDArray[Any], flux_std: ArrayLike) -> Floats:
    """Standard deviation of the tilt of ln M, edge to edge, that errors of the fluxes leave.

    Parameters
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols).
    shifts : ndarray, shape (..., n, 2)
        Shifts (row, col) in pixels, of one pattern or many.
    flux_std : array_like, shape () or (n,)
        Standard deviation of ln c of each exposure.

    Returns
    -------
    ndarray, shape (..., 2), float64
        The slope's standard deviation times the size along each axis: for equal ε it is
        ε·N/(√n·std·√(1 − ρ²)). 0 along an axis of one pixel, and where no flux has an error.
    """
    if not np.any(flux_std):
        return np.zeros((*shifts.shape[:-2], 2))
    sizes = np.array(shape)
    slopes = slope_std(shifts, flux_std)
    return np.asarray(np.multiply(slopes, sizes, where=sizes > 1, out=np.zeros(slopes.shape)))


def tilt_rms(tilt: ArrayLike) -> Floats:
    """Root mean square over the sensor of tilts given edge to edge, (..., 2): both over √12."""
    along_rows, along_cols = np.moveaxis(np.asarray(tilt), -1, 0)
    return np.asarray(np.hypot(along_rows, along_cols) / np.sqrt(12))


def distinct_trend(shifts: NDArray[Any], times: NDArray[Any]) -> float:
    """Share of the variance of a trend linear in time that is distinguished from a tilt.

    Parameters
    ----------
    shifts : ndarray, shape (n, 2)
        Shifts (row, col) in pixels.
    times : ndarray, shape (n,)
        When each exposure was taken.

    Returns
    -------
    float
        1 − R² of the regression of the times on (1, d): 0 where a trend is degenerate with a tilt,
        1 where no part of it is, or all times are equal.
    """
    return float(1 - np.sum((unit_times(times) @ tilt_basis(shifts)) ** 2))


def tilt_basis(shifts: NDArray[Any]) -> Floats:
    """Orthonormal basis of what is linear in the shifts, their mean removed, (n, 0 to 2)."""
    axes, lengths, _ = np.linalg.svd(shifts - shifts.mean(axis=0), full_matrices=False)
    return np.asarray(axes[:, lengths > 1e-9 * max(lengths.max(initial=0), 1e-300)])


def unit_times(times: NDArray[Any]) -> Floats:
    """Times less their mean, of norm 1; 0 where all are equal."""
    centred = times - np.mean(times)
    return np.asarray(centred / max(float(np.linalg.norm(centred)), 1e-300))

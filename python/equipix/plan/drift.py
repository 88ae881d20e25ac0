"""Lamp drift: the tilt of ln M without a residual, and orders of exposures that show a trend.

Errors of ln c that are affine in the shifts d, a + s·d, leave no residual: the beam takes a and one
slope, and M the slope s.
"""

from itertools import permutations

import numpy as np

from equipix._check import (
    Array,
    ArrayLike,
    Floats,
    Ints,
    as_array,
    as_shifts,
    one_or_each,
    per_exposure,
)
from equipix.errors import InputError
from equipix.exposures.positions import Positions

_ON_A_LINE = 1e-12
"""Share of the variance of shifts along an axis, 1 − ρ², below which only rounding is left."""


def slope_std(shifts: Array, flux_std: ArrayLike) -> Floats:
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


def slope_covariance(
    shifts: Array, flux_std: float, times: ArrayLike | None, weights: Floats
) -> Floats:
    """Covariance of the slope of ln M, per pixel, that independent errors of the fluxes leave.

    Parameters
    ----------
    shifts : ndarray, shape (n, 2)
        Shifts (row, col) in pixels; both columns and 1 must be linearly independent.
    flux_std : float
        Standard deviation of ln c of each exposure.
    times : array_like, shape (n,), or None
        When each exposure was taken, where a trend of ln c linear in time was fitted.
    weights : ndarray, shape (n,)
        Weight of each exposure in the fit: a light one follows the slope that the others set.

    Returns
    -------
    ndarray, shape (2, 2), float64
        Part of ε² HHᵀ for the shifts, H = (XᵀWX)⁻¹XᵀW, the columns of X being 1, the shifts, and
        the times.
    """
    slopes = slopes_by_fluxes(affine_columns(shifts, times), weights)
    return np.asarray(flux_std**2 * slopes @ slopes.T)


def slopes_by_fluxes(columns: Floats, weights: Floats) -> Floats:
    """What multiplies errors of ln c, (n,), to the slope of ln M (row, col) that they leave."""
    roots = np.sqrt(weights / weights.max())
    return np.asarray(np.linalg.pinv(columns * roots[:, None])[1:3] * roots)


def affine_columns(shifts: Array, times: ArrayLike | None) -> Floats:
    """Columns of ln c that leave no residual: 1, the shifts, and times if a trend is fitted."""
    columns = [np.ones(len(shifts)), *shifts.T]
    if times is not None:
        columns.append(unit_times(np.asarray(times, np.float64)))
    return np.stack(columns, axis=1)


def undetermined_fluxes(positions: Positions, times: ArrayLike | None) -> Floats:
    """Columns of ln c that leave no residual; a factor alone where exposures are turned apart."""
    if positions.are_turned:
        return np.ones((len(positions), 1))
    return affine_columns(positions.shifts, times)


def tilt_of_fluxes(shape: tuple[int, int], shifts: Array, flux_std: ArrayLike) -> Floats:
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


def distinct_trend(shifts: ArrayLike, times: ArrayLike | None = None) -> float:
    """Share of the variance of a trend linear in time that is distinguished from a tilt.

    Parameters
    ----------
    shifts : array_like, shape (n, 2)
        Shifts (row, col) in pixels.
    times : array_like, shape (n,), optional
        When each exposure was taken; equally spaced unless given.

    Returns
    -------
    float
        1 − R² of the regression of the times on (1, d): 0 where a trend is degenerate with a tilt,
        1 where no part of it is, or all times are equal.
    """
    positions = as_shifts(shifts)
    when = np.arange(len(positions)) if times is None else np.asarray(times)
    return float(1 - np.sum((unit_times(when) @ tilt_basis(positions)) ** 2))


def tilt_basis(shifts: Array) -> Floats:
    """Orthonormal basis of what is linear in the shifts, their mean removed, (n, 0 to 2)."""
    axes, lengths, _ = np.linalg.svd(shifts - shifts.mean(axis=0), full_matrices=False)
    return np.asarray(axes[:, lengths > 1e-9 * max(lengths.max(initial=0), 1e-300)])


def unit_times(times: Array) -> Floats:
    """Times less their mean, of norm 1; 0 where all are equal."""
    centred = times - np.mean(times)
    return np.asarray(centred / max(float(np.linalg.norm(centred)), 1e-300))


def tilt_std(
    shape: tuple[int, int],
    shifts: ArrayLike,
    *,
    flux_std: ArrayLike | None = None,
    shift_std: ArrayLike | None = None,
    beam_slope: ArrayLike = (0.0, 0.0),
) -> Floats:
    r"""Standard deviation of the tilt that errors of fluxes and shifts cause.

    Parameters
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols).
    shifts : array_like, shape (n, 2)
        Shifts (row, col) in pixels, all exposures turned alike.
    flux_std : array_like, shape () or (n,), optional
        Relative standard deviation of the flux of each exposure.
    shift_std : array_like, shape () or (n, 2), optional
        Standard deviation of each shift, in pixels.
    beam_slope : array_like, shape (2,)
        Mean slope (row, col) of ln L over the sensor, per pixel: it converts an error of a shift to
        one of the flux.

    Returns
    -------
    ndarray, shape (2,), float64
        Standard deviation of the slope of ln M, edge to edge, (row, col); infinite along an axis
        that the shifts do not determine, 0 along one of a single pixel.

    Notes
    -----
    An error of ln c that is affine in the shifts, a + s·d, leaves no residual: it becomes the tilt
    s of ln M. Of independent errors ε_k that part is the least-squares one, with D the shifts less
    their mean

    .. math:: \mathrm{Cov}(s) = (D^T D)^{-1} D^T \mathrm{diag}(ε_k^2) D (D^T D)^{-1},

    which is (ε²/n) times the inverse covariance of the shifts where all ε are equal. An error δ of
    a shift counts as one of ln c by δ·∇ln L.

    Examples
    --------
    >>> from equipix import cross_pattern, plan
    >>> rows, cols = plan.tilt_std((582, 782), cross_pattern(11, 19), flux_std=1e-4)
    >>> print(f"{rows:.1e} {cols:.1e}")
    4.2e-03 5.6e-03
    """
    positions = as_array("shifts", shifts, ndim=2).astype(np.float64)
    count = len(positions)
    variance = np.zeros(count)
    if flux_std is not None:
        variance += np.square(one_or_each("flux_std", flux_std, (count,), ndim=(0, 1)))
    if shift_std is not None:
        slope = per_exposure("beam_slope", beam_slope, 2, default=0)
        errors = one_or_each("shift_std", shift_std, (count, 2), ndim=(0, 1, 2))
        variance += np.square(errors * slope).sum(axis=1)
    if np.linalg.matrix_rank(positions - positions.mean(axis=0)) < 2:
        return np.full(2, np.inf)
    return tilt_of_fluxes(shape, positions, np.sqrt(variance))


_ALL = 8
"""Up to so many exposures all orders are tried: 40 320."""

_STARTS = 64

_TIE = 12
"""Decimals beyond which shares of a trend differ by rounding only."""


def advise_order(shifts: ArrayLike) -> Ints:
    """Order of exposures in which a linear drift of the lamp is least degenerate with a tilt.

    Parameters
    ----------
    shifts : array_like, shape (n, 2)
        Shifts (row, col) in pixels.

    Returns
    -------
    ndarray, shape (n,), int64
        ``shifts[order]`` are the shifts in the order advised. Of up to 8 exposures it is the
        best, of more the best that exchanges of two lead to from 64 starts.

    Raises
    ------
    InputError
        If there is no shift, or one is not a finite number.

    Examples
    --------
    >>> from equipix import cross_pattern, plan
    >>> cross = cross_pattern(11, 19)
    >>> order = plan.advise_order(cross)
    >>> cross[order].tolist()
    [[0, 11], [19, 0], [0, 0], [0, 19], [11, 0]]
    """
    positions = as_shifts(shifts)
    count = len(positions)
    if count == 0:
        raise InputError("'shifts' is empty, expected one (row, col) an exposure")
    basis, times = tilt_basis(positions), unit_times(np.arange(count))
    if count <= _ALL:
        ranks = np.array(list(permutations(range(count))))
    else:
        rng = np.random.default_rng(0)
        ranks = _exchanged(np.arange(count), basis, times)[None]
        while _hidden_share(ranks, basis, times).min() > 0 and len(ranks) <= _STARTS:
            found = _exchanged(rng.permutation(count), basis, times)
            ranks = np.concatenate([ranks, found[None]])
    # Exposure k is taken as number ranks[k].
    best = _hidden_share(ranks, basis, times).argmin()
    return np.argsort(ranks[best]).astype(np.int64)


def _hidden_share(ranks: Ints, basis: Floats, times: Floats) -> Floats:
    """Share of a trend without a residual, in orders (m, n); differences by rounding count as 0."""
    return np.asarray(np.round(np.sum((times[ranks] @ basis) ** 2, axis=1), _TIE))


def _exchanged(ranks: Ints, basis: Floats, times: Floats) -> Ints:
    """Exchange the pair of exposures that reduces the share most, until none does."""
    first, second = np.triu_indices(len(ranks), 1)
    apart = basis[first] - basis[second]
    ranks, best = ranks.copy(), np.inf
    while True:
        # An exchange adds (t_second − t_first)·(b_first − b_second) to Σ t·b.
        gained = times[ranks[second]] - times[ranks[first]]
        hidden = np.sum((times[ranks] @ basis + gained[:, None] * apart) ** 2, axis=1)
        pair = hidden.argmin()
        if not (hidden[pair] < best * (1 - 1e-9) and best > 0.4 * 10.0**-_TIE):
            return ranks
        best, chosen = hidden[pair], [first[pair], second[pair]]
        ranks[chosen] = ranks[chosen[::-1]]

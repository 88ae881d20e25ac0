"""The order of exposures in which a steady lamp drift is least degenerate with a tilt."""

from __future__ import annotations

from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np

from equipix import drift
from equipix._check import as_shifts
from equipix.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

_ALL = 8
"""Up to so many exposures all orders are tried: 40 320."""
_STARTS = 64

_TIE = 12
"""Decimals beyond which shares of a trend differ by rounding only."""


def distinct_trend(shifts: ArrayLike) -> float:
    """Share of the variance of a linear trend of the lamp that is distinct from a tilt.

    Parameters
    ----------
    shifts : array_like, shape (n, 2)
        Shifts (row, col) in pixels, in the order of the exposures, equally spaced in time.

    Returns
    -------
    float
        From 0, where a trend is degenerate with a tilt of the sensitivity, to 1, where no part of
        it is. The tilt that it causes decreases with the square root of 1 − this share.

    Notes
    -----
    Only the part of ln c that is affine in d leaves no residual: the share is 1 − R² of the
    regression of the exposures' numbers on (1, d). With three exposures, not on one line, it is 0.

    Examples
    --------
    >>> from equipix import cross_pattern, plan
    >>> print(f"{plan.distinct_trend(cross_pattern(11, 19)):.3f}")
    0.035
    """
    positions = as_shifts(shifts)
    return drift.distinct_trend(positions, np.arange(len(positions)))


def advise_order(shifts: ArrayLike) -> NDArray[np.int64]:
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
    >>> print(f"{plan.distinct_trend(cross[order]):.3f}")
    0.996
    """
    positions = as_shifts(shifts)
    count = len(positions)
    if count == 0:
        raise InputError("'shifts' is empty, expected one (row, col) an exposure")
    basis, times = drift.tilt_basis(positions), drift.unit_times(np.arange(count))
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


def _hidden_share(
    ranks: NDArray[np.int64], basis: NDArray[np.float64], times: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Share of a trend without a residual, in orders (m, n); differences by rounding count as 0."""
    return np.asarray(np.round(np.sum((times[ranks] @ basis) ** 2, axis=1), _TIE))


def _exchanged(
    ranks: NDArray[np.int64], basis: NDArray[np.float64], times: NDArray[np.float64]
) -> NDArray[np.int64]:
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

"""Measurements that disagree with the fit: particles and reflections in one exposure only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.errors import InputError
from equipix.prediction import light, window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from equipix.prediction import Position

FEWEST = 3
"""Exposures without which nothing tells which of two measurements is wrong."""

_BEYOND = 5.0
"""Standard deviations that honest noise exceeds in one of two million measurements."""

_NEAR = 3.0
"""The same beside a measurement that is rejected: grains have soft edges."""

_LEADING = 0.7
"""Share of the largest deviation in the same pixel and cell that is suspect. One false value among
m spreads 1/(m − 1) of its own deviation over each of the others: at most a half from m = 3."""

_TESTABLE = 1e-6
"""Least share of its variance that a residual must keep: less is rounding."""

_ROBUST = 1.4826
"""Standard deviation over median absolute deviation, for normal noise."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """The measurements of a calibration and what became of them.

    Attributes
    ----------
    values : ndarray, shape (n, rows, cols)
        The measurements y.
    variances : ndarray of shape (n, rows, cols) or (n,), or None
        Their variances, of which only the ratios count.
    usable : ndarray of bool, shape (n, rows, cols)
        Which of them may be used.
    places : list of Position
        Where each exposure was taken.
    floor : float
        Relative deviation that the solver leaves: less is none.
    """

    values: NDArray[Any]
    variances: NDArray[Any] | None
    usable: NDArray[np.bool_]
    places: list[Position]
    floor: float


def check_count_for_rejection(count: int) -> None:
    """Refuse to look for the false one of two measurements."""
    if count < FEWEST:
        raise InputError(
            f"'robust' needs at least {FEWEST} exposures to tell which measurement is false, "
            f"got {count}"
        )


def rejected(
    evidence: Evidence,
    sensitivity: NDArray[Any],
    beam: NDArray[Any],
    before: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Find the measurements to leave out next.

    Parameters
    ----------
    evidence : Evidence
        The measurements.
    sensitivity : ndarray, shape (rows, cols)
        M, fitted without those that were left out.
    beam : ndarray, shape of the padded grid
        L likewise.
    before : ndarray of bool, shape (n, rows, cols)
        Which were left out.

    Returns
    -------
    ndarray of bool, shape (n, rows, cols)
        Which to leave out: when it is `before`, all is said.

    Notes
    -----
    A hard redescending weight, 1 or 0, in rounds. A false value pulls M and L, and so makes its
    own residual smaller and those that share its pixel or its cell larger. So in each round only
    what deviates most in its pixel and in its cell goes; the next fit shows what remains. What no
    longer deviates comes back, and so do those of a pixel that would be left without M.
    """
    new, old = deviations(evidence, sensitivity, beam, before)
    leading = np.where(before, 0, np.nan_to_num(new))
    by_pixel = leading.max(axis=0)
    by_cell = np.zeros(beam.shape, leading.dtype)
    shape = by_pixel.shape
    for each, place in zip(leading, evidence.places, strict=True):
        np.maximum(window(by_cell, place, shape), each, out=window(by_cell, place, shape))
    result = before & ~(old <= _NEAR)
    # A pixel that has lost its ties by mistake, while larger deviations hid the true ones, gets
    # its measurements back.
    result[:, np.isnan(sensitivity)] = False
    for k, place in enumerate(evidence.places):
        rival = _LEADING * np.maximum(by_pixel, window(by_cell, place, shape))
        suspect = (leading[k] > _NEAR) & (leading[k] >= rival)
        result[k] |= suspect & (leading[k] > _BEYOND)
        result[k] |= suspect & (_box(result[k]) > 0)
    return result


def deviations(
    evidence: Evidence,
    sensitivity: NDArray[Any],
    beam: NDArray[Any],
    left_out: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """How far each measurement, or the mean of the 3×3 pixels around it, is from the fit.

    Parameters
    ----------
    evidence : Evidence
        The measurements.
    sensitivity : ndarray, shape (rows, cols)
        Fitted M.
    beam : ndarray, shape of the padded grid
        Fitted L.
    left_out : ndarray of bool, shape (n, rows, cols)
        Which were left out of the fit.

    Returns
    -------
    new, old : ndarray, shape (n, rows, cols), float32
        The larger of both absolute deviations, in standard deviations; NaN where nothing tells.
        `new` is for what was not left out: the mean is over such only, and does not count beside
        one that is conspicuous by itself, whose pull on others would show in it. `old` is for
        what was left out: the mean is over both, each deviation cut off at five.

    Notes
    -----
    M takes the share h_M = w c²L² / Σ w c²L² (over the exposures of the pixel) of a measurement's
    noise out of its residual, L the share h_L = w c²M² / Σ w c²M² (over those that see the cell):
    its variance is near (1 − h_M)(1 − h_L) σ², which is exact where every exposure sees all, as
    in a two-way analysis of variance. That of one that was left out is (1 + h_M)(1 + h_L) σ². The
    scale of these is the residuals' own, in each exposure, from their median absolute value; so it
    matters little whether the variances given are right by a factor.
    """
    shape = evidence.values.shape[1:]
    response = np.nan_to_num(sensitivity).astype(np.float64)
    on_pixels, on_cells = np.zeros(shape), np.zeros(beam.shape)
    seen = [np.nan_to_num(light(beam, place, shape)) for place in evidence.places]
    weights = [_weights(evidence, k, seen[k] * response != 0) for k in range(len(seen))]
    for k, place in enumerate(evidence.places):
        weight = np.where(left_out[k], 0, weights[k])
        on_pixels += weight * seen[k] ** 2
        window(on_cells, place, shape)[:] += weight * (place.flux * response) ** 2
    new, old = (np.empty(evidence.values.shape, np.float32) for _ in range(2))
    for k, place in enumerate(evidence.places):
        shares = (
            _share(weights[k] * seen[k] ** 2, on_pixels),
            _share(weights[k] * (place.flux * response) ** 2, window(on_cells, place, shape)),
        )
        sign = np.where(left_out[k], 1, -1)
        spread = (1 + sign * shares[0]) * (1 + sign * shares[1])
        known = (weights[k] > 0) & (spread > _TESTABLE)  # NaN is not
        root = np.sqrt(weights[k])
        expected = seen[k] * response
        residual = np.full(shape, np.nan)
        residual[known] = (root * (evidence.values[k] - expected))[known] / np.sqrt(spread[known])
        used = known & ~left_out[k]
        floor = evidence.floor * _median(root * expected, known)
        residual /= max(_ROBUST * _median(residual, used), floor, np.finfo(float).tiny)
        own = np.abs(residual)
        quiet = _box(used & (own > _BEYOND)) == 0
        new[k] = np.fmax(own, np.where(known & quiet, np.abs(_around(residual, used)), np.nan))
        old[k] = np.fmax(own, np.abs(_around(np.clip(residual, -_BEYOND, _BEYOND), known)))
        new[k][~known] = old[k][~known] = np.nan
    return new, old


def _around(residual: NDArray[Any], where: NDArray[np.bool_]) -> NDArray[Any]:
    """Mean of the 3×3 residuals around each pixel, in standard deviations by their own scale."""
    mean = _box(np.where(where, residual, 0)) / np.sqrt(np.maximum(_box(where), 1))
    scaled: NDArray[Any] = mean / max(1.0, _ROBUST * _median(mean, where))
    return scaled


def _weights(evidence: Evidence, exposure: int, expected: NDArray[np.bool_]) -> NDArray[Any]:
    """Weights 1/σ² of an exposure; 0 where nothing is measured or no light expected."""
    variance = 1.0 if evidence.variances is None else evidence.variances[exposure]
    weights: NDArray[Any] = np.divide(
        1.0, variance, where=evidence.usable[exposure] & expected, out=np.zeros(expected.shape)
    )
    return weights


def _share(own: NDArray[Any], total: NDArray[Any]) -> NDArray[Any]:
    """Share that a weight has in a sum; NaN where the sum is 0."""
    share: NDArray[Any] = np.divide(own, total, where=total > 0, out=np.full(own.shape, np.nan))
    return share


def _median(values: NDArray[Any], where: NDArray[np.bool_]) -> float:
    chosen = np.abs(values[where])
    return float(np.median(chosen)) if chosen.size else 0.0


def _box(image: NDArray[Any]) -> NDArray[Any]:
    """Sum of the 3×3 pixels around each, those beyond the border counting 0."""
    padded = np.pad(image.astype(np.float32), 1)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    total: NDArray[Any] = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    return total

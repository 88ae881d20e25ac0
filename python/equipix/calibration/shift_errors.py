"""What errors of shifts leave that have a standard deviation but were not refined.

An error δ of a shift changes a measurement by δ·∇L, and so the flux of its exposure by δ times the
mean slope of ln L.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix.calibration.significance import chi2_tail
from equipix.exposures.positions import in_beam

if TYPE_CHECKING:
    from equipix._types import Array, Floats
    from equipix.calibration.residuals import Residuals
    from equipix.calibration.weights import Weighted

_ON_A_LINE = 1e-9
"""Shifts refined along one direction moved less than this across it, relative to it."""

_RARE = 1e-3
"""Probability of errors so large below which their standard deviations do not explain them."""


class Unrefined(NamedTuple):
    """Directions in the beam along which shifts stayed as given.

    `slopes` (directions, n, bands, rows, cols) are M/σ · ∂(c L) along each, `std` (directions, n)
    the standard deviations of the shifts.
    """

    slopes: Floats
    std: Floats


def unrefined(weighted: Weighted, residuals: Residuals) -> Unrefined | None:
    """Find the slopes and standard deviations of shifts that the fit left as given.

    None where shifts count as exact, or were refined along both axes.
    """
    positions, fit = weighted.exposures.positions, weighted.fit
    if positions.std is None:
        return None
    directions = np.eye(2)
    if fit.refinement == "refined":
        _, lengths, directions = np.linalg.svd(np.array(fit.shifts) - positions.shifts)
        if not lengths[1] <= _ON_A_LINE * lengths[0]:
            return None
        directions = directions[1:]
    axes = [_axes(turn) for turn in positions.rotation.tolist()]
    slopes = np.einsum("da,nab,bnkrc->dnkrc", directions, axes, residuals.slopes)
    return Unrefined(slopes, np.sqrt(directions**2 @ np.square(positions.std).T))


def flux_variance(weighted: Weighted, residuals: Residuals) -> Floats:
    """Variance of ln c of each exposure by shifts that were not refined, shape (n,)."""
    found = unrefined(weighted, residuals)
    if found is None:
        return np.zeros(len(residuals.values))
    signal = np.where(np.isfinite(residuals.values), residuals.signal, 0)
    sums = np.einsum("dnkrc,nkrc->dn", np.where(signal == 0, 0, found.slopes), signal)
    power = np.einsum("nkrc,nkrc->n", signal, signal)
    means = np.divide(sums, power, where=power > 0, out=np.zeros_like(sums))
    return np.asarray(np.sum((means * found.std) ** 2, axis=0))


def without_shift_errors(weighted: Weighted, residuals: Residuals) -> Residuals:
    """Residuals without what the stated errors of unrefined shifts explain.

    The errors are those of least squares with their prior. Where they are larger than it allows,
    residuals are as they were.
    """
    found = unrefined(weighted, residuals)
    if found is None:
        return residuals
    values, total, freedom = residuals.values.copy(), 0.0, -len(found.std)
    for k, (each, std) in enumerate(zip(values, found.std.T, strict=True)):
        known, used = np.isfinite(each), std > 0
        slopes = found.slopes[used, k][:, known]
        errors, squares = _with_prior(slopes, each[known], std[used], residuals.scale)
        each[known] -= errors @ slopes
        total, freedom = total + squares, freedom + int(used.sum())
    if freedom < 1 or chi2_tail(total, freedom) < _RARE:
        return residuals
    return dataclasses.replace(residuals, values=values)


def _with_prior(slopes: Floats, values: Floats, std: Floats, scale: float) -> tuple[Floats, float]:
    """Errors of a shift, and their squares over those expected of prior and noise.

    With A = SᵀS/σ² and Λ = diag(1/std²) they are (A + Λ)⁻¹ Sᵀr/σ². The least-squares errors have
    the covariance A⁻¹ + Λ⁻¹, so that the squares are rᵀS (A + AΛ⁻¹A)⁻¹ Sᵀr/σ⁴.
    """
    normal = slopes @ slopes.T / scale
    product = slopes @ values / scale
    errors = np.linalg.solve(normal + np.diag(std**-2), product)
    spread = normal + normal @ np.diag(std**2) @ normal
    squares = product @ np.linalg.pinv(spread, hermitian=True) @ product
    return np.asarray(errors), float(squares)


def _axes(turn: int) -> Array:
    """Return A: a step along the sensor's axes in the beam."""
    return np.stack(
        [in_beam(p, turn, (1, 1)) - in_beam((0, 0), turn, (1, 1)) for p in np.eye(2)], 1
    )

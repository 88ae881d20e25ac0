"""The fast method: Gauss-Newton steps in M by conjugate gradients on two scales.

With L at its closed form for M, F depends on M alone. A step x of M changes F by −2·bᵀx + xᵀS·x, to
second order in x and first in the residuals, with the slope and the reduced operator

    b(p) = Σ_k w·c·L(u)·(y − c·L(u)·M(p)),
    S·x (p) = Σ_k w·c²·L(u)²·(x(p) − M(p)·h(u)),    h(u) = Σ w·c²·M·x / Σ w·c²·M²,

the sums in h over the measurements that see cell u. In g = x/M, S is the Laplacian of a graph:
xᵀS·x is a sum over the cells of the variance of g around the mean of the measurements that meet
there. It is 0 for x = M in each component, to which b is orthogonal. The step solves S·x = b.

Neighbouring pixels settle by the diagonal D(p) = Σ_k w·c²·L² of S; errors as wide as the sensor
would take (sensor/shift) steps. So the preconditioner adds a solution for wide errors alone, on
hats some shifts apart [1]_: docs/method.md is a course on it.

.. [1] W. L. Briggs, V. E. Henson, S. F. McCormick, A Multigrid Tutorial, 2nd ed., SIAM 2000.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.reference.descent import Solution, best_beam, best_sensitivity, gauged
from equipix.reference.model import Problem, exposures, objective, problem

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

SPACING = 3
"""Distance of the hats, in extents of the shifts."""
LEAST_SPACING = 8
"""The same in pixels, where shifts are small."""
DAMPING = 0.25
"""Factor of the solution on hats: errors that the diagonal sees as well would count twice."""
LEAST_WEIGHT = 1e-6
"""Share of the mean weight D below which a pixel leaves the system."""
LEAST_PRODUCTS = 10
"""Before so many products the smallest Ritz value is too large for a verdict."""
INNER_SHARE = 0.8
"""Share of the tolerance at which conjugate gradients stop."""
SINGULAR = 1e-10
"""Eigenvalues of the coarse matrix that are this small beside the diagonal's count as 0."""
ROUNDING = 1e-14
"""Corrections this small, relative to the mean of M, are nothing but rounding."""


@dataclass(frozen=True)
class MultiscaleSolution(Solution):
    """What `multiscale` found, and how well.

    Attributes
    ----------
    products : int
        Products with the data or their weights: those of the conjugate gradients, and one for
        each M at which L and the slope were worked out.
    error_estimate : float
        Estimate of the largest error of the sensitivity, in units of its mean.
    converged : bool
        Whether the estimate is within the tolerance.
    unreliable : ndarray of bool, shape (rows, cols)
        Pixels measured with so little weight that they had no say.
    """

    products: int
    error_estimate: float
    converged: bool
    unreliable: NDArray[Any]


@dataclass(frozen=True)
class _State:
    """Where the method stands: M, the closed form of L, F and what the next step needs."""

    data: Problem
    sensitivity: NDArray[Any]
    beam: NDArray[Any]
    objective: float
    slope: NDArray[Any]
    diagonal: NDArray[Any]
    weak: NDArray[Any]

    def size(self, change: NDArray[Any]) -> float:
        """Largest value of a change of M, in units of the mean of M."""
        mean = self.sensitivity[~self.weak].mean()
        return float(np.abs(change[~self.weak]).max() / mean)

    def product(self, x: NDArray[Any]) -> NDArray[Any]:
        """S·x; a pixel that left the system counts as M = 0."""
        weights = self.data.weights * self.data.flux[:, None, None] ** 2
        inner = np.where(self.weak, 0, self.sensitivity)
        mass = _over_cells(self.data, weights * inner**2)
        h = _ratio(_over_cells(self.data, weights * inner * x), mass)[self.data.cells]
        lit = weights * self.beam.flat[self.data.cells] ** 2
        return np.asarray((lit * (x - inner * h)).sum(axis=0))


@dataclass(frozen=True)
class _Step:
    """What conjugate gradients found; exhausted: down to rounding."""

    change: NDArray[Any]
    theta: float
    products: int
    exhausted: bool


def multiscale(
    frames: ArrayLike,
    shifts: ArrayLike,
    *,
    variance: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    flux: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    tolerance: float = 1e-6,
    products: int = 1000,
) -> MultiscaleSolution:
    """Minimise F until the estimated error of M is within a tolerance, from M = 1.

    Parameters
    ----------
    frames : array_like, shape (n, rows, cols)
        Exposures, dark subtracted; NaN counts as masked.
    shifts : array_like of int, shape (n, 2)
        Shifts (row, col) in whole pixels.
    variance : array_like, optional
        Variance of the values, like `frames` or (n,); 1 unless given.
    mask : array_like of bool, optional
        True = do not use; (rows, cols) or (n, rows, cols).
    flux : array_like, shape (n,), optional
        Relative power of the lamp in each exposure; 1 unless given.
    rotation : array_like, shape (n,), optional
        Rotations of the sensor in degrees, multiples of 90; 0 unless given.
    tolerance : float
        Largest error of M to be left, relative to its mean.
    products : int
        Largest number of products; only steps that must be halved go beyond it.

    Returns
    -------
    MultiscaleSolution
        Sensitivity, beam, the objective at the start and after each step, and the estimate.

    Notes
    -----
    The error is estimated as max|P⁻¹b|/θ, with P the preconditioner, b the slope at the final M
    and θ the smallest Ritz value of P⁻¹S that conjugate gradients came upon: P⁻¹b is the step
    that an operator equal to P would ask for, and no error is larger than 1/θ of it in the norm
    of P. In the largest norm that is no bound, but holds to within a small factor.
    """
    data = problem(frames, shifts, variance=variance, mask=mask, flux=flux, rotation=rotation)
    shape = data.values.shape[1:]
    hats = _hats(shape, np.ptp(np.asarray(shifts), axis=0))
    state = _state(data, np.ones(shape))
    history = [state.objective]
    # What the hats alone see has the eigenvalue DAMPING.
    used, inner, theta, exhausted = 1, 0, DAMPING, False
    while True:
        precondition = _two_levels(state, hats)
        estimate = state.size(precondition(state.slope)) / theta
        converged = estimate <= tolerance and (inner >= LEAST_PRODUCTS or exhausted)
        if converged or used + 2 > products:
            break
        step = _conjugate_gradients(
            state,
            precondition,
            theta=theta,
            target=INNER_SHARE * tolerance,
            least=LEAST_PRODUCTS - inner,
            most=products - used - 1,
        )
        theta, exhausted = step.theta, step.exhausted
        state, tried = _take(state, step.change)
        inner += step.products
        used += step.products + tried
        history.append(state.objective)
    unreliable = state.weak & (data.weights > 0).any(axis=0)
    solution = gauged(data, state.sensitivity, best_beam(data, state.sensitivity), history)
    return MultiscaleSolution(
        **vars(solution),
        products=used,
        error_estimate=estimate,
        converged=converged,
        unreliable=unreliable,
    )


def _state(data: Problem, sensitivity: NDArray[Any]) -> _State:
    """Give L its closed form, and M too where D is next to nothing."""
    beam = np.nan_to_num(best_beam(data, sensitivity))
    diagonal = _diagonal(data, beam)
    weak = diagonal < LEAST_WEIGHT * diagonal[diagonal > 0].mean()
    if (weak & (diagonal > 0)).any():
        closed = best_sensitivity(data, beam)
        sensitivity = np.where(weak & (diagonal > 0), closed, sensitivity)
        beam = np.nan_to_num(best_beam(data, sensitivity))
        diagonal = _diagonal(data, beam)
    residual = data.values - exposures(sensitivity, beam, data.flux, data.cells)
    scale = data.weights * data.flux[:, None, None]
    slope = (scale * beam.flat[data.cells] * residual).sum(axis=0)
    return _State(
        data=data,
        sensitivity=sensitivity,
        beam=beam,
        objective=objective(data, sensitivity, beam),
        slope=np.where(weak, 0, slope),
        diagonal=diagonal,
        weak=weak,
    )


def _diagonal(data: Problem, beam: NDArray[Any]) -> NDArray[Any]:
    """D(p) = Σ_k w·c²·L²."""
    scale = data.weights * data.flux[:, None, None] ** 2
    return np.asarray((scale * beam.flat[data.cells] ** 2).sum(axis=0))


def _take(state: _State, change: NDArray[Any]) -> tuple[_State, int]:
    """Take a step, or the half, the quarter, … of it: F may not rise; and how many were tried.

    The residuals are known to rounding of the values only: F may rise by what that makes of it.
    """
    data = state.data
    rounding = ROUNDING * np.sqrt(np.sum(data.weights * data.values**2))
    allowed = (np.sqrt(state.objective) + rounding) ** 2
    for tried in range(1, 60):
        new = _state(data, state.sensitivity + change)
        if new.objective <= allowed:
            return new, tried
        change = change / 2
    return state, tried


def _conjugate_gradients(
    state: _State,
    precondition: Callable[[NDArray[Any]], NDArray[Any]],
    *,
    theta: float,
    target: float,
    least: int,
    most: int,
) -> _Step:
    """Solve S·x = b as far as is worth while, and lower θ to the smallest Ritz value.

    No further than what linearising loses, the square of the step, or than the target; but for the
    target's sake not before the `least` products, which a smallest Ritz value takes to show.
    """
    x = np.zeros_like(state.slope)
    residual = state.slope
    z = precondition(residual)
    direction = z
    product = np.vdot(residual, z)
    lengths: list[float] = []
    updates: list[float] = []
    while state.size(z) > ROUNDING and len(lengths) < most:
        image = state.product(direction)
        curvature = np.vdot(direction, image)
        if curvature <= 0:
            break
        lengths.append(product / curvature)
        x = x + lengths[-1] * direction
        residual = residual - lengths[-1] * image
        z = precondition(residual)
        updates.append(np.vdot(residual, z) / product)
        product = np.vdot(residual, z)
        direction = z + updates[-1] * direction
        theta = min(theta, _smallest_ritz_value(lengths, updates))
        lost = state.size(x) ** 2
        enough = len(lengths) >= least or lost > target
        if enough and state.size(z) / theta < max(lost, target):
            return _Step(x, theta, len(lengths), exhausted=False)
    return _Step(x, theta, len(lengths), exhausted=len(lengths) < most)


def _smallest_ritz_value(lengths: list[float], updates: list[float]) -> float:
    """Smallest eigenvalue of what conjugate gradients saw of P⁻¹S, a tridiagonal matrix [1]_.

    1/a_j + b_j−1/a_j−1 on the diagonal, √b_j/a_j beside it; a: lengths, b: updates of directions.

    .. [1] Y. Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., SIAM 2003, section 6.7.3.
    """
    length, update = np.array(lengths), np.array(updates)[:-1]
    diagonal = 1 / length
    diagonal[1:] += update / length[:-1]
    beside = np.sqrt(update) / length[:-1]
    matrix = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
    return float(np.linalg.eigvalsh(matrix)[0])


def _hats(shape: tuple[int, ...], extent: NDArray[Any]) -> NDArray[Any]:
    """Bilinear hats over the sensor, shape (hats, rows, cols): their sum is 1 everywhere."""
    rows, cols = (
        _hats_along(length, max(LEAST_SPACING, SPACING * int(reach)))
        for length, reach in zip(shape, extent, strict=True)
    )
    return np.asarray(np.einsum("ir,jc->ijrc", rows, cols).reshape(-1, *shape))


def _hats_along(length: int, spacing: int) -> NDArray[Any]:
    """Hats of one axis, shape (hats, length), two at least and about the spacing apart."""
    span = max(1, length - 1)
    nodes = np.linspace(0, span, max(1, span // spacing) + 1)
    pixels = np.arange(length)
    return np.array([np.interp(pixels, nodes, peak) for peak in np.eye(len(nodes))])


def _two_levels(state: _State, hats: NDArray[Any]) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """P⁻¹·r = r/D + γ·Φ·A⁺·Φᵀ·r, with Φ the hats times M, A = Φᵀ·S·Φ and γ the damping.

    A is singular: waves that no shift sees are left out, to begin with that which is the same
    everywhere.
    """
    inner = np.where(state.weak, 0, state.sensitivity)
    phi = hats * inner
    coarse = np.array([np.tensordot(phi, state.product(hat), 2) for hat in phi])
    values, waves = np.linalg.eigh((coarse + coarse.T) / 2)
    seen = values > SINGULAR * np.tensordot(phi**2, state.diagonal, 2).max()
    inverse = waves[:, seen] / values[seen] @ waves[:, seen].T
    diagonal = np.where(state.weak, 0, _ratio(np.ones_like(inner), state.diagonal))

    def precondition(residual: NDArray[Any]) -> NDArray[Any]:
        wave = np.tensordot(inverse @ np.tensordot(phi, residual, 2), hats, 1)
        return np.asarray(diagonal * residual + DAMPING * inner * (wave - wave.mean()))

    return precondition


def _over_cells(data: Problem, values: NDArray[Any]) -> NDArray[Any]:
    """Sum what the measurements of a cell carry, flat over the beam grid."""
    size = data.grid_shape[0] * data.grid_shape[1]
    return np.asarray(np.bincount(data.cells.ravel(), values.ravel(), size))


def _ratio(above: NDArray[Any], below: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(np.divide(above, below, where=below > 0, out=np.zeros_like(above)))

"""Weights that depend on the fit: variances by a noise model, and none for what disagrees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.calibration.robust import Evidence, check_count_for_rejection, rejected
from equipix.noise import modelled_variances
from equipix.prediction import positions, predictions

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from equipix._native import Solution
    from equipix.noise import NoiseModel
    from equipix.prediction import Position

_ROUGH = 1e-3
"""Tolerance of a fit that only tells how much signal to expect: its noise is larger."""

_MOST_ROUNDS = 20
"""Of fitting and leaving out; a grain takes three or four."""

_BLOCK = 64


@dataclass(frozen=True, eq=False)
class Problem:
    """What weights are made for.

    Attributes
    ----------
    values : ndarray, shape (n, rows, cols)
        The measurements.
    masked : ndarray of bool, shape (rows, cols) or (n, rows, cols), or None
        Which are not to be used.
    shifts, rotation, flux : ndarray, shape (n, 2), (n,) and (n,)
        Where and how bright.
    solve : callable
        ``solve(variances, masked, tolerance)`` fits them.
    """

    values: NDArray[Any]
    masked: NDArray[np.bool_] | None
    shifts: NDArray[Any]
    rotation: NDArray[Any]
    flux: NDArray[Any]
    solve: Callable[[NDArray[Any] | None, NDArray[np.bool_] | None, float], Solution]

    def usable(self) -> NDArray[np.bool_]:
        """Which measurements may be used, shape (n, rows, cols)."""
        finite: NDArray[np.bool_] = np.isfinite(self.values)
        if self.masked is not None:
            finite &= ~self.masked
        return finite

    def places(self, solution: Solution) -> list[Position]:
        """Where each exposure lies on the grid of the beam."""
        shifts = self.shifts if solution.shifts is None else np.array(solution.shifts)
        return positions(solution.beam_origin, shifts, self.rotation, np.array(solution.flux))


def modelled(data: Problem, models: list[NoiseModel], tolerance: float) -> NDArray[Any]:
    """Variances of the values by their noise models, at what a first fit expects.

    That fit has the variances at the medians over the exposures, pixel by pixel, which no single
    false value moves far.
    """
    middle = medians(data)
    rough = modelled_variances(models, (c * middle for c in data.flux), data.values)
    first = data.solve(rough, data.masked, max(tolerance, _ROUGH))
    return modelled_variances(models, _expected(data, first, middle), data.values)


def solve_robustly(
    data: Problem,
    models: list[NoiseModel],
    variances: NDArray[Any] | None,
    tolerance: float,
) -> tuple[Solution, NDArray[np.bool_]]:
    """Fit, leave out what disagrees, and so on until nothing changes.

    Returns the last fit and the measurements (n, rows, cols) that it did without.
    """
    check_count_for_rejection(len(data.values))
    usable = data.usable()
    out = np.zeros_like(usable)
    middle = medians(data) if models else None
    solution = data.solve(variances, data.masked, tolerance)
    for _ in range(_MOST_ROUNDS):
        evidence = Evidence(data.values, variances, usable, data.places(solution), tolerance)
        former, out = out, rejected(evidence, solution.sensitivity, solution.beam, out)
        if np.array_equal(former, out):
            break
        if middle is not None:
            expected = _expected(data, solution, middle)
            variances = modelled_variances(models, expected, data.values)
        solution = data.solve(variances, ~usable | out, tolerance)
    return solution, out


def _expected(data: Problem, solution: Solution, middle: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Signals c · L · M; where the fit knows none, outside the largest part, the medians."""
    frames = predictions(solution.sensitivity, solution.beam, data.places(solution))
    for frame, flux in zip(frames, data.flux, strict=True):
        yield np.where(np.isfinite(frame), frame, flux * middle)


def medians(data: Problem) -> NDArray[Any]:
    """Median over the exposures of value/flux in each pixel; NaN where nothing is measured."""
    result = np.empty(data.values.shape[1:])
    for start in range(0, len(result), _BLOCK):
        rows = slice(start, start + _BLOCK)
        values = data.values[:, rows] / data.flux[:, None, None]
        usable = np.isfinite(values)
        if data.masked is not None:
            usable &= ~data.masked[..., rows, :]
        values[~usable] = np.nan
        values.sort(axis=0)  # NaN last
        count = usable.sum(axis=0)
        middle = [np.maximum(index, 0)[None] for index in ((count - 1) // 2, count // 2)]
        result[rows] = np.mean([np.take_along_axis(values, i, axis=0)[0] for i in middle], axis=0)
    return result

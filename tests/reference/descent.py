"""Coordinate descent, the paper's method: all L with M fixed, then all M with L fixed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from reference.connectivity import components
from reference.model import Problem, objective, problem

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Solution:
    """What a solver found.

    Attributes
    ----------
    sensitivity : ndarray, shape (rows, cols)
        M, of mean 1 over its pixels; NaN outside component 0.
    beam : ndarray, shape of the padded grid
        L; NaN in cells that no used measurement sees.
    beam_origin : tuple of int
        ``beam[beam_origin + p]`` is the beam at pixel p of a sensor with shift 0.
    objective : list of float
        F after each sweep.
    component_labels : ndarray of int32, shape (rows, cols)
        Connected component of each pixel.
    """

    sensitivity: NDArray[Any]
    beam: NDArray[Any]
    beam_origin: tuple[int, int]
    objective: list[float]
    component_labels: NDArray[Any]


def coordinate_descent(
    frames: ArrayLike,
    shifts: ArrayLike,
    *,
    variance: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    flux: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    sweeps: int = 100,
) -> Solution:
    """Run a number of sweeps of coordinate descent from M = 1.

    Parameters
    ----------
    frames, shifts, variance, mask, flux, rotation : array_like
        As for `reference.model.problem`.
    sweeps : int
        Number of sweeps.

    Returns
    -------
    Solution
        Sensitivity, beam and the objective after each sweep.
    """
    data = problem(frames, shifts, variance=variance, mask=mask, flux=flux, rotation=rotation)
    sensitivity = np.ones(data.values.shape[1:])
    beam = np.empty(data.grid_shape)
    history = []
    for _ in range(sweeps):
        beam = best_beam(data, sensitivity)
        sensitivity = best_sensitivity(data, beam)
        history.append(objective(data, sensitivity, beam))
    return gauged(data, sensitivity, beam, history)


def best_beam(data: Problem, sensitivity: NDArray[Any]) -> NDArray[Any]:
    """Minimise F over L: L(u) = Σ w·c·M·y / Σ w·c²·M², sums over all that sees cell u."""
    above, below = np.zeros((2, *data.grid_shape))
    for y, w, c, u in zip(data.values, data.weights, data.flux, data.cells, strict=True):
        seen = w > 0
        np.add.at(above.ravel(), u[seen], (w * c * sensitivity * y)[seen])
        np.add.at(below.ravel(), u[seen], (w * c**2 * sensitivity**2)[seen])
    return _ratio(above, below)


def best_sensitivity(data: Problem, beam: NDArray[Any]) -> NDArray[Any]:
    """Minimise F over M: M(p) = Σ w·c·L·y / Σ w·c²·L², sums over the exposures."""
    above, below = np.zeros((2, *data.values.shape[1:]))
    for y, w, c, u in zip(data.values, data.weights, data.flux, data.cells, strict=True):
        seen = w > 0
        above[seen] += (w * c * beam.flat[u] * y)[seen]
        below[seen] += (w * c**2 * beam.flat[u] ** 2)[seen]
    return _ratio(above, below)


def _ratio(above: NDArray[Any], below: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(np.divide(above, below, where=below > 0, out=np.full_like(above, np.nan)))


def gauged(
    data: Problem, sensitivity: NDArray[Any], beam: NDArray[Any], history: list[float]
) -> Solution:
    """Scale each component to mean(M) = 1; leave M only in component 0."""
    pixels, cells = components(data.cells, data.weights > 0, data.grid_shape)
    sensitivity, beam = sensitivity.copy(), beam.copy()
    for label in range(pixels.max() + 1):
        scale = sensitivity[pixels == label].mean()
        sensitivity[pixels == label] /= scale
        beam[cells == label] *= scale
    sensitivity[pixels != 0] = np.nan
    return Solution(sensitivity, beam, data.beam_origin, history, pixels)

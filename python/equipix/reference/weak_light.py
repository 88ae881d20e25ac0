"""The prior of the sensitivity in weak light."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.reference.descent import best_beam
from equipix.reference.model import problem

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

SPREAD = 0.2
"""Standard deviation of M, relative to its mean, that is assumed without light."""

LIT = 100.0
"""D of the faintest pixel without a prior, in variances of a measurement of weight 1."""


def weak_light_prior(
    frames: ArrayLike,
    shifts: ArrayLike,
    unit: float,
    *,
    variance: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    flux: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
) -> NDArray[Any]:
    """Weights λ = σ²/0.2² (1 − D/100σ²)² of the prior, with D = Σ w·c²·L² at M = 1.

    Parameters
    ----------
    frames, shifts, variance, mask, flux, rotation : array_like
        As for `equipix.reference.model.problem`.
    unit : float
        σ², the variance of a measurement of weight 1.

    Returns
    -------
    ndarray, shape (rows, cols)
        λ; 0 from D = 100σ² on, and in pixels without a measurement.
    """
    data = problem(frames, shifts, variance=variance, mask=mask, flux=flux, rotation=rotation)
    beam = np.nan_to_num(best_beam(data, np.ones(data.values.shape[1:])))
    weights = data.weights * data.flux[:, None, None] ** 2
    information = (weights * beam.flat[data.cells] ** 2).sum(axis=0)
    lacking = np.maximum(1 - information / (LIT * unit), 0)
    return np.where((data.weights > 0).any(axis=0), unit / SPREAD**2 * lacking**2, 0)

"""The prior of the sensitivity in weak light."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from reference.descent import best_beam
from reference.model import problem

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

SPREAD = 0.2
"""Standard deviation of M, relative to its mean, that is assumed without light."""

LIT = 100.0
"""D of a pixel that needs no prior, in variances of a measurement of weight 1."""

UNKNOWN = 4.0
"""D of a pixel that needs one in any light, likewise."""

WEAK = 1 / 16
"""D of a pixel in weak light, at most, as a share of a bright pixel's."""


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
    """Weights λ = σ²/0.2² (1 − D/D₀)² of the prior, with D = Σ w·c²·L² at M = 1.

    D₀ is 100σ², but no more than a sixteenth of a bright pixel's D or 4σ², whichever is more. A
    bright pixel is at 90 % of those above 100σ², or of all if fewer than 16 are.

    Parameters
    ----------
    frames, shifts : array_like
        As for `reference.model.problem`.
    unit : float
        Variance σ² of a measurement of weight 1.
    variance, mask, flux, rotation : array_like
        As for `reference.model.problem`.

    Returns
    -------
    ndarray, shape (rows, cols)
        Weights λ; 0 from D = D₀ on, and in pixels without a measurement.
    """
    data = problem(frames, shifts, variance=variance, mask=mask, flux=flux, rotation=rotation)
    beam = np.nan_to_num(best_beam(data, np.ones(data.values.shape[1:])))
    weights = data.weights * data.flux[:, None, None] ** 2
    information = (weights * beam.flat[data.cells] ** 2).sum(axis=0)
    lit = np.sort(information[information > LIT * unit])
    lit = lit if lit.size >= 16 else np.sort(information[information > 0])
    enough = min(LIT * unit, max(WEAK * lit[int(0.9 * lit.size)], UNKNOWN * unit))
    lacking = np.maximum(1 - information / enough, 0)
    return np.where((data.weights > 0).any(axis=0), unit / SPREAD**2 * lacking**2, 0)

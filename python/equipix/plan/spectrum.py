"""How well a pattern of shifts determines waves of the sensitivity: the symbol λ(q)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_FINER = 64
"""Steps within one of the grid of frequencies, to each side, that the smallest λ is refined by."""

_FREQUENCIES = 512
"""Between 0 and half a cycle per pixel: finer than the dips of patterns up to this many pixels."""


@dataclass(frozen=True, eq=False, repr=False)
class Spectrum:
    """The symbol of the least-squares problem for waves of the sensitivity, far from the edges.

    Attributes
    ----------
    rows : ndarray, shape (513,), float64
        Frequencies along the rows' axis, in cycles per pixel, from 0 to 1/2.
    cols : ndarray, shape (1025,), float64
        Frequencies along the columns' axis, from −1/2 to 1/2.
    values : ndarray, shape (513, 1025), float64
        λ(q) from 0 (an undetermined wave) to n. For random noise σ the variance of the
        wave's amplitude is proportional to σ²/λ.
    worst : tuple of float
        Frequency (row, col) of the smallest λ away from long waves: a nearly periodic one, whose
        phase is about the same in all exposures. NaN if all waves are long.
    smallest : float
        λ there.
    """

    rows: NDArray[np.float64]
    cols: NDArray[np.float64]
    values: NDArray[Any]
    worst: tuple[float, float]
    smallest: float

    def __repr__(self) -> str:
        """Short form: the worst wave."""
        return (
            f"<Spectrum: λ falls to {self.smallest:.3g} at ({self.worst[0]:.3f}, "
            f"{self.worst[1]:.3f}) cycles per pixel>"
        )


def spectrum(shifts: NDArray[Any], powers: NDArray[np.float64]) -> Spectrum:
    """Evaluate λ(q) = Σ c² − |Σ c² e^{iq·d}|² / Σ c², which is n − |Σ e^{iq·d}|²/n for c = 1."""
    rows = np.linspace(0, 0.5, _FREQUENCIES + 1)
    cols = np.linspace(-0.5, 0.5, 2 * _FREQUENCIES + 1)
    down = np.exp(2j * np.pi * np.outer(rows, shifts[:, 0])) * powers**2
    right = np.exp(2j * np.pi * np.outer(shifts[:, 1], cols))
    total = np.sum(powers**2)
    values = total - np.abs(down @ right) ** 2 / total
    # A wave is long if its phases scatter by less than a radian over the exposures, where λ is
    # still close to n·qᵀ·cov(d)·q.
    covariance = (2 * np.pi) ** 2 * np.cov(shifts.T, bias=True)
    scatter = (
        covariance[0, 0] * rows[:, None] ** 2
        + 2 * covariance[0, 1] * rows[:, None] * cols
        + covariance[1, 1] * cols**2
    )
    short = np.where(scatter < 1, np.inf, values)
    row, col = np.unravel_index(short.argmin(), short.shape)
    if np.isinf(short[row, col]):
        return Spectrum(rows, cols, values, (np.nan, np.nan), np.nan)
    worst = float(rows[row]), float(cols[col])
    return Spectrum(rows, cols, values, worst, float(values[row, col]))


def smallest_near(found: Spectrum, shifts: NDArray[Any]) -> float:
    """Refine the smallest λ between the frequencies of the spectrum, for fluxes of 1.

    Shifts between pixels may make a wave periodic whose frequency is none of the grid's.
    """
    steps = np.linspace(-1, 1, 2 * _FINER + 1) / (2 * _FREQUENCIES)
    down, right = (
        np.exp(2j * np.pi * np.outer(steps + middle, along))
        for middle, along in zip(found.worst, shifts.T, strict=True)
    )
    count = len(shifts)
    return float((count - np.abs(down @ right.T) ** 2 / count).min())

"""The course of a calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from equipix._readonly import ReadOnly

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class History(ReadOnly):
    """The course of a calibration: its state after some of its sweeps.

    Attributes
    ----------
    sweep : ndarray, shape (looks,), uint64
        How many sweeps had been made.
    objective : ndarray, shape (looks,), float64
        Objective F, with penalty and priors where a fit has them; it never rises but for rounding,
        and while such a fit still finds their weights. In coordinate descent it is F after a sweep;
        `Calibration.objective` is smaller by the one update of the beam that follows the last.
    error_estimate : ndarray, shape (looks,), float64
        The estimated largest relative error of the sensitivity.
    """

    sweep: NDArray[Any]
    objective: NDArray[Any]
    error_estimate: NDArray[Any]

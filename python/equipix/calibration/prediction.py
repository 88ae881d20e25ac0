"""Frames that a calibrated sensor would give, and what others differ from them by."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix._check import per_exposure
from equipix.exposures.positions import Positions

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import ArrayLike

    from equipix._native import Beam
    from equipix._types import Array
    from equipix.exposures.front import Measured


class Place(NamedTuple):
    """Where the sensor is in the beam, and how bright the beam is."""

    shift: tuple[float, float]
    rotation: int
    flux: float


def places_of(shifts: ArrayLike, rotation: ArrayLike | None, flux: ArrayLike | None) -> list[Place]:
    """Shift, rotation and flux of each exposure, checked."""
    positions = Positions.of(shifts, rotation=rotation)
    fluxes = per_exposure("flux", flux, len(positions), default=1)
    rows = zip(positions.shifts, positions.rotation, fluxes, strict=True)
    return [
        Place((float(shift[0]), float(shift[1])), int(turn), float(c)) for shift, turn, c in rows
    ]


def signal_at(place: Place, beam: Beam, sensitivity: Array) -> Array:
    """Frame c · L(u) · M(p) from a place, in the dtype of the sensitivity."""
    rows, cols = sensitivity.shape
    light = beam.light((rows, cols), place.shift, place.rotation, workers=None)
    return np.asarray(place.flux * light * sensitivity, sensitivity.dtype)


def subtract_signals(
    measured: Measured, signals: Iterable[Array], dark: Array | None, out: Array
) -> None:
    """Write values less signals and dark, in standard deviations where variances are known.

    Where nothing is measured `out` stays as it is.
    """
    for k, (values, signal) in enumerate(zip(measured.values, signals, strict=True)):
        np.subtract(values, signal, out=out[k], where=np.isfinite(values))
        if dark is not None:
            out[k] -= dark
        variance = measured.variance_of(k, signal)
        if variance is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                out[k] /= np.sqrt(variance)

"""Exposures of arrays, as `equipix.calibrate` makes them before its fit."""

from __future__ import annotations

from typing import Any

from equipix.exposures.exposures import Exposures
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Positions
from equipix.measured.measured import measured_of


def exposures_of(
    frames: Any,
    shifts: Any,
    *,
    variance: Any = None,
    saturation: float | None = None,
    flux: Any = None,
    flux_std: Any = None,
    time: Any = None,
    rotation: Any = None,
    shift_std: Any = None,
    **options: Any,
) -> Exposures:
    """Make exposures; the arguments are those of `equipix.calibrate`."""
    measured = measured_of(frames, variance, saturation)
    shape = measured.values.shape
    positions = Positions.of(shifts, rotation=rotation, std=shift_std, shape=shape)
    return Exposures.of(
        measured, positions, Flux.of(flux, flux_std, time, len(measured)), **options
    )

"""Verdicts on what is given, before any fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.calibration.brightness import on_brightness
from equipix.calibration.verdicts import Verdict
from equipix.exposures.clipping import clipping_advice
from equipix.exposures.reach import micrometre_step
from equipix.exposures.repeated import repeated

if TYPE_CHECKING:
    from equipix.exposures.exposures import Exposures


_LEAST_MOVE = 0.5
"""Least distance, in pixels, between shifts that are in pixels."""


def on_input(exposures: Exposures) -> list[Verdict]:
    """Verdicts on exposures that the values given contradict."""
    found = [
        _on_clipping(exposures),
        _on_raw(exposures),
        Verdict("light", exposures.unsteady) if exposures.unsteady else None,
        _on_units(exposures),
        _on_brightness(exposures),
        _on_repeats(exposures),
        _on_filters(exposures),
    ]
    return [verdict for verdict in found if verdict is not None]


def _on_clipping(exposures: Exposures) -> Verdict | None:
    """Verdict on a saturation level that is missing or too high."""
    if exposures.clipped is None:
        return None
    return Verdict("saturation", clipping_advice(exposures.clipped))


def _on_raw(exposures: Exposures) -> Verdict | None:
    """Verdict on averages, or arrays as cameras write them, without a dark."""
    if not exposures.raw:
        return None
    return Verdict(
        "raw",
        "no dark was subtracted from frames of whole numbers, so that an offset of the camera "
        "counts as light: give 'dark' to equipix.average (--dark), or subtract it before",
    )


def _on_units(exposures: Exposures) -> Verdict | None:
    """Verdict on shifts that look like millimetres, or like micrometres."""
    shifts = exposures.positions.shifts
    most = float(np.ptp(shifts, axis=0).max())
    if 0 < most < _LEAST_MOVE:
        return Verdict(
            "unit",
            f"the shifts differ by {most:.2g} pixel at most (limit {_LEAST_MOVE:g}), from which "
            "next to nothing follows. Expected are pixels: divide millimetres by the pixel pitch, "
            "see 'From micrometres to pixels' in README",
        )
    step = micrometre_step(shifts, exposures.shape)
    if step is None:
        return None
    return Verdict(
        "unit",
        f"the shifts look like micrometres: they are multiples of {step:g}, and the largest is "
        f"{abs(shifts - shifts[0]).max():g}. Expected are pixels: divide micrometres by the pixel "
        "pitch, see 'From micrometres to pixels' in README",
    )


def _on_brightness(exposures: Exposures) -> Verdict | None:
    """Verdict on one exposure with far more or less light than its flux says."""
    words = on_brightness(exposures)
    return None if words is None else Verdict("flux", words)


def _on_filters(exposures: Exposures) -> Verdict | None:
    """Verdict on a pattern of colour filters, or of the read-out, that is not the one named."""
    filters = exposures.filters
    return Verdict("cfa", filters.words) if filters is not None and filters.words else None


def _on_repeats(exposures: Exposures) -> Verdict | None:
    """Verdict on one exposure that is given for two positions."""
    pair = repeated(exposures.values, exposures.positions)
    if pair is None:
        return None
    first, second = pair
    return Verdict(
        "repeated",
        f"exposures {first} and {second} are equal, value for value, which noise prevents: give "
        "each position its own frames, and see whether the sensor moved",
    )

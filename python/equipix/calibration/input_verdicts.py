"""Verdicts on what is given, before any fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

from equipix.calibration.verdicts import Verdict
from equipix.exposures.clipping import clipping_advice

if TYPE_CHECKING:
    from equipix.exposures.exposures import Exposures


def on_input(exposures: Exposures) -> list[Verdict]:
    """Verdicts on exposures that the values given contradict."""
    found = [_on_clipping(exposures)]
    return [verdict for verdict in found if verdict is not None]


def _on_clipping(exposures: Exposures) -> Verdict | None:
    """Verdict on a saturation level that is missing or too high."""
    if exposures.clipped is None:
        return None
    return Verdict("saturation", clipping_advice(exposures.clipped))

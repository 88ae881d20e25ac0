"""What limits a result, as bad_pixels; what limits a pixel, as flags."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntFlag

import numpy as np

from equipix._check import Array, Bools, Floats
from equipix.errors import (
    ConvergenceWarning,
    EquipixWarning,
    IdentifiabilityWarning,
    InputWarning,
    MisfitWarning,
    warn,
)

_CATEGORIES: dict[str, type[EquipixWarning]] = {
    "rounding": InputWarning,
    "order": IdentifiabilityWarning,
    "saturation": InputWarning,
    "unit": IdentifiabilityWarning,
    "raw": InputWarning,
    "light": MisfitWarning,
    "flux": MisfitWarning,
    "repeated": MisfitWarning,
    "partial": IdentifiabilityWarning,
    "sign": MisfitWarning,
    "orientation": IdentifiabilityWarning,
    "components": IdentifiabilityWarning,
    "pattern": IdentifiabilityWarning,
    "tilt": IdentifiabilityWarning,
    "faint": IdentifiabilityWarning,
    "dark": IdentifiabilityWarning,
    "misfit": MisfitWarning,
    "cfa": MisfitWarning,
    "colour": MisfitWarning,
    "drift": MisfitWarning,
    "prior": MisfitWarning,
    "variance": MisfitWarning,
    "convergence": ConvergenceWarning,
    "uncertainty": ConvergenceWarning,
}
"""The warning of each kind of finding."""


@dataclass(frozen=True)
class Finding:
    """A finding that limits a result.

    Attributes
    ----------
    kind : str
        Its subject: one of the keys above.
    message : str
        What is wrong, the value, the limit and the remedy.
    """

    kind: str
    message: str

    def __post_init__(self) -> None:
        """Refuse a kind that there is not."""
        if self.kind not in _CATEGORIES:
            raise ValueError(f"finding of kind {self.kind!r}, expected one of {[*_CATEGORIES]}")


def say(findings: Iterable[Finding]) -> None:
    """Raise the warning of each; no other function warns of a calibration."""
    for finding in findings:
        warn(finding.message, _CATEGORIES[finding.kind])


class Flag(IntFlag):
    """Defects of a pixel: bits of ``flags`` arrays, with JWST's bit numbers.

    A pixel without any bit set is good. ``DO_NOT_USE`` accompanies every flag that makes the
    pixel's corrected value worthless.
    """

    DO_NOT_USE = 1 << 0
    SATURATED = 1 << 1
    DEAD = 1 << 10
    HOT = 1 << 11
    TELEGRAPH = 1 << 15
    NONLINEAR = 1 << 16
    NO_FLAT_FIELD = 1 << 18
    UNRELIABLE_FLAT = 1 << 25
    OTHER_BAD_PIXEL = 1 << 30


BITS = {
    "saturated": Flag.SATURATED,
    "dead": Flag.DEAD | Flag.DO_NOT_USE,
    "hot": Flag.HOT | Flag.DO_NOT_USE,
    "noisy": Flag.HOT | Flag.DO_NOT_USE,
    "contradictory": Flag.UNRELIABLE_FLAT | Flag.DO_NOT_USE,
    "faint": Flag.UNRELIABLE_FLAT | Flag.DO_NOT_USE,
    "undetermined": Flag.NO_FLAT_FIELD | Flag.DO_NOT_USE,
    "falling": Flag.NONLINEAR | Flag.DO_NOT_USE,
    "nonlinear": Flag.NONLINEAR | Flag.DO_NOT_USE,
    "non_responding": Flag.DEAD | Flag.DO_NOT_USE,
    "flickering": Flag.TELEGRAPH | Flag.DO_NOT_USE,
    "out_of_range": Flag.OTHER_BAD_PIXEL | Flag.DO_NOT_USE,
}
"""Bits that each finding sets; a saturated value is left out of its exposure, and the pixel keeps
the sensitivity that the others determine. The last six are bad_pixels on response curves."""


def set_bits(flags: Array, finding: str, pixels: Bools | None) -> None:
    """Set the bits of a finding in `flags` where `pixels` is true."""
    if pixels is not None:
        flags[pixels] |= np.uint32(BITS[finding])


def usable(flags: Array) -> Bools:
    """Pixels without ``DO_NOT_USE``."""
    return np.asarray((flags & Flag.DO_NOT_USE) == 0)


def mean_of_usable(sensitivity: Floats, flags: Array) -> float:
    """Mean sensitivity of pixels without ``DO_NOT_USE``; 1 if it is but for rounding, or none."""
    counted = usable(flags) & np.isfinite(sensitivity)
    mean = float(np.mean(sensitivity, where=counted)) if counted.any() else 1.0
    return mean if abs(mean - 1) > counted.size * np.finfo(float).eps else 1.0


def determined(sensitivity: Array, flags: Array) -> Bools:
    """Where ln M is known: M is above 0, and its measurements carry weight."""
    weak = (flags & Flag.UNRELIABLE_FLAT) != 0
    return np.asarray((sensitivity > 0) & ~weak)

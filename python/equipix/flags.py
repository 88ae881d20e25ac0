"""What is wrong with a pixel."""

from __future__ import annotations

from enum import IntFlag
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Flag(IntFlag):
    """What is wrong with a pixel: bits of ``flags`` arrays, with JWST's bit numbers.

    A pixel without any bit set is good. ``DO_NOT_USE`` accompanies every flag that makes the
    pixel's corrected value worthless.
    """

    DO_NOT_USE = 1 << 0
    SATURATED = 1 << 1
    DEAD = 1 << 10
    HOT = 1 << 11
    NO_FLAT_FIELD = 1 << 18
    UNRELIABLE_FLAT = 1 << 25


def determined(sensitivity: NDArray[Any], flags: NDArray[Any]) -> NDArray[np.bool_]:
    """Where ln M is known: M is above 0, and its measurements carry weight."""
    weak = (flags & Flag.UNRELIABLE_FLAT) != 0
    return np.asarray((sensitivity > 0) & ~weak)

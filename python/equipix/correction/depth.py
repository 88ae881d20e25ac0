"""Frames of another bit depth than those that a correction was measured with."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from equipix.errors import InputError

if TYPE_CHECKING:
    from equipix.correction.protocol import Correction


class Depth(NamedTuple):
    """Bits of the raw values that a correction was measured with, 0 where they are unknown.

    `floats` tells whether it fits no other unit than DN. Frames of floating-point numbers may be in
    another unit where a correction is a gain, so they are compared only where it is not. `dark` is
    the level in DN that frames without light have, or the lowest level that was measured; 0 where
    neither is known.
    """

    bits: int = 0
    floats: bool = False
    dark: float = 0.0

    @property
    def largest(self) -> int:
        """Largest raw value."""
        return int(2**self.bits - 1)

    def refuse_type(self, dtype: np.dtype[Any]) -> None:
        """Refuse whole numbers of fewer bits."""
        # A saturation level of 256 may be given for 8 bits, so one bit less is no other depth.
        if dtype.kind == "u" and np.iinfo(dtype).max < self.largest // 2:
            raise InputError(
                f"'frames' is {dtype}, but the correction was measured with {self.bits} bits: "
                "frames of another sensor or bit depth"
            )

    def refuse_highest(self, highest: float, dtype: np.dtype[Any]) -> None:
        """Refuse a highest value that these bits do not hold, or of numbers from 0 to 1."""
        if dtype.kind == "f" and 0 < highest <= 1 and self.dark > _DARK:
            raise InputError(
                f"'frames' holds floating-point numbers up to {highest:.4g}, but without light the "
                f"correction was measured at {self.dark:.6g} DN: if they are scaled to 0 to 1, "
                f"multiply by {self.largest or 'the largest value of the camera'}"
            )
        compared = self.bits and (self.floats or dtype.kind in "iu")
        if compared and highest > self.largest:
            raise InputError(
                f"'frames' holds {highest:.10g}, above {self.largest}, the largest value of the "
                f"{self.bits} bits that the correction was measured with: frames of another sensor "
                "or bit depth"
            )


_DARK = 10.0
"""Level without light, in DN, from which frames of at most 1 DN are in another unit."""

UNKNOWN = Depth()


def depth_of(correction: Correction) -> Depth:
    """Return the bits of the sensor in the metadata, else those that hold the saturation level.

    Pixels may give more than that level, which may be set below the largest value.
    """
    level: float | None = getattr(correction, "saturation", None)
    sensor = correction.metadata.get("sensor")
    bits = sensor.get("bit_depth") if isinstance(sensor, dict) else None
    if not isinstance(bits, int):
        bits = 0 if level is None or level == math.inf else math.ceil(level).bit_length()
    return Depth(bits, level is not None, _dark_level(correction))


def _dark_level(correction: Correction) -> float:
    """Median of the dark that is subtracted; of raw levels the lowest mean."""
    values = getattr(correction, "dark", None)
    if values is None and getattr(correction, "raw", False):
        return float(np.min(getattr(correction, "levels", 0.0)))
    known = np.zeros(0) if values is None else values[np.isfinite(values)]
    return float(np.median(known)) if known.size else 0.0

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
    another unit where a correction is a gain, so they are compared only where it is not.
    """

    bits: int = 0
    floats: bool = False

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

    def refuse_above(self, highest: float, dtype: np.dtype[Any]) -> None:
        """Refuse a highest value that these bits do not hold."""
        compared = self.bits and (self.floats or dtype.kind in "iu")
        if compared and highest > self.largest:
            raise InputError(
                f"'frames' holds {highest:.10g}, above {self.largest}, the largest value of the "
                f"{self.bits} bits that the correction was measured with: frames of another sensor "
                "or bit depth"
            )


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
    return Depth(bits, floats=level is not None)

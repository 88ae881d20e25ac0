"""What a correction is, and checks of its sensor and bit depth."""

from __future__ import annotations

import math
from os import PathLike
from typing import Any, Literal, NamedTuple, Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from equipix._check import Flagged, described
from equipix.errors import InputError
from equipix.findings import Finding
from equipix.measured.colour import Colours
from equipix.measured.statistics import FrameStatistics


@runtime_checkable
class Correction(Protocol):
    """The protocol of all corrections of a sensor, whatever method found them."""

    @property
    def shape(self) -> tuple[int, int]:
        """Sizes of the sensor (rows, cols)."""

    @property
    def flags(self) -> NDArray[Any]:
        """Bits of `Flag` per pixel, shape (rows, cols), uint32."""

    @property
    def metadata(self) -> dict[str, Any]:
        """Versions, options and origin, as JSON values."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What limits it."""

    @property
    def coefficients(self) -> NDArray[Any]:
        """Coefficients c of the corrected frame Σ c_j y^j, shape (order + 1, rows, cols).

        y is the raw frame in DN. NaN in a pixel that the correction does not determine.
        """

    def correct(
        self, frames: ArrayLike, *, flagged: Flagged = "nan", out: NDArray[Any] | None = None
    ) -> NDArray[Any]:
        """Frames as a sensor of equal pixels would have given them.

        Of the frames' shape, (rows, cols) or (n, rows, cols); float64 for float64 frames, else
        float32; or in `out`. `flagged` determines the value of pixels flagged ``DO_NOT_USE``.
        """

    def save(self, path: str | PathLike[str], *, force: bool = False) -> None:
        """Write to a file that `equipix.load` reads; its suffix names the format."""


class DarkCorrection(Correction, Protocol):
    """A dataclass of a correction that subtracts a dark frame, which another may replace."""

    @property
    def dark(self) -> NDArray[Any] | None:
        """The dark frame in DN, shape (rows, cols), if it is part of the correction."""

    def correct(
        self,
        frames: ArrayLike,
        *,
        dark: Literal["stored"] | FrameStatistics | ArrayLike | None = "stored",
        flagged: Flagged = "nan",
        out: NDArray[Any] | None = None,
    ) -> NDArray[Any]:
        """Frames as `Correction.correct` gives them, after `dark` is subtracted."""


def check_correction(name: str, given: object) -> None:
    """Refuse what is no correction, such as the name of its file."""
    needed = ("shape", "flags", "metadata", "coefficients")
    # Of the class first: a property of the object may be costly.
    if all(hasattr(type(given), each) or hasattr(given, each) for each in needed):
        return
    raise InputError(
        f"'{name}' is {described(given)}, expected a correction: equipix.load(path), or the result "
        "of equipix.calibrate or equipix.nuc.fit"
    )


def takes_dark(correction: Correction) -> TypeGuard[DarkCorrection]:
    """Whether another dark frame can take the place of that stored."""
    return hasattr(correction, "dark")


def sensor_of(correction: Correction) -> str:
    """Return the name of the sensor in the metadata; empty where there is none."""
    sensor = correction.metadata.get("sensor")
    return str(sensor.get("name", "")) if isinstance(sensor, dict) else ""


def cfa_of(correction: Correction) -> Colours | None:
    """Return the colour filters of the pixels, of the correction or of the sensor in metadata."""
    own = getattr(correction, "cfa", None)
    sensor = correction.metadata.get("sensor")
    named = sensor.get("cfa") if isinstance(sensor, dict) else None
    return Colours.of(named if own is None else own)


def named_cfa(correction: Correction, cfa: ArrayLike | None) -> Colours | None:
    """Return the colour filters of a correction, or `cfa`, which must be no others.

    Raises
    ------
    InputError
        If `cfa` is no pattern, or another than that of the correction.
    """
    own, given = cfa_of(correction), Colours.of(cfa)
    if own is not None and given not in (None, own):
        raise InputError(
            f"'cfa' is {str(given)!r}, but the correction was fitted with {str(own)!r}: "
            "leave it out"
        )
    return given if own is None else own


def check_sensor(correction: Correction, sensor: str | None) -> None:
    """Refuse frames of a sensor of another name than that of the correction."""
    if sensor is None:
        return
    own = sensor_of(correction)
    if not own:
        raise InputError(
            f"'sensor' is '{sensor}', but this correction names no sensor to compare it with: "
            "leave it out"
        )
    if own != sensor:
        raise InputError(f"'sensor' is '{sensor}', but the correction is of '{own}'")


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

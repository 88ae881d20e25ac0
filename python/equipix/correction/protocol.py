"""What a correction is, and checks of its sensor and bit depth."""

from collections.abc import Mapping
from dataclasses import replace
from os import PathLike
from typing import Any, Literal, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import Array, Flagged, as_array, described
from equipix.errors import InputError
from equipix.findings import Finding
from equipix.measured.colour import Colours
from equipix.measured.part import median
from equipix.measured.statistics import FrameStatistics, refuse_subtracted

Dark = Literal["stored"] | FrameStatistics | ArrayLike | None
"""A dark frame to subtract: that which is part of the correction, another, or none."""

_C = TypeVar("_C", bound="Correction")


@runtime_checkable
class Correction(Protocol):
    """The protocol of all corrections of a sensor, whatever method found them."""

    @property
    def shape(self) -> tuple[int, int]:
        """Sizes of the sensor (rows, cols)."""

    @property
    def flags(self) -> Array:
        """Bits of `Flag` per pixel, shape (rows, cols), uint32."""

    @property
    def coefficients(self) -> Array:
        """Coefficients c of the corrected frame Σ c_j y^j, shape (2 to 4, rows, cols).

        y is the raw frame in DN, and a stored dark is part of them. NaN in a pixel that the
        correction does not determine.
        """

    @property
    def metadata(self) -> dict[str, Any]:
        """Versions, options and origin, as JSON values."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What limits the result."""

    @property
    def dark(self) -> Array | None:
        """The dark frame in DN, shape (rows, cols), if one is part of the correction."""

    @property
    def takes_dark(self) -> bool:
        """Whether another dark frame, or none, can take the place of that stored.

        Such a correction is a dataclass, and `dark` one of its fields.
        """

    @property
    def needs_dark(self) -> bool:
        """Whether it is of frames less a dark frame, and stores none: `correct` asks for one."""

    @property
    def limits(self) -> Array | None:
        """Lowest and highest corrected value that was measured, shape (2, rows, cols), in DN.

        None where a correction has no range of levels.
        """

    @property
    def saturation(self) -> float | None:
        """Level of saturation of raw values in DN, where it is kept."""

    @property
    def bits(self) -> int:
        """Bits of the raw values, 0 where they are unknown."""

    @property
    def leaves_offset(self) -> bool:
        """Whether corrected frames keep an offset, as of raw levels, which no gain may multiply."""

    @property
    def colours(self) -> Colours | None:
        """Colour filters of the pixels, where they are known."""

    def correct(
        self,
        frames: ArrayLike,
        *,
        dark: Dark = "stored",
        flagged: Flagged = "nan",
        out: Array | None = None,
    ) -> Array:
        """Frames as a sensor of equal pixels would have given them.

        Of the frames' shape, (rows, cols) or (n, rows, cols); float64 for float64 frames, else
        float32; or in `out`. `flagged` determines the value of pixels flagged ``DO_NOT_USE``.
        """

    def save(self, path: str | PathLike[str], *, force: bool = False) -> None:
        """Write to a file that `equipix.load` reads; its suffix names the format."""


MEMBERS = tuple(name for name in vars(Correction) if not name.startswith("_"))
"""Names of what every correction gives."""


def check_correction(name: str, given: object) -> None:
    """Refuse what is no correction, such as the name of its file."""
    # Of the class first: a property of the object may be costly.
    if all(hasattr(type(given), each) or hasattr(given, each) for each in MEMBERS):
        return
    raise InputError(
        f"'{name}' is {described(given)}, expected a correction: equipix.load(path), or the result "
        "of equipix.calibrate or equipix.nuc.fit"
    )


def sensor_table(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Return what metadata hold of the sensor."""
    sensor = metadata.get("sensor")
    return sensor if isinstance(sensor, dict) else {}


def sensor_of(correction: Correction) -> str:
    """Return the name of the sensor in the metadata; empty where there is none."""
    return str(sensor_table(correction.metadata).get("name", ""))


def named_cfa(correction: Correction, cfa: ArrayLike | None) -> Colours | None:
    """Return the colour filters of a correction, or `cfa`, which must be no others.

    Raises
    ------
    InputError
        If `cfa` is no pattern, or another than that of the correction.
    """
    own, given = correction.colours, Colours.of(cfa)
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


def is_stored(dark: Dark) -> bool:
    """Whether a dark is the word "stored"; another word is refused."""
    if isinstance(dark, str) and dark != "stored":
        raise InputError(f"'dark' is {dark!r}, expected 'stored', an array or None")
    return isinstance(dark, str)


def refuse_dark(correction: Correction, dark: Dark) -> None:
    """Refuse another dark than "stored" where a correction takes none."""
    if not correction.takes_dark:
        raise InputError(
            f"'dark' is {described(dark)}, but the offsets of this correction are part of it and "
            "no dark frame can replace them: expected 'stored'"
        )


def with_dark(correction: _C, dark: Dark) -> _C:
    """Return a correction with this dark frame in place of that stored."""
    if is_stored(dark):
        if correction.needs_dark:
            raise InputError(
                "'dark' is 'stored', but this calibration holds no dark frame: give one. None is "
                "for frames from which it is subtracted already"
            )
        return correction
    refuse_dark(correction, dark)
    if dark is not None and correction.leaves_offset:
        raise InputError(
            "'dark' is given, but the offsets of this response are part of its curves: it was "
            "fitted to levels from which no dark was subtracted"
        )
    offset = None if dark is None else _dark_frame(dark, correction.shape)
    if offset is correction.dark:
        return correction
    changed: Any = correction
    made: _C = replace(changed, dark=offset)
    return made


def _dark_frame(dark: FrameStatistics | ArrayLike, shape: tuple[int, ...]) -> Array:
    """Check a dark frame that is to be subtracted; of averages it is the mean."""
    if isinstance(dark, FrameStatistics):
        refuse_subtracted(dark)
        dark = dark.mean
    offset = as_array("dark", dark, ndim=2)
    if offset.shape != shape:
        raise InputError(f"'dark' has shape {offset.shape}, the sensor {shape}")
    return offset


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
        if dtype.kind == "u" and 8 * dtype.itemsize < self.bits - 1:
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


def depth_of(correction: Correction) -> Depth:
    """Return the bits of raw values, with what shows that frames are in another unit."""
    dark = 0.0
    if correction.dark is not None:
        dark = float(np.nan_to_num(median(correction.dark)))
    elif correction.leaves_offset and correction.limits is not None:
        dark = float(np.nan_to_num(np.fmin.reduce(correction.limits[0], axis=None)))
    return Depth(correction.bits, correction.saturation is not None, dark)

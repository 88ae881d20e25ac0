"""The protocol of all corrections of a sensor, whatever method found them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

from equipix._check import described
from equipix.colour import Colours
from equipix.errors import InputError

if TYPE_CHECKING:
    from os import PathLike
    from typing import TypeGuard

    from numpy.typing import ArrayLike, NDArray

    from equipix._types import Flagged
    from equipix.frames import FrameStatistics


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

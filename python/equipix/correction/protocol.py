"""What every correction of a sensor has in common, whatever method found it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

if TYPE_CHECKING:
    from os import PathLike

    from numpy.typing import ArrayLike, NDArray

    from equipix._types import Flagged
    from equipix.frames import FrameStatistics


@runtime_checkable
class Correction(Protocol):
    """What every correction of a sensor has in common, whatever method found it."""

    @property
    def shape(self) -> tuple[int, int]:
        """Sizes of the sensor (rows, cols)."""

    @property
    def flags(self) -> NDArray[Any]:
        """Bits of `Flag` per pixel, shape (rows, cols), uint32."""

    @property
    def metadata(self) -> dict[str, Any]:
        """Versions, options and origin, as JSON values."""

    def correct(
        self,
        frames: ArrayLike,
        *,
        dark: Literal["stored"] | FrameStatistics | ArrayLike | None = "stored",
        flagged: Flagged = "nan",
        out: NDArray[Any] | None = None,
    ) -> NDArray[Any]:
        """Frames as a sensor of equal pixels would have given them."""

    def save(self, path: str | PathLike[str]) -> None:
        """Write to a file whose suffix names the format."""

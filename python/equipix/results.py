"""What the package's functions return and share: pixel flags, averaged frames, corrections."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

if TYPE_CHECKING:
    from os import PathLike

    from numpy.typing import ArrayLike, NDArray


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


@dataclass(frozen=True, eq=False)
class FrameStatistics:
    """Mean and scatter of repeated frames of one scene.

    Attributes
    ----------
    mean : ndarray, shape (rows, cols), float64
        Mean of the frames, the dark mean subtracted if there was one, in DN.
    variance : ndarray, shape (rows, cols), float64
        Unbiased sample variance of one frame, in DN²; NaN where fewer than two samples count.
    variance_of_mean : ndarray, shape (rows, cols), float64
        Variance of `mean`, in DN²: ``variance / count``, plus that of the dark mean.
    count : ndarray, shape (rows, cols), uint32
        Number of samples that went into the mean.
    saturated : ndarray, shape (rows, cols), uint32
        Number of samples at or above the saturation level.
    """

    mean: NDArray[Any]
    variance: NDArray[Any]
    variance_of_mean: NDArray[Any]
    count: NDArray[Any]
    saturated: NDArray[Any]


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
        flagged: Literal["nan", "keep", "replace"] = "nan",
        out: NDArray[Any] | None = None,
    ) -> NDArray[Any]:
        """Frames as a sensor of equal pixels would have given them."""

    def save(self, path: str | PathLike[str]) -> None:
        """Write to a file whose suffix names the format."""

"""What other programs see of a result: one image, its uncertainty and its mask."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from equipix._check import Array, Bools
from equipix.findings import usable


@dataclass(frozen=True, eq=False)
class Viewed:
    """The image of a result that other programs show and divide by.

    Attributes
    ----------
    image : ndarray, shape (rows, cols)
        Sensitivity, gain or mean, finite everywhere.
    std : ndarray, shape (rows, cols), or None
        Its standard deviation, where it is known.
    mask : ndarray of bool, shape (rows, cols)
        Pixels that must not be used.
    unit : str
        Empty for a ratio.
    """

    image: Array
    std: Array | None
    mask: Bools
    unit: str = ""

    @classmethod
    def of(
        cls, image: Array, flags: Array, std: Array | None = None, *, nothing: float = 1.0
    ) -> Self:
        """Put `nothing` into pixels that must not be used, or have no value."""
        mask = ~usable(flags) | ~np.isfinite(image)
        filled = np.where(mask, image.dtype.type(nothing), image)
        known = None if std is None else np.where(mask | ~np.isfinite(std), std.dtype.type(0), std)
        return cls(filled, known, mask)

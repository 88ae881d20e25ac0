"""What other programs see of a result: one image, its uncertainty and its mask.

The only module that imports xarray.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np

from equipix._check import Array, Bools
from equipix.errors import EquipixError, InputError
from equipix.findings import Flag, mean_of_usable, usable

Use = Literal["flat", "gain"]
"""What other programs do with a map: divide by a flat, or multiply by a gain."""

_NAMES = {"flat": "sensitivity", "gain": "gain", "mean": "mean"}


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
    flags : ndarray, shape (rows, cols), uint32
        Bits of `equipix.Flag`.
    kind : {"flat", "gain", "mean"}
        A sensitivity to divide by, a gain to multiply by, or a mean of frames in DN.
    """

    image: Array
    std: Array | None
    mask: Bools
    flags: Array
    kind: Literal["flat", "gain", "mean"]

    @classmethod
    def of(
        cls,
        kind: Literal["flat", "gain", "mean"],
        image: Array,
        flags: Array,
        std: Array | None = None,
    ) -> Self:
        """Put 1, or 0 DN, into pixels that must not be used, or have no value."""
        mask = ~usable(flags) | ~np.isfinite(image)
        filled = np.where(mask, image.dtype.type(kind != "mean"), image)
        known = None if std is None else np.where(mask | ~np.isfinite(std), std.dtype.type(0), std)
        return cls(filled, known, mask, flags, kind)

    @property
    def name(self) -> str:
        """Name of the map."""
        return _NAMES[self.kind]

    @property
    def unit(self) -> str:
        """Unit in the words of FITS; empty for a ratio."""
        return "adu" if self.kind == "mean" else ""

    def exported(self, use: Use | None, *, mean_one: bool = False) -> Self:
        """Return the map for a use, or as it is; with `mean_one` of mean 1 over usable pixels.

        Raises
        ------
        InputError
            If there is no such use, or the map is a mean of frames.
        """
        if use not in (None, "flat", "gain"):
            raise InputError(f"'use' is {use!r}, expected 'flat', 'gain' or None")
        if self.kind == "mean" and (use or mean_one):
            raise InputError(
                "this result is a mean of frames, neither a flat nor a gain: leave out 'use' and "
                "'mean_one'"
            )
        found = self if use in (None, self.kind) else self._inverted(use)
        if not mean_one:
            return found
        mean = found.image.dtype.type(mean_of_usable(found.image.astype(float), found.mask))
        image = np.where(found.mask, found.image, found.image / mean)
        return replace(found, image=image, std=None if found.std is None else found.std / mean)

    def _inverted(self, use: Use) -> Self:
        one = self.image.dtype.type(1)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            inverse = np.where(self.mask, np.nan, one / self.image).astype(self.image.dtype)
            std = None if self.std is None else (self.std * inverse**2).astype(self.std.dtype)
        return self.of(use, inverse, self.flags, std)

    def dataset(self) -> Any:
        """Return a dataset of xarray; NaN where pixels must not be used."""
        try:
            import xarray
        except ImportError as error:
            raise EquipixError(
                "datasets need xarray, which is not installed: pip install 'equipix[xarray]'"
            ) from error
        units = {"units": "DN" if self.kind == "mean" else "1"}
        maps = {self.name: self.image, "std": self.std}
        axes = ("row", "col")
        found = {
            name: (axes, np.where(self.mask, np.nan, each).astype(each.dtype), units)
            for name, each in maps.items()
            if each is not None
        }
        bits = {
            "flag_masks": np.array([*Flag], np.uint32),
            "flag_meanings": " ".join(str(flag.name).lower() for flag in Flag),
        }
        return xarray.Dataset({**found, "flags": (axes, self.flags, bits)})

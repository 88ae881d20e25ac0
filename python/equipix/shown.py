"""What can be looked at: results that draw themselves, and show themselves in notebooks."""

from dataclasses import fields
from importlib import import_module
from typing import Any

import numpy as np

from equipix.errors import EquipixError, InputError

_LONGEST = 100
"""Characters of a short form, from which on fields are left out."""

_WORD = 40
"""Characters of a text in it."""


class Brief:
    """Base of dataclasses whose ``__repr__`` is a short form, unless they have one of their own."""

    __slots__ = ()

    def __init_subclass__(cls, **options: Any) -> None:
        """Set it before the decorator of dataclasses does."""
        super().__init_subclass__(**options)
        if "__repr__" not in vars(cls):
            cls.__repr__ = _short  # type: ignore[method-assign]


def _short(self: Any) -> str:
    """Names and values of the first fields, in a line."""
    text = f"<{type(self).__name__}"
    for number, each in enumerate(fields(self)):
        more = f"{',' if number else ':'} {each.name} {_brief(getattr(self, each.name))}"
        if len(text) + len(more) > _LONGEST:
            return f"{text}, …>"
        text += more
    return f"{text}>"


def _brief(value: Any) -> str:
    """A value in few characters: at most four digits, the shape of an array, else its type."""
    match value:
        case bool() | int() | None:
            return str(value)
        case float():
            return f"{value:.4g}"
        case np.ndarray():
            return f"of shape {value.shape}"
        case str():
            return repr(value if len(value) <= _WORD else f"{value[: _WORD - 1]}…")
        case tuple() if all(isinstance(item, int | float) for item in value):
            return f"({', '.join(map(_brief, value))})"
    return type(value).__name__


class Shown:
    """Base of results that can be looked at, and passed on to other libraries.

    Reports stand above all results, so they are imported where one is drawn.
    """

    __slots__ = ()

    def plot(self) -> Any:
        """Draw the maps of this result, its flags, and curves of them.

        Returns
        -------
        matplotlib.figure.Figure
            ``figure.savefig(path)`` writes it; a notebook shows it.

        Raises
        ------
        EquipixError
            If matplotlib is not installed.
        """
        return import_module("equipix.report.drawing").draw_result(self)

    def to_ccddata(self, *, use: str | None = None, mean_one: bool = False) -> Any:
        """Return the map of this result for astropy.

        Parameters
        ----------
        use : {"flat", "gain"}, optional
            A flat to divide frames by, or a gain to multiply them by; what the result is unless
            given.
        mean_one : bool
            Whether the map is scaled to mean 1 over the usable pixels.

        Returns
        -------
        astropy.nddata.CCDData
            The map with its mask and, where it is known, its standard deviation; 1 in pixels that
            must not be used.

        Raises
        ------
        InputError
            If the result has no map for this use.
        EquipixError
            If astropy is not installed.
        """
        return import_module("equipix.io.fits").ccddata(self._exported(use, mean_one))

    def to_xarray(self, *, use: str | None = None, mean_one: bool = False) -> Any:
        """Return the map of this result as a dataset of xarray.

        Parameters
        ----------
        use : {"flat", "gain"}, optional
            A flat to divide frames by, or a gain to multiply them by; what the result is unless
            given.
        mean_one : bool
            Whether the map is scaled to mean 1 over the usable pixels.

        Returns
        -------
        xarray.Dataset
            ``sensitivity``, ``gain`` or ``mean``, ``std`` where it is known, and ``flags``, along
            ``row`` and ``col``; NaN in pixels that must not be used.

        Raises
        ------
        InputError
            If the result has no map for this use.
        EquipixError
            If xarray is not installed.
        """
        return self._exported(use, mean_one).dataset()

    def viewed(self) -> Any:
        """Return what other programs show of a file; None without a map that is meant for them."""
        return None

    def _exported(self, use: str | None, mean_one: bool) -> Any:
        found = self.viewed()
        if found is None:
            raise InputError("this result has no map for other programs; its correction() has one")
        return found.exported(use, mean_one=mean_one)

    def _repr_html_(self) -> str | None:
        """Small map, main figures and findings, for notebooks; None without the libraries."""
        try:
            return str(import_module("equipix.report.page").cell(self))
        except EquipixError:
            return None

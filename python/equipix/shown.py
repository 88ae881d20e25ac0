"""What can be looked at: results that draw themselves, and show themselves in notebooks."""

from importlib import import_module
from typing import Any

from equipix.errors import EquipixError, InputError


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

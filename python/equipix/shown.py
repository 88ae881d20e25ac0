"""What can be looked at: results that draw themselves, and show themselves in notebooks."""

from importlib import import_module
from typing import Any

from equipix.errors import EquipixError


class Shown:
    """Base of results that can be looked at.

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

    def _repr_html_(self) -> str | None:
        """Small map, main figures and findings, for notebooks; None without the libraries."""
        try:
            return str(import_module("equipix.report.page").cell(self))
        except EquipixError:
            return None

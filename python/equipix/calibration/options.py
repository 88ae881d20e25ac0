"""Options of a calibration, and which of them exclude each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from equipix.errors import InputError

if TYPE_CHECKING:
    from equipix.exposures.exposures import Exposures
    from equipix.exposures.options import FitOptions

_FEWEST_FOR_REJECTION = 3
"""Fewest exposures: with two, no residual shows which of two measurements is wrong."""


@dataclass(frozen=True)
class Options:
    """How a calibration is made.

    Attributes
    ----------
    fit : FitOptions
        How each fit is made.
    robust : bool
        Whether to leave out measurements that disagree with the others.
    uncertainty : bool
        Whether to find standard deviations.
    """

    fit: FitOptions
    robust: bool = False
    uncertainty: bool = False

    def __post_init__(self) -> None:
        """Refuse values that are not bool."""
        for name in ("robust", "uncertainty"):
            if not isinstance(getattr(self, name), bool):
                raise InputError(f"'{name}' is {getattr(self, name)!r}, expected True or False")

    def check(self, exposures: Exposures) -> None:
        """Refuse options that these exposures exclude."""
        if exposures.offset and exposures.noise:
            raise InputError(
                "'dark' is 'fit', but the noise model, that of averages or of 'variance', expects "
                "the signal alone: subtract a dark, or give 'variance' as numbers"
            )
        if exposures.offset and self.robust:
            raise InputError(
                "'dark' is 'fit', but 'robust' expects the signal alone: subtract a dark, or leave "
                "'robust' out"
            )
        if self.robust and len(exposures) < _FEWEST_FOR_REJECTION:
            raise InputError(
                f"'robust' is True with {len(exposures)} exposures, expected at least "
                f"{_FEWEST_FOR_REJECTION}: with fewer no residual shows which measurement is false"
            )


def is_to_be_fitted(dark: object) -> bool:
    """Whether the dark is an unknown of the fit; refuses other values."""
    if dark is None or isinstance(dark, bool):
        raise InputError(f"'dark' is {dark!r}, expected 'subtracted' or 'fit'")
    if not isinstance(dark, str):
        raise InputError(
            "'dark' holds values: subtract it from the frames, or give it to equipix.average"
        )
    if dark not in ("subtracted", "fit"):
        raise InputError(f"'dark' is {dark!r}, expected 'subtracted' or 'fit'")
    return dark == "fit"

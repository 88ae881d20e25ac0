"""Errors and warnings: everything that equipix raises is one of these."""

__all__ = [
    "ConvergenceWarning",
    "EquipixError",
    "EquipixWarning",
    "FileError",
    "IdentifiabilityWarning",
    "InputError",
    "InputWarning",
    "InsufficientMemoryError",
    "MisfitWarning",
    "SpotError",
]
__dir__ = __all__.copy


class EquipixError(Exception):
    """Base class of all errors of this package."""


class InputError(EquipixError, ValueError):
    """An argument is invalid; the message contains its name, its value and the remedy."""


class SpotError(InputError):
    """A spot is missing, cut by the edge, doubled or saturated."""


class FileError(EquipixError, OSError):
    """A file cannot be read or written, or holds something else; the message names it."""


class UnsupportedFileError(FileError):
    """A file is of a kind that the compiled part does not decode, though tifffile may."""


class InsufficientMemoryError(EquipixError, MemoryError):
    """Not enough memory for the work; the message contains the number of bytes."""


class EquipixWarning(UserWarning):
    """Base class of all warnings of this package.

    Attributes
    ----------
    kind : str
        The kind of the finding that it tells.
    """

    kind: str = ""


class ConvergenceWarning(EquipixWarning):
    """A solver stopped before it reached the tolerance."""


class IdentifiabilityWarning(EquipixWarning):
    """The measurements do not determine all that was asked for."""


class InputWarning(EquipixWarning):
    """What was given saturates, was corrected before, has no dark, or is not used."""


class MisfitWarning(EquipixWarning):
    """The data contradict the model: residuals, shifts, fluxes, the dark or the curves."""

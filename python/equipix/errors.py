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
    """Base class of all errors of this package.

    Attributes
    ----------
    code : str
        Kind of the error for programs: "failed", "input", "file" or "memory".
    """

    code: str = "failed"


class InputError(EquipixError, ValueError):
    """An argument is invalid; the message contains its name, its value and the remedy."""

    code = "input"


class SpotError(InputError):
    """A spot is missing, cut by the edge, doubled or saturated."""


_REMEDIES = {
    "is truncated": "copy it again, or record it again",
    "signature not found": "use a file of the format that its name says",
    "one grey channel": "record grey, or write a stack by tifffile with photometric='minisblack'",
}
"""What to do about a file, by the last words of what its reader says."""


class FileError(EquipixError, OSError):
    """A file cannot be read or written, or holds something else; the message names it."""

    code = "file"

    def __str__(self) -> str:
        """Return the message, with a remedy where the reader of the file gave none."""
        said = super().__str__()
        return ": ".join([said, *(_REMEDIES[end] for end in _REMEDIES if said.endswith(end))])


class UnsupportedFileError(FileError):
    """A file is of a kind that the compiled part does not decode, though tifffile may."""


class InsufficientMemoryError(EquipixError, MemoryError):
    """Not enough memory for the work; the message contains the number of bytes."""

    code = "memory"


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

"""Options of a fit."""

from dataclasses import dataclass
from typing import Self, get_args

from equipix import _native
from equipix._check import (
    Method,
    Progress,
    as_tolerance,
    check_progress,
    positive_count,
    positive_workers,
)
from equipix.errors import InputError


@dataclass(frozen=True)
class FitOptions:
    """How to minimise the objective, and how far.

    Attributes
    ----------
    method : {"multiscale", "coordinate-descent"}
        The solver at shifts that differ by whole pixels.
    tolerance : float
        Largest relative error of the sensitivity at which the solver stops.
    max_sweeps : int or None
        Upper limit on passes over the data or its weights.
    workers : int or None
        Number of threads; None: as many as processors may be used.
    progress : callable or None
        Called as ``progress(done, total, stage)`` repeatedly.
    """

    method: Method = "multiscale"
    tolerance: float = 1e-6
    max_sweeps: int | None = None
    workers: int | None = None
    progress: Progress | None = None

    @property
    def whole_shifts(self) -> bool:
        """Whether the method takes shifts alone that differ by whole pixels: the core decides."""
        return _native.needs_whole_shifts(self.method)

    @classmethod
    def of(
        cls,
        method: Method,
        tolerance: float,
        max_sweeps: int | None,
        workers: int | None,
        progress: Progress | None,
    ) -> Self:
        """Check what the caller gave."""
        if method not in get_args(Method):
            raise InputError(f"'method' is {method!r}, expected one of {get_args(Method)}")
        check_progress(progress)
        return cls(
            method=method,
            tolerance=as_tolerance(tolerance),
            max_sweeps=None if max_sweeps is None else positive_count("max_sweeps", max_sweeps),
            workers=positive_workers(workers),
            progress=progress,
        )

"""The compiled part of equipix: private; the docs stand in the Python modules that wrap it."""

from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, Protocol, TypeAlias, final

from numpy.typing import NDArray

__all__ = [
    "Accumulator",
    "Solution",
    "__version__",
    "average_files",
    "calibrate_frames",
    "error_map",
    "file_format",
    "functional_variances",
    "locate_spots",
    "offset_variances",
    "planned_components",
    "read_file",
    "shift_variances",
]

_Spot: TypeAlias = tuple[list[float], list[float]]
_Statistics: TypeAlias = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]

__version__: str

@final
class Accumulator:
    def __new__(
        cls,
        dtype: str,
        shape: tuple[int, int],
        saturation: float | None,
        workers: int | None,
    ) -> Accumulator: ...
    def add(self, frames: NDArray[Any]) -> None: ...
    def finish(self) -> _Statistics: ...

def average_files(
    paths: Sequence[str | PathLike[str]],
    saturation: float | None,
    workers: int | None,
    progress: Callable[[int, int, str], object] | None,
) -> _Statistics: ...
def file_format(path: str | PathLike[str]) -> tuple[int, int, int, int]: ...
def read_file(path: str | PathLike[str], workers: int | None) -> NDArray[Any]: ...

@final
class Solution:
    @property
    def sensitivity(self) -> NDArray[Any]: ...
    @property
    def beam(self) -> NDArray[Any]: ...
    @property
    def coefficients(self) -> NDArray[Any] | None: ...
    @property
    def beam_origin(self) -> tuple[int, int]: ...
    @property
    def flags(self) -> NDArray[Any]: ...
    @property
    def flux(self) -> list[float]: ...
    @property
    def shifts(self) -> list[list[float]] | None: ...
    @property
    def offset(self) -> NDArray[Any] | None: ...
    @property
    def leaves_tilt(self) -> bool: ...
    @property
    def refinement(self) -> str: ...
    @property
    def smallest_ritz(self) -> float | None: ...
    @property
    def misfit(self) -> float: ...
    @property
    def component_labels(self) -> NDArray[Any]: ...
    @property
    def components(self) -> int: ...
    @property
    def objective(self) -> NDArray[Any]: ...
    @property
    def sweeps(self) -> NDArray[Any]: ...
    @property
    def error_estimate(self) -> NDArray[Any]: ...
    @property
    def ended(self) -> str: ...
    @property
    def degrees_of_freedom(self) -> int: ...

def calibrate_frames(
    frames: NDArray[Any],
    shifts: NDArray[Any],
    *,
    shift_std: NDArray[Any] | None,
    rotation: list[int],
    flux: list[float],
    flux_model: tuple[str, list[float]],
    offset: bool,
    variance: NDArray[Any] | None,
    mask: NDArray[Any] | None,
    method: str,
    tolerance: float,
    max_sweeps: int | None,
    workers: int | None,
    progress: Callable[[int, int, str], object] | None,
) -> Solution: ...

class _JointFit(Protocol):
    """Attributes that are read of a joint fit."""

    @property
    def measured(self) -> NDArray[Any]: ...
    @property
    def shift_std(self) -> NDArray[Any] | None: ...
    @property
    def flux_model(self) -> tuple[str, list[float]]: ...
    @property
    def offset(self) -> bool: ...
    @property
    def shifts(self) -> NDArray[Any]: ...
    @property
    def refined(self) -> bool: ...
    @property
    def unit(self) -> float: ...

class _Measurements(Protocol):
    """Attributes that are read of the measurements behind a calibration."""

    @property
    def frames(self) -> NDArray[Any]: ...
    @property
    def shifts(self) -> NDArray[Any]: ...
    @property
    def rotation(self) -> list[int]: ...
    @property
    def flux(self) -> list[float]: ...
    @property
    def variance(self) -> NDArray[Any] | None: ...
    @property
    def mask(self) -> NDArray[Any] | None: ...
    @property
    def joint(self) -> _JointFit | None: ...

def error_map(
    measurements: _Measurements,
    sensitivity: NDArray[Any],
    beam: NDArray[Any],
    *,
    workers: int | None,
    progress: Callable[[int, int, str], object] | None,
) -> tuple[NDArray[Any], int, float]: ...
def functional_variances(
    measurements: _Measurements,
    sensitivity: NDArray[Any],
    beam: NDArray[Any],
    *,
    functionals: NDArray[Any],
    workers: int | None,
    progress: Callable[[int, int, str], object] | None,
) -> NDArray[Any]: ...
def shift_variances(
    measurements: _Measurements,
    sensitivity: NDArray[Any],
    beam: NDArray[Any],
    *,
    workers: int | None,
    progress: Callable[[int, int, str], object] | None,
) -> list[list[float]]: ...
def offset_variances(
    measurements: _Measurements,
    sensitivity: NDArray[Any],
    beam: NDArray[Any],
    *,
    workers: int | None,
    progress: Callable[[int, int, str], object] | None,
) -> list[float]: ...
def locate_spots(
    before: NDArray[Any],
    after: NDArray[Any],
    saturations: tuple[float | None, float | None],
) -> tuple[_Spot, _Spot]: ...
def planned_components(
    shape: tuple[int, int],
    shifts: NDArray[Any],
    *,
    rotation: list[int],
    mask: NDArray[Any] | None,
) -> tuple[NDArray[Any], list[int], int]: ...

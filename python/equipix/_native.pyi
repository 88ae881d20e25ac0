"""The compiled part of equipix: private; the docs stand in the Python modules that wrap it."""

from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, TypeAlias, final

from numpy.typing import NDArray

__all__ = [
    "Accumulator",
    "Beam",
    "Corrector",
    "Exposures",
    "Fit",
    "SceneCorrection",
    "Start",
    "Uncertainty",
    "__version__",
    "adapt_words",
    "apply_words",
    "average_files",
    "common_fraction",
    "exposure_s",
    "file_format",
    "fit_response",
    "locate_spots",
    "needs_whole_shifts",
    "planned_components",
    "read_file",
    "slope_pixels",
]

_Spot: TypeAlias = tuple[list[float], list[float]]
_Progress: TypeAlias = Callable[[int, int, str], object]
_Statistics: TypeAlias = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], float]

__version__: str

@final
class Accumulator:
    def __new__(
        cls,
        dtype: str,
        shape: tuple[int, int],
        saturation: float | None,
        mask: NDArray[Any] | None,
        workers: int | None,
    ) -> Accumulator: ...
    def add(self, frames: NDArray[Any]) -> None: ...
    def merge(self, other: Accumulator) -> None: ...
    def state(self) -> NDArray[Any]: ...
    def restore(self, state: NDArray[Any]) -> None: ...
    def finish(self) -> _Statistics: ...

def adapt_words(
    frames: NDArray[Any],
    gain: NDArray[Any],
    offset: NDArray[Any],
    out: NDArray[Any],
    widths: Sequence[int],
    step: int,
    *,
    workers: int | None,
) -> None: ...
def apply_words(
    frames: NDArray[Any],
    gain: NDArray[Any],
    offset: NDArray[Any],
    out: NDArray[Any],
    arithmetic: tuple[int, int, int, int, int, int, int],
    *,
    workers: int | None,
) -> tuple[int, int]: ...
def average_files(
    paths: Sequence[str | PathLike[str]],
    saturation: float | None,
    mask: NDArray[Any] | None,
    workers: int | None,
    progress: _Progress | None,
) -> _Statistics: ...
def exposure_s(path: str | PathLike[str]) -> float | None: ...
def file_format(path: str | PathLike[str]) -> tuple[int, int, int, int]: ...
def read_file(path: str | PathLike[str], workers: int | None) -> NDArray[Any]: ...

@final
class Corrector:
    """A correction prepared for many frames; it keeps a copy of the coefficients.

    With coefficients of float32 it takes and gives uint8, uint16 and float32, of float64 float64.
    """

    def __new__(
        cls,
        coefficients: NDArray[Any],
        unusable: NDArray[Any],
        flagged: str,
        levels: NDArray[Any] | None,
        colours: NDArray[Any] | None,
        reach: int,
    ) -> Corrector: ...
    def apply(
        self,
        frames: NDArray[Any],
        out: NDArray[Any],
        largest: float,
        *,
        workers: int | None,
    ) -> tuple[int, int, float]: ...

@final
class Exposures:
    """Mean frames of one beam, checked once; it keeps references to the arrays."""

    def __new__(
        cls,
        frames: NDArray[Any],
        shifts: NDArray[Any],
        *,
        shift_std: NDArray[Any] | None,
        rotation: list[int],
        flux: list[float],
        flux_model: tuple[str, list[float]],
        offset: bool,
        variance: NDArray[Any] | None,
        is_relative: bool,
        mask: NDArray[Any] | None,
        unreliable: NDArray[Any] | None,
        workers: int | None,
        progress: _Progress | None,
    ) -> Exposures: ...
    def fit(
        self,
        *,
        method: str,
        tolerance: float,
        max_sweeps: int | None,
        start: Start | None,
        workers: int | None,
        progress: _Progress | None,
    ) -> Fit: ...

@final
class Beam:
    """The beam on its grid; a spline if there are coefficients. NaN where it was not seen.

    `tilt` is the slope of ln L that the gauge put into the coefficients: it goes into files too.
    """

    def __new__(
        cls,
        values: NDArray[Any],
        coefficients: NDArray[Any] | None,
        origin: tuple[float, float],
        *,
        tilt: tuple[float, float] | list[float] = ...,
    ) -> Beam: ...
    @property
    def values(self) -> NDArray[Any]: ...
    @property
    def coefficients(self) -> NDArray[Any] | None: ...
    @property
    def origin(self) -> tuple[float, float]: ...
    @property
    def tilt(self) -> list[float]: ...
    def light(
        self,
        shape: tuple[int, int],
        shift: tuple[float, float],
        rotation: int,
        *,
        workers: int | None,
    ) -> NDArray[Any]: ...

@final
class Start:
    """Initial state of a fit, which consumes it."""

@final
class Fit:
    """What was found. `refinement` is "none", "not tried", "undetermined" or "refined"."""

    @property
    def sensitivity(self) -> NDArray[Any]: ...
    @property
    def beam(self) -> Beam: ...
    @property
    def flags(self) -> NDArray[Any]: ...
    @property
    def component_labels(self) -> NDArray[Any]: ...
    @property
    def components(self) -> int: ...
    @property
    def flux(self) -> list[float]: ...
    @property
    def shifts(self) -> list[list[float]]: ...
    @property
    def offset(self) -> NDArray[Any] | None: ...
    @property
    def sweeps(self) -> NDArray[Any]: ...
    @property
    def objective(self) -> NDArray[Any]: ...
    @property
    def error_estimate(self) -> NDArray[Any]: ...
    @property
    def ended(self) -> str: ...
    @property
    def misfit(self) -> float: ...
    @property
    def degrees_of_freedom(self) -> int: ...
    @property
    def unit(self) -> float: ...
    @property
    def smallest_ritz(self) -> float | None: ...
    @property
    def few(self) -> NDArray[Any] | None: ...
    @property
    def lost(self) -> list[NDArray[Any]]: ...
    @property
    def prior(self) -> NDArray[Any] | None: ...
    @property
    def leaves_tilt(self) -> bool: ...
    @property
    def refinement(self) -> str: ...
    @property
    def is_joint(self) -> bool: ...
    def start(self) -> Start: ...
    def information(self, *, workers: int | None) -> NDArray[Any]: ...
    def dark_misfit(self, dark_variance: NDArray[Any], *, workers: int | None) -> float: ...
    def uncertainty(
        self,
        *,
        error_map: bool,
        functionals: NDArray[Any] | None,
        shifts: bool,
        offset: bool,
        workers: int | None,
        progress: _Progress | None,
        dark_variance: NDArray[Any] | None = None,
    ) -> Uncertainty: ...

@final
class Uncertainty:
    """Answers in units of the variance of a value of weight 1, which is the fit's `unit`."""

    @property
    def std(self) -> NDArray[Any] | None: ...
    @property
    def draws(self) -> int: ...
    @property
    def exactness(self) -> float: ...
    @property
    def variances(self) -> NDArray[Any] | None: ...
    @property
    def shift_variances(self) -> list[list[float]] | None: ...
    @property
    def offset_variances(self) -> tuple[float, float] | None: ...
    @property
    def incomplete(self) -> int: ...

def fit_response(
    means: NDArray[Any],
    references: list[float],
    *,
    form: str,
    noise: Sequence[tuple[float, float, float]] | None,
    workers: int | None,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]: ...
def locate_spots(
    before: NDArray[Any],
    after: NDArray[Any],
    saturations: tuple[float | None, float | None],
) -> tuple[_Spot, _Spot]: ...
def common_fraction(shifts: NDArray[Any]) -> list[float] | None: ...
def needs_whole_shifts(method: str) -> bool: ...
def planned_components(
    shape: tuple[int, int],
    shifts: NDArray[Any],
    *,
    rotation: list[int],
    mask: NDArray[Any] | None,
) -> tuple[NDArray[Any], list[int], int]: ...
def slope_pixels(sensitivity: NDArray[Any], flags: NDArray[Any]) -> NDArray[Any]: ...

@final
class SceneCorrection:
    """Gain and offset from the scene; it keeps the state of its method."""

    @staticmethod
    def local_mean(
        shape: tuple[int, int], data_range: tuple[float, float], step: float, kernel: NDArray[Any]
    ) -> SceneCorrection: ...
    @staticmethod
    def gated(
        shape: tuple[int, int],
        data_range: tuple[float, float],
        step: float,
        width: int,
        threshold: float,
        texture: float,
    ) -> SceneCorrection: ...
    @staticmethod
    def registered(
        shape: tuple[int, int],
        data_range: tuple[float, float],
        step: float,
        least_motion: float,
        most_motion: int,
        cutoff: float,
        agreement: float,
    ) -> SceneCorrection: ...
    @staticmethod
    def constant_statistics(
        shape: tuple[int, int],
        data_range: tuple[float, float],
        width: int,
        window: int,
        motion: float,
        prior: int,
    ) -> SceneCorrection: ...
    @staticmethod
    def kalman(
        shape: tuple[int, int],
        data_range: tuple[float, float],
        width: int,
        block: int,
        motion: float,
        gain_spread: float,
        offset_spread: float,
        memory: float,
    ) -> SceneCorrection: ...
    def update(
        self,
        frame: NDArray[Any],
        corrected: NDArray[Any],
        *,
        saturation: float | None,
        workers: int | None,
    ) -> bool: ...
    def frames(self) -> int: ...
    def taken(self) -> int: ...
    def foreign(self) -> int: ...
    def still(self) -> float | None: ...
    def floor(self, workers: int | None) -> float | None: ...
    def mask(self, mask: NDArray[Any]) -> None: ...
    def deviation(self) -> NDArray[Any]: ...
    def coefficients(self) -> tuple[NDArray[Any], NDArray[Any]]: ...
    def variances(self) -> tuple[NDArray[Any], NDArray[Any]] | None: ...
    def state(self) -> tuple[list[tuple[str, NDArray[Any]]], list[tuple[str, int]]]: ...
    def restore(
        self, maps: list[tuple[str, NDArray[Any]]], counts: list[tuple[str, int]]
    ) -> None: ...

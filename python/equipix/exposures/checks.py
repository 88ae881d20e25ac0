"""The measurements that a calibration is made from, checked and in the solver's shapes."""

from __future__ import annotations

import functools
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix._check import as_array, as_floats, check_count, number, per_exposure
from equipix._types import FluxModel
from equipix.drift import trend_told
from equipix.errors import IdentifiabilityWarning, InputError
from equipix.frames import FrameStatistics
from equipix.noise import NoiseModel, fit_frames, models_of_means

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray


_HARDLY_TOLD = 0.1
"""A share of a trend's variance that leaves its error three times larger."""

_WIDEST = 0.3
"""Standard deviation of a shift, in pixels: three are within the pixel that it may move."""


def as_statistics(frames: object) -> list[FrameStatistics]:
    """The frames as a list, if that is what they are; an empty one for arrays."""
    if not isinstance(frames, list | tuple):
        return []
    statistics = [each for each in frames if isinstance(each, FrameStatistics)]
    if statistics and len(statistics) != len(frames):
        raise InputError("'frames' mixes FrameStatistics and arrays, expected either")
    shapes = [each.mean.shape for each in statistics]
    if len(set(shapes)) > 1:
        raise InputError(f"'frames' holds means of shapes {shapes}, expected one shape")
    for k, each in enumerate(statistics):
        if each.saturated.all():
            raise InputError(
                f"'frames': every pixel of exposure {k} saturates: expose less, or correct the "
                "'saturation' that they were averaged with"
            )
    return statistics


def as_values(frames: ArrayLike, statistics: list[FrameStatistics]) -> NDArray[Any]:
    """Frames as (n, rows, cols); NaN, which counts as masked, where averaged samples saturated."""
    if statistics:
        frames = np.stack([np.where(f.saturated > 0, np.nan, f.mean) for f in statistics])
    values = as_floats("frames", frames, ndim=3)
    if 0 in values.shape:
        raise InputError(
            f"'frames' has shape {values.shape}, expected at least one exposure and one pixel"
        )
    return values


def as_rotation(rotation: ArrayLike | None, count: int) -> NDArray[np.int64]:
    """Rotation of each exposure, in degrees; 0 unless given."""
    turns = per_exposure("rotation", rotation, count, default=0)
    if not np.all(np.isin(turns, (0, 90, 180, 270))):
        raise InputError(f"'rotation' is {turns.tolist()}, expected 0, 90, 180 or 270 degrees")
    return turns.astype(np.int64)


def as_models(
    variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None,
    statistics: list[FrameStatistics],
    count: int,
) -> list[NoiseModel]:
    """Noise model of each of the values given; none if variances are given as numbers, or not."""
    if variance is None and statistics:
        variance = fit_frames(statistics)
    if isinstance(variance, NoiseModel):
        return models_of_means(statistics, variance) if statistics else [variance] * count
    if not isinstance(variance, list | tuple):
        return []
    models = [each for each in variance if isinstance(each, NoiseModel)]
    if models:
        if len(models) != len(variance):
            raise InputError("'variance' mixes noise models and numbers, expected either")
        check_count("variance", len(models), count)
    return models


def as_saturated(
    saturation: float | None, values: NDArray[Any], statistics: list[FrameStatistics]
) -> NDArray[np.bool_] | None:
    """Which values reach the level `saturation`."""
    if saturation is None:
        return None
    if statistics:
        raise InputError(
            "'saturation' is for arrays, but 'frames' are averages: their saturated samples are "
            "counted where equipix.average is given the level"
        )
    level = number("saturation", saturation)
    if not level > 0:
        raise InputError(f"'saturation' is {saturation!r}, expected a level above 0")
    saturated: NDArray[np.bool_] = values >= level
    for k, each in enumerate(saturated):
        if each.all():
            raise InputError(
                f"'frames': every pixel of exposure {k} reaches the 'saturation' level {level:g}: "
                "expose less, or correct the level"
            )
    return saturated


def as_variances(variance: ArrayLike, values: NDArray[Any]) -> NDArray[Any]:
    """Variances in the shape and dtype that the solver takes."""
    variances = as_array("variance", variance, ndim=(1, 3))
    if variances.ndim == 1:
        check_count("variance", len(variances), len(values))
        return variances.astype(np.float64)
    if variances.shape != values.shape:
        raise InputError(f"'variance' has shape {variances.shape}, expected {values.shape}")
    with np.errstate(over="ignore"):  # the solver refuses what becomes infinite
        return variances.astype(values.dtype, copy=False)


def union(*masks: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """Mask of what any of several masks, of one exposure or of all, hides."""
    given = [mask for mask in masks if mask is not None]
    return functools.reduce(np.logical_or, given) if given else None


def as_mask(mask: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Mask of one exposure or of all, of frames of that shape."""
    array = as_array("mask", mask, ndim=(2, 3))
    if array.dtype != np.bool_:
        raise InputError(f"'mask' has dtype {array.dtype}, expected bool: True = do not use")
    if array.shape not in (shape[1:], shape):
        raise InputError(f"'mask' has shape {array.shape}, expected {shape[1:]} or {shape}")
    return array


def as_flux(
    flux: ArrayLike | FluxModel | None,
    flux_std: ArrayLike | None,
    time: ArrayLike | None,
    count: int,
) -> tuple[NDArray[np.float64], tuple[str, list[float]]]:
    """Fluxes, and how the solver is to take them: its kind, with standard deviations or times."""
    if isinstance(flux, str):
        if flux not in ("fit", "linear"):
            raise InputError(f"'flux' is {flux!r}, expected numbers, 'fit' or 'linear'")
        if flux_std is not None:
            raise InputError(f"'flux_std' goes with fluxes that are given, but 'flux' is {flux!r}")
        if (time is None) == (flux == "linear"):
            raise InputError("'time' and flux='linear' go together: give both or neither")
        times = [] if time is None else per_exposure("time", time, count, default=0).tolist()
        if times and (not np.isfinite(times).all() or len(set(times)) < 2):
            raise InputError(f"'time' is {times}, expected seconds, not all the same")
        return np.ones(count), (flux, times)
    if time is not None:
        raise InputError("'time' is given but 'flux' is not 'linear'")
    values = per_exposure("flux", flux, count, default=1)
    if flux_std is None:
        return values, ("known", [])
    array = as_array("flux_std", flux_std, ndim=(0, 1))
    if array.size != 1:
        check_count("flux_std", len(array), count)
    std = np.broadcast_to(array.ravel(), count).astype(np.float64)
    if not (np.isfinite(std).all() and (std > 0).all()):
        raise InputError(f"'flux_std' is {std.tolist()}, expected positive numbers")
    return values, ("prior", std.tolist())


def moves(shifts: NDArray[Any], rotation: NDArray[Any], shape: tuple[int, ...]) -> bool:
    """Whether exposures differ by more than turns that go round among four pixels."""
    rows, cols = shape
    return bool(np.ptp(shifts, axis=0).any()) or (rows != cols and len(set(rotation % 180)) > 1)


def warn_of_order(
    flux_model: tuple[str, list[float]], shifts: NDArray[Any], rotation: NDArray[Any]
) -> None:
    """Warn where a drift linear in time looks much like a tilt, whose error then is large."""
    kind, values = flux_model
    if kind != "linear" or len(set(rotation.tolist())) > 1:
        return
    share = trend_told(shifts, np.array(values))
    if share < _HARDLY_TOLD:
        warnings.warn(
            f"of a drift linear in time only {share:.1%} of the variance can be told from a tilt "
            "of the sensitivity in this order of exposures: take another "
            "(equipix.plan.advise_order)",
            IdentifiabilityWarning,
            stacklevel=3,
        )


def as_shift_std(shift_std: ArrayLike, count: int) -> NDArray[np.float64]:
    """Standard deviations of the shifts, (n, 2)."""
    array = as_array("shift_std", shift_std, ndim=(0, 1, 2))
    if array.ndim == 1:
        array = array[:, np.newaxis]
    if array.size != 1 and array.shape not in ((count, 1), (count, 2)):
        raise InputError(
            f"'shift_std' has shape {array.shape}, expected ({count},) or ({count}, 2)"
        )
    std = np.array(np.broadcast_to(array, (count, 2)), dtype=np.float64)
    if not (np.isfinite(std).all() and (std >= 0).all() and std.any()):
        raise InputError(f"'shift_std' is {std.tolist()}, expected pixels, not negative, not all 0")
    if std.max() > _WIDEST:
        raise InputError(
            f"'shift_std' holds {std.max():g}, expected at most {_WIDEST}: shifts are refined "
            "within a pixel of where they were measured; measure them better"
        )
    return std


@dataclass(frozen=True)
class Asked:
    """What of a calibration was asked for, where not all goes with all."""

    method: str
    flux: str
    shifts_refined: bool
    shifts_whole: bool
    moves: bool
    dark: str
    one_level: bool
    modelled: bool
    robust: bool
    uncertainty: bool

    def check(self) -> None:
        """Refuse what does not go together."""
        if not isinstance(self.dark, str):
            raise InputError(
                "'dark' holds values: subtract it from the frames, or give it to equipix.average"
            )
        for name in ("robust", "uncertainty"):
            if not isinstance(getattr(self, name), bool):
                raise InputError(f"'{name}' is {getattr(self, name)!r}, expected True or False")
        if self.dark not in ("subtracted", "fit"):
            raise InputError(f"'dark' is {self.dark!r}, expected 'subtracted' or 'fit'")
        fitted = self.flux != "known" or self.dark == "fit"
        if self.method != "multiscale" and (fitted or self.shifts_refined):
            raise InputError(
                "'method' is 'coordinate-descent', which knows whole shifts and given fluxes: to "
                "fit fluxes, shifts or the dark take 'multiscale'"
            )
        if not self.moves and (fitted or self.shifts_refined or not self.shifts_whole):
            raise InputError(
                "'shifts' are all alike: each pixel sees one place of the beam, and nothing "
                "compares it with others; move the sensor between exposures"
            )
        if self.dark == "fit" and self.one_level:
            raise InputError(
                "'dark' is 'fit' with one flux for all: offset and gain cannot be told apart; "
                "take exposures at two or more levels and give their 'flux', or subtract a dark"
            )
        if self.dark == "fit" and (self.robust or self.modelled):
            raise InputError(
                "'dark' is 'fit', but 'robust' and noise models expect the signal alone: subtract "
                "a dark, or give variances as numbers and leave 'robust' out"
            )

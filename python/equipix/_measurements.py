"""The measurements that a calibration is made from, checked and in the solver's shapes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from equipix._arrays import as_array, as_floats, check_count, per_exposure
from equipix.errors import InputError
from equipix.results import FrameStatistics

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

FluxModel = Literal["fit", "linear"]


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
    if 0 in values.shape[1:]:
        raise InputError(f"'frames' has shape {values.shape}, expected at least one pixel")
    return values


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
    if array.size > 1:
        check_count("flux_std", len(array), count)
    std = np.broadcast_to(array.ravel(), count).astype(np.float64)
    if not (np.isfinite(std).all() and (std > 0).all()):
        raise InputError(f"'flux_std' is {std.tolist()}, expected positive numbers")
    return values, ("prior", std.tolist())


def as_shift_std(shift_std: ArrayLike, count: int) -> NDArray[np.float64]:
    """Standard deviations of the shifts, (n, 2)."""
    array = as_array("shift_std", shift_std, ndim=(0, 1, 2))
    if array.ndim == 1:
        array = array[:, np.newaxis]
    if array.size > 1 and array.shape not in ((count, 1), (count, 2)):
        raise InputError(f"'shift_std' has shape {array.shape}, expected ({count},) or ({count}, 2)")
    std = np.array(np.broadcast_to(array, (count, 2)), dtype=np.float64)
    if not (np.isfinite(std).all() and (std >= 0).all() and std.any()):
        raise InputError(f"'shift_std' is {std.tolist()}, expected pixels, not negative, not all 0")
    return std

"""The measurements that a calibration is made from, checked and in the solver's shapes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix._arrays import as_array, as_floats, check_count
from equipix.errors import InputError
from equipix.results import FrameStatistics

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


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

"""Frames of another bit depth than those that a correction was measured with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix._check import as_array
from equipix.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def refuse_other_depth(frames: ArrayLike, saturation: float | None) -> None:
    """Refuse values that a sensor that saturates at this level cannot have given."""
    if saturation is None or np.size(frames) == 0:
        return
    raw = as_array("frames", frames, ndim=(2, 3))
    refuse_above(float(np.fmax.reduce(raw, axis=None)), saturation)
    check_depth(raw.dtype, saturation)


def refuse_above(highest: float, saturation: float | None) -> None:
    """Refuse a largest value above the level of saturation."""
    if saturation is not None and highest > saturation:
        raise InputError(
            f"'frames' holds {highest:.10g}, above the saturation level {saturation:g} DN of the "
            "levels: frames of another sensor or bit depth"
        )


def check_depth(dtype: np.dtype[Any], saturation: float | None) -> None:
    """Refuse whole numbers of fewer bits than a sensor that saturates at this level gives."""
    if saturation is None or dtype.kind != "u" or np.iinfo(dtype).max >= saturation / 2:
        return
    raise InputError(
        f"'frames' is {dtype}, but the levels saturate at {saturation:g} DN: frames of another bit "
        "depth"
    )

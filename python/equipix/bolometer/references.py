"""References of a dynamic correction: frames of all states, and the pixels that they leave out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix._check import as_array, check_shape
from equipix.defects import DEAD_RESPONSE
from equipix.errors import InputError
from equipix.flags import set_bits
from equipix.frames import FrameStatistics

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from equipix._types import Array, Bools, Floats


def stack_of(name: str, given: ArrayLike | Sequence[FrameStatistics]) -> Floats:
    """Mean frames of all states as one array (n, rows, cols)."""
    if isinstance(given, FrameStatistics):
        raise InputError(f"'{name}' is one FrameStatistics, expected a sequence: one a state")
    if isinstance(given, list | tuple):
        frames: list[Any] = [
            each.mean if isinstance(each, FrameStatistics) else each for each in given
        ]
        shapes = {np.shape(each) for each in frames}
        if len(shapes) > 1:
            raise InputError(f"'{name}' has frames of {sorted(shapes)}, expected one shape")
        return _checked_stack(name, frames)
    return _checked_stack(name, given)


def _checked_stack(name: str, given: Any) -> Floats:
    """Array (n, rows, cols) of one frame or more."""
    values = as_array(name, given, ndim=3).astype(np.float64)
    check_shape((values.shape[1], values.shape[2]))
    if not len(values):
        raise InputError(f"'{name}' has no frames, expected one for each state")
    return values


def bodies_of(given: Any, shape: tuple[int, ...]) -> list[Floats]:
    """Frames of the cold and the hot black body."""
    if not isinstance(given, list | tuple) or len(given) != 2:
        raise InputError("'black_bodies' is no pair, expected (cold, hot), each like 'shutter'")
    bodies = [stack_of(f"black_bodies[{k}]", each) for k, each in enumerate(given)]
    for k, each in enumerate(bodies):
        if each.shape != shape:
            raise InputError(
                f"'black_bodies[{k}]' has shape {each.shape}, expected {shape} like 'shutter'"
            )
    return bodies


def flags_of(values: Floats, bodies: list[Floats] | None, mask: ArrayLike | None) -> Array:
    """Flags of pixels without values, of masked ones, and of those that do not respond."""
    shape = values.shape[1:]
    unknown: Bools = np.asarray(~np.isfinite(values).all(axis=0))
    if mask is not None:
        given = as_array("mask", mask, ndim=2)
        if given.dtype != np.bool_ or given.shape != shape:
            raise InputError(
                f"'mask' is {given.dtype} of shape {given.shape}, expected bool of shape {shape}"
            )
        unknown |= given
    flags, dead = np.zeros(shape, np.uint32), np.zeros(shape, bool)
    if bodies is not None:
        unknown |= ~np.isfinite(np.stack(bodies)).all(axis=(0, 1))
        if not unknown.all():
            response = relative_response(bodies[1] - bodies[0], ~unknown).mean(axis=0)
            dead = np.asarray(~unknown & ~(response >= DEAD_RESPONSE))
    if (unknown | dead).all():
        raise InputError("'shutter' has no pixel with a value at every state, expected some")
    set_bits(flags, "undetermined", unknown)
    set_bits(flags, "non_responding", dead)
    return flags


def relative_response(rise: Floats, good: Bools) -> Floats:
    """Response of each pixel over the array's, at each state."""
    mean = rise[:, good].mean(axis=1)
    scatter = rise[:, good].std(axis=1)
    weak = np.flatnonzero(~(np.abs(mean) > scatter))
    if weak.size:
        k = int(weak[0])
        raise InputError(
            f"'black_bodies' at state {k} differ by {mean[k]:.4g} DN in the mean and by "
            f"{scatter[k]:.4g} DN rms between pixels, expected a difference that all pixels see: "
            "take black bodies further apart"
        )
    return np.asarray(rise / mean[:, None, None])

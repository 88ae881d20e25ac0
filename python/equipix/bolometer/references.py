"""References of a dynamic correction: frames of all states, and the pixels that they leave out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix._check import as_array, check_shape
from equipix.defects import DEAD_RESPONSE
from equipix.errors import InputError, SaturationWarning, warn
from equipix.exposures.clipping import clipping
from equipix.flags import Flag, set_bits
from equipix.frames import FrameStatistics

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from equipix._types import Array, Bools, Floats


@dataclass(frozen=True, eq=False)
class References:
    """Mean frames of all states, what is known of their noise, and where they saturate.

    Attributes
    ----------
    values : ndarray, shape (n, rows, cols), float64
        The mean frames in DN.
    variance : tuple of ndarray, or None
        Variances of the means, where all references are averages.
    saturated : ndarray, shape (rows, cols), bool
        Pixels that are known to saturate in a reference.
    """

    values: Floats
    variance: tuple[Floats, ...] | None
    saturated: Bools

    @classmethod
    def of(cls, name: str, given: ArrayLike | Sequence[FrameStatistics]) -> References:
        """Check the frames of all states, and warn of values that probably saturate."""
        if isinstance(given, FrameStatistics):
            raise InputError(f"'{name}' is one FrameStatistics, expected a sequence: one a state")
        listed: list[Any] = list(given) if isinstance(given, list | tuple) else []
        averages = [each for each in listed if isinstance(each, FrameStatistics)]
        variance = None
        if averages and len(averages) == len(listed):
            variance = tuple(each.variance_of_mean for each in averages)
        values = _stack(name, listed or given)
        found = cls(values.astype(np.float64), variance, np.zeros(values.shape[1:], bool))
        for each in listed or values:
            at_top = each.saturated > 0 if isinstance(each, FrameStatistics) else _at_the_top(each)
            found.saturated[at_top] = True
        return found

    def noise(self, good: Bools) -> Floats | None:
        """Mean variance of the means of usable pixels at each state, where it is known."""
        if self.variance is None:
            return None
        noise = np.array([each[good].mean() for each in self.variance])
        return noise if np.isfinite(noise).all() else None

    def warn_of_clipping(self, name: str, good: Bools) -> None:
        """Warn of values of usable pixels at exactly the highest one."""
        for k, frame in enumerate(self.values):
            found = clipping(np.where(good, frame, np.nan))
            if found is not None:
                warn(
                    f"{found.values} values of '{name}' at state {k} are exactly "
                    f"{found.level:.10g}, the highest one: they probably saturate and count as "
                    "valid: exclude their pixels by 'mask', or give averages with a 'saturation'",
                    SaturationWarning,
                )
                return


def _stack(name: str, given: Any) -> Array:
    """Mean frames of all states as one array (n, rows, cols), in the type of the frames."""
    if isinstance(given, list | tuple):
        given = [each.mean if isinstance(each, FrameStatistics) else each for each in given]
        shapes = {np.shape(each) for each in given}
        if len(shapes) > 1:
            raise InputError(f"'{name}' has frames of {sorted(shapes)}, expected one shape")
    values = as_array(name, given, ndim=3)
    check_shape((values.shape[1], values.shape[2]))
    if not len(values):
        raise InputError(f"'{name}' has no frames, expected one for each state")
    return values


def _at_the_top(given: ArrayLike) -> Bools:
    """Pixels of a frame at the largest number of its type of whole numbers."""
    frame = np.asanyarray(given)
    if frame.dtype.kind not in "iu":
        return np.zeros(frame.shape, bool)
    return np.asarray(frame == np.iinfo(frame.dtype).max)


def bodies_of(given: Any, shape: tuple[int, ...]) -> list[References]:
    """Frames of the cold and the hot black body."""
    if not isinstance(given, list | tuple) or len(given) != 2:
        raise InputError("'black_bodies' is no pair, expected (cold, hot), each like 'shutter'")
    bodies = [References.of(f"black_bodies[{k}]", each) for k, each in enumerate(given)]
    for k, each in enumerate(bodies):
        if each.values.shape != shape:
            raise InputError(
                f"'black_bodies[{k}]' has shape {each.values.shape}, expected {shape} like "
                "'shutter'"
            )
    return bodies


def flags_of(shutter: References, bodies: list[References] | None, mask: ArrayLike | None) -> Array:
    """Flags of pixels without values, masked, saturated, or that do not respond."""
    shape = shutter.saturated.shape
    unknown: Bools = np.asarray(~np.isfinite(shutter.values).all(axis=0))
    saturated = shutter.saturated.copy()
    if mask is not None:
        given = as_array("mask", mask, ndim=2)
        if given.dtype != np.bool_ or given.shape != shape:
            raise InputError(
                f"'mask' is {given.dtype} of shape {given.shape}, expected bool of shape {shape}"
            )
        unknown |= given
    flags, dead = np.zeros(shape, np.uint32), np.zeros(shape, bool)
    if bodies is not None:
        cold, hot = bodies
        unknown |= ~np.isfinite([cold.values, hot.values]).all(axis=(0, 1))
        saturated |= cold.saturated | hot.saturated
        good = ~(unknown | saturated)
        if good.any():
            response = relative_response(hot.values - cold.values, good).mean(axis=0)
            dead = np.asarray(good & ~(response >= DEAD_RESPONSE))
    if (unknown | dead | saturated).all():
        raise InputError(
            "'shutter' has no pixel with a value at every state below saturation, expected some"
        )
    set_bits(flags, "undetermined", unknown)
    set_bits(flags, "non_responding", dead)
    flags[saturated] |= np.uint32(Flag.SATURATED | Flag.DO_NOT_USE)
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

"""Exposures that fit far better in the place of another, or flipped."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from equipix.calibration.causes import standing_out
from equipix.calibration.window_fit import WindowFit, if_there_is_light

if TYPE_CHECKING:
    from collections.abc import Sequence

    from equipix.exposures.exposures import Exposures
    from equipix.exposures.options import FitOptions

_SIDE = 128
"""Pixels along a window that is fitted in either order."""

_LEFT = 0.1
"""Share of F above noise that the right order leaves at most."""

_FLIPS = {"upside down": (0,), "mirrored left to right": (1,), "turned by 180 degrees": (0, 1)}


@if_there_is_light
def misplaced(
    exposures: Exposures, pairs: Sequence[tuple[int, int]], worst: int | None, options: FitOptions
) -> str | None:
    """Which of these pairs is exchanged, or how the worst exposure is flipped, in words; or None.

    Fits of a central window are compared, in all orders, with that as given. Shifts are held: those
    that are found follow the mistake. Unless given, the worst exposure is that which stands out.
    """
    exposures = dataclasses.replace(
        exposures, positions=dataclasses.replace(exposures.positions, std=None)
    )
    window = exposures.window(_SIDE)
    given = WindowFit.of(window, options)
    worst = standing_out(given.residuals) if worst is None else worst
    tried = {
        f"{exposures.name_of(i)} and {exposures.name_of(j)} fit better each at the shift of the "
        "other: check the order of the frames and of 'shifts'": _at_the_other(window, (i, j))
        for i, j in pairs
    }
    if worst is not None:
        tried |= {
            f"{exposures.name_of(worst)} fits better {flip}: give its frames as the others are, "
            "or its 'rotation'": _flipped(exposures, window, worst, axes)
            for flip, axes in _FLIPS.items()
        }
    if not tried:
        return None
    fits = {words: WindowFit.of(each, options) for words, each in tried.items()}
    best = min(fits, key=lambda words: fits[words].left)
    return best if _explains(fits[best], given, knows_noise=exposures.knows_noise) else None


def _explains(best: WindowFit, given: WindowFit, *, knows_noise: bool) -> bool:
    """Whether another order leaves little of what noise does not explain of the order given.

    Where noise is not known, and may be none, all that is left may be what the solver leaves.
    """
    is_noise = given.is_within_noise if knows_noise else given.cannot_be_far_above(best)
    noise = 1.0 if knows_noise else 0.0
    return not is_noise and best.left - noise < _LEFT * (given.left - noise)


def _at_the_other(window: Exposures, pair: tuple[int, int]) -> Exposures:
    """Return the exposures, each of two at the place of the other."""
    order = np.arange(len(window))
    order[list(pair)] = pair[::-1]
    positions = window.positions
    moved = dataclasses.replace(
        positions, shifts=positions.shifts[order], rotation=positions.rotation[order]
    )
    return dataclasses.replace(window, positions=moved)


def _flipped(
    exposures: Exposures, window: Exposures, exposure: int, axes: tuple[int, ...]
) -> Exposures:
    """Return the window with one exposure flipped, as the camera wrote it, about the middle."""
    values = window.values.copy()
    middle = exposures.middle(_SIDE)
    sizes = enumerate(zip(middle, exposures.shape, strict=True))
    source = tuple(
        slice(size - part.stop, size - part.start) if axis in axes else part
        for axis, (part, size) in sizes
    )
    dark = 0.0 if exposures.dark is None else exposures.dark
    response, dark = (np.broadcast_to(x, exposures.shape) for x in (exposures.response, dark))
    frame = exposures.values[exposure][source] * response[source] + dark[source]
    values[exposure] = (np.flip(frame, axes) - dark[middle]) / response[middle]
    return dataclasses.replace(window, values=values)

"""Exposures whose order is wrong: two that fit far better each at the place of the other."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from equipix.calibration.window_fit import WindowFit, if_there_is_light

if TYPE_CHECKING:
    from collections.abc import Sequence

    from equipix.exposures.exposures import Exposures
    from equipix.exposures.options import FitOptions

_SIDE = 128
"""Pixels along a window that is fitted in either order."""

_LEFT = 0.1
"""Share of F above noise that the right order leaves at most."""


@if_there_is_light
def exchanged(
    exposures: Exposures, pairs: Sequence[tuple[int, int]], options: FitOptions
) -> tuple[int, int] | None:
    """Return the pair of exposures that are exchanged, by fits of a central window; or None."""
    if not pairs:
        return None
    window = exposures.window(_SIDE)
    # In units of noise where that is known: an order explains what is above it.
    noise = 1.0 if exposures.knows_noise else 0.0
    left = {pair: WindowFit.of(_at_the_other(window, pair), options).left - noise for pair in pairs}
    best = min(left, key=lambda pair: left[pair])
    return best if left[best] < _LEFT * (WindowFit.of(window, options).left - noise) else None


def _at_the_other(window: Exposures, pair: tuple[int, int]) -> Exposures:
    """Return the exposures, each of two at the place of the other."""
    order = np.arange(len(window))
    order[list(pair)] = pair[::-1]
    positions = window.positions
    moved = dataclasses.replace(
        positions,
        shifts=positions.shifts[order],
        rotation=positions.rotation[order],
        std=None if positions.std is None else positions.std[order],
    )
    return dataclasses.replace(window, positions=moved)

"""Exposures whose order is wrong: two that fit far better each at the place of the other."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from equipix.calibration.window_fit import WindowFit
from equipix.errors import InputError, InsufficientMemoryError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from equipix.exposures.exposures import Exposures
    from equipix.exposures.options import FitOptions

_SIDE = 128
"""Pixels along a window that is fitted in either order."""

_LEFT = 0.1
"""Share of F that the right order leaves at most."""


def exchanged(
    exposures: Exposures, pairs: Sequence[tuple[int, int]], options: FitOptions
) -> tuple[int, int] | None:
    """Return the pair of exposures that are exchanged, by fits of a central window; or None."""
    window = exposures.window(_SIDE)
    try:
        left = {pair: WindowFit.of(_at_the_other(window, pair), options).left for pair in pairs}
        given = WindowFit.of(window, options).left if left else 0.0
    except (InputError, InsufficientMemoryError):
        # All arguments are valid for the whole sensor: the window has too little light or memory.
        return None
    best = min(left, key=lambda pair: left[pair], default=None)
    return best if best is not None and left[best] < _LEFT * given else None


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

"""One exposure that is far brighter or darker than its flux says."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.calibration.residuals import on_sensor
from equipix.shifts import nearest_whole

if TYPE_CHECKING:
    from equipix._types import Array, Bools
    from equipix.exposures.exposures import Exposures

_FAR, _BLACK = 1.5, 20.0
"""Factors from which light contradicts a flux that is known, and one that is fitted. The latter is
of an exposure without light, or of the others."""

_FALL = 4.0
"""Factor by which a sensitivity may fall from edge to edge, which compares as light does."""

_STDS = 5.0
"""Standard deviations of a prior that a flux does not reach."""

_ROWS, _FEWEST = 256, 100
"""Rows that are compared, and fewest pixels of two exposures in the same cells of the beam."""

_CLEAR = 10.0
"""Standard deviations of noise that the light of an exposure, over these pixels, must be."""


def on_brightness(exposures: Exposures) -> str | None:
    """Say which exposure has far more or less light than its flux says; None if not just one.

    Wrong shifts in a steep beam make several exposures look so.
    """
    # Values with an offset are not proportional to light.
    if exposures.offset or exposures.raw or len(set(exposures.positions.rotation.tolist())) > 1:
        return None
    shifts = on_sensor(exposures.positions)
    away = np.linalg.norm(shifts - np.median(shifts, axis=0), axis=1)
    # The first may itself be black.
    for middle in np.argsort(away, kind="stable")[:2].tolist():
        moves = nearest_whole(shifts - shifts[middle]).astype(int)
        found = _relative_light(exposures, middle, moves)
        if np.isfinite(found).sum() >= 3 and np.nanmedian(found) > 0:
            break
    else:
        return None
    found /= np.nanmedian(found)
    flux = exposures.flux
    is_free = flux.kind in ("fit", "linear")
    limit = np.maximum(_FAR, _FALL ** np.sum(np.abs(moves) / exposures.shape, axis=1))
    limit = np.maximum(limit, _BLACK) if is_free else limit
    if flux.std is not None:
        limit = np.maximum(limit, np.exp(_STDS * flux.std))
    (far,) = np.nonzero((found > limit) | (found < 1 / limit))
    if len(far) != 1:
        return None
    (worst,) = far
    given = "" if is_free else f", for its flux of {flux.values[worst]:g}"
    return (
        f"{exposures.name_of(int(worst))} has {max(found[worst], 0.0):.2g} times the light of the "
        f"others in the same cells of the beam{given} (expected 1, limit {limit[worst]:.3g} or its "
        "inverse): check its frames and its flux, or leave it out"
    )


def _relative_light(exposures: Exposures, middle: int, moves: Array) -> Array:
    """Light of each exposure over that of the middle one, in cells that both see, for equal fluxes.

    NaN of exposures that have too few of them in common.
    """
    step = max(1, exposures.shape[0] // _ROWS)
    result = np.full(len(exposures), np.nan)
    usable = exposures.usable(middle)
    for k, move in enumerate(moves.tolist()):
        here, there = (_common(each, exposures.shape, step) for each in (move, [-d for d in move]))
        both = exposures.usable(k)[here] & usable[there]
        if np.count_nonzero(both) < _FEWEST:
            continue
        own, other = exposures.values[k][here], exposures.values[middle][there]
        light, usual = (float(np.sum(each, where=both, dtype=np.float64)) for each in (own, other))
        ratio = exposures.flux.values[k] / exposures.flux.values[middle]
        if usual * ratio > _CLEAR * max(_noise(own, both), ratio * _noise(other, both)):
            result[k] = light / (usual * ratio)
    return result


def _noise(values: Array, used: Bools) -> float:
    """Standard deviation of a sum of values, at most: of neighbours, which light changes too."""
    both = used[:, 1:] & used[:, :-1]
    steps = np.subtract(values[:, 1:], values[:, :-1], where=both, out=np.zeros(both.shape))
    return float(np.sqrt(np.sum(steps**2) / 2))


def _common(move: list[int], shape: tuple[int, int], step: int) -> tuple[slice, slice]:
    """Rows, every `step`-th, and columns of a moved sensor that see what it saw before."""
    (first, left), (end, right) = np.maximum(0, (np.negative(move), shape - np.maximum(move, 0)))
    return slice(first, end, step), slice(left, right)

"""Rules on what was given, before any fit."""

from itertools import combinations

import numpy as np

from equipix._check import Array, Bools
from equipix.exposures.exposures import Exposures
from equipix.exposures.positions import Positions, nearest_whole
from equipix.findings import Rule
from equipix.fitting.residuals import on_sensor
from equipix.measured.saturation import clipping_advice
from equipix.plan.drift import distinct_trend

_LEAST_MOVE = 0.5
"""Least distance, in pixels, between shifts that are in pixels."""


_DEGENERATE = 0.1
"""Share of the variance of a drift below which the error of its size is over three times larger."""


def _on_raw(exposures: Exposures) -> str | None:
    """Say that averages, or arrays as cameras write them, are without a dark."""
    if not exposures.raw:
        return None
    return (
        "no dark was subtracted from frames of whole numbers, so that an offset of the camera "
        "counts as light: give 'dark' to equipix.average (--dark), or subtract it before"
    )


def _on_millimetres(exposures: Exposures) -> str | None:
    """Say that shifts look like millimetres."""
    most = float(np.ptp(exposures.positions.shifts, axis=0).max())
    if not 0 < most < _LEAST_MOVE:
        return None
    return (
        f"the shifts differ by {most:.2g} pixel at most (limit {_LEAST_MOVE:g}), from which "
        "next to nothing follows. Expected are pixels: divide millimetres by the pixel pitch, "
        "see 'From micrometres to pixels' in docs/shifts.md"
    )


def _on_repeats(exposures: Exposures) -> str | None:
    """Say that one exposure is given for two positions."""
    pair = repeated(exposures.values, exposures.positions)
    if pair is None:
        return None
    first, second = pair
    return (
        f"{exposures.name_of(first)} and {exposures.name_of(second)} are equal, value for value, "
        "which noise prevents: give each position its own frames, and see whether the sensor moved"
    )


def _on_rounding(exposures: Exposures) -> str | None:
    """Say that fractions of shifts were rounded away."""
    rounding = exposures.positions.rounding
    if rounding is None:
        return None
    words = rounding.words(exposures.names)
    return f"{words}: use method='multiscale', or move the sensor by whole pixels"


def _on_order(exposures: Exposures) -> str | None:
    """Say that a drift in time is degenerate with a tilt in the order of the exposures."""
    times, positions = exposures.flux.time, exposures.positions
    if times is None or positions.are_turned:
        return None
    share = distinct_trend(positions.shifts, times)
    if share >= _DEGENERATE:
        return None
    return (
        f"in this order of exposures only {share:.1%} of the variance of a drift linear in time is "
        f"distinguishable from a tilt of the sensitivity (limit {_DEGENERATE:.0%}): take the "
        "exposures in another order, see equipix.plan.advise_order"
    )


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


def _contradicted(exposures: Exposures) -> tuple[int, float, float] | None:
    """The exposure of far more or less light than its flux says, how much, and the limit.

    None if it is not just one: wrong shifts in a steep beam make several look so.
    """
    # Values with an offset are not proportional to light.
    if exposures.offset or exposures.raw or exposures.positions.are_turned:
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
    limit = np.maximum(_FAR, _FALL ** np.sum(np.abs(moves) / exposures.shape, axis=1))
    limit = np.maximum(limit, _BLACK) if flux.is_fitted else limit
    if flux.std is not None:
        limit = np.maximum(limit, np.exp(_STDS * flux.std))
    (far,) = np.nonzero((found > limit) | (found < 1 / limit))
    if len(far) != 1:
        return None
    worst = int(far[0])
    return worst, max(float(found[worst]), 0.0), float(limit[worst])


def on_brightness(exposures: Exposures) -> str | None:
    """Say which exposure has far more or less light than its flux says."""
    contradicted = _contradicted(exposures)
    if contradicted is None:
        return None
    worst, light, limit = contradicted
    given = remedy = ""
    if not exposures.flux.is_fitted:
        given = f", for its flux of {exposures.flux.values[worst]:g}"
        remedy = "; flux='fit' (--flux fit) finds the fluxes of a lamp that varies"
    return (
        f"{exposures.name_of(worst)} has {light:.2g} times the light of the others in the same "
        f"cells of the beam{given} (expected 1, limit {limit:.3g} or its inverse): check its "
        f"frames and its flux, or leave it out{remedy}"
    )


def wrong_flux(exposures: Exposures) -> str:
    """Words on the same as a cause of something else; none without one."""
    contradicted = _contradicted(exposures)
    if contradicted is None:
        return ""
    worst, light, _ = contradicted
    return f"{exposures.name_of(worst)} has {light:.2g} times the light that its flux says"


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


_SAMPLED = 4096
"""Values of an exposure that are compared before all are."""


def repeated(values: Array, positions: Positions) -> tuple[int, int] | None:
    """Indices of the first two exposures that are equal though the sensor moved, or None."""
    step = max(1, values[0].size // _SAMPLED)
    samples = [each.ravel()[::step] for each in values]
    for first, second in combinations(range(len(values)), 2):
        has_moved = np.any(positions.shifts[first] != positions.shifts[second])
        if not has_moved or not np.array_equal(samples[first], samples[second], equal_nan=True):
            continue
        is_known = np.isfinite(samples[first]).any()
        if is_known and np.array_equal(values[first], values[second], equal_nan=True):
            return first, second
    return None


BEFORE: tuple[Rule[Exposures], ...] = (
    Rule("saturation", "input", lambda e: clipping_advice(e.clipped) if e.clipped else None),
    Rule("raw", "input", _on_raw),
    Rule("light", "misfit", lambda e: e.unsteady),
    Rule("unit", "identifiability", _on_millimetres),
    Rule("flux", "misfit", on_brightness),
    Rule("repeated", "misfit", _on_repeats),
    Rule("cfa", "misfit", lambda e: e.filters.words if e.filters else None),
    Rule("rounding", "input", _on_rounding),
    Rule("order", "identifiability", _on_order, severity="note"),
)
"""What is asked of exposures, in this order."""

"""How much quality C the words of a table cost, and which widths suffice."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import count, takewhile
from typing import Any, NamedTuple, Self

import numpy as np

from equipix._check import Array, ArrayLike, Progress, as_array, naming_memory, positive
from equipix.correction.protocol import Correction
from equipix.errors import InputError, InputWarning
from equipix.findings import usable
from equipix.hardware.table import Table
from equipix.measured.colour import Colours
from equipix.metrics import correctability, planes
from equipix.metrics.correctability import Correctability
from equipix.shown import Brief

_WIDTHS = range(8, 17)

_BOTH = 16
"""Width of the words that are not varied."""


class Cost(NamedTuple):
    """C of the correction and of its table, and what the words add; as of `Quality`."""

    before: Correctability
    after: Correctability
    added: float


@dataclass(frozen=True)
class Quality(Brief):
    """Quality C of a correction and of its table, the result of `quality`.

    Attributes
    ----------
    before, after : Correctability
        C of the correction in floating point, and of the table; behind colour filters those of the
        plane that `worst` names.
    added : float
        Spatial noise that the words add, over the temporal noise: the rms over the pixels of the
        difference of both mean images, less its mean. Of the same plane.
    at_ends : int
        Words of usable pixels at either end of the ADC, probably beyond it.
    table : Table
        The table.
    worst : str
        The plane of `equipix.metrics.planes` to which the words add most; "" where the correction
        names no colour filters.
    planes : dict
        The first three of each plane, by its name.
    """

    before: Correctability
    after: Correctability
    added: float
    at_ends: int
    table: Table
    worst: str
    planes: dict[str, Cost]


@naming_memory("quality of a table")
def quality(correction: Correction, frames: ArrayLike, **options: Any) -> Quality:
    """Quality C of a correction before and after its coefficients become words.

    Parameters
    ----------
    correction : Correction
        The correction.
    frames : array_like, shape (n, rows, cols)
        Raw frames of one steady even level, two or more, as without the DAC.
    **options : Any
        Widths and steps, as of `Table.of`.

    Returns
    -------
    Quality
        Both C, and what the words add.

    Raises
    ------
    InputError
        As of `Table.of` and `equipix.metrics.correctability`.

    Notes
    -----
    Of the table nothing is warned: what it costs is the result, and `Table.findings` has the rest.
    Behind colour filters each plane is judged by itself, as colours differ in level.

    Examples
    --------
    >>> import equipix
    >>> from equipix import hardware, simulate
    >>> array = simulate.StaringArray.of("InSb", (48, 64), rng=1)
    >>> levels = [equipix.average(array.frames(e, 16, rng=k)) for k, e in enumerate((4e6, 16e6))]
    >>> response = equipix.nuc.fit(levels, order=1)
    >>> frames = list(array.frames(13e6, 16, rng=9))
    >>> narrow = hardware.quality(response, frames, offset_bits=8, gain_bits=8)
    >>> wide = hardware.quality(response, frames, offset_bits=14, gain_bits=14)
    >>> narrow.added > 10 * wide.added
    True
    """
    return _quality(_Level.of("frames", correction, frames), correction, options)


def _quality(level: _Level, correction: Correction, options: dict[str, Any]) -> Quality:
    with warnings.catch_warnings(action="ignore", category=InputWarning):  # what words cost is told
        table = Table.of(correction, **options)
    words = table.digitise(level.raw)[:, usable(table.flags)]
    at_ends = int(np.count_nonzero((words == 0) | (words == table.format.largest_word)))
    _refuse_clipped(level.raw, table, words, at_ends)
    found = table.correct(level.raw)
    added, after = level.added(found), level.judged(found)
    costs = {name: Cost(level.before[name], after[name], added[name]) for name in added}
    worst = max(added, key=added.__getitem__)
    return Quality(*costs[worst], at_ends, table, worst, costs)


def _refuse_clipped(raw: Array, table: Table, words: Array, at_ends: int) -> None:
    """Refuse frames of which the ADC sees nothing."""
    if at_ends == words.size:
        form = table.format
        raise InputError(
            f"'frames' of {np.nanmin(raw):g} to {np.nanmax(raw):g} DN are beyond an ADC of "
            f"'adc_bits' {form.adc_bits} and 'adc_step' {2.0**form.adc:g} in all usable pixels: "
            f"all words are 0 or {form.largest_word}: take an ADC that holds the range of the "
            "frames, or see that their offset is that of the correction"
        )


class _Level(NamedTuple):
    """Frames of one level, the same corrected in floating point, and C of each plane of these."""

    raw: Array
    exact: Array
    colours: Colours | None
    before: dict[str, Correctability]

    @classmethod
    def of(cls, name: str, correction: Correction, frames: ArrayLike) -> Self:
        raw = as_array(name, frames, ndim=3)
        level = cls(raw, correction.correct(raw, flagged="nan"), correction.colours, {})
        return level._replace(before=level.judged(level.exact))

    def planes(self, frames: Array) -> dict[str, Array]:
        """Each plane of colour filters by its name, or all pixels under no name."""
        return {"": frames} if self.colours is None else planes(frames, self.colours)

    def judged(self, frames: Array) -> dict[str, Correctability]:
        """C of each plane."""
        return {name: correctability(plane) for name, plane in self.planes(frames).items()}

    def added(self, found: Array) -> dict[str, float]:
        """Spread over the pixels of what the words change, over the temporal noise."""
        change = (found.astype(np.float64) - self.exact).mean(axis=0)
        return {
            name: float(
                np.std(plane[np.isfinite(plane)]) / np.sqrt(self.before[name].temporal_variance)
            )
            for name, plane in self.planes(change).items()
        }


@dataclass(frozen=True)
class Widths(Brief):
    """Widths that suffice, the result of `smallest_widths`.

    Attributes
    ----------
    offset_bits, gain_bits : int or None
        The smallest width, the other memory having 16 bits; None if 16 bits do not suffice.
    both_bits : int or None
        The smallest width of both memories.
    added : dict
        By ``"offset"``, ``"gain"`` and ``"both"``, what each width from 8 to 16 bits adds at the
        worst level, over the temporal noise; infinite where words of usable pixels do not fit.
    worst : dict
        By the same names, the number of the level and the plane of colour filters to which the
        width that suffices adds most, or 16 bits where none does; the plane is "" without filters.
    """

    offset_bits: int | None
    gain_bits: int | None
    both_bits: int | None
    added: dict[str, dict[int, float]]
    worst: dict[str, tuple[int, str]]


class Trial(NamedTuple):
    """What words cost at one level, whose frames are not kept.

    Attributes
    ----------
    planes : dict
        As of `Quality`.
    at_ends : int
        As of `Quality`.
    by_width : dict
        By ``"offset"``, ``"gain"`` and ``"both"`` and the width, what the words add in the worst
        plane, and its name.
    """

    planes: dict[str, Cost]
    at_ends: int
    by_width: dict[str, dict[int, tuple[float, str]]]


_SOUGHT = {"offset_bits", "gain_bits"}
"""Widths of which the smallest that suffice are sought."""


def trial(
    correction: Correction,
    frames: ArrayLike,
    *,
    progress: Progress | None = None,
    stage: str = "",
    **options: Any,
) -> Trial:
    """Find `quality` at one level, and what `widths_of` needs of it, with one correction of it."""
    level = _Level.of("frames", correction, frames)
    found = _quality(level, correction, options)
    others = {name: value for name, value in options.items() if name not in _SOUGHT}
    return Trial(found.planes, found.at_ends, _by_width(level, correction, others, progress, stage))


def _by_width(
    level: _Level,
    correction: Correction,
    options: dict[str, Any],
    progress: Progress | None = None,
    stage: str = "",
) -> dict[str, dict[int, tuple[float, str]]]:
    """Most that words of each width add at a level, and in which plane.

    Tables are made anew for each level: kept, they would take as much memory as 100 frames.
    """
    total, done = 3 * len(_WIDTHS) - 2, count(1)  # 16 bits of both are tried once

    @cache
    def most(offset_bits: int, gain_bits: int) -> tuple[float, str]:
        if progress is not None:
            progress(next(done), total, stage)
        widths: dict[str, Any] = {"offset_bits": offset_bits, "gain_bits": gain_bits}
        try:
            table = Table.of(correction, **widths, **options)
        except InputError:
            # Words of usable pixels do not fit; with 16 bits they do.
            return float("inf"), ""
        added = level.added(table.correct(level.raw))
        return max((each, plane) for plane, each in added.items())

    with warnings.catch_warnings(action="ignore", category=InputWarning):
        Table.of(correction, offset_bits=_BOTH, gain_bits=_BOTH, **options)
        return {
            "offset": {bits: most(bits, _BOTH) for bits in _WIDTHS},
            "gain": {bits: most(_BOTH, bits) for bits in _WIDTHS},
            "both": {bits: most(bits, bits) for bits in _WIDTHS},
        }


@naming_memory("widths of a table")
def smallest_widths(
    correction: Correction, levels: Iterable[ArrayLike], *, added: float = 0.1, **options: Any
) -> Widths:
    """Find the smallest widths of the memories that cost no more than a share of the noise.

    Parameters
    ----------
    correction : Correction
        The correction.
    levels : iterable of array_like, shape (n, rows, cols) each
        Raw frames of steady even levels, taken one at a time; the worst one counts, and behind
        colour filters the worst plane.
    added : float
        Largest spatial noise that the words may add, over the temporal noise. 0.1 raises a C of 1
        to 1.005.
    **options : Any
        The other widths, and steps, as of `Table.of`.

    Returns
    -------
    Widths
        The widths, and what each of them adds.

    Raises
    ------
    InputError
        As of `quality`; or if `options` names a width that is sought.
    """
    positive("added", added)
    if sought := _SOUGHT & set(options):
        raise InputError(f"{sorted(sought)}: expected levels, and no width of a memory")
    tried = [
        _by_width(_Level.of("levels", correction, frames), correction, options) for frames in levels
    ]
    if not tried:
        raise InputError("levels: expected levels, and no width of a memory")
    return widths_of(tried, added=added)


def widths_of(
    levels: Sequence[dict[str, dict[int, tuple[float, str]]]], *, added: float = 0.1
) -> Widths:
    """Find the smallest widths that suffice at all levels, of what `Trial.by_width` has of each."""
    found = {
        name: {
            bits: max(
                (cost, (k, plane))
                for k, (cost, plane) in enumerate(level[name][bits] for level in levels)
            )
            for bits in _WIDTHS
        }
        for name in levels[0]
    }
    costs = {name: {bits: each for bits, (each, _) in of.items()} for name, of in found.items()}
    enough = {name: _first(of, added) for name, of in costs.items()}
    where = {name: found[name][bits or _BOTH][1] for name, bits in enough.items()}
    offset, gain, both = enough.values()
    return Widths(offset, gain, both, costs, where)


def _first(found: dict[int, float], limit: float) -> int | None:
    """Return the smallest width from which on none adds more than the limit."""
    widths = takewhile(lambda bits: not found[bits] > limit, sorted(found, reverse=True))
    return min(widths, default=None)

"""Which pixels a pattern of shifts compares."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from equipix import _native
from equipix._check import (
    Array,
    Bools,
    Ints,
    as_mask,
    as_shifts,
    check_shape,
    naming_memory,
    union,
)
from equipix.errors import InputError
from equipix.exposures.positions import as_rotation, round_shifts, whole_moves
from equipix.findings import Finding, say
from equipix.measured.colour import Colours


@dataclass(frozen=True, eq=False, repr=False)
class Identifiability:
    """What the measurements of an experiment determine: the result of `identify`.

    Attributes
    ----------
    components : int
        Number of connected components: within one, sensitivity and beam are determined up to one
        factor; between two they are not compared. It should be 1.
    labels : ndarray, shape (rows, cols), int32
        The component of each pixel, the largest being 0; −1 for a pixel without measurement.
        Without `mask` and `rotation` they are found when first asked for: all else needs a part of
        the sensor only.
    largest : int
        Number of pixels of the largest component.
    equations : int
        Number of measurements used.
    unknowns : int
        Number of pixels and beam cells that are measured. One in each component is the gauge.
    by_colour : dict of str to int, or None
        Of a sensor with a `cfa` the number of components of each colour where it stands alone, with
        a beam of its own. None without a `cfa`.
    """

    components: int
    largest: int
    equations: int
    unknowns: int
    by_colour: dict[str, int] | None
    _shape: tuple[int, int]
    _labels: Callable[[], Array]

    def __repr__(self) -> str:
        """Short form: how many pixels are compared."""
        parts = "1 component" if self.components == 1 else f"{self.components} components"
        if self.by_colour is not None:
            parts += f" (each colour alone: {sum(self.by_colour.values())})"
        return (
            f"<Identifiability: {parts}, the largest of {self.largest} of "
            f"{math.prod(self._shape)} pixels; {self.equations} equations for {self.unknowns} "
            "unknowns>"
        )

    @cached_property
    def labels(self) -> Array:
        """The component of each pixel."""
        return self._labels()


def identify(
    shape: tuple[int, int],
    shifts: ArrayLike,
    mask: ArrayLike | None = None,
    *,
    rotation: ArrayLike | None = None,
    cfa: ArrayLike | None = None,
) -> Identifiability:
    """Find which pixels an experiment can compare, before it is made.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    shifts : array_like, shape (n, 2)
        Position (row, col) of the sensor in the beam in each exposure, in pixels.
    mask : array_like of bool, shape (rows, cols) or (n, rows, cols), optional
        True = will not be used, in all exposures or in one.
    rotation : array_like of int, shape (n,), optional
        How far each exposure is turned, in degrees: 0, 90, 180 or 270; 0 unless given.
    cfa : str or array_like of labels, optional
        Colour filters of the pixels, as for `equipix.calibrate`. The components are those of one
        beam for all colours; those of each colour alone are counted beside them.

    Returns
    -------
    Identifiability
        The components, the label of each pixel, equations and unknowns.

    Raises
    ------
    InputError
        If an argument has a wrong shape or value, or a shift is as large as the sensor.
    InsufficientMemoryError
        If the memory that it takes cannot be had: 17 bytes a pixel and 9 a beam cell, with `mask`
        or `rotation` of the whole sensor, else of a part of it.

    Warns
    -----
    InputWarning
        If a shift differs from the first one by no whole number of pixels.

    Notes
    -----
    ln y_k(p) = ln L(u_k(p)) + ln M(p) is a graph of pixels and beam cells with an edge for each
    measurement. Union-find over all of them is exact for shifts that differ by whole pixels. The
    index of the lattice that the differences generate is only a lower bound: corners come apart.
    Where all pixels are used, a sensor of three spans of the shifts and one period of the lattice
    that they generate has the same components, and is looked at instead.

    Examples
    --------
    >>> from equipix import cross_pattern, plan
    >>> found = plan.identify((48, 64), cross_pattern(5, 7))
    >>> found.components, found.equations, found.unknowns
    (1, 15360, 6928)
    >>> plan.identify((48, 64), cross_pattern(4, 6)).components
    4
    >>> plan.identify((48, 64), cross_pattern(5, 7), cfa="RGGB").by_colour
    {'R': 1, 'G': 1, 'B': 1}
    """
    sizes = check_shape(shape)
    exact = as_shifts(shifts)
    if len(exact) < 2:
        raise InputError(f"'shifts' holds {len(exact)} exposures, expected at least two")
    # A part of a pixel that all shifts have in common moves the grid of the beam along.
    whole, rounding = whole_moves(exact), round_shifts(exact)[1]
    if rounding is not None:
        first = np.round(exact[0], 3).tolist()
        words = (
            f"{rounding.words()}, the first is {first}: choose shifts that differ by whole pixels"
        )
        say(Finding("rounding", words, "input"))
    masked = as_mask(mask, (len(whole), *sizes), may_be_whole=True)
    turns = as_rotation(rotation, len(whole)).tolist()
    colours = Colours.of(cfa)
    if masked is None and not any(turns) and np.all(np.abs(whole) < sizes):
        return _of_part(sizes, whole, colours)
    with naming_memory("identifying"):
        labels, counts, seen = _found(sizes, whole, turns, masked)
        by_colour = None if colours is None else _alone(sizes, whole, turns, masked, colours)
    unused = np.broadcast_to(False if masked is None else masked, (len(whole), *sizes))
    return Identifiability(
        components=len(counts),
        largest=max(counts, default=0),
        equations=unused.size - int(np.count_nonzero(unused)),
        unknowns=sum(counts) + seen,
        by_colour=by_colour,
        _shape=sizes,
        _labels=lambda: labels,
    )


def _found(
    shape: tuple[int, int], positions: Ints, turns: list[int], mask: Bools | None
) -> tuple[Array, list[int], int]:
    """Labels of the pixels, sizes of the components, and number of cells, by union-find."""
    return _native.planned_components(shape, positions, rotation=turns, mask=mask)


def _alone(
    shape: tuple[int, int],
    positions: Ints,
    turns: list[int],
    mask: Bools | None,
    colours: Colours,
) -> dict[str, int]:
    """Count the components of each colour where it alone is measured."""
    planes = dict(colours.planes(shape))
    counts = {k: _found(shape, positions, turns, union(mask, ~v))[1] for k, v in planes.items()}
    return {label: len(sizes) for label, sizes in counts.items()}


def _alone_by_part(shape: tuple[int, int], positions: Ints, colours: Colours) -> dict[str, int]:
    """Count them on a part of a sensor of which all pixels are used, if it has as many.

    Where a colour has components that do not reach along both axes, their number grows with each
    period; else it does not depend on the size.
    """
    corners, turns = positions - positions.min(axis=0), [0] * len(positions)
    spans = np.ptp(positions, axis=0).tolist()
    fewer, more = (
        _alone(_whole_periods(shape, spans, colours.period, count), corners, turns, None, colours)
        for count in (8, 9)
    )
    return fewer if fewer == more else _alone(shape, positions, turns, None, colours)


def _whole_periods(
    shape: tuple[int, int], spans: list[int], periods: tuple[int, int], count: int
) -> tuple[int, int]:
    """Leave out whole periods of the sensor beyond so many, and three spans of the shifts."""
    rows, cols = (
        size - max(0, (size - 3 * span) // period - count) * period
        for size, span, period in zip(shape, spans, periods, strict=True)
    )
    return rows, cols


def _of_part(shape: tuple[int, int], positions: Ints, colours: Colours | None) -> Identifiability:
    """What a sensor of which all pixels are used determines, by a part of it.

    Away from the edges the components are the cosets of the lattice that the differences of the
    shifts generate, and repeat with its period. What comes apart lies within a span or so of a
    corner: along an edge, every pixel is compared with one further inside. So rows in the middle
    can be left out by whole periods, and columns likewise. Others then stand for several.
    """
    turns = [0] * len(positions)
    spans = np.ptp(positions, axis=0).tolist()
    rows, cols = map(_weights, shape, spans, _periods(positions))
    part = len(rows), len(cols)
    with naming_memory("identifying"):
        labels, counts, _ = _found(part, positions - positions.min(axis=0), turns, None)
        by_colour = None if colours is None else _alone_by_part(shape, positions, colours)
        pixels = np.bincount(labels.ravel(), np.outer(rows, cols).ravel())

    def whole() -> Array:
        with naming_memory("identifying"):
            return labels if part == shape else _found(shape, positions, turns, None)[0]

    return Identifiability(
        components=len(counts),
        largest=int(pixels.max()),
        equations=len(positions) * math.prod(shape),
        unknowns=math.prod(shape) + _cells(shape, positions),
        by_colour=by_colour,
        _shape=shape,
        _labels=whole,
    )


def _periods(positions: Ints) -> tuple[int, int]:
    """Periods along rows and columns of the lattice that the differences of shifts generate.

    0 along an axis without a period. With D the greatest common divisor of all determinants and g
    that of all moves along columns, the lattice has the vector (D/g, 0).
    """
    rows, cols = (positions - positions[0]).T
    determinant = int(np.gcd.reduce(np.outer(rows, cols) - np.outer(cols, rows), axis=None))
    along_rows, along_cols = int(np.gcd.reduce(rows)), int(np.gcd.reduce(cols))
    return (
        determinant // along_cols if along_cols else along_rows,
        determinant // along_rows if along_rows else along_cols,
    )


def _weights(size: int, span: int, period: int) -> Ints:
    """Rows (or columns) that stand for all of a sensor, and how many each stands for."""
    edge = 3 * span // 2 + 1
    repeats = max(0, size - 2 * edge - period) // period if period else 0
    weights = np.ones(size - repeats * period, np.int64)
    weights[edge : edge + period] += repeats
    return weights


def _cells(shape: tuple[int, int], positions: Ints) -> int:
    """Count the cells that any exposure covers, by rectangles between the exposures' edges."""
    covered = []
    for size, places in zip(shape, positions.T, strict=True):
        ends = np.unique([places, places + size])
        begins = ends[:-1, None]
        covered.append((np.diff(ends), ((places <= begins) & (begins < places + size)).astype(int)))
    (heights, down), (widths, right) = covered
    return int(heights @ (down @ right.T > 0) @ widths)


def is_connected(shape: tuple[int, int], positions: Ints, colours: Colours | None = None) -> bool:
    """Whether whole shifts compare all pixels of a sensor, by a part of three spans at most.

    A part that is connected by itself proves it: such parts cover the sensor, overlap, and stay
    connected. Three spans reject patterns that only detours through a large sensor connect.
    Of colours each must be connected by itself, too; parts that begin a period apart are alike.
    """
    return any(_part_is_connected(shape, positions, colours, wide) for wide in (1.5, 3))


def _part_is_connected(
    shape: tuple[int, int], positions: Ints, colours: Colours | None, wide: float
) -> bool:
    """Whether a part so many spans wide is connected by itself."""
    spans = np.ptp(positions, axis=0).tolist()
    periods = (1, 1) if colours is None else colours.period
    sizes = zip(shape, spans, periods, strict=True)
    rows, cols = (min(size, int(wide * span) + 8 * period) for size, span, period in sizes)
    corners, turns = positions - positions.min(axis=0), [0] * len(positions)
    alone = [] if colours is None else [plane for _, plane in colours.planes((rows, cols))]
    for plane in (np.ones((rows, cols), bool), *alone):
        mask = None if plane.all() else ~plane
        if _found((rows, cols), corners, turns, mask)[1] != [np.count_nonzero(plane)]:
            return False
    return True

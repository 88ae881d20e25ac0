"""Which pixels a pattern of shifts compares."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from equipix import _native
from equipix._check import Array, Ints, as_mask, as_shifts, check_shape, naming_memory, union
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
    labels: Array
    largest: int
    equations: int
    unknowns: int
    by_colour: dict[str, int] | None = None

    def __repr__(self) -> str:
        """Short form: how many pixels are compared."""
        parts = "1 component" if self.components == 1 else f"{self.components} components"
        if self.by_colour is not None:
            parts += f" (each colour alone: {sum(self.by_colour.values())})"
        return (
            f"<Identifiability: {parts}, the largest of {self.largest} of {self.labels.size} "
            f"pixels; {self.equations} equations for {self.unknowns} unknowns>"
        )


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
        If the memory that it takes, 17 bytes a pixel and 9 a beam cell, cannot be had.

    Warns
    -----
    InputWarning
        If a shift differs from the first one by no whole number of pixels.

    Notes
    -----
    ln y_k(p) = ln L(u_k(p)) + ln M(p) is a graph of pixels and beam cells with an edge for each
    measurement. Union-find over all of them is exact for shifts that differ by whole pixels. The
    index of the lattice that the differences generate is only a lower bound: corners come apart.

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
        words = f"{rounding.words}, the first is {first}: choose shifts that differ by whole pixels"
        say(Finding("rounding", words, "input"))
    masked = as_mask(mask, (len(whole), *sizes), may_be_whole=True)
    turns = as_rotation(rotation, len(whole))
    colours = Colours.of(cfa)
    with naming_memory("identifying"):
        find = partial(_native.planned_components, sizes, whole, rotation=turns.tolist())
        labels, counts, seen = find(mask=masked)
        # Components of each colour where it alone is measured.
        planes = {} if colours is None else dict(colours.planes(sizes))
        alone = {label: len(find(mask=union(masked, ~plane))[1]) for label, plane in planes.items()}
    unused = np.broadcast_to(False if masked is None else masked, (len(whole), *sizes))
    return Identifiability(
        components=len(counts),
        labels=labels,
        largest=max(counts, default=0),
        equations=unused.size - int(np.count_nonzero(unused)),
        unknowns=sum(counts) + seen,
        by_colour=None if colours is None else alone,
    )


def is_connected(shape: tuple[int, int], positions: Ints, colours: Colours | None = None) -> bool:
    """Whether whole shifts compare all pixels of a sensor, by a part of it three spans wide.

    A part that is connected by itself proves it: such parts cover the sensor, overlap, and stay
    connected. One that is not rejects patterns that only detours through a large sensor connect.
    Of colours each must be connected by itself, too; parts that begin a period apart are alike.
    """
    spans = np.ptp(positions, axis=0).tolist()
    periods = (1, 1) if colours is None else colours.period
    sizes = zip(shape, spans, periods, strict=True)
    rows, cols = (min(size, 3 * span + 8 * period) for size, span, period in sizes)
    corners = positions - positions.min(axis=0)
    turns = [0] * len(corners)
    alone = [] if colours is None else [plane for _, plane in colours.planes((rows, cols))]
    for plane in (np.ones((rows, cols), bool), *alone):
        mask = None if plane.all() else ~plane
        counts = _native.planned_components((rows, cols), corners, rotation=turns, mask=mask)[1]
        if counts != [np.count_nonzero(plane)]:
            return False
    return True

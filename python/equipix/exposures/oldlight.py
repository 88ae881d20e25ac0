"""What a sensor shows of a beam from a position: c · L(u) · M(p), with u = A p + t + d."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


_BEFORE, _AROUND = 2, 5
"""Cells before the one behind which a place lies, and in all but one, of a polynomial."""


class Position(NamedTuple):
    """Where a sensor stands in a beam, and how bright that is.

    Attributes
    ----------
    corner : tuple of int
        First cell (row, col) of the beam's grid that it sees.
    rotation : int
        How far the sensor is turned, in degrees, as by ``numpy.rot90`` of the window.
    flux : float
        Relative flux c.
    fraction : tuple of float
        How far behind that cell (row, col) it stands, from 0 to 1.
    """

    corner: tuple[int, int]
    rotation: int
    flux: float
    fraction: tuple[float, float] = (0.0, 0.0)


def positions(
    origin: tuple[int, int], shifts: NDArray[Any], rotation: NDArray[Any], flux: NDArray[Any]
) -> list[Position]:
    """Positions on the grid of a beam where shift 0 is cell `origin`."""
    floors = np.floor(shifts)
    corners = (np.array(origin) + floors.astype(int)).tolist()
    fractions = (shifts - floors).tolist()
    return [
        Position((row, col), int(turn), float(c), (down, right))
        for (row, col), turn, c, (down, right) in zip(
            corners, rotation, flux, fractions, strict=True
        )
    ]


def window(grid: NDArray[Any], position: Position, shape: tuple[int, int]) -> NDArray[Any]:
    """View of the cells next to what a sensor of `shape` sees; the grid must hold them all."""
    rows, cols = shape if position.rotation % 180 == 0 else shape[::-1]
    row, col = np.array(position.corner) + np.rint(position.fraction).astype(int)
    return np.rot90(grid[row : row + rows, col : col + cols], position.rotation // 90)


def light(beam: NDArray[Any], position: Position, shape: tuple[int, int]) -> NDArray[Any]:
    """Light c · L(u) on each pixel of a sensor of `shape`; NaN beyond the grid of the beam.

    Between cells it is interpolated by polynomials of degree 5, or where one of their six cells is
    not known by straight lines.
    """
    sizes = shape if position.rotation % 180 == 0 else shape[::-1]
    # What lies around, for the polynomials; NaN beyond the grid.
    wide = np.full([size + _AROUND for size in sizes], np.nan)
    first = np.array(position.corner) - _BEFORE
    start = np.clip(first, 0, beam.shape)
    stop = np.clip(first + wide.shape, 0, beam.shape)
    place = tuple(slice(a, b) for a, b in zip(start - first, stop - first, strict=True))
    wide[place] = beam[start[0] : stop[0], start[1] : stop[1]]
    seen = _between(_between(wide, position.fraction[0]).T, position.fraction[1]).T
    return position.flux * np.rot90(seen, position.rotation // 90)


def _between(values: NDArray[Any], fraction: float) -> NDArray[Any]:
    """Values so far behind each row but the first two and the last three."""
    count = len(values) - _AROUND
    rows = [values[first : first + count] for first in range(_AROUND + 1)]
    if fraction == 0:
        return rows[_BEFORE]
    nodes = np.arange(_AROUND + 1) - _BEFORE
    weights = [
        np.prod([(fraction - other) / (node - other) for other in nodes if other != node])
        for node in nodes
    ]
    curve: NDArray[Any] = sum(
        (weight * row for weight, row in zip(weights, rows, strict=True)), np.zeros(())
    )
    line = (1 - fraction) * rows[_BEFORE] + fraction * rows[_BEFORE + 1]
    return np.where(np.isfinite(curve), curve, line)


def predictions(
    sensitivity: NDArray[Any], beam: NDArray[Any], places: list[Position]
) -> Iterator[NDArray[Any]]:
    """Frames c · L(u) · M(p) from one position after the other; NaN where either is unknown."""
    for place in places:
        yield light(beam, place, sensitivity.shape[:2]) * sensitivity

"""What a sensor shows of a beam from a position: c · L(u) · M(p), with u = A p + t + d."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


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
    """

    corner: tuple[int, int]
    rotation: int
    flux: float


def positions(
    origin: tuple[int, int], shifts: NDArray[Any], rotation: NDArray[Any], flux: NDArray[Any]
) -> list[Position]:
    """Positions on the grid of a beam where shift 0 is cell `origin`."""
    corners = (np.array(origin) + np.rint(shifts).astype(int)).tolist()
    return [
        Position((row, col), int(turn), float(c))
        for (row, col), turn, c in zip(corners, rotation, flux, strict=True)
    ]


def window(grid: NDArray[Any], position: Position, shape: tuple[int, int]) -> NDArray[Any]:
    """View of what a sensor of `shape` sees of a grid, all of which it must hold."""
    rows, cols = shape if position.rotation % 180 == 0 else shape[::-1]
    row, col = position.corner
    return np.rot90(grid[row : row + rows, col : col + cols], position.rotation // 90)


def light(beam: NDArray[Any], position: Position, shape: tuple[int, int]) -> NDArray[Any]:
    """Light c · L(u) on each pixel of a sensor of `shape`; NaN beyond the grid of the beam."""
    rows, cols = shape if position.rotation % 180 == 0 else shape[::-1]
    row, col = position.corner
    inside = beam[
        max(row, 0) : max(row + rows, 0),
        max(col, 0) : max(col + cols, 0),
    ]
    before = (min(max(-row, 0), rows), min(max(-col, 0), cols))
    seen = np.full((rows, cols), np.nan)
    seen[
        before[0] : before[0] + inside.shape[0],
        before[1] : before[1] + inside.shape[1],
    ] = inside
    return position.flux * np.rot90(seen, position.rotation // 90)


def predictions(
    sensitivity: NDArray[Any], beam: NDArray[Any], places: list[Position]
) -> Iterator[NDArray[Any]]:
    """Frames c · L(u) · M(p) from one position after the other; NaN where either is unknown."""
    for place in places:
        yield light(beam, place, sensitivity.shape[:2]) * sensitivity

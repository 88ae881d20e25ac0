"""Connected components: which pixels the measurements tie to which.

ln y_k(p) = ln L(u_k(p)) + ln M(p) has an edge from pixel p to beam cell u_k(p) for each used
measurement. Within a component the solution is unique up to one factor. A pixel that does not
respond has no edge: y = 0 tells nothing of the light.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def components(
    cells: NDArray[Any],
    used: NDArray[Any],
    grid_shape: tuple[int, int],
    silent: NDArray[Any] | None = None,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Label the connected components of pixels and beam cells.

    Parameters
    ----------
    cells : ndarray of int, shape (n, rows, cols)
        Flat index of the beam cell of each measurement.
    used : ndarray of bool, shape (n, rows, cols)
        Whether the measurement counts.
    grid_shape : tuple of int
        Rows and columns of the beam grid.
    silent : ndarray of bool, shape (rows, cols), optional
        Pixels that do not respond, or are in the dark. They join nothing.

    Returns
    -------
    pixel_labels : ndarray of int32, shape (rows, cols)
        Component of each pixel; −1 without a used measurement. Component 0 has the most pixels
        that are not silent; of equal ones, that with the lowest pixel index comes first. A silent
        pixel has the label of the cells that it sees, −1 if they are of several components.
    cell_labels : ndarray of int32, shape grid_shape
        Component of each beam cell, −1 likewise.
    """
    pixels = cells[0].size
    if silent is None:
        silent = np.zeros(cells[0].shape, bool)
    everything, used = used, used & ~silent
    parent = list(range(pixels + grid_shape[0] * grid_shape[1]))
    for exposure, counts in zip(cells, used, strict=True):
        for pixel in np.flatnonzero(counts):
            _join(parent, int(pixel), pixels + int(exposure.flat[pixel]))
    roots = np.array([_root(parent, node) for node in range(len(parent))])
    seen = used.any(axis=0).ravel()
    order = sorted(set(roots[:pixels][seen].tolist()))
    members = {root: np.flatnonzero(roots[:pixels] == root) for root in order}
    order.sort(key=lambda root: (-len(members[root]), members[root][0]))
    labels = np.full(len(parent), -1, np.int32)
    for label, root in enumerate(order):
        labels[roots == root] = label
    for pixel in np.flatnonzero(silent):
        exposures = [k for k, counts in enumerate(everything) if counts.flat[pixel]]
        around = {int(labels[pixels + cells[k].flat[pixel]]) for k in exposures} - {-1}
        if len(around) == 1:
            labels[pixel] = around.pop()
    return labels[:pixels].reshape(cells[0].shape), labels[pixels:].reshape(grid_shape)


def _root(parent: list[int], node: int) -> int:
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


def _join(parent: list[int], a: int, b: int) -> None:
    parent[_root(parent, b)] = _root(parent, a)

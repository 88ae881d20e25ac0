"""Frames of a sensor with colour filters, cut into planes of one place of the pattern each."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from equipix._check import as_array
from equipix.colour import Colours
from equipix.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from equipix._types import Array


def planes(frames: ArrayLike, cfa: ArrayLike | Colours) -> dict[str, Array]:
    """Cut frames into one plane for each pixel of a period of the colour filters.

    Parameters
    ----------
    frames : array_like, shape (..., rows, cols)
        Frames, or a map, of up to three dimensions.
    cfa : str or array_like of labels
        Colour filters of the pixels, as for `equipix.calibrate`.

    Returns
    -------
    dict of str to ndarray
        Every so many rows and columns, by the label; where a label stands in the period more than
        once "G1", "G2" and so on, in the order of reading. Views of the frames.

    Raises
    ------
    InputError
        If `cfa` is no pattern, or the frames are smaller than a period of it.

    Notes
    -----
    A plane is an image of one colour on a regular grid, which the figures of a camera, and the
    methods of `equipix.scene`, take as they take that of a monochrome sensor. The EMVA 1288
    standard evaluates colours so, too.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import metrics
    >>> found = metrics.planes(np.arange(16).reshape(4, 4), "RGGB")
    >>> found["R"].tolist(), [*found]
    ([[0, 2], [8, 10]], ['R', 'G1', 'G2', 'B'])
    """
    array, colours = as_array("frames", frames, ndim=(2, 3)), Colours.of(cfa)
    if colours is None:
        raise InputError("'cfa' is None, expected a pattern such as 'RGGB'")
    (down, right), size = colours.period, array.shape[-2:]
    if size[0] < down or size[1] < right:
        raise InputError(
            f"'frames' has shape {array.shape}, smaller than a period of {down}×{right}"
        )
    several = Counter(label for row in colours.pattern for label in row)
    found: dict[str, Array] = {}
    numbers = Counter[str]()
    for row, col in np.ndindex(down, right):
        label = colours.pattern[row][col]
        numbers[label] += 1
        name = label if several[label] == 1 else f"{label}{numbers[label]}"
        found[name] = array[..., row::down, col::right]
    return found

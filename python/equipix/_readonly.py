"""Arrays of immutable results, which cannot be written to."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from equipix._types import Array


class ReadOnly:
    """Base of frozen dataclasses whose arrays are read-only.

    They are views: nothing is copied, and an array that the caller made stays writeable.
    """

    def __post_init__(self) -> None:
        """Replace each array by a read-only view of it."""
        fields = vars(self)
        fields |= {
            name: read_only(value)
            for name, value in fields.items()
            if isinstance(value, np.ndarray)
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Unpickle: NumPy makes arrays writeable again."""
        vars(self).update(state)
        ReadOnly.__post_init__(self)


def read_only(array: Array) -> Array:
    """Return the array itself if it is read-only, else a read-only view of it."""
    if not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view

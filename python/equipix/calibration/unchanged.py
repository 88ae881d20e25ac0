"""Whether the arrays that were calibrated are still what they were.

Exposures hold views of the caller's arrays, and the compiled fit reads them again for later
questions. A copy would double the memory of a calibration, and a checksum would read all of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from equipix._types import Array
    from equipix.exposures.exposures import Exposures

_SAMPLE = 4096
"""Values kept of each array: a change of one value in a hundred is missed with a probability of
exp(−41), of one in a thousand with exp(−4)."""


def sampled_arrays(exposures: Exposures) -> dict[str, Array]:
    """Values at random places of each array of a caller that is read again, by its argument."""
    arrays = {
        "frames": exposures.values,
        "variance": exposures.variance,
        "mask": exposures.mask,
        "dark_variance": exposures.dark_variance,
    }
    return {name: _sample(array) for name, array in arrays.items() if array is not None}


def _sample(array: Array) -> Array:
    """Values at random places, the same ones at every call; all values of a small array."""
    if array.size <= _SAMPLE:
        return array.copy()
    places = np.random.default_rng(0).integers(array.size, size=_SAMPLE)
    sample: Array = array[np.unravel_index(places, array.shape)]
    return sample


def check_unchanged(exposures: Exposures, before: Mapping[str, Array]) -> None:
    """Refuse a question about exposures of whose arrays the samples differ from those before.

    Raises
    ------
    InputError
        If a sample differs; it names the array.
    """
    now = sampled_arrays(exposures)
    changed = [name for name, sample in before.items() if sample.tobytes() != now[name].tobytes()]
    if changed:
        raise InputError(
            f"{' and '.join(map(repr, changed))} of this calibration changed after it was made, "
            "and std_of reads the arrays again: calibrate copies of arrays that change later"
        )

"""Exposures without a single usable value are refused, with the reason."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import InputError
from equipix.exposures.clipping import clipping_advice

if TYPE_CHECKING:
    from collections.abc import Iterator

    from equipix._types import Bools
    from equipix.exposures.exposures import Exposures

_REASONS = {  # the first that most pixels share: dark frames scatter more than a wrong model too
    "noisy": "scatters between frames by more than its noise model explains: correct the gain "
    "('gain_dn_per_e' in [sensor], 'variance' of calibrate), or leave it out",
    "hot": "is hot in the dark frames: give dark frames of the same camera and exposure time",
    "dead": "does not respond to light: is the dark that of these frames?",
}


def refuse_nothing(exposures: Exposures, given: Bools | None) -> None:
    """Refuse exposures that leave no value to use, if the mask `given` is not the reason.

    Raises
    ------
    InputError
        With what most pixels were left out for.
    """
    if any(part.any() for part in _parts(exposures, exposures.mask)):
        return
    if not np.isfinite(exposures.values).any():
        raise InputError(
            "'frames' holds no finite number: every value is NaN, infinite or saturated"
        )
    left = np.any([*_parts(exposures, given)], axis=0)
    if exposures.clipped is not None and left.any():
        raise InputError(f"'frames': {clipping_advice(exposures.clipped)}")
    for name, reason in _REASONS.items():
        found = getattr(exposures.findings, name)
        if found is not None and 2 * np.count_nonzero(left & found) > np.count_nonzero(left):
            raise InputError(f"'frames' leave no usable pixel: nearly each {reason}")


def _parts(exposures: Exposures, mask: Bools | None) -> Iterator[Bools]:
    """Pixels of each exposure with a finite value that a mask leaves."""
    for k, values in enumerate(exposures.values):
        masked = False if mask is None else mask[k] if mask.ndim == 3 else mask
        yield np.isfinite(values) & ~np.asarray(masked)

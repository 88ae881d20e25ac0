"""Misfit of response curves that most pixels have in common: of the order, or of the noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import MisfitWarning, warn
from equipix.flags import usable

if TYPE_CHECKING:
    from equipix._types import Array
    from equipix.nuc.response import Response

_MOST = 2.0
"""Misfit of the array above which more of it comes from the order than from noise."""


def median_of_noise(freedom: Array) -> Array:
    """Median of reduced χ² with so many degrees of freedom, after Wilson and Hilferty."""
    return np.asarray((1 - 2 / (9 * freedom)) ** 3)


def common_misfit(response: Response) -> float:
    """Median over usable pixels of reduced χ², over the median that noise alone has."""
    if response.metadata.get("options", {}).get("weights") != "variances":
        return float("nan")
    judged = usable(response.flags) & (response.freedom > 0)
    if not judged.any():
        return float("nan")
    noise = median_of_noise(response.freedom[judged])
    return float(np.median(response.reduced_chi2[judged] / noise))


def warn_of_misfit(response: Response, misfit: float) -> None:
    """Warn where more of the misfit comes from the order than from noise, and say what to do."""
    if not misfit > _MOST:
        return
    order, levels = response.order, len(response.levels)
    higher = ""
    if order < 3:
        more = "fit with" if order < levels - 2 else "give more levels and fit with"
        higher = f"{more} order={order + 1} or order='auto', "
    warn(
        f"curves of order {order} leave half of the pixels a misfit of {misfit:.3g} or more times "
        f"that of noise: {higher}check that the source was steady and that the noise was as "
        "stated. find_defects flags pixels that deviate from the others, not what all have in "
        "common",
        MisfitWarning,
    )

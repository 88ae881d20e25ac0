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

_LEAST = 0.5
"""Mean of reduced χ² below which the noise is less than stated."""


def median_of_noise(freedom: Array) -> Array:
    """Median of reduced χ² with so many degrees of freedom, after Wilson and Hilferty."""
    return np.asarray((1 - 2 / (9 * freedom)) ** 3)


def common_misfit(response: Response) -> float:
    """Median over usable pixels of reduced χ², over the median that noise alone has.

    At most its mean: where rounding is above the noise residuals have few different values, and
    their median may be any of them.
    """
    if response.metadata.get("options", {}).get("weights") != "variances":
        return float("nan")
    judged = usable(response.flags) & (response.freedom > 0)
    if not judged.any():
        return float("nan")
    noise = median_of_noise(response.freedom[judged])
    chi2 = response.reduced_chi2[judged]
    return float(min(np.median(chi2 / noise), chi2.mean()))


def warn_of_misfit(response: Response, misfit: float) -> None:
    """Warn of a misfit that noise does not explain, or of less than noise, and say what to do."""
    if misfit < _LEAST:
        _warn_of_large_noise(response)
    if not misfit > _MOST:
        return
    order, levels = response.order, len(response.levels)
    higher = ""
    if response.metadata["options"]["order"] == "auto":
        higher = "no other order predicts levels that are left out better, so "
    elif order < 3:
        more = "fit with" if order < levels - 2 else "give more levels and fit with"
        higher = f"{more} order={order + 1} or order='auto', "
    warn(
        f"curves of order {order} leave half of the pixels a misfit of {misfit:.3g} or more times "
        f"that of noise: {higher}check that the source was steady and that the noise was as "
        "stated. find_defects flags pixels that deviate from the others, not what all have in "
        "common",
        MisfitWarning,
    )


def _warn_of_large_noise(response: Response) -> None:
    """Warn of residuals that are smaller than the noise, of which not all pixels have few."""
    judged = usable(response.flags) & (response.freedom > 0)
    chi2 = float(response.reduced_chi2[judged].mean())
    if chi2 < _LEAST:
        warn(
            f"the residuals of the curves are smaller than the noise predicts (reduced "
            f"chi-square {chi2:.3g}, expected 1, limit {_LEAST:g}): standard deviations are too "
            "large, and bad pixels may be missed. Check that the light was steady while the "
            "frames of a level were taken, and that the noise was as stated",
            MisfitWarning,
        )

"""Bad pixels of a response and of frames: criteria, their limits, and what was found."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from equipix._check import check_type, naming_memory
from equipix._readonly import ReadOnly
from equipix.correction.protocol import named_cfa
from equipix.errors import MisfitWarning, warn
from equipix.flags import set_bits, usable
from equipix.mosaic import Filters
from equipix.nuc.criteria import mean_slope, of_frames, of_response, too_few_for_flicker
from equipix.nuc.limits import DefectLimits
from equipix.nuc.misfit import common_misfit, warn_of_misfit
from equipix.nuc.response import Response

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from equipix._types import Array, Floats
    from equipix.colour import Colours
    from equipix.frames import FrameStatistics

__all__ = ["DefectLimits", "Defects", "find_defects"]

PERCENTILES = (0.1, 1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0, 99.9)
"""Percentiles that describe the distribution of K."""


@dataclass(frozen=True, eq=False)
class Defects(ReadOnly):
    """Bad pixels, the result of `find_defects`.

    Attributes
    ----------
    flags : ndarray, shape (rows, cols), uint32
        Bits of `equipix.Flag`: those of the response, and those found.
    counts : dict of str to int
        Pixels of each kind; one pixel may be of several. ``"unusable"`` counts all that are flagged
        ``DO_NOT_USE``. A kind that is not determinable has no number here.
    gain_percentiles : dict of str to float
        Distribution of K over the pixels that are determined: percentiles by their names.
    misfit : float
        Reduced χ² that half of the usable pixels exceed, over that of noise alone: about 1 if the
        curves are of this order. NaN where no noise was known, or no level is left over.
    limits : DefectLimits
        The limits that were used.
    not_determinable : dict of str to str
        Kinds that these frames are too few for, with the reason. Pixels that were found
        nevertheless are flagged.
    """

    flags: Array
    counts: dict[str, int]
    gain_percentiles: dict[str, float]
    misfit: float = float("nan")
    limits: DefectLimits = field(default_factory=DefectLimits)
    not_determinable: dict[str, str] = field(default_factory=dict)


def find_defects(
    response: Response,
    frames: ArrayLike | FrameStatistics | None = None,
    *,
    cfa: ArrayLike | None = None,
    limits: DefectLimits | None = None,
) -> Defects:
    """Find bad pixels by their response curves and by frames of one steady level.

    Parameters
    ----------
    response : Response
        Response curves.
    frames : array_like of shape (n, rows, cols), or FrameStatistics, optional
        Raw frames of one steady even level, or their average; without them noise is not judged, and
        of an average flicker is not.
    cfa : str or array_like of labels, optional
        Colour filters of the pixels, as for `equipix.calibrate`, where the response was fitted
        without: slopes are then compared within a colour.
    limits : DefectLimits, optional
        Limits of the criteria.

    Returns
    -------
    Defects
        ``response.with_flags(defects.flags, cfa=cfa)`` is a response that has them.

    Raises
    ------
    InputError
        If an argument is of another type, the frames are of another shape, fewer than two, or
        without a value, or `cfa` is no pattern or another than that of the response.

    Warns
    -----
    MisfitWarning
        If the curves of most pixels are of another order, or the noise was not as stated; if the
        slopes show a pattern of colour filters that nobody has named.
    DriftWarning
        If frame means scatter by more than five times the noise of a pixel: they are then hardly
        frames of one level.

    Notes
    -----
    ============== =================================================================== =========
    kind           criterion                                                           flag
    ============== =================================================================== =========
    dead           mean slope of the curve below `limits.response` of the neighbours'  DEAD
    non_responding 1/(1 + K) above `limits.gain` or negative, K the mean slope less 1  DEAD
    noisy          noise above `limits.noise` times that of its signal, beyond chance  HOT
    flickering     noise beyond chance, and slower than white noise                    TELEGRAPH
    out_of_range   values in less than `limits.range` of the range of levels           OTHER
    nonlinear      reduced χ² beyond chance and beyond that of the array               NONLINEAR
    ============== =================================================================== =========

    All come with ``DO_NOT_USE``. Dead and noisy pixels are decided by the functions that
    `equipix.calibrate` uses; there all noise beyond chance counts, since it decides on weights.
    Beyond chance is six standard deviations of the scatter of a sample variance.

    Where the order is too low, all pixels misfit. The excess of χ² is then judged as the square of
    a normal variable whose variance follows from its median over the array: a pixel is flagged if
    it deviates from the others. `Defects.misfit` and the warning name the order.

    Von Neumann's ratio is Σ(x_k+1 − x_k)²/Σ(x_k − x̄)², which is 2 for white noise with a standard
    deviation of 2·√((n − 2)/(n² − 1)) [1]_; the mean of each frame is subtracted before. Noise with
    a correlation r of successive frames lies r·√(n + 2) of them below. With r = 1/2, which a pixel
    has that often jumps, that is the limit of 5 from 98 frames on: below, flicker is not
    determinable. Of jumps by five standard deviations in a twentieth of the frames 2 % were found
    with 32 frames, 77 % with 64 and 96 % with 98.

    References
    ----------
    .. [1] J. von Neumann, "Distribution of the ratio of the mean square successive difference to
       the variance", Annals of Mathematical Statistics 12 (1941) 367-395.
    """
    wanted = "a Response: equipix.load(path), or the result of equipix.nuc.fit"
    check_type("response", response, Response, wanted)
    limits = DefectLimits() if limits is None else limits
    check_type("limits", limits, DefectLimits, "equipix.nuc.DefectLimits(noise=2.0, ...)")
    with naming_memory("finding bad pixels"):
        misfit = common_misfit(response)
        slope = mean_slope(response)
        colours, filters = _filters(response, named_cfa(response, cfa), slope)
        found = of_response(response, slope, limits, misfit, filters)
        if frames is not None:
            found |= of_frames(frames, usable(response.flags), limits, colours)
    flags = response.flags.copy()
    for kind, pixels in found.items():
        set_bits(flags, kind, pixels)
    few = too_few_for_flicker(frames, limits) if "flickering" in found else {}
    counts = {kind: int(np.count_nonzero(each)) for kind, each in found.items() if kind not in few}
    counts["unusable"] = int(np.count_nonzero(~usable(flags)))
    gain = slope - 1
    known = gain[np.isfinite(gain)]
    percentiles = np.percentile(known, PERCENTILES) if known.size else np.full(len(PERCENTILES), 0)
    named = {f"{name:g}": float(each) for name, each in zip(PERCENTILES, percentiles, strict=True)}
    warn_of_misfit(response, misfit)
    return Defects(flags, counts, named, misfit, limits, few)


def _filters(
    response: Response, given: Colours | None, slope: Floats
) -> tuple[Colours | None, Filters | None]:
    """Colours of the pixels, and filters of slopes that are not over the mean of a colour."""
    if response.cfa is not None:
        return response.cfa, None
    filters = Filters.of(given, slope)
    if filters is None:
        return None, None
    if filters.words:
        warn(filters.words, MisfitWarning)
    return filters.colours, filters

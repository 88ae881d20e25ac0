"""Bad pixels of response curves and of frames, by limits."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import Array, Bools, Floats, ReadOnly, check_type, naming_memory
from equipix.correction.protocol import named_cfa
from equipix.errors import InputError
from equipix.findings import Finding, Findings, ask, say, set_bits, usable
from equipix.io.frames import FrameFiles
from equipix.measured import defects, noise
from equipix.measured.colour import Colours, Filters, planes_of
from equipix.measured.defects import DefectLimits
from equipix.measured.part import blocks, known_part, spread
from equipix.measured.statistics import FrameStatistics, Light, light_of
from equipix.metrics.frame_noise import STEADY, Temporal, stack_of, temporal_of
from equipix.nuc.curves import response_at
from equipix.nuc.level_rules import CURVES, Curves
from equipix.nuc.response import Response, common_misfit

_SAMPLED = 4096
"""Pixels that show the step between values."""

_FEWEST_SAMPLED = 64
"""Pixels of each of many frames."""

_CORRELATED = 0.5
"""Correlation of successive frames from which flicker must be found."""

_NEW_SERIES = 0.25
"""Excess of the difference of two successive frames from which their pattern differs: by the
noise of a pixel."""


def mean_slope(response: Response) -> Floats:
    """Mean slope 1 + K of each curve between its limits; of one level 1 + K of the fit."""
    low, high = response.limits
    if response.order == 0:
        return np.where(np.isnan(response.deviation[0]), np.nan, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        rise = response_at(response.deviation, high) - response_at(response.deviation, low)
        slope = rise / (high - low)
    return np.asarray(np.where(high > low, slope, 1 + response.deviation[1]))


def of_response(
    response: Response, slope: Floats, limits: DefectLimits, misfit: float, filters: Filters | None
) -> dict[str, Bools]:
    """Bad pixels by their curves of this mean slope; `misfit` is that of the array.

    `filters` are those of slopes that are not over the mean of a colour.
    """
    usual: Floats | float = 1.0
    if filters is not None:
        usual = filters.map_of(response.shape)
        slope = slope / usual
    known = np.isfinite(slope)
    low, high = response.limits
    whole = _range(response)
    found = {
        "dead": _dead(response, slope, usual, limits.response),
        "non_responding": slope * limits.gain < 1,
        "out_of_range": known & (high - low < limits.range * whole),
    }
    if not np.isnan(misfit):
        found["nonlinear"] = _nonlinear(response, limits.misfit, misfit)
    return found


def _range(response: Response) -> Floats:
    """Range of the levels, in which those of a colour are its own."""
    low, high = response.limits
    whole = np.zeros(response.shape)
    for plane in planes_of(response.cfa, response.shape):
        known = plane & np.isfinite(low) & np.isfinite(high)
        if known.any():
            ends = (
                np.max(high, where=known, initial=-np.inf),
                np.min(low, where=known, initial=np.inf),
            )
            whole[plane] = ends[0] - ends[1]
    return whole


def of_frames(
    frames: ArrayLike | FrameFiles | FrameStatistics,
    good: Bools,
    limits: DefectLimits,
    cfa: Colours | None,
) -> tuple[dict[str, Bools], Findings]:
    """Bad pixels by their noise, and what limits it; `good` are those whose curves are usable."""
    steps, light = None, Light()
    said: Findings = ()
    given = frames.mean if isinstance(frames, FrameStatistics) else stack_of("frames", frames)
    if given.shape[-2:] != good.shape:
        raise InputError(f"'frames' has frames of {given.shape[-2:]}, the sensor {good.shape}")
    if isinstance(frames, FrameStatistics):
        mean, variance, count = frames.mean, frames.variance, int(frames.count.max())
        step, light = frames.step, light_of(frames)
    else:
        over_time = temporal_of(given, ~good)
        said = say(*ask(STEADY, over_time.steadiness))
        if not said:
            _refuse_series(over_time)
        mean, variance, steps, _, count, *_ = over_time
        pixels = max(_SAMPLED // count, _FEWEST_SAMPLED)
        sampled = np.unravel_index(spread(good.size, pixels), good.shape)
        step = noise.step_of(np.array([frame[sampled] for frame in given]))
    if count < 2:
        raise InputError("'frames' holds one frame, expected two or more: one shows no noise")
    common = None if light == Light() else light.variance(mean)
    period = (1, 1) if cfa is None else cfa.period
    model = _common_noise(mean, variance, good, count, step, common, period)
    noisy, flickering = np.zeros((2, *good.shape), bool)
    if model is not None:
        of_level = mean[None], variance[None], [count], model
        flickering = defects.noisy_pixels(*of_level, [Light()])
        noisy = defects.noisy_pixels(*of_level, [light], times=limits.noise)
    if isinstance(frames, FrameStatistics) and frames.reject is not None:
        missing = np.where(frames.count > 0, count - frames.count.astype(np.int64), 0)
        noisy = noisy | defects.often_rejected(missing, count)
    found = {"noisy": noisy}
    if steps is not None:
        of_pixels = steps[flickering], variance[flickering]
        flickering[flickering] = defects.flickering_pixels(*of_pixels, count, limits.correlation)
        found["flickering"] = flickering
    return found, said


def _refuse_series(found: Temporal) -> None:
    """Refuse frames of which two successive ones differ in their pattern, not by noise alone."""
    if not found.changes.size:
        return
    usual, largest = np.median(found.changes), np.argmax(found.changes)
    # A mean absolute difference of N pixels errs by 0.76/√N.
    limit = 1 + max(_NEW_SERIES, defects.SIGMAS / np.sqrt(np.count_nonzero(found.used)))
    if found.changes[largest] > limit * usual > 0:
        raise InputError(
            f"'frames' {largest} and {largest + 1}, counted from 0, differ "
            f"{found.changes[largest] / usual:.3g} times as much as two frames usually do "
            f"(limit {limit:.3g}): they are of two series or sensors, or the camera has renewed "
            "its offsets between them: give frames of one series"
        )


def too_few_for_flicker(frames: object, limits: DefectLimits) -> dict[str, str]:
    """Say that frames are too few to find flicker, if they are."""
    count = len(frames if isinstance(frames, FrameFiles) else np.asarray(frames))
    needed = int(np.ceil((limits.correlation / _CORRELATED) ** 2 - 2))
    return {"flickering": f"below {needed} frames"} if count < needed else {}


def _dead(response: Response, slope: Floats, usual: Floats | float, least: float) -> Bools:
    """Pixels that rise less than their neighbours, by more than the error of their slope."""
    if response.order == 0 or not np.isfinite(slope).any():
        return np.zeros(slope.shape, bool)
    # Of a line; that of a higher order at 0, which is larger than that of the mean slope.
    std = np.sqrt(np.nan_to_num(response.variances[1])) / usual
    return defects.response_outliers(slope, lambda: std, least=least)[0]


def _nonlinear(response: Response, sigmas: float, misfit: float) -> Bools:
    """Pixels whose curve fits worse than noise, and the misfit of the array, explain."""
    found = np.zeros(response.shape, bool)
    common, freedoms = sigmas**2 * max(0.0, misfit - 1) / noise.MEDIAN_SQUARE, response.freedom
    limits = [
        noise.scatter_limit(freedom + 1, sigmas=sigmas) + common if freedom else np.inf
        for freedom in range(len(response.levels) + 1)
    ]
    for rows in blocks(response.shape):
        found[rows] = response.reduced_chi2[rows] > np.array(limits)[freedoms[rows]]
    return found


def _common_noise(
    mean: Array,
    variance: Array,
    good: Bools,
    count: int,
    step: float,
    light: Array | None,
    period: tuple[int, int],
) -> noise.NoiseModel | None:
    """Noise that pixels of a signal have in common; None of equal frames that are not rounded."""
    known = good & np.isfinite(mean) & np.isfinite(variance)
    if not known.any():
        known = np.isfinite(mean) & np.isfinite(variance)
    points = noise.photon_transfer(mean, variance, known, count, step, light, period)
    if not len(points):
        raise InputError("'frames' hold no value: they show no noise")
    if step == 0 and not points[:, 1].any():
        return None
    return noise.NoiseModel.fit(points, step=step)


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
        Distribution of K over the pixels that are determined, of 2¹⁹ of them, evenly over the
        sensor, where there are more: percentiles by their names.
    misfit : float
        Reduced χ² that half of the usable pixels exceed, over that of noise alone: about 1 if the
        curves are of this order. NaN where no noise was known, or no level is left over.
    limits : DefectLimits
        The limits that were used.
    not_determinable : dict of str to str
        Kinds that these frames are too few for, with the reason. Pixels that were found
        nevertheless are flagged.
    findings : tuple of Finding
        What limits the result, each also a warning.
    """

    flags: Array
    counts: dict[str, int]
    gain_percentiles: dict[str, float]
    misfit: float = float("nan")
    limits: DefectLimits = field(default_factory=DefectLimits)
    not_determinable: dict[str, str] = field(default_factory=dict)
    findings: Findings = ()


def find_defects(
    response: Response,
    frames: ArrayLike | FrameFiles | FrameStatistics | None = None,
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
        ``response.with_flags(defects.flags, cfa=cfa, findings=defects.findings)`` is a response
        that has them.

    Raises
    ------
    InputError
        If an argument is of another type, the frames are of another shape, fewer than two, or
        without a value, or those of two series, which differ in their pattern; or `cfa` is no
        pattern or another than that of the response.

    Warns
    -----
    MisfitWarning
        If the curves of most pixels are of another order, or the noise was not as stated; if the
        slopes show a pattern of colour filters that nobody has named.
    MisfitWarning
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
        given = named_cfa(response, cfa)
        # Slopes of a response with filters are over the mean of a colour.
        filters = Filters.of(given, slope) if response.cfa is None else None
        colours = response.cfa if filters is None else filters.colours
        said: Findings = ()
        if filters is not None and filters.words:
            said = say(Finding("cfa", filters.words, "misfit"))
        found = of_response(response, slope, limits, misfit, filters)
        if frames is not None:
            by_noise, more = of_frames(frames, usable(response.flags), limits, colours)
            found |= by_noise
            said += more
    flags = response.flags.copy()
    for kind, pixels in found.items():
        set_bits(flags, kind, pixels)
    few = too_few_for_flicker(frames, limits) if "flickering" in found else {}
    counts = {kind: int(np.count_nonzero(each)) for kind, each in found.items() if kind not in few}
    counts["unusable"] = int(np.count_nonzero(~usable(flags)))
    known = known_part(slope) - 1
    percentiles = np.percentile(known, PERCENTILES) if known.size else np.full(len(PERCENTILES), 0)
    named = {f"{name:g}": float(each) for name, each in zip(PERCENTILES, percentiles, strict=True)}
    said += say(*ask(CURVES, Curves(response, misfit)))
    return Defects(flags, counts, named, misfit, limits, few, said)

"""Fit of response curves to levels of a uniform source."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import LOG, Array, Bools, By, Floats, Order, naming_memory, positive_workers
from equipix.findings import ask, say, set_bits, usable
from equipix.io.record import made, now
from equipix.measured.means import Averaged
from equipix.measured.noise import NoiseModel, median_of_noise
from equipix.measured.part import blocks, median
from equipix.measured.statistics import FrameStatistics
from equipix.nuc.curves import horner_inverse, least_slope
from equipix.nuc.level_rules import CURVES, INVERSE, Curves, inverse_error
from equipix.nuc.levels import Levels, alike_pixels, levels_of
from equipix.nuc.order import check_count, check_gain, check_order, chosen_order, next_power
from equipix.nuc.response import Response, common_misfit

_MOST_MOVED = 0.01
"""Square by which pixels that deviate may move V̄, over the variance of a value."""

_ROUNDING = 1e-9
"""Residual of exact levels, relative to the largest: it shows no pixel that deviates."""


def fit(
    levels: ArrayLike | Sequence[FrameStatistics] | Averaged,
    *,
    order: Order = 1,
    by: By = "offset",
    variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None = None,
    mask: ArrayLike | None = None,
    saturation: float | None = None,
    cfa: ArrayLike | None = None,
    workers: int | None = None,
) -> Response:
    r"""Fit the response curve of every pixel to levels of a uniform source.

    Parameters
    ----------
    levels : sequence of FrameStatistics, or array_like of shape (n, rows, cols)
        Mean frames of a uniform source (black body, integrating sphere), one a level, in DN, in any
        order. Averages bring their noise, dark and bad pixels along; of plain arrays only the
        values are known. Raw levels are welcome: the offset is part of the curve. NaN in arrays,
        and saturated values, are not used.
    order : {0, 1, 2, 3, "auto"}
        Highest power of the array's mean: 0 one-point, 1 two-point, 2 quadratic, 3 cubic. It needs
        order + 1 levels that differ. "auto" takes the order that best predicts levels left out.
    by : {"offset", "gain"}
        What a one-point correction (``order=0``) changes. "gain" needs levels without dark level:
        averages of raw frames are refused.
    variance : NoiseModel, array_like of shape (n,), or sequence of NoiseModel, optional
        Variance of the values given, in DN²; by default averages give it, and arrays have equal
        weights.
    mask : array_like of bool, shape (rows, cols) or (n, rows, cols), optional
        True = do not use.
    saturation : float, optional
        Level of saturation of arrays, in DN; by default the largest value of a whole-number dtype.
    cfa : str or array_like of labels, optional
        Colour filters of the pixels, as for `equipix.calibrate`. Neighbours, and the mean V̄ of the
        array, are then those of a colour, so that a corrected frame keeps its white balance.
    workers : int, optional
        Number of threads; by default one for each processor. It changes no bit of the result.

    Returns
    -------
    Response
        The curves, their standard errors, and the correction that inverts them.

    Raises
    ------
    InputError
        If levels are too few, do not differ by more than noise, or saturate in half of the
        pixels; if a level has one value, the highest, in nearly all pixels, whether a saturation
        level was given or not; or an argument has a wrong shape or value.
    InsufficientMemoryError
        If there is not enough memory.

    Warns
    -----
    InputWarning
        If many values are exactly the highest one, and no saturation level was given for it; or
        averages show less than half the noise of a darker level, as a full well has it.
    InputWarning
        If the median of a level less the dark is below 0 by more than the noise of a value.
    MisfitWarning
        If the noise is known, and curves of order 1 or 2 would be better with the next order: the
        variance of its coefficient is above twice that by noise. For other causes, if half of the
        pixels have a reduced χ² above twice that of noise.
    MisfitWarning
        If the cubic of orders 2 and 3 differs from the exact inverse by more than 0.3 of the noise
        of a frame at the lowest level, which adds 4 % to it, in more than 0.1 % of the usable
        pixels.

    Notes
    -----
    At every level all pixels see the same light. The deviation of a pixel's mean V from the mean
    V̄ of the array is fitted as a polynomial of V̄ [1]_,

    .. math:: V - \bar V = a + K \bar V + c \bar V^2 + e \bar V^3

    by least squares with weights 1/σ², the variance at the signal that a first fit expects. V̄ is
    the mean over good pixels that have a value at every level, so it is nearly free of noise;
    within the fit it is scaled to [−1, 1]. A pixel is good if it is not hot, noisy or dead by the
    tests of `equipix.calibrate`, and rises from the lowest to the highest level by half to twice
    as much as its neighbours. Pixels whose residuals deviate from the others by more than six
    standard deviations do not count in V̄ where they move it by more than a tenth of the noise.

    The radiation need not be known, only uniform: the fall-off of the source or of a lens enters
    the coefficients as gain.

    References
    ----------
    .. [1] "Correction of the non-uniformity of parameters of focal plane arrays", in a course on
       staring infrared systems (in Russian); it quotes studies of PtSi, InSb and HgCdTe arrays.

    Examples
    --------
    >>> import numpy as np
    >>> import equipix
    >>> gain = np.array([[0.9, 1.0, 1.1]])
    >>> levels = [level * gain + 20 for level in (100.0, 1000.0)]
    >>> response = equipix.nuc.fit(levels, order=1)
    >>> response.correct(500 * gain + 20).round(6)
    array([[520., 520., 520.]])
    """
    check_order(order, by)
    with naming_memory("fitting response curves"):
        given = levels_of(levels, variance=variance, mask=mask, saturation=saturation, cfa=cfa)
    return fitted(given, order=order, by=by, workers=workers)


def fitted(
    given: Levels,
    *,
    order: Order,
    by: By,
    workers: int | None = None,
    provenance: dict[str, Any] | None = None,
) -> Response:
    """Fit response curves to checked levels; `provenance` is added to the metadata.

    The other parameters and the errors are those of `fit`.
    """
    started = now()
    workers = positive_workers(workers)
    with naming_memory("fitting response curves"):
        options: dict[str, Any] = {"order": order, "by": by}
        parts = _parts(given)
        if order == "auto":
            orders = [chosen_order(part, by, workers=workers) for _, part in parts]
            chosen, options["prediction_errors"] = max(orders, key=lambda each: each[0])
            LOG.info("order %d predicts held-out levels best", chosen)
        else:
            chosen = int(order)
        LOG.info("fits %d levels of %d × %d pixels by order %d", len(given), *given.shape, chosen)
        for _, part in parts:
            check_count(part, chosen)
            if chosen == 0 and by == "gain":
                check_gain(part)
        options["weights"] = "equal" if given.level_noise is None else "variances"
        curves = [(pixels, _curves(part, chosen, by, workers)) for pixels, part in parts]
        metadata = made(options=options, started=started) | (provenance or {})
        metadata["level_variances"] = given.variances.tolist()
        response = _response(given, _joined(curves), metadata)
        found = ask(INVERSE, response)
        # One point is right at one level, whatever the others are; "auto" judged them all.
        if chosen > 0 or order == "auto":
            misfit = common_misfit(response)
            if order != "auto" and (len(given) - chosen - 1) * (misfit - 1) > 1:
                response.metadata["next_power"] = _next_power(parts, chosen, workers)
            found += ask(CURVES, Curves(response, misfit))
        return replace(response, findings=response.findings + say(*found))


def _next_power(
    parts: list[tuple[Bools, Levels]], order: int, workers: int | None
) -> dict[str, float] | None:
    """What `next_power` finds of the colour that most needs it; None where no levels give it."""
    found = [
        next_power(part, order, workers=workers)
        for _, part in parts
        if order < 3 and part.distinct() > order + 1
    ]
    return max(found, key=lambda each: each["ratio"], default=None)


def _parts(levels: Levels) -> list[tuple[Bools, Levels]]:
    """The levels of each colour, with a map of its pixels; all of them without colours."""
    everywhere = np.ones(levels.shape, bool)
    if levels.colours is None:
        return [(everywhere, levels)]
    planes = [plane for _, plane in levels.colours.planes(everywhere.shape)]
    return [(plane, levels.of_pixels(plane)) for plane in planes if levels.good[plane].any()]


def _joined(parts: list[tuple[Bools, dict[str, Array]]]) -> dict[str, Array]:
    """Put the maps of each colour together; NaN, 0 or False where there is none.

    The mean of the array at each level is that over the pixels of all colours.
    """
    if len(parts) == 1 and parts[0][0].all():
        return parts[0][1]
    counts = [pixels.sum() for pixels, _ in parts]
    means = [maps.pop("levels") for _, maps in parts]
    joined: dict[str, Array] = {"levels": np.average(means, axis=0, weights=counts)}
    shape = parts[0][0].shape
    for name, first in parts[0][1].items():
        nothing = np.nan if first.dtype.kind == "f" else 0
        joined[name] = np.full((*first.shape[:-2], *shape), nothing, first.dtype)
        for pixels, maps in parts:
            joined[name][..., pixels] = maps[name][..., 0, :]
    return joined


def _curves(levels: Levels, order: int, by: By, workers: int | None) -> dict[str, Array]:
    """Fit one order and invert it: maps and levels of a `Response`, and where curves rise."""
    found = levels.fit(order, by, workers=workers)
    spare = len(levels) - (order + 1)
    cleaned = _of_alike_pixels(levels, found[2], spare) if order > 0 and spare > 0 else None
    if cleaned is not None:
        del found  # before the next maps are made
        levels, found = cleaned, cleaned.fit(order, by, workers=workers)
    deviation, variances, misfit, used = found
    if levels.level_noise is None:
        variances *= _pooled(misfit, used, order + 1, levels.good)
    _add_dark(variances, levels, by if order == 0 else "offset")
    limits = levels.limits()
    rising, difference = np.empty(used.shape, bool), np.empty(used.shape)
    inverse = np.empty((2 if order < 2 else 4, *used.shape))
    for rows in blocks(used.shape):
        curves, ends = deviation[:, rows], limits[:, rows]
        rising[rows] = least_slope(curves, ends) > 0
        usable_curves = np.where(rising[rows], curves, np.nan)
        inverse[:, rows], difference[rows] = horner_inverse(usable_curves, ends)
        freedom = used[rows].astype(np.int64) - (order + 1)
        reduced = misfit[rows] / np.maximum(freedom, 1)
        misfit[rows] = np.where(freedom > 0, reduced, np.nan)
    return {
        "deviation": deviation,
        "variances": variances,
        "inverse": inverse,
        "inverse_error": difference,
        "limits": limits,
        "reduced_chi2": misfit,
        "used": used,
        "rising": rising,
        "levels": levels.references,
    }


def _response(levels: Levels, maps: dict[str, Array], metadata: dict[str, Any]) -> Response:
    """Make the result of the maps of `_curves`."""
    flags = _flags(maps["deviation"], levels, maps.pop("rising"))
    error = maps["inverse_error"][usable(flags)]
    metadata["inverse"] = inverse_error(error, levels.frame_noise)
    return Response(
        **maps,
        flags=flags,
        dark=levels.dark,
        raw=levels.raw,
        saturation=levels.saturation,
        metadata=metadata,
        findings=levels.findings,
        cfa=levels.colours,
        colour_response=levels.filters.response if levels.colours and levels.filters else None,
    )


def _of_alike_pixels(levels: Levels, misfit: Floats, freedom: int) -> Levels | None:
    """Levels without pixels in V̄ that deviate from the others, where these move it by much.

    A pixel that saturates bends V̄, and so the deviation of all others. Moves below a tenth of the
    noise of a value, which add 1 % to χ², pass.
    """
    rounding = (_ROUNDING * np.abs(levels.references).max()) ** 2 / levels.variances.min()
    squares = misfit[levels.good][None]
    np.maximum(squares, len(levels) * rounding, out=squares)
    alike = alike_pixels(squares)
    if alike.all():
        return None
    cleaned = levels.counting(alike)
    typical = median(squares) / (freedom * median_of_noise(np.array(freedom)))
    noise = levels.variances if levels.level_noise else typical
    moved = (cleaned.references - levels.references) ** 2
    return cleaned if np.any(moved > _MOST_MOVED * noise) else None


def _pooled(misfit: Floats, used: Array, coefficients: int, usable: Array) -> float:
    """Variance of a value from the residuals of all good pixels; NaN without freedom."""
    total = int((used[usable].astype(np.int64) - coefficients).sum())
    return float(misfit[usable].sum()) / total if total > 0 else float("nan")


def _add_dark(variances: Floats, levels: Levels, by: By) -> None:
    """Add the noise of the dark, which changes all values of a pixel by the same amount."""
    if levels.dark_variance is None:
        return
    if by == "offset":
        variances[0] += levels.dark_variance
        return
    weighted = levels.references / levels.variances
    factor = weighted.sum() / (weighted @ levels.references)
    variances[1] += levels.dark_variance * factor**2


def _flags(deviation: Floats, levels: Levels, rising: Array) -> Array:
    """Bits of `equipix.Flag` of each pixel."""
    flags = np.zeros(levels.shape, np.uint32)
    bad_pixels, undetermined = levels.bad_pixels, np.isnan(deviation[0])
    for finding, pixels in vars(bad_pixels).items():
        set_bits(flags, finding, pixels)
    set_bits(flags, "undetermined", undetermined)
    falling = ~rising & ~undetermined
    set_bits(flags, "falling", falling if bad_pixels.dead is None else falling & ~bad_pixels.dead)
    return flags

"""Offset and gain against the state, from a shutter and black bodies."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import LOG, Array, Bools, Floats, Words, as_mask, is_whole, union
from equipix.bolometer.dynamic import DynamicCorrection
from equipix.bolometer.held_out import HIGHEST, STATES, Judged, Observed
from equipix.bolometer.states import Axes, Regressor, States, check_spread, solver_of
from equipix.errors import InputError
from equipix.findings import Finding, Findings, Flag, ask, say, set_bits, usable
from equipix.io.record import made, now
from equipix.measured.defects import BadPixels, response_outliers
from equipix.measured.measured import Measured, measured_of
from equipix.measured.saturation import clipping
from equipix.measured.statistics import FrameStatistics

_BODIES = ("cold", "hot")
"""Names of the black bodies in messages."""

_COUNTED = "(states count from 0)"

_NEARER = 0.5
"""Distance of a pattern to that of another state, over that to its own, from which it is of it."""


def fit(
    shutter: ArrayLike | Sequence[FrameStatistics],
    substrate_c: ArrayLike,
    bias_v: ArrayLike,
    *,
    black_bodies: tuple[ArrayLike | Sequence[FrameStatistics], ...] | None = None,
    order: int | Literal["auto"] = "auto",
    bias_order: int | None = None,
    regressor: Regressor = "temperature",
    mask: ArrayLike | None = None,
) -> DynamicCorrection:
    r"""Fit offset and gain of each pixel against substrate temperature and bias.

    Parameters
    ----------
    shutter : sequence of FrameStatistics, or array_like of shape (n, rows, cols)
        Mean frames of a shutter at the temperature of the substrate, one for each state, in DN.
    substrate_c : array_like, shape (n,)
        Temperature of the substrate at each state, in °C.
    bias_v : array_like, shape (n,), or a number
        Bias at each state in volts.
    black_bodies : tuple of two, optional
        Mean frames of a cold and a hot black body, each as `shutter` and at the same states. Their
        difference gives the gain. Each may have the temperature that suits; it need not be known,
        and exchanged they give the same. Messages name them 'cold' and 'hot'.
    order : int or "auto"
        Highest power of the temperature, of offset and gain: 0 is the static correction. "auto"
        takes for each that which best predicts a temperature that is held out.
    bias_order : int, optional
        Highest power of V²; 1 unless given, or 0 where all biases are the same.
    regressor : {"temperature", "inverse"}
        What the polynomials are of: the temperature, or one over the absolute temperature. The
        inverse suits pixels of R = R₀·exp(B/T): it needs one order less.
    mask : array_like of bool, shape (rows, cols), optional
        True = do not use.

    Returns
    -------
    DynamicCorrection
        Its `correction` gives that of a state.

    Raises
    ------
    InputError
        If shapes or numbers do not fit, the states do not determine the coefficients, or the black
        bodies do not differ, or by another sign at some states.

    Warns
    -----
    MisfitWarning
        With "auto", if the references are averages and the best prediction is worse than five
        times what their noise explains, or if temperature explains nothing. With any order, if the
        pattern of the array before the shutter turns back between two temperatures, as it does
        where some are exchanged. All temperatures in reversed order fit as well as the true ones.
        If the black bodies have the patterns of the shutter at other states.
    InputWarning
        If the hot black body is darker than the cold one.
    InputWarning
        If many values of a reference are exactly the highest one, and not known to saturate.

    Notes
    -----
    With ȳ the mean over usable pixels, d = y − ȳ before the shutter, and K = Δy/Δȳ − 1 with Δ the
    difference between the black bodies. Of each pixel, d and K are fitted by least squares as

    .. math:: \sum_{i \le order} \sum_{j \le bias\_order} c_{ij}\, T_i(t)\, T_j(v)

    with Chebyshev polynomials of the regressor t and of v = V², scaled to [−1, 1]. The bias enters
    as V² since it acts through the heat V²/R.

    With "auto" each temperature between the lowest and the highest is held out in turn, at all its
    biases; of three temperatures each. Temperatures within 1 % of the range are held out together.
    The error is the median over usable pixels of the mean square difference to the prediction by
    the others. The lowest order within 0.1 % of the smallest error is taken; `metadata` has the
    errors.

    Pixels with a missing value in a reference, and masked ones, are flagged ``NO_FLAT_FIELD``, and
    those with a saturated sample in an average, or the largest number of the type in an array of
    whole numbers, ``SATURATED``. Those with less than half of the response of their neighbours are
    flagged ``DEAD``, with more than twice of it ``HOT``, by the test of `equipix.nuc.fit`. They
    count in no mean. Without black bodies no response is known, so neither is flagged.

    References
    ----------
    .. [1] "Correction of the non-uniformity of parameters of focal plane arrays", in a course on
       staring infrared systems (in Russian): static and dynamic correction of bolometers.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import bolometer, simulate
    >>> array = simulate.BolometerArray.of((24, 32), rng=1)
    >>> celsius, volts = [-20, 0, 20, 40, 60], 2.0
    >>> shutter = [array.mean(each) for each in celsius]
    >>> correction = bolometer.fit(shutter, celsius, volts, order=4)
    >>> left = correction.correction(10.0).correct(array.mean(10.0))
    >>> bool(np.std(left) < 1e-4 * np.std(array.mean(10.0)))
    True
    """
    started = now()
    taken = references_of("shutter", shutter)
    states = States.of(substrate_c, bias_v, len(taken), bias_order, regressor)
    bodies = [] if black_bodies is None else _bodies(black_bodies, taken.shape, len(taken))
    flags = flags_of(taken, bodies, mask)
    good = usable(flags)
    named = {"shutter": taken, **dict(zip(_BODIES, bodies, strict=False))}
    clipped = [_clipping(name, each, good) for name, each in named.items()]
    said = say(*(Finding("saturation", words, "input") for words in clipped if words))
    shown = Observed(taken.values, states, good, _noise(taken, good))
    said += say(*_on_bodies(bodies, shown))
    chosen, errors, more = _order(shown, order)
    said += more
    axes, offset = _coefficients(shown, chosen)
    level = np.asarray(solver_of(axes, states) @ shown.mean)
    options = {
        "order": chosen if errors is None else "auto",
        "bias_order": states.bias_order,
        "regressor": regressor,
        "black_bodies": bool(bodies),
    }
    metadata = made(options=options, started=started, prediction_errors=errors)
    if not bodies:
        return DynamicCorrection(offset, None, level, axes, axes, flags, metadata, said)
    response, variance = response_of(bodies, good)
    rise = Observed(response, states, good, variance, is_offset=False)
    chosen, metadata["gain_prediction_errors"], more = _order(rise, order)
    gain_axes, gain = _coefficients(rise, chosen)
    return DynamicCorrection(offset, gain, level, axes, gain_axes, flags, metadata, said + more)


def _coefficients(shown: Observed, order: int) -> tuple[Axes, Floats]:
    """Coefficients of the deviation of each pixel, shape (terms, rows, cols)."""
    axes = shown.states.axes(order)
    solver = solver_of(axes, shown.states)
    check_spread(axes, shown.states, solver)
    return axes, np.tensordot(solver, shown.values - shown.mean[:, None, None], 1)


def _order(
    shown: Observed, order: int | Literal["auto"]
) -> tuple[int, list[float] | None, Findings]:
    """Order that is given, or that which best predicts; prediction errors, and findings."""
    errors: list[float] | None = None
    if isinstance(order, str) and order == "auto":
        chosen, errors = shown.chosen()
        LOG.info("order %d predicts held-out temperatures best, of errors %s", chosen, errors)
    elif is_whole(order, 0, HIGHEST):
        chosen = int(order)
    else:
        raise InputError(f"'order' is {order!r}, expected 0 to {HIGHEST} or 'auto'")
    return chosen, errors or None, say(*ask(STATES, Judged(shown, chosen, errors)))


def references_of(name: str, given: Any) -> Measured:
    """Mean frames of all states; of averages with the variances of their means."""
    listed: list[Any] = list(given) if isinstance(given, list | tuple) else []
    averages = [each for each in listed if isinstance(each, FrameStatistics)]
    means = [each.mean if isinstance(each, FrameStatistics) else each for each in listed]
    measured = measured_of(means or given, words=Words(f"'{name}'", "state"))
    saturated = [each.saturated > 0 for each in averages]
    variance = None
    if averages and len(averages) == len(listed):
        variance = np.stack([each.variance_of_mean for each in averages])
    return dataclasses.replace(
        measured,
        values=measured.values.astype(np.float64, copy=False),
        variance=variance,
        bad_pixels=BadPixels(saturated=union(measured.bad_pixels.saturated, *saturated)),
    )


def _bodies(given: Any, shape: tuple[int, int], count: int) -> list[Measured]:
    """Frames of the cold and the hot black body."""
    if not isinstance(given, list | tuple) or len(given) != 2:
        raise InputError("'black_bodies' is no pair, expected (cold, hot), each like 'shutter'")
    bodies = [references_of(name, each) for name, each in zip(_BODIES, given, strict=True)]
    for name, each in zip(_BODIES, bodies, strict=True):
        if each.values.shape != (count, *shape):
            raise InputError(
                f"'{name}' has shape {each.values.shape}, expected {(count, *shape)} like 'shutter'"
            )
    return bodies


def _noise(references: Measured, good: Bools) -> Floats | None:
    """Mean variance of the means of usable pixels at each state, where it is known."""
    if references.variance is None:
        return None
    noise = np.array([each[good].mean() for each in references.variance])
    return noise if np.isfinite(noise).all() else None


def _clipping(name: str, references: Measured, good: Bools) -> str | None:
    """Say that values of usable pixels are at exactly the highest one."""
    for k, frame in enumerate(references.values):
        found = clipping(np.where(good, frame, np.nan))
        if found is not None:
            return (
                f"{found.values} values of '{name}' at state {k} {_COUNTED} are exactly "
                f"{found.level:.10g}, the highest one: they probably saturate and count as valid: "
                "exclude their pixels by 'mask', or give averages with a 'saturation'"
            )
    return None


def _on_bodies(bodies: Sequence[Measured], shown: Observed) -> Findings:
    """Say that the black bodies are probably exchanged, or of other states than the shutter."""
    if not bodies:
        return ()
    found = []
    cold, hot = (each.values[:, shown.good].mean(axis=1) for each in bodies)
    if np.all(hot < cold):
        words = (
            f"'hot' is darker than 'cold' at every state, by {(cold - hot).min():.4g} DN or more: "
            "either they are exchanged, or the values fall as the scene warms. The correction is "
            "the same in both cases"
        )
        found.append(Finding("black_bodies", words, "input", "note"))
    for name, body in zip(_BODIES, bodies, strict=True):
        away = body.values[:, shown.good]
        own = np.arange(len(away))
        of_shutter = _nearest(away - away.mean(axis=1, keepdims=True), shown.deviation)
        # A black body as warm as another substrate may look like it; an exchange moves them all.
        if len(set(of_shutter)) < len(own) or np.array_equal(of_shutter, own):
            continue
        k = int(np.flatnonzero(of_shutter != own)[0])
        words = (
            f"'{name}' at state {k} has the pattern of 'shutter' at state {of_shutter[k]} "
            f"{_COUNTED}: give the references of '{name}' in the order of 'substrate_c'"
        )
        found.append(Finding("states", words, "misfit"))
    return tuple(found)


def _nearest(patterns: Floats, others: Floats) -> Array:
    """Number of the pattern that is nearest to each; its own unless another is far nearer."""
    squares = (patterns**2).sum(axis=1)[:, None] + (others**2).sum(axis=1)
    squares -= 2 * patterns @ others.T
    far = squares.min(axis=1) >= _NEARER**2 * squares.diagonal()
    return np.where(far, np.arange(len(patterns)), squares.argmin(axis=1))


def response_of(bodies: Sequence[Measured], good: Bools) -> tuple[Floats, Floats | None]:
    """Response of each pixel over the array's at each state, and the variance of that by noise."""
    cold, hot = bodies
    rise = hot.values - cold.values
    mean, scatter = rise[:, good].mean(axis=1), rise[:, good].std(axis=1)
    if mean.min() < 0 < mean.max():
        raise InputError(
            f"'hot' is brighter than 'cold' by {mean.max():.4g} DN at state {mean.argmax()}, and "
            f"darker by {-mean.min():.4g} DN at state {mean.argmin()} {_COUNTED}, expected one "
            "sign at all states: give the references of 'cold' and of 'hot' in the order of "
            "'substrate_c'"
        )
    weak = np.flatnonzero(~(np.abs(mean) > scatter))
    if weak.size:
        k = int(weak[0])
        raise InputError(
            f"'cold' and 'hot' at state {k} {_COUNTED} differ by {mean[k]:.4g} DN in the mean and "
            f"by {scatter[k]:.4g} DN rms between pixels, expected a difference that all pixels "
            "see: take black bodies further apart, and see that both are of this state"
        )
    of_cold, of_hot = (_noise(each, good) for each in bodies)
    variance = None if of_cold is None or of_hot is None else (of_cold + of_hot) / mean**2
    return rise / mean[:, None, None], variance


def flags_of(shutter: Measured, bodies: Sequence[Measured], mask: ArrayLike | None) -> Array:
    """Flags of pixels without values, masked, saturated, or of another response than others."""
    unknown, saturated = np.zeros((2, *shutter.shape), bool)
    for each in (shutter, *bodies):
        unknown |= ~np.isfinite(each.values).all(axis=0)
        if each.bad_pixels.saturated is not None:
            saturated |= each.bad_pixels.saturated
    if (given := as_mask(mask, shutter.shape)) is not None:
        unknown |= given
    good, dead, hot = ~(unknown | saturated), None, None
    if bodies and good.any():
        response, variance = response_of(bodies, good)
        mean = np.where(good, response.mean(axis=0), np.nan)
        error = 0.0 if variance is None else float(np.sqrt(variance.sum())) / len(variance)
        dead, hot = response_outliers(mean, lambda: np.full(mean.shape, error))
    if not good.any():
        raise InputError(
            "'shutter' has no pixel with a value at every state below saturation, expected some"
        )
    flags = np.zeros(shutter.shape, np.uint32)
    set_bits(flags, "undetermined", unknown)
    set_bits(flags, "dead", dead)
    set_bits(flags, "hot", hot)
    flags[saturated] |= np.uint32(Flag.SATURATED | Flag.DO_NOT_USE)
    return flags

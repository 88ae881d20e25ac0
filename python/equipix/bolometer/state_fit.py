"""Offset and gain against the state, from a shutter and black bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import Array, Bools, Floats, as_array, check_shape, check_word, described
from equipix.bolometer.dynamic import DynamicCorrection
from equipix.bolometer.held_out import HIGHEST, STATES, Form, HeldOut, Judged
from equipix.bolometer.states import Axes, Regressor, States, check_spread, solver_of
from equipix.errors import InputError
from equipix.findings import Finding, Flag, ask, say, set_bits, usable
from equipix.measured.defects import DEAD_RESPONSE, relative_response
from equipix.measured.saturation import clipping
from equipix.measured.statistics import FrameStatistics


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
        and exchanged they give the same.
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
        `at` gives its correction at a state.

    Raises
    ------
    InputError
        If shapes or numbers do not fit, the states do not determine the coefficients, or the black
        bodies do not differ.

    Warns
    -----
    MisfitWarning
        With "auto", if the references are averages and the best prediction is worse than five
        times what their noise explains, or if temperature explains nothing. With any order, if the
        pattern of the array before the shutter turns back between two temperatures, as it does
        where some are exchanged. All temperatures in reversed order fit as well as the true ones.
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

    Pixels with a missing value in a reference, and masked ones, are flagged ``NO_FLAT_FIELD``,
    those with less than half of the mean response ``DEAD``, and those with a saturated sample in an
    average, or the largest number of the type in an array of whole numbers, ``SATURATED``; they
    count in no mean. Without black bodies no response is known, so no pixel is flagged ``DEAD``.

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
    taken = References.of("shutter", shutter)
    states = States.of(substrate_c, bias_v, len(taken.values))
    powers = _bias_order(states, bias_order)
    bodies = None if black_bodies is None else bodies_of(black_bodies, taken.values.shape)
    flags = flags_of(taken, bodies, mask)
    check_word("regressor", regressor, get_args(Regressor))
    good, form = usable(flags), Form(powers, regressor)
    named = {"shutter": taken, **{f"black_bodies[{k}]": b for k, b in enumerate(bodies or ())}}
    clipped = [each.clipping(name, good) for name, each in named.items()]
    said = say(*(Finding("saturation", words, "input") for words in clipped if words))
    shown = Shown(taken.values, states, good, form, taken.noise(good))
    chosen, errors, more = shown.order(order)
    said += more
    axes, offset = shown.coefficients(chosen)
    level = shown.coefficients_of_mean(chosen)
    metadata: dict[str, Any] = {
        "options": {
            "order": chosen if errors is None else "auto",
            "bias_order": powers,
            "regressor": regressor,
            "black_bodies": bodies is not None,
        },
        "prediction_errors": errors,
    }
    if bodies is None:
        return DynamicCorrection(offset, None, level, axes, axes, flags, metadata, said)
    rise = _response(bodies, states, good, form)
    chosen, metadata["gain_prediction_errors"], more = rise.order(order)
    gain_axes, gain = rise.coefficients(chosen)
    return DynamicCorrection(offset, gain, level, axes, gain_axes, flags, metadata, said + more)


def _response(bodies: list[References], states: States, good: Bools, form: Form) -> Shown:
    """Relative response of all pixels, and the noise of it."""
    cold, hot = bodies
    rise, noises = hot.values - cold.values, [each.noise(good) for each in bodies]
    variance = None
    if noises[0] is not None and noises[1] is not None:
        variance = (noises[0] + noises[1]) / rise[:, good].mean(axis=1) ** 2
    response = relative_response(rise, good)
    return Shown(response, states, good, form, variance, is_offset=False)


@dataclass(frozen=True, eq=False)
class Shown:
    """Values of all pixels at some states, of which the deviation from the mean is fitted.

    `variance` is the mean of that of the values at each state, where it is known. The response of
    stable pixels may need order 0, their offset does not.
    """

    values: Floats
    states: States
    good: Bools
    form: Form
    variance: Floats | None
    is_offset: bool = True

    @property
    def mean(self) -> Floats:
        """Mean over usable pixels at each state."""
        return np.asarray(self.values[:, self.good].mean(axis=1))

    @property
    def deviation(self) -> Floats:
        """Values less the mean of their state."""
        return self.values - self.mean[:, None, None]

    def coefficients(self, order: int) -> tuple[Axes, Floats]:
        """Coefficients of the deviation of each pixel, shape (terms, rows, cols)."""
        axes = self.states.axes(order, *self.form)
        solver = solver_of(axes, self.states)
        check_spread(axes, self.states, solver)
        return axes, np.tensordot(solver, self.deviation, 1)

    def coefficients_of_mean(self, order: int) -> Floats:
        """Coefficients of the mean of the array."""
        axes = self.states.axes(order, *self.form)
        return np.asarray(solver_of(axes, self.states) @ self.mean)

    def order(
        self, order: int | Literal["auto"]
    ) -> tuple[int, list[float] | None, tuple[Finding, ...]]:
        """Order that is given, or that which best predicts; prediction errors, and findings."""
        given = None
        if not (isinstance(order, str) and order == "auto"):
            given = _checked_order(order)
        held_out = self._held_out()
        chosen, errors = held_out.chosen() if given is None else (given, None)
        said = say(*ask(STATES, Judged(held_out, chosen, errors, self.is_offset)))
        return chosen, errors or None, said

    def _held_out(self) -> HeldOut:
        """Values of usable pixels, of which some are to be predicted."""
        largest = float(np.abs(self.values[:, self.good]).max())
        deviation = self.deviation[:, self.good]
        return HeldOut(deviation, self.states, self.form, self.variance, largest)


def _bias_order(states: States, given: int | None) -> int:
    """Highest power of V², checked."""
    if given is None:
        return min(1, len(states.biases) - 1)
    if isinstance(given, bool) or not isinstance(given, int | np.integer) or given < 0:
        raise InputError(f"'bias_order' is {given!r}, expected a whole number from 0, or None")
    return int(given)


def _checked_order(order: int | str) -> int:
    whole = isinstance(order, int | np.integer) and not isinstance(order, bool)
    if not whole or not 0 <= int(order) <= HIGHEST:
        raise InputError(f"'order' is {described(order)}, expected 0 to {HIGHEST} or 'auto'")
    return int(order)


@dataclass(frozen=True, eq=False)
class References:
    """Mean frames of all states, what is known of their noise, and where they saturate.

    Attributes
    ----------
    values : ndarray, shape (n, rows, cols), float64
        The mean frames in DN.
    variance : tuple of ndarray, or None
        Variances of the means, where all references are averages.
    saturated : ndarray, shape (rows, cols), bool
        Pixels that are known to saturate in a reference.
    """

    values: Floats
    variance: tuple[Floats, ...] | None
    saturated: Bools

    @classmethod
    def of(cls, name: str, given: ArrayLike | Sequence[FrameStatistics]) -> References:
        """Check the frames of all states, and warn of values that probably saturate."""
        if isinstance(given, FrameStatistics):
            raise InputError(f"'{name}' is one FrameStatistics, expected a sequence: one a state")
        listed: list[Any] = list(given) if isinstance(given, list | tuple) else []
        averages = [each for each in listed if isinstance(each, FrameStatistics)]
        variance = None
        if averages and len(averages) == len(listed):
            variance = tuple(each.variance_of_mean for each in averages)
        values = _stack(name, listed or given)
        found = cls(values.astype(np.float64), variance, np.zeros(values.shape[1:], bool))
        for each in listed or values:
            at_top = each.saturated > 0 if isinstance(each, FrameStatistics) else _at_the_top(each)
            found.saturated[at_top] = True
        return found

    def noise(self, good: Bools) -> Floats | None:
        """Mean variance of the means of usable pixels at each state, where it is known."""
        if self.variance is None:
            return None
        noise = np.array([each[good].mean() for each in self.variance])
        return noise if np.isfinite(noise).all() else None

    def clipping(self, name: str, good: Bools) -> str | None:
        """Say that values of usable pixels are at exactly the highest one."""
        for k, frame in enumerate(self.values):
            found = clipping(np.where(good, frame, np.nan))
            if found is not None:
                return (
                    f"{found.values} values of '{name}' at state {k} are exactly "
                    f"{found.level:.10g}, the highest one: they probably saturate and count as "
                    "valid: exclude their pixels by 'mask', or give averages with a 'saturation'"
                )
        return None


def _stack(name: str, given: Any) -> Array:
    """Mean frames of all states as one array (n, rows, cols), in the type of the frames."""
    if isinstance(given, list | tuple):
        given = [each.mean if isinstance(each, FrameStatistics) else each for each in given]
        shapes = {np.shape(each) for each in given}
        if len(shapes) > 1:
            raise InputError(f"'{name}' has frames of {sorted(shapes)}, expected one shape")
    values = as_array(name, given, ndim=3)
    check_shape((values.shape[1], values.shape[2]))
    if not len(values):
        raise InputError(f"'{name}' has no frames, expected one for each state")
    return values


def _at_the_top(given: ArrayLike) -> Bools:
    """Pixels of a frame at the largest number of its type of whole numbers."""
    frame = np.asanyarray(given)
    if frame.dtype.kind not in "iu":
        return np.zeros(frame.shape, bool)
    return np.asarray(frame == np.iinfo(frame.dtype).max)


def bodies_of(given: Any, shape: tuple[int, ...]) -> list[References]:
    """Frames of the cold and the hot black body."""
    if not isinstance(given, list | tuple) or len(given) != 2:
        raise InputError("'black_bodies' is no pair, expected (cold, hot), each like 'shutter'")
    bodies = [References.of(f"black_bodies[{k}]", each) for k, each in enumerate(given)]
    for k, each in enumerate(bodies):
        if each.values.shape != shape:
            raise InputError(
                f"'black_bodies[{k}]' has shape {each.values.shape}, expected {shape} like "
                "'shutter'"
            )
    return bodies


def flags_of(shutter: References, bodies: list[References] | None, mask: ArrayLike | None) -> Array:
    """Flags of pixels without values, masked, saturated, or that do not respond."""
    shape = shutter.saturated.shape
    unknown: Bools = np.asarray(~np.isfinite(shutter.values).all(axis=0))
    saturated = shutter.saturated.copy()
    if mask is not None:
        given = as_array("mask", mask, ndim=2)
        if given.dtype != np.bool_ or given.shape != shape:
            raise InputError(
                f"'mask' is {given.dtype} of shape {given.shape}, expected bool of shape {shape}"
            )
        unknown |= given
    flags, dead = np.zeros(shape, np.uint32), np.zeros(shape, bool)
    if bodies is not None:
        cold, hot = bodies
        unknown |= ~np.isfinite([cold.values, hot.values]).all(axis=(0, 1))
        saturated |= cold.saturated | hot.saturated
        good = ~(unknown | saturated)
        if good.any():
            response = relative_response(hot.values - cold.values, good).mean(axis=0)
            dead = np.asarray(good & ~(response >= DEAD_RESPONSE))
    if (unknown | dead | saturated).all():
        raise InputError(
            "'shutter' has no pixel with a value at every state below saturation, expected some"
        )
    set_bits(flags, "undetermined", unknown)
    set_bits(flags, "non_responding", dead)
    flags[saturated] |= np.uint32(Flag.SATURATED | Flag.DO_NOT_USE)
    return flags

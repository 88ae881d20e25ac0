"""Fit of a dynamic correction to references taken at some states."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import takewhile
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np

from equipix._check import check_word, described
from equipix.bolometer.dynamic import DynamicCorrection
from equipix.bolometer.references import bodies_of, flags_of, relative_response, stack_of
from equipix.bolometer.states import Regressor, States
from equipix.errors import InputError
from equipix.flags import usable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from equipix._types import Bools, Floats
    from equipix.bolometer.states import Axes
    from equipix.frames import FrameStatistics

_BETTER = 1e-3
"""Relative fall of the prediction error that a higher order must bring."""

_ROUNDING = 1e-12
"""Prediction error of exact data, relative to the largest value."""

_HIGHEST = 8
"""Highest order in temperature."""

_MOST_NOISE = 100.0
"""Noise of a deviation between the references, over that of a reference."""


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
        difference gives the gain. Each may have the temperature that suits; it need not be known.
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

    Notes
    -----
    With ȳ the mean over usable pixels, d = y − ȳ before the shutter, and K = Δy/Δȳ − 1 with Δ the
    difference between the black bodies. Of each pixel, d and K are fitted by least squares as

    .. math:: \sum_{i \le order} \sum_{j \le bias\_order} c_{ij}\, T_i(t)\, T_j(v)

    with Chebyshev polynomials of the regressor t and of v = V², scaled to [−1, 1]. The bias enters
    as V² since it acts through the heat V²/R.

    With "auto" each temperature between the lowest and the highest is held out in turn, at all its
    biases. The error is the median over usable pixels of the mean square difference to the
    prediction by the others. The lowest order within 0.1 % of the smallest error is taken;
    `metadata` has the errors.

    Pixels with a missing value in a reference, and masked ones, are flagged ``NO_FLAT_FIELD``,
    those with less than half of the mean response ``DEAD``; they count in no mean. Without black
    bodies no response is known, so no pixel is flagged ``DEAD``.

    References
    ----------
    .. [1] "Correction of the non-uniformity of parameters of focal plane arrays", in a course on
       staring infrared systems (in Russian): static and dynamic correction of bolometers.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import bolometer
    >>> array = bolometer.BolometerArray.of((24, 32), rng=1)
    >>> celsius, volts = [-20, 0, 20, 40, 60], 2.0
    >>> shutter = [array.mean(each) for each in celsius]
    >>> correction = bolometer.fit(shutter, celsius, volts, order=4)
    >>> left = correction.at(10.0).correct(array.mean(10.0))
    >>> bool(np.std(left) < 1e-4 * np.std(array.mean(10.0)))
    True
    """
    values = stack_of("shutter", shutter)
    states = States.of(substrate_c, bias_v, len(values))
    powers = _bias_order(states, bias_order)
    bodies = None if black_bodies is None else bodies_of(black_bodies, values.shape)
    flags = flags_of(values, bodies, mask)
    check_word("regressor", regressor, get_args(Regressor))
    form = Form(powers, regressor)
    shown = Shown(values, states, usable(flags), form)
    chosen, errors = shown.order(order)
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
        return DynamicCorrection(offset, None, level, axes, axes, flags, metadata)
    rise = Shown(relative_response(bodies[1] - bodies[0], shown.good), states, shown.good, form)
    chosen, metadata["gain_prediction_errors"] = rise.order(order)
    gain_axes, gain = rise.coefficients(chosen)
    return DynamicCorrection(offset, gain, level, axes, gain_axes, flags, metadata)


class Form(NamedTuple):
    """What all fits have in common."""

    bias_order: int
    regressor: Regressor


@dataclass(frozen=True, eq=False)
class Shown:
    """Values of all pixels at some states, of which the deviation from the mean is fitted."""

    values: Floats
    states: States
    good: Bools
    form: Form

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
        solver = _solver(axes, self.states)
        _check_spread(axes, self.states, solver)
        return axes, np.tensordot(solver, self.deviation, 1)

    def coefficients_of_mean(self, order: int) -> Floats:
        """Coefficients of the mean of the array."""
        axes = self.states.axes(order, *self.form)
        return np.asarray(_solver(axes, self.states) @ self.mean)

    def order(self, order: int | Literal["auto"]) -> tuple[int, list[float] | None]:
        """Order that is given, or that which best predicts, and the prediction error of each."""
        if not (isinstance(order, str) and order == "auto"):
            return _checked_order(order), None
        temperatures = self.states.temperatures
        if len(temperatures) == 1:
            return 0, None
        if len(temperatures) == 2:
            raise InputError(
                "'order' is 'auto', which holds out a temperature between the lowest and the "
                f"highest, but 'substrate_c' has {temperatures.tolist()} °C: give three, or an "
                "order"
            )
        deviation = self.deviation[:, self.good]
        orders = range(1, min(_HIGHEST, len(temperatures) - 2) + 1)
        held = takewhile(self._may_be_held_out, orders)
        errors = [self._prediction_error(deviation, each) for each in (0, *held)]
        enough = min(errors) * (1 + _BETTER)
        enough += (_ROUNDING * float(np.abs(self.values[:, self.good]).max())) ** 2
        return next(each for each, error in enumerate(errors) if error <= enough), errors

    def _may_be_held_out(self, order: int) -> bool:
        """Whether the states without any one temperature determine an order."""
        axes = self.states.axes(order, *self.form)
        others = [self.states.substrate_c != each for each in self.states.temperatures[1:-1]]
        return all(_rank(axes, self.states.chosen(each)) == axes.terms for each in others)

    def _prediction_error(self, deviation: Floats, order: int) -> float:
        """Mean square error of predictions of temperatures held out, median over the pixels."""
        axes, total = self.states.axes(order, *self.form), np.zeros(deviation.shape[1])
        held = self.states.temperatures[1:-1]
        for celsius in held:
            out = self.states.substrate_c == celsius
            solver = _solver(axes, self.states.chosen(~out))
            one = self.states.chosen(out)
            predicted = axes.basis(one.substrate_c, one.bias_v) @ (solver @ deviation[~out])
            total += np.mean((deviation[out] - predicted) ** 2, axis=0)
        return float(np.median(total)) / len(held)


def _rank(axes: Axes, states: States) -> int:
    """Number of coefficients that states determine."""
    return int(np.linalg.matrix_rank(axes.basis(states.substrate_c, states.bias_v)))


def _solver(axes: Axes, states: States) -> Floats:
    """Matrix that makes coefficients of values by least squares, shape (terms, n)."""
    rank = _rank(axes, states)
    if rank < axes.terms:
        raise InputError(
            f"'order' {axes.order} and 'bias_order' {axes.bias_order} have {axes.terms} "
            f"coefficients, but {len(states.substrate_c)} references at "
            f"{len(states.temperatures)} temperatures and {len(states.biases)} biases determine "
            f"{rank}: take more states, or lower orders"
        )
    return np.asarray(np.linalg.pinv(axes.basis(states.substrate_c, states.bias_v)))


def _check_spread(axes: Axes, states: States, solver: Floats) -> None:
    """Refuse states between which the noise of a reference is multiplied by much."""
    celsius = np.linspace(*axes.substrate_c, 33)
    noise = [
        np.linalg.norm(axes.basis(celsius, np.full(len(celsius), volts)) @ solver, axis=1).max()
        for volts in states.biases
    ]
    if max(noise) > _MOST_NOISE:
        raise InputError(
            f"'substrate_c' and 'bias_v' determine order {axes.order} with {max(noise):.3g} times "
            f"the noise of a reference (limit {_MOST_NOISE:g}): take states further apart, or "
            "lower orders"
        )


def _bias_order(states: States, given: int | None) -> int:
    """Highest power of V², checked."""
    if given is None:
        return min(1, len(states.biases) - 1)
    if isinstance(given, bool) or not isinstance(given, int | np.integer) or given < 0:
        raise InputError(f"'bias_order' is {given!r}, expected a whole number from 0, or None")
    return int(given)


def _checked_order(order: int | str) -> int:
    whole = isinstance(order, int | np.integer) and not isinstance(order, bool)
    if not whole or not 0 <= int(order) <= _HIGHEST:
        raise InputError(f"'order' is {described(order)}, expected 0 to {_HIGHEST} or 'auto'")
    return int(order)

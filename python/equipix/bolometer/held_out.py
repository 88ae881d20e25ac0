"""The order of a dynamic correction by predictions of temperatures that are held out."""

from dataclasses import dataclass
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from equipix._check import Bools, Floats
from equipix.bolometer.states import Axes, Regressor, States, rank_of, solver_of
from equipix.errors import InputError
from equipix.findings import Rule

HIGHEST = 8
"""Highest order in temperature."""

_BETTER = 1e-3
"""Relative fall of the prediction error that a higher order must bring."""

_ROUNDING = 1e-12
"""Prediction error of exact data, relative to the largest value."""

_MANY_SIGMAS = 5.0
"""Prediction error over that of noise from which the polynomials do not follow the array."""


_FEWEST = 4
"""Fewest references of one bias that show how the pattern follows the temperature."""

_MOST = 0.8
"""Least share of the variance that the pattern must hold: of noise alone it has a third at most."""

_FAR = 3.0
"""Largest deviation that counts, over the median one of its reference: two standard deviations."""

_BACK = 0.1
"""Share of its range by which the pattern may turn back between two temperatures."""


class Form(NamedTuple):
    """What all fits have in common."""

    bias_order: int
    regressor: Regressor


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Deviations of usable pixels, shape (n, pixels), to be predicted from other temperatures.

    `variance` is that of a deviation at each state, shape (n,), where it is known; `largest` the
    largest of the values, which sets their rounding.
    """

    deviation: Floats
    states: States
    form: Form
    variance: Floats | None
    largest: float

    def chosen(self) -> tuple[int, list[float]]:
        """Order that predicts best, and the mean square error of each order.

        The lowest within 0.1 % of the smallest error; 0, without errors, of one temperature.

        Raises
        ------
        InputError
            If there are two temperatures, so that the others of one that is held out are one.
        """
        if len(self.states.groups) == 1:
            return 0, []
        if len(self.states.groups) == 2:
            raise InputError(
                "'order' is 'auto', which holds out a temperature, but 'substrate_c' has "
                f"{[float(group[0]) for group in self.states.groups]} °C: give three, or an order"
            )
        orders = range(1, min(HIGHEST, len(self.states.groups) - 2) + 1)
        possible = [0, *takewhile(self._is_possible, orders)]
        errors = [self._error(each) for each in possible]
        enough = min(errors) * (1 + _BETTER) + self.rounding
        order = next(each for each, error in enumerate(errors) if error <= enough)
        return order, errors

    @property
    def rounding(self) -> float:
        """Mean square error of exact data."""
        return (_ROUNDING * self.largest) ** 2

    def _held(self) -> list[Floats]:
        """Temperatures to hold out: those between the ends, and the ends if there is but one.

        The mean of two ends and the line through them predict the same halfway between them, so
        that one temperature cannot tell orders 0 and 1 apart.
        """
        groups = self.states.groups
        return groups if len(groups) == 3 else groups[1:-1]

    def _is_possible(self, order: int) -> bool:
        """Whether the states without any temperature that is held out determine an order."""
        axes = self.states.axes(order, *self.form)
        others = [~self.states.at_one_of(group) for group in self._held()]
        return all(rank_of(axes, self.states.chosen(each)) == axes.terms for each in others)

    def _error(self, order: int) -> float:
        """Mean square error of the predictions, median over the pixels."""
        axes, total = self.states.axes(order, *self.form), np.zeros(self.deviation.shape[1])
        held = self._held()
        for group in held:
            out = self.states.at_one_of(group)
            predicted = self._weights(axes, group) @ self.deviation[~out]
            total += np.mean((self.deviation[out] - predicted) ** 2, axis=0)
        return float(np.median(total)) / len(held)

    def _weights(self, axes: Axes, group: Floats) -> Floats:
        """Matrix that predicts the states of some temperatures from all others."""
        out = self.states.at_one_of(group)
        one, solver = self.states.chosen(out), solver_of(axes, self.states.chosen(~out))
        return np.asarray(axes.basis(one.substrate_c, one.bias_v) @ solver)

    def error_of_noise(self, order: int, variance: Floats) -> float:
        """Mean square error of the predictions that noise alone makes."""
        axes, total, held = self.states.axes(order, *self.form), 0.0, self._held()
        for group in held:
            out = self.states.at_one_of(group)
            of_prediction = self._weights(axes, group) ** 2 @ variance[~out]
            total += float(np.mean(variance[out] + of_prediction))
        return total / len(held)

    def turn(self) -> str:
        """Say where the pattern of the array turns back as the temperature rises, if it does.

        Its course is the score of the first principal component of the references of one bias,
        where this holds most of their variance: more than noise can.
        """
        for volts in self.states.biases:
            of_bias = self.states.bias_v == volts
            celsius, course = self._course(of_bias)
            steps = np.diff(course) * np.sign(course[-1] - course[0])
            back = np.flatnonzero(steps < -_BACK * np.ptp(course))
            if back.size:
                here, there = celsius[back[0]], celsius[back[0] + 1]
                return (
                    f"the pattern of the array turns back between {here:g} and {there:g} °C of "
                    "'substrate_c': see that each is the temperature of its reference, and that "
                    "none are exchanged"
                )
        return ""

    def _course(self, of_bias: Bools) -> tuple[Floats, Floats]:
        """Temperatures, lowest first, and the scores of the references; 0 where noise is most."""
        celsius = self.states.substrate_c[of_bias]
        order = np.argsort(celsius, kind="stable")
        away = self.deviation[of_bias][order]
        # Pixels far off, such as saturated ones, are not the pattern of the array.
        away = away - np.median(away, axis=1, keepdims=True)
        away -= away.mean(axis=0)
        most = _FAR * np.median(np.abs(away), axis=1, keepdims=True)
        away = np.clip(away, -most, most)
        squares, vectors = np.linalg.eigh(away @ away.T)
        course = vectors[:, -1]
        if len(course) < _FEWEST or squares[-1] < _MOST * squares.sum() or squares[-1] <= 0:
            course = np.zeros_like(course)
        return celsius[order], course


class Judged(NamedTuple):
    """Deviations, and the order that was chosen for them: by predictions, unless it was given.

    The response of stable pixels may need order 0, their offset does not.
    """

    held_out: HeldOut
    order: int
    errors: list[float] | None
    is_offset: bool


def _on_prediction(e: Judged) -> str | None:
    """Say that predictions are worse than noise explains."""
    if not e.errors or len(e.errors) == 1:
        return None
    held_out, error, noise = e.held_out, e.errors[e.order], np.inf
    if held_out.variance is not None:
        noise = held_out.error_of_noise(e.order, held_out.variance) + held_out.rounding
    if error <= _MANY_SIGMAS**2 * noise:
        return None
    return (
        f"order {e.order} predicts temperatures that are held out best, yet with "
        f"{np.sqrt(error / noise):.3g} times the error that noise explains: "
        + (
            held_out.turn()
            or f"take references at more temperatures than {len(held_out.states.groups)}, and see "
            "that each of 'substrate_c' is that of its reference"
        )
    )


def _on_exchanged(e: Judged) -> str | None:
    """Say that temperatures are probably those of other references."""
    asked = e.is_offset if e.errors is None else e.order > 0
    return e.held_out.turn() if asked else None


def _on_one_order(e: Judged) -> str | None:
    """Say that the states determine no order but 0."""
    if e.errors is None or len(e.errors) != 1:
        return None
    return (
        f"'order' is 'auto', but {len(e.held_out.states.groups)} temperatures with these biases "
        "determine no order above 0 where one is held out: take references at more states, or "
        "give 'order' and 'bias_order'"
    )


def _on_repeats(e: Judged) -> str | None:
    """Say that references at one temperature differ by more than noise explains."""
    held_out, states = e.held_out, e.held_out.states
    axes = states.axes(0, *held_out.form)
    freedom = len(held_out.deviation) - axes.terms
    if e.errors != [] or held_out.variance is None or freedom < 1:
        return None
    basis = axes.basis(states.substrate_c, states.bias_v)
    left = held_out.deviation - basis @ (solver_of(axes, states) @ held_out.deviation)
    error = float(np.median((left**2).sum(axis=0))) / freedom
    noise = float(held_out.variance.mean()) + held_out.rounding
    if error <= _MANY_SIGMAS**2 * noise:
        return None
    return (
        f"the references differ by {np.sqrt(error / noise):.3g} times their noise, but all "
        f"of 'substrate_c' is {states.substrate_c[0]:g} °C: see that each is the "
        "temperature of its reference"
    )


def _on_constant(e: Judged) -> str | None:
    """Say that temperatures explain nothing, where no noise is known that hides it."""
    if not e.errors or len(e.errors) == 1 or e.order > 0 or not e.is_offset:
        return None
    if e.held_out.variance is not None or e.errors[0] <= e.held_out.rounding:
        return None
    return (
        "order 0 predicts temperatures that are held out best, with an error of "
        f"{np.sqrt(e.errors[0]):.3g} DN rms, so 'substrate_c' explains nothing that the "
        "references differ by: see that each is the temperature of its reference; averages in "
        "their place tell how much of it is noise"
    )


_OTHER = frozenset({"states"})

STATES: tuple[Rule[Judged], ...] = (
    Rule("states", "misfit", _on_prediction),
    Rule("states", "misfit", _on_exchanged, unless=_OTHER),
    Rule("states", "misfit", _on_one_order),
    Rule("states", "misfit", _on_repeats),
    Rule("states", "misfit", _on_constant),
)
"""What is asked of references at several states."""

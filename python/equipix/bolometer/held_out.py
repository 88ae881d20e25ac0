"""The order of a dynamic correction by predictions of temperatures that are held out."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from equipix._check import Bools, Floats
from equipix.bolometer.states import States, rank_of, solver_of
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


@dataclass(frozen=True, eq=False)
class Observed:
    """Values of all pixels at some states, shape (n, rows, cols); their deviations are fitted.

    `good` are the usable pixels, `variance` the mean of that of the values at each state, where it
    is known. The response of stable pixels may need order 0, their offset does not.
    """

    values: Floats
    states: States
    good: Bools
    variance: Floats | None
    is_offset: bool = True

    @cached_property
    def mean(self) -> Floats:
        """Mean over usable pixels at each state."""
        return np.asarray(self.values[:, self.good].mean(axis=1))

    @cached_property
    def deviation(self) -> Floats:
        """Deviations of usable pixels from it, to be predicted, shape (n, pixels)."""
        return np.asarray(self.values[:, self.good] - self.mean[:, None])

    def chosen(self) -> tuple[int, list[float]]:
        """Lowest order within 0.1 % of the smallest error, and the mean square error of each order.

        Order 0, without errors, of one temperature.

        Raises
        ------
        InputError
            If there are two temperatures, so that the others of one that is held out are one.
        """
        groups = self.states.groups
        if len(groups) == 1:
            return 0, []
        if len(groups) == 2:
            raise InputError(
                "'order' is 'auto', which holds out a temperature, but 'substrate_c' has "
                f"{[float(group[0]) for group in groups]} °C: give three, or an order"
            )
        orders = range(1, min(HIGHEST, len(groups) - 2) + 1)
        possible = [0, *takewhile(self._is_possible, orders)]
        errors = [self._error(each) for each in possible]
        enough = min(errors) * (1 + _BETTER) + self.rounding
        order = next(each for each, error in enumerate(errors) if error <= enough)
        return order, errors

    @property
    def rounding(self) -> float:
        """Mean square error of exact data."""
        return (_ROUNDING * float(np.abs(self.values[:, self.good]).max())) ** 2

    def _held(self) -> list[Floats]:
        """Temperatures to hold out: those between the ends, and the ends if there is but one.

        The mean of two ends and the line through them predict the same halfway between them, so
        that one temperature cannot tell orders 0 and 1 apart.
        """
        groups = self.states.groups
        return groups if len(groups) == 3 else groups[1:-1]

    def _is_possible(self, order: int) -> bool:
        """Whether the states without any temperature that is held out determine an order."""
        axes = self.states.axes(order)
        others = [~self.states.at_one_of(group) for group in self._held()]
        return all(rank_of(axes, self.states.chosen(each)) == axes.terms for each in others)

    def _error(self, order: int) -> float:
        """Mean square error of the predictions, median over the pixels."""
        squares = (
            np.mean((self.deviation[out] - weights @ self.deviation[~out]) ** 2, axis=0)
            for out, weights in self._predictions(order)
        )
        return float(np.median(sum(squares))) / len(self._held())

    def error_of_noise(self, order: int, variance: Floats) -> float:
        """Mean square error of the predictions that noise alone makes."""
        errors = [
            float(np.mean(variance[out] + weights**2 @ variance[~out]))
            for out, weights in self._predictions(order)
        ]
        return sum(errors) / len(errors)

    def _predictions(self, order: int) -> Iterator[tuple[Bools, Floats]]:
        """States that are held out together, and the matrix that predicts them from all others."""
        axes = self.states.axes(order)
        for group in self._held():
            out = self.states.at_one_of(group)
            one, solver = self.states.chosen(out), solver_of(axes, self.states.chosen(~out))
            yield out, axes.basis(one.substrate_c, one.bias_v) @ solver

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
    """Deviations, and the order that was chosen for them: by predictions, unless it was given."""

    observed: Observed
    order: int
    errors: list[float] | None


def _on_prediction(e: Judged) -> str | None:
    """Say that predictions are worse than noise explains."""
    if not e.errors or len(e.errors) == 1:
        return None
    observed, error, noise = e.observed, e.errors[e.order], np.inf
    if observed.variance is not None:
        noise = observed.error_of_noise(e.order, observed.variance) + observed.rounding
    if error <= _MANY_SIGMAS**2 * noise:
        return None
    return (
        f"order {e.order} predicts temperatures that are held out best, yet with "
        f"{np.sqrt(error / noise):.3g} times the error that noise explains: "
        + (
            observed.turn()
            or f"take references at more temperatures than {len(observed.states.groups)}, and see "
            "that each of 'substrate_c' is that of its reference"
        )
    )


def _on_exchanged(e: Judged) -> str | None:
    """Say that temperatures are probably those of other references."""
    asked = e.observed.is_offset if e.errors is None else e.order > 0
    return e.observed.turn() if asked else None


def _on_one_order(e: Judged) -> str | None:
    """Say that the states determine no order but 0."""
    if e.errors is None or len(e.errors) != 1:
        return None
    return (
        f"'order' is 'auto', but {len(e.observed.states.groups)} temperatures with these biases "
        "determine no order above 0 where one is held out: take references at more states, or "
        "give 'order' and 'bias_order'"
    )


def _on_repeats(e: Judged) -> str | None:
    """Say that references at one temperature differ by more than noise explains."""
    observed, states = e.observed, e.observed.states
    axes = states.axes(0)
    freedom = len(observed.deviation) - axes.terms
    if e.errors != [] or observed.variance is None or freedom < 1:
        return None
    basis = axes.basis(states.substrate_c, states.bias_v)
    left = observed.deviation - basis @ (solver_of(axes, states) @ observed.deviation)
    error = float(np.median((left**2).sum(axis=0))) / freedom
    noise = float(observed.variance.mean()) + observed.rounding
    if error <= _MANY_SIGMAS**2 * noise:
        return None
    return (
        f"the references differ by {np.sqrt(error / noise):.3g} times their noise, but all "
        f"of 'substrate_c' is {states.substrate_c[0]:g} °C: see that each is the "
        "temperature of its reference"
    )


def _on_constant(e: Judged) -> str | None:
    """Say that temperatures explain nothing, where no noise is known that hides it."""
    if not e.errors or len(e.errors) == 1 or e.order > 0 or not e.observed.is_offset:
        return None
    if e.observed.variance is not None or e.errors[0] <= e.observed.rounding:
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

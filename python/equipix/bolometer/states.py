"""States of a bolometer, polynomials in them, and their least squares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import Bools, Floats, as_array, check_word, is_whole
from equipix.detector.photons import ZERO_C
from equipix.errors import InputError

_ALIKE = 0.01
"""Share of the range within which temperatures count as one: extrema of the highest polynomial, of
order 8, are 0.038 of it apart or more, so no order resolves less."""

_HOTTEST_C = 150.0
"""Highest temperature of a substrate; what is above is probably in kelvin."""

Regressor: TypeAlias = Literal["temperature", "inverse"]
"""What the polynomials are of: the temperature, or one over the absolute temperature."""


@dataclass(frozen=True)
class Axes:
    """Ranges of the states, which the polynomials are scaled by, and their orders.

    Attributes
    ----------
    substrate_c : tuple of float
        Lowest and highest temperature of the substrate in °C.
    bias_v : tuple of float
        Lowest and highest bias in volts.
    order : int
        Highest power of the temperature.
    bias_order : int
        Highest power of the square of the bias.
    regressor : {"temperature", "inverse"}
        What the polynomials are of: the temperature, or one over the absolute temperature.
    """

    substrate_c: tuple[float, float]
    bias_v: tuple[float, float]
    order: int
    bias_order: int
    regressor: Regressor = "temperature"

    @property
    def terms(self) -> int:
        """Number of coefficients."""
        return (self.order + 1) * (self.bias_order + 1)

    def basis(self, substrate_c: ArrayLike, bias_v: ArrayLike) -> Floats:
        """Values of all terms, shape (n, terms): T_i(t)·T_j(v) with Chebyshev polynomials.

        t is the regressor and v the square of the bias, scaled to [−1, 1].
        """
        celsius = np.atleast_1d(substrate_c).astype(np.float64)
        t = _scaled(self._regressor(celsius), self._regressor(np.array(self.substrate_c)))
        squares = np.square(np.atleast_1d(bias_v).astype(np.float64))
        v = _scaled(squares, np.square(self.bias_v))
        of_t = np.polynomial.chebyshev.chebvander(t, self.order)
        of_v = np.polynomial.chebyshev.chebvander(v, self.bias_order)
        return np.asarray((of_t[:, :, None] * of_v[:, None, :]).reshape(len(t), self.terms))

    def _regressor(self, celsius: Floats) -> Floats:
        return 1 / (celsius + ZERO_C) if self.regressor == "inverse" else celsius


@dataclass(frozen=True, eq=False)
class States:
    """The states of n references: temperatures in °C and biases in volts, checked.

    All polynomials in them have the same highest power of the bias and the same regressor.
    """

    substrate_c: Floats
    bias_v: Floats
    bias_order: int
    regressor: Regressor

    @classmethod
    def of(
        cls,
        substrate_c: ArrayLike,
        bias_v: ArrayLike,
        count: int,
        bias_order: int | None,
        regressor: Regressor,
    ) -> States:
        """Check one state for each of `count` references; one bias may serve all."""
        celsius = as_array("substrate_c", substrate_c, ndim=1).astype(np.float64)
        volts = as_array("bias_v", bias_v, ndim=(0, 1)).astype(np.float64).ravel()
        volts = np.broadcast_to(volts, count) if volts.size == 1 else volts
        for name, values in (("substrate_c", celsius), ("bias_v", volts)):
            if len(values) != count:
                raise InputError(
                    f"'{name}' has {len(values)} entries, expected {count}: one a reference"
                )
        wrong = celsius[~((celsius > -ZERO_C) & (celsius < np.inf))]
        if wrong.size:
            raise InputError(
                f"'substrate_c' holds {wrong[0]:g} °C, expected more than {-ZERO_C} °C"
            )
        hot = celsius[celsius > _HOTTEST_C]
        if hot.size:
            raise InputError(
                f"'substrate_c' holds {hot[0]:g} °C, expected at most {_HOTTEST_C:g}: subtract "
                f"{ZERO_C} from kelvin"
            )
        wrong = volts[~((volts > 0) & (volts < np.inf))]
        if wrong.size:
            raise InputError(f"'bias_v' holds {wrong[0]:g} V, expected finite volts above 0")
        if bias_order is None:
            bias_order = min(1, len(np.unique(volts)) - 1)
        if not is_whole(bias_order, 0):
            raise InputError(
                f"'bias_order' is {bias_order!r}, expected a whole number from 0, or None"
            )
        check_word("regressor", regressor, get_args(Regressor))
        return cls(celsius, volts, int(bias_order), regressor)

    @property
    def temperatures(self) -> Floats:
        """Temperatures that differ, lowest first."""
        return np.unique(self.substrate_c)

    @property
    def groups(self) -> list[Floats]:
        """Temperatures that differ, lowest first, those together that no order resolves."""
        celsius = self.temperatures
        width = _ALIKE * (celsius[-1] - celsius[0])
        groups: list[Floats] = []
        while celsius.size:
            alike = celsius <= celsius[0] + width
            groups.append(celsius[alike])
            celsius = celsius[~alike]
        return groups

    def at_one_of(self, group: Floats) -> Bools:
        """Which of the states are at one of some temperatures."""
        return np.isin(self.substrate_c, group)

    @property
    def biases(self) -> Floats:
        """Biases that differ, lowest first."""
        return np.unique(self.bias_v)

    def chosen(self, which: Bools) -> States:
        """Return some of the states."""
        return replace(self, substrate_c=self.substrate_c[which], bias_v=self.bias_v[which])

    def axes(self, order: int) -> Axes:
        """Ranges of these states, with orders and regressor."""
        celsius, volts = ((float(v.min()), float(v.max())) for v in (self.substrate_c, self.bias_v))
        return Axes(celsius, volts, order, self.bias_order, self.regressor)


def _scaled(values: Floats, ends: Floats) -> Floats:
    """Values with the ends at −1 and 1; 0 where there is one end."""
    middle, half = (ends[0] + ends[1]) / 2, (ends[1] - ends[0]) / 2
    return np.asarray((values - middle) / half if half else np.zeros_like(values))


_MOST_NOISE = 100.0
"""Noise of a deviation between the references, over that of a reference."""


def rank_of(axes: Axes, states: States) -> int:
    """Number of coefficients that states determine."""
    return int(np.linalg.matrix_rank(axes.basis(states.substrate_c, states.bias_v)))


def solver_of(axes: Axes, states: States) -> Floats:
    """Matrix that makes coefficients of values by least squares, shape (terms, n)."""
    rank = rank_of(axes, states)
    if rank < axes.terms:
        raise InputError(
            f"'order' {axes.order} and 'bias_order' {axes.bias_order} have {axes.terms} "
            f"coefficients, but {len(states.substrate_c)} references at "
            f"{len(states.temperatures)} temperatures and {len(states.biases)} biases determine "
            f"{rank}: take more states, or lower orders"
        )
    return np.asarray(np.linalg.pinv(axes.basis(states.substrate_c, states.bias_v)))


def check_spread(axes: Axes, states: States, solver: Floats) -> None:
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

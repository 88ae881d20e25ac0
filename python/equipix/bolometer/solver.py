"""Least squares of polynomials in the states."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import InputError

if TYPE_CHECKING:
    from equipix._types import Floats
    from equipix.bolometer.states import Axes, States

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

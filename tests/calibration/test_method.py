"""What docs/method.md says of a sweep and of the preconditioner, on sensors that take no time."""

from __future__ import annotations

import numpy as np
import pytest
import spectrum

ARMS = [(11, 19), (5, 7)]


# Without noise, exposures of a uniform beam are equal.
@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
@pytest.mark.parametrize("arms", ARMS)
@pytest.mark.parametrize("cycles", [0.004, 0.05, 0.3])
def test_a_sweep_removes_what_the_symbol_says(arms, cycles):
    q = 2 * np.pi * cycles
    # The wave is 1e-6 high, and so is what linearising neglects beside it.
    assert spectrum.removed(q, arms) == pytest.approx(spectrum.symbol(q, arms), abs=1e-5)


def test_the_second_level_lifts_the_lowest_eigenvalues_and_damping_lowers_the_highest(monkeypatch):
    monkeypatch.setattr(spectrum, "SMALL", (20, 24))
    monkeypatch.setattr(spectrum, "SMALL_ARMS", (2, 3))
    found = spectrum.eigenvalues([0.0, 0.25, 1.0])
    # S ≤ D, and what is added is never negative: both exactly, up to rounding.
    assert found[0.0][-1] < 1 + 1e-12
    assert found[0.0][0] < 0.5 * found[0.25][0]
    assert (found[0.0] <= found[0.25] + 1e-12).all()
    assert (found[0.25] <= found[1.0] + 1e-12).all()
    assert found[0.25][-1] < 0.5 * (1 + found[1.0][-1])

"""Probabilities of what noise alone would give."""

from __future__ import annotations

import math


def chi2_tail(value: float, freedom: int) -> float:
    """Probability that χ² of so many degrees of freedom is above a value.

    Notes
    -----
    With y = value/2 it is e^{−y} Σ_{j<f/2} y^j/j! for even f; for odd f it is erfc(√y) +
    e^{−y} Σ_{j<(f−1)/2} y^{j+1/2}/Γ(j + 3/2).
    """
    half = max(value, 0.0) / 2
    if half == 0:
        return 1.0
    odd = freedom % 2
    tail = math.erfc(math.sqrt(half)) if odd else 0.0
    powers = (j + odd / 2 for j in range(freedom // 2))
    return tail + sum(math.exp(p * math.log(half) - half - math.lgamma(p + 1)) for p in powers)

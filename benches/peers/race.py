"""The clock that all rivals run against: the true error decides when one is there."""

from __future__ import annotations

import math
import time
from itertools import count
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy as np

    ErrorOf = Callable[[np.ndarray], float]


class Outcome(NamedTuple):
    """How far a solver came: the true error reached, the passes and the seconds it took."""

    error: float
    passes: int
    seconds: float


def race(
    estimates: Iterator[np.ndarray], error_of: ErrorOf, tolerance: float, seconds: float
) -> Outcome:
    """Draw one estimate a pass until the error is within the tolerance or the time is over.

    The time of measuring the error does not count. It is measured whenever the passes have grown
    by 2 %, so that nobody waits for it; a count is too high by at most as much.
    """
    spent, check, error = 0.0, 1, math.inf
    for passes in count(1):
        start = time.perf_counter()
        estimate = next(estimates)
        spent += time.perf_counter() - start
        if passes >= check or spent >= seconds:
            error = error_of(estimate)
            if error <= tolerance or spent >= seconds:
                break
            check = passes + max(1, passes // 50)
    return Outcome(error, passes, spent)

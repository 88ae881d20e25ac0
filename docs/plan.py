"""Draw plan.png, three patterns of shifts and their errors: ``python docs/plan.py``.

The cross of the paper and what `equipix.plan.suggest` finds for the same sensor and a stage that
travels 80 pixels, with 5 and with 9 exposures. Printed: how much better they are, and how long the
search took.
"""

from __future__ import annotations

import time
import warnings

from figures import FOLDER, SAVED

import equipix
from equipix import plan
from equipix.errors import MisfitWarning
from equipix.pictures import draw_plans

SENSOR, TRAVEL = (582, 782), 80
CAUSES = {"noise": 5.8e-4, "drift": 3e-5, "shift_error": 0.01, "beam_width": 1000}


def main() -> None:
    """Measure, print and draw."""
    cross = plan.error_budget(SENSOR, equipix.cross_pattern(11, 19), **CAUSES)
    budgets = [cross]
    for exposures in (5, 9):
        start = time.perf_counter()
        best = plan.suggest(SENSOR, exposures, TRAVEL, **CAUSES)[0]
        seconds = time.perf_counter() - start
        drift, noise = (
            best.budget.rms_by_cause[cause] / cross.rms_by_cause[cause]
            for cause in ("drift", "noise")
        )
        print(
            f"{exposures} exposures: {best}, tilt from drift {1 / drift:.1f} times smaller, noise "
            f"{noise:.2f} times that of the cross; a linear trend: "
            f"{best.budget.distinct_trend:.1%} distinct from a tilt; {seconds:.1f} s"
        )
        budgets.append(best.budget)
    draw_plans(budgets).savefig(FOLDER / "plan.png", **SAVED)


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MisfitWarning)
        main()

"""Fits at random whole shifts, beside that of the cross (11, 19), for the table of `make bench`."""

from __future__ import annotations

import itertools
import time
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

import equipix
from equipix import plan, simulate
from equipix.exposures.exposures import Exposures, FitOptions
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Positions
from equipix.measured.measured import measured_of

if TYPE_CHECKING:
    from commands import Row

CROSS = equipix.cross_pattern(11, 19)
COUNTS = 5, 6, 7, 9, 20
MOST_PRODUCTS, MOST_TIMES = {9: 40, 20: 40, 7: 60}, {5: 4.0, 6: 4.0}
"""Products in 95 of 100 fits, and the time over that of the cross in 90 of 100."""
TOLERANCE = 1e-6


class Taken(NamedTuple):
    """What a fit has taken."""

    products: int
    seconds: float
    converged: bool


def rows(
    shape: tuple[int, int] = (582, 782),
    *,
    travels: tuple[int, ...] = (30, 100, 200),
    patterns: int = 100,
) -> list[Row]:
    """Fit each pattern, and the cross in turn with them."""
    found = []
    for count, travel in itertools.product(COUNTS, travels):
        rng = np.random.default_rng([count, travel])
        fits, cross = [], []
        for number in range(patterns):
            if number % 10 == 0:
                cross.append(fit(shape, CROSS))
            fits.append(fit(shape, determined(shape, count, travel, rng)))
        found.append(row(f"{count} positions within ± {travel}", count, fits, cross))
    for count in (5, 6):
        for travel in travels:
            # A stage of travel ± t moves by 2 t in all.
            proposed = plan.suggest(shape, count, 2 * travel, patterns=1)[0].shifts
            fits = [fit(shape, each) for each in (proposed, CROSS) * 3]
            name = f"{count} that plan proposes, ± {travel}"
            found.append(row(name, count, fits[::2], fits[1::2]))
    return found


def determined(
    shape: tuple[int, int], count: int, travel: int, rng: np.random.Generator
) -> np.ndarray:
    """Positions of equal probability that leave no wave undetermined."""
    while True:
        shifts = rng.integers(-travel, travel + 1, (count, 2))
        if plan.identify(shape, shifts).components == 1:
            return shifts


def fit(shape: tuple[int, int], shifts: np.ndarray) -> Taken:
    """Fit the exposures of a sensor without noise."""
    truth = simulate.paper_sensitivity(shape, rng=1)
    frames = simulate.exposures(truth, simulate.gaussian_beam(shape), shifts)
    exposures = Exposures.of(
        measured_of(frames), Positions.of(shifts), Flux.of(None, None, None, len(shifts))
    )
    options = FitOptions.of("multiscale", TOLERANCE, None, None, None)
    start = time.perf_counter()
    done = exposures.fit(options)
    seconds = time.perf_counter() - start
    return Taken(int(done.sweeps[-1]), seconds, done.ended == "converged")


def row(name: str, count: int, fits: list[Taken], cross: list[Taken]) -> Row:
    """Products and times of fits, as a row of the table."""
    products = np.array([each.products for each in fits])
    usual = float(np.median([each.seconds for each in cross]))
    times = np.array([each.seconds for each in fits]) / usual
    failed = sum(not each.converged for each in fits)
    most, longest = MOST_PRODUCTS.get(count), MOST_TIMES.get(count)
    wanted = f"<= {most} in 95 %" if most else f"<= {longest:g} x the cross's time in 90 %"
    got = f"{np.quantile(products, 0.95):.0f}" if most else f"{np.quantile(times, 0.9):.1f} x"
    return (
        f"whole shifts, {name}, to a certified {TOLERANCE:g}",
        wanted,
        got,
        f"products {products.min()} to {products.max()}, median {np.median(products):.0f}; time "
        f"{times.min():.1f} to {times.max():.1f} x, median {np.median(times):.1f} x that of cross "
        f"(11, 19), {usual * 1e3:.0f} ms; {failed} of {len(fits)} not converged",
    )


if __name__ == "__main__":
    for each in rows():
        print(" | ".join(each))

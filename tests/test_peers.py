"""The rivals of `make bench` solve the problem, so that beating them means something."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

import equipix
from equipix import metrics, simulate

pytest.importorskip("numba", reason="needs requirements-bench.txt")
pytest.importorskip("scipy", reason="needs requirements-bench.txt")

SHIFTS = equipix.cross_pattern(5, 7)
SHAPE = (24, 32)


@pytest.fixture(autouse=True)
def benches(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benches")


@pytest.fixture(params=["kuhn_lin_loranz", "over_relaxed", "alternating", "log_lsmr"])
def solve(request):
    from peers import alternating, kuhn_lin_loranz, log_lsmr, over_relaxed

    return {
        "kuhn_lin_loranz": kuhn_lin_loranz.solve,
        "over_relaxed": partial(over_relaxed.solve, factor=1.5),
        "alternating": alternating.solve,
        "log_lsmr": log_lsmr.solve,
    }[request.param]


def exposed(beam):
    truth = simulate.paper_sensitivity(SHAPE, rng=3)

    def error_of(sensitivity):
        return float(np.abs(metrics.relative_error(sensitivity, truth)).max())

    return simulate.exposures(truth, beam, SHIFTS), error_of


class TestSolve:
    @pytest.mark.parametrize(
        "beam", [simulate.gaussian_beam(SHAPE, width=20), simulate.wavy_beam(SHAPE, rng=4)]
    )
    def test_it_converges_to_the_truth(self, solve, beam):
        frames, error_of = exposed(beam)
        outcome = solve(frames, SHIFTS, error_of, 1e-10, 60)
        assert outcome.error <= 1e-10
        assert outcome.passes > 1
        assert 0 < outcome.seconds < 60

    def test_it_takes_any_corner_as_the_origin(self, solve):
        frames, error_of = exposed(simulate.gaussian_beam(SHAPE))
        assert solve(frames, SHIFTS - [9, 2], error_of, 1e-10, 60).error <= 1e-10

    def test_with_shifts_of_the_wrong_sign_it_ends_in_time_elsewhere(self, solve):
        frames, error_of = exposed(simulate.wavy_beam(SHAPE, rng=4))
        outcome = solve(frames, -SHIFTS, error_of, 1e-10, 0.2)
        assert outcome.error > 1e-3


class TestRace:
    @pytest.fixture(autouse=True)
    def clock(self, monkeypatch):
        from peers import race

        self.now = 0.0
        monkeypatch.setattr(race.time, "perf_counter", lambda: self.now)

    def estimates(self):
        """Errors that halve, a second each."""
        for passes in range(1, 1000):
            self.now += 1
            yield np.array(0.5**passes)

    def error_of(self, estimate):
        self.now += 100
        return float(estimate)

    def test_it_ends_when_the_error_is_small_enough(self):
        from peers.race import race

        assert race(self.estimates(), self.error_of, 0.2, seconds=50) == (0.125, 3, 3)

    def test_it_ends_when_the_time_is_over(self):
        from peers.race import race

        assert race(self.estimates(), self.error_of, 0.0, seconds=5) == (0.5**5, 5, 5)

    def test_it_measures_whenever_the_passes_have_grown_by_2_percent(self):
        from peers.race import race

        measured = []
        race(iter(range(1, 1000)), lambda e: measured.append(e) or 1.0 * (e < 500), 0.5, seconds=1)
        assert measured[:100] == list(range(1, 101))
        assert measured[100:104] == [102, 104, 106, 108]
        assert measured[-1] < 500 * 1.02 + 1

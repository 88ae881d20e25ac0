"""The nouns of the input: exposures, their positions and fluxes."""

from __future__ import annotations

import dataclasses
import operator
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import equipix
from equipix import simulate
from equipix.errors import InputError
from equipix.exposures.exposures import Exposures, FitOptions
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Orientation, Positions, in_beam, variance_in_beam
from equipix.fitting import outliers as robust
from equipix.fitting.weighted import expected
from equipix.measured.noise import NoiseModel
from given import exposures_of

SHAPE = (9, 14)
TURNS = (0, 90, 180, 270)
SHIFTS = [(0.0, 0.0), (1.5, -2.25), (3.0, 4.0), (-2.0, 0.5)]


def grid(turn):
    """Row and column of each cell that a turned sensor at shift 0 sees."""
    rows, cols = SHAPE if turn % 180 == 0 else SHAPE[::-1]
    return [np.rot90(axis, turn // 90) for axis in np.indices((rows, cols))]


@pytest.mark.parametrize("turn", TURNS)
def test_a_pixel_sees_the_cell_that_a_turned_window_shows_it(turn):
    seen = grid(turn)
    for pixel in np.ndindex(SHAPE):
        assert in_beam(pixel, turn, SHAPE).tolist() == [axis[pixel] for axis in seen]


@pytest.mark.parametrize("turn", TURNS)
def test_variances_turn_with_the_axes(turn):
    rng = np.random.default_rng(1)
    spots = rng.normal(0, (0.1, 0.3), (4000, 2))
    turned = np.array([in_beam(spot, turn, SHAPE) for spot in spots])
    found = variance_in_beam(spots.var(axis=0), turn)
    # The same numbers in another order, and a constant added to them.
    np.testing.assert_allclose(found, turned.var(axis=0), rtol=1e-10)


def test_a_window_sees_what_its_pixels_saw():
    positions = Positions.of(SHIFTS, rotation=TURNS)
    first, sizes = np.array([2, 5]), np.array([4, 6])
    part = positions.of_window(first, sizes, SHAPE)
    offsets = []
    for k, turn in enumerate(TURNS):
        for pixel in np.ndindex(*sizes):
            whole = in_beam(np.add(pixel, first), turn, SHAPE) + positions.shifts[k]
            own = in_beam(pixel, turn, tuple(sizes)) + part.shifts[k]
            offsets.append(whole - own)
    # One displacement of the beam, by whole cells, for all exposures and pixels.
    np.testing.assert_array_equal(offsets, np.broadcast_to(offsets[0], np.shape(offsets)))
    np.testing.assert_array_equal(offsets[0], np.rint(offsets[0]))


def test_a_window_of_exposures_has_the_sensitivity_of_its_part():
    rng = np.random.default_rng(2)
    shape, shifts = (48, 56), equipix.cross_pattern(5, 7)
    truth = simulate.paper_sensitivity(shape, rng=rng)
    turns = [0, 90, 0, 180, 270]
    frames = simulate.exposures(truth, simulate.wavy_beam(shape, rng=3), shifts, rotation=turns)
    exposures = exposures_of(frames, shifts, rotation=turns)
    fit = exposures.window(32).fit(FitOptions(tolerance=1e-8))
    part = truth[8:40, 12:44]
    np.testing.assert_allclose(fit.sensitivity, part / part.mean(), rtol=1e-7)


def test_a_part_of_exposures_keeps_what_is_known_of_its_pixels():
    rng = np.random.default_rng(5)
    shape, shifts, region = (48, 56), equipix.cross_pattern(5, 7), (slice(6, 44), slice(10, 52))
    truth = simulate.paper_sensitivity(shape, rng=rng)
    colours = np.where(np.indices(shape).sum(axis=0) % 2, 1.2, 0.8)
    frames = simulate.exposures(truth * colours, simulate.wavy_beam(shape, rng=3), shifts)
    marked = rng.random((5, *shape)) < 0.01
    exposures = exposures_of(
        frames, shifts, mask=marked, variance=rng.uniform(1, 2, frames.shape), cfa="RGGR"
    )
    exposures = exposures.marked(hot=marked[0])
    part = exposures.part(region)
    np.testing.assert_array_equal(part.response, exposures.response[region])
    for name in ("values", "variance", "mask"):
        np.testing.assert_array_equal(getattr(part, name), getattr(exposures, name)[:, *region])
    np.testing.assert_array_equal(part.bad_pixels.hot, marked[0][region])
    # The beam of a part is found without the rest of the sensor; there is no noise.
    fit, own = part.fit(FitOptions(tolerance=1e-8)), (truth * colours)[region] / part.response
    found = np.isfinite(fit.sensitivity)
    np.testing.assert_allclose(fit.sensitivity[found], (own / own[found].mean())[found], rtol=1e-7)
    with pytest.raises(ValueError, match="within a period"):
        exposures.part((slice(5, 44), slice(10, 52)))


def test_reversed_exposures_differ_in_the_sign_of_shifts_alone():
    exposures = exposures_of(np.ones((3, 8, 9)), [(0, 0), (1, 0), (0, 2.5)])
    back = Orientation(rows=True, cols=True)
    other = exposures.at(exposures.positions.oriented(back))
    np.testing.assert_array_equal(other.positions.shifts, -exposures.positions.shifts)
    assert other.values is exposures.values
    np.testing.assert_array_equal(other.positions.oriented(back).shifts, exposures.positions.shifts)


def test_masks_add_up():
    exposures = exposures_of(np.ones((3, 8, 9)), [(0, 0), (1, 0), (0, 2)], mask=np.eye(8, 9) > 0)
    more = np.zeros((3, 8, 9), bool)
    more[1, 2, 3] = True
    usable = exposures.without(more).usable()
    assert not usable[1, 2, 3]
    assert not usable[:, range(8), range(8)].any()
    assert np.count_nonzero(~usable) == 25


def test_a_start_at_the_solution_saves_passes_and_keeps_the_answer():
    rng = np.random.default_rng(4)
    shape, shifts = (60, 80), equipix.cross_pattern(7, 11) + rng.uniform(-0.4, 0.4, (5, 2))
    truth = simulate.cosine_sensitivity(shape, rng=rng)
    frames = simulate.exposures(truth, simulate.wavy_beam(shape, rng=3), shifts)
    frames += 1e-3 * rng.standard_normal(frames.shape)
    options = FitOptions(tolerance=1e-6)
    for places in (np.rint(shifts), shifts):
        exposures = exposures_of(frames, places)
        cold = exposures.fit(options)
        start = cold.start()
        warm = exposures.fit(options, start)
        assert warm.ended == "converged"
        assert warm.sweeps[-1] < 0.8 * cold.sweeps[-1]
        # Each is within the tolerance of the minimum, as estimated: three times for the estimate.
        np.testing.assert_allclose(warm.sensitivity, cold.sensitivity, rtol=3 * 2 * 1e-6)
        with pytest.raises(InputError, match="'start' was taken by an earlier fit"):
            exposures.fit(options, start)


def test_exposures_cannot_be_changed():
    exposures = exposures_of(np.ones((3, 8, 9)), [(0, 0), (1, 0), (0, 2)])
    for noun, name in (
        (exposures, "values"),
        (exposures.flux, "kind"),
        (exposures.positions, "std"),
    ):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(noun, name, None)


@pytest.mark.parametrize(
    ("given", "kind", "model"),
    [
        ({}, "known", []),
        ({"flux": [1, 2, 3]}, "known", []),
        ({"flux": [1, 2, 3], "flux_std": 0.1}, "prior", [0.1, 0.1, 0.1]),
        ({"flux": "fit"}, "fit", []),
        ({"flux": "linear", "time": [0, 5, 9]}, "linear", [0.0, 5.0, 9.0]),
    ],
)
def test_fluxes_are_of_one_kind(given, kind, model):
    flux = Flux.of(*(given.get(name) for name in ("flux", "flux_std", "time")), 3)
    assert flux.model == (kind, model)
    free = flux.free(np.array([1.0, 2.0, 3.0]))
    assert free.model == ("fit", [])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"flux": "free"}, "'flux' is 'free', expected numbers, 'fit' or 'linear'"),
        ({"flux": "fit", "flux_std": 0.1}, "'flux_std' is given, but 'flux' is 'fit'"),
        ({"flux": "linear"}, "'time' and flux='linear' need each other"),
        ({"time": [1, 2, 3]}, "'time' is given but 'flux' is not 'linear'"),
        ({"flux": "linear", "time": [1, 1, 1]}, "not all the same"),
        ({"flux_std": 0.0}, "expected positive numbers"),
    ],
)
def test_fluxes_that_do_not_go_together_are_refused(given, message):
    with pytest.raises(InputError, match=message):
        Flux.of(*(given.get(name) for name in ("flux", "flux_std", "time")), 3)


def test_chosen_exposures_keep_all_that_is_known_of_them():
    rng = np.random.default_rng(5)
    values = rng.uniform(1, 2, (5, 8, 9))
    exposures = exposures_of(
        values,
        rng.uniform(-1, 1, (5, 2)),
        variance=rng.uniform(1, 2, 5),
        mask=rng.random((5, 8, 9)) < 0.1,
        flux=rng.uniform(1, 2, 5),
        flux_std=rng.uniform(0.1, 0.2, 5),
        rotation=[0, 90, 180, 270, 0],
        shift_std=rng.uniform(0.1, 0.2, (5, 2)),
    )
    models = tuple(NoiseModel(k + 1.0, 0.0) for k in range(5))
    exposures = dataclasses.replace(exposures, noise=models)
    indices = [4, 1, 2]
    part = exposures.chosen(np.array(indices))
    assert len(part) == 3
    assert part.noise == tuple(models[k] for k in indices)
    for name in ("values", "variance", "mask", "positions.shifts", "positions.rotation"):
        assert_chosen(part, exposures, name, indices)
    for name in ("positions.std", "flux.values", "flux.std"):
        assert_chosen(part, exposures, name, indices)


def assert_chosen(part, whole, name, indices):
    taken, given = (operator.attrgetter(name)(each) for each in (part, whole))
    np.testing.assert_array_equal(taken, [given[k] for k in indices])


def test_what_all_exposures_share_stays_when_some_are_chosen():
    variance = np.random.default_rng(6).uniform(1, 2, (4, 6, 7))
    exposures = exposures_of(
        np.ones((4, 6, 7)),
        np.eye(4, 2),
        variance=variance,
        mask=np.eye(6, 7) > 0,
        flux="linear",
        time=[0, 5, 9, 11],
    )
    part = exposures.chosen(np.array([3, 0]))
    np.testing.assert_array_equal(part.mask, np.eye(6, 7) > 0)
    np.testing.assert_array_equal(part.variance, variance[[3, 0]])
    assert part.flux.time.tolist() == [11, 0]
    assert part.noise == ()


class TestThreads:
    """The number of threads that the caller gives is that of every evaluation of the beam."""

    def test_are_passed_on_to_the_beam(self):
        asked = []

        def light(shape, shift, rotation, *, workers):
            asked.append((shape, shift, rotation, workers))
            return np.ones(shape)

        fit = SimpleNamespace(
            lost=[],
            shifts=[[0.0, 0.0], [1.0, 2.5], [0.0, 0.0]],
            flux=[1.0, 2.0, 1.0],
            beam=SimpleNamespace(light=light),
        )
        exposures = exposures_of(np.ones((3, 8, 9)), np.zeros((3, 2)), rotation=[0, 180, 0])
        seen = exposures.light(fit, 1, 7)
        assert asked == [((8, 9), (1.0, 2.5), 180, 7)]
        np.testing.assert_array_equal(seen, 2.0)

    @pytest.mark.parametrize(
        ("options", "caller"),
        [
            ({}, Exposures.residual),
            ({"robust": True}, robust._seen),
            ({"variance": NoiseModel(1e-3, 1e-9)}, expected),
        ],
        ids=["sign", "robust", "noise model"],
    )
    def test_are_those_of_the_caller_throughout(self, monkeypatch, options, caller):
        asked, light = [], Exposures.light

        def spied(self, fit, exposure, workers):
            asked.append((sys._getframe(1).f_code.co_name, workers))
            return light(self, fit, exposure, workers)

        monkeypatch.setattr(Exposures, "light", spied)
        shape, shifts = (48, 56), equipix.cross_pattern(5, 7)
        frames = simulate.exposures(np.ones(shape), simulate.wavy_beam(shape, rng=3), shifts)
        frames += 1e-3 * np.random.default_rng(1).standard_normal(frames.shape)
        equipix.calibrate(frames, shifts, workers=2, **options)
        assert [name for name, _ in asked].count(caller.__name__) >= len(shifts)
        assert {workers for _, workers in asked} == {2}

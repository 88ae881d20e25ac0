"""`cal.shift_sign`: whether the data confirm the sign of the shifts."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import equipix
from equipix import simulate
from equipix.errors import (
    IdentifiabilityWarning,
    MisfitWarning,
)

SMALL, SMALL_CROSS = (64, 80), equipix.cross_pattern(5, 7)
SENSOR, CROSS = (120, 160), equipix.cross_pattern(11, 19)


def smooth(shape):
    """A beam as a lamp makes it."""
    return simulate.gaussian_beam(shape, width=200)


def experiment(seed, beam, *, shape=SENSOR, cross=CROSS, noise=1e-3, drift=0.0, whole=True, **how):
    """Frames and shifts of a sensor in that beam, which a function of the shape makes."""
    rng = np.random.default_rng(seed)
    shifts = cross.astype(float)
    if not whole:
        shifts[1:] += rng.uniform(-0.5, 0.5, (len(shifts) - 1, 2))
    flux = np.exp(drift * rng.standard_normal(len(shifts))) * how.pop("flux", 1)
    truth = simulate.cosine_sensitivity(shape, rng=rng)
    frames = simulate.exposures(truth, beam(shape), shifts, flux=flux, **how)
    return frames + noise * rng.standard_normal(frames.shape), shifts


REVERSED = "reverse the sign of all shifts"


def wavy(seed):
    """The beam of the sub-pixel check."""
    return lambda shape: simulate.wavy_beam(shape, rng=seed)


def sign_of(frames, shifts, **options):
    """The finding; other misfits of reversed shifts and drifts do not matter here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        warnings.filterwarnings("ignore", f"(?!.*{REVERSED})", MisfitWarning)
        options = {"tolerance": 1e-2} | options
        return equipix.calibrate(frames, shifts, **options).shift_sign


@pytest.mark.study
def test_no_false_alarm_in_200_experiments_with_a_drifting_lamp(draws, figure):
    beams = {
        "gaussian": simulate.gaussian_beam,
        "narrow": lambda shape: simulate.gaussian_beam(shape, width=60, centre=(20, 50)),
        "tilted": simulate.tilted_beam,
        # What distinguishes the orders of axes must be above the misfit of a faint reflection.
        "striped": lambda shape: simulate.striped_beam(shape, period=20),
        "wavy": wavy(1),
    }
    told = {name: [] for name in beams}
    for seed in draws(200):
        name = list(beams)[seed % 5]
        rng = np.random.default_rng([1, seed])
        frames, shifts = experiment(
            seed,
            beams[name],
            shape=SMALL,
            cross=SMALL_CROSS,
            noise=10 ** rng.uniform(-4, -2),
            drift=10 ** rng.uniform(-4, -2),
            whole=seed % 2 == 0,
        )
        told[name].append(sign_of(frames, shifts))  # a warning is an error
    for name, findings in told.items():
        figure(
            f"{name} beam: share that is confirmed",
            findings.count("confirmed") / len(findings),
            "none contradicted",
        )
    assert set(told["wavy"]) == {"confirmed"}
    assert set(told["gaussian"]) == {"undetermined"}
    assert "confirmed" in told["striped"]


@pytest.mark.long
@pytest.mark.parametrize("whole", [True, False])
def test_a_structured_beam_contradicts_reversed_shifts(whole):
    for seed in range(6):
        noise, drift = (1e-2, 1e-3, 1e-5)[seed % 3], (0, 1e-2)[seed % 2]
        frames, shifts = experiment(seed, wavy(seed), noise=noise, drift=drift, whole=whole)
        with pytest.warns(MisfitWarning, match=REVERSED):
            assert sign_of(frames, -shifts) == "contradicted"
        assert sign_of(frames, shifts) == "confirmed"


@pytest.mark.long
def test_shifts_far_apart_ask_a_smaller_window():
    cross = equipix.cross_pattern(97, 160)
    frames, shifts = experiment(1, wavy(1), shape=(240, 320), cross=cross)
    assert sign_of(frames, shifts, max_sweeps=20, tolerance=0.9) == "confirmed"
    with pytest.warns(MisfitWarning, match=REVERSED):
        assert sign_of(frames, -shifts, max_sweeps=20, tolerance=0.9) == "contradicted"


@pytest.mark.parametrize("turn", [90, 180, 270])
def test_turned_exposures(turn):
    shape, cross = (96, 120), np.vstack([CROSS, [(4, -3)]])
    rotation = [0] * 5 + [turn]
    frames, shifts = experiment(2, wavy(2), shape=shape, cross=cross, rotation=rotation)
    assert sign_of(frames, shifts, rotation=rotation) == "confirmed"
    with pytest.warns(MisfitWarning, match=REVERSED):
        assert sign_of(frames, -shifts, rotation=rotation) == "contradicted"


@pytest.mark.parametrize(
    "options",
    [
        {"variance": np.full(5, 1e-6)},
        {"variance": np.full((5, *SENSOR), 1e-6)},
        {"variance": equipix.NoiseModel(1e-3, 1e-9)},
        {"flux": "fit"},
        {"flux": np.ones(5), "flux_std": 1e-2},
        {"method": "coordinate-descent", "max_sweeps": 200},
        {"robust": True},
        {"mask": np.random.default_rng(3).random(SENSOR) < 0.02},
        {"mask": np.random.default_rng(4).random((5, *SENSOR)) < 0.02},
        {"mask": np.indices(SENSOR)[1] > 0.55 * SENSOR[1]},
    ],
    ids=lambda options: "-".join(options),
)
def test_whatever_calibrate_takes(options):
    frames, shifts = experiment(3, wavy(3))
    assert sign_of(frames, shifts, **options) == "confirmed"
    with pytest.warns(MisfitWarning, match=REVERSED):
        assert sign_of(frames, -shifts, **options) == "contradicted"


def test_known_fluxes_of_two_levels():
    shifts, levels = np.tile(SMALL_CROSS, (2, 1)), np.repeat([1, 0.2], 5)
    frames, shifts = experiment(4, wavy(4), shape=SMALL, cross=shifts, flux=levels)
    assert sign_of(frames, shifts, flux=levels) == "confirmed"
    with pytest.warns(MisfitWarning, match=REVERSED):
        assert sign_of(frames, -shifts, flux=levels) == "contradicted"


def test_averaged_frames():
    truth = simulate.paper_sensitivity(SMALL, rng=1)
    camera = simulate.experiment(truth, wavy(5)(SMALL), SMALL_CROSS, rng=2)
    dark = equipix.average(camera.dark())
    frames = [equipix.average(camera.frames(k), dark=dark) for k in range(5)]
    assert sign_of(frames, SMALL_CROSS) == "confirmed"
    with pytest.warns(MisfitWarning, match=REVERSED):
        assert sign_of(frames, -SMALL_CROSS) == "contradicted"


@pytest.mark.study
@pytest.mark.parametrize("size", [(4, 5), (12, 12)])
def test_dust_is_no_finding(size, draws):
    """An opaque grain in one exposure does more to F than chance, at borders by the sign."""
    for seed in draws(12):
        frames, shifts = experiment(seed, smooth)
        rng = np.random.default_rng([2, seed])
        exposure, row, col = rng.integers(5), rng.integers(22, 90), rng.integers(42, 110)
        frames[exposure, row : row + size[0], col : col + size[1]] *= 0.1
        assert sign_of(frames, shifts) == "undetermined"
        assert sign_of(frames, -shifts) == "undetermined"


class TestNotAsked:
    def test_of_two_exposures(self):
        frames, shifts = experiment(1, wavy(1), cross=CROSS[:2])
        assert sign_of(frames, shifts) == "undetermined"

    def test_of_a_small_sensor(self):
        frames, shifts = experiment(1, wavy(1), shape=(12, 16), cross=SMALL_CROSS)
        assert sign_of(frames, -shifts) == "undetermined"

    def test_where_nothing_moves(self):
        frames, shifts = experiment(1, wavy(1), cross=np.full((5, 2), 3))
        assert sign_of(frames, shifts) == "undetermined"

    def test_without_light_in_the_middle(self):
        frames, shifts = experiment(1, wavy(1))
        mask = np.zeros(SENSOR, bool)
        mask[20:100, 40:120] = True
        assert sign_of(frames, shifts, mask=mask) == "undetermined"

    def test_of_a_fitted_dark(self):
        shifts, levels = np.tile(SMALL_CROSS, (2, 1)), np.repeat([1, 0.2], 5)
        frames, shifts = experiment(4, wavy(4), shape=SMALL, cross=shifts, flux=levels)
        assert sign_of(frames, shifts, flux=levels, dark="fit") == "undetermined"


def test_without_noise_nothing_is_made_of_rounding():
    frames, shifts = experiment(1, smooth, noise=0)
    for values in (frames, frames.astype(np.float32)):
        assert sign_of(values, shifts) == sign_of(values, -shifts) == "undetermined"
    frames, shifts = experiment(1, wavy(1), noise=0)
    assert sign_of(frames, shifts) == "confirmed"


def test_progress_and_its_exceptions_come_through():
    class EnoughError(Exception):
        pass

    def stop(_done, _total, stage):
        if stage == "sign of shifts":
            raise EnoughError

    cross = equipix.cross_pattern(97, 160)
    frames, shifts = experiment(1, smooth, shape=(240, 320), cross=cross)
    with pytest.raises(EnoughError):
        sign_of(frames, shifts, max_sweeps=20, tolerance=0.9, progress=stop)


@pytest.mark.parametrize("suffix", [".tif", ".npz"])
def test_it_is_kept_in_files(tmp_path, suffix):
    frames, shifts = experiment(1, wavy(1))
    path = tmp_path / f"cal{suffix}"
    equipix.calibrate(frames, shifts, tolerance=1e-2).save(path)
    assert equipix.load(path).shift_sign == "confirmed"

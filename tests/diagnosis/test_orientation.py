"""`cal.orientation`: which signs and which order of the shifts' axes the data confirm."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import equipix
from equipix import simulate
from equipix.diagnosis.orientation import chosen_exposures
from equipix.errors import EquipixWarning, MisfitWarning
from equipix.exposures.positions import Orientation, Positions

SENSOR, CROSS = (96, 120), equipix.cross_pattern(11, 19)
EVERY = Orientation.every(quarter_turns=False)


def fringes(_shape, *, period=20.0, contrast=0.18):
    """Fringes along rows only: no part of the beam depends on the column."""
    return lambda rows, cols: 1 + contrast * np.cos(2 * np.pi / period * rows) + 0 * cols


def speckle(seed, shape, smallest, largest):
    """Beam of random waves of periods from `smallest` to `largest` pixels, 10 % rms."""
    rng = np.random.default_rng(seed)
    waves = 60
    k = 2 * np.pi / rng.uniform(smallest, largest, waves)
    angle, phase = rng.uniform(0, 2 * np.pi, (2, waves))
    gaussian = simulate.gaussian_beam(shape)

    def beam(rows, cols):
        arguments = zip(k * np.sin(angle), k * np.cos(angle), phase, strict=True)
        structure = sum(np.cos(a * rows + b * cols + start) for a, b, start in arguments)
        return gaussian(rows, cols) * (1 + 0.1 * np.sqrt(2 / waves) * structure)

    return beam


def photograph(seed, beam, shifts=CROSS, noise=1e-3, **how):
    """Frames of a sensor in a beam."""
    rng = np.random.default_rng([5, seed])
    frames = simulate.exposures(simulate.cosine_sensitivity(SENSOR, rng=rng), beam, shifts, **how)
    return frames + noise * rng.standard_normal(frames.shape)


def asked(frames, shifts, **options):
    """What is said of the orientation; other warnings of a wrong one do not matter here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EquipixWarning)
        return equipix.calibrate(frames, shifts, tolerance=1e-2, **options).orientation


@pytest.mark.parametrize("given", EVERY, ids=lambda way: way.words)
def test_each_of_eight_orientations_is_found_and_named(given):
    """The best orientation turns the shifts that are given into the true ones."""
    true = CROSS + np.random.default_rng(1).uniform(-0.5, 0.5, CROSS.shape)
    frames = photograph(1, simulate.wavy_beam(SENSOR, rng=4), true)
    wrong = given.shifts(true)
    found = asked(frames, wrong)
    np.testing.assert_allclose(found.best.shifts(wrong), true, atol=1e-12)
    assert found.sign == ("confirmed" if given == Orientation() else "contradicted")
    assert found.best.words in found.words or found.sign == "confirmed"


@pytest.mark.long
@pytest.mark.parametrize(("true", "given"), [(90, 270), (270, 90)])
def test_an_opposite_quarter_turn_is_named(true, given):
    shifts, turns = np.vstack([CROSS, [(4, -3)]]), np.zeros(6, int)
    turns[-1] = true
    frames = photograph(2, simulate.wavy_beam(SENSOR, rng=5), shifts, rotation=turns)
    assert asked(frames, shifts, rotation=turns, flux="fit").turned == "confirmed"
    turns[-1] = given
    found = asked(frames, shifts, rotation=turns, flux="fit")
    assert (found.turned, found.sign) == ("contradicted", "contradicted")
    assert found.best == Orientation(turned=True)


@pytest.mark.parametrize("mirrored", [False, True])
def test_fringes_along_rows_determine_no_sign_along_columns(mirrored):
    frames = photograph(3, fringes(SENSOR))
    found = asked(frames, Orientation(cols=mirrored).shifts(CROSS.astype(float)))
    assert (found.rows, found.cols, found.sign) == ("confirmed", "undetermined", "undetermined")
    sure = "(they do confirm the sign along rows and the order of the axes)"
    assert f"do not determine the sign along columns {sure}: the beam" in found.words
    assert found.words.endswith(
        "is too smooth for that, which is no fault; compare the axes of the stage once with the "
        "figure in docs/shifts.md, or put structure into the beam"
    )


@pytest.mark.long
def test_rows_reversed_in_fringes_are_never_confirmed():
    """With both axes in the fringes, and with one axis: no finding, or the right one."""
    for seed in range(6):
        beam = fringes(SENSOR, period=12 + 6 * seed)
        if seed % 2:
            beam = simulate.striped_beam(SENSOR, period=12 + 6 * seed, contrast=0.18)
        found = asked(photograph(seed, beam), Orientation(rows=True).shifts(CROSS.astype(float)))
        assert found.sign == "contradicted"
        assert found.rows != "confirmed"


@pytest.mark.long
@pytest.mark.parametrize("periods", [(3, 10), (4, 8)])
def test_fine_speckle_contradicts_reversed_shifts(periods):
    for seed in range(2):
        frames = photograph(seed, speckle(seed, SENSOR, *periods))
        assert asked(frames, -CROSS).sign == "contradicted"
        assert asked(frames, CROSS).sign == "confirmed"


def test_a_scale_that_fits_in_no_orientation_is_not_confirmed():
    """Shifts a third too large, in a beam with structure: every orientation fits badly."""
    frames = photograph(6, simulate.wavy_beam(SENSOR, rng=7))
    found = asked(frames, CROSS * 1.5)
    assert found.sign == "undetermined"
    assert "correlated" in found.words


class TestExposuresThatReturn:
    """23 exposures, every second one at home."""

    SHIFTS = np.zeros((23, 2))
    SHIFTS[1::2] = np.random.default_rng(8).integers(-12, 13, (11, 2))

    def test_are_chosen_by_their_shifts(self):
        chosen = chosen_exposures(Positions.of(self.SHIFTS), 12)
        assert len({tuple(shift) for shift in self.SHIFTS[chosen].tolist()}) == 12

    def test_get_a_finding(self):
        frames = photograph(9, simulate.wavy_beam(SENSOR, rng=9), self.SHIFTS)
        assert asked(frames, self.SHIFTS).sign == "confirmed"
        assert asked(frames, -self.SHIFTS).sign == "contradicted"


def smooth_field(rng, scale, rms):
    """Random field over the sensor with a correlation length of so many pixels."""
    padded = [size + 4 * scale for size in SENSOR]
    squares = [(np.pi * scale * np.fft.fftfreq(size)) ** 2 / 2 for size in padded]
    transfer = np.exp(-squares[0][:, None] - squares[1])
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal(padded)) * transfer).real
    return rms * field[: SENSOR[0], : SENSOR[1]] / np.sqrt(np.mean(field**2))


def with_nuisance(kind, frames, beam_of, rng):
    """Frames of a beam with what is no structure of the beam."""
    if kind == "illumination":
        rms, scale = 10 ** rng.uniform(-3.5, -2.5), int(20 * 10 ** rng.uniform(0, 1))
        return frames * (1 + np.stack([smooth_field(rng, scale, rms) for _ in frames]))
    if kind == "non-linear":
        return frames * (1 + 0.01 * frames / frames.max())
    ghost = simulate.exposures(np.ones(SENSOR), beam_of, -CROSS)
    return frames + 0.005 * ghost


@pytest.mark.long
@pytest.mark.parametrize("kind", ["illumination", "ghost", "non-linear"])
def test_nuisances_give_no_finding(kind):
    """In smooth beams: neither a right finding nor a wrong one."""
    for seed in range(10):
        rng = np.random.default_rng([6, seed])
        beam = simulate.gaussian_beam(SENSOR, width=(300, 1000)[seed % 2])
        noise = 10 ** rng.uniform(-4, -3)
        ghost = simulate.wavy_beam(SENSOR, contrast=0.3, rng=seed)
        frames = with_nuisance(kind, photograph(seed, beam, noise=0), ghost, rng)
        frames = frames + noise * rng.standard_normal(frames.shape)
        for shifts in (CROSS, -CROSS):
            assert asked(frames, shifts).sign == "undetermined"


@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
def test_a_contradiction_is_a_warning_that_names_the_remedy():
    frames = photograph(1, simulate.wavy_beam(SENSOR, rng=4))
    with pytest.warns(MisfitWarning, match=r"exchange the two values.*\(row, col\), not"):
        equipix.calibrate(frames, CROSS[:, ::-1], tolerance=1e-2)


def test_it_is_kept_in_files(tmp_path):
    frames = photograph(3, fringes(SENSOR))
    cal = equipix.calibrate(frames, CROSS, tolerance=1e-2)
    cal.save(tmp_path / "cal.npz")
    assert equipix.load(tmp_path / "cal.npz").orientation == cal.orientation


class TestOrientationsThatLeaveNoResidual:
    """In a Gaussian beam the shifts in another orientation fit as well, with other fluxes."""

    BEAM = staticmethod(simulate.gaussian_beam(SENSOR, width=150, centre=(40, 70)))
    TRUE = np.array([(0, 0), (3, 9), (11, 2), (-7, 8), (5, -9), (-3, -8), (9, 11)], float)
    VARIANCE = np.full(7, 1e-6)

    def calibrated(self, seed, given, **options):
        rng = np.random.default_rng([8, seed])
        truth = simulate.cosine_sensitivity(SENSOR, rng=rng)
        flux = np.exp(options.pop("drift", 0.0) * rng.standard_normal(7))
        frames = simulate.exposures(truth, self.BEAM, self.TRUE, flux=flux)
        frames += 1e-3 * rng.standard_normal(frames.shape)
        options = {"variance": self.VARIANCE, "tolerance": 1e-4} | options
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EquipixWarning)
            cal = equipix.calibrate(frames, given, **options)
        return cal, truth

    @pytest.mark.parametrize(
        "known", [{"flux": "fit"}, {"flux": np.ones(7), "flux_std": 3e-2}], ids=["free", "prior"]
    )
    @pytest.mark.parametrize("way", [Orientation(cols=True), Orientation(rows=True, cols=True)])
    def test_free_fluxes_say_by_how_much_another_sensitivity_fits(self, known, way):
        cal, truth = self.calibrated(1, way.shifts(self.TRUE), **known)
        (found,) = cal.findings
        assert found.kind == ("tilt" if "flux_std" not in known else "orientation")
        assert cal.orientation.sign == "undetermined"
        assert "neither residuals nor fluxes determine the orientation" in found.message
        assert f"differs by {cal.orientation.difference:.1%}" in found.message
        # The error of M by this orientation is no larger than what is said of the worst.
        error = np.std(np.log(cal.sensitivity / truth))
        assert 1e-2 < error < 1.3 * cal.orientation.difference

    def test_a_prior_that_excludes_the_others_says_nothing(self):
        cal, _ = self.calibrated(2, self.TRUE, flux=np.ones(7), flux_std=2e-4)
        assert cal.findings == ()
        assert cal.orientation.hidden is None

    @pytest.mark.parametrize("way", [Orientation(cols=True), Orientation(rows=True, cols=True)])
    def test_a_wrong_sign_is_named_before_the_lamp(self, way):
        """Its fluxes agree with those given in the true orientation alone."""
        for seed in range(3):
            cal, _ = self.calibrated(seed, way.shifts(self.TRUE))
            assert [finding.kind for finding in cal.findings] == ["orientation", "drift"]
            assert cal.orientation.hidden == way
            assert way.words in cal.findings[0].message
            assert "probably wrong" in cal.orientation.words
            assert cal.shift_sign == "undetermined"

    @pytest.mark.long
    def test_a_right_sign_is_never_called_wrong(self):
        for seed in range(6):
            cal, _ = self.calibrated(seed, self.TRUE)
            assert cal.findings == ()
            assert cal.orientation.hidden is None
            assert "do not determine" in cal.orientation.words

    @pytest.mark.long
    def test_a_drift_of_the_lamp_is_no_wrong_sign(self):
        for seed in range(6):
            cal, _ = self.calibrated(seed, self.TRUE, drift=10.0 ** -(1 + seed % 3))
            assert [finding.kind for finding in cal.findings] == ["drift"]

    def test_a_prior_that_only_another_orientation_keeps_names_it_first(self):
        cal, _ = self.calibrated(3, -self.TRUE, flux=np.ones(7), flux_std=2e-4)
        assert [finding.kind for finding in cal.findings] == ["orientation", "prior"]

    def test_it_is_kept_in_files(self, tmp_path):
        cal, _ = self.calibrated(4, -self.TRUE)
        cal.save(tmp_path / "cal.npz")
        assert equipix.load(tmp_path / "cal.npz").orientation == cal.orientation


def test_after_a_wrong_sign_no_other_cause_is_named():
    """Reversed shifts in a beam with structure also contradict fluxes and leave a misfit."""
    frames = photograph(4, simulate.wavy_beam(SENSOR, rng=5))
    with pytest.warns(MisfitWarning, match="A shift grows when the sensor moves") as told:
        cal = equipix.calibrate(frames, -CROSS, variance=np.full(5, 1e-6), tolerance=1e-3)
    assert [finding.kind for finding in cal.findings] == ["sign"]
    assert len(told) == 1

"""A calibration that determines too little is named as such, with its cause."""

from __future__ import annotations

import json
import re
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

import equipix
from equipix import cli, errors, simulate
from equipix.cli import terminal
from equipix.diagnosis import coverage, rules
from equipix.exposures.exposures import Exposures
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Positions
from equipix.measured.measured import measured_of
from equipix.report.figures import summary
from given import written_experiment

SHAPE, CROSS = (40, 50), equipix.cross_pattern(5, 7)
AT_ITS_END = SimpleNamespace(fit=SimpleNamespace(tolerance=1e-6, max_sweeps=None))


def exposures(shifts, noise=1e-3):
    rng = np.random.default_rng(1)
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    frames = simulate.exposures(truth, simulate.gaussian_beam(SHAPE), shifts)
    return frames + noise * rng.standard_normal(frames.shape)


def stripes():
    """A mask that leaves stripes of two rows, farther apart than the shifts reach."""
    mask = np.ones(SHAPE, bool)
    mask[::20] = mask[1::20] = False
    return mask


class TestHeavy:
    """One exposure with most of the weight: its comparisons are small differences."""

    SHIFTS = np.array([(0, 0), (20, 1), (2, 26), (19, 24), (7, 12)])

    @pytest.mark.long
    def test_a_fit_that_does_not_end_names_it(self):
        shape, std = (60, 80), np.array([0.1, 10, 10, 10, 10])
        truth = simulate.paper_sensitivity(shape, rng=1)
        beam = simulate.gaussian_beam(shape, width=120, amplitude=1e4)
        frames = simulate.exposures(truth, beam, self.SHIFTS)
        frames += np.random.default_rng(0).normal(size=frames.shape) * std[:, None, None]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cal = equipix.calibrate(frames, self.SHIFTS, variance=std**2, uncertainty=False)
        (words,) = [each.message for each in cal.findings if each.kind == "convergence"]
        assert re.search("exposure 0 .* has more than 100 times the weight", words)
        # What it says to do.
        std[0] = 1
        advised = equipix.calibrate(frames, self.SHIFTS, variance=std**2, uncertainty=False)
        assert advised.converged
        rms = [(each.sensitivity / (truth / truth.mean())).std() for each in (cal, advised)]
        assert rms[1] < 1.02 * rms[0]

    @pytest.mark.parametrize(
        ("variance", "named"),
        [(None, ""), ([1e-4, 1, 1, 1, 1], "exposure 0"), ([1e-2, 1, 1, 1, 1], "")],
    )
    def test_it_is_that_of_a_hundred_times_the_weight_of_the_others(self, variance, named):
        measured = measured_of(exposures(CROSS), variance and 1e-6 * np.array(variance))
        flux = Flux.of(None, None, None, 5)
        words = coverage.too_heavy(Exposures.of(measured, Positions.of(CROSS), flux))
        assert words.startswith(named)
        assert bool(words) == bool(named)


@pytest.mark.parametrize(
    ("shifts", "options", "cause"),
    [
        ([(0, 0), (0, 11)], {}, "2 exposures compare pixels along one direction only"),
        ([(3, 3)] * 4, {}, "they are all alike: move the sensor"),
        ([(3.3, 2.5)] * 4, {}, "they are all alike: move the sensor"),
        ([(0, 0), (0, 7), (0, 11), (0, 19)], {}, "they lie on one line"),
        ([(0.5, 0.1), (0.5, 7.1), (0.5, 11.1), (0.5, 19.1)], {}, "they lie on one line"),
        (equipix.cross_pattern(4, 6), {}, "leave 4 parts .* unconnected: choose other shifts"),
        (CROSS, {"mask": stripes()}, "values between them are masked"),
        (CROSS + 0.5, {"mask": stripes()}, "values between them are masked"),
        (CROSS, {"saturation": 0.97}, "most of the others reach the saturation level"),
    ],
    ids=[
        "two",
        "alike",
        "alike between pixels",
        "line",
        "line between pixels",
        "lattice",
        "mask",
        "mask between pixels",
        "saturation",
    ],
)
def test_the_cause_is_named(shifts, options, cause):
    with pytest.warns(errors.IdentifiabilityWarning, match=rf"only \d+ of \d+ unmasked .*{cause}"):
        found = equipix.calibrate(exposures(shifts), shifts, **options)
    assert found.is_partial
    assert [each.kind for each in found.findings].count("components") == 0


def test_millimetres_lie_on_no_line():
    flux, positions = Flux.of(None, None, None, 5), Positions.of(0.0083 * CROSS)
    given = Exposures.of(measured_of(exposures(CROSS)), positions, flux)
    words = "they differ by 0.058 pixel at most: move the sensor farther"
    assert coverage._uncompared(given) == words


@pytest.mark.parametrize(
    ("shifts", "cause", "components"),
    [
        ([(0, 0), (0.3, 11.4)], "2 exposures .* take at least 3, .* not lie on one line", None),
        ([(0, 0), (0, 11.3), (0, 18.6)], "they lie on one line: move the sensor along", SHAPE[0]),
    ],
    ids=["two", "line"],
)
def test_positions_between_pixels_are_a_cause_before_the_light(shifts, cause, components, capsys):
    with warnings.catch_warnings(record=True, action="always") as said:
        found = equipix.calibrate(exposures(shifts), shifts)
    assert found.is_partial
    messages = {each.message.kind: str(each.message) for each in said}
    for kind in ("partial", "convergence"):
        assert re.search(rf"do not determine the sensitivity, since {cause}", messages[kind])
        assert "light" not in messages[kind]
    told = summary(found)
    terminal.show_result(told, as_json=True)
    assert json.loads(capsys.readouterr().out)["components"] == components
    terminal.show_result(told, as_json=False)
    out = capsys.readouterr().out
    assert re.search(
        rf"^separate parts of the sensor +{components or 'not determined'}$", out, re.MULTILINE
    )


def test_positions_that_scatter_about_a_line_lie_on_it():
    taken = measured_of(exposures([(0, 0)] * 4))
    flux = Flux.of(None, None, None, 4)
    for away, words in ((0.03, "they lie on one line"), (1.0, "the light is too weak")):
        places = np.array([(0, 0), (away, 11.3), (-away, 18.6), (away, 24.2)])
        fit = SimpleNamespace(ended="stalled", error_estimate=np.array([2.0]))
        given = Exposures.of(taken, Positions.of(places), flux)
        assert words in coverage.why_far(SimpleNamespace(fit=fit, exposures=given), "")


def test_bad_pixels_are_a_cause():
    """Two thirds of the sensor scatter ten times as much as the noise model that is given."""
    rng = np.random.default_rng(2)
    noise = np.where(np.arange(SHAPE[1]) < 17, 5.0, 50.0)
    frames = [
        equipix.average(2000 * each + noise * rng.standard_normal((8, *SHAPE)))
        for each in exposures(CROSS, 0)
    ]
    with pytest.warns(errors.IdentifiabilityWarning, match=r"count as dead, hot or noisy"):
        found = equipix.calibrate(frames, CROSS, variance=equipix.NoiseModel(5.0, 0.0))
    assert found.is_partial


def test_masked_pixels_are_not_missed():
    """Two thirds of the sensor are masked; the rest is determined."""
    mask = np.zeros(SHAPE, bool)
    mask[:, 17:] = True
    found = equipix.calibrate(exposures(CROSS), CROSS, mask=mask)  # warnings are errors here
    assert not found.is_partial


def test_the_finding_is_saved(tmp_path):
    with pytest.warns(errors.IdentifiabilityWarning):
        equipix.calibrate(exposures(CROSS[:2]), CROSS[:2]).save(tmp_path / "cal.npz")
    assert equipix.load(tmp_path / "cal.npz").is_partial


@pytest.fixture(scope="module")
def manifest(tmp_path_factory):
    """An experiment of which only the first and the last exposure are listed."""
    folder = tmp_path_factory.mktemp("partial")
    path = written_experiment(folder, SHAPE, CROSS)
    path.write_text(
        re.sub(r"\[\[exposure\]\]\nname = \"p[1-3]\"\n(?:\w+ = .*\n)+\n*", "", path.read_text())
    )
    text = re.sub(r"aperture_before.*\naperture_after.*", "shift = [7, 0]", path.read_text())
    path.write_text(text)
    return path


def test_the_command_writes_it_only_if_asked(manifest, tmp_path, capsys):
    output = tmp_path / "cal.tif"
    command = ["calibrate", str(manifest), "-o", str(output)]
    with pytest.raises(SystemExit) as done:
        cli.main(command)
    captured = capsys.readouterr()
    assert (done.value.code, captured.out) == (1, "")
    (line,) = captured.err.splitlines()
    assert line.startswith(f"equipix: error: '{output}' is not written (--partial writes it): the")
    assert "2 exposures compare pixels along one direction only" in line
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SystemExit) as done:
        cli.main([*command, "--partial"])
    assert not done.value.code
    assert "equipix: warning: the exposures determine only" in capsys.readouterr().err
    assert equipix.load(output).is_partial


def test_a_fit_far_from_its_minimum_is_written_only_if_asked(manifest, tmp_path, capsys):
    """A hundredth of a pixel is no shift: 50 sweeps end at an estimated error of about 100."""
    small, output = manifest.with_name("small.toml"), tmp_path / "cal.npz"
    small.write_text(manifest.read_text().replace("shift = [7, 0]", "shift = [0.01, 0]"))
    command = ["calibrate", str(small), "-o", str(output), "--max-sweeps", "50"]
    with pytest.raises(SystemExit) as done:
        cli.main(command)
    captured = capsys.readouterr()
    assert (done.value.code, captured.out) == (1, "")
    last = captured.err.splitlines()[-1]
    assert "is not written (--partial writes it): the fit ended far from its minimum" in last
    assert captured.err.count("the fit ended far") == 1
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SystemExit) as done:
        cli.main([*command, "--partial"])
    assert not done.value.code
    found = equipix.load(output)
    assert found.is_partial
    assert found.error_estimate > 1


@pytest.mark.parametrize(
    ("ended", "remedy"),
    [
        ("stalled", "use more light or more frames"),
        ("sweeps used", "allow more sweeps, or use larger shifts"),
    ],
)
def test_measurements_left_out_add_a_remedy_to_a_fit_far_from_its_minimum(ended, remedy):
    fit = SimpleNamespace(ended=ended, error_estimate=np.array([2.0]), lost=[])
    measured, flux = measured_of(exposures(CROSS)), Flux.of(None, None, None, len(CROSS))
    taken = Exposures.of(measured, Positions.of(CROSS), flux)
    evidence = SimpleNamespace(fit=fit, exposures=taken, options=AT_ITS_END)
    plain = coverage.too_far(evidence)
    assert remedy in plain
    fit.lost = [[3], [1, 4]]
    assert coverage.too_far(evidence) == plain
    dead = np.zeros(taken.shape, bool)
    dead[3, 4] = True
    evidence.exposures = taken.marked(dead=dead).without(dead)
    assert coverage.too_far(evidence) == plain
    evidence.exposures = taken.without(dead)
    more = coverage.too_far(evidence)
    assert more.startswith(f"{plain}. Besides, 3 measurements along ragged edges")


@pytest.mark.parametrize(
    ("ended", "error"), [("stalled", 2.0), ("stalled", 1e-3), ("sweeps used", 2.0)]
)
def test_a_flux_that_the_light_contradicts_is_the_cause_of_a_fit_that_fails(ended, error):
    frames = exposures(CROSS)
    frames[2] *= 0.1
    flux = Flux.of(None, None, None, len(CROSS))
    taken = Exposures.of(measured_of(frames), Positions.of(CROSS), flux)
    fit = SimpleNamespace(ended=ended, error_estimate=np.array([error]), lost=[], sweeps=[9])
    evidence = SimpleNamespace(fit=fit, exposures=taken, options=AT_ITS_END)
    (rule,) = (each for each in rules.AFTER if each.kind == "convergence")
    cause = r"exposure 2 \(from 0\) has 0\.1 times the light that its flux says: check"
    assert re.search(cause, rule.ask(evidence))
    assert error < 1 or re.search(cause, coverage.too_far(evidence))
    # Who limits the passes is told of the limit; lines are a cause before fluxes.
    evidence.options = SimpleNamespace(fit=SimpleNamespace(tolerance=1e-6, max_sweeps=8))
    if ended == "sweeps used":
        assert rule.ask(evidence).endswith(": allow more sweeps")
    evidence.exposures = Exposures.of(
        measured_of(frames), Positions.of(np.multiply(CROSS, [1, 0])), flux
    )
    assert "do not determine the sensitivity" in rule.ask(evidence)


def test_a_pixel_that_masks_leave_alone_is_no_fault_of_the_shifts():
    cells = {tuple(shift) for shift in CROSS.tolist()}
    others = {(r - a, c - b) for r, c in cells for a, b in cells}
    mask = np.zeros(SHAPE, bool)
    for r, c in others - {(0, 0)}:
        if min(r, c) >= 0:
            mask[r, c] = True
    with pytest.warns(errors.IdentifiabilityWarning, match="undetermined"):
        cal = equipix.calibrate(exposures(CROSS), CROSS, mask=mask)
    (words,) = [each.message for each in cal.findings if each.kind == "components"]
    assert "sensitivity of 1 pixel outside" in words
    assert "masked, missing or saturated: use shorter shifts" in words


@pytest.mark.parametrize("flipped", [False, True])
def test_clipped_values_do_not_show_that_variances_are_wrong(flipped):
    """A flipped exposure is named beside them."""
    rng = np.random.default_rng(1)
    beam = simulate.gaussian_beam(SHAPE, width=60)
    frames = simulate.exposures(simulate.paper_sensitivity(SHAPE, rng=rng), beam, CROSS)
    frames += 3e-3 * rng.standard_normal(frames.shape)
    if flipped:
        frames[2] = frames[2, ::-1]
    clipped = np.minimum(frames, np.quantile(frames, 0.9))
    with pytest.warns(errors.EquipixWarning):
        cal = equipix.calibrate(clipped, CROSS, variance=np.full(5, 9e-6))
    kinds = [each.kind for each in cal.findings]
    assert kinds == (["saturation", "misfit"] if flipped else ["saturation"])
    assert cal.reduced_chi2 > 1.1

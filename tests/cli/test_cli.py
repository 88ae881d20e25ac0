"""The command line: exit status, outputs whole or none, words for people and for machines."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import io
import json
import os
import pty
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import equipix
from equipix import average, cli, simulate
from equipix.cli import terminal
from equipix.errors import FileError
from equipix.io.frames import read_frames
from equipix.io.paths import write_whole
from equipix.io.tiff import write_frames

SHAPE = (64, 80)


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    sensitivity = simulate.cosine_sensitivity(SHAPE, rng=1)
    beam = simulate.gaussian_beam(SHAPE, width=200)
    shifts = [(0, 0), (0, 5), (0, 7), (5, 0), (7, 0)]
    virtual = simulate.experiment(sensitivity, beam, shifts, frames=6, rng=5)
    return virtual.write(tmp_path_factory.mktemp("cli") / "experiment")


@pytest.fixture(scope="module")
def calibration(experiment):
    path = experiment.parent / "cal.tif"
    with pytest.raises(SystemExit) as done:
        cli.main(["calibrate", str(experiment), "-o", str(path), "--tolerance", "1e-4"])
    assert done.value.code == 0
    return path


def refused(result, *words):
    """A failed job says why in one line on stderr, and nothing on stdout."""
    status, out, err = result
    assert (status, out) == (1, "")
    assert err.startswith("equipix: error: ")
    assert err.count("\n") == 1
    for word in words:
        assert str(word) in err


# Each command


@pytest.mark.parametrize(
    "command", ["demo", "simulate", "average", "calibrate", "compare", "correct", "inspect"]
)
def test_help_has_an_example(run, command):
    status, out, _ = run(command, "--help")
    assert status == 0
    assert f"Example: equipix {command} " in out


def test_calibrate_reports_what_it_saved(run, experiment, tmp_path):
    output = tmp_path / "cal.npz"
    status, out, err = run(
        "calibrate", experiment, "-o", output, "--tolerance", "1e-4", "--workers", "1", "--json"
    )
    assert (status, err) == (0, "")
    result = json.loads(out)
    saved = equipix.load(output)
    assert result["sweeps"] == saved.sweeps
    assert result["converged"] is True
    assert result["shape"] == list(SHAPE)
    assert result["flagged_pixels"]["DEAD"] == 4
    assert result["flagged_pixels"]["DO_NOT_USE"] == 8
    assert saved.metadata["options"]["tolerance"] == 1e-4


@pytest.mark.long
@pytest.mark.parametrize("frames", [20, 100, 500])
def test_a_simulated_8_bit_camera_is_calibrated_without_false_pixels(run, tmp_path, frames):
    """Its noise is below a step, so that rounding is a part of it; 2175 pixels were hot."""
    folder, output = tmp_path / "experiment", tmp_path / "cal.npz"
    given = ("--bit-depth", 8, "--frames", frames, "--shape", 120, 160)
    assert run("simulate", "-o", folder, *given)[0] == 0
    status, out, err = run("calibrate", folder / "experiment.toml", "-o", output, "--json")
    assert (status, err) == (0, "")
    saved = equipix.load(output)
    with np.load(folder / "truth.npz") as file:
        truth = dict(file)
    bad = np.concatenate([truth["dead"], truth["hot"]])
    np.testing.assert_array_equal(np.flatnonzero(saved.flags), np.sort(bad))
    freedom = (5 - 2) * truth["sensitivity"].size
    assert json.loads(out)["reduced_chi2"] == pytest.approx(1, abs=5 * np.sqrt(2 / freedom))


def test_warnings_are_one_line_each(run, experiment, tmp_path):
    status, out, err = run(
        "calibrate", experiment, "-o", tmp_path / "cal.tif", "--max-sweeps", "2", "--json"
    )
    assert status == 0
    assert json.loads(out)["converged"] is False
    assert re.fullmatch(r"equipix: warning: not converged after \d sweeps[^\n]*\n", err)


def test_findings_and_rejected_values_are_reported(run, experiment, tmp_path):
    output = tmp_path / "cal.tif"
    command = ("calibrate", experiment, "-o", output, "--max-sweeps", "2", "--robust")
    status, out, err = run(*command)
    assert status == 0
    assert re.search(r"\nfindings +convergence\n", out)
    saved = equipix.load(output)
    (finding,) = saved.findings
    assert finding.message in err
    inspected = json.loads(run("inspect", output, "--json")[1])
    calibrated = json.loads(run(*command, "--force", "--json")[1])
    for told in (inspected, calibrated):
        assert told["findings"] == [dataclasses.asdict(finding)]
        assert told["is_partial"] is False
        assert list(told["rejected_values"]) == ["p0", "p1", "p2", "p3", "p4"]
        assert list(told["rejected_values"].values()) == saved.metadata["rejected"]
    out = run("inspect", output)[1]
    assert re.search(rf"\nfindings +convergence: {re.escape(finding.message)}\n", out)
    assert re.search(r"\nrejected values +p0 \d+, p1 ", out)


def test_inspect_shows_the_calibration(run, calibration):
    status, out, _ = run("inspect", calibration)
    assert status == 0
    for line in (
        r"shape +64 rows × 80 columns",
        r"converged +yes",
        r"flagged pixels +DO_NOT_USE 8",
        r"\ndark +\[dark\]\n",
        r"\n +p0 .* 1 *\n",
    ):
        assert re.search(line, out)
    # The sign of the shifts is said once, in words that go with "findings none".
    assert re.search(r"findings +none", out)
    assert "shift sign" not in out
    words = (
        "the data do not determine the orientation: the beam is too smooth for that, which is no"
    )
    assert re.search(rf"orientation of the shifts +{words} fault; compare .* docs/shifts.md", out)
    _, out, _ = run("inspect", calibration, "--json")
    assert json.loads(out)["shift_sign"] == "undetermined"
    told, saved = json.loads(out), equipix.load(calibration)
    assert told["metadata"]["sensor"]["bit_depth"] == 12
    assert told["sensitivity_mean"] == pytest.approx(1)
    assert [each["shift"] for each in told["exposures"]] == saved.shifts.tolist()
    assert told["exposures"][0] | {"flux": 1} == {
        "exposure": "p0", "shift": saved.shifts[0].tolist(), "shift_std": [0, 0], "flux": 1,
        "dark": "[dark]",
    }  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("count", [5, 13])
def test_shifts_are_printed_with_their_standard_deviations(run, tmp_path, count):
    rng = np.random.default_rng(1)
    shifts = np.rint(12 * rng.random((count, 2))) + 0.5 * np.eye(count, 2)
    frames = simulate.exposures(np.ones((32, 40)), simulate.gaussian_beam((32, 40)), shifts)
    found = equipix.calibrate(
        frames + 1e-3 * rng.standard_normal(frames.shape),
        shifts,
        shift_std=0.02,
        variance=np.full(count, 1e-6),
        uncertainty=True,
    )
    found.save(tmp_path / "cal.tif")
    out = run("inspect", tmp_path / "cal.tif")[1]
    listed = re.findall(
        r"^ +(\d+) +(-?\d+\.\d{4} ± 0\.\d{4}), (-?\d+\.\d{4} ± 0\.\d{4}) +1", out, re.M
    )
    told = json.loads(run("inspect", tmp_path / "cal.tif", "--json")[1])["exposures"]
    assert [each["shift_std"] for each in told] == found.shift_std.tolist()
    if count > 12:
        assert not listed
        assert re.search(r"\nexposures +13: --json and equipix report list them\n", out)
    else:
        assert "pixels" in out
        (row, std), (col, _) = (each.split(" ± ") for each in listed[1][1:])
        assert (float(row), float(col)) == pytest.approx(found.shifts[1], abs=5e-5)
        assert float(std) == pytest.approx(found.shift_std[1, 0], abs=5e-5)


def test_shifts_measured_by_a_hole_have_the_errors_of_the_measurement(run, tmp_path):
    shifts = equipix.cross_pattern(2, 3)
    frames = simulate.exposures(np.ones((20, 16)), simulate.gaussian_beam((20, 16)), shifts)
    noise = np.random.default_rng(1).standard_normal(frames.shape)
    found = equipix.calibrate(frames + 1e-3 * noise, shifts)
    stated = np.full((5, 2), 0.02)
    stated[0] = 0
    for std, wanted in ((stated, stated.tolist()), (0 * stated, [None] * 5)):
        given = found.metadata | {"measured_shift_std": std.tolist()}
        saved = dataclasses.replace(found, metadata=given)
        saved.save(tmp_path / "cal.npz", force=True)
        status, out, _ = run("inspect", tmp_path / "cal.npz", "--json")
        assert status == 0
        assert [each["shift_std"] for each in json.loads(out)["exposures"]] == wanted
        assert ("± 0.0200" in run("inspect", tmp_path / "cal.npz")[1]) == std.any()


@pytest.mark.parametrize("weights", ["equal", "variances"])
def test_inspect_names_the_mean_square_residual(run, tmp_path, weights):
    beam, shifts = simulate.gaussian_beam(SHAPE), equipix.cross_pattern(5, 7)
    frames = simulate.exposures(np.ones(SHAPE), beam, shifts)
    frames += 1e-3 * np.random.default_rng(1).standard_normal(frames.shape)
    variance = None if weights == "equal" else np.full(5, 1e-6)
    equipix.calibrate(frames, shifts, variance=variance).save(tmp_path / "cal.tif")
    out = run("inspect", tmp_path / "cal.tif", "--json")[1]
    # 13 000 degrees of freedom.
    if weights == "equal":
        assert json.loads(out)["variance_of_a_value"] == pytest.approx(1e-6, rel=0.05)
        assert "reduced_chi2" not in json.loads(out)
        assert "variance of a value" in run("inspect", tmp_path / "cal.tif")[1]
    else:
        assert json.loads(out)["reduced_chi2"] == pytest.approx(1, rel=0.05)
        assert "variance_of_a_value" not in json.loads(out)


def test_inspect_says_what_is_no_calibration(run, experiment, tmp_path):
    frames, mean = experiment.parent / "frames/p0.tif", tmp_path / "mean.tif"
    assert run("average", frames, "-o", mean)[0] == 0
    np.savez(tmp_path / "arrays.npz", values=np.ones(3))
    refused(run("compare", mean, mean), mean, "holds frame statistics, expected calibration")
    for other in (frames, tmp_path / "arrays.npz"):
        refused(run("inspect", other), other, "holds neither a correction", "did not write it")


def test_inspect_shows_an_average(run, experiment, tmp_path):
    frames, dark = experiment.parent / "frames/p0.tif", experiment.parent / "dark/dark.tif"
    mean = tmp_path / "mean.npz"
    run("average", frames, "--dark", dark, "--saturation", "4095", "-o", mean)
    status, out, _ = run("inspect", mean, "--json")
    told = json.loads(out)
    assert status == 0
    assert (told["shape"], told["frames"], told["saturation"]) == (list(SHAPE), 6, 4095)
    assert told["dark_frames"] == equipix.load(mean).dark.count.max()
    assert told["mean"] == pytest.approx(equipix.load(mean).mean.mean())
    assert "saturated pixels" in run("inspect", mean)[1]
    run("average", frames, "-o", mean, "--force")
    assert re.search(r"\nsaturation +65535 DN\n", run("inspect", mean)[1])


def test_a_file_is_not_averaged_twice(run, experiment, tmp_path):
    frames, copy, out = (
        experiment.parent / "frames/p0.tif",
        tmp_path / "copy.tif",
        tmp_path / "m.tif",
    )
    copy.write_bytes(frames.read_bytes())
    refused(run("average", frames, frames, "-o", out), "'p0.tif' stands twice in the frames")
    refused(run("average", frames, copy, "-o", out), "'p0.tif' and 'copy.tif' are the same images")
    refused(
        run("average", frames, "--dark", frames, "-o", out), "'p0.tif' stands in the frames and"
    )
    refused(run("average", frames, "--dark", copy, "-o", out), "are the same images, and stand in")
    assert not out.exists()


def test_average_writes_statistics(run, experiment, tmp_path):
    frames, dark = experiment.parent / "frames", experiment.parent / "dark/dark.tif"
    output = tmp_path / "mean.tif"
    status, out, _ = run(
        "average", frames / "p0.tif", frames / "p1.tif", "--dark", dark, "-o", output,
        "--saturation", "4095", "--json",
    )  # fmt: skip
    assert status == 0
    told = json.loads(out)
    assert (told["frames"], told["findings"]) == (12, [])
    expected = average([frames / "p0.tif", frames / "p1.tif"], dark=average(dark), saturation=4095)
    saved = equipix.load(output)
    for name, values in expected.maps.items():
        np.testing.assert_array_equal(getattr(saved, name), values)
    files = [str(each) for each in (frames / "p0.tif", frames / "p1.tif", dark)]
    assert [*saved.metadata["inputs"]] == files
    digest = hashlib.sha256(dark.read_bytes()).hexdigest()
    assert saved.metadata["inputs"][files[-1]] == digest
    # A saved average keeps its origin.
    run("average", output, "-o", tmp_path / "again.tif")
    again = equipix.load(tmp_path / "again.tif").metadata
    assert {*again["inputs"]} == {*files, str(output)}
    assert {name: again[name] for name in ("options", "started", "finished")} == {
        "options": {"saturation": 4095, "reject": None},
        "started": saved.metadata["started"],
        "finished": saved.metadata["finished"],
    }


def test_what_an_average_does_not_determine_is_said_in_words(run, tmp_path):
    frame = np.arange(20 * 24, dtype=np.float32).reshape(20, 24)
    write_frames(tmp_path / "one.tif", iter([frame]), nbytes=1)
    command = ("average", tmp_path / "one.tif", "-o", tmp_path / "mean.npz")
    status, out, _ = run(*command)
    assert status == 0
    rows = dict(re.split("  +", line, maxsplit=1) for line in out.splitlines())
    assert (rows["variance of a frame"], rows["saturation"]) == ("not determined", "none")
    assert rows["findings"] == "none"
    told = json.loads(run(*command, "--json", "--force")[1])
    assert (told["variance"], told["saturation"]) == (None, None)


def test_correct_to_one_file_and_to_a_folder(run, experiment, calibration, tmp_path):
    inputs = [experiment.parent / f"frames/p{k}.tif" for k in range(2)]
    expected = equipix.load(calibration).correct(read_frames(inputs), flagged="replace")
    one, folder = tmp_path / "all.tif", tmp_path / "corrected"
    for output in (one, folder):
        status, out, _ = run(
            "correct", calibration, *inputs, "-o", output, "--flagged", "replace", "--json"
        )
        assert status == 0
        assert json.loads(out)["frames"] == 12
    np.testing.assert_array_equal(read_frames(one), expected)
    assert sorted(path.name for path in folder.iterdir()) == ["p0.tif", "p1.tif"]
    np.testing.assert_array_equal(read_frames(folder / "p1.tif"), expected[6:])


def test_json_has_null_for_numbers_that_do_not_exist(capsys):
    values = {
        "a": float("nan"),
        "b": [1.5, [np.float64("inf")]],
        "c": ({"d": -np.inf},),
        "e": "nan",
    }
    terminal.show_result(values, as_json=True)
    out = capsys.readouterr().out
    assert json.loads(out) == {
        "a": None, "b": [1.5, [None]], "c": [{"d": None}], "e": "nan", "findings": []
    }  # fmt: skip
    terminal.show_result({"a": np.inf, "b": [1.5, np.nan], "nan": "nan.tif"}, as_json=False)
    said = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    assert said == [["a", "not determined"], ["b", "1.5, not determined"], ["nan", "nan.tif"]]


@pytest.mark.parametrize("folder", [False, True])
def test_correct_warns_of_corrected_frames(run, experiment, calibration, tmp_path, folder):
    inputs = [experiment.parent / f"frames/p{k}.tif" for k in range(2)]
    once, twice = (tmp_path / (name if folder else f"{name}.tif") for name in ("once", "twice"))
    status, _, err = run("correct", calibration, *inputs, "-o", once)
    assert (status, err) == (0, "")
    corrected = sorted(once.iterdir()) if folder else [once]
    status, out, err = run("correct", calibration, *corrected, "-o", twice, "--json")
    assert (status, [each["kind"] for each in json.loads(out)["findings"]]) == (0, ["corrected"])
    more = " and 1 more" if folder else ""
    assert err.startswith(f"equipix: warning: {corrected[0]}{more}: corrected already")
    assert err.count("\n") == 1


def test_correct_refuses_an_input_that_is_named_twice(run, experiment, calibration, tmp_path):
    raw = tmp_path / "p0.tif"
    raw.write_bytes((experiment.parent / "frames/p0.tif").read_bytes())
    (tmp_path / "link.tif").symlink_to(raw)
    for again in (raw, tmp_path / "*.tif", tmp_path / "link.tif"):
        for output in (tmp_path / "out.tif", tmp_path / "out"):
            refused(run("correct", calibration, raw, again, "-o", output), "named twice")
            assert not output.exists()


def test_correct_takes_another_dark(run, experiment, calibration, tmp_path):
    frames, dark = experiment.parent / "frames/p0.tif", experiment.parent / "dark/dark.tif"
    mean = tmp_path / "mean.tif"
    assert run("average", dark, "-o", mean)[0] == 0
    corrected = []
    for choice in ("none", dark, mean):
        output = tmp_path / f"{len(corrected)}.tif"
        assert run("correct", calibration, frames, "-o", output, "--dark", choice)[0] == 0
        corrected.append(read_frames(output))
    plain, dark_subtracted, mean_subtracted = corrected
    np.testing.assert_array_equal(mean_subtracted, dark_subtracted)
    assert np.nanmean(plain - dark_subtracted) == pytest.approx(60, abs=10)


def test_all_colour_filters_of_the_help_can_be_simulated(run, tmp_path):
    said = terminal.Cfa.__metadata__[0].help
    patterns = re.findall(r"\b[A-Z]{2,}(?:/[A-Z]+)*/?", said)
    assert len(patterns) == 6
    for k, cfa in enumerate(patterns):
        command = ("simulate", "-o", tmp_path / str(k), "--shape", 48, 64, "--frames", 1)
        assert run(*command, "--cfa", cfa)[0] == 0
    refused(run(*command, "--force", "--cfa", "RGBW/"), "the colours ['W']", "use these alone")


def test_simulate_writes_an_experiment(run, tmp_path):
    output = tmp_path / "experiment"
    command = ("simulate", "-o", output, "--shape", "64", "80", "--frames", "2", "--rng", "3")
    assert run(*command)[0] == 0
    assert (output / "experiment.toml").is_file()
    refused(run(*command), output, "exists")
    assert run(*command, "--force")[0] == 0


@pytest.mark.long
@pytest.mark.data
def test_photon_transfer_gain_of_a_real_camera(run, data_dir, tmp_path):
    """K = slope of the variance over the mean; the EMVA reference gives 0.280 DN/e-."""
    folder = data_dir / "emva1288-set001-ccd-12bit"
    bright, dark = (levels[:50:3] for levels in exposures_of(folder))
    means, variances = [], []
    for k, (frames, darks) in enumerate(zip(bright, dark, strict=True)):
        output, offset = tmp_path / f"{k}.npz", tmp_path / f"{k}-dark.npz"
        assert run("average", *frames, *with_dark(darks), "-o", output)[0] == 0
        assert run("average", *darks, "-o", offset)[0] == 0
        signal, dark_signal = equipix.load(output), equipix.load(offset)
        means.append(signal.mean.mean())
        variances.append(signal.variance.mean() - dark_signal.variance.mean())
    means, variances = np.array(means), np.array(variances)
    # As EMVA 1288 says: from 0 to 70 % of the saturation capacity, where the variance peaks.
    linear = means <= 0.7 * means[np.argmax(variances)]
    gain = np.sum(means[linear] * variances[linear]) / np.sum(means[linear] ** 2)
    assert gain == pytest.approx(0.280, rel=0.02)


def exposures_of(folder):
    """Paths of the bright and of the dark frames of each exposure, by the descriptor."""
    bright, dark = [], []
    for line in (folder / "EMVA1288_Data.txt").read_text().splitlines():
        kind, _, rest = line.strip().partition(" ")
        if kind in ("b", "d"):
            (bright if kind == "b" else dark).append(frames := [])
        elif kind == "i":
            frames.append(folder / rest.strip().replace("\\", "/"))
    return bright, dark


def with_dark(paths):
    return [word for path in paths for word in ("--dark", path)]


# Failures


def test_version(run):
    assert run("--version") == (0, f"{equipix.__version__}\n", "")


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "1"])
def test_a_tolerance_that_is_none_is_refused(run, experiment, tmp_path, value):
    output = tmp_path / "cal.tif"
    refused(run("calibrate", experiment, "-o", output, "--tolerance", value), "--tolerance is")


def test_usage_errors_have_status_2(run, experiment, tmp_path):
    assert run()[0] == 2
    assert run("calibrate")[0] == 2
    assert run("calibrate", experiment, "-o", tmp_path / "c.tif", "--workers", "0")[0] == 2
    assert run("calibrate", experiment, "-o", tmp_path / "c.tif", "--method", "magic")[0] == 2
    assert run("simulate", "-o", tmp_path / "e", "--shape", "-3", "5")[0] == 2
    assert run("nothing")[0] == 2


@pytest.mark.parametrize("command", ["calibrate", "average", "correct", "demo"])
def test_an_existing_output_is_refused_before_the_work(run, tmp_path, command):
    suffix = ".png" if command == "demo" else ".tif"
    output = tmp_path / f"precious{suffix}"
    output.write_text("precious")
    # The inputs do not exist: were the work begun, the message would name them.
    inputs = {"calibrate": ["x.toml"], "average": ["x"], "correct": ["x", "y"], "demo": []}
    refused(run(command, *inputs[command], "-o", output), output, "--force")
    assert output.read_text() == "precious"


def test_a_picture_and_a_folder_of_one_name_are_refused(run, tmp_path):
    picture = tmp_path / "demo.png"
    refused(run("demo", "-o", picture, "--keep", picture), picture, "named for two outputs")
    assert not picture.exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ("inspect", "none.npz"),
        ("hardware", "none.npz", "-o", "table.bin"),
        ("correct", "none.npz", "raw.tif", "-o", "out.tif"),
    ],
)
def test_a_missing_correction_does_not_exist(run, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    refused(run(*arguments), "none.npz: does not exist")


@pytest.mark.parametrize("name", ["no/folder/cal.tif", "cal.jpg", "cal"])
def test_an_impossible_output_is_refused_before_the_work(run, tmp_path, name):
    refused(run("calibrate", "x.toml", "-o", tmp_path / name), tmp_path / name)


def test_a_folder_is_refused_where_a_file_is_wanted_and_a_file_where_a_folder(run, tmp_path):
    folder, file = tmp_path / "folder.tif", tmp_path / "file"
    folder.mkdir()
    file.touch()
    for command in (["calibrate", "x"], ["average", "x"], ["correct", "x", "y"]):
        refused(run(*command, "-o", folder, "--force"), folder, "is a folder")
    refused(run("correct", "x", "y", "-o", file, "--force"), file, "is a file")
    refused(run("simulate", "-o", file, "--force"), file, "is a file")


def test_force_replaces(run, experiment, tmp_path):
    output = tmp_path / "mean.tif"
    output.write_text("old")
    frames = experiment.parent / "frames/p0.tif"
    assert run("average", frames, "-o", output, "--force")[0] == 0
    assert equipix.load(output).mean.shape == SHAPE


def test_an_input_is_never_replaced(run, experiment, calibration, tmp_path):
    raw = tmp_path / "p0.tif"
    raw.write_bytes(content := (experiment.parent / "frames/p0.tif").read_bytes())
    (tmp_path / "link").symlink_to(tmp_path)
    for output in (raw, tmp_path, tmp_path / "link/p0.tif"):
        refused(run("correct", calibration, raw, "-o", output, "--force"), "one of the inputs")
    refused(run("average", raw, "-o", raw, "--force"), raw, "one of the inputs")
    refused(run("correct", calibration, raw, "-o", calibration, "--force"), "one of the inputs")
    frames = experiment.parent / "frames/p1.tif"
    refused(run("calibrate", experiment, "-o", frames, "--force"), frames, "one of the inputs")
    assert raw.read_bytes() == content


def test_files_that_cannot_be_read_say_what_to_do(run, experiment, calibration, tmp_path):
    frames, output = experiment.parent / "frames/p0.tif", tmp_path / "mean.tif"
    table = tmp_path / "table.bin"
    assert run("hardware", calibration, "-o", table)[0] == 0
    for name, content, words in (
        ("cut.tif", frames.read_bytes()[:9999], "is truncated: copy it again"),
        ("cal.tif", calibration.read_bytes()[:9999], "is damaged: array 'sensitivity' is missing"),
        ("no.npz", b"hello", "damaged, or no .npz file: use a copy"),
        ("word.tif", b"hello", "use a"),
        ("latin.toml", "format = 1\n# caf\xe9".encode("latin-1"), "line 2 is no UTF-8: save it"),
        ("table.h", table.read_bytes(), "damaged, or no .h file: use a copy"),
        ("table.hex", table.read_bytes(), "damaged, or no .hex file: use a copy"),
        ("text.bin", b"hello", "written in the format of its name: name such a file"),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        command = "calibrate" if name == "latin.toml" else "inspect"
        command = "average" if name in ("cut.tif", "word.tif") else command
        result = run(command, path, *(() if command == "inspect" else ("-o", output)))
        refused(result, f"{path}: ", words)
        assert not re.search("codec|zip|Errno|byte 0x|expected str", result[2])
    cut = tmp_path / "cut.tif"
    for size in (9999, frames.stat().st_size - 1000):
        cut.write_bytes(frames.read_bytes()[:size])
        for result in (
            run("correct", calibration, cut, "-o", tmp_path / "corrected.tif"),
            run("average", cut, "-o", output),
        ):
            refused(result, f"{cut}: is truncated: copy it again, or record it again")
    for command, name, content, words in (
        ("average", "text.dng", b"hello", "is no .dng file of a camera that LibRaw reads"),
        ("average", "text.fits", b"hello", "no .fits file: use a copy, or make it again (it holds"),
        (
            "calibrate",
            "frame.tif",
            frames.read_bytes(),
            "is no text, expected the file experiment.toml",
        ),
        ("inspect", "raw.tif", frames.read_bytes(), "Images are for equipix average, or for"),
        ("inspect", "raw.dng", b"hello", "Images are for equipix average"),
        (
            "calibrate",
            "one.toml",
            b"[[exposure]]\nname = 'a'\nframes = 'b'",
            "'exposure' holds 1 table, expected",
        ),
        ("calibrate", "two.toml", b"exposure = [1, 2]", "[[exposure]] 1 is 1, expected a table"),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        result = run(command, path, *(() if command == "inspect" else ("-o", output)))
        refused(result, f"{name}: ", words)
    result = run("calibrate", tmp_path, "-o", output)
    refused(result, f"{tmp_path}: is a folder, expected the file experiment.toml")
    for command in (("calibrate",), ("nuc", "fit")):
        result = run(*command, tmp_path / "no.toml", "-o", output)
        refused(result, f"{tmp_path / 'no.toml'}: does not exist, expected the file ")
    refused(run("emva", tmp_path / "EMVA.txt"), f"{tmp_path / 'EMVA.txt'}: does not exist")
    for name in ("nosuch.bin", "nosuch.h", "nosuch.npz", "nosuch.tif"):
        refused(run("inspect", tmp_path / name), f"{name}: does not exist")


def test_an_output_that_no_folder_takes_is_named_alone(run, experiment):
    result = run("average", experiment.parent / "frames/p0.tif", "-o", "/proc/x.tif")
    refused(result, "/proc/x.tif", "cannot be written: ")
    assert result[2].count(".tif") == 1
    with pytest.raises(FileError, match="^/proc/x.npz: cannot be written: [^/]*: name another fol"):
        average(np.zeros((2, 3, 4))).save("/proc/x.npz")


@pytest.mark.parametrize(
    ("given", "wrong"),
    [
        ("fit levels.toml -o", "Option '-o' requires an argument"),
        ("-v fit levels.toml -o", "Option '-o' requires an argument"),
        ("--bogus fit levels.toml", "No such option: --bogus"),
        ("-v fit", "Missing argument 'levels'"),
    ],
)
def test_a_usage_error_names_the_help_of_the_command(run, given, wrong):
    status, _, err = run("nuc", *given.split())
    assert status == 2
    assert err.startswith(f"equipix: error: {wrong}")
    assert err.endswith("(see equipix nuc fit --help)\n")


def test_a_full_disk_is_named(tmp_path):
    with (
        pytest.raises(FileError, match=r"x\.npz: cannot be .*: free space, or name another folder"),
        write_whole(tmp_path / "x.npz", force=False),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_results_are_no_masks(run, experiment, calibration, tmp_path):
    frames, average = experiment.parent / "frames/p0.tif", tmp_path / "mean.npz"
    assert run("average", frames, "-o", average)[0] == 0
    for mask, kind in ((calibration, "a calibration"), (average, "frame statistics")):
        result = run("average", frames, "--mask", mask, "-o", tmp_path / "a.tif")
        refused(result, f"{mask}: holds {kind}, expected a mask, ")


def test_a_failed_job_leaves_nothing(run, experiment, calibration, tmp_path):
    truncated = tmp_path / "truncated.tif"
    truncated.write_bytes((experiment.parent / "frames/p0.tif").read_bytes()[:999])
    before = sorted(tmp_path.iterdir())
    refused(run("average", truncated, "-o", tmp_path / "mean.tif"), truncated)
    refused(run("correct", calibration, truncated, "-o", tmp_path / "folder"), truncated)
    refused(run("calibrate", tmp_path / "none.toml", "-o", tmp_path / "cal.tif"), "none.toml")
    refused(run("inspect", truncated), truncated)
    assert sorted(tmp_path.iterdir()) == before


def test_frames_of_another_sensor_are_refused(run, calibration, tmp_path, data_dir):
    frames = data_dir / "experiment-320x240/frames/p0.tif"
    refused(run("correct", calibration, frames, "-o", tmp_path / "c.tif"), frames, "(240, 320)")


# A process of its own


def command_line(*arguments):
    return [sys.executable, "-c", "from equipix.cli import main; main()", *map(str, arguments)]


def test_the_package_is_a_command(tmp_path):
    command = [sys.executable, "-m", "equipix", "inspect", tmp_path / "none.tif"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("equipix: error: ")
    assert done.stderr.count("\n") == 1


def test_a_pipe_sees_no_bars(experiment, tmp_path):
    command = command_line("average", experiment.parent / "frames/p0.tif", "-o", tmp_path / "m.tif")
    done = subprocess.run(command, capture_output=True, check=True)
    assert done.stderr == b""
    assert b"\x1b" not in done.stdout


@pytest.mark.parametrize("arguments", [(), ("--json",), ("--help",)])
def test_a_pipe_may_be_closed(calibration, arguments):
    """As `| head` does; what it has not read is no error."""
    closed, output = os.pipe()
    os.close(closed)
    command = command_line("inspect", calibration, *arguments)
    done = subprocess.run(command, stdout=output, stderr=subprocess.PIPE, check=False)
    os.close(output)
    assert (done.returncode, done.stderr) == (1, b"")


def test_names_are_no_markup_of_tables(capsys):
    terminal.show_table(("a[b]", "[/c]"), [("p[red]0[/red]", "[/d] :smile:"), ("x", "inf")])
    out = capsys.readouterr().out
    for words in ("a[b]", "[/c]", "p[red]0[/red]", "[/d] :smile:", "not determined"):
        assert words in out


def test_the_bar_of_a_stage_that_ends_early_is_complete(monkeypatch):
    """A solver may converge before the passes that it may take."""
    screen = io.StringIO()
    for name, value in {"TERM": "xterm", "COLUMNS": "100"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(screen, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stderr", screen)
    with terminal.progress_bars() as report:
        report(56, 120, "calibrate")
        report(0, 9, "uncertainty")
    assert "56/56" in screen.getvalue()


def test_a_terminal_sees_bars(experiment, tmp_path):
    command = command_line(
        "calibrate", experiment, "-o", tmp_path / "cal.tif", "--tolerance", "1e-3"
    )
    main, terminal = pty.openpty()
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=terminal, env=os.environ | {"TERM": "xterm"}
    )
    os.close(terminal)
    seen = b""
    while chunk := read(main):
        seen += chunk
    assert process.wait() == 0
    assert b"averaging p0" in seen


def read(descriptor):
    try:
        return os.read(descriptor, 4096)
    except OSError:  # Linux says so when the other end is closed
        return b""


@pytest.mark.timing
def test_ctrl_c_stops_the_solver_at_once(stops_within, tmp_path_factory, tmp_path):
    # Short arms on a sensor of some size: to rounding takes many seconds.
    shape = (320, 400)
    virtual = simulate.experiment(
        simulate.cosine_sensitivity(shape, rng=1),
        simulate.gaussian_beam(shape, width=1000),
        [(0, 0), (0, 5), (0, 7), (5, 0), (7, 0)],
        frames=2,
        rng=5,
    )
    experiment = virtual.write(tmp_path_factory.mktemp("long") / "experiment")
    output = tmp_path / "cal.tif"
    command = command_line("calibrate", experiment, "-o", output, "--tolerance", "1e-30")
    command += ["--method", "coordinate-descent"]
    assert stops_within(0.5, lambda: interrupted(list(command)))
    assert list(tmp_path.iterdir()) == []


def interrupted(command):
    """Seconds from Ctrl-C to the end of a process that is past its start."""
    loaded = "import equipix.cli.calibrate; print(flush=True); main()"
    command[2] = command[2].replace("main()", loaded)
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        process.stdout.readline()
        time.sleep(1.0)
        started = time.monotonic()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=10) == 130
        ended = time.monotonic()
        assert "Traceback" not in process.stderr.read()
    return ended - started


class TestPlan:
    CROSS = "0,0 0,5 0,7 5,0 7,0"

    def test_judges_a_pattern(self, run, tmp_path):
        picture = tmp_path / "plan.png"
        status, out, err = run("plan", "--shape", 64, 80, "--shifts", self.CROSS, "-o", picture)
        assert status == 0
        assert "tilt from lamp drift" in out
        assert "in the order advised: " in out
        assert out.splitlines()[-1].split() == ["picture", str(picture)]
        assert err.startswith("equipix: warning: lamp drift will tilt")
        assert picture.stat().st_size > 0

    @pytest.mark.filterwarnings("error::RuntimeWarning")
    @pytest.mark.parametrize("shifts", ["0,0 0,0", "0,0 0,5", "0,0 0.4,0.5 0.5,0 0.1,0.5"])
    def test_draws_errors_that_are_infinite_or_not_known(self, run, tmp_path, shifts):
        picture = tmp_path / "plan.png"
        status, *_ = run("plan", "--shape", 64, 80, "--shifts", shifts, "-o", picture)
        assert (status, picture.exists()) == (0, True)

    def test_as_json(self, run):
        status, out, _ = run("plan", "--shape", 64, 80, "--shifts", "0,0 0,4 0,6 4,0 6,0", "--json")
        assert status == 0
        (found,) = json.loads(out)["patterns"]
        assert found["components"] == 4
        assert found["equations"] == 5 * 64 * 80
        assert sorted(found["order"]) == [0, 1, 2, 3, 4]

    def test_an_option_without_effect_is_a_finding(self, run):
        command = ("plan", "--shape", 64, 80, "--shifts", self.CROSS, "--shift-error", 0.1)
        _, out, err = run(*command, "--json")
        (found,) = json.loads(out)["patterns"]
        assert found["findings"][0]["kind"] == "unused"
        assert found["findings"][0]["message"] in err

    @pytest.mark.long
    def test_finds_patterns(self, run):
        status, out, _ = run("plan", "--shape", 64, 80, "--max-shift", 9, 9, "--drift", 0, "--json")
        assert status == 0
        result = json.loads(out)
        found = result["patterns"]
        assert {(len(plan["shifts"]), plan["components"]) for plan in found} == {(5, 1)}
        six, seven = result["more_exposures"]
        assert (six["exposures"], seven["exposures"]) == (6, 7)
        assert found[0]["rms"] > six["rms"] > seven["rms"]
        assert all(each["expected_passes"] > 0 for each in (*found, six, seven))

    @pytest.mark.long
    @pytest.mark.parametrize(("exposures", "more"), [(4, 2), (6, 1), (7, 0)])
    def test_says_what_more_positions_gain(self, run, exposures, more):
        command = ("plan", "--shape", 64, 80, "--exposures", exposures, "--drift", 1e-6)
        status, out, err = run(*command, "--max-shift", 9, 9)
        assert (status, err) == (0, "")
        assert re.search(r"expected passes +\d+", out)
        gains = re.findall(
            r"^with (\d) positions: \S+ of all causes, \d+ passes$", out, re.MULTILINE
        )
        assert gains == ["6", "7"][2 - more :]

    @pytest.mark.long
    def test_judges_each_pattern_that_it_finds(self, run):
        status, out, err = run("plan", "--shape", 300, 400, "--max-shift", 9, 9)
        assert status == 0
        assert "tilt from lamp drift" in out
        warned = re.findall(r"^equipix: warning: pattern (\d): lamp drift will", err, re.MULTILINE)
        assert warned == ["1", "2", "3"]

    def test_judges_shifts_between_pixels(self, run):
        shifts = "0,0 0,11.4 0,19.7 11.2,0 19.5,0"
        status, out, err = run(
            "plan", "--shape", 64, 80, "--shifts", shifts, "--drift", 0, "--json"
        )
        assert (status, err) == (0, "")
        assert json.loads(out)["patterns"][0]["components"] == 1
        _, _, err = run(
            "plan", "--shape", 64, 80, "--drift", 0,
            "--shifts", "0,0 0,2.5 0,7.5 2.5,0 7.5,0",
        )  # fmt: skip
        assert "do not constrain a wave of (0." in err

    @pytest.mark.long
    def test_a_single_row(self, run, tmp_path):
        command = ("plan", "--shape", 1, 40, "-o", tmp_path / "plan.png", "--drift", 0, "--json")
        status, out, err = run(*command, "--max-shift", 5, 5)
        assert (status, err) == (0, "")
        assert json.loads(out)["patterns"][0]["components"] == 1

    def test_a_pattern_has_its_own_number_of_exposures(self, run):
        given = ("plan", "--shape", 64, 80, "--shifts", self.CROSS, "--exposures", 7)
        status, _, err = run(*given)
        assert status == 1
        assert "--exposures is 7, but a pattern given by --shifts has its own: leave one" in err

    @pytest.mark.parametrize("shifts", ["0,0 0,0 0,1", "0,0 0,5 0,7", "0,0 0,5.3 0,7.8"])
    def test_what_a_line_of_shifts_leaves_open_is_said(self, run, shifts):
        command = ("plan", "--shape", 50, 50, "--shifts", shifts)
        status, out, err = run(*command, "--json")
        assert status == 0
        assert not re.search("NaN|Infinity", out)
        (found,) = json.loads(out)["patterns"]
        assert found["rms"] is None
        assert found["rms_by_cause"]["drift"] is None
        assert found["tilt_by_cause"]["drift"][0] is None
        assert found["tilt_by_cause"]["drift"][1] > 0
        kind = "tilt" if "." in shifts else "components"
        assert kind in [each["kind"] for each in found["findings"]]
        assert "unconnected" in err or "the shifts lie on one line" in err
        assert "equipix.plan" not in err
        status, out, err = run(*command)
        assert status == 0
        assert re.search(r"all causes +not determined", out)
        assert not re.search(r"\b(inf|nan)\b", out + err)

    def test_a_beam_that_lights_a_part_is_named_with_the_width_that_suffices(self, run):
        command = ("plan", "--shape", 100, 100, "--shifts", "0,0 0,11 0,19 11,0 19,0")
        status, _, err = run(*command, "--beam-width", 5)
        assert status == 0
        share, width = re.search(r"for (\S+)% of the pixels.* --beam-width (\d+) or", err).groups()
        assert float(share) > 50
        assert run(*command, "--beam-width", width, "--drift", 0)[2] == ""

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (("--max-shift", 9, 9, "--noise", "nan"), "--noise is nan"),
            ((), "give either --shifts"),
            (("--shifts", CROSS, "--max-shift", 9, 9), "give either --shifts"),
            (("--shifts", "0,0 5"), "--shifts is '0,0 5'"),
            (("--shifts", CROSS, "-o", "plan.doc"), "plan.doc"),
        ],
    )
    def test_refuses(self, run, arguments, words):
        refused(run("plan", "--shape", 64, 80, *arguments), words)


def test_frames_of_different_things_are_noticed_in_an_average(run, tmp_path):
    rng = np.random.default_rng(1)
    for name, level in (("dark", 100), ("light", 2000)):
        frames = np.rint(level + 3 * rng.standard_normal((4, 20, 24))).astype(np.uint16)
        write_frames(tmp_path / f"{name}.tif", iter(frames), nbytes=frames.nbytes)
    for source, words in (("light.tif", ""), ("*.tif", "see that all are of one measurement")):
        output = tmp_path / f"out{len(words)}.npz"
        status, out, said = run("average", tmp_path / source, "-o", output, "--json")
        assert status == 0
        assert words in said
        assert bool(words) == bool(said)
        found = [dataclasses.asdict(each) for each in equipix.load(output).findings]
        assert [words in each["message"] for each in found] == [True] * bool(words)
        for shown in (out, run("inspect", output, "--json")[1]):
            assert json.loads(shown)["findings"] == found


@pytest.mark.parametrize(("rows", "says"), [(10, False), (9, True)])
def test_an_average_that_saturates_in_most_pixels_is_noticed(run, tmp_path, rows, says):
    frames = np.full((4, 20, 24), 2000, np.uint16)
    frames[:, :rows] = 500
    write_frames(tmp_path / "raw.tif", iter(frames), nbytes=frames.nbytes)
    arguments = ("average", tmp_path / "raw.tif", "-o", tmp_path / "out.npz", "--saturation", 1000)
    status, _, said = run(*arguments)
    assert status == 0
    words = "264 of 480 unmasked pixels (limit 50%) reach the saturation level of 1000.0 DN: expose"
    assert (words in said) == says
    assert bool(said) == says


def test_an_average_of_frames_without_a_number_is_refused(run, tmp_path):
    frames = np.full((4, 20, 24), np.nan, np.float32)
    write_frames(tmp_path / "raw.tif", iter(frames), nbytes=frames.nbytes)
    out = tmp_path / "out.npz"
    refused(run("average", tmp_path / "raw.tif", "-o", out), "'frames' holds no finite number")
    assert not out.exists()

"""The demo, on a smaller sensor: its finding, its picture, its traces."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from equipix import cli, demo, errors, measure_shift
from equipix.pictures import draw_demo, new_figure

pytest.importorskip("matplotlib")

# The hole's image is small on so small a sensor, and non-uniformity moves its centroid.
pytestmark = pytest.mark.filterwarnings("ignore::equipix.errors.InputWarning")

SHAPE = (160, 208)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "experiment"
    return demo.run_demo(folder, shape=SHAPE, frames=10, rng=3)


@pytest.mark.long
def test_error_is_what_the_noise_predicts(result):
    assert result.passed
    figures = result.figures()
    # A flat field keeps the source's 1 %: a slope of that range has an rms of 0.2 %.
    assert figures["flat_field_block_rms"] == pytest.approx(2e-3, rel=0.15)
    assert figures["block_rms"] < 0.1 * figures["flat_field_block_rms"]


def test_an_error_beyond_the_noise_fails(result):
    rows = np.linspace(0.999, 1.001, SHAPE[0])[:, None]
    tilted = dataclasses.replace(
        result.calibration, sensitivity=result.calibration.sensitivity * rows
    )
    worse = dataclasses.replace(result, calibration=tilted)
    assert not worse.passed
    # White error alone would not show in the block means.
    rms, block_rms = demo.rms_at_both_scales(worse.error)
    assert rms < demo.RMS_LIMIT * 1.2 * worse.predicted[0]
    assert block_rms > demo.BLOCK_RMS_LIMIT * worse.predicted[1]


def test_picture_shows_all(result):
    figure = draw_demo(result)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert len(titles) == 9
    shown = figure.axes[0].images[0].get_array()
    np.testing.assert_array_equal(shown, result.truth)
    block_rms = 100 * result.figures()["block_rms"]
    assert f"rms {block_rms:.2g}" in figure.axes[3].get_title()
    for axes in figure.axes[6:8]:
        assert axes.get_xlabel() == "error, %"
        # Every error has a place in its histogram: the area is 1.
        for steps in axes.patches:
            values, edges, _ = steps.get_data()
            assert np.sum(values * np.diff(edges)) == pytest.approx(1)


@pytest.mark.parametrize("shape", [(48, 64), (64, 80), SHAPE, (240, 320)])
@pytest.mark.parametrize("seed", [1, 6, 11])
def test_the_hole_is_seen_whole_and_on_good_pixels(shape, seed):
    virtual = demo.virtual_experiment(shape, frames=2, rng=seed)
    for k in range(1, len(virtual.positions)):
        images = (virtual.aperture_before(k), virtual.aperture_after(k))
        before, after = (np.stack(list(image)) for image in images)
        measured = measure_shift(before, after, saturation=4095)
        moved = virtual.positions[k] - virtual.positions[k - 1]
        # Unequal pixels move a centroid by 0.008: ten of it, for the two images.
        np.testing.assert_allclose(measured.shift, moved, atol=0.08 * np.sqrt(2))


@pytest.mark.long
def test_command_leaves_a_picture_only(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as done:
        cli.main(["demo", "--shape", "160", "208", "--frames", "4", "--json"])
    assert done.value.code == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["passed"] is True
    assert figures["rms"] <= 1.1 * figures["predicted_rms"]
    assert [path.name for path in tmp_path.iterdir()] == ["equipix-demo.png"]


@pytest.mark.long
def test_command_fails_when_the_errors_are_too_large(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(demo, "BLOCK_RMS_LIMIT", 0.1)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as done:
        cli.main(["demo", "--shape", "160", "208", "--frames", "4", "--keep", "kept"])
    assert done.value.code == 1
    captured = capsys.readouterr()
    assert "noise predicts" in captured.out
    assert captured.err.endswith("larger than the noise explains\n")
    assert (tmp_path / "kept/experiment.toml").is_file()


@pytest.mark.long
def test_command_replaces_what_it_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["demo", "--shape", "64", "80", "--frames", "4", "--keep", "kept", "--force"]
    truths = []
    for seed in ("1", "2"):
        with pytest.raises(SystemExit):
            cli.main([*command, "--rng", seed])
        truths.append((tmp_path / "kept/truth.npz").read_bytes())
    assert truths[0] != truths[1]


def test_without_matplotlib_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    with pytest.raises(errors.EquipixError, match=r"pip install 'equipix\[plot\]'"):
        new_figure(1, 1)

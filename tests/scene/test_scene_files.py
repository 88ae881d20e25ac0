"""Corrections from the scene by the command line."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
import tifffile

import equipix
from equipix import scene
from equipix.cli.scene import _summary
from equipix.io.frames import read_frames
from equipix.io.tiff import write_frames
from equipix.scene.methods import METHODS
from equipix.scene.sequence import SequenceResult
from equipix.simulate import MovingScene

SHAPE = (48, 64)
COUNT = 90


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A sequence of 16 bits, as a file of many pages and as a folder of files."""
    folder = tmp_path_factory.mktemp("scene")
    moving = MovingScene(seed=4, shape=SHAPE)
    frames = np.stack(
        [np.rint(4000 + 8000 * frame.values) for frame in moving.frames(COUNT)]
    ).astype(np.uint16)
    write_frames(folder / "all.tif", frames, nbytes=frames.nbytes)
    for index, frame in enumerate(frames):
        write_frames(folder / f"frame{index:03}.tif", [frame], nbytes=frame.nbytes)
    return folder, frames


RANGE = ("--data-range", "4000", "12000")


@pytest.mark.parametrize("name", [name for name in METHODS if name != "kalman"])
def test_a_sequence_gives_what_the_methods_give(run, recorded, tmp_path, name):
    folder, frames = recorded
    output, corrected = tmp_path / "nuc.tif", tmp_path / "corrected.tif"
    options = ("--method", name, *RANGE, "--corrected", corrected, "--json")
    status, out, err = run("scene", folder / "all.tif", "-o", output, *options)
    assert (status, err) == (0, "")
    method = METHODS[name](SHAPE, (4000, 12_000))
    wanted = [method.update(frame) for frame in frames]
    np.testing.assert_array_equal(read_frames(corrected), wanted)
    loaded = equipix.load(output)
    np.testing.assert_array_equal(loaded.coefficients, method.correction().coefficients)
    shown = json.loads(out)
    assert shown["frames"] == COUNT
    assert shown["frames_that_counted"] == method.frames
    first, last = shown["roughness"][0], shown["roughness"][-1]
    assert (first["frame"], last["frame"]) == (1, COUNT)
    # Before the first step nothing is corrected; the pattern of 10 % is most of the roughness.
    assert first["corrected"] == pytest.approx(first["raw"], rel=1e-2)
    assert last["corrected"] < 0.8 * last["raw"]


def test_a_sequence_goes_on_from_a_saved_state(run, recorded, tmp_path):
    folder, frames = recorded
    halves = [
        [folder / f"frame{index:03}.tif" for index in part]
        for part in (range(40), range(40, COUNT))
    ]
    state, output = tmp_path / "state.npz", tmp_path / "nuc.npz"
    first = ("--data-range", "4000", "12000", "--state", state)
    assert run("scene", *halves[0], "-o", output, *first)[0] == 0
    second = ("--resume", state, "--force")
    assert run("scene", *halves[1], "-o", output, *second)[0] == 0
    method = scene.Registered(SHAPE, (4000, 12_000))
    for frame in frames:
        method.update(frame)
    np.testing.assert_array_equal(
        equipix.load(output).coefficients, method.correction().coefficients
    )


def test_files_and_findings_are_kept(run, recorded, tmp_path):
    folder, frames = recorded
    frame, state, output = (tmp_path / name for name in ("once.tif", "state.npz", "nuc.npz"))
    tifffile.imwrite(frame, frames, description="corrected by equipix", metadata=None)
    options = ("-o", output, "--method", "local-mean", *RANGE, "--state", state, "--json")
    status, out, err = run("scene", frame, *options)
    assert (status, "corrected already" in err) == (0, True)
    loaded = equipix.load(output)
    assert [vars(each) for each in loaded.findings] == json.loads(out)["findings"]
    assert "corrected" in {each.kind for each in loaded.findings}
    digest = hashlib.sha256(frame.read_bytes()).hexdigest()
    assert loaded.metadata["inputs"] == {str(frame): digest}
    assert loaded.metadata["versions"]["equipix"] == equipix.__version__
    command = ("scene", folder / "all.tif", "-o", output, "--resume", state, "--force")
    assert run(*command, "--method", "local-mean")[0] == 0
    assert [*equipix.load(output).metadata["inputs"]] == [str(folder / "all.tif"), str(state)]


def test_a_floor_that_is_not_known_is_said_in_words(run, recorded, tmp_path):
    command = ("scene", recorded[0] / "frame00*.tif", "-o", tmp_path / "nuc.npz", *RANGE)
    options = ("--method", "local-mean", "--force")
    assert re.search(r"\nfloor of the pattern +not determined\n", run(*command, *options)[1])
    assert json.loads(run(*command, *options, "--json")[1])["floor_dn"] is None


@pytest.mark.parametrize("count", [1, 2, 10, 11, 19, 20, 21, 100])
def test_at_most_ten_points_of_the_quality_are_printed(count):
    """The first and the last are among them."""
    points = tuple(range(1, count + 1))
    done = SequenceResult(count, points, (0.1,) * count, (0.1,) * count, np.zeros(SHAPE), ())
    method = scene.LocalMean(SHAPE, (0.0, 1.0))
    shown = [each["frame"] for each in _summary(Path("nuc.tif"), method, done)["roughness"]]
    assert (shown[0], shown[-1]) == (1, count)
    assert len(shown) == len({*shown}) <= 10


def test_the_picture_is_drawn_and_the_table_printed(run, recorded, tmp_path):
    folder, _ = recorded
    picture = tmp_path / "before-after.png"
    options = ("--method", "gated", *RANGE, "--picture", picture)
    status, out, _ = run("scene", folder / "frame*.tif", "-o", tmp_path / "nuc.tif", *options)
    assert status == 0
    assert "roughness" in out
    assert re.search(r"frame 1, raw \d\.\d+, corrected \d\.\d+\n", out)
    assert picture.stat().st_size > 10_000


def test_the_range_of_whole_numbers_is_that_of_their_type(run, recorded, tmp_path):
    folder, _ = recorded
    output = tmp_path / "nuc.tif"
    assert run("scene", folder / "all.tif", "-o", output, "--method", "local-mean")[0] == 0
    assert equipix.load(output).metadata["scene"]["data_range"] == [0, 65535]


def test_inspect_shows_how_it_was_learned(run, recorded, tmp_path):
    folder, _ = recorded
    output = tmp_path / "nuc.tif"
    options = ("--method", "local-mean", *RANGE, "--json")
    made = json.loads(run("scene", folder / "all.tif", "-o", output, *options)[1])
    shown = json.loads(run("inspect", output, "--json")[1])
    assert shown["scene_method"] == "local-mean"
    assert shown["scene_data_range"] == [4000, 12000]
    assert shown["scene_frames"] == made["frames_that_counted"] > 0
    assert "scene method" in run("inspect", output)[1]


def test_frames_that_are_dropped_leave_points_of_the_others(run, recorded, tmp_path):
    frames = recorded[1][:80].copy()
    frames[0] = 0
    frames[1::2] = 0
    write_frames(tmp_path / "dropped.tif", frames, nbytes=1)
    arguments = ("-o", tmp_path / "nuc.tif", "--method", "local-mean", *RANGE, "--json")
    status, out, _ = run("scene", tmp_path / "dropped.tif", *arguments)
    assert status == 0
    shown = json.loads(out)
    assert (shown["frames"], shown["usable_frames"], shown["frames_that_counted"]) == (80, 39, 39)
    assert [point["frame"] for point in shown["roughness"]] == [79]


class TestRefusals:
    def refused(self, result, *words):
        status, out, err = result
        assert (status, out) == (1, "")
        assert err.count("\n") == 1
        for word in words:
            assert str(word) in err

    def test_a_scene_that_never_moves(self, run, recorded, tmp_path):
        write_frames(tmp_path / "still.tif", [recorded[1][0]] * 5, nbytes=1)
        output = tmp_path / "nuc.tif"
        self.refused(
            run("scene", tmp_path / "still.tif", "-o", output), "the scene never moved", "moving"
        )
        assert not output.exists()

    def test_no_corrected_frames_are_left_of_a_scene_that_never_moves(
        self, run, recorded, tmp_path
    ):
        write_frames(tmp_path / "still.tif", [recorded[1][0]] * 5, nbytes=1)
        corrected = tmp_path / "corrected.tif"
        arguments = ("-o", tmp_path / "nuc.tif", "--corrected", corrected)
        self.refused(run("scene", tmp_path / "still.tif", *arguments), "the scene never moved")
        assert not corrected.exists()

    def test_a_frame_out_of_range_is_named(self, run, recorded, tmp_path):
        frames = recorded[1][:5].copy()
        frames[3, 4, 5] = 60_000
        write_frames(tmp_path / "bright.tif", frames, nbytes=1)
        arguments = ("-o", tmp_path / "nuc.tif", *RANGE)
        self.refused(
            run("scene", tmp_path / "bright.tif", *arguments), "bright.tif", "frame 4", "range"
        )

    def test_too_few_frames_for_a_block(self, run, recorded, tmp_path):
        folder, _ = recorded
        arguments = (folder / "frame00*.tif", "-o", tmp_path / "nuc.tif", "--method", "kalman")
        self.refused(run("scene", *arguments), "no block of moving frames is complete")

    def test_options_that_do_not_fit(self, run, recorded, tmp_path):
        folder, _ = recorded
        arguments = ("scene", folder / "frame00*.tif", "-o", tmp_path / "nuc.tif")
        self.refused(run(*arguments, "--width", "11"), "registered", "--width")
        self.refused(run(*arguments, "--step", "0.3"), "--step is 0.3", "0.2500")
        self.refused(run(*arguments, "--corrected", tmp_path / "c.png"), ".tif")
        floats = tmp_path / "floats.tif"
        write_frames(floats, recorded[1][:3].astype(np.float32), nbytes=1)
        self.refused(run("scene", floats, "-o", tmp_path / "nuc.tif"), "float32", "--data-range")

    def test_a_state_that_does_not_fit(self, run, recorded, tmp_path):
        folder, _ = recorded
        scene.Gated((32, 32), "uint16").save(tmp_path / "small.npz")
        scene.Gated(SHAPE, "uint16").save(tmp_path / "gated.npz")
        arguments = ("scene", folder / "frame00*.tif", "-o", tmp_path / "nuc.tif", "--resume")
        self.refused(run(*arguments, tmp_path / "small.npz"), "small.npz", "(32, 32)", "(48, 64)")
        self.refused(run(*arguments, tmp_path / "gated.npz"), "gated.npz", "--method gated")
        self.refused(run(*arguments, tmp_path / "none.npz"), "none.npz: does not exist")
        both = (tmp_path / "gated.npz", "--method", "gated", "--step", "0.1")
        self.refused(run(*arguments, *both), "--resume", "--step")

    def test_frames_of_fewer_bits_than_the_state(self, run, recorded, tmp_path):
        state, narrow = tmp_path / "state.npz", tmp_path / "narrow.tif"
        write_frames(narrow, (recorded[1][:3] // 256).astype(np.uint8), nbytes=1)
        scene.Registered(SHAPE, (0, 16383)).save(state)
        arguments = ("scene", narrow, "-o", tmp_path / "nuc.tif", "--resume", state)
        self.refused(run(*arguments), "state.npz", "uint8", "0 to 16383")

    def test_saved_files_and_outputs_among_the_inputs(self, run, recorded, tmp_path):
        folder, _ = recorded
        output = tmp_path / "nuc.tif"
        assert run("scene", folder / "all.tif", "-o", output, "--method", "local-mean")[0] == 0
        self.refused(run("scene", output, "-o", tmp_path / "other.tif"), "polynomial", "raw frames")
        inside = ("scene", folder / "frame*.tif", "-o", folder / "frame000.tif", "--force")
        self.refused(run(*inside), "frame000.tif")

    @pytest.mark.parametrize("option", ["--state", "--corrected"])
    def test_two_outputs_of_one_name(self, run, recorded, tmp_path, option):
        folder, _ = recorded
        output, link = tmp_path / "nuc.tif", tmp_path / "link"
        link.symlink_to(tmp_path)
        for again in (output, tmp_path / "none/../nuc.tif", link / "nuc.tif"):
            (tmp_path / "none").mkdir(exist_ok=True)
            arguments = ("-o", output, option, again, "--force")
            result = run("scene", folder / "frame00*.tif", *arguments)
            self.refused(result, "nuc.tif", "named for two outputs")
            assert not output.exists()

    def test_two_outputs_of_one_name_beside_the_correction(self, run, recorded, tmp_path):
        both = tmp_path / "both.tif"
        arguments = ("-o", tmp_path / "nuc.tif", "--state", both, "--corrected", both, "--force")
        result = run("scene", recorded[0] / "frame00*.tif", *arguments)
        self.refused(result, "both.tif", "named for two outputs")
        assert not both.exists()

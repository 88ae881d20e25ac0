"""`equipix watch`: half-written, odd and vanished files, kills, its end and its exit status."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

import equipix
from equipix.cli.watch import _in_words, _shown
from equipix.errors import FileError
from equipix.io import arrivals
from equipix.live.folder import WatchedFolder
from live.test_running import SHAPE, SHIFTS, frames_of

DARK, FRAMES = frames_of(SHAPE, SHIFTS)


def manifest_of(folder: Path, count: int = 6, more: str = "") -> Path:
    entries = "".join(
        f'[[exposure]]\nname = "p{k}"\nframes = "p{k}-*.tif"\nshift = [{row}, {col}]\n{more}'
        for k, (row, col) in enumerate(SHIFTS[:count].tolist())
    )
    path = folder / "experiment.toml"
    path.write_text(f'[sensor]\nbit_depth = 12\n[dark]\nframes = "dark-*.tif"\n{entries}')
    return path


def written(path: Path, frame: np.ndarray, *, age: float = 10, share: float = 1) -> None:
    """Write a file, or its beginning, that has not changed for some seconds."""
    tifffile.imwrite(path, frame)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    os.utime(path, (time.time() - age,) * 2)


def all_frames(folder: Path, count: int = 6) -> None:
    for j, frame in enumerate(DARK):
        written(folder / f"dark-{j}.tif", frame)
    for k, frames in enumerate(FRAMES[:count]):
        for j, frame in enumerate(frames):
            written(folder / f"p{k}-{j}.tif", frame)


def watched(folder: Path, **given: Any) -> WatchedFolder:
    return WatchedFolder(folder, manifest_of(folder, **given))


def counts(found: WatchedFolder) -> tuple[int, ...]:
    """Frames at each position, in the order of the manifest; files are read by their age."""
    assert found.running is not None
    estimate = found.running.estimate()
    frames = dict(zip(map(tuple, estimate.positions.tolist()), estimate.frames, strict=True))
    places = list(map(tuple, SHIFTS.tolist()))
    assert set(frames) <= set(places)
    return tuple(frames[each] for each in places if each in frames)


def test_the_answer_is_that_of_equipix_calibrate(tmp_path: Path) -> None:
    found = watched(tmp_path)
    all_frames(tmp_path)
    new, waiting, findings = found.look()
    assert (new, waiting, findings) == (True, False, [])
    assert found.running is not None
    wanted = equipix.Experiment.load(found.path).run()
    calibration = found.running.estimate().calibration
    assert calibration is not None
    limit = wanted.error_estimate + calibration.error_estimate + 1e-6
    assert np.nanmax(np.abs(calibration.sensitivity / wanted.sensitivity - 1)) <= limit
    assert found.look() == (False, False, [])
    assert found.names[(0.0, 11.0)] == "p1"


def test_a_half_written_file_is_waited_for(tmp_path: Path) -> None:
    found = watched(tmp_path)
    all_frames(tmp_path)
    last = tmp_path / "p5-1.tif"
    written(last, FRAMES[5][1], age=0, share=0.5)
    assert found.look()[1:] == (True, [])
    written(last, FRAMES[5][1], age=1, share=0.5)  # the camera pauses
    assert found.look()[2] == []
    assert counts(found)[-1] == 1
    written(last, FRAMES[5][1], age=9, share=0.5)
    said = found.look()[2]
    assert [each.kind for each in said] == ["unused"]
    assert "p5-1.tif" in said[0].message
    assert found.look() == (False, False, [])
    written(last, FRAMES[5][1], age=8)
    assert found.look() == (True, False, [])
    assert counts(found) == (2,) * 6


def test_a_file_of_another_shape_is_not_used_even_if_it_is_the_first(tmp_path: Path) -> None:
    found = watched(tmp_path)
    written(tmp_path / "dark-0.tif", np.ones((30, 40), np.uint16))
    found.look()
    all_frames(tmp_path)
    written(tmp_path / "dark-0.tif", np.ones((30, 40), np.uint16))
    written(tmp_path / "p2-7.tif", FRAMES[2][0].astype(np.uint8))
    messages = [each.message for _ in range(3) for each in found.look()[2]]
    assert len(messages) == 2
    assert "(30, 40), expected uint16 of shape (100, 100)" in messages[0] + messages[1]
    assert counts(found) == (2,) * 6


def test_files_at_a_position_beyond_the_sensor_are_refused_once(tmp_path: Path) -> None:
    found = watched(tmp_path)
    all_frames(tmp_path)
    with found.path.open("a") as file:
        file.write('[[exposure]]\nname = "far"\nframes = "far-*.tif"\nshift = [0, 2450]\n')
    far = [tmp_path / f"far-{j}.tif" for j in range(2)]
    for each in far:
        written(each, FRAMES[0][0])
    new, _, findings = found.look()
    words = "'shift' is (0, 2450): its column part must be smaller than the sensor"
    assert [each.message.partition(", which")[0] for each in findings] == [
        f"{each}: {words}" for each in far
    ]
    assert new
    assert found.look() == (False, False, [])
    assert counts(found) == (2,) * 6


@pytest.mark.parametrize(("of", "copy"), [("p1-0", "p4-9"), ("p4-0", "p1-9"), ("dark-0", "p1-9")])
@pytest.mark.parametrize("later", [4, 0, -4])
def test_of_copies_the_oldest_counts(tmp_path: Path, of: str, copy: str, later: int) -> None:
    """Whichever was seen first, and in a new process; by name if they are equally old."""
    found = watched(tmp_path)
    all_frames(tmp_path)
    written(tmp_path / "dark-x.tif", DARK[1])  # a camera may show 0 in the dark
    found.look()
    files = [tmp_path / f"{each}.tif" for each in (of, copy)]
    files[1].write_bytes(files[0].read_bytes())
    os.utime(files[1], ns=(files[0].stat().st_mtime_ns + later * 10**9,) * 2)
    counting, refused = sorted(files, key=lambda file: (file.stat().st_mtime_ns, file))
    for each in (found, WatchedFolder(tmp_path, found.path)):
        new, _, (finding,) = each.look()
        assert new == (each is not found or counting == files[1])
        assert finding.message.startswith(f"{refused}: is a copy of '{counting}', which counts")
        frames = [file for file in tmp_path.glob("p*.tif") if file != refused]
        assert counts(each) == tuple(
            sum(file.name.startswith(f"p{k}") for file in frames) for k in range(6)
        )
        assert each.look() == (False, False, [])


def test_what_is_not_used_is_reported_once_whatever_is_read_again(tmp_path: Path) -> None:
    found = watched(tmp_path)
    written(tmp_path / "dark-x.tif", np.ones((30, 40), np.uint16), age=20)
    all_frames(tmp_path)
    assert len(found.look()[2]) == 1
    (tmp_path / "p3-1.tif").unlink()
    assert found.look() == (True, False, [])
    assert counts(found) == (2, 2, 2, 1, 2, 2)


def test_a_broken_manifest_is_reported_also_where_all_is_read_again(tmp_path: Path) -> None:
    found = watched(tmp_path)
    all_frames(tmp_path)
    found.look()
    with found.path.open("a") as file:
        file.write("shift = [")
    written(tmp_path / "p0-9.tif", FRAMES[1][0], age=60)  # an older copy
    assert [each.message.partition(": ")[0] for each in found.look()[2]] == [
        str(found.path),
        str(tmp_path / "p1-0.tif"),
    ]


def test_a_file_that_vanishes_or_changes_no_longer_counts(tmp_path: Path) -> None:
    found = watched(tmp_path)
    all_frames(tmp_path)
    found.look()
    (tmp_path / "p3-1.tif").unlink()
    assert found.look()[0]
    assert counts(found) == (2, 2, 2, 1, 2, 2)
    written(tmp_path / "p4-0.tif", FRAMES[3][0], age=5)
    assert found.look()[0]
    fresh = watched(tmp_path)
    fresh.look()
    assert fresh.running is not None
    assert found.running is not None
    one, other = (each.running.estimate().calibration for each in (found, fresh))
    np.testing.assert_array_equal(one.sensitivity, other.sensitivity)


def test_a_position_that_is_added_to_the_file_counts(tmp_path: Path) -> None:
    found = watched(tmp_path, count=5)
    all_frames(tmp_path)
    found.look()
    assert counts(found) == (2,) * 5
    manifest_of(tmp_path)
    found.look()
    assert counts(found) == (2,) * 6


def test_a_manifest_that_is_being_edited_is_told_and_waited_for(tmp_path: Path) -> None:
    found = watched(tmp_path, count=5)
    all_frames(tmp_path)
    found.look()
    whole = found.path.read_text()
    found.path.write_text(whole.replace("shift = [0, 0]", "shift = ["))
    said = found.look()[2]
    assert [each.kind for each in said] == ["unused"]
    assert "experiment.toml" in said[0].message
    assert found.look()[2] == []
    assert counts(found) == (2,) * 5
    manifest_of(tmp_path)
    assert found.look()[2] == []
    assert counts(found) == (2,) * 6


def test_frames_in_a_folder_count_again_when_they_change(tmp_path: Path) -> None:
    zarr = pytest.importorskip("zarr")
    path = manifest_of(tmp_path, count=2)
    path.write_text(path.read_text().replace("p1-*.tif", "p1.zarr"))
    all_frames(tmp_path, count=1)

    def write(frames: np.ndarray) -> None:
        array = zarr.create_array(
            str(tmp_path / "p1.zarr"),
            shape=frames.shape,
            dtype=frames.dtype,
            chunks=(1, *SHAPE),
            overwrite=True,
        )
        array[:] = frames
        for each in [tmp_path / "p1.zarr", *(tmp_path / "p1.zarr").rglob("*")]:
            os.utime(each, (time.time() - 10 - len(frames),) * 2)

    write(np.stack(FRAMES[1][:1]))
    found = WatchedFolder(tmp_path, path)
    found.look()
    assert counts(found) == (2, 1)
    write(np.stack(FRAMES[1][:2]))
    assert found.look()[0]
    assert counts(found) == (2, 2)


@pytest.mark.parametrize(
    ("more", "words"),
    [("flux = 1.0\n", "'flux'"), ("rotation = 90\n", "'rotation'"), ("time = 1.0\n", "'time'")],
)
def test_what_an_estimate_does_not_take_is_refused(tmp_path: Path, more: str, words: str) -> None:
    with pytest.raises(FileError, match=f"{words} in .* is not for equipix watch"):
        watched(tmp_path, more=more).look()


@pytest.mark.parametrize("library", [True, False])
def test_waiting_ends_with_a_new_file_or_in_time(
    tmp_path: Path, library: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not library:
        monkeypatch.setattr(arrivals, "watchfiles", None)
    started = time.monotonic()
    arrivals.wait_for_change(tmp_path, 0.3)
    assert 0.25 < time.monotonic() - started < 5
    code = f"import time, pathlib; time.sleep(0.5); pathlib.Path({str(tmp_path / 'a')!r}).touch()"
    with subprocess.Popen([sys.executable, "-c", code]):
        started = time.monotonic()
        arrivals.wait_for_change(tmp_path, 60)
        assert time.monotonic() - started < 20


def begun(folder: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "equipix", "watch", str(folder), "--json", *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.long
def test_a_killed_process_goes_on_and_ends_where_the_accuracy_is_met(tmp_path: Path) -> None:
    manifest_of(tmp_path)
    all_frames(tmp_path, count=4)
    with begun(tmp_path, "--until", "6e-3") as process:
        assert process.stdout is not None
        first = json.loads(process.stdout.readline())
        os.kill(process.pid, signal.SIGKILL)
    assert (first["met"], first["components"], len(first["positions"])) == (False, 11, 4)
    assert first["next"]["components"] == 1
    all_frames(tmp_path)
    with begun(tmp_path, "--until", "6e-3") as process:
        out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
    last = json.loads(out.splitlines()[-1])
    assert (last["met"], last["next"]) == (True, None)
    assert last["rms"] <= 6e-3
    assert last["positions"][1] == {"exposure": "p1", "shift": [0.0, 11.0]}


def test_it_says_where_the_dark_limits_most(tmp_path: Path) -> None:
    found = watched(tmp_path)
    all_frames(tmp_path)
    found.look()
    assert found.running is not None
    shown, _ = _shown(found, found.running, None, None)
    for (noise, dark, drift), limits in {
        (1e-3, 2e-3, math.nan): True,
        (3e-3, 2e-3, math.nan): False,
        (1e-3, 2e-3, 3e-3): False,
        (1e-3, 2e-3, 1e-3): True,
    }.items():
        shown["rms_by_cause"] = {"noise": noise, "dark": dark, "drift": drift}
        assert ("the dark limits most" in _in_words(shown)) == limits
    shown["rms"] = math.nan
    shown["next"]["rms"] = math.nan
    assert "expected error not known" in _in_words(shown)
    assert _in_words(shown).endswith(": error not known")
    assert "nan" not in _in_words(shown)


def test_the_dark_is_waited_for(tmp_path: Path) -> None:
    found = watched(tmp_path)
    all_frames(tmp_path)
    for file in tmp_path.glob("dark-*.tif"):
        file.unlink()
    found.look()
    assert found.running is not None
    shown, met = _shown(found, found.running, 1.0, None)
    assert (shown["dark"], met) == (False, False)
    assert "no frame of the dark yet" in _in_words(shown)
    all_frames(tmp_path)
    found.look()
    shown, met = _shown(found, found.running, 1.0, None)
    assert (shown["dark"], met) == (True, True)


@pytest.mark.long
def test_ctrl_c_ends_cleanly(tmp_path: Path) -> None:
    manifest_of(tmp_path)
    all_frames(tmp_path)
    with begun(tmp_path, "--until", "1e-9") as process:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["met"] is False
        time.sleep(0.5)  # it waits for files
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    assert process.returncode == 130
    assert json.loads(err)["code"] == "interrupted"


def test_a_folder_without_a_manifest_is_an_error(tmp_path: Path) -> None:
    with begun(tmp_path) as process:
        _, err = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "experiment.toml" in json.loads(err)["error"]

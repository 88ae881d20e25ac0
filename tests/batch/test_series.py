"""Long series in pieces: the same bytes as in one process, whatever ends in the middle."""

import functools
import json
import os
import pkgutil
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import equipix
from equipix import batch, errors
from equipix.batch import averages, recordings
from equipix.batch.series import remove_work
from equipix.correction.correct_files import correct_files
from equipix.io import arrays
from equipix.io.arrays import ZarrFrames
from equipix.io.tiff import write_frames

SHAPE = (24, 32)
COUNT = 600
MAPS = ("mean", "variance", "variance_of_mean", "count", "saturated")


def frames_of(dtype, count=COUNT):
    rng = np.random.default_rng(3)
    frames = rng.normal(1000, 30, (count, *SHAPE)) * (1 + 0.01 * rng.random((count, 1, 1)))
    frames = frames.astype(dtype)
    if frames.dtype.kind == "f":
        frames[rng.random(frames.shape) < 0.01] = np.nan
    return frames


def tiffs(folder, frames):
    """Files of 70 pages."""
    for number in range(0, len(frames), 70):
        part = frames[number : number + 70]
        write_frames(folder / f"{number:04}.tif", part, nbytes=part.nbytes)
    return [str(folder / "*.tif")]


def fits(folder, frames):
    fits = pytest.importorskip("astropy.io.fits")
    for number in range(0, len(frames), 70):
        fits.writeto(folder / f"{number:04}.fits", frames[number : number + 70])
    return [str(folder / "*.fits")]


def zarr(folder, frames):
    """Chunks of 50 frames."""
    array = pytest.importorskip("zarr").create_array(
        str(folder / "frames.zarr"), shape=frames.shape, dtype=frames.dtype, chunks=(50, *SHAPE)
    )
    array[:] = frames
    return [str(folder / "frames.zarr")]


def hdf5(folder, frames):
    """Two axes of frames, chunks of 64."""
    with pytest.importorskip("h5py").File(folder / "frames.h5", "w") as file:
        shape = (2, len(frames) // 2, *SHAPE)
        file.create_dataset("frames", data=frames.reshape(shape), chunks=(1, 64, 12, 32))
    return [str(folder / "frames.h5")]


WRITERS = (tiffs, fits, zarr, hdf5)


@pytest.fixture
def series(tmp_path, request):
    """Names of files of one kind, and the frames in them."""
    writer, dtype = request.param
    frames = frames_of(dtype)
    return writer(tmp_path, frames), frames


every_series = pytest.mark.parametrize(
    "series",
    [(writer, dtype) for writer in WRITERS for dtype in ("uint16", "float32")],
    indirect=True,
    ids=lambda given: f"{given[0].__name__}-{given[1]}",
)


def agree(one, other):
    for name in MAPS:
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name
    assert one.light_variance == other.light_variance
    assert (one.saturation, one.raw, one.step) == (other.saturation, other.raw, other.step)


@every_series
def test_pieces_give_the_same_bytes(series, tmp_path):
    names, frames = series
    mask = np.zeros(SHAPE, bool)
    mask[3:7, 5] = True
    options = {"saturation": 1100.0, "mask": mask}
    found = batch.average(names, tmp_path / "work", scheduler=None, **options)
    agree(found, equipix.average(names, **options))
    agree(found, equipix.average(frames, **options))
    assert len(list((tmp_path / "work").glob("*.sums"))) == 3
    assert set(found.metadata["inputs"]) == {str(path) for path in paths(names)}


def paths(names):
    return sorted(path for name in names for path in Path("/").glob(name.lstrip("/")))


@pytest.mark.long
@every_series
def test_two_workers_give_the_same_bytes(series, tmp_path, cluster):
    names, _ = series
    at = cluster.scheduler_address
    agree(batch.average(names, tmp_path / "work", scheduler=at), equipix.average(names))


@pytest.mark.long
def test_one_worker_gives_the_same_bytes(tmp_path):
    pytest.importorskip("distributed")
    names = tiffs(tmp_path, frames_of("float32"))
    found = batch.average(names, tmp_path / "work", workers=1)
    agree(found, equipix.average(names))


def test_what_is_finished_is_kept(tmp_path, monkeypatch):
    names, work, calls = tiffs(tmp_path, frames_of("float32")), tmp_path / "work", []
    run, original = functools.partial(batch.average, names, work, scheduler=None), averages._sum
    monkeypatch.setattr(averages, "_sum", lambda *job: calls.append(job) or original(*job))
    first = run()
    assert len(calls) == 3
    agree(run(), first)
    assert len(calls) == 3
    kept = sorted(work.glob("*.sums"))[0]
    data = bytearray(kept.read_bytes())
    data[1000] ^= 1
    kept.write_bytes(data)
    agree(run(), first)
    assert len(calls) == 4
    run(saturation=900)
    assert len(calls) == 7
    frames = frames_of("float32", 70) + 1
    write_frames(tmp_path / "0000.tif", frames, nbytes=frames.nbytes)
    assert not np.array_equal(run().mean, first.mean)
    assert len(calls) == 10


def test_an_input_that_changes_meanwhile_is_refused(tmp_path, monkeypatch):
    names, work = tiffs(tmp_path, frames_of("uint16")), tmp_path / "work"
    original = averages._sum

    def changing(job, workers):
        frames = frames_of("uint16", 70)[::-1]
        write_frames(tmp_path / "0000.tif", frames, nbytes=frames.nbytes)
        os.utime(tmp_path / "0000.tif", (9, 9))
        return original(job, workers)

    with monkeypatch.context() as patched:
        patched.setattr(averages, "_sum", changing)
        with pytest.raises(errors.FileError, match=r"0000\.tif.* changed"):
            batch.average(names, work, scheduler=None)
    assert not list(work.glob("*.sums"))
    agree(batch.average(names, work, scheduler=None), equipix.average(names))


def test_the_folder_of_pieces_keeps_files_of_others(tmp_path):
    work = tmp_path / "mean.npz.parts"
    work.mkdir()
    (work / "notes.txt").write_text("mine")
    names = tiffs(tmp_path, frames_of("uint16"))
    batch.average(names, work, scheduler=None)
    remove_work(tmp_path / "mean.npz")
    assert [each.name for each in work.iterdir()] == ["notes.txt"]


def test_a_saved_average_stays_one(tmp_path):
    saved = equipix.average(frames_of("uint16", 5))
    saved.save(tmp_path / "mean.tif")
    agree(batch.average(tmp_path / "mean.tif", tmp_path / "work", scheduler=None), saved)


def test_files_that_differ_are_refused(tmp_path):
    names = tiffs(tmp_path, frames_of("uint16", 80))
    other = np.zeros((2, 9, 9), np.uint16)
    write_frames(tmp_path / "9.tif", other, nbytes=other.nbytes)
    with pytest.raises(errors.FileError, match=r"9\.tif: is 9 x 9 .* expected 24 x 32"):
        batch.average(names, tmp_path / "work", scheduler=None)


def _killed_once(work, phases, job, workers):
    """Work; the first attempt at each job ends by SIGKILL where a name of `phases` is called."""
    mark = Path(f"{job.piece.parts[0][0]}.{job.piece.start}.{len(phases)}")
    if not mark.exists():
        mark.touch()
        owner, name = pkgutil.resolve_name(phases.rpartition(".")[0]), phases.rpartition(".")[2]
        setattr(owner, name, lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL))
    return work(job, workers)


@pytest.mark.long
@pytest.mark.parametrize(
    "place", ["equipix.measured.average.RunningAverage.add", "pathlib.Path.replace"]
)
def test_a_killed_worker_changes_no_average(tmp_path, cluster, monkeypatch, place):
    names = zarr(tmp_path, frames_of("float32"))
    killed = functools.partial(_killed_once, averages._sum, place)
    monkeypatch.setattr(averages, "_sum", killed)
    found = batch.average(names, tmp_path / "work", scheduler=cluster.scheduler_address)
    assert len(list(tmp_path.glob(f"frames.zarr.*.{len(place)}"))) == 3
    agree(found, equipix.average(names))


_LIMITED = """
import resource, sys
from equipix import batch
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
batch.{}
"""


def test_a_full_disk_is_told_and_the_rest_done_later(tmp_path):
    names, work = tiffs(tmp_path, frames_of("uint16")), tmp_path / "work"
    code = _LIMITED.format(f"average({names!r}, {str(work)!r}, scheduler=None)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ".sums: cannot be written: File too large" in done.stderr
    assert not work.exists()
    agree(batch.average(names, work, scheduler=None), equipix.average(names))


@pytest.fixture
def correction(tmp_path):
    rng = np.random.default_rng(7)
    levels = [level * (1 + 0.05 * rng.random(SHAPE)) for level in (100.0, 1000.0, 3000.0)]
    equipix.nuc.fit(levels, order=1).save(tmp_path / "response.npz")
    return tmp_path / "response.npz"


def files_in(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def corrected(correction, names, tmp_path):
    """Frames that `correct_files` writes to a TIFF."""
    correct_files(equipix.load(correction), names, tmp_path / "alone.tif", force=True)
    return equipix.io.frames.read_frames(tmp_path / "alone.tif")


@every_series
@pytest.mark.filterwarnings("ignore:.*NaN or infinite")
def test_a_recording_is_corrected_to_the_same_values(series, tmp_path, correction):
    reader, (names, _) = pytest.importorskip("zarr"), series
    found = batch.correct(correction, names, tmp_path / "out.zarr", scheduler=None)
    assert (found.frames, found.dtype) == (COUNT, "float32")
    array = reader.open_array(str(tmp_path / "out.zarr"), mode="r")
    assert array[:].tobytes() == corrected(correction, names, tmp_path).tobytes()
    assert array.attrs["description"].startswith("corrected by equipix, correction sha256")
    assert not (tmp_path / "out.zarr.parts").exists()


@pytest.mark.long
@pytest.mark.parametrize("writer", [zarr, hdf5])
def test_two_workers_write_the_same_files(writer, tmp_path, correction, cluster):
    names = writer(tmp_path, frames_of("uint16"))
    for name, at in (("one", None), ("two", cluster.scheduler_address)):
        batch.correct(correction, names, tmp_path / f"{name}.zarr", scheduler=at, dtype="uint16")
    assert files_in(tmp_path / "one.zarr") == files_in(tmp_path / "two.zarr")


@pytest.mark.long
@pytest.mark.parametrize(
    "place", ["equipix.correction.apply.Corrector.apply", "os.fsync", "pathlib.Path.replace"]
)
def test_a_killed_worker_changes_no_recording(tmp_path, correction, cluster, monkeypatch, place):
    names = zarr(tmp_path, frames_of("uint16"))
    batch.correct(correction, names, tmp_path / "one.zarr", scheduler=None)
    killed = functools.partial(_killed_once, recordings._kept_or_corrected, place)
    monkeypatch.setattr(recordings, "_kept_or_corrected", killed)
    at = cluster.scheduler_address
    batch.correct(correction, names, tmp_path / "two.zarr", scheduler=at)
    assert len(list(tmp_path.glob(f"frames.zarr.*.{len(place)}"))) == 3
    assert files_in(tmp_path / "one.zarr") == files_in(tmp_path / "two.zarr")


def test_a_recording_goes_on_where_it_was(tmp_path, correction, monkeypatch):
    names, output = zarr(tmp_path, frames_of("uint16")), tmp_path / "out.zarr"
    batch.correct(correction, names, tmp_path / "one.zarr", scheduler=None)
    original, calls = recordings._corrected, []

    def failing(job, workers):
        if len(calls) == 1:
            raise errors.FileError("gone")
        calls.append(job)
        return original(job, workers)

    monkeypatch.setattr(recordings, "_corrected", failing)
    with pytest.raises(errors.FileError, match="gone"):
        batch.correct(correction, names, output, scheduler=None)
    assert not output.exists()
    monkeypatch.setattr(
        recordings, "_corrected", lambda *job: calls.append(job[0]) or original(*job)
    )
    batch.correct(correction, names, output, scheduler=None)
    starts = [job.piece.start for job in calls]
    assert starts == [0, 250, 500]
    assert files_in(tmp_path / "one.zarr") == files_in(output)


@pytest.mark.parametrize(
    "damage", ["removed", "emptied", "flipped", "mark", "metadata", "description", "separator"]
)
def test_a_piece_that_was_damaged_is_made_again(tmp_path, correction, monkeypatch, damage):
    names, output = zarr(tmp_path, frames_of("uint16")), tmp_path / "out.zarr"
    batch.correct(correction, names, tmp_path / "one.zarr", scheduler=None)
    monkeypatch.setattr(recordings, "_total", lambda _: (_ for _ in ()).throw(errors.FileError))
    with pytest.raises(errors.FileError):
        batch.correct(correction, names, output, scheduler=None)
    monkeypatch.undo()
    (array,) = (tmp_path / "out.zarr.parts").glob("*.zarr")
    chunk = array / "c" / "1" / "0" / "0"
    content = chunk.read_bytes()
    if damage == "removed":
        chunk.unlink()
    elif damage == "mark":
        (mark,) = array.parent.glob("*.250.json")
        written = mark.read_text()
        mark.write_text(written.replace('"limited" : 0', '"limited" : 7'))
        assert mark.read_text() != written
    elif damage == "metadata":
        (array / "zarr.json").write_bytes(b"")
    elif damage in ("description", "separator"):
        was, new = {
            "description": ("corrected", "corrcted_"),
            "separator": ('"separator": "/"', '"separator": "."'),
        }[damage]
        written = (array / "zarr.json").read_text()
        (array / "zarr.json").write_text(written.replace(was, new))
        assert (array / "zarr.json").read_text() != written
    else:
        chunk.write_bytes(b"" if damage == "emptied" else bytes([content[0] ^ 1, *content[1:]]))
    counts = batch.correct(correction, names, output, scheduler=None)
    assert counts.limited == 0
    assert files_in(tmp_path / "one.zarr") == files_in(output)


def test_pieces_are_kept_where_a_dark_has_another_name(tmp_path, correction, monkeypatch):
    names, output = zarr(tmp_path, frames_of("uint16")), tmp_path / "out.zarr"
    dark, moved = tmp_path / "dark.npy", tmp_path / "moved.npy"
    np.save(dark, np.full((2, *SHAPE), 100, np.uint16))
    monkeypatch.setattr(recordings, "_total", lambda _: (_ for _ in ()).throw(errors.FileError))
    with pytest.raises(errors.FileError):
        batch.correct(correction, names, output, scheduler=None, dark=[str(dark)])
    monkeypatch.undo()
    dark.rename(moved)
    with monkeypatch.context() as patched:
        patched.setattr(recordings, "_corrected", lambda *_: pytest.fail("made again"))
        batch.correct(correction, names, output, scheduler=None, dark=[str(moved)])
    batch.correct(correction, names, tmp_path / "one.zarr", scheduler=None, dark=[str(moved)])
    assert "moved.npy" in (output / "zarr.json").read_text()
    assert files_in(tmp_path / "one.zarr") == files_in(output)


def test_a_disk_that_fails_for_a_moment_costs_no_piece(tmp_path, correction, monkeypatch):
    zarrs = pytest.importorskip("zarr")
    names, output = zarr(tmp_path, frames_of("uint16")), tmp_path / "out.zarr"
    monkeypatch.setattr(recordings, "_total", lambda _: (_ for _ in ()).throw(errors.FileError))
    with pytest.raises(errors.FileError):
        batch.correct(correction, names, output, scheduler=None)
    monkeypatch.undo()
    before, opened = files_in(tmp_path / "out.zarr.parts"), zarrs.open_array

    def failing(path, **given):
        if ".parts" in path:
            raise OSError(5, "Input/output error")
        return opened(path, **given)

    monkeypatch.setattr(zarrs, "open_array", failing)
    with pytest.raises(errors.FileError, match="Input/output error"):
        batch.correct(correction, names, output, scheduler=None)
    assert files_in(tmp_path / "out.zarr.parts") == before


@pytest.mark.parametrize(
    ("options", "chunk"),
    [
        ({"chunks": (50, *SHAPE)}, "c/3/0/0"),
        ({"chunks": (10, 12, 32), "shards": (50, *SHAPE)}, "c/3/0/0"),
        ({"chunks": (50, 12, 32), "zarr_format": 2}, "3.1.0"),
    ],
    ids=["chunks", "shards", "format 2"],
)
@pytest.mark.parametrize("place", ["", "entry/data"])
def test_a_zarr_array_that_lacks_a_chunk_is_refused(tmp_path, options, chunk, place):
    frames, file = frames_of("uint16"), tmp_path / "frames.zarr"
    array = pytest.importorskip("zarr").create_array(
        str(file), name=place or None, shape=frames.shape, dtype=frames.dtype, **options
    )
    array[:] = frames
    agree(equipix.average(file), equipix.average(frames))
    (file / place / chunk).unlink()
    words = f"lacks the chunk '{file / place / chunk}', which would be read as 0: copy it again"
    for refused in (equipix.average, arrays.header):  # before frames are read, too
        with pytest.raises(errors.FileError, match=words):
            refused(file)
    until = arrays.stream_frames(file, 0, 150)
    np.testing.assert_array_equal(np.concatenate([*until]), frames[:150])
    with pytest.raises(errors.FileError, match=words):
        [*arrays.stream_frames(file, 100, 151)]


def test_a_missing_chunk_of_frames_by_two_indices_is_refused(tmp_path):
    frames, file = frames_of("uint16", 12).reshape(3, 4, *SHAPE), tmp_path / "frames.zarr"
    array = pytest.importorskip("zarr").create_array(
        str(file), shape=frames.shape, dtype=frames.dtype, chunks=(2, 2, 12, *SHAPE[1:])
    )
    array[:] = frames
    (file / "c" / "1" / "0" / "1" / "0").unlink()  # of frame (2, 0) and (2, 1)
    until = arrays.stream_frames(file, 0, 8)
    np.testing.assert_array_equal(np.concatenate([*until]), frames[:2].reshape(8, *SHAPE))
    with pytest.raises(errors.FileError, match="lacks the chunk .*c/1/0/1/0'"):
        [*arrays.stream_frames(file, 8, 9)]


def test_chunks_of_zeros_are_written(tmp_path):
    pytest.importorskip("zarr")
    array, frames = ZarrFrames(tmp_path / "out.zarr"), np.zeros((20, *SHAPE), np.uint8)
    array.ensure(frames.shape, frames.dtype, 10)
    for start in (0, 10):
        array.write(start, frames[start : start + 10])
    np.testing.assert_array_equal(equipix.average(array.path).mean, np.zeros(SHAPE))


@pytest.mark.filterwarnings("ignore:100% of the corrected values")
def test_counts_are_those_of_one_process(tmp_path, correction):
    frames = frames_of("uint16")
    frames[:, 4, 5] = 65535
    names = zarr(tmp_path, frames)
    applied, output = equipix.load(correction), tmp_path / "alone.tif"
    alone = correct_files(applied, names, output, dtype="uint8")
    found = batch.correct(correction, names, tmp_path / "o.zarr", scheduler=None, dtype="uint8")
    assert found == alone
    assert found.limited > COUNT


def test_what_cannot_be_a_recording_is_refused(tmp_path, correction, monkeypatch):
    names, output = zarr(tmp_path, frames_of("uint16", 20)), tmp_path / "out.zarr"
    scene = equipix.scene.LocalMean(SHAPE, data_range=np.dtype("uint16"))
    scene.update(frames_of("uint16", 1)[0])
    scene.save(tmp_path / "state.npz")
    with pytest.raises(errors.FileError, match="state of a scene correction"):
        batch.correct(tmp_path / "state.npz", names, output, scheduler=None)
    with pytest.raises(errors.InputError, match=r"\.tif"):
        batch.correct(correction, names, tmp_path / "out.tif", scheduler=None)
    with pytest.raises(errors.InputError, match="'stored' twice"):
        batch.correct(correction, names, output, scheduler=None, dark=["stored", "stored"])
    with pytest.raises(errors.FileError, match="is one of the inputs"):
        batch.correct(correction, names, names[0], scheduler=None, force=True)
    with pytest.raises(errors.FileError, match="is named twice"):
        batch.correct(correction, [*names, *names], output, scheduler=None)
    with pytest.raises(errors.InputError, match="'workers'"):
        batch.average(names, tmp_path / "work", scheduler=None, workers=0)
    output.mkdir()
    with pytest.raises(errors.FileError, match="exists already"):
        batch.correct(correction, names, output, scheduler=None)
    monkeypatch.setattr("equipix.batch.cluster._TIMEOUT_S", 1)
    output.rmdir()
    before = {*tmp_path.iterdir()}
    with pytest.raises(errors.EquipixError, match="cannot be reached"):
        batch.correct(correction, names, output, scheduler="tcp://127.0.0.1:9")
    assert {*tmp_path.iterdir()} == before


@pytest.mark.long
def test_commands(tmp_path, correction, cluster, run, monkeypatch):
    at = ("--scheduler", cluster.scheduler_address)
    names = tiffs(tmp_path, frames_of("uint16"))
    # Names count from the folder of the command, not from that of the workers.
    monkeypatch.chdir(tmp_path)
    names, correction = ([os.path.relpath(each) for each in of] for of in (names, [correction]))
    for name, more in (("one", ()), ("two", at)):
        status, _, err = run("average", *names, "-o", f"{name}.npz", *more)
        assert status == 0, err
    one, two = (equipix.load(tmp_path / f"{name}.npz") for name in ("one", "two"))
    agree(one, two)
    assert one.metadata["inputs"] == two.metadata["inputs"]
    assert not (tmp_path / "two.npz.parts").exists()
    status, out, err = run("correct", *correction, *names, "-o", "o.zarr", *at, "--json")
    assert status == 0, err
    assert json.loads(out)["frames"] == COUNT
    shutil.rmtree(tmp_path / "o.zarr")


def test_options_that_do_not_go_together_are_refused(tmp_path, correction, run):
    names = tiffs(tmp_path, frames_of("uint16", 10))
    mean = ("average", *names, "-o", tmp_path / "mean.npz")
    assert "--reject compares each frame" in run(*mean, "--scheduler", "local", "--reject", 5)[2]
    command = ("correct", correction, *names, "-o")
    assert "name a .zarr" in run(*command, tmp_path / "o.tif", "--scheduler", "local")[2]
    assert (
        "--display makes pictures" in run(*command, tmp_path / "o.zarr", "--display", "linear")[2]
    )

"""Lots of sensors on a cluster of two processes: rows, files, what is kept, what faults leave."""

import csv
import functools
import json
import os
import pkgutil
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from dataclasses import asdict
from importlib import import_module
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

import equipix
from equipix import batch, errors, simulate
from equipix.batch import cluster as cluster_of_dask
from equipix.batch.cluster import Task, finished, scheduler_at
from equipix.batch.evaluation import Job, Row, _flagged, described_by, evaluate, refuse_taken
from equipix.batch.lot import Lot
from equipix.io.formats import checked, with_checksum
from equipix.io.tiff import write_frames
from equipix.report.limits import LimitsFile, limits_template
from given import written_experiment
from studies import taken

TIMES = {"started", "finished", "created", "seconds"}

_RESOURCES = {"equipix-memory": 2e9}

SHIFTS = [(0, 0), (0, 5), (0, 9), (5, 0), (9, 0)]


def write_levels(folder):
    """Write three levels of a uniform source."""
    rng, lines = np.random.default_rng(5), []
    folder.mkdir()
    for number in range(3):
        frames = np.rint(rng.normal(300 + 900 * number, 8, (4, 40, 50))).astype(np.uint16)
        write_frames(folder / f"{number}.tif", frames, nbytes=frames.nbytes)
        lines.append(f'[[level]]\nframes = "{number}.tif"')
    (folder / "levels.toml").write_text("[sensor]\nbit_depth = 12\n" + "\n".join(lines))
    return folder / "levels.toml"


@pytest.fixture
def lot(tmp_path):
    """Two experiments and one of levels."""
    manifests = []
    for name, shape in (("a", (90, 110)), ("b", (80, 120))):
        manifests.append(written_experiment(tmp_path / name, shape, SHIFTS))
    (tmp_path / "lot").mkdir()
    return [*manifests, write_levels(tmp_path / "lot" / "levels")]


def run(lot, tmp_path, cluster, **options):
    return batch.run(lot, tmp_path / "results", scheduler=cluster.scheduler_address, **options)


@pytest.mark.long
def test_each_sensor_has_a_result_a_page_and_a_row(lot, tmp_path, cluster):
    (tmp_path / "limits.toml").write_text(limits_template())
    found = run(lot, tmp_path, cluster, limits=tmp_path / "limits.toml", order=0)
    assert [row.sensor for row in found.rows] == ["a-experiment", "b-experiment", "lot-levels"]
    assert [row.status for row in found.rows] == ["done"] * 3
    for row in found.rows:
        assert (tmp_path / "results" / row.report).read_text().startswith("<!doctype html>")
        assert equipix.load(tmp_path / "results" / row.result).shape
        written = checked((tmp_path / "results" / f"{row.sensor}.json").read_text())
        assert Row(**written) == row
    columns = found.columns
    for row, count in zip(found.rows, columns["flagged_pixels.DO_NOT_USE"], strict=True):
        flags = equipix.load(tmp_path / "results" / row.result).flags
        assert count == np.count_nonzero(flags & equipix.Flag.DO_NOT_USE)
    with (tmp_path / "results" / "lot.csv").open(newline="") as file:
        rows = [*csv.DictReader(file)]
    assert [row["sensor"] for row in rows] == columns["sensor"]
    assert [float(row["reduced_chi2"]) for row in rows[:2]] == columns["reduced_chi2"][:2]
    parquet = pytest.importorskip("pyarrow.parquet")
    assert parquet.read_table(tmp_path / "results" / "lot.parquet").to_pydict() == columns
    good, of = found.yields["converged"]
    assert (good, of) == (2, 2)
    page = (tmp_path / "results" / "lot.html").read_text()
    assert f'<a href="{found.rows[0].report}">' in page


@pytest.mark.long
def test_results_are_those_of_one_process(lot, tmp_path, cluster):
    """The same bytes of every array and the same metadata, but for times."""
    found = run(lot, tmp_path, cluster)
    for manifest, row in zip(lot[:2], found.rows, strict=False):
        alone = equipix.Experiment.load(manifest).run()
        alone.save(tmp_path / "alone.tif", force=True)
        one, other = (
            equipix.load(file)
            for file in (tmp_path / "alone.tif", tmp_path / "results" / row.result)
        )
        for name in ("sensitivity", "flags", "beam", "shifts", "flux"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
        first, second = (
            {name: value for name, value in each.metadata.items() if name not in TIMES}
            for each in (one, other)
        )
        assert first == second


@pytest.mark.long
def test_the_output_counts_from_the_folder_of_the_caller(lot, tmp_path, cluster, monkeypatch):
    monkeypatch.chdir(tmp_path)
    manifest = os.path.relpath(lot[0])
    found = batch.run([manifest], "here", scheduler=cluster.scheduler_address)
    assert [row.status for row in found.rows] == ["done"]
    assert (tmp_path / "here" / found.rows[0].result).exists()


@pytest.mark.long
def test_a_cluster_has_no_more_workers_than_tasks():
    distributed = pytest.importorskip("distributed")
    with scheduler_at(None, [10**8], workers=3) as address, distributed.Client(address) as client:
        assert len(client.scheduler_info(n_workers=-1)["workers"]) == 1


@pytest.mark.long
def test_what_is_the_same_is_kept(lot, tmp_path, cluster):
    first = run(lot, tmp_path, cluster)
    again = run(lot, tmp_path, cluster)
    assert [row.status for row in again.rows] == ["kept"] * 3
    assert [row.key for row in again.rows] == [row.key for row in first.rows]
    # An option, an input, a lost result.
    assert [row.status for row in run(lot, tmp_path, cluster, tolerance=1e-5).rows] == ["done"] * 3
    run(lot, tmp_path, cluster)
    frames = np.full((4, 40, 50), 700, np.uint16)
    frames[::2] += 9
    write_frames(tmp_path / "lot" / "levels" / "0.tif", frames, nbytes=frames.nbytes)
    (tmp_path / "results" / again.rows[0].result).unlink()
    states = [row.status for row in run(lot, tmp_path, cluster).rows]
    assert states == ["done", "kept", "done"]


@pytest.mark.parametrize("file", ["a.tif", "a.html"])
def test_a_file_that_was_damaged_is_made_again(tmp_path, file):
    results = tmp_path / "results"
    results.mkdir()
    job = Job("a", write_levels(tmp_path / "a"), results, ".tif", {}, LimitsFile(), False)
    assert [evaluate(job).status for _ in range(2)] == ["done", "kept"]
    written = (results / file).read_bytes()
    for damaged in (written[:-1], b"", bytes([written[0] ^ 1, *written[1:]])):
        (results / file).write_bytes(damaged)
        assert [evaluate(job).status for _ in range(2)] == ["done", "kept"]


@pytest.mark.long
def test_one_bad_sensor_does_not_stop_the_others(lot, tmp_path, cluster):
    next((tmp_path / "a" / "experiment" / "dark").iterdir()).unlink()
    found = run(lot, tmp_path, cluster)
    assert [row.status for row in found.rows] == ["failed", "done", "done"]
    assert "dark" in found.rows[0].reason
    page = (tmp_path / "results" / "lot.html").read_text()
    assert "dark" in page
    assert "Failure, no result." in page
    assert "1 of 3 sensors: a-experiment" in page
    assert "nothing contradicts" not in page


def test_maps_show_where_sensors_are_flagged_and_beyond_a_limit():
    """Two of four sensors have dead pixels in a corner, one of them beyond a limit; one failed."""
    none, corner = np.zeros((4, 5)), np.zeros((4, 5))
    corner[0, 0] = 0.3
    marks = {"DO_NOT_USE": corner.tolist(), "DEAD": corner.tolist()}
    beyond = [{"figure": "flagged_share", "verdict": "FAIL"}]
    size = {"size": "40×50"}
    rows = (
        Row("a", "", status="done", flagged=marks, limits=beyond, figures=size),
        Row("b", "", status="done", flagged=marks, figures=size),
        Row("c", "", status="done", flagged={"HOT": none.tolist()}, figures=size),
        Row("d", "", status="done", figures=size),
        Row("e", ""),
    )
    maps = {each.name: each.values for each in batch.Lot(rows)._maps()}
    share = "Share of 4 sensors of 40×50"
    wanted = {
        f"{share} with pixels flagged 'do not use' there": 0.5,
        f"{share} with pixels flagged 'dead' there": 0.5,
        f"{share} with pixels flagged 'hot' there": 0.0,
        f"{share} beyond the limit of share of flagged pixels, with flagged pixels there": 0.25,
    }
    assert {name: values[0, 0] for name, values in maps.items()} == wanted
    assert all(values.ravel()[1:].max() == 0 for values in maps.values())


@pytest.mark.parametrize(
    ("shape", "places"), [((96, 128), (36, 48)), ((30, 20), (30, 20)), ((4, 1000), (1, 48))]
)
def test_parts_of_a_map_are_about_square(shape, places):
    flags = np.zeros(shape, np.uint32)
    flags[0, 0] = equipix.Flag.DEAD
    shares = np.array(_flagged(flags)["DEAD"])
    rows, cols = (length // count for length, count in zip(shape, places, strict=True))
    assert shares.shape == places
    assert shares[0, 0] == pytest.approx(1 / (rows * cols), abs=1e-6)  # rounded to six digits
    assert shares.sum() == shares[0, 0]


@pytest.mark.long
def test_a_killed_worker_is_replaced(lot, tmp_path, cluster):
    """SIGKILL to each worker while sensors are evaluated: every one has its result in the end."""
    from distributed import Client

    with Client(cluster) as client:
        before = client.run(os.getpid)
    killer = threading.Timer(2.5, lambda: [os.kill(pid, signal.SIGKILL) for pid in before.values()])
    killer.start()
    found = run(lot, tmp_path, cluster)
    killer.join()
    assert [row.status for row in found.rows] == ["done"] * 3
    names = {path.name for path in (tmp_path / "results").iterdir()}
    wanted = {f"{row.sensor}{end}" for row in found.rows for end in (".json", ".html", ".tif")}
    assert wanted | {"lot.csv", "lot.parquet", "lot.html"} == names
    with Client(cluster) as client:
        client.wait_for_workers(2)
        assert not set(client.run(os.getpid).values()) & set(before.values())


@pytest.mark.long
def test_workers_of_this_machine_keep_freed_memory():
    from distributed import Client

    with scheduler_at(None, [10**8], workers=1) as address, Client(address) as client:
        client.wait_for_workers(1)
        (known,) = client.run(lambda: dict(os.environ)).values()
    assert "MALLOC_TRIM_THRESHOLD_" not in known


@pytest.mark.long
def test_a_process_takes_one_sensor_at_a_time_and_none_beyond_its_memory(tmp_path):
    """Two threads serve one sensor: its libraries and warnings are those of the process."""
    from distributed import LocalCluster

    jobs = [Job(f"{k}", tmp_path, tmp_path, ".tif", {}, LimitsFile(), False) for k in range(4)]
    one = {
        "n_workers": 1,
        "threads_per_worker": 2,
        "memory_limit": 0,
        "dashboard_address": "127.0.0.1:0",
    }
    one["resources"] = _RESOURCES
    with LocalCluster(**one) as cluster:
        tasks = [Task(job, 5 * 10**8) for job in jobs]
        rows = [row for _, row in finished(_nap, tasks, cluster.scheduler_address, None)]
        beyond = [Task(jobs[0], 10**18)]
        (_, reason), *_ = finished(_nap, beyond, cluster.scheduler_address, None)
    spans = sorted((row.figures["from"], row.figures["to"]) for row in rows)
    assert not any(one[1] > other[0] for one, other in pairwise(spans))
    assert reason.startswith("needs 1000000000.0 GB, and the largest worker has 2.0 GB")


def test_without_declared_memory_nothing_is_sent(tmp_path):
    from distributed import LocalCluster

    tasks = [Task(Job("a", tmp_path, tmp_path, ".tif", {}, LimitsFile(), False), 1)]
    one = {"n_workers": 1, "processes": False, "dashboard_address": "127.0.0.1:0"}
    with (
        LocalCluster(**one) as cluster,
        pytest.raises(errors.EquipixError, match="--resources equipix-memory=BYTES"),
    ):
        next(finished(_nap, tasks, cluster.scheduler_address, None))


@pytest.mark.long
def test_where_all_workers_are_gone_a_warning_says_so(tmp_path, monkeypatch):
    """The lot waits, and is evaluated once another one comes."""
    from distributed import LocalCluster

    jobs = [Job(f"{k}", tmp_path, tmp_path, ".tif", {}, LimitsFile(), False) for k in range(3)]
    one = {"processes": False, "dashboard_address": "127.0.0.1:0", "resources": _RESOURCES}
    with LocalCluster(n_workers=1, threads_per_worker=1, **one) as cluster:
        given = _nap, [Task(job, 10**9) for job in jobs], cluster.scheduler_address, None
        found = finished(*given)
        next(found)
        monkeypatch.setattr("equipix.batch.cluster._TIMEOUT_S", 1)
        cluster.scale(0)
        comes = threading.Timer(5, cluster.scale, [1])
        comes.start()
        with pytest.warns(errors.EquipixWarning, match=r"no worker of 1\.0 GB for [12] tasks"):
            rows = [row for _, row in found]
        comes.join()
    assert [row.status for row in rows] == ["done"] * 2


@pytest.mark.parametrize(
    ("largest", "warned"),
    [([0, 0, 0], 1), ([0, 9, 0], 0), ([2, 2, 2], 1), ([3, 3, 3], 0), ([0, OSError, 0], 1)],
    ids=["gone", "started again", "too small", "large enough", "scheduler away for a moment"],
)
def test_it_warns_once_where_no_worker_has_the_memory_for_long(monkeypatch, largest, warned):
    looks = iter(largest)

    class Left:
        """The last future ends together with the last look: nothing is sent any more then."""

        def is_empty(self):
            return not sent

        def next_batch(self, *, block):
            assert not block
            return [] if looks.__length_hint__() else ["one"]

    def declared(_):
        found = next(looks)
        if found is OSError:
            raise found
        return found

    monkeypatch.setattr(cluster_of_dask, "_TIMEOUT_S", 0)
    monkeypatch.setattr(cluster_of_dask, "_POLL_S", 0)
    monkeypatch.setattr(cluster_of_dask, "_declared", declared)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        sent = {"one": Task(None, 3), "other": Task(None, 7)}
        for future in cluster_of_dask._ended(None, Left(), sent):
            assert future == "one"
            sent.clear()
    assert len(said) == warned


def _deadly(job, _):
    if job.name == "deadly":
        os.kill(os.getpid(), signal.SIGKILL)
    return Row(job.name, "", status="done")


@pytest.mark.long
def test_who_waits_behind_a_task_that_ends_processes_is_not_blamed():
    """The largest comes first, and ends each process that works on it."""
    names = ("deadly", "a", "b", "c")
    jobs = [Job(name, None, None, ".tif", {}, None, False) for name in names]
    tasks = [Task(job, 10**8 - number) for number, job in enumerate(jobs)]
    found = {task.job.name: row for task, row in finished(_deadly, tasks, None, 1)}
    assert found.pop("deadly").startswith("each process that worked on it ended")
    assert [row.status for row in found.values()] == ["done"] * 3


def _deadly_at_last(job, _):
    time.sleep(0.5 if job.name == "deadly" else 0)
    return _deadly(job, _)


@pytest.mark.long
def test_a_result_that_is_lost_with_its_process_is_made_again(monkeypatch):
    """It is found lost while the first result is seen to; no scheduler has ended."""
    monkeypatch.setattr(cluster_of_dask, "_ROUNDS", 1)
    jobs = [Job(name, None, None, ".tif", {}, None, False) for name in ("first", "a", "deadly")]
    tasks = [Task(job, 10**8 - number) for number, job in enumerate(jobs)]
    rows = {}
    for task, row in finished(_deadly_at_last, tasks, None, 1):
        if not rows:
            time.sleep(2)
        rows[task.job.name] = row
    assert rows.pop("deadly").startswith("each process that worked on it ended")
    assert [row.status for row in rows.values()] == ["done"] * 2


@pytest.mark.parametrize("status", ["error", "cancelled"])
def test_a_result_that_is_lost_while_it_is_fetched_is_none(status):
    distributed = pytest.importorskip("distributed")
    future = SimpleNamespace(status="finished")

    def result():
        future.status = status
        if status == "error":
            raise distributed.KilledWorker("task", None, 3)
        raise distributed.CancelledError

    future.result = result
    assert cluster_of_dask._fetched(future) == []
    whole = SimpleNamespace(status="finished", result=lambda: None)
    assert cluster_of_dask._fetched(whole) == [None]


_ASLEEP = """
import time
from typing import NamedTuple
import distributed
from equipix.batch.cluster import Task, finished

class Job(NamedTuple):
    name: str

def asleep(job, workers):
    print("works", flush=True)
    time.sleep(60)

if __name__ == "__main__":
    print("starts", flush=True)
    [*finished(asleep, [Task(Job("a"), 10**8)], None, 1)]
"""


@pytest.mark.long
@pytest.mark.parametrize("line", [1, 2])
def test_ctrl_c_ends_workers_of_this_machine_without_a_word_of_theirs(tmp_path, line):
    """A terminal sends it to all processes, while they start or work."""
    (tmp_path / "asleep.py").write_text(_ASLEEP)
    command = [sys.executable, tmp_path / "asleep.py"]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **options, start_new_session=True) as process:
        for _ in range(line):
            process.stdout.readline()
        time.sleep(0.5)
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=30)
    assert process.returncode == -signal.SIGINT
    assert err.startswith("Traceback")
    assert err.count("Traceback") == 1, err
    assert err.endswith("\nKeyboardInterrupt\n")


@pytest.mark.long
def test_where_all_is_kept_no_cluster_starts(lot, tmp_path, monkeypatch):
    first = batch.run(lot[2:], tmp_path / "results")
    assert [row.status for row in first.rows] == ["done"]
    monkeypatch.setattr("distributed.LocalCluster", None)
    again = batch.run(lot[2:], tmp_path / "results")
    assert [row.status for row in again.rows] == ["kept"]


def _nap(job, _):
    began = time.monotonic()
    time.sleep(0.5)
    return Row(job.name, "", status="done", figures={"from": began, "to": time.monotonic()})


def test_a_full_disk_is_the_reason_and_leaves_nothing_half_written(lot, tmp_path):
    results = tmp_path / "results"
    results.mkdir()
    code = f"""
import json, resource
from dataclasses import asdict
from pathlib import Path
from equipix.batch.evaluation import Job, evaluate
from equipix.report.limits import LimitsFile
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
job = Job("a", Path({str(lot[0])!r}), Path({str(results)!r}), ".tif", {{}}, LimitsFile(), False)
print(json.dumps(asdict(evaluate(job))))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    row = Row(**json.loads(done.stdout))
    assert row.status == "failed"
    assert "a.tif: cannot be written" in row.reason
    assert [*results.iterdir()] == []


def test_an_input_that_the_system_refuses_is_the_reason_of_one_sensor(tmp_path):
    path = write_levels(tmp_path / "a")
    path.write_text(path.read_text().replace("1.tif", f"{'a' * 300}/1.tif"))
    lot = batch.run([path], tmp_path / "results", order=1)
    assert [row.status for row in lot.rows] == ["failed"]
    assert lot.rows[0].reason.endswith("/1.tif: cannot be read: File name too long")
    lot = batch.run([tmp_path / ("b" * 300) / "levels.toml"], tmp_path / "results", order=1)
    assert "File name too long" in lot.rows[0].reason


def test_a_sensor_has_no_name_of_the_lot(tmp_path):
    manifests = [write_levels(tmp_path / "lot"), write_levels(tmp_path / "other")]
    named = import_module("equipix.batch.run")._named
    assert [*named(manifests[:1])] == ["lot-levels"]
    assert [*named(manifests)] == ["lot-levels", "other-levels"]


def test_a_name_of_another_sensor_is_refused_while_that_is_there(lot, tmp_path):
    results, job = tmp_path / "results", Job("a", lot[0], tmp_path / "results", ".tif", {}, None, 0)
    results.mkdir()
    row = Row("a", str(lot[1]), status="done")
    (results / "a.json").write_text(with_checksum(asdict(row)))
    with pytest.raises(errors.FileError, match=r"a\.json: is that of .*b/experiment"):
        refuse_taken(job)
    refuse_taken(job._replace(manifest=lot[1]))
    lot[1].unlink()
    refuse_taken(job)


def test_no_row_stands_beside_a_result_that_is_not_its_own(lot, tmp_path, monkeypatch):
    """What ends between the result and its row leaves the result without one."""
    results = tmp_path / "results"
    results.mkdir()
    job = Job("a", lot[0], results, ".tif", {"tolerance": 1e-3}, LimitsFile(), False)
    assert evaluate(job).status == "done"

    def ended(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("equipix.batch.evaluation.write_page", ended)
    with pytest.raises(KeyboardInterrupt):
        evaluate(job._replace(options={"tolerance": 1e-4}))
    assert not (results / "a.json").exists()


def test_an_input_that_changes_meanwhile_is_the_reason(lot, tmp_path, monkeypatch):
    results = tmp_path / "results"
    results.mkdir()
    job = Job("a", lot[0], results, ".tif", {"tolerance": 1e-3}, LimitsFile(), False)
    dark = next((lot[0].parent / "dark").iterdir())
    original = equipix.Experiment.run

    def changing(*given, **options):
        found = original(*given, **options)
        os.utime(dark, (9, 9))
        return found

    monkeypatch.setattr("equipix.Experiment.run", changing)
    row = evaluate(job)
    assert (row.status, "changed" in row.reason) == ("failed", True)
    assert not (results / "a.json").exists()


def test_what_cannot_be_a_lot_is_refused(lot, tmp_path, monkeypatch):
    output = tmp_path / "results"
    with pytest.raises(errors.InputError, match="'manifests' is empty"):
        batch.run([], output)
    with pytest.raises(errors.InputError, match="is named twice"):
        batch.run([lot[0], lot[0]], output)
    with pytest.raises(errors.InputError, match="'toleranz' is no option"):
        batch.run(lot, output, toleranz=1)
    with pytest.raises(errors.InputError, match=r"'suffix' is '\.doc'"):
        batch.run(lot, output, suffix=".doc")
    wrong = {"tolerance": np.nan, "method": "best", "max_sweeps": 0, "flux": "x", "order": 7}
    for name, value in wrong.items():
        with pytest.raises(errors.InputError, match=f"'{name}' is "):
            batch.run(lot, output, **{name: value})
    assert not output.exists()
    monkeypatch.setattr("equipix.batch.cluster._TIMEOUT_S", 1)
    with pytest.raises(errors.EquipixError, match="cannot be reached"):
        batch.run(lot, output, scheduler="tcp://127.0.0.1:9")
    with pytest.raises(errors.InputError, match=r"'order' is no option of experiment\.toml"):
        batch.run(lot[:2], output, order=2)
    (tmp_path / "file").touch()
    for each in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(errors.FileError, match=r"file: is a file, expected a folder"):
            batch.run(lot, each)
    for refused in ("/proc", tmp_path / ("x" * 300)):
        with pytest.raises(errors.FileError, match=f"^{refused}: cannot be written"):
            batch.run(lot, refused)
    (output / "lot.html").mkdir(parents=True)
    with pytest.raises(errors.FileError, match=r"lot\.html: is a folder"):
        batch.run(lot, output)


@pytest.mark.long
def test_the_command_tells_states_and_reasons(lot, tmp_path, run_command, cluster):
    (tmp_path / "a" / "experiment" / "dark" / "dark.tif").unlink()
    given = [*lot, "-o", tmp_path / "results", "--scheduler", cluster.scheduler_address]
    status, out, err = run_command("batch", *given, "--json")
    told = json.loads(out)
    assert status == 1
    assert (told["done"], told["kept"], told["failed"]) == (2, 0, 1)
    assert "1 of 3 sensors gave no result" in err
    _, out, _ = run_command("batch", *given)
    assert re.search(r"^reasons +a-experiment: .*dark", out, re.M)


def test_the_command_lists_the_first_reasons(run_command, monkeypatch, tmp_path):
    rows = tuple(Row(f"s{k:02}", "", status="failed", reason=f"why {k}") for k in range(12))
    monkeypatch.setattr("equipix.cli.batch.run", lambda *_, **__: Lot(rows))
    (tmp_path / "experiment.toml").touch()
    status, out, _ = run_command("batch", tmp_path / "experiment.toml", "-o", tmp_path)
    assert status == 1
    assert "s09: why 9" in out
    assert "s10" not in out
    assert "and 2 more" in out
    assert "yield" not in out


@pytest.fixture
def run_command(request):
    """The fixture `run` of conftest, whose name the helper here has."""
    return request.getfixturevalue("run")


def _kill(seconds, then):
    """Call `then` and be gone by SIGKILL after some seconds, or when it has ended."""

    def called(*given, **options):
        threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGKILL)).start()
        then(*given, **options)
        os.kill(os.getpid(), signal.SIGKILL)

    return called


_PHASES = {
    "average": ("equipix._native.average_files", 0.002),
    "solve": ("equipix.calibration.calibrate.weighted_fit", 0.02),
    "write": ("equipix.batch.evaluation.write_page", 0.02),
    "replace": ("pathlib.Path.replace", 0),
}


def _killed_while(phase, job, workers):
    """Evaluate; the first attempt ends by SIGKILL in a phase."""
    mark = job.output.parent / f"{job.name}.{phase}"
    if not mark.exists():
        mark.touch()
        place, seconds = _PHASES[phase]
        owner, name = pkgutil.resolve_name(place.rpartition(".")[0]), place.rpartition(".")[2]
        setattr(owner, name, _kill(seconds, getattr(owner, name)))
    return evaluate(job, workers)


@pytest.mark.long
@pytest.mark.parametrize("phase", _PHASES)
def test_a_worker_killed_in_a_phase_leaves_whole_files(lot, tmp_path, cluster, phase):
    output = tmp_path / "results"
    output.mkdir()
    jobs = [Job(f"{k}", lot[k], output, ".tif", {}, LimitsFile(), False) for k in range(2)]
    work = functools.partial(_killed_while, phase)
    found = finished(work, [Task(job, 1) for job in jobs], cluster.scheduler_address, None)
    assert [row.status for _, row in found] == ["done"] * 2
    assert (tmp_path / f"0.{phase}").exists()
    for k in range(2):
        alone = equipix.Experiment.load(lot[k]).run()
        there = equipix.load(output / f"{k}.tif")
        assert there.sensitivity.tobytes() == alone.sensitivity.tobytes()
        assert Row(**checked((output / f"{k}.json").read_text())).status == "done"


def _program(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def _cluster_at(port):
    """Start a scheduler and a worker; both end with what is returned."""
    scheduler = _program("dask_scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
    worker = _program(
        "dask_worker",
        f"tcp://127.0.0.1:{port}",
        "--nworkers",
        "2",
        "--nthreads",
        "1",
        "--no-dashboard",
        "--resources",
        "equipix-memory=2e9",
    )
    return scheduler, worker


def _slow(job, _):
    time.sleep(3)
    (job.output / f"{job.name}").touch()
    return Row(job.name, "", status="done")


@pytest.mark.long
def test_a_scheduler_that_starts_again_gets_the_rest(tmp_path):
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    jobs = [Job(f"{k}", tmp_path, tmp_path, ".tif", {}, LimitsFile(), False) for k in range(6)]
    programs = [*_cluster_at(port)]
    try:
        found = finished(_slow, [Task(job, 1) for job in jobs], f"tcp://127.0.0.1:{port}", None)
        rows = [next(found)[1]]
        programs[0].kill()
        programs[0].wait()
        programs[1].terminate()
        programs[1].wait()
        programs += _cluster_at(port)
        rows += [row for _, row in found]
    finally:
        for each in programs[::-1]:
            each.terminate()
            each.wait()
    assert not [row for row in rows if isinstance(row, str)]
    assert sorted(row.sensor for row in rows) == [job.name for job in jobs]
    assert {row.status for row in rows} == {"done"}


@pytest.mark.long
def test_a_disk_that_is_full_is_told_and_the_rest_done_later(lot, tmp_path, cluster):
    """Disk of 150 kB, later of 50 MB."""
    output = tmp_path / "results"
    output.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o"]
    made = subprocess.run([*mount, "size=150k", "none", output], capture_output=True, check=False)
    if made.returncode:
        pytest.skip("mount is not allowed; the test with a limit of file sizes stands in")
    try:
        failed = run(lot, tmp_path, cluster).failed
        assert failed
        assert all("No space left on device: free space" in row.reason for row in failed)
        assert not [*output.glob(".*")]
        for file in output.glob("*.json"):
            row = Row(**checked(file.read_text()))
            assert equipix.load(output / row.result).shape
        subprocess.run(["mount", "-o", "remount,size=50m", output], check=True)
        assert not run(lot, tmp_path, cluster).failed
    finally:
        subprocess.run(["umount", output], check=True)


def _vanished(job, workers):
    """Evaluate; the first image goes when the manifest is read."""
    described = described_by(job.manifest)
    described.files()[0].unlink()
    return evaluate(job, workers)


@pytest.mark.long
def test_an_input_that_vanishes_is_the_reason(lot, tmp_path, cluster):
    output = tmp_path / "results"
    output.mkdir()
    jobs = [Job("a", lot[0], output, ".tif", {}, LimitsFile(), False)]
    ((_, row),) = finished(_vanished, [Task(jobs[0], 1)], cluster.scheduler_address, None)
    assert row.status == "failed"
    assert ".tif" in row.reason
    assert not [*output.iterdir()]


_SENSORS = 100
"""Of a whole study."""


@pytest.mark.long
def test_a_hundred_sensors_end_as_one_after_the_other(tmp_path, cluster, pytestconfig):
    """The same bytes of every array of every result, and the same metadata but for times."""
    lot, count = [], taken(_SENSORS, pytestconfig.option.study_share)
    for number in range(count):
        rng = np.random.default_rng(number)
        sensitivity = simulate.paper_sensitivity((240, 320), rng=rng)
        beam = simulate.gaussian_beam((240, 320), width=300)
        virtual = simulate.experiment(sensitivity, beam, SHIFTS, frames=4, rng=rng)
        lot.append(virtual.write(tmp_path / f"s{number:03}"))
    found = run(lot, tmp_path, cluster, suffix=".npz")
    assert [row.status for row in found.rows] == ["done"] * count
    for manifest, row in zip(lot, found.rows, strict=True):
        equipix.Experiment.load(manifest).run().save(tmp_path / "alone.npz", force=True)
        one, other = (
            np.load(file) for file in (tmp_path / "alone.npz", tmp_path / "results" / row.result)
        )
        assert one.files == other.files
        for name in one.files:
            if one[name].dtype.kind not in "SU":
                assert one[name].tobytes() == other[name].tobytes(), name
        first, second = (
            {
                name: value
                for name, value in equipix.load(file).metadata.items()
                if name not in TIMES
            }
            for file in (tmp_path / "alone.npz", tmp_path / "results" / row.result)
        )
        assert first == second

"""Commands killed while they write: each output is the old one or the new one, whole."""

from __future__ import annotations

import shlex
from importlib import import_module
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest

import equipix
from equipix import cli, nuc, simulate
from equipix.batch.evaluation import evaluate
from equipix.cli.app import COMMANDS, command
from equipix.io import tiff
from equipix.io.paths import write_whole
from given import written_camera, written_experiment
from kills import killed
from studies import taken

if TYPE_CHECKING:
    from pathlib import Path

SHIFTS = [(0, 0), (0, 5), (0, 9), (5, 0), (9, 0)]

KILLS, OF_WRITER, IN_SHORT = 100, 1000, 3

GIVEN = {
    "average": "IN/frames.npy -o OUT/a.tif",
    "batch": "IN/lot/levels.toml -o OUT/results",
    "bolometer": "IN/level*.npy --substrate-c '0 20 40' --bias-v 2 -o OUT/a.fits",
    "calibrate": "IN/experiment/experiment.toml --tolerance 1e-3 -o OUT/a.tif",
    "combine": "IN/response.npz IN/flat.npz -o OUT/a.nxs",
    "compare": "IN/cal.npz IN/cal2.npz -o OUT/a.html",
    "convert": "IN/response.npz OUT/a.asdf",
    "correct file": "IN/response.npz IN/frames.npy -o OUT/a.fits",
    "correct folder": "IN/response.npz IN/frames.npy IN/level0.npy -o OUT/results",
    "correct zarr": "IN/response.npz IN/frames.npy -o OUT/a.zarr",
    "correct new folder": "IN/response.npz IN/frames.npy IN/level0.npy -o OUT/new",
    "demo": "--shape 48 64 --frames 2 --keep OUT/experiment -o OUT/a.png",
    "emva": "IN/camera.toml -o OUT/a.html",
    "hardware": "IN/response.npz -o OUT/a.hex",
    "init": "experiment IN -o OUT/a.toml",
    "inspect": "IN/response.npz -o OUT/a.png",
    "lens": "IN/lens.npy -o OUT/a.npz",
    "nuc fit": "IN/lot/levels.toml --order 1 -o OUT/a.tif",
    "nuc defects": "IN/response.npz IN/level1.npy -o OUT/a.tif",
    "plan": "--shape 48 64 --shifts '0,0 0,5 7,0' -o OUT/a.png",
    "report": "IN/response.npz -o OUT/a.html",
    "scene": "IN/scene.npy --method gated --data-range 0 1 -o OUT/a.tif",
    "simulate": "--shape 48 64 --frames 2 --rng 1 -o OUT/experiment",
}
"""Arguments of each command that writes; a second word says what it is about, or is its command."""

WITHOUT_OUTPUT = {"watch"}

SEVERAL = {"batch", "correct folder"}
"""Commands whose outputs are files of one folder, each whole; the folder may have had others."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Else each copy of a process imports them while it writes.
    for library in (
        "asdf",
        "astropy.io.fits",
        "matplotlib.backends.backend_agg",
        "pyarrow.parquet",
    ):
        pytest.importorskip(library)
    import_module("matplotlib.pyplot")
    folder = tmp_path_factory.mktemp("inputs")
    rng = np.random.default_rng(1)
    written_experiment(folder, (48, 64), SHIFTS)
    written_camera(folder, shape=(16, 20))
    np.save(folder / "frames.npy", rng.poisson(800, (3, 48, 64)).astype(np.uint16))
    (folder / "lot").mkdir()
    lines, levels = ["[sensor]\nbit_depth = 12"], []
    for k in range(3):
        frames = rng.poisson(300 + 900 * k, (4, 48, 64)).astype(np.uint16)
        np.save(folder / f"level{k}.npy", frames)
        tiff.write_frames(folder / "lot" / f"{k}.tif", frames, nbytes=frames.nbytes)
        lines.append(f'[[level]]\nframes = "{k}.tif"')
        levels.append(equipix.average(frames))
    (folder / "lot/levels.toml").write_text("\n".join(lines))
    moving = simulate.MovingScene(seed=1, shape=(48, 64)).frames(40)
    np.save(folder / "scene.npy", np.stack([each.values for each in moving]))
    response = nuc.fit(levels, order=1)
    response.save(folder / "response.npz")
    flat = equipix.Polynomial(np.stack([np.zeros((48, 64)), np.ones((48, 64))]), response.flags)
    flat.save(folder / "flat.npz")
    written_experiment(folder / "again", (48, 64), SHIFTS, exposure_e=12_000.0)
    for name, place in (("cal", folder), ("cal2", folder / "again")):
        experiment = equipix.Experiment.load(place / "experiment/experiment.toml")
        experiment.run(tolerance=1e-3).save(folder / f"{name}.npz")
    radius = np.hypot(*np.indices((48, 64)) - np.array([23.5, 31.5])[:, None, None])
    np.save(folder / "lens.npy", 1e4 / (1 + (radius / 100) ** 2) ** 2)
    return folder


def check(inputs: Path, folder: Path, name: str, count: int) -> None:
    """Kill a command that replaces outputs of before."""
    out = folder / "out"
    out.mkdir()
    given = [
        each.replace("IN/", f"{inputs}/").replace("OUT/", f"{out}/")
        for each in shlex.split(GIVEN[name])
    ]
    given = [str(inputs) if each == "IN" else each for each in given]
    first, second = (name.split() + [""])[:2]
    full = [first, *([second] if first == "nuc" else []), *given]
    if first in ("simulate", "demo"):
        simulate.experiment(
            np.ones((48, 64)), simulate.gaussian_beam((48, 64)), SHIFTS[:2], frames=2, rng=2
        ).write(out / "experiment")
    if second == "folder" or first == "batch":
        (out / "results").mkdir()
        name_of_old = "lot-levels" if first == "batch" else "frames"
        (out / f"results/{name_of_old}.tif").write_bytes(b"the old one")
        (out / "results/other").write_bytes(b"of another program")
    elif second == "zarr":
        (out / "a.zarr").mkdir()
        (out / "a.zarr/zarr.json").write_bytes(b"the old one")
    elif second != "new" and first != "simulate":
        (out / given[-1].rpartition("/")[2]).write_bytes(b"the old one")
    forced = [] if first == "batch" or second == "new" else ["--force"]

    def work() -> None:
        # In this process, as a worker does it: a cluster would be killed by itself.
        import_module("equipix.batch.evaluation").time = SimpleNamespace(monotonic=lambda: 0.0)
        module = import_module("equipix.batch.run")
        module.finished = lambda _, tasks, *__: ((each, evaluate(each.job)) for each in tasks)
        cli.main([*full, *forced])

    told = killed(work, out, count, by_file=name in SEVERAL)
    assert told["torn"] == []
    assert told["killed"] >= count // 2, told
    print(name, told)


def test_every_command_that_writes_is_killed() -> None:
    writing = {
        f"{name} {each}".strip() if each != name else name
        for name in COMMANDS
        for each, inner in (
            getattr(command(name), "commands", None) or {name: command(name)}
        ).items()
        if any("--output" in parameter.opts for parameter in inner.params)
    }
    killed_ones = {n if n.startswith("nuc ") else n.split()[0] for n in GIVEN} - {"convert"}
    assert writing == killed_ones


@pytest.mark.parametrize("name", GIVEN)
def test_a_command_killed_a_few_times(inputs: Path, tmp_path: Path, name: str) -> None:
    check(inputs, tmp_path, name, IN_SHORT)


@pytest.mark.long
@pytest.mark.parametrize("name", GIVEN)
def test_a_killed_command_leaves_the_old_or_the_new(
    inputs: Path, tmp_path: Path, name: str, request: pytest.FixtureRequest
) -> None:
    check(inputs, tmp_path, name, taken(KILLS, request.config.option.study_share))


@pytest.mark.long
def test_the_killed_writer_leaves_the_old_or_the_new(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "a.bin").write_bytes(b"the old one")

    def work() -> None:
        with write_whole(out / "a.bin", force=True) as temporary, temporary.open("wb") as file:
            for number in range(64):
                file.write(bytes([number]) * 2**14)

    count = taken(OF_WRITER, request.config.option.study_share)
    told = killed(work, out, count, by_file=False)
    assert told["torn"] == [], told
    assert told["killed"] >= count // 2
    print(told)

"""Memory that cannot be had: an error that names the bytes, before the work starts."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest

import equipix
from equipix import cli
from equipix.errors import EquipixError, InsufficientMemoryError
from equipix.io.frames import frame_format
from equipix.io.tiff import write_frames

CROSS = equipix.cross_pattern(2, 3)

LIMIT = """
import os, re, resource, sys
import numpy as np
def limit(extra):
    np.ones((200, 200)) @ np.ones((200, 200))
    used = 1024 * int(re.search(r"VmSize:\\s+(\\d+)", open("/proc/self/status").read())[1])
    resource.setrlimit(resource.RLIMIT_AS, (used + extra, used + extra))
"""
"""Leaves a process `extra` bytes of address space beyond what it has.

OpenBLAS takes 32 MB of buffers at the first product that needs them, and would end the process
without them. Which one that is depends on the processor: where AVX-512 is, products of up to a
million multiplications need none. So it has taken them before.
"""


def run(code, *arguments):
    """Run code in a process whose threads share one heap: each else reserves 64 MiB for its own."""
    command = [sys.executable, "-c", LIMIT + code, *map(str, arguments)]
    env = os.environ | {"MALLOC_ARENA_MAX": "1"}
    return subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False, env=env
    )


class TestArraysThatNoMachineHolds:
    """Of more bytes than a process can address, so nothing depends on the machine."""

    @pytest.mark.parametrize("dtype", [np.float32, np.uint8])
    def test_calibrate(self, dtype):
        frames = np.broadcast_to(dtype(1), (5, 2**20, 2**29))
        with pytest.raises(InsufficientMemoryError, match=r"calibrating: .* PiB") as caught:
            equipix.calibrate(frames, CROSS)
        assert isinstance(caught.value, EquipixError)
        assert isinstance(caught.value, MemoryError)

    def test_calibrate_variance(self):
        variance = np.broadcast_to(1.0, (5, 2**20, 2**29))
        with pytest.raises(InsufficientMemoryError, match=r"calibrating: .* PiB"):
            equipix.calibrate(np.ones((5, 8, 9)), CROSS, variance=variance)

    def test_response_curves(self):
        levels = np.broadcast_to(np.uint8(1), (2, 2**20, 2**29))
        with pytest.raises(InsufficientMemoryError, match=r"fitting response curves: .* PiB"):
            equipix.nuc.fit(levels)

    @pytest.mark.parametrize("dtype", [np.uint8, np.float64])
    @pytest.mark.parametrize(
        ("work", "named"),
        [
            (lambda response, raw: response.correct(raw), "correcting"),
            (lambda response, raw: response.correct(raw, exact=True), "correcting"),
            (lambda response, raw: response.extrapolated(raw), "finding extrapolated values"),
        ],
    )
    def test_frames_of_a_response(self, dtype, work, named):
        response = equipix.nuc.fit(np.arange(2.0 * 8 * 9).reshape(2, 8, 9))
        raw = np.broadcast_to(dtype(1), (2**52, 8, 9))
        with pytest.raises(InsufficientMemoryError, match=f"{named}: .* (P|E)iB"):
            work(response, raw)

    def test_a_dark_of_the_caller(self, monkeypatch):
        """NumPy's own error, wherever it comes from."""

        def refuse(*_):
            raise MemoryError("no 8 bytes")

        response = equipix.nuc.fit(np.arange(2.0 * 8 * 9).reshape(2, 8, 9))
        monkeypatch.setattr("equipix.correction.protocol._dark_frame", refuse)
        for work, named in ((response.correct, "correcting"), (response.extrapolated, "finding")):
            with pytest.raises(InsufficientMemoryError, match=f"{named}.*: no 8 bytes"):
                work(np.ones((8, 9)), dark=np.ones((8, 9)))

    def test_a_plan(self, monkeypatch):
        def refuse(*_, **__):
            raise MemoryError("no 8 bytes")

        monkeypatch.setattr("equipix.measured.measured.as_floats", refuse)
        with pytest.raises(InsufficientMemoryError, match=r"planning.*: no 8 bytes"):
            equipix.plan.error_budget((64, 64), equipix.cross_pattern(3, 4), noise=1e-3)

    @pytest.mark.parametrize("shape", [(2, 2**25, 2**25), (2, 2**31, 2**29)])
    def test_average(self, shape):
        words = r"averaging frames of .* needs .* \(\d{17,} bytes\) .* are available: "
        with pytest.raises(InsufficientMemoryError, match=words):
            equipix.average(np.broadcast_to(np.uint8(1), shape))


RESPONSE = """
import equipix
from equipix.nuc.levels import levels_of
levels = levels_of(np.random.default_rng(0).uniform(1, 2, (2, 1500, 1500)) * [[[1]], [[9]]])
levels.fit(1, "offset", workers=1)
limit(100 * 10**6)
try:
    levels.fit(1, "offset", workers=1)
except equipix.errors.InsufficientMemoryError as error:
    print(error)
"""


def test_response_curves_count_their_bytes():
    said = run(RESPONSE)
    assert "fitting response curves of (1500, 1500) needs" in said.stdout
    # 44 bytes for the planes of a pixel, 80 for its polynomial in 64 rows, and the 64 MiB.
    needed = 44 * 1500**2 + 80 * 64 * 1500 + 2**26
    assert f"({needed} bytes)" in said.stdout, said.stdout + said.stderr


CHILDREN = """
import json, equipix, warnings
warnings.simplefilter("ignore")
frames = np.random.default_rng(0).uniform(1, 2, (5, 1500, 1500)).astype(np.float32)
def peak():
    return 1024 * int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1])
def calibrate(megabytes, shifts, options):
    \"\"\"By how much a child of this process grows that has so many megabytes, or its error.\"\"\"
    read, write = os.pipe()
    if child := os.fork():
        os.close(write)
        with open(read) as answer:
            said = answer.read()
        return said if os.waitpid(child, 0)[1] == 0 else "died"
    if options.pop("uneven"):
        options["variance"] = 1 + frames
    limit(megabytes * 10**6)
    before = peak()
    try:
        equipix.calibrate(frames, shifts, max_sweeps=9, workers=2, **options)
        answer = str(peak() - before)
    except equipix.errors.InsufficientMemoryError as error:
        answer = str(error)
    os.write(write, answer.encode())
    os._exit(0)
limits, shifts, options = json.loads(sys.argv[1])
print(json.dumps([calibrate(megabytes, shifts, dict(options)) for megabytes in limits]))
"""


def calibrations(limits, shifts=CROSS, *, uneven=False, **options):
    given = [limits, shifts.tolist(), {"uneven": uneven, **options}]
    return json.loads(run(CHILDREN, json.dumps(given)).stdout)


@pytest.mark.long
@pytest.mark.parametrize("turn", [0, 90])
def test_the_bytes_named_are_those_it_takes(turn):
    """All that is counted is used, and the allocator's share covers what is not."""
    allocator = 2**26
    refused, grown = calibrations([60, 2000], rotation=[0, 0, 0, 0, turn])
    words = r"calibrating 5 exposures of \(1500, 1500\) needs (.*) MB \((\d+) bytes\) beside its"
    short, needed = re.match(words, refused).groups()
    assert float(short) == pytest.approx(int(needed) / 1e6, abs=0.05)
    assert int(needed) - allocator <= int(grown) <= int(needed)


@pytest.mark.long
@pytest.mark.parametrize(
    "sought",
    [
        {},
        {"uneven": True},
        {"flux": "fit"},
        {"shift_std": 0.05},
        {"rotation": [0, 0, 0, 0, 90]},
        {"rotation": [90] * 5, "shift_std": 0.05},
    ],
)
def test_a_joint_fit_takes_no_more_bytes_than_it_names(sought):
    refused, grown = calibrations([60, 4000], CROSS + 0.3 * (CROSS > 0), **sought)
    words = r"fitting 5 exposures of \(1500, 1500\) jointly needs .* MB \((\d+) bytes\) beside its"
    assert int(grown) <= int(re.match(words, refused)[1])


@pytest.mark.long
def test_a_process_is_refused_or_finishes_whatever_its_limit():
    """Nobody dies of too few bytes in between."""
    answers = calibrations([*range(60, 320, 20)])
    assert "needs" in answers[0]
    assert answers[-1].isdigit()
    assert "died" not in answers


def test_the_command_says_so_in_one_line_and_leaves_the_disk_alone(tmp_path):
    lines = ['[dark]\nframes = "dark.tif"']
    write_frames(tmp_path / "dark.tif", np.zeros((2, 800, 800), np.uint16), nbytes=0)
    for k, shift in enumerate(CROSS.tolist()):
        frames = np.full((2, 800, 800), k + 1, np.uint16)
        write_frames(tmp_path / f"{k}.tif", frames, nbytes=0)
        lines.append(f'[[exposure]]\nname = "{k}"\nframes = "{k}.tif"\nshift = {shift}')
    experiment = tmp_path / "experiment.toml"
    experiment.write_text("\n".join(lines))
    before = sorted(tmp_path.rglob("*"))
    # The limit counts from a process that has loaded what the command imports.
    command = (
        "from equipix import cli; import equipix.cli.calibrate; limit(60 * 10**6); "
        "cli.main(sys.argv[1:])"
    )
    done = run(command, "calibrate", experiment, "-o", tmp_path / "cal.tif", "--workers", 2)
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(
        r"equipix: error: .* needs .* \(\d+ bytes\) .* raise the limit.*\n", done.stderr
    )
    assert sorted(tmp_path.rglob("*")) == before


def test_a_small_job_runs_beside_a_low_limit():
    code = f"""
import equipix
limit(40 * 10**6)
frames = np.random.default_rng(0).uniform(1, 2, (5, 40, 50))
equipix.calibrate(frames, {CROSS.tolist()}, tolerance=1e-3, workers=1)
"""
    done = run(code)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.long
@pytest.mark.parametrize(
    ("options", "stacks", "masks", "images"),
    [
        ({"variance": equipix.NoiseModel(1e-3, 1e-9)}, 2, 0, 6),
        ({"robust": True}, 2, 3, 11),
        ({"variance": equipix.NoiseModel(1e-3, 1e-9), "robust": True}, 3, 3, 12),
    ],
    ids=["noise model", "robust", "both"],
)
def test_numpy_takes_little_beside_the_data(options, stacks, masks, images):
    """Weights that depend on the fit take a few arrays of the data's size, the rest one by one.

    Beside the data there are at the peak `stacks` of its size and dtype, `masks` of its size, and
    `images` of one exposure in float64:

    - noise model: variances at the medians and at the first fit; the medians, and of one exposure
      light, c times light, signal, signal or median, variance.
    - robust: deviations of values used and left out; masks of values given, without dust, left
      out; response, information of pixels and cells, and of one exposure light, weight, squares of
      either, two shares, spread, residual.
    - both: those of robust, the variances, and the medians.

    Images of bool are together below one image in float64.
    """
    shape, shifts = (960, 1200), equipix.cross_pattern(5, 7)
    beam = equipix.simulate.gaussian_beam(shape)
    frames = equipix.simulate.exposures(np.ones(shape), beam, shifts)
    frames += 1e-3 * np.random.default_rng(1).standard_normal(frames.shape)
    frames = frames.astype(np.float32)
    tracemalloc.start()
    try:
        equipix.calibrate(frames, shifts, tolerance=1e-2, **options)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    ceiling = stacks * frames.nbytes + masks * frames.size + images * 8 * frames[0].size
    assert peak < ceiling


def write_files(folder, shape):
    """Write 800 frames of 16 bits to eight files, since a small file is read at once."""
    frames = np.random.default_rng(1).integers(100, 200, (100, *shape), dtype=np.uint16)
    paths = [folder / f"raw{number}.tif" for number in range(8)]
    for path in paths:
        write_frames(path, frames, nbytes=frames.nbytes)
    return paths


NUC = """
from equipix import cli
from equipix.cli.app import command
command("nuc")
import equipix.io.record
limit(int(sys.argv[1]) * 10**6)
cli.main(["nuc", *sys.argv[2:]])
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "work"), [("quality", "measuring quality"), ("defects", "finding bad pixels")]
)
def test_commands_on_frames_of_one_level_name_it(tmp_path, command, work):
    """Where reading the response, of 46 MB, leaves too little; a step in it may name itself."""
    shape = (600, 800)
    response = equipix.nuc.fit(np.ones((2, *shape)) * [[[100.0]], [[200.0]]])
    response.save(tmp_path / "response.npz")
    frames = np.random.default_rng(1).integers(100, 200, (2, *shape), dtype=np.uint16)
    write_frames(tmp_path / "raw.tif", frames, nbytes=frames.nbytes)
    arguments = command, tmp_path / "response.npz", tmp_path / "raw.tif"
    said = [run(NUC, limit, *arguments) for limit in (80, 90, 100)]
    refused = [each.stderr for each in said if each.returncode == 1]
    assert len(refused) == sum(each.returncode != 0 for each in said)
    assert all(re.fullmatch(r"equipix: error: .*\n", each) for each in refused), refused
    assert any(each.startswith(f"equipix: error: {work}: ") for each in refused), refused


def peak_of(arguments):
    """Most memory that a command asks NumPy for."""
    tracemalloc.start()
    try:
        with pytest.raises(SystemExit, match="0"):
            cli.main([*map(str, arguments)])
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.long
@pytest.mark.parametrize("command", ["quality", "defects"])
@pytest.mark.parametrize("filters", [[], ["--cfa", "RGGB"]], ids=["plain", "colours"])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
@pytest.mark.usefixtures("hashing_by_one_thread")
def test_memory_does_not_grow_with_the_frames_of_a_level(tmp_path, command, filters, dtype):
    """Eight times as many files take less than one more frame."""
    shape = (200, 300)
    response = equipix.nuc.fit(np.ones((2, *shape)) * [[[100.0]], [[200.0]]])
    response.save(tmp_path / "response.npz")
    rng = np.random.default_rng(1)
    for number in range(32):
        frames = np.rint(rng.normal(150, 3, (2, *shape))).astype(dtype)
        write_frames(tmp_path / f"raw{number:02}.tif", frames, nbytes=frames.nbytes)
    start = ["nuc", command, tmp_path / "response.npz", *filters]
    peak_of([*start, tmp_path / "raw00.tif", tmp_path / "raw01.tif"])  # what is imported once
    few, many = (
        peak_of([*start, *sorted(tmp_path.glob(f"raw{each}*.tif"))]) for each in ("00", "")
    )
    assert many - few < frames[0].nbytes + 2**17  # and the names of the files


@pytest.mark.long
def test_memory_of_levels_is_that_of_their_means(tmp_path):
    """Each level more is a mean and a variance, of 8 and 4 bytes; nothing else grows with it."""
    shape, peaks = (300, 400), {}
    rng = np.random.default_rng(1)
    for count in (2, 2, 10):
        lines = []
        for number in range(count):
            frames = rng.normal(100 * (number + 1), 3, (3, *shape))
            frames = np.rint(frames).astype(np.uint16)
            write_frames(tmp_path / f"{number}.tif", frames, nbytes=frames.nbytes)
            lines.append(f'[[level]]\nframes = "{number}.tif"')
        (tmp_path / "levels.toml").write_text("\n".join(lines))
        output = tmp_path / "response.npz"
        peaks[count] = peak_of(["nuc", "fit", tmp_path / "levels.toml", "-o", output, "--force"])
    pixels = shape[0] * shape[1]
    # Raw levels are counted from the lowest, in a stack of as many more bytes.
    assert peaks[10] - peaks[2] < 8 * (8 + 4 + 8) * pixels + 2 * pixels


@pytest.mark.long
def test_the_cost_of_words_holds_one_level(tmp_path):
    """Beside its corrected frames: of another level not even half of the raw frames are held."""
    shape = (150, 200)
    equipix.nuc.fit(np.ones((2, *shape)) * [[[100.0]], [[900.0]]]).save(tmp_path / "r.npz")
    names = []
    for number in range(2):
        frames = np.random.default_rng(number).normal(300 + 200 * number, 3, (24, *shape))
        raw = np.rint(frames).astype(np.uint16)
        names.append(str(tmp_path / f"level{number}.tif"))
        write_frames(names[-1], raw, nbytes=raw.nbytes)

    def peak(names):
        command = ["hardware", str(tmp_path / "r.npz"), "-o", str(tmp_path / "t.bin"), "--force"]
        tracemalloc.start()
        try:
            with pytest.raises(SystemExit, match="0"):
                cli.main([*command, *(f"--frames={name}" for name in names)])
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(names[:1])  # imports
    assert peak(names) < peak(names[:1]) + raw.nbytes / 2


@pytest.mark.parametrize("dark", [None, 5.0], ids=["no dark", "dark"])
def test_coefficients_are_made_in_the_precision_of_the_frames(dark):
    """Of 4 bytes, beside one map or two of 8: all coefficients of 8 bytes took 8 maps of 4."""
    shape = (200, 300)
    truth = equipix.simulate.paper_sensitivity(shape, rng=1)
    frames = equipix.simulate.exposures(truth, equipix.simulate.gaussian_beam(shape), CROSS)
    cal = equipix.calibrate(frames, CROSS, tolerance=1e-2)
    frame, offset = frames[0].astype(np.float32), None if dark is None else np.full(shape, dark)
    out = np.empty_like(frame)
    tracemalloc.start()
    try:
        cal.correct(frame, dark=offset, out=out)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < (5 if dark is None else 7) * frame.nbytes


CORRECT = """
from equipix import cli
from equipix.cli.app import command
command("correct")
import equipix.io.tiff
limit(140 * 10**6)
cli.main(["correct", *sys.argv[1:], "--workers", "1"])
"""


def test_files_are_corrected_in_constant_memory(tmp_path):
    shape = (250, 250)
    planes = np.stack([np.full(shape, -5.0), np.ones(shape)])
    equipix.Polynomial(planes, np.zeros(shape, np.uint32)).save(tmp_path / "correction.tif")
    output = tmp_path / "out.tif"
    # 100 MB of frames, and 200 MB of corrected ones; reading asks for 64 MiB of the allocator's.
    source = write_files(tmp_path, shape)
    said = run(CORRECT, tmp_path / "correction.tif", *source, "-o", output)
    assert said.returncode == 0, said.stderr
    assert frame_format(output)[0] == (800, *shape)


@pytest.mark.parametrize("layout", ["Mono12p", "Mono16"])
def test_bare_frames_are_averaged_in_constant_memory(tmp_path, layout):
    """One frame is unpacked at a time: 60 MB of packed frames of 300 kB take less than 10 MB."""
    packed = np.random.default_rng(1).integers(0, 15, 300_000, dtype=np.uint8).tobytes()
    with (tmp_path / "a.raw").open("wb") as file:
        for _ in range(200):
            file.write(packed)
    shape = "400x500" if layout == "Mono12p" else "300x500"
    tracemalloc.start()
    try:
        found = equipix.average(f"{tmp_path}/a.raw:{shape}:{layout}", saturation=4095)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert found.count.max() == 200
    # Sixteen frames of 16 bits in a batch, and the six maps of the result.
    assert peak < (16 * 2 + 6 * 8 + 8) * found.mean.size

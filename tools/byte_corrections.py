"""Cases of all results but those of shift calibrations, for `byte_cases.py`.

Inputs are made with NumPy from fixed seeds. A case gives results of any kind, of which
`same_bytes.collected` makes arrays. Of what is written to a file, what is read back is compared.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile

import equipix
from byte_scenes import Scene, given_experiment
from equipix import bolometer, hardware, lens, metrics, nuc, scene, simulate

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

SHAPE = (24, 32)
LIGHT = np.linspace(1000.0, 12000.0, 6)
"""Levels of a uniform source, in DN."""

FLAGGED: Any = ("nan", "keep", "replace")
OUT = ("uint8", "uint16", "float32", "float64")
"""Types of corrected frames."""


def raw_frames(light: float, count: int = 16, seed: int = 1) -> Any:
    """Frames of 14 bits of an even source, with a bad pixel of each kind."""
    pixels, rng = np.random.default_rng(11), np.random.default_rng(seed)
    maps = pixels.standard_normal((3, *SHAPE))
    offset, slope, bend = 300 + 30 * maps[0], 1 + 0.03 * maps[1], 3e-6 * (1 + 0.1 * maps[2])
    slope[3, 4], slope[9, 9], slope[15, 20] = 0.0, 0.4, 2.5
    offset[20, 13], bend[18, 2] = 9000.0, 2e-5
    noise = np.sqrt(4.0 + 0.2 * light) * rng.standard_normal((count, *SHAPE))
    noise[:, 12, 25] *= 3
    noise[:, 17, 7] += 300 * (np.cumsum(rng.random(count) < 0.1) % 2)
    signal = offset + slope * light * (1 - bend * light)
    return np.clip(np.rint(signal + noise), 0, 16383).astype(np.uint16)


FRAMES = raw_frames(6000.0, 3, seed=7)
DARK = np.full(SHAPE, 310.0)


def means() -> Any:
    """Mean frames of the levels, as arrays."""
    return np.array([raw_frames(each, seed=k).mean(axis=0) for k, each in enumerate(LIGHT)])


def averages(light: Iterable[float] = LIGHT, *, dark: bool = False) -> list[Any]:
    """Averages of the frames of levels."""
    known = equipix.average(raw_frames(0.0, 32, seed=90), saturation=16383.0) if dark else None
    options: dict[str, Any] = {"saturation": 16383.0, "dark": known}
    return [equipix.average(raw_frames(each, seed=k), **options) for k, each in enumerate(light)]


def write(name: str, frames: Any) -> None:
    """Write frames to a TIFF, without the package."""
    tifffile.imwrite(name, frames, photometric="minisblack")


def mask(shape: tuple[int, ...] = SHAPE) -> NDArray[Any]:
    """Mask of some pixels or measurements at random."""
    return np.random.default_rng(3).random(shape) < 0.05


def reread(found: Any, *more: str) -> dict[str, Any]:
    """A result as read from the files that it was written to."""
    for suffix in more or (".tif", ".npz"):
        found.save(f"saved{suffix}", force=True)
    return {suffix: equipix.load(f"saved{suffix}") for suffix in more or (".tif", ".npz")}


def corrected(correction: Any, frames: Any, types: Any = OUT, **options: Any) -> dict[str, Any]:
    """Frames corrected by the correction's own method, in all ways and types."""
    found = {
        f"{dtype} {way}": correction.correct(frames.astype(dtype), flagged=way, **options)
        for dtype in ("uint16", "int32", "float32", "float64")
        for way in FLAGGED
    }
    for dtype in types:
        out = np.zeros(frames.shape, dtype)
        found[f"to {dtype}"] = correction.correct(frames, flagged="replace", out=out, **options)
    return found | {"single": correction.correct(frames[1], **options)}


def response(levels: Any = None, **options: Any) -> dict[str, Any]:
    """The response to levels, and what it makes of frames."""
    found = nuc.fit(averages() if levels is None else levels, **options)
    return {
        "": found,
        "corrected": found.correct(FRAMES),
        "exact": found.correct(FRAMES, exact=True, flagged="replace"),
        "extrapolated": found.extrapolated(FRAMES),
    }


def flagged_response(order: Any = 1, **options: Any) -> Any:
    """A response with the flags of its bad pixels."""
    found = nuc.fit(averages(**options), order=order)
    return found.with_flags(nuc.find_defects(found, raw_frames(6000.0, 100, seed=50)).flags)


def defects(frames: Any = None, levels: Any = None, **options: Any) -> Any:
    """Bad pixels of a response."""
    fitted = nuc.fit(averages() if levels is None else levels, order=2)
    return {"": nuc.find_defects(fitted, frames, **options)}


def applied_response() -> Any:
    """Frames corrected by responses, with the dark stored, given or subtracted."""
    raw, less = flagged_response(2), flagged_response(2, dark=True)
    return {
        "cubic": corrected(raw, FRAMES),
        "exact": corrected(raw, FRAMES, OUT[2:], exact=True),
        "stored": corrected(less, FRAMES),
        "given": corrected(less, FRAMES, dark=DARK),
        "without": corrected(less, FRAMES - np.uint16(200), dark=None),
        "files": reread(less),
    }


def level_files(keys: str = "", *, dark: bool = True, **options: Any) -> Any:
    """The response to levels in files."""
    lines = [f"[sensor]\nbit_depth = 14\n{keys}"]
    for number, light in enumerate((0.0, *LIGHT)):
        write(f"level{number}.tif", raw_frames(light, seed=number))
        if dark or number:
            lines.append("[[level]]" if number else "[dark]")
            lines.append(f'frames = "level{number}.tif"')
    Path("levels.toml").write_text("\n".join(lines))
    return {"": equipix.LevelExperiment.load("levels.toml").run(**options)}


def camera_files(keys: str = "") -> Any:
    """Figures of a camera by levels in files."""
    lines = [f"[sensor]\nbit_depth = 14\n{keys}"]
    for number, light in enumerate(LIGHT):
        for name, frames in (("on", raw_frames(light, 2, number)), ("off", raw_frames(0, 2, 50))):
            write(f"{name}{number}.tif", frames)
        lines.append(f'[[exposure]]\nframes = "on{number}.tif"\ndark = "off{number}.tif"')
        lines.append(f"photons = {8 * light}\nexposure_s = {light / 1e5}")
    for name, light in (("half", 6000.0), ("dark", 0.0)):
        write(f"{name}.tif", raw_frames(light, 16, seed=60))
    lines.append('[spatial]\nframes = "half.tif"\ndark = "dark.tif"')
    Path("camera.toml").write_text("\n".join(lines))
    return equipix.CameraExperiment.load("camera.toml").figures()


STATES = np.array([(t, v) for t in np.linspace(-20.0, 60.0, 6) for v in (1.95, 2.05)])
"""Temperatures and biases of a bolometer array."""


def bolometer_frames(hotter: float) -> Any:
    """Frames of a bolometer array at each state; `hotter` is the signal of a black body in DN."""
    maps, rng = np.random.default_rng(30).standard_normal((5, *SHAPE)), np.random.default_rng(31)
    celsius, volts = (each[:, None, None] for each in STATES.T / 50)
    drift = 900 * celsius * maps[0] + 300 * celsius**2 * maps[1] + 90 * celsius**3 * maps[2]
    slope = 1 + 0.05 * maps[3] + 0.02 * celsius * maps[4]
    slope[:, 5, 6] = 0.1
    signal = 30000 + 800 * maps[4] + drift + 3e5 * maps[0] * volts**2 + hotter * slope
    noise = 3 * rng.standard_normal((4, *signal.shape))
    return np.rint(signal + noise).astype(np.uint16).swapaxes(0, 1)


def dynamic(*, bodies: bool = True, averaged: bool = False, **options: Any) -> Any:
    """A correction that follows temperature and bias, at two states and read from files."""
    stacks = [bolometer_frames(hotter) for hotter in (0, 2000, 6000)]
    shutter, *others = (
        [*map(equipix.average, stack)] if averaged else stack.mean(axis=1) for stack in stacks
    )
    options["black_bodies"] = tuple(others) if bodies else None
    found = bolometer.fit(shutter, *STATES.T, **options)
    inside = found.correction(14.5, 2.0)
    return {
        "": found,
        "inside": inside,
        "outside": found.correction(70.0, 2.0, extrapolate=True),
        "corrected": corrected(inside, np.array([stack[4, 0] for stack in stacks])),
        "files": reread(found),
    }


def bolometer_array() -> Any:
    """A simulated array, and the non-uniformity of its frames."""
    array = simulate.BolometerArray.of(SHAPE, rng=5)
    frames = [*array.frames(20.0, 2, rng=6, scene_c=40.0, bias_v=1.9)]
    span = array.output_span([-20.0, 60.0], [-20.0, 100.0])
    return {
        "": array,
        "frames": frames,
        "mean": array.mean(10.0, scene_c=30.0, bias_v=2.1),
        "changed": array.with_properties(b_k=1900.0).mean(10.0),
        "temperature": array.temperature(10.0, scene_c=30.0),
        "noise": array.temporal_noise(10.0),
        "johnson": array.johnson_v(10.0),
        "span": span,
        "non_uniformity": metrics.non_uniformity(frames, span),
    }


def moving_frames(count: int = 120) -> Any:
    """Raw frames of 14 bits of a moving scene, with dead and hot pixels, a stop and a shutter."""
    rng = np.random.default_rng(21)
    waves = [(*rng.uniform(-0.5, 0.5, 2), *rng.uniform(0, 6, 2)) for _ in range(24)]
    offset, slope = 300 * rng.standard_normal(SHAPE), 1 + 0.05 * rng.standard_normal(SHAPE)
    slope[5, 6] = slope[14, 22] = 0.0
    rows, cols = np.indices(SHAPE)
    light = np.zeros((count, *SHAPE))
    for k in range(count):
        step = min(k, 40) + max(k - 50, 0)
        u, v = rows + 1.3 * step, cols + 0.9 * step + 3 * np.sin(step / 9)
        light[k] = sum(np.cos(a * u + b * v + c) * (1 + d) for a, b, c, d in waves)
    light[70:71] = 0.0
    raw = 6000 + offset + slope * 90 * light + 12 * rng.standard_normal(light.shape)
    raw[:, 20, 3] = 16383.0
    return np.rint(raw).clip(0, 16383).astype(np.uint16)


def learned(kind: Any, dtype: str = "uint16", **options: Any) -> Any:
    """What a method learns from a moving scene; also if its state is saved on the way."""
    frames = moving_frames().astype(dtype)
    method = kind(SHAPE, (0.0, 16383.0), saturation=16383.0, **options)
    seen = [method.update(frame) for frame in frames[:60]]
    resumed = reread(method)
    seen += [method.update(frame) for frame in frames[60:]]
    for other in resumed.values():
        for frame in frames[60:]:
            other.update(frame)
    return {"": method, "result": method.correction(), "seen": seen[::17], "resumed": resumed}


def flat_frame(size: int = 2) -> tuple[Any, Any]:
    """A frame of an even scene through a lens, and the sensitivity of the sensor."""
    rows, cols = np.ogrid[: size * SHAPE[0], : size * SHAPE[1]]
    squared = (rows / size - 13.0) ** 2 + (cols / size - 14.5) ** 2
    sensitivity = 1 + 0.01 * np.random.default_rng(41).standard_normal(squared.shape)
    return 4000 / (1 + squared / 45.0**2) ** 2 * sensitivity, sensitivity


def falloff(flat: Any = None, **options: Any) -> Any:
    """The fall-off of a lens, and frames without it."""
    flat = flat_frame()[0] if flat is None else flat
    found = lens.fit(flat, **options)
    correction = found.correction()
    return {
        "": found,
        "illumination": found.illumination(),
        "correction": correction,
        "corrected": corrected(correction, np.array([flat, flat / 2]), OUT[2:]),
        "files": reread(correction),
        "cos4": lens.cos4(np.arange(9.0), 3.0),
    }


def polynomial(planes: int) -> Any:
    """A correction of given coefficients and flags."""
    typical = np.array([-20.0, 1.0, 2e-6, -3e-11])[:planes, None, None]
    flags = np.where(mask(), np.uint32(equipix.Flag.DO_NOT_USE), np.uint32(0))
    flags[10:13, 20:24] = equipix.Flag.DO_NOT_USE | equipix.Flag.DEAD
    scatter = np.random.default_rng(51).uniform(0.7, 1.3, (planes, *SHAPE))
    return equipix.Polynomial(typical * scatter, flags)


def combined() -> Any:
    """Pairs of corrections, each as one."""
    raw, less = nuc.fit(averages(), order=2), nuc.fit(averages(dark=True), order=3)
    again = nuc.fit(raw.correct(means(), flagged="keep"), order=1)
    own = Scene(shape=SHAPE, contrast=0.1).fit()
    fall = lens.fit(flat_frame(1)[0]).correction()
    method = scene.LocalMean(SHAPE, (0.0, 16383.0))
    for frame in moving_frames(40):
        method.update(frame)
    pairs = {
        "response response": (raw, again),
        "response lens": (less, fall),
        "response calibration": (less, own),
        "lens calibration": (fall, own),
        "calibration polynomial": (own, polynomial(2)),
        "polynomial lens": (polynomial(4), fall),
        "scene polynomial": (method.correction(), polynomial(2)),
    }
    found = {name: equipix.combine(*pair) for name, pair in pairs.items()}
    return found | {
        "corrected": corrected(found["response response"], FRAMES),
        "files": {name: reread(each) for name, each in found.items()},
    }


def correctors(correction: Any, raw: Any, bits: int = 16, **options: Any) -> Any:
    """Frames corrected by prepared corrections of all types, and the counts of each."""
    found: dict[str, Any] = {}
    for dtype in OUT[:3]:
        options["bit_depth"] = bits if dtype == "uint16" else None
        for way in (None, *FLAGGED[dtype != "float32" :]):
            corrector = equipix.Corrector(correction, dtype, flagged=way, **options)
            results = [corrector.apply(raw, np.zeros(raw.shape, dtype)), corrector.apply(raw[1])]
            counts = [corrector.clipped, corrector.extrapolated, corrector.frames]
            found[f"{dtype} {way}"] = results, counts, corrector.replaced
    return found


def prepared() -> Any:
    """Prepared corrections of 2 to 4 coefficients, of frames of all types."""
    wide = np.random.default_rng(52).integers(0, 65536, (3, *SHAPE)).astype(np.uint16)
    raw = {"uint8": wide.astype(np.uint8), "uint16": wide, "float32": wide.astype(np.float32) / 3}
    return {
        f"{planes} of {dtype}": correctors(polynomial(planes), frames)
        for planes in (2, 3, 4)
        for dtype, frames in raw.items()
    }


def prepared_results() -> Any:
    """Prepared corrections of a response and of calibrations, with their darks and others."""
    less, low = flagged_response(3, dark=True), Scene(shape=SHAPE, contrast=0.1)
    levels = Scene(shape=SHAPE, contrast=0.1, flux=(1.0, 0.5, 1.0, 0.5, 1.0))
    own = levels.fit(1000 * levels.frames + 60, flux=levels.flux, dark="fit")
    seen = np.random.default_rng(53).integers(60, 1000, FRAMES.shape).astype(np.uint16)
    return {
        "response": correctors(less, FRAMES, 14),
        "given": correctors(less, FRAMES, dark=DARK),
        "calibration": correctors(own, seen, 10),
        "average": correctors(own, seen, dark=equipix.average([seen[0] // 9, seen[0] // 8])),
        "subtracted": correctors(low.fit(), seen, dark=None),
        "own": corrected(own, seen),
    }


def table_of(table: Any) -> Any:
    """The words of a table, what it makes of frames, and the same from files."""
    words = table.digitise(FRAMES)
    return {
        "": table,
        "words": [words, *table.applied(words)],
        "corrected": [table.correct(FRAMES, flagged=way) for way in FLAGGED],
        "files": reread(table, ".bin", ".hex", ".h"),
    }


def costs() -> Any:
    """Quality of a table, and the smallest widths of its memories."""
    found = flagged_response()
    frames = [raw_frames(light, seed=62) for light in LIGHT[1:5:3]]
    return {
        "quality": hardware.quality(found, frames[0], offset_bits=8, gain_bits=9),
        "widths": hardware.smallest_widths(found, frames, added=0.2),
    }


def adaptive(bits: int = 14, **options: Any) -> Any:
    """Memories that follow a scene."""
    loop = hardware.AdaptiveLoop(SHAPE, adc_bits=bits, **options)
    frames = moving_frames() >> (14 - bits)
    seen = [loop.update(frames[:60]), *(loop.update(frame) for frame in frames[60::9])]
    return {"seen": seen, "words": [loop.gain, loop.offset], "result": loop.correction()}


def command(*words: str) -> None:
    """Run the command line; what it prints is not compared."""
    line = [sys.executable, "-m", "equipix", *words]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)}: {done.stderr.strip()}")


def averaged_files() -> Any:
    """Averages of files, saved and loaded."""
    for number in range(3):
        write(f"part{number}.tif", raw_frames(5000.0, 6, seed=number))
    write("dark.tif", raw_frames(0.0, 12, seed=9))
    command("average", "part*.tif", "--dark", "dark.tif", "--reject=4", "-o", "mean.tif", "--force")
    options: dict[str, Any] = {"saturation": 13000.0, "mask": mask(), "reject": 4.0}
    found = {
        "plain": equipix.average("part*.tif"),
        "listed": equipix.average(["part2.tif", "part0.tif"], dark=DARK, **options),
        "floats": equipix.average(raw_frames(5000.0, 5).astype(np.float32)),
        "command": equipix.load("mean.tif"),
    }
    read = {name: reread(each) for name, each in found.items()}
    return found | {"files": read}


def corrected_files() -> Any:
    """Files that the command line corrects: floats, whole numbers, pictures, a folder."""
    flagged_response(2).save("response.npz", force=True)
    write("raw.tif", FRAMES)
    write("one.tif", moving_frames(1))
    ways: dict[str, tuple[str, ...]] = {
        "float32.tif": (),
        "kept.tif": ("--flagged", "keep"),
        "uint16.tif": ("--dtype", "uint16", "--bit-depth", "14"),
        "linear.tif": ("--display", "linear"),
        "histogram.tif": ("--display", "histogram"),
        "folder": (),
    }
    for output, options in ways.items():
        command("correct", "response.npz", "raw.tif", "-o", output, "--force", *options)
    command("correct", "response.npz", "one.tif", "-o", "16.png", "--force")
    command("correct", "response.npz", "one.tif", "-o", "8.png", "--force", *ways["linear.tif"])
    found = {name: tifffile.imread(name) for name in [*ways][:-1]}
    found["folder"] = tifffile.imread("folder/raw.tif")
    return found | {name: equipix.average(name).mean for name in ("16.png", "8.png")}


def written() -> Any:
    """Corrections that the command line writes."""
    level_files()
    given_experiment()
    write("moving.tif", moving_frames())
    command("nuc", "fit", "levels.toml", "-o", "nuc.npz", "--order", "2", "--force")
    command("calibrate", "given.toml", "-o", "given.npz", "--force")
    options = ("--bit-depth", "14", "--corrected", "seen.tif", "--state", "state.npz", "--force")
    command("scene", "moving.tif", "-o", "scene.npz", "--method", "local-mean", *options)
    command("hardware", "nuc.npz", "-o", "words.bin", "--linearise", "900", "9000", "--force")
    return {
        "corrections": [equipix.load(f"{name}.npz") for name in ("nuc", "given", "scene")],
        "scene": [tifffile.imread("seen.tif"), equipix.load("state.npz")],
        "hardware": equipix.load("words.bin"),
    }


def figures() -> Any:
    """Figures of noise and of non-uniformity."""
    dark, frames, hot = (raw_frames(each, 32, seed=3) for each in (0.0, 6000.0, 6600.0))
    light = np.linspace(2000.0, 20000.0, 8)
    bright = [raw_frames(each, seed=k) for k, each in enumerate(light)]
    pair = equipix.average(dark), equipix.average(frames)
    return {
        "three": metrics.three_d_noise(frames),
        "transfer": metrics.emva_transfer(bright, [dark], 8 * light),
        "spatial": metrics.emva_spatial(frames, dark),
        "plain": metrics.emva_spatial(frames, dark, gain_dn_per_e=0.2, highpass=False),
        "averages": metrics.emva_spatial(*pair[::-1]),
        "correctability": metrics.correctability(frames),
        "masked": metrics.correctability(frames, mask=mask(), confidence=0.9),
        "netd": metrics.netd(frames, hot, 2.5),
        "roughness": metrics.roughness(frames[0]),
        "interval": metrics.validity_interval([0, 10, 20], [0.2, 0.8, 1.2]),
        "planes": [plane.copy() for plane in metrics.planes(frames[0], "RGGB").values()],
    }


CASES: dict[str, Callable[[], Any]] = {
    "nuc, one point": lambda: response(order=0),
    "nuc, one point by gain": lambda: response(averages(dark=True), order=0, by="gain"),
    "nuc, two points": lambda: response(order=1),
    "nuc, two points of float32 with NaN": lambda: response(
        np.where(mask((6, *SHAPE)), np.nan, means()).astype(np.float32)
    ),
    "nuc, quadratic": lambda: response(averages(dark=True), order=2),
    "nuc, quadratic, masked": lambda: response(order=2, mask=mask()),
    "nuc, quadratic, masked levels": lambda: response(
        means(), order=2, mask=mask((6, *SHAPE)), variance=50 + LIGHT / 80
    ),
    "nuc, cubic": lambda: response(averages(dark=True), order=3),
    "nuc, cubic, noise model": lambda: response(
        means(), order=3, variance=equipix.NoiseModel(read_noise=2.0, gain=0.2).of_mean(16)
    ),
    "nuc, predicted order": lambda: response(order="auto"),
    "nuc, saturated averages": lambda: response(averages([*LIGHT, 15500.0]), order=2),
    "nuc, saturated arrays": lambda: response(means().round(), saturation=12200.0),
    "nuc, colours": lambda: response(means() * (1 + np.indices(SHAPE)[1] % 2), cfa="RG/RG"),
    "nuc, applied": applied_response,
    "nuc, defects": lambda: defects(raw_frames(6000.0, 100, seed=50)),
    "nuc, defects by an average": lambda: defects(equipix.average(raw_frames(6000.0, 32))),
    "nuc, defects by curves": lambda: defects(levels=averages(dark=True), cfa="RGGB"),
    "nuc, defects by other limits": lambda: defects(
        raw_frames(6000.0, 100, seed=50), limits=nuc.DefectLimits(response=0.9, noise=1.2, misfit=2)
    ),
    "nuc, files": lambda: level_files(order=2),
    "nuc, files without a dark": lambda: level_files(
        "region = [{rows = [0, 2]}]", dark=False, order="auto", mask=mask()
    ),
    "camera, files": camera_files,
    "camera, colours": lambda: camera_files('cfa = "RG/RG"'),
    "bolometer, order": lambda: dynamic(order=3),
    "bolometer, predicted order": lambda: dynamic(averaged=True),
    "bolometer, inverse": lambda: dynamic(order=2, regressor="inverse", mask=mask()),
    "bolometer, shutter alone": lambda: dynamic(bodies=False, order=2, bias_order=0),
    "bolometer, simulated": bolometer_array,
    "scene, local mean": lambda: learned(scene.LocalMean),
    "scene, local mean, float32": lambda: learned(
        scene.LocalMean, "float32", step=0.1, kernel=np.ones((3, 3)), mask=mask()
    ),
    "scene, gated": lambda: learned(scene.Gated),
    "scene, gated, masked": lambda: learned(
        scene.Gated, threshold=0.01, texture=50.0, width=7, mask=mask()
    ),
    "scene, registered": lambda: learned(scene.Registered),
    "scene, registered, float64": lambda: learned(
        scene.Registered, "float64", step=0.05, most_motion=5, least_motion=1.0, mask=mask()
    ),
    "scene, constant statistics": lambda: learned(scene.ConstantStatistics, prior=20, width=11),
    "scene, constant statistics, masked": lambda: learned(
        scene.ConstantStatistics, window=40, width=9, mask=mask()
    ),
    "scene, kalman": lambda: learned(scene.Kalman, block=10, width=11),
    "scene, kalman, masked": lambda: learned(
        scene.Kalman, block=20, width=9, memory=500.0, mask=mask()
    ),
    "lens": falloff,
    "lens, radial": lambda: falloff(law="radial", mask=mask((48, 64))),
    "lens, sensitivity": lambda: falloff(sensitivity=flat_frame()[1] ** 0.9),
    "lens, colours": lambda: falloff(
        flat_frame()[0] * (1 + np.indices((48, 64))[1] % 2), cfa="RG/RG"
    ),
    "combined": combined,
    "correctors": prepared,
    "correctors of results": prepared_results,
    "hardware": lambda: table_of(hardware.Table.of(flagged_response())),
    "hardware, narrow": lambda: table_of(
        hardware.Table.of(polynomial(2), gain_bits=8, offset_bits=8, out_bits=8, lowest=30.0)
    ),
    "hardware, steps": lambda: table_of(
        hardware.Table.of(flagged_response(), adc_bits=12, adc_step=4.0, out_step=0.5, dac_bits=10)
    ),
    "hardware, linearised": lambda: table_of(
        hardware.Table.of(flagged_response(2), linearise=(2000.0, 9000.0))
    ),
    "hardware, costs": costs,
    "hardware, adaptive": adaptive,
    "hardware, adaptive, narrow": lambda: adaptive(12, gain_bits=10, offset_bits=9, step=0.0625),
    "files, averages": averaged_files,
    "files, corrected": corrected_files,
    "files, commands": written,
    "figures": figures,
}

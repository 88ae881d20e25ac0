"""What tests of several rooms share: exposures of arrays, small experiments between pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import tifffile

import equipix
from equipix import simulate
from equipix.exposures.exposures import Exposures
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Positions
from equipix.io.tiff import write_frames
from equipix.measured.colour import Colours
from equipix.measured.measured import measured_of
from equipix.scene.methods import METHODS
from equipix.scene.scene_correction import SceneCorrection

SMALL = (9, 12)
SMALL_CROSS = np.array([(0, 0), (0, 2), (0, 3), (2, 0), (3, 0)], float)
TURNED = [0, 90, 180, 270, 0]
CROSS = equipix.cross_pattern(11, 19).astype(float)


def exposures_of(
    frames: Any,
    shifts: Any,
    *,
    variance: Any = None,
    saturation: float | None = None,
    flux: Any = None,
    flux_std: Any = None,
    time: Any = None,
    rotation: Any = None,
    shift_std: Any = None,
    cfa: Any = None,
    **options: Any,
) -> Exposures:
    """Make exposures; the arguments are those of `equipix.calibrate`."""
    measured = measured_of(frames, variance, saturation, colours=Colours.of(cfa))
    shape = measured.values.shape
    positions = Positions.of(shifts, rotation=rotation, std=shift_std, shape=shape)
    return Exposures.of(
        measured, positions, Flux.of(flux, flux_std, time, len(measured)), **options
    )


def between(cross, rng):
    """The cross with random fractions of a pixel, but for its first exposure."""
    shifts = np.array(cross, float)
    shifts[1:] += rng.uniform(-0.5, 0.5, (len(shifts) - 1, 2))
    return shifts


def small(seed, shifts, **options):
    """A tiny sensor with uneven weights and missing measurements."""
    rng = np.random.default_rng(seed)
    sensitivity = simulate.paper_sensitivity(SMALL, rng=rng)
    beam = simulate.wavy_beam(SMALL, width=30, contrast=0.2, rng=rng)
    frames = simulate.exposures(sensitivity, beam, shifts, **options)
    variance = rng.uniform(1e-6, 2e-6, frames.shape)
    frames += np.sqrt(variance) * rng.standard_normal(frames.shape)
    return frames, {"variance": variance, "mask": rng.random(frames.shape) < 0.05}


def used(cal, measured):
    """The same with those measurements masked that the fit lost."""
    mask = measured["mask"].copy()
    for k, lost in enumerate(cal.weighted.fit.lost):
        mask[k].flat[lost] = True
    return measured | {"mask": mask}


def written_experiment(folder, shape, shifts, **options):
    """Write four frames of each exposure of a small virtual camera; return the manifest."""
    rng = np.random.default_rng(3)
    sensitivity = simulate.paper_sensitivity(shape, rng=rng)
    beam = simulate.gaussian_beam(shape, width=150)
    virtual = simulate.experiment(sensitivity, beam, shifts, frames=4, rng=rng, **options)
    return virtual.write(folder / "experiment")


CAMERA = {"gain": 0.25, "read": 8.0, "efficiency": 0.6, "well": 14_000.0, "current": 2000.0}
"""A virtual camera: DN per electron, e-, electrons per photon, e-, e-/s."""


def camera_levels(rng, shape=(48, 64), count=14, frames=2, efficiency=None, **changed):
    """Frames of levels with light and without, photons, exposure times of a virtual camera."""
    truth = CAMERA | changed
    rng = np.random.default_rng(rng)
    camera = simulate.Camera(
        sensitivity=np.ones(shape),
        gain_dn_per_e=truth["gain"],
        read_noise_e=truth["read"],
        full_well_e=truth["well"],
    )
    efficiency = np.broadcast_to(truth["efficiency"] if efficiency is None else efficiency, shape)
    photons = np.linspace(0.02, 1.2, count) * truth["well"] / truth["efficiency"]
    times = photons / 1e6
    stacks, levels = [], [*zip(photons, times, strict=True)]
    for lit in (1, 0):
        electrons = (lit * n * efficiency + truth["current"] * t for n, t in levels)
        stacks.append([np.stack([*camera.frames(e, frames, rng=rng)]) for e in electrons])
    return *stacks, photons, times


def written_camera(folder, rng=1, *, spatial=16, cfa=None, **options):
    """Write levels of a virtual camera, and frames at half of saturation; return the manifest."""
    bright, dark, photons, times = camera_levels(rng, **options)
    photons, times = photons.tolist(), times.tolist()
    lines = ["[sensor]", "bit_depth = 12", *([f'cfa = "{cfa}"'] if cfa else [])]
    for k, level in enumerate(photons):
        for name, stacks in (("b", bright), ("d", dark)):
            write_frames(folder / f"{name}{k}.tif", stacks[k], nbytes=stacks[k].nbytes)
        lines += ["[[exposure]]", f'frames = "b{k}.tif"', f'dark = "d{k}.tif"']
        lines += [f"photons = {level!r}", f"exposure_s = {times[k]!r}"]
    if spatial:
        half = len(photons) // 2
        stacks = camera_levels([rng, 1], **options | {"frames": spatial})
        for name, each in zip("bd", stacks, strict=False):
            write_frames(folder / f"{name}.tif", each[half], nbytes=each[half].nbytes)
        lines += ["[spatial]", 'frames = "b.tif"', 'dark = "d.tif"']
    path = folder / "camera.toml"
    path.write_text("\n".join(lines))
    return path


def write_dng(path, counts, *, pattern="RGGB", black=64, white=4095, exposure=(1, 50), area=None):
    """Write counts behind Bayer's filters as a DNG, as the specification 1.4 has its tags."""
    repeat, levels = ((2, 2), black) if isinstance(black, tuple) else ((1, 1), (black,))
    tags = [
        (50706, "B", 4, (1, 4, 0, 0)),  # DNGVersion
        (50708, "s", 0, "equipix"),  # UniqueCameraModel
        (33421, "H", 2, (2, 2)),  # CFARepeatPatternDim
        (33422, "B", 4, bytes("RGB".index(each) for each in pattern)),  # CFAPattern
        (50713, "H", 2, repeat),  # BlackLevelRepeatDim
        (50714, "H", len(levels), levels),  # BlackLevel
        (50717, "I", 1, white),  # WhiteLevel
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1)),  # ColorMatrix1
    ]
    tags += [(33434, "2I", 1, exposure)] if exposure else []  # ExposureTime
    tags += [(50829, "I", 4, area)] if area else []  # ActiveArea: top, left, bottom, right
    tifffile.imwrite(
        path,
        counts,
        photometric=32803,
        metadata=None,
        subfiletype=0,
        extratags=[(*each, True) for each in tags],
    )
    return path


def learned(name: str, shape: tuple[int, int]) -> SceneCorrection:
    """A method of `equipix.scene` that has learned from forty frames of a moving scene."""
    method = METHODS[name](shape, (0, 1))
    for frame in simulate.MovingScene(seed=1, shape=shape).frames(40):
        method.update(frame.values)
    return method

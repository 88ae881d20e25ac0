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
from equipix.measured.measured import measured_of

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
    **options: Any,
) -> Exposures:
    """Make exposures; the arguments are those of `equipix.calibrate`."""
    measured = measured_of(frames, variance, saturation)
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

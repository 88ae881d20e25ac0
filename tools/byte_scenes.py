"""Scenes for `byte_cases.py`: sensors in a beam, their exposures and their frames on disk.

Inputs are made with NumPy alone, so that they do not come from the builds that are compared; but
`equipix.average` averages frames, and `equipix.simulate` writes experiments.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import equipix

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Shifts = tuple[tuple[float, float], ...]

NOISE = 2e-3
CROSS: Shifts = ((0, 0), (0, 5), (0, 7), (5, 0), (7, 0))
SIX: Shifts = (*CROSS, (2, 3))
BETWEEN: Shifts = ((0, 0), (0.31, 4.83), (-0.22, 7.4), (5.13, 0.08), (6.64, 0.27))
"""A cross whose shifts are no whole numbers."""
REVERSED: Shifts = tuple((-row, -col) for row, col in BETWEEN)
IN_PARTS: Shifts = ((0, 0), (0, 4), (0, 6), (4, 0), (6, 0))
"""A cross that leaves the sensor in four parts."""
BY_TURNS: Shifts = ((0, 0), (5, 0), (0, 5), (7, 0), (0, 7))
"""The cross in an order that distinguishes a linear drift from a tilt."""


@dataclass(frozen=True)
class Scene:
    """A sensor in a beam, and the exposures that it takes; everything follows from the fields."""

    shape: tuple[int, int] = (40, 56)
    shifts: Shifts = CROSS
    rotation: list[int] | None = None
    flux: tuple[float, ...] | None = None
    noise: float = NOISE
    contrast: float = 0.0
    width: float = 90.0
    dtype: str = "float64"

    @property
    def sensitivity(self) -> NDArray[Any]:
        """M: white noise of 5 % times a smooth pattern."""
        u, v = (np.linspace(-0.5, 0.5, size) for size in self.shape)
        white = 1 + np.random.default_rng(1).uniform(-0.05, 0.05, self.shape)
        return white * (1 + 0.05 * np.cos(2 * u)[:, None] * np.cos(3 * v + 1))

    def light(self, shift: tuple[float, float], rotation: int) -> NDArray[Any]:
        """L as an exposure sees it."""
        rows, cols = self.shape if rotation % 180 == 0 else self.shape[::-1]
        row, col = np.meshgrid(
            shift[0] + np.arange(rows), shift[1] + np.arange(cols), indexing="ij"
        )
        falloff = np.exp(-((row - 17.0) ** 2 + (col - 31.0) ** 2) / self.width**2)
        waves = np.cos(0.31 * row + 0.17 * col) + np.cos(0.23 * row - 0.37 * col + 1)
        seen: NDArray[Any] = np.rot90(falloff * (1 + self.contrast * waves), rotation // 90)
        return seen

    @property
    def frames(self) -> NDArray[Any]:
        """The mean exposures."""
        count = len(self.shifts)
        turns, powers = self.rotation or [0] * count, self.flux or (1.0,) * count
        exposures = zip(self.shifts, turns, powers, strict=True)
        light = np.array([power * self.light(shift, turn) for shift, turn, power in exposures])
        noise = self.noise * np.random.default_rng(2).standard_normal(light.shape)
        frames: NDArray[Any] = (light * self.sensitivity + noise).astype(self.dtype)
        return frames

    def fit(self, frames: Any = None, **options: Any) -> Any:
        """Calibrate its frames, or others at its shifts."""
        if self.rotation is not None:
            options["rotation"] = self.rotation
        frames = self.frames if frames is None else frames
        return equipix.calibrate(frames, self.shifts, **options)


def bad_pixels(scene: Scene) -> NDArray[Any]:
    """Mask of a strip and of some pixels at random."""
    mask = np.random.default_rng(3).random(scene.shape) < 0.03
    mask[10:13, 5:20] = True
    return mask


def bad_measurements(scene: Scene) -> NDArray[Any]:
    """Mask of some measurements at random."""
    return np.random.default_rng(4).random((len(scene.shifts), *scene.shape)) < 0.05


def with_nan(scene: Scene) -> NDArray[Any]:
    """Frames with some values that are no numbers."""
    frames = scene.frames
    frames[bad_measurements(scene)] = np.nan
    frames[1, 3, 4] = np.inf
    return frames


def with_dust(scene: Scene) -> NDArray[Any]:
    """Frames with a grain, a reflection, and a pixel whose exposures contradict each other."""
    frames = scene.frames
    frames[2, 20:23, 30:33] *= 0.9
    frames[4, 8, 40] *= 1.3
    frames[:3, 33, 44] *= [0.7, 1.4, 1.1]
    return frames


def with_odd_pixels(scene: Scene) -> NDArray[Any]:
    """Frames of a sensor with a dead pixel, a hot one and one without signal."""
    frames = scene.frames
    frames[:, 7, 9] *= 0.02
    frames[:, 30, 11] *= 4.0
    frames[:, 25, 25] = 0.0
    return frames


def statistics(
    scene: Scene, *, frames: int = 8, full_scale: float = 4095.0, saturation: float = 4095.0
) -> list[Any]:
    """Averages of 12-bit frames less their dark; one pixel is far noisier than the others."""
    rng = np.random.default_rng(5)
    clean = 2500 * Scene(**{**vars(scene), "noise": 0.0}).frames

    def averaged(signal: NDArray[Any], **options: Any) -> Any:
        electrons = rng.poisson(4 * signal, (frames, *scene.shape)) / 4
        digital = 60 + electrons + 2 * rng.standard_normal(electrons.shape)
        digital[:, 12, 33] += 300 * rng.standard_normal(frames)
        raw = np.clip(np.rint(digital), 0, full_scale).astype(np.uint16)
        return equipix.average(raw, **options)

    dark = averaged(np.zeros(scene.shape))
    return [averaged(signal, dark=dark, saturation=saturation) for signal in clean]


def written_experiment(**camera: Any) -> Path:
    """Write an experiment whose shifts follow from images of a hole; returns its manifest."""
    scene = Scene(shape=(48, 64))
    beam = equipix.simulate.gaussian_beam(scene.shape, width=90)
    virtual = equipix.simulate.experiment(
        *(scene.sensitivity, beam, CROSS),
        **{"frames": 6, "dark_frames": 6, "aperture_frames": 3, "rng": 6, **camera},
    )
    # A relative path: messages that name the file are then the same for both builds.
    return virtual.write("measured", force=True)


def given_experiment(keys: str = "", shifts: Shifts = CROSS, **camera: Any) -> Any:
    """The same files with a manifest that gives the shifts, and these keys of each exposure."""
    folder, depth = written_experiment(**camera).parent, camera.get("bit_depth", 12)
    lines = [f'[sensor]\nbit_depth = {depth}\n[dark]\nframes = "{folder}/dark/dark.tif"']
    for k, (row, col) in enumerate(shifts):
        lines.append(f'[[exposure]]\nname = "p{k}"\nframes = "{folder}/frames/p{k}.tif"')
        lines.append(f"shift = [{row}, {col}]\ntime = {10 * k}\n{keys}")
    Path("given.toml").write_text("\n".join(lines))
    return equipix.Experiment.load("given.toml")


def measured_experiment() -> Any:
    """The experiment whose shifts are measured."""
    return equipix.Experiment.load(written_experiment())

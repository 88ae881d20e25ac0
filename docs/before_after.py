"""Draw a frame before and after correction: `make figures`, or ``python docs/before_after.py``.

A virtual camera is calibrated from five exposures of a beam. Then it takes one frame of a scene.
before-after.png shows this frame raw and corrected, with the same grey scale, and an enlarged part
of both. The script prints how far each is from the scene.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import equipix
from equipix import Flag, simulate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

FILE = Path(__file__).parent / "before-after.png"
SHAPE = (200, 320)
FRAMES = 20
"""Frames of an exposure, and of the dark."""

ELECTRONS = 16_000.0
"""Signal of a white area of the scene, of 20 000 electrons that the camera can hold."""

ZOOM = (slice(112, 167), slice(136, 224))
DARKEST, BRIGHTEST = 0.25, 1.1
"""The grey scale, relative to a white area."""

FRAME_COLOUR = "#d62728"


def sensitivity(rng: np.random.Generator) -> NDArray:
    """Sensitivity of a poor sensor: pixels, columns and shadows of dust on its cover."""
    rows, cols = np.indices(SHAPE)
    values = simulate.cosine_sensitivity(SHAPE, rng=rng)
    values *= 1 + 0.03 * rng.standard_normal(SHAPE[1])
    for row, col, radius in zip(
        rng.uniform(10, SHAPE[0] - 10, 12),
        rng.uniform(10, SHAPE[1] - 10, 12),
        rng.uniform(4, 9, 12),
        strict=True,
    ):
        distance = np.hypot(rows - row, cols - col)
        values *= 1 - 0.15 / (1 + np.exp(2 * (distance - radius)))
    return values / values.mean()


def scene() -> NDArray:
    """Light of a scene, 1 in a white area: a wall, a disc, bars that become finer, a ramp."""
    rows, cols = np.indices(SHAPE).astype(float)
    light = 0.72 + 0.1 * np.cos(cols / 60) * np.sin(rows / 45)
    disc = np.hypot(rows - 96, cols - 105)
    light = np.where(disc < 62, 0.92 - 0.004 * disc, light)
    light = np.where(disc < 28, 0.42 + 0.004 * disc, light)
    phase = (cols - 190) ** 2 / 150
    bars = (np.abs(rows - 105) < 42) & (cols > 190) & (cols < 300)
    light = np.where(bars, 0.7 + 0.28 * np.sign(np.cos(phase)), light)
    ramp = (rows > 168) & (rows < 188) & (cols > 20) & (cols < 300)
    return np.where(ramp, 0.3 + 0.7 * (np.floor((cols - 20) / 28) / 9), light)


def photograph() -> tuple[NDArray, NDArray]:
    """Raw frame and corrected frame, in electrons; bad pixels are replaced in the latter alone."""
    rng = np.random.default_rng(8)
    shifts = equipix.cross_pattern(11, 19)
    virtual = simulate.experiment(
        sensitivity(rng),
        simulate.gaussian_beam(SHAPE),
        shifts,
        frames=FRAMES,
        dead=12,
        hot=12,
        rng=rng,
    )
    dark = equipix.average(virtual.dark(), saturation=4095)
    exposures = [
        equipix.average(virtual.frames(k), dark=dark, saturation=4095) for k in range(len(shifts))
    ]
    cal = equipix.calibrate(exposures, shifts)
    light = ELECTRONS * scene()
    frame = next(virtual.camera.frames(light, 1, rng=rng))
    gain = virtual.camera.gain_dn_per_e
    raw, corrected = (frame - dark.mean) / gain, cal.correct(frame, flagged="replace") / gain
    good = (cal.flags & Flag.DO_NOT_USE) == 0
    for name, values in {"raw": raw, "corrected": corrected}.items():
        ratio = (values / light)[good]
        print(f"{name}: {ratio.std() / ratio.mean():.1%} rms from the scene")
    print(f"noise of a frame at {ELECTRONS:.0f} electrons: {noise():.1%}")
    return raw, corrected


def noise() -> float:
    """Noise of one frame relative to its signal, for the camera's 10 electrons of read noise."""
    return float(np.sqrt(ELECTRONS + 10**2) / ELECTRONS)


def draw(raw: NDArray, corrected: NDArray) -> Figure:
    """Draw both frames, and below each an enlarged part of it."""
    figure = Figure(figsize=(11, 6.9), layout="constrained")
    whole, part = figure.subplots(2, 2)
    titles = ("raw frame (dark subtracted)", "corrected frame")
    for above, below, frame, title in zip(whole, part, (raw, corrected), titles, strict=True):
        show(above, frame)
        show(below, frame[ZOOM])
        above.set_title(title, fontsize=14)
        below.set_title("enlarged", fontsize=11)
        corner = (ZOOM[1].start - 0.5, ZOOM[0].start - 0.5)
        size = (ZOOM[1].stop - ZOOM[1].start, ZOOM[0].stop - ZOOM[0].start)
        above.add_patch(Rectangle(corner, *size, fill=False, ec=FRAME_COLOUR, lw=1.8))
        for spine in below.spines.values():
            spine.set(edgecolor=FRAME_COLOUR, linewidth=1.8)
    return figure


def show(axes: Axes, frame: NDArray) -> None:
    """Show a frame in the common grey scale, its pixels as squares."""
    limits = {"vmin": DARKEST * ELECTRONS, "vmax": BRIGHTEST * ELECTRONS}
    axes.imshow(frame, cmap="gray", interpolation="nearest", **limits)
    axes.set(xticks=[], yticks=[])


def main() -> None:
    """Draw the picture."""
    draw(*photograph()).savefig(FILE, dpi=90, facecolor="white")


if __name__ == "__main__":
    main()

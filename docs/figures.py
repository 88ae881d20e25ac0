"""Draw the pictures of the docs: `make figures`, or ``python docs/figures.py``.

- scheme.png: the optical scheme (the paper's figure 3) and the sign convention of shifts
- figure1.png, figure2.png: the paper's figures 1 and 2, from a calibration made here
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, FancyArrowPatch, Polygon, Rectangle

import equipix
from equipix import metrics, simulate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

FOLDER = Path(__file__).parent
SHAPE = (240, 320)
ROW = 120
NOISE = 1e-3
INK, BEFORE, AFTER, LIGHT = "#1f2430", "#1f77b4", "#d62728", "#f4c55c"
SAVED = {"dpi": 90, "facecolor": "white"}

SENSOR, MOVE, SPOT = (6, 8), (2, 4), (4.0, 6.5)
"""Of the sketch of the sign convention: rows and columns, the shift, the spot in the beam."""


def draw_scheme() -> Figure:
    """Draw the optical scheme, and what the sensor sees before and after a move."""
    figure = Figure(figsize=(12.4, 4.6), layout="constrained")
    scheme, windows, frames = figure.subplots(1, 3, width_ratios=(1.5, 1.25, 0.85))
    _draw_optics(scheme)
    _draw_windows(windows)
    _draw_frames(frames)
    return figure


def _draw_optics(axes: Axes) -> None:
    axes.set(xlim=(0, 10), ylim=(-3.9, 3.9), aspect="equal")
    axes.axis("off")
    cone = [(0.9, 0), (5, 1.7), (8.6, 0.9), (8.6, -0.9), (5, -1.7)]
    axes.add_patch(Polygon(cone, color=LIGHT, alpha=0.45, lw=0))
    axes.plot([0.3, 9.4], [0, 0], color=INK, lw=0.8, ls=(0, (8, 3, 2, 3)))
    axes.plot(0.9, 0, marker="o", ms=11, color="#e09b00", mec=INK)
    _draw_screen(axes, 2.2, "-", 4)
    _draw_screen(axes, 0, ":", 2)
    axes.add_patch(Ellipse((5, 0), 0.7, 4, facecolor="#cfe3f5", edgecolor=INK))
    axes.add_patch(Rectangle((8.6, -1.3), 0.35, 2.6, facecolor="#9aa5b8", edgecolor=INK))
    _arrow(axes, (9.45, -1.1), (9.45, 1.1), "<->")
    _arrow(axes, (2.8, 2.2), (2.8, 0.9), "-|>")
    for letter, x, y in (("S", 0.9, -0.75), ("D", 1.9, 2.2), ("L", 5, -2.5), ("M", 8.75, -1.85)):
        axes.text(x, y, letter, ha="center", va="center", fontsize=13, weight="bold", color=INK)
    axes.text(0, 3.9, "Optical scheme", va="top", fontsize=12)
    legend = (
        "S steady source     L objective\n"
        "M sensor on a stage, moved across the beam\n"
        "D screen with a hole, put in before each move, taken out after"
    )
    axes.text(0, -3.9, legend, va="bottom", color=INK)


def _draw_screen(axes: Axes, height: float, style: str, width: float) -> None:
    for low, high in ((0.15, 0.95), (-0.95, -0.15)):
        ends = [height + low, height + high]
        axes.plot([2.4, 2.4], ends, color=INK, lw=width, ls=style, solid_capstyle="butt")


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], style: str) -> None:
    options = {"arrowstyle": style, "mutation_scale": 15, "color": INK, "shrinkA": 0, "shrinkB": 0}
    axes.add_patch(FancyArrowPatch(start, end, **options))


def _draw_windows(axes: Axes) -> None:
    rows, cols = SENSOR
    beam = simulate.gaussian_beam((rows + MOVE[0], cols + MOVE[1]), width=6)
    seen = beam(np.linspace(-1, 9, 200)[:, None], np.linspace(-1, 13, 280))
    axes.imshow(seen, extent=(-1, 13, 9, -1), cmap="YlOrBr_r", vmin=-1.2, vmax=1.05)
    for corner, colour, style in (((0, 0), BEFORE, "--"), (MOVE, AFTER, "-")):
        outline = {"fill": False, "edgecolor": colour, "lw": 2.4, "ls": style}
        axes.add_patch(Rectangle(corner[::-1], cols, rows, **outline))
    _arrow(axes, (0, 0), MOVE[::-1], "-|>")
    axes.text(1.2, 1.5, "d", fontsize=14, fontstyle="italic", color=INK)
    axes.plot(SPOT[1], SPOT[0], "o", ms=9, color="white", mec=INK)
    axes.text(SPOT[1] - 0.4, SPOT[0], "spot u", ha="right", va="center", color=INK)
    axes.text(0, -0.2, "before: shift (0, 0)", color=BEFORE, weight="bold")
    after = f"after: shift d = {MOVE}"
    axes.text(MOVE[1] + 0.2, MOVE[0] + rows - 0.2, after, color=AFTER, weight="bold")
    axes.set_title("The sensor in the beam: u = p + d", loc="left")
    axes.set(xlabel="column in the beam", ylabel="row in the beam")


def _draw_frames(axes: Axes) -> None:
    rows, cols = SENSOR
    below = rows + 1.0
    axes.set(xlim=(-1.6, cols + 1.4), ylim=(2 * rows + 3.2, -1.8), aspect="equal")
    axes.axis("off")
    axes.text(-1.6, -1.8, "The frames: p = u − d", va="top", fontsize=12)
    for top, shift, colour, name in ((0, (0, 0), BEFORE, "before"), (below, MOVE, AFTER, "after")):
        row, col = SPOT[0] - shift[0], SPOT[1] - shift[1]
        axes.add_patch(Rectangle((0, top), cols, rows, fc="#fff3d6", edgecolor=colour, lw=2.4))
        axes.plot(col, top + row, "o", ms=9, color="white", mec=INK)
        axes.text(col, top + row + 0.5, f"({row:g}, {col:g})", ha="center", va="top", color=INK)
        side = {"ha": "right", "va": "center", "rotation": 90, "color": colour, "weight": "bold"}
        axes.text(-0.3, top + rows / 2, name, **side)
    formula = "d new = d old + before − after"
    axes.text(cols / 2, 2 * rows + 3.2, formula, ha="center", va="bottom", color=INK)


def solve_paper() -> tuple[NDArray, NDArray, equipix.Calibration]:
    """Calibrate the paper's sensor: truth, exposures and result."""
    rng = np.random.default_rng(120)
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    shifts = equipix.cross_pattern(11, 19)
    frames = simulate.exposures(truth, simulate.gaussian_beam(SHAPE), shifts)
    frames += rng.uniform(-NOISE, NOISE, frames.shape)
    return truth, frames, equipix.calibrate(frames, shifts, tolerance=1e-6)


def draw_maps(frame: NDArray, result: equipix.Calibration, drawn: int) -> Figure:
    """Draw an exposure, the beam and the sensitivity, and one row of each."""
    rows, cols = frame.shape
    row, col = result.beam_origin
    beam = result.beam[row : row + rows, col : col + cols]
    figure = Figure(figsize=(12, 6.2), layout="constrained")
    images, profiles = figure.subplots(2, 3, height_ratios=(1, 0.8))
    maps = {"exposure $y_1$": frame, "beam $L$": beam, "sensitivity $M$": result.sensitivity}
    for axes, below, (name, values) in zip(images, profiles, maps.items(), strict=True):
        image = axes.imshow(values, cmap="gray")
        figure.colorbar(image, ax=axes, shrink=0.85)
        axes.axhline(drawn, color=AFTER, lw=1)
        axes.set(title=name, xlabel="column", ylabel="row")
        below.plot(values[drawn], color=INK, lw=0.8)
        below.set(xlabel="column", title=f"{name}, row {drawn}", xlim=(0, cols - 1))
        below.grid(alpha=0.3)
    return figure


def draw_figure_2(error: NDArray) -> Figure:
    """Draw the relative error of the sensitivity along row 120."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.axhspan(-NOISE, NOISE, color=LIGHT, alpha=0.3, lw=0, label="largest noise, ±1e-3")
    axes.plot(error[ROW], color=INK, lw=0.8, label=f"relative error of M, row {ROW}")
    axes.set(xlabel="column", ylabel="relative error of M", xlim=(0, SHAPE[1] - 1))
    axes.set_ylim(-1.6 * NOISE, 1.6 * NOISE)
    axes.ticklabel_format(axis="y", scilimits=(-3, -3), useMathText=True)
    axes.grid(alpha=0.3)
    axes.legend(loc="upper right", ncols=2)
    return figure


def main() -> None:
    """Draw every picture into the folder of this file."""
    truth, frames, result = solve_paper()
    pictures = {
        "scheme": draw_scheme(),
        "figure1": draw_maps(frames[0], result, ROW),
        "figure2": draw_figure_2(metrics.relative_error(result.sensitivity, truth)),
    }
    for name, figure in pictures.items():
        figure.savefig(FOLDER / f"{name}.png", **SAVED)


if __name__ == "__main__":
    main()

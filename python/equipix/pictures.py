"""Pictures of calibrations, corrections and plans; they need matplotlib, the extra ``plot``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from equipix._check import Array
from equipix.comparison import Comparison
from equipix.correction.protocol import Correction
from equipix.demo import Demo
from equipix.errors import EquipixError, InputError
from equipix.io.paths import write_whole
from equipix.measured.noise import BLOCK
from equipix.metrics.maps import block_means, rms
from equipix.plan.budget import ErrorBudget
from equipix.scene.sequence import SequenceResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def missing_matplotlib() -> EquipixError:
    """Return the error that names the library which is missing, and how to get it."""
    return EquipixError(
        "pictures need matplotlib, which is not installed: pip install 'equipix[plot]'"
    )


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure of this size in inches, drawn without a display.

    Raises
    ------
    EquipixError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_matplotlib() from error
    return Figure(figsize=(width, height), layout="constrained")


def check_picture(path: Path | None) -> None:
    """Refuse a picture that cannot be drawn, before the work starts.

    Raises
    ------
    EquipixError
        If matplotlib is not installed.
    InputError
        If the suffix is unknown.
    """
    if path is None:
        return
    formats = new_figure(1, 1).canvas.get_supported_filetypes()
    if path.suffix.lower().removeprefix(".") not in formats:
        raise InputError(f"'{path}' is no picture, expected a suffix such as .png, .pdf or .svg")


def save_figure(figure: Figure, path: Path, *, force: bool = False) -> None:
    """Write a figure to a file whose suffix names the format; it appears whole or not at all.

    Raises
    ------
    FileError
        If the file exists and `force` is not set, or cannot be written.
    """
    with write_whole(path, force=force) as temporary:
        figure.savefig(temporary)


def draw_map(
    axes: Axes, title: str, image: Array, limits: tuple[float, float], cmap: str, step: int = 1
) -> None:
    """Draw an image with its scale; a pixel of it is `step` pixels wide and high."""
    rows, cols = (step * size for size in image.shape)
    extent = (-0.5, cols - 0.5, rows - 0.5, -0.5)
    shown = axes.imshow(image, vmin=limits[0], vmax=limits[1], cmap=cmap, extent=extent)
    axes.set(title=title, xlabel="column", ylabel="row")
    axes.figure.colorbar(shown, ax=axes, shrink=0.8)


def draw_comparison(comparison: Comparison, names: Sequence[str]) -> Figure:
    """Show how far calibrations of one sensor agree, as figure 5 of the method's authors does.

    Parameters
    ----------
    comparison : Comparison
        What `equipix.compare` gave.
    names : sequence of str
        What to call each calibration.

    Returns
    -------
    matplotlib.figure.Figure
        First row: the sensitivities along a part of the middle row of pixels, and what they differ
        by along all of it. Second row: the scatter of a pixel, and the two that differ most at
        large scales. Third row: the distributions of the differences of single pixels and of block
        means, with what the uncertainties predict where they are known.
    """
    figure = new_figure(12.5, 12)
    rows = figure.subplots(3, 2)
    middle, width = (size // 2 for size in comparison.agreement.shape)
    differences = [100 * comparison.difference(pair) for pair in range(len(comparison.pairs))]
    blocks = [block_means(each) for each in differences]
    labels = [f"{names[i]} − {names[j]}" for i, j in comparison.pairs]
    part = np.arange(comparison.agreement.shape[1])[width : width + 60]
    profiles = zip(names, comparison.sensitivities[:, middle, part], strict=True)
    _curves(rows[0, 0], "Sensitivity along a part of the middle row", part, profiles)
    along = zip(labels, [each[middle] for each in differences], strict=True)
    _curves(rows[0, 1], f"Differences along row {middle}, %", None, along)
    scatter = 100 * comparison.agreement
    title = f"Scatter of a pixel, %\n(rms {rms(scatter):.2g})"
    draw_map(rows[1, 0], title, scatter, (0, float(np.nanpercentile(scatter, 99.9))), "gray")
    worst = int(np.argmax(comparison.block_rms))
    _block_map(rows[1, 1], labels[worst], blocks[worst], blocks[worst])
    for axes, title, errors, predicted in (
        (rows[2, 0], "Differences of pixels", differences, comparison.predicted_rms),
        (rows[2, 1], "Differences of 16×16 means", blocks, comparison.predicted_block_rms),
    ):
        known = predicted is not None and np.isfinite(predicted).all()
        expected = 100 * float(rms(np.asarray(predicted))) if known else None
        _densities(axes, title, "difference, %", zip(labels, errors, strict=True), expected)
    return figure


def _curves(
    axes: Axes, title: str, places: Array | None, curves: Iterable[tuple[str, Array]]
) -> None:
    """Draw curves over columns, the later thinner, so that each is visible."""
    for index, (label, values) in enumerate(curves):
        columns = np.arange(len(values)) if places is None else places
        axes.plot(columns, values, linewidth=max(0.7, 3 / (index + 1)), label=label)
    axes.set(title=title, xlabel="column")
    axes.legend(fontsize="small")


def _block_map(axes: Axes, what: str, blocks: Array, scale: Array) -> None:
    """Draw block means of a difference, on the scale of one."""
    limit = float(np.nanmax(np.abs(scale)))
    title = f"{what}, %\n(16×16 means, rms {rms(blocks):.2g})"
    draw_map(axes, title, blocks, (-limit, limit), "RdBu_r", BLOCK)


def _densities(
    axes: Axes, title: str, what: str, values: Iterable[tuple[str, Array]], predicted: float | None
) -> None:
    """Draw histograms, and the normal distribution of what is predicted."""
    lowest, highest = np.inf, 0.0
    for label, each in values:
        reach, count = float(np.nanmax(np.abs(each))) or 1.0, int(np.isfinite(each).sum())
        edges = reach * np.linspace(-1, 1, min(62, 6 + round(count**0.5)))
        density = np.histogram(each, edges)[0] / count / np.diff(edges)
        lowest = min(lowest, 0.5 / count / float(edges[1] - edges[0]))
        highest = max(highest, float(density.max()))
        axes.stairs(density, edges, label=f"{label}: rms {rms(each):.2g}")
    if predicted is not None:
        sigmas = np.linspace(-6, 6, 121)
        normal = np.exp(-0.5 * sigmas**2) / (predicted * np.sqrt(2 * np.pi))
        label = f"predicted {predicted:.2g}"
        axes.plot(predicted * sigmas, normal, color="black", linestyle=":", label=label)
        highest = max(highest, float(normal.max()))
    limits = (lowest, 30 * highest)
    axes.set(title=title, xlabel=what, ylabel="density", yscale="log", ylim=limits)
    axes.legend(loc="upper right", fontsize="small")


def draw_demo(demo: Demo) -> Figure:
    """Show what a calibration and a flat field found, and how far each is from the truth.

    Parameters
    ----------
    demo : Demo
        What `equipix.demo.run_demo` gave.

    Returns
    -------
    matplotlib.figure.Figure
        First row: the sensitivities on a common scale. Second row: the errors of means over 16×16
        pixels on a common scale, and their profile along the rows. Third row: the distribution
        of the errors of single pixels and of block means, and the estimated error by sweep.
    """
    figure = new_figure(12.5, 10.5)
    rows = figure.subplots(3, 3)
    found = demo.calibration.sensitivity / np.nanmean(demo.calibration.sensitivity)
    flat_field = "Flat field, source uneven by 1 %"
    images = {
        "True sensitivity": demo.truth,
        "Shift calibration": found,
        flat_field: demo.flat_field,
    }
    _maps(rows[0], images, demo.truth, (0.1, 99.9))
    names, errors = ("shift calibration", "flat field"), (demo.error, demo.flat_field_error)
    pixels = [(name, 100 * error) for name, error in zip(names, errors, strict=True)]
    blocks = [(name, block_means(error)) for name, error in pixels]
    for axes, (name, error) in zip(rows[1], blocks, strict=False):
        _block_map(axes, f"Error of {name}", error, blocks[1][1])
    middle, places = len(blocks[0][1]) // 2, BLOCK * (np.arange(blocks[0][1].shape[1]) + 0.5)
    profiles = [(name, error[middle]) for name, error in blocks]
    _curves(rows[1, 2], "Both along the middle row, %", places, profiles)
    rows[1, 2].axhline(0, color="gray", linewidth=0.5)
    predicted, predicted_blocks = (100 * value for value in demo.predicted)
    _densities(rows[2, 0], "Errors of pixels", "error, %", pixels, predicted)
    _densities(rows[2, 1], "Errors of 16×16 means", "error, %", blocks, predicted_blocks)
    history = demo.calibration.history
    rows[2, 2].semilogy(history["sweep"], 100 * history["error_estimate"], marker="o")
    rows[2, 2].set(title="Estimated distance from the optimum, %", xlabel="sweep", ylabel="%")
    rows[2, 2].grid(alpha=0.3)
    return figure


def _maps(
    places: Iterable[Axes], images: dict[str, Array], scale: Array, shares: tuple[float, float]
) -> None:
    """Draw images beside one another, on a scale between two percentiles of one."""
    low, high = np.nanpercentile(scale, shares)
    for axes, (title, image) in zip(places, images.items(), strict=True):
        draw_map(axes, title, image, (float(low), float(high)), "gray")


def draw_sequence(sequence: SequenceResult, correction: Correction) -> Figure:
    """Show the last frame raw and corrected on a common scale, and the roughness over the frames.

    Parameters
    ----------
    sequence : Sequence
        What `equipix.scene.sequence.run_sequence` gave.
    correction : Correction
        The correction that was learned.

    Returns
    -------
    matplotlib.figure.Figure
        First row: the frame before and after. Second row: the roughness.
    """
    figure = new_figure(12, 9)
    grid = figure.add_gridspec(2, 2, height_ratios=(3, 2))
    after = correction.correct(sequence.last, flagged="replace")
    images = {"Last frame, raw": sequence.last, "Last frame, corrected": after}
    above = [figure.add_subplot(grid[0, col]) for col in range(2)]
    _maps(above, images, after, (0.5, 99.5))
    axes = figure.add_subplot(grid[1, :])
    axes.plot(sequence.points, sequence.raw, color="0.5", label="raw")
    axes.plot(sequence.points, sequence.corrected, label="corrected")
    axes.set(xlabel="frame", ylabel="roughness", ylim=(0, None))
    axes.legend()
    return figure


def draw_plans(budgets: list[ErrorBudget]) -> Figure:
    """Show patterns of shifts, a row each, and what errors they leave.

    Parameters
    ----------
    budgets : list of ErrorBudget
        What `equipix.plan.error_budget` gave.

    Returns
    -------
    matplotlib.figure.Figure
        In each row the positions of the sensor, numbered by exposure; the spectrum λ(q)/n with
        its worst wave; the standard deviation of M that noise leaves, on a scale common to all
        rows; and the errors by cause.
    """
    figure = new_figure(15, 3.6 * len(budgets))
    rows = figure.subplots(len(budgets), 4, squeeze=False, width_ratios=(1, 1.5, 1.3, 0.9))
    shown = [_thinned_noise(budget) for budget in budgets]
    finite = np.concatenate([values[np.isfinite(values)] for values, _ in shown])
    limits = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    heights = np.array([[*each.rms_by_cause.values()] for each in budgets])
    largest = np.max(heights, where=np.isfinite(heights), initial=0.0) or 1.0
    for row, budget, (values, step) in zip(rows, budgets, shown, strict=True):
        _positions(row[0], budget)
        _spectrum(row[1], budget)
        rms = budget.rms_by_cause["noise"]
        draw_map(row[2], f"Error from noise (rms {rms:.2g})", values, limits, "viridis", step)
        _causes(row[3], budget, 1.15 * largest)
    return figure


def _thinned_noise(budget: ErrorBudget) -> tuple[Array, int]:
    """Return the map of errors by noise without rows and columns that no picture could show."""
    step = max(1, max(budget.shape) // 1000)
    rows, cols = (np.arange(0, size, step) for size in budget.shape)
    return budget.noise_at(rows, cols), step


def _positions(axes: Axes, budget: ErrorBudget) -> None:
    """Draw the positions of the sensor."""
    rows, cols = budget.shifts.T
    axes.plot(cols, rows, color="gray", linewidth=0.6, linestyle=":")
    axes.plot(cols, rows, "o", color="C0")
    for k, (row, col) in enumerate(budget.shifts):
        axes.annotate(str(k), (col, row), xytext=(5, 3), textcoords="offset points")
    axes.set(title=f"{len(rows)} positions, pixels", xlabel="column", ylabel="row")
    axes.margins(0.15)
    axes.invert_yaxis()
    axes.set_aspect("equal", "datalim")


def _spectrum(axes: Axes, budget: ErrorBudget) -> None:
    """Draw λ(q)/n on a logarithmic scale."""
    found = budget.spectrum
    share = np.log10(np.maximum(found.values / len(budget.shifts), 1e-4))
    extent = (found.cols[0], found.cols[-1], found.rows[0], found.rows[-1])
    shown = axes.imshow(
        share, origin="lower", extent=extent, aspect="auto", cmap="magma", vmin=-3, vmax=0
    )
    axes.plot(*found.worst[::-1], "o", mfc="none", mec="white", ms=9)
    axes.set(
        title=f"log₁₀ λ/n of waves; least away from 0: {found.smallest / len(budget.shifts):.1g}",
        xlabel="cycles per column",
        ylabel="cycles per row",
    )
    axes.figure.colorbar(shown, ax=axes, shrink=0.8)


def _causes(axes: Axes, budget: ErrorBudget, limit: float) -> None:
    """Draw a bar for each cause of error; one without end, or not known, has its label alone."""
    names = [name.replace("_", "\n") for name in budget.rms_by_cause]
    values = np.array([*budget.rms_by_cause.values()])
    bars = axes.bar(names, np.where(np.isfinite(values), values, 0), color=("C0", "C1", "C2"))
    axes.bar_label(bars, [f"{value:.1e}" for value in values], fontsize="small")
    axes.set(title="rms error of M by cause", ylim=(0, limit))

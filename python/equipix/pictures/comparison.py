"""Pictures of results beside one another, the truth or raw frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from equipix.calibration.result import Calibration
from equipix.comparison import Comparison
from equipix.correction.protocol import Correction
from equipix.demo import Demo
from equipix.measured.filters import BLOCK
from equipix.metrics.maps import block_means, rms
from equipix.pictures.canvas import CALIBRATION, FLAT_FIELD, PREDICTION, draw_map, new_figure
from equipix.scene.sequence import SequenceResult


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
    middle = comparison.agreement.shape[0] // 2
    differences = [100 * comparison.difference(pair) for pair in range(len(comparison.pairs))]
    blocks = [block_means(each) for each in differences]
    labels = [f"{names[i]} − {names[j]}" for i, j in comparison.pairs]
    _lines(rows[0, 0], comparison.sensitivities[:, middle], names)
    _differences(rows[0, 1], [each[middle] for each in differences], labels)
    rows[0, 1].set(title=f"Differences along row {middle}, %", xlabel="column")
    _scatter(rows[1, 0], 100 * comparison.agreement)
    worst = int(np.argmax(comparison.block_rms))
    _worst(rows[1, 1], labels[worst], blocks[worst])
    for axes, title, errors, predicted in (
        (rows[2, 0], "Differences of pixels", differences, comparison.predicted_rms),
        (rows[2, 1], "Differences of 16×16 means", blocks, comparison.predicted_block_rms),
    ):
        known = predicted is not None and np.isfinite(predicted).all()
        expected = 100 * float(rms(np.asarray(predicted))) if known else None
        _densities(axes, title, dict(zip(labels, errors, strict=True)), expected)
    return figure


def _lines(axes: Axes, profiles: NDArray[Any], names: Sequence[str]) -> None:
    """Draw profiles one over the other, the later thinner, so that each is visible."""
    part = slice(profiles.shape[1] // 2, profiles.shape[1] // 2 + 60)
    columns = np.arange(profiles.shape[1])[part]
    for index, (profile, name) in enumerate(zip(profiles, names, strict=True)):
        width = max(1.0, 5 / (index + 1))
        axes.plot(columns, profile[part], linewidth=width, label=name)
    axes.set(title="Sensitivity along a part of the middle row", xlabel="column")
    axes.legend(fontsize="small")


def _differences(axes: Axes, profiles: Sequence[NDArray[Any]], labels: Sequence[str]) -> None:
    """Draw what each two calibrations differ by along a row."""
    for profile, label in zip(profiles, labels, strict=True):
        axes.plot(profile, linewidth=0.7, label=label)
    axes.legend(fontsize="small")


def _scatter(axes: Axes, scatter: NDArray[Any]) -> None:
    """Draw the scatter of each pixel over the calibrations."""
    high = float(np.nanpercentile(scatter, 99.9))
    draw_map(axes, f"Scatter of a pixel, %\n(rms {rms(scatter):.2g})", scatter, (0, high), "gray")


def _worst(axes: Axes, label: str, blocks: NDArray[Any]) -> None:
    """Draw the block means of a difference."""
    limit = float(np.nanmax(np.abs(blocks)))
    title = f"{label}, %\n(16×16 means, rms {rms(blocks):.2g})"
    draw_map(axes, title, blocks, (-limit, limit), "RdBu_r", BLOCK)


def _densities(
    axes: Axes, title: str, values: dict[str, NDArray[Any]], predicted: float | None
) -> None:
    """Draw histograms with one set of edges, and what the uncertainties predict."""
    reach = max(float(np.nanmax(np.abs(each))) for each in values.values()) or 1.0
    count = min(int(np.isfinite(each).sum()) for each in values.values())
    edges = reach * np.linspace(-1, 1, min(62, 6 + round(count**0.5)))
    highest, width = 0.0, 2 * reach / (len(edges) - 1)
    for label, each in values.items():
        density = np.histogram(each, edges)[0] / np.isfinite(each).sum() / np.diff(edges)
        highest = max(highest, float(density.max()))
        axes.stairs(density, edges, label=f"{label}: rms {rms(each):.2g}")
    if predicted is not None:
        normal = np.exp(-0.5 * (edges / predicted) ** 2) / (predicted * np.sqrt(2 * np.pi))
        label = f"uncertainties predict {predicted:.2g}"
        axes.plot(edges, normal, color=PREDICTION, linestyle=":", label=label)
        highest = max(highest, float(normal.max()))
    axes.set(
        title=title,
        xlabel="difference, %",
        ylabel="density",
        yscale="log",
        ylim=(0.5 / count / width, 30 * highest),
    )
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
    _sensitivities(rows[0], demo)
    pixels = [100 * error for error in (demo.error, demo.flat_field_error)]
    blocks = [100 * block_means(error) for error in (demo.error, demo.flat_field_error)]
    _block_errors(rows[1], *blocks)
    predicted, predicted_blocks = (100 * value for value in demo.predicted)
    _distributions(rows[2, 0], "Errors of pixels", pixels, predicted)
    _distributions(rows[2, 1], "Errors of 16×16 means", blocks, predicted_blocks)
    _history(rows[2, 2], demo.calibration)
    return figure


def _sensitivities(axes: NDArray[Any], demo: Demo) -> None:
    """Draw what is true and what was found on a common scale."""
    measured = demo.calibration.sensitivity / np.nanmean(demo.calibration.sensitivity)
    low, high = np.nanpercentile(demo.truth, (0.1, 99.9))
    images = {
        "True sensitivity": demo.truth,
        "Shift calibration": measured,
        "Flat field, source uneven by 1 %": demo.flat_field,
    }
    for place, (title, image) in zip(axes, images.items(), strict=True):
        draw_map(place, title, image, (low, high), "gray")


def _block_errors(axes: NDArray[Any], calibration: NDArray[Any], flat_field: NDArray[Any]) -> None:
    """Draw the errors of block means on a common scale, and their profiles."""
    limit = float(np.nanmax(np.abs(flat_field)))
    images = {"shift calibration": calibration, "flat field": flat_field}
    for place, (name, errors) in zip(axes[:2], images.items(), strict=True):
        title = f"Error of {name}, %\n(16×16 means, rms {rms(errors):.1g})"
        draw_map(place, title, errors, (-limit, limit), "RdBu_r", BLOCK)
    _profiles(axes[2], calibration, flat_field)


def _profiles(axes: Axes, calibration: NDArray[Any], flat_field: NDArray[Any]) -> None:
    """Draw the errors of block means along the middle row of blocks."""
    middle = len(calibration) // 2
    cols = BLOCK * (np.arange(calibration.shape[1]) + 0.5)
    axes.plot(cols, flat_field[middle], color=FLAT_FIELD, label="flat field")
    axes.plot(cols, calibration[middle], color=CALIBRATION, label="shift calibration")
    axes.axhline(0, color="gray", linewidth=0.5)
    axes.set(title="Both along the middle row, %", xlabel="column")
    axes.legend()


def _distributions(axes: Axes, title: str, errors: list[NDArray[Any]], predicted: float) -> None:
    """Draw histograms of errors of calibration and flat field, and what the noise predicts."""
    for values, color, label in zip(
        errors, (CALIBRATION, FLAT_FIELD), ("shift calibration", "flat field"), strict=True
    ):
        edges = np.nanmax(np.abs(values)) * np.linspace(-1, 1, 62)
        density = np.histogram(values, edges)[0] / np.isfinite(values).sum() / np.diff(edges)
        axes.stairs(density, edges, color=color, label=label)
    sigmas = np.linspace(-6, 6, 121)
    normal = np.exp(-0.5 * sigmas**2) / (predicted * np.sqrt(2 * np.pi))
    axes.plot(predicted * sigmas, normal, color=PREDICTION, linestyle=":", label="noise predicts")
    axes.set(
        title=title,
        xlabel="error, %",
        ylabel="density",
        yscale="log",
        ylim=(normal.max() / 1e4, 30 * normal.max()),
    )
    axes.legend(loc="upper right", fontsize="small")


def _history(axes: Axes, calibration: Calibration) -> None:
    """Draw the estimated largest error of the sensitivity by sweep."""
    history = calibration.history
    axes.semilogy(history["sweep"], 100 * history["error_estimate"], marker="o", color=CALIBRATION)
    axes.set(title="Estimated distance from the optimum, %", xlabel="sweep", ylabel="%")
    axes.grid(alpha=0.3)


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
    low, high = np.nanpercentile(after, (0.5, 99.5))
    images = {"Last frame, raw": sequence.last, "Last frame, corrected": after}
    for col, (title, image) in enumerate(images.items()):
        draw_map(figure.add_subplot(grid[0, col]), title, image, (float(low), float(high)), "gray")
    axes = figure.add_subplot(grid[1, :])
    axes.plot(sequence.points, sequence.raw, color="0.5", label="raw")
    axes.plot(sequence.points, sequence.corrected, label="corrected")
    axes.set(xlabel="frame", ylabel="roughness", ylim=(0, None))
    axes.legend()
    return figure

"""Pictures of a calibration; they need matplotlib, the extra ``plot``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.errors import EquipixError, InputError
from equipix.io import write_whole
from equipix.maps import BLOCK, block_means, rms

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from equipix.calibration.result import Calibration
    from equipix.comparison import Comparison
    from equipix.demo import Demo
    from equipix.plan import ErrorBudget

_CALIBRATION, _FLAT_FIELD, _PREDICTION = "C0", "C1", "black"


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
        raise EquipixError(
            "pictures need matplotlib, which is not installed: pip install 'equipix[plot]'"
        ) from error
    return Figure(figsize=(width, height), layout="constrained")


def check_picture(path: Path) -> None:
    """Refuse a picture that cannot be drawn, before the work starts.

    Raises
    ------
    EquipixError
        If matplotlib is not installed.
    InputError
        If it does not know the suffix.
    """
    formats = new_figure(1, 1).canvas.get_supported_filetypes()
    if path.suffix.lower().removeprefix(".") not in formats:
        raise InputError(f"'{path}' is no name of a picture: end it in {', '.join(formats)}")


def save_figure(figure: Figure, path: Path, *, force: bool = False) -> None:
    """Write a figure to a file whose suffix names the format; it appears whole or not at all.

    Raises
    ------
    FileError
        If the file exists and `force` is not set, or cannot be written.
    """
    with write_whole(path, force=force) as temporary:
        figure.savefig(temporary)


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
    measured = demo.calibration.sensitivity / np.nanmean(demo.calibration.sensitivity)
    low, high = np.nanpercentile(demo.truth, (0.1, 99.9))
    sensitivities = {
        "True sensitivity": demo.truth,
        "Shift calibration": measured,
        "Flat field, source uneven by 1 %": demo.flat_field,
    }
    for axes, (title, image) in zip(rows[0], sensitivities.items(), strict=True):
        _map(axes, title, image, (low, high), "gray")
    errors = [100 * block_means(error) for error in (demo.error, demo.flat_field_error)]
    limit = float(np.nanmax(np.abs(errors[1])))
    _map(
        rows[1, 0],
        f"Error of shift calibration, %\n(16×16 means, rms {rms(errors[0]):.1g})",
        errors[0],
        (-limit, limit),
        "RdBu_r",
        BLOCK,
    )
    _map(
        rows[1, 1],
        f"Error of flat field, %\n(16×16 means, rms {rms(errors[1]):.1g})",
        errors[1],
        (-limit, limit),
        "RdBu_r",
        BLOCK,
    )
    _profiles(rows[1, 2], *errors)
    predicted, predicted_blocks = (100 * value for value in demo.predicted)
    pixels = [100 * error for error in (demo.error, demo.flat_field_error)]
    _distributions(rows[2, 0], "Errors of pixels", pixels, predicted)
    _distributions(rows[2, 1], "Errors of 16×16 means", errors, predicted_blocks)
    _history(rows[2, 2], demo.calibration)
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
    shown = [_thinned(budget.noise_map) for budget in budgets]
    finite = np.concatenate([values[np.isfinite(values)] for values, _ in shown])
    limits = (float(finite.min()), float(finite.max()))
    largest = max(max(b.rms_by_cause.values()) for b in budgets if np.isfinite(b.rms))
    for row, budget, (values, step) in zip(rows, budgets, shown, strict=True):
        _positions(row[0], budget)
        _spectrum(row[1], budget)
        rms = budget.rms_by_cause["noise"]
        _map(row[2], f"Error from noise (rms {rms:.2g})", values, limits, "viridis", step)
        _causes(row[3], budget, 1.15 * largest)
    return figure


def _thinned(image: NDArray[Any]) -> tuple[NDArray[Any], int]:
    """Leave out rows and columns of a map that no picture could show."""
    step = max(1, max(image.shape) // 1000)
    return image[::step, ::step], step


def _positions(axes: Axes, budget: ErrorBudget) -> None:
    """Draw where the sensor stands in each exposure."""
    rows, cols = budget.shifts.T
    axes.plot(cols, rows, color="gray", linewidth=0.6, linestyle=":")
    axes.plot(cols, rows, "o", color=_CALIBRATION)
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
    """Draw a bar for each cause of error."""
    names = [name.replace("_", "\n") for name in budget.rms_by_cause]
    bars = axes.bar(names, list(budget.rms_by_cause.values()), color=("C0", "C1", "C2"))
    axes.bar_label(bars, fmt="%.1e", fontsize="small")
    axes.set(title="rms error of M by cause", ylim=(0, limit))


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
    for each, label in zip(differences, labels, strict=True):
        rows[0, 1].plot(each[middle], linewidth=0.7, label=label)
    rows[0, 1].set(title=f"Differences along row {middle}, %", xlabel="column")
    rows[0, 1].legend(fontsize="small")
    scatter = 100 * comparison.agreement
    high = float(np.nanpercentile(scatter, 99.9))
    title = f"Scatter of a pixel, %\n(rms {rms(scatter):.2g})"
    _map(rows[1, 0], title, scatter, (0, high), "gray")
    worst = int(np.argmax(comparison.block_rms))
    limit = float(np.nanmax(np.abs(blocks[worst])))
    title = f"{labels[worst]}, %\n(16×16 means, rms {rms(blocks[worst]):.2g})"
    _map(rows[1, 1], title, blocks[worst], (-limit, limit), "RdBu_r", BLOCK)
    for axes, title, errors, predicted in (
        (rows[2, 0], "Differences of pixels", differences, comparison.predicted_rms),
        (rows[2, 1], "Differences of 16×16 means", blocks, comparison.predicted_block_rms),
    ):
        known = predicted is not None and np.isfinite(predicted).all()
        expected = 100 * float(rms(np.asarray(predicted))) if known else None
        _densities(axes, title, dict(zip(labels, errors, strict=True)), expected)
    return figure


def _lines(axes: Axes, profiles: NDArray[Any], names: Sequence[str]) -> None:
    """Draw profiles one over the other, the later thinner, so that each is seen."""
    part = slice(profiles.shape[1] // 2, profiles.shape[1] // 2 + 60)
    columns = np.arange(profiles.shape[1])[part]
    for index, (profile, name) in enumerate(zip(profiles, names, strict=True)):
        width = max(1.0, 5 / (index + 1))
        axes.plot(columns, profile[part], linewidth=width, label=name)
    axes.set(title="Sensitivity along a part of the middle row", xlabel="column")
    axes.legend(fontsize="small")


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
        axes.plot(edges, normal, color=_PREDICTION, linestyle=":", label=label)
        highest = max(highest, float(normal.max()))
    axes.set(
        title=title,
        xlabel="difference, %",
        ylabel="density",
        yscale="log",
        ylim=(0.5 / count / width, 30 * highest),
    )
    axes.legend(loc="upper right", fontsize="small")


def _map(
    axes: Axes,
    title: str,
    image: NDArray[Any],
    limits: tuple[float, float],
    cmap: str,
    step: int = 1,
) -> None:
    rows, cols = (step * size for size in image.shape)
    extent = (-0.5, cols - 0.5, rows - 0.5, -0.5)
    shown = axes.imshow(image, vmin=limits[0], vmax=limits[1], cmap=cmap, extent=extent)
    axes.set(title=title, xlabel="column", ylabel="row")
    axes.figure.colorbar(shown, ax=axes, shrink=0.8)


def _profiles(axes: Axes, calibration: NDArray[Any], flat_field: NDArray[Any]) -> None:
    """Draw the errors of block means along the middle row of blocks."""
    middle = len(calibration) // 2
    cols = BLOCK * (np.arange(calibration.shape[1]) + 0.5)
    axes.plot(cols, flat_field[middle], color=_FLAT_FIELD, label="flat field")
    axes.plot(cols, calibration[middle], color=_CALIBRATION, label="shift calibration")
    axes.axhline(0, color="gray", linewidth=0.5)
    axes.set(title="Both along the middle row, %", xlabel="column")
    axes.legend()


def _distributions(axes: Axes, title: str, errors: list[NDArray[Any]], predicted: float) -> None:
    """Draw histograms of errors of calibration and flat field, and what the noise predicts."""
    for values, color, label in zip(
        errors, (_CALIBRATION, _FLAT_FIELD), ("shift calibration", "flat field"), strict=True
    ):
        edges = np.nanmax(np.abs(values)) * np.linspace(-1, 1, 62)
        density = np.histogram(values, edges)[0] / np.isfinite(values).sum() / np.diff(edges)
        axes.stairs(density, edges, color=color, label=label)
    sigmas = np.linspace(-6, 6, 121)
    normal = np.exp(-0.5 * sigmas**2) / (predicted * np.sqrt(2 * np.pi))
    axes.plot(predicted * sigmas, normal, color=_PREDICTION, linestyle=":", label="noise predicts")
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
    axes.semilogy(history.sweep, 100 * history.error_estimate, marker="o", color=_CALIBRATION)
    axes.set(title="Estimated distance from the optimum, %", xlabel="sweep", ylabel="%")
    axes.grid(alpha=0.3)

"""The picture of plans: patterns of shifts, and what errors they leave."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix._check import Array
from equipix.pictures.canvas import CALIBRATION, draw_map, new_figure
from equipix.plan.budget import ErrorBudget

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
        draw_map(row[2], f"Error from noise (rms {rms:.2g})", values, limits, "viridis", step)
        _causes(row[3], budget, 1.15 * largest)
    return figure


def _thinned(image: Array) -> tuple[Array, int]:
    """Leave out rows and columns of a map that no picture could show."""
    step = max(1, max(image.shape) // 1000)
    return image[::step, ::step], step


def _positions(axes: Axes, budget: ErrorBudget) -> None:
    """Draw the positions of the sensor."""
    rows, cols = budget.shifts.T
    axes.plot(cols, rows, color="gray", linewidth=0.6, linestyle=":")
    axes.plot(cols, rows, "o", color=CALIBRATION)
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

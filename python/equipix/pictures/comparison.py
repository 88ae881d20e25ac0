"""The picture of a comparison: how far calibrations of one sensor agree."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.maps import BLOCK, block_means, rms
from equipix.pictures.canvas import PREDICTION, draw_map, new_figure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from equipix.comparison import Comparison


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

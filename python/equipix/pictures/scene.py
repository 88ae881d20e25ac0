"""The picture of a correction from the scene: before and after, and the quality over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.pictures.canvas import draw_map, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from equipix.correction.protocol import Correction
    from equipix.scene.sequence import Sequence


def draw_sequence(sequence: Sequence, correction: Correction) -> Figure:
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

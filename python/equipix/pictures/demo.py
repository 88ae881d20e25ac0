"""The picture of the demo: a calibration and a flat field against the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.maps import BLOCK, block_means, rms
from equipix.pictures.canvas import CALIBRATION, FLAT_FIELD, PREDICTION, draw_map, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from equipix.calibration.result import Calibration
    from equipix.demo import Demo


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
    axes.semilogy(history.sweep, 100 * history.error_estimate, marker="o", color=CALIBRATION)
    axes.set(title="Estimated distance from the optimum, %", xlabel="sweep", ylabel="%")
    axes.grid(alpha=0.3)

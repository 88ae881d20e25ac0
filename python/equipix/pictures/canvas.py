"""What all pictures share: figures, files, maps, colours."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from equipix._check import Array
from equipix.errors import EquipixError, InputError
from equipix.io.paths import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CALIBRATION, PREDICTION = "C0", "black"
"""Colours of what is drawn in several pictures."""


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
        raise InputError(
            f"'{path}' is not the name of a picture, expected the suffix {' or '.join(formats)}"
        )


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

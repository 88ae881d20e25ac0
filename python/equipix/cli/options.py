"""Options that several commands share."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equipix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

Force = Annotated[bool, typer.Option("--force", help="Replace an existing output.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Threads; all processors unless given.")]
Tolerance = Annotated[float, typer.Option(help="Largest relative error of the sensitivity.")]
MaxSweeps = Annotated[int | None, typer.Option(min=1, help="Stop after so many sweeps.")]
Uncertainty = Annotated[
    bool, typer.Option("--uncertainty", help="Find the standard deviation of every pixel.")
]
Saturation = Annotated[
    float | None, typer.Option(help="Saturation level in DN; the largest value unless given.")
]
Mask = Annotated[
    Path | None,
    typer.Option(help="An image or .npy: pixels that are not 0 in it are not used."),
]
Cfa = Annotated[
    str | None,
    typer.Option(
        help="Colour filters of the pixels: RGGB, GRBG, GBRG or BGGR, or the rows of one period, "
        "such as RRGG/RRGG/GGBB/GGBB, or RGBW/ of one row."
    ),
]
Sensor = Annotated[
    str | None,
    typer.Option(
        help="Name of the sensor that gave the frames: another than the file's is refused."
    ),
]


@contextmanager
def naming_mask(file: Path | None) -> Iterator[None]:
    """Name the file in messages on the mask that was read from it."""
    try:
        yield
    except InputError as error:
        if file is None or not str(error).startswith("'mask'"):
            raise
        raise InputError(f"{file}: {error}") from error


Picture = Annotated[
    Path | None, typer.Option("--output", "-o", help="A picture: .png, .pdf or .svg.")
]
Seed = Annotated[int, typer.Option("--rng", min=0, help="Seed of the random numbers.")]
Shape = Annotated[
    tuple[int, int], typer.Option(min=48, help="Rows and columns of the sensor, 48 or more.")
]

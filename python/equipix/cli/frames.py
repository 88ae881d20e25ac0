"""Commands about frames: average, correct."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from equipix._types import Flagged
from equipix.cli.options import Force, Json, Mask, Saturation, Workers, naming_mask
from equipix.cli.summary import of_statistics
from equipix.cli.terminal import check_output, progress_bars, show_result
from equipix.correction.files import correct_files, is_folder
from equipix.errors import InputError
from equipix.experiment.repeats import refuse_repeated_files
from equipix.frames import average as average_frames
from equipix.frames import refuse_subtracted
from equipix.io import SUFFIXES, find_files, read_mask, refuse_inputs
from equipix.loading import load

commands = typer.Typer()

_OTHER_FORMATS = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".fits", ".fit", ".npz", ".npy")
"""Formats of images that `correct` does not write."""


@commands.command(epilog="Example: equipix average frames/*.png --dark 'dark/*.png' -o mean.tif")
def average(
    source: Annotated[list[str], typer.Argument(help="Image files or globs; or one average.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Statistics: .tif or .npz.")],
    dark: Annotated[
        list[str] | None, typer.Option(help="Dark frames or their average, to be subtracted.")
    ] = None,
    saturation: Saturation = None,
    mask: Mask = None,
    workers: Workers = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Mean and variance of every pixel over many frames."""
    check_output(output, force=force, suffixes=SUFFIXES)
    images, offsets = find_files(source), find_files(dark) if dark else []
    refuse_inputs([output], [*images, *offsets, *([mask] if mask else [])])
    refuse_repeated_files(images, offsets)
    excluded = None if mask is None else read_mask(mask)
    with progress_bars() as progress, naming_mask(mask):
        offset = None
        if dark:
            offset = average_frames(dark, saturation=saturation, workers=workers, progress=progress)
            refuse_subtracted(offset, " ".join(dark))
        frames = average_frames(
            source,
            dark=offset,
            saturation=saturation,
            mask=excluded,
            workers=workers,
            progress=progress,
        )
    frames.save(output, force=force)
    result = {"output": str(output), **of_statistics(frames)}
    show_result(result, as_json=as_json)


@commands.command(epilog="Example: equipix correct cal.tif raw/*.tif -o corrected/")
def correct(
    calibration: Annotated[Path, typer.Argument(help="A calibration: .tif or .npz.")],
    frames: Annotated[list[str], typer.Argument(help="Image files or globs.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="A .tif of all frames, or a folder of files.")
    ],
    dark: Annotated[
        str, typer.Option(help="'stored', 'none', or a file: dark frames or their average.")
    ] = "stored",
    flagged: Annotated[Flagged, typer.Option(help="What flagged pixels become.")] = "nan",
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Divide frames by the sensitivity, their dark level subtracted."""
    _refuse_image(output)
    check_output(output, force=force, folder=is_folder(output))
    refuse_inputs([output], [calibration])
    with progress_bars() as progress:
        done = correct_files(
            load(calibration),
            frames,
            output,
            dark=dark,
            flagged=flagged,
            force=force,
            progress=progress,
        )
    show_result({"output": str(output), "frames": done}, as_json=as_json)


def _refuse_image(output: Path) -> None:
    """Refuse a folder that is named like a file of another format."""
    if output.suffix.lower() in _OTHER_FORMATS and not output.is_dir():
        raise InputError(
            f"'{output}' ends in '{output.suffix}', but corrected frames are written as .tif: name "
            "a .tif file, or a folder for a .tif of each input"
        )

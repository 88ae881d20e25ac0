"""Commands about frames: average, correct."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from equipix._check import Display, Flagged, OutputType
from equipix.cli.summary import of_statistics
from equipix.cli.terminal import (
    Force,
    Json,
    Mask,
    Saturation,
    Sensor,
    Workers,
    check_output,
    naming_mask,
    progress_bars,
    show_result,
)
from equipix.correction.correct_files import Corrected, correct_files, is_folder
from equipix.errors import InputError, MisfitWarning, warn
from equipix.experiment.image_files import origin_of, refuse_repeated_files
from equipix.io.formats import SUFFIXES
from equipix.io.frames import read_mask
from equipix.io.paths import find_files, refuse_inputs
from equipix.loading import load_correction
from equipix.measured.average import average as average_frames
from equipix.measured.statistics import (
    STRAY,
    light_of,
    refuse_subtracted,
    saved_shape,
    warn_of_bright_dark,
)

commands = typer.Typer()

_OTHER_FORMATS = (".jpg", ".jpeg", ".bmp", ".pgm", ".fits", ".fit", ".npz", ".npy")
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
    reject: Annotated[
        float | None,
        typer.Option(help="Leave out samples by so many standard deviations: cosmic rays, 5."),
    ] = None,
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
            averaged = any(saved_shape(file) for file in offsets)
            offset = average_frames(
                dark,
                saturation=saturation,
                reject=None if averaged else reject,
                workers=workers,
                progress=progress,
            )
            refuse_subtracted(offset, " ".join(dark))
        frames = average_frames(
            source,
            dark=offset,
            saturation=saturation,
            mask=excluded,
            reject=reject,
            workers=workers,
            progress=progress,
        )
    warn_of_bright_dark(frames)
    if (light := light_of(frames)).over_noise > STRAY:
        warn(f"{light.words} (limit {STRAY:g}): see that all are of one measurement", MisfitWarning)
    frames.save(output, force=force)
    result = {"output": str(output), **of_statistics(frames)}
    show_result(result, as_json=as_json)


@commands.command(epilog="Example: equipix correct cal.tif raw/*.tif -o corrected/")
def correct(
    correction: Annotated[Path, typer.Argument(help="A calibration or a response: .tif or .npz.")],
    frames: Annotated[list[str], typer.Argument(help="Image files or globs.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="A .tif of all frames, a .png of one, or a folder of files."
        ),
    ],
    dark: Annotated[
        str, typer.Option(help="'stored', 'none', or a file: dark frames or their average.")
    ] = "stored",
    flagged: Annotated[
        Flagged | None,
        typer.Option(
            help="What flagged pixels become. Unless given, NaN in floating-point numbers; in "
            "whole numbers and pictures the mean of good neighbours."
        ),
    ] = None,
    dtype: Annotated[
        OutputType | None,
        typer.Option(
            help="Type of the result: whole numbers are rounded half to even, and values that had "
            "to be limited are counted. float32 unless given; uint16 for a .png."
        ),
    ] = None,
    bit_depth: Annotated[
        int | None, typer.Option(help="Significant bits of whole numbers, 8 to 16.")
    ] = None,
    display: Annotated[
        Display | None,
        typer.Option(
            help="8-bit pictures: 'linear' between the percentiles 0.5 and 99.5 of each frame, or "
            "by its 'histogram' with a plateau of 4 times the mean of its bins."
        ),
    ] = None,
    sensor: Sensor = None,
    workers: Workers = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Correct frames by a calibration or by response curves."""
    _refuse_image(output)
    check_output(output, force=force, folder=is_folder(output))
    refuse_inputs([output], [correction])
    with progress_bars() as progress:
        done = correct_files(
            load_correction(correction),
            frames,
            output,
            dark=dark,
            flagged=flagged,
            dtype=dtype,
            bit_depth=bit_depth,
            display=display,
            sensor=sensor,
            workers=workers,
            origin=origin_of(correction),
            force=force,
            progress=progress,
        )
    counts = _counts(done, whole=done.dtype != "float32" and display is None)
    result = {"output": str(output), "frames": done.frames, "dtype": done.dtype, **counts}
    show_result(result, as_json=as_json)


def _counts(done: Corrected, *, whole: bool) -> dict[str, Any]:
    """Collect what was counted, as far as it can differ from 0."""
    counts = {"limited_values": done.limited} if whole else {}
    if done.extrapolated is not None:
        counts["extrapolated_values"] = done.extrapolated
    if done.replaced:
        counts["replaced_pixels"] = done.replaced
    if done.flagged:
        counts["unusable_pixels"] = done.flagged
    return counts


def _refuse_image(output: Path) -> None:
    """Refuse a folder that is named like a file of another format."""
    if output.suffix.lower() in _OTHER_FORMATS and not output.is_dir():
        raise InputError(
            f"'{output}' ends in '{output.suffix}', but corrected frames are written as .tif: name "
            "a .tif file, a .png, or a folder for a .tif of each input"
        )

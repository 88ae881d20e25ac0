"""Commands about frames: average, correct."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from equipix.cli import terminal
from equipix.correction.correct_files import correct_files, is_folder
from equipix.errors import InputError
from equipix.experiment.darks import average_findings
from equipix.experiment.image_files import origin_of, refuse_repeated_files, with_inputs
from equipix.findings import ask, say
from equipix.io.formats import SUFFIXES
from equipix.io.paths import find_files, refuse_inputs
from equipix.measured import statistics
from equipix.measured.average import average as average_frames
from equipix.report.figures import known
from equipix.saved_results import READ, load_correction

commands = typer.Typer()


@commands.command(epilog="Example: equipix average frames/*.png --dark 'dark/*.png' -o mean.tif")
@terminal.options_of(
    average_frames,
    saturation="Saturation level in DN; the largest value unless given.",
    reject="Leave out samples by so many standard deviations: cosmic rays, 5.",
)
def average(
    frames: Annotated[list[str], typer.Argument(help="Image files or globs; or one average.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Statistics: .tif or .npz.")],
    dark: Annotated[
        list[str] | None, typer.Option(help="Dark frames or their average, to be subtracted.")
    ] = None,
    mask: terminal.Mask = None,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Mean and variance of every pixel over many frames."""
    terminal.check_output(output, force=force, suffixes=SUFFIXES)
    found = averaged(frames, dark, output, mask, workers=workers, **options)
    terminal.show_saved(output, found, force=force, as_json=as_json)


def averaged(
    frames: list[str], dark: list[str] | None, output: Path, mask: Path | None, **options: Any
) -> statistics.FrameStatistics:
    """Average frames, less their dark, with findings and the hashes of the files."""
    images, offsets = find_files(frames), find_files(dark) if dark else []
    refuse_inputs([output], [*images, *offsets, *terminal.given(mask)])
    hashes = refuse_repeated_files(images, offsets)
    with terminal.working(mask) as (progress, excluded):
        offset = None
        if dark:
            is_saved = any(statistics.saved_shape(file) for file in offsets)
            of_dark = options | ({"reject": None} if is_saved else {})
            offset = average_frames(dark, progress=progress, **of_dark)
            statistics.refuse_subtracted(offset, " ".join(dark))
        found = average_frames(frames, dark=offset, mask=excluded, progress=progress, **options)
    said = say(*average_findings(images, offsets), *ask(statistics.AVERAGED, found))
    return replace(found, findings=said, metadata=with_inputs(found.metadata, hashes))


@commands.command(epilog="Example: equipix correct cal.tif raw/*.tif -o corrected/")
@terminal.options_of(
    correct_files,
    dark="'stored', 'none', or a file: dark frames or their average.",
    flagged="What flagged pixels become. Unless given, NaN in floating-point numbers; in whole "
    "numbers and pictures the mean of good neighbours.",
    dtype="Type of the result: whole numbers are rounded half to even, and values that had to be "
    "limited are counted. float32 unless given; uint16 for a .png.",
    bit_depth="Significant bits of whole numbers, 8 to 16.",
    display="8-bit pictures: 'linear' between the percentiles 0.5 and 99.5 of each frame, or by "
    "its 'histogram' with a plateau of 4 times the mean of its bins.",
)
def correct(
    correction: Annotated[Path, typer.Argument(help=f"A correction: {READ}.")],
    frames: Annotated[list[str], typer.Argument(help="Image files or globs.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="A .tif of all frames, a .png of one, or a folder of files."
        ),
    ],
    sensor: terminal.Sensor = None,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Correct frames by a calibration or by response curves."""
    _refuse_image(output)
    terminal.check_output(output, [correction], force=force, folder=is_folder(output))
    with terminal.working() as (progress, _):
        done = correct_files(
            load_correction(correction),
            frames,
            output,
            sensor=sensor,
            workers=workers,
            origin=origin_of(correction),
            force=force,
            progress=progress,
            **options,
        )
    whole = done.dtype != "float32" and options["display"] is None
    counts = known(
        limited_values=done.limited if whole else None,
        extrapolated_values=done.extrapolated,
        replaced_pixels=done.replaced or None,
        unusable_pixels=done.flagged or None,
    )
    result = {"output": str(output), "frames": done.frames, "dtype": done.dtype, **counts}
    terminal.show_result(result, done.findings, as_json=as_json)


def _refuse_image(output: Path) -> None:
    """Refuse a new folder that is named like a file of another format."""
    if output.suffix and is_folder(output) and not output.is_dir():
        raise InputError(
            f"'{output}' ends in '{output.suffix}', but corrected frames are written as .tif: name "
            "a .tif, a .png of one frame, or a folder (one with a dot in its name: make it first)"
        )

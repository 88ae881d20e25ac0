"""Commands about frames: average, correct."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from equipix.cli import terminal
from equipix.correction.correct_files import correct_files, is_folder
from equipix.errors import InputError
from equipix.experiment.image_files import origin_of, refuse_repeated_files, with_inputs
from equipix.findings import ask, say
from equipix.io.formats import SAVED, SUFFIXES, frame_files
from equipix.io.paths import refuse_inputs
from equipix.measured import statistics
from equipix.measured.average import average as average_frames
from equipix.measured.settings import average_findings
from equipix.report.figures import known
from equipix.saved_results import READ, load_correction

commands = typer.Typer()


@commands.command(epilog="Example: equipix average frames/*.png --dark 'dark/*.png' -o mean.tif")
@terminal.options_of(
    average_frames,
    saturation="Saturation level in DN. Unless given, the largest value of whole numbers.",
    reject="Leave out samples that lie more than this many standard deviations off, such as "
    "cosmic rays; 5 is usual.",
)
def average(
    frames: Annotated[
        list[str], typer.Argument(help="Image files or globs, or one saved average.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help=f"Statistics: {SAVED}.")],
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
    images, offsets = frame_files(frames), frame_files(dark) if dark else []
    paths, of_darks = ([each.path for each in files] for files in (images, offsets))
    refuse_inputs([output], [*paths, *of_darks, *terminal.given(mask)])
    hashes = refuse_repeated_files(paths, of_darks)
    with terminal.working(mask) as (progress, excluded):
        offset = None
        if offsets:
            is_saved = any(map(statistics.is_average, offsets))
            of_dark = options | ({"reject": None} if is_saved else {})
            offset = average_frames(offsets, progress=progress, **of_dark)
            statistics.refuse_subtracted(offset, str(of_darks[0]))
        found = average_frames(images, dark=offset, mask=excluded, progress=progress, **options)
    said = say(*average_findings(images, offsets), *ask(statistics.AVERAGED, found))
    return replace(found, findings=said, metadata=with_inputs(found.metadata, hashes))


@commands.command(epilog="Example: equipix correct cal.tif raw/*.tif -o corrected/")
@terminal.options_of(
    correct_files,
    dark="'stored', which it is unless given, 'none', or dark frames or their average, a pattern "
    "in quotes: --dark 'd*.fits'. Given once for each exposure time or temperature, each frame "
    "takes the one that fits by its header, or one interpolated between two times.",
    flagged="What flagged pixels become. Unless given, NaN in floating-point numbers; in whole "
    "numbers and pictures the mean of good neighbours.",
    dtype="Type of the result: whole numbers are rounded half to even, and values that had to be "
    "limited are counted. float32 unless given; uint16 for a .png.",
    bit_depth=typer.Option(min=8, max=16, help="Significant bits of whole numbers."),
    display="8-bit pictures, in no .fits: 'linear' between the percentiles 0.5 and 99.5 of each "
    "frame, or by its 'histogram' with a plateau of 4 times the mean of its bins.",
)
def correct(
    correction: Annotated[Path, typer.Argument(help=f"A correction: {READ}.")],
    frames: Annotated[list[str], typer.Argument(help="Image files or globs.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="A .tif or .fits of all frames, a .png of one, or a folder: of FITS files .fits "
            "with their headers, of others .tif.",
        ),
    ],
    substrate_c: terminal.SubstrateC = None,
    bias_v: terminal.BiasV = None,
    sensor: terminal.Sensor = None,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Correct frames by a calibration or by response curves."""
    _refuse_image(output)
    terminal.check_output(output, [correction], force=force, folder=is_folder(output))
    applied = load_correction(correction, substrate_c=substrate_c, bias_v=bias_v)
    state = ", ".join(f"{name} {x:g}" for name, x in applied.metadata.get("state", {}).items())
    with terminal.working() as (progress, _):
        done = correct_files(
            applied,
            frames,
            output,
            sensor=sensor,
            workers=workers,
            origin=", ".join(filter(None, (origin_of(correction), state))),
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
        unit="DN" if options["display"] is None else None,
    )
    result = {"output": str(output), "frames": done.frames, "dtype": done.dtype, **counts}
    terminal.show_result(result, done.findings, as_json=as_json)


def _refuse_image(output: Path) -> None:
    """Refuse a new folder that is named like a file of another format."""
    if output.suffix and is_folder(output) and not output.is_dir():
        raise InputError(
            f"'{output}' ends in '{output.suffix}', but corrected frames are written as .tif or "
            ".fits: name one for all frames, a .png of one, or a folder (with a dot in its name: "
            "make it first)"
        )

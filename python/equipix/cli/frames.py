"""Commands about frames: average, correct."""

from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from equipix.batch.averages import average_in, memory_of
from equipix.batch.recordings import correct as correct_recording
from equipix.batch.recordings import named
from equipix.batch.series import remove_work, series_at, work_beside
from equipix.cli import terminal
from equipix.correction.correct_files import correct_files, is_folder
from equipix.errors import InputError
from equipix.experiment.image_files import refuse_repeated_files, with_inputs
from equipix.findings import ask, say
from equipix.io.arrays import ZARR
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
    scheduler: terminal.Scheduler = None,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Mean and variance of every pixel over many frames."""
    terminal.check_output(output, force=force, suffixes=SUFFIXES)
    if scheduler is not None and options["reject"] is not None:
        raise InputError(
            "'reject' (--reject) compares each frame with those before, but 'scheduler' "
            "(--scheduler) takes frames apart: leave out one"
        )
    found = averaged(frames, dark, output, mask, scheduler=scheduler, workers=workers, **options)
    terminal.show_saved(output, found, force=force, as_json=as_json)
    if scheduler is not None:
        remove_work(output)


def averaged(
    frames: list[str],
    dark: list[str] | None,
    output: Path,
    mask: Path | None,
    *,
    scheduler: str | None = None,
    **options: Any,
) -> statistics.FrameStatistics:
    """Average frames, less their dark, with findings and the hashes of the files.

    With the address of a scheduler, workers of a cluster do so beside the output.
    """
    images, offsets = frame_files(frames), frame_files(dark) if dark else []
    paths, of_darks = ([each.path for each in files] for files in (images, offsets))
    refuse_inputs([output], [*paths, *of_darks, *terminal.given(mask)])
    with terminal.working(mask) as (progress, excluded), ExitStack() as stack:
        take: Any = partial(average_frames, progress=progress, **options)
        digests = None
        if scheduler is not None:
            workers = options.pop("workers")
            at = scheduler, work_beside(output), memory_of(images), workers, progress
            series = stack.enter_context(series_at(*at))
            take, digests = partial(average_in, series, **options), series.digests
        hashes = refuse_repeated_files(paths, of_darks, digests)
        if scheduler is not None:
            take = partial(take, hashes=hashes)
        offset = None
        if offsets:
            of_dark = {"reject": None} if any(map(statistics.is_average, offsets)) else {}
            offset = take(offsets, **of_dark)
            statistics.refuse_subtracted(offset, str(of_darks[0]))
        found: statistics.FrameStatistics = take(images, dark=offset, mask=excluded)
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
            help="A .tif, .fits or .zarr of all frames, a .png of one, or a folder: of FITS files "
            ".fits with their headers, of others .tif.",
        ),
    ],
    substrate_c: terminal.SubstrateC = None,
    bias_v: terminal.BiasV = None,
    scheduler: terminal.Scheduler = None,
    sensor: terminal.Sensor = None,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Correct frames by a calibration or by response curves."""
    is_zarr = output.suffix.lower() in ZARR
    if not is_zarr:
        _refuse_image(output)
    if scheduler is not None and not is_zarr:
        raise InputError(
            f"'scheduler' (--scheduler) writes a Zarr array, but '{output}' is none: name a .zarr"
        )
    terminal.check_output(output, [correction], force=force, folder=is_folder(output))
    given: dict[str, Any] = {"sensor": sensor, "workers": workers, "force": force, **options}
    of_state: dict[str, float | None] = {"substrate_c": substrate_c, "bias_v": bias_v}
    with terminal.working() as (progress, _):
        given["progress"] = progress
        if is_zarr:
            if given.pop("display") is not None:
                raise InputError(
                    f"'display' (--display) makes pictures, but '{output}' holds values to "
                    "measure: name a .tif, a .png of one frame or a folder, or leave it out"
                )
            given |= of_state
            done = correct_recording(correction, frames, output, scheduler=scheduler, **given)
        else:
            applied = load_correction(correction, **of_state)
            origin = named(correction, applied)
            done = correct_files(applied, frames, output, origin=origin, **given)
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

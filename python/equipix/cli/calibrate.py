"""Commands about calibrations: calibrate, inspect, compare."""

import warnings
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from equipix.calibration.result import Calibration, refuse_partial
from equipix.cli import terminal
from equipix.comparison import Comparison
from equipix.comparison import compare as compare_calibrations
from equipix.errors import InputError
from equipix.experiment.experiment import Experiment
from equipix.io.formats import SAVED, SUFFIXES
from equipix.io.paths import refuse_inputs
from equipix.io.record import read_record
from equipix.pictures import check_picture, draw_comparison, save_figure
from equipix.report.drawing import draw_result
from equipix.report.figures import COMPARED, rows_of, summary
from equipix.report.limits import in_json, read_limits, refuse_beyond
from equipix.report.page import comparison_checks, comparison_parts, page, write_page
from equipix.saved_results import READ, load

commands = typer.Typer()


@commands.command(epilog="Example: equipix calibrate experiment.toml -o cal.tif")
@terminal.options_of(
    Experiment.run,
    robust="Leave out values that disagree with those of the other exposures.",
    method="Solver: multiscale is fast, coordinate-descent is the paper's and slow.",
    flux="Fit the fluxes: fit, one for each exposure; linear, a line in the times of the file. "
    "Unless given, fluxes are those of the file, or equal.",
    tolerance="Stop where the error of the solver, relative to the sensitivity, is below this.",
    max_sweeps=typer.Option(
        min=1, help="Most passes over the data in each fit; a calibration may take several fits."
    ),
    uncertainty="Compute the standard deviation of every pixel. It takes several times as long as "
    "the calibration, with refined shifts tens of times.",
)
def calibrate(
    experiment: Annotated[
        Path, typer.Argument(help="The experiment.toml; equipix init writes one.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help=f"Calibration: {SAVED}.")],
    mask: terminal.Mask = None,
    partial: Annotated[
        bool,
        typer.Option(
            "--partial", help="Save a result even if it determines less than half of the pixels."
        ),
    ] = False,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Calibrate a sensor from the images of an experiment."""
    terminal.check_output(output, force=force, suffixes=SUFFIXES)
    loaded = Experiment.load(experiment)
    refuse_inputs([output], [experiment, *loaded.files(), *terminal.given(mask)])
    if not partial:
        # `refuse_partial` says the same as an error.
        warnings.filterwarnings("ignore", "the exposures determine only|the fit ended far from")
    with terminal.working(mask) as (progress, excluded):
        calibration = loaded.run(mask=excluded, workers=workers, progress=progress, **options)
    if not partial:
        refuse_partial(calibration, output)
    terminal.show_saved(output, calibration, force=force, as_json=as_json)


@commands.command(epilog="Example: equipix inspect cal.tif -o cal.png")
def inspect(
    file: Annotated[Path, typer.Argument(help=f"A result: {READ}.")],
    output: terminal.Picture = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Show main figures of a result, and draw its maps."""
    terminal.check_output(output, [file], force=force)
    content = load(file)
    check_picture(output)
    result = {"file": str(file), **summary(content)}
    if output is not None:
        save_figure(draw_result(content), output, force=force)
    if output is not None or as_json:
        result["picture"] = output and str(output)
    if as_json and hasattr(content, "metadata"):
        result["metadata"] = content.metadata
    terminal.show_result(result, as_json=as_json)


@commands.command(epilog="Example: equipix compare first.tif second.tif -o agreement.png")
def compare(
    calibrations: Annotated[
        list[Path], typer.Argument(help=f"Calibrations of one sensor: {SAVED}.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="A page: .html, or a picture: .png, .pdf or .svg."),
    ] = None,
    limits: terminal.Limits = None,
    check: terminal.Check = False,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Show how far calibrations of one sensor agree."""
    is_page = output is not None and output.suffix.lower() == ".html"
    terminal.check_output(output, calibrations, force=force)
    wanted = read_limits(limits).comparison
    loaded = [read_record(file, Calibration) for file in calibrations]
    if not is_page:
        check_picture(output)
    _refuse_equal(calibrations, loaded)
    result = compare_calibrations(loaded)
    names = [str(file) for file in calibrations]
    judged = {
        f"{names[i]} − {names[j]}": comparison_checks(
            result, k, loaded[i].findings + loaded[j].findings, wanted
        )
        for k, (i, j) in enumerate(result.pairs)
    }
    if output is not None and is_page:
        parts = comparison_parts(result, calibrations, loaded, judged)
        text = page(parts, "Calibrations compared")
        write_page(output, text, force=force)
    elif output is not None:
        stems = [file.stem for file in calibrations]
        save_figure(draw_comparison(result, stems), output, force=force)
    predicted = None if result.predicted_rms is None else result.predicted_rms.tolist()
    pairs: list[dict[str, Any]] = [
        {
            "files": [names[i] for i in pair],
            "rms": float(result.rms[k]),
            "block_rms": float(result.block_rms[k]),
            "largest": float(result.largest[k]),
            "tilt_compared": not result.open_tilt[k],
            "predicted_rms": predicted and predicted[k],
            "verdict": result.verdicts[k],
            "checks": [each._asdict() | {"passed": each.passed} for each in result.checks[k]],
        }
        | ({} if limits is None else {"limits": in_json(checks)})
        for (k, pair), checks in zip(enumerate(result.pairs), judged.values(), strict=True)
    ]
    pixels = summary(result)["pixels_compared"]
    if as_json:
        told = {"output": output and str(output), "pixels": pixels, "pairs": pairs}
        terminal.show_result(told, as_json=True)
    else:
        written = {"output": str(output)} if output else {}
        _show_pairs(pairs, result, written | {"pixels compared": pixels})
    if limits is not None and not as_json:
        terminal.show_limits(judged)
    if check:
        why = {
            each.removeprefix("not judged: ") for each in result.verdicts if "not judged" in each
        }
        refuse_beyond(judged, f"{'; '.join(sorted(why))}, or give --limits")


def _show_pairs(pairs: list[dict[str, Any]], result: Comparison, words: dict[str, Any]) -> None:
    """Print what each pair differs by and its verdict, and then `words`."""
    for number, pair in enumerate(pairs):
        print(f"{' − '.join(pair['files'])}: {pair['verdict']}")  # noqa: T201
        terminal.show_table(COMPARED, rows_of(result, number))
    if result.open_tilt.any():
        open_ = [pair["files"] for pair in pairs if not pair["tilt_compared"]]
        words["tilt"] = "left out: free fluxes leave it undetermined in one or more of " + (
            ", ".join(sorted({file for files in open_ for file in files}))
        )
    terminal.show_result(words, as_json=False)


def _refuse_equal(files: list[Path], calibrations: list[Calibration]) -> None:
    """Refuse one calibration given twice: independent experiments differ by their noise."""
    for (one, first), (other, second) in combinations(zip(files, calibrations, strict=True), 2):
        if np.array_equal(first.sensitivity, second.sensitivity, equal_nan=True):
            raise InputError(
                f"'{one}' and '{other}' hold one calibration, so that their agreement says "
                "nothing: name calibrations of independent experiments"
            )

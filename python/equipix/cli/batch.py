"""The command batch: many manifests, on this machine or on a cluster."""

from pathlib import Path
from typing import Annotated, Any

import typer

from equipix.batch.run import run
from equipix.cli import terminal
from equipix.errors import EquipixError
from equipix.experiment.experiment import Experiment
from equipix.experiment.level_experiment import LevelExperiment
from equipix.io.formats import SUFFIXES
from equipix.io.paths import find_files

commands = typer.Typer()

_MOST_REASONS = 10
"""Most sensors whose reason is printed."""


@commands.command(epilog="Example: equipix batch 'lot-*/experiment.toml' -o results/")
@terminal.options_of(
    Experiment.run,
    LevelExperiment.run,
    robust="experiment.toml: leave out values that disagree with those of other exposures.",
    method="experiment.toml: multiscale or coordinate-descent.",
    flux="experiment.toml: fit the fluxes, fit or linear.",
    tolerance="experiment.toml: stop where the error of the solver is below this.",
    uncertainty="experiment.toml: compute the standard deviation of every pixel.",
    order="levels.toml: highest power of the mean of the array, 0 to 3, or auto.",
    by="levels.toml: what a one-point correction changes, offset or gain.",
)
def batch(
    manifests: Annotated[
        list[str],
        typer.Argument(help="Files experiment.toml, levels.toml or camera.toml, or globs of them."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the results.")],
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="A running scheduler of dask, tcp://HOST:PORT; else this machine, local."
        ),
    ] = None,
    suffix: Annotated[
        str, typer.Option(help=f"Format of the results: {', '.join(SUFFIXES)}.")
    ] = ".tif",
    limits: terminal.Limits = None,
    check: terminal.Check = False,
    partial: Annotated[
        bool,
        typer.Option(
            "--partial", help="Save results even if they determine less than half of the pixels."
        ),
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Worker processes on this machine; by processors and memory."),
    ] = None,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Evaluate many manifests, on this machine or on a cluster."""
    files = find_files(manifests)
    given = {name: value for name, value in options.items() if value is not None}
    with terminal.working() as (progress, _):
        lot = run(
            files,
            output,
            scheduler=scheduler,
            limits=limits,
            suffix=suffix,
            partial=partial,
            workers=workers,
            progress=progress,
            **given,
        )
    states = [row.status for row in lot.rows]
    result: dict[str, Any] = {
        "output": str(output),
        "sensors": len(lot.rows),
        **{status: states.count(status) for status in ("done", "kept", "failed")},
    }
    yields = {name: f"{good} of {of}" for name, (good, of) in lot.yields.items()}
    if as_json or yields:
        result["yield"] = yields
    if as_json:
        result["reasons"] = {row.sensor: row.reason for row in lot.failed}
    elif lot.failed:
        reasons = [f"{row.sensor}: {row.reason}" for row in lot.failed[:_MOST_REASONS]]
        more = len(lot.failed) - _MOST_REASONS
        result["reasons"] = "\n".join([*reasons, *([f"and {more} more"] if more > 0 else [])])
    terminal.show_result(result, as_json=as_json)
    if lot.failed:
        raise EquipixError(
            f"{len(lot.failed)} of {len(lot.rows)} sensors gave no result: "
            f"{output / 'lot.html'} says why"
        )
    if check and (beyond := [row.sensor for row in lot.rows if row.verdict != "PASS"]):
        raise EquipixError(
            f"{len(beyond)} of {len(lot.rows)} sensors are beyond a limit, or not judged: "
            f"{', '.join(beyond[:_MOST_REASONS])}"
        )

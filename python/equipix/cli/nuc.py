"""Commands about corrections with a uniform source: nuc fit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from equipix._types import By
from equipix.cli.options import Force, Json, Mask, Workers, naming_mask
from equipix.cli.summary import summary
from equipix.cli.terminal import check_output, progress_bars, show_result
from equipix.experiment.levels import LevelExperiment
from equipix.io import SUFFIXES, read_mask, refuse_inputs

commands = typer.Typer()
nuc = typer.Typer(no_args_is_help=True, help="Correction with a uniform source.")
commands.add_typer(nuc, name="nuc")

_ORDERS = {"0": 0, "1": 1, "2": 2, "3": 3, "auto": "auto"}


@commands.callback()
def _group() -> None: ...


@nuc.callback()
def _nuc() -> None: ...


@nuc.command(epilog="Example: equipix nuc fit levels.toml -o response.tif --order auto")
def fit(
    levels: Annotated[Path, typer.Argument(help="The levels.toml.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Response: .tif or .npz.")],
    order: Annotated[
        Literal["0", "1", "2", "3", "auto"],
        typer.Option(help="0 one-point, 1 two-point, 2 quadratic, 3 cubic; or by held-out levels."),
    ] = "1",
    by: Annotated[By, typer.Option(help="What a one-point correction changes.")] = "offset",
    mask: Mask = None,
    workers: Workers = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Fit the response curves of all pixels to levels of a uniform source."""
    check_output(output, force=force, suffixes=SUFFIXES)
    loaded = LevelExperiment.load(levels)
    refuse_inputs([output], [levels, *loaded.files(), *([mask] if mask else [])])
    with progress_bars() as progress, naming_mask(mask):
        response = loaded.run(
            order=_ORDERS[order],  # type: ignore[arg-type]
            by=by,
            mask=None if mask is None else read_mask(mask),
            workers=workers,
            progress=progress,
        )
    response.save(output, force=force)
    show_result({"output": str(output), **summary(response)}, as_json=as_json)

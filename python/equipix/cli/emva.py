"""The command emva: figures of a camera after EMVA 1288."""

from pathlib import Path
from typing import Annotated

import typer

from equipix.cli import terminal
from equipix.experiment.camera import CameraExperiment
from equipix.io.paths import refuse_inputs
from equipix.report.camera import camera_parts, figures_of
from equipix.report.figures import told
from equipix.report.page import page, write_page

commands = typer.Typer()


@commands.command(epilog="Example: equipix emva camera.toml -o report.html")
def emva(
    camera: Annotated[
        Path, typer.Argument(help="A camera.toml or EMVA1288_Data.txt, or a folder that holds one.")
    ],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="A page: .html.")] = None,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Figures of a camera after EMVA 1288, and a page of them."""
    terminal.check_output(output, force=force, suffixes=(".html",))
    loaded = CameraExperiment.load(camera)
    refuse_inputs(terminal.given(output), [loaded.path, *loaded.files()])
    with terminal.working() as (progress, _):
        planes = loaded.figures(workers=workers, progress=progress)
    if output is not None:
        text = page(camera_parts(loaded.path.parent.resolve().name, planes), "Figures of a camera")
        write_page(output, text, force=force)
    if as_json:
        of_planes = {
            name: {each.key: each.value for each in figures_of(found)} | told(found.findings)
            for name, found in planes.items()
        }
        every = dict.fromkeys(each for found in planes.values() for each in found.findings)
        result = {"output": output and str(output), **of_planes.get("", of_planes)}
        terminal.show_result(result, tuple(every), as_json=True)
        return
    rows = zip(*map(figures_of, planes.values()), strict=True)
    terminal.show_table(
        ("figure", "unit", *planes),
        ((each[0].name, each[0].unit, *(figure.number for figure in each)) for each in rows),
    )

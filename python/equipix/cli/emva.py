"""The command emva: figures of a camera after EMVA 1288."""

from pathlib import Path
from typing import Annotated

import typer

from equipix.cli import terminal
from equipix.experiment.camera import CameraExperiment
from equipix.io.paths import refuse_inputs
from equipix.report.camera import bounds_of, camera_checks, camera_parts, figures_of, rows_of
from equipix.report.figures import findings_entry
from equipix.report.limits import in_json, read_limits, refuse_beyond
from equipix.report.page import page, write_page

commands = typer.Typer()


@commands.command(epilog="Example: equipix emva camera.toml -o report.html")
def emva(
    camera: Annotated[
        Path, typer.Argument(help="A camera.toml or EMVA1288_Data.txt, or a folder that holds one.")
    ],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="A page: .html.")] = None,
    limits: terminal.Limits = None,
    check: terminal.Check = False,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Figures of a camera after EMVA 1288, and a page of them."""
    terminal.check_output(output, force=force, suffixes=(".html",))
    wanted = read_limits(limits, check=check).camera
    loaded = CameraExperiment.load(camera)
    refuse_inputs(terminal.given(output), [loaded.path, *loaded.files()])
    with terminal.working() as (progress, _):
        planes = loaded.figures(workers=workers, progress=progress)
    judged = {
        f"plane {name}" if name else str(camera): camera_checks(found, wanted)
        for name, found in planes.items()
    }
    if output is not None:
        name = loaded.path.parent.resolve().name
        text = page(camera_parts(name, planes, judged.values()), "Figures of a camera")
        write_page(output, text, force=force)
    if as_json:
        of_planes = {
            name: {each.key: each.value for each in figures_of(found)}
            | {"bounds": bounds_of(found)}
            | findings_entry(found.findings)
            | ({} if limits is None else {"limits": in_json(checks)})
            for (name, found), checks in zip(planes.items(), judged.values(), strict=True)
        }
        every = dict.fromkeys(each for found in planes.values() for each in found.findings)
        result = {"output": output and str(output), **of_planes.get("", of_planes)}
        terminal.show_result(result, tuple(every), as_json=True)
    else:
        terminal.show_table(("figure", "unit", *planes), rows_of(planes))
        terminal.show_limits(judged)
        if output is not None:
            terminal.show_result({"output": str(output)}, as_json=False)
    if check:
        refuse_beyond(judged, f"{limits} has no limit for its figures")

"""Commands that pass results on: report, convert."""

from pathlib import Path
from typing import Annotated, Any

import typer

from equipix.cli import terminal
from equipix.errors import InputError
from equipix.hardware.table import Table
from equipix.io.formats import SUFFIXES
from equipix.io.paths import refuse_inputs
from equipix.io.viewed import Use
from equipix.report.limits import in_json, read_limits, refuse_beyond
from equipix.report.page import page, part_of, write_page
from equipix.saved_results import load
from equipix.scene.scene_correction import SceneCorrection

commands = typer.Typer()


@commands.command(
    epilog="Example: equipix report cal.tif -o report.html --limits limits.toml --check"
)
def report(
    results: Annotated[list[Path], typer.Argument(help="Results that equipix has saved.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The page: .html.")],
    limits: terminal.Limits = None,
    check: terminal.Check = False,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Write results as one page, judged by limits."""
    terminal.check_output(output, results, force=force, suffixes=(".html",))
    refuse_inputs(results, [], "is named twice: name each result once")
    wanted = read_limits(limits, check=check)
    parts = [part_of(str(file), load(file), wanted, share=len(results)) for file in results]
    title = f"Report of {results[0].name}" if len(results) == 1 else f"{len(results)} results"
    write_page(output, page(parts, title), force=force)
    judged = {part.name: part.checks for part in parts}
    unjudged = "not judged" if limits or as_json else "not judged (give --limits)"
    result: dict[str, Any] = {
        "output": str(output),
        "verdicts": {part.name: part.verdict or unjudged for part in parts},
    }
    if as_json:
        result["limits"] = {name: in_json(checks) for name, checks in judged.items()}
    terminal.show_result(result, as_json=as_json)
    if not as_json:
        terminal.show_limits(judged)
    if check:
        refuse_beyond(judged, f"{limits} has no limit for their figures")


@commands.command(epilog="Example: equipix convert cal.tif cal.fits --as flat --mean-one")
def convert(
    result: Annotated[Path, typer.Argument(help="A result that equipix has saved.")],
    output: Annotated[
        Path, typer.Argument(help=f"The same result; its suffix is one of {', '.join(SUFFIXES)}.")
    ],
    use: Annotated[
        Use | None,
        typer.Option(
            "--as", help="A flat to divide by, or a gain to multiply by; what the result is."
        ),
    ] = None,
    mean_one: Annotated[
        bool, typer.Option("--mean-one", help="Scale that map to mean 1 over usable pixels.")
    ] = False,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Write a result in another format, for other programs."""
    terminal.check_output(output, [result], force=force)
    content = load(result)
    options: dict[str, Any] = {"use": use, "mean_one": mean_one} if use or mean_one else {}
    if options and isinstance(content, Table | SceneCorrection):
        raise InputError(f"{result}: holds no map for 'use' or 'mean_one': leave them out")
    content.save(output, force=force, **options)
    terminal.show_result({"output": str(output)}, as_json=as_json)

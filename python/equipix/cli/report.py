"""The command report: results as one page, judged by limits."""

from pathlib import Path
from typing import Annotated

import typer

from equipix.cli import terminal
from equipix.errors import EquipixError, InputError
from equipix.io.paths import write_whole
from equipix.report.limits import read_limits
from equipix.report.page import page, part_of
from equipix.saved_results import load

commands = typer.Typer()


@commands.command(
    epilog="Example: equipix report cal.tif -o report.html --limits limits.toml --check"
)
def report(
    results: Annotated[list[Path], typer.Argument(help="Results that equipix has saved.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The page: .html.")],
    limits: Annotated[
        Path | None, typer.Option(help="Limits that the figures must keep: .toml.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="End with status 1 if a figure is beyond its limit.")
    ] = False,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Write results as one page, judged by limits."""
    terminal.check_output(output, results, force=force, suffixes=(".html",))
    if check and limits is None:
        raise InputError("--check needs --limits: equipix init limits writes a file of usual ones")
    wanted = read_limits(limits)
    parts = [part_of(str(file), load(file), wanted, share=len(results)) for file in results]
    title = f"Report of {results[0].name}" if len(results) == 1 else f"{len(results)} results"
    text = page(parts, title)
    with write_whole(output, force=force) as temporary:
        temporary.write_text(text, encoding="utf-8")
    verdicts = {part.name: part.verdict or "not judged" for part in parts}
    terminal.show_result({"output": str(output), "verdicts": verdicts}, as_json=as_json)
    failed = [part.name for part in parts if part.verdict == "FAIL"]
    if check and failed:
        raise EquipixError(f"beyond the limits of {limits}: {', '.join(failed)}")

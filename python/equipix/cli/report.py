"""The command report: results as one page, judged by limits."""

from pathlib import Path
from typing import Annotated

import typer

from equipix.cli import terminal
from equipix.errors import EquipixError, InputError
from equipix.report.limits import limits_template, read_limits
from equipix.report.page import page, part_of, write_page
from equipix.saved_results import load

commands = typer.Typer()


@commands.command(
    epilog="Example: equipix report cal.tif -o report.html --limits limits.toml --check"
)
def report(
    results: Annotated[
        list[Path] | None, typer.Argument(help="Results that equipix has saved.")
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="The page: .html.")] = None,
    limits: Annotated[
        Path | None, typer.Option(help="Limits that the figures must keep: .toml.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="End with status 1 if a figure is beyond its limit.")
    ] = False,
    limits_template_: Annotated[
        Path | None,
        typer.Option("--limits-template", help="Write a file of usual limits, and do no more."),
    ] = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Write results as one page, judged by limits."""
    if limits_template_ is not None:
        write_page(limits_template_, limits_template(), force=force)
        terminal.show_result({"output": str(limits_template_)}, as_json=as_json)
        return
    if not results or output is None:
        raise InputError("name results and the page: equipix report cal.tif --output report.html")
    terminal.check_output(output, results, force=force, suffixes=(".html",))
    if check and limits is None:
        raise InputError("--check needs --limits; --limits-template writes a file of usual ones")
    wanted = read_limits(limits)
    parts = [part_of(str(file), load(file), wanted, share=len(results)) for file in results]
    title = f"Report of {results[0].name}" if len(results) == 1 else f"{len(results)} results"
    write_page(output, page(parts, title), force=force)
    verdicts = {part.name: part.verdict or "not judged" for part in parts}
    terminal.show_result({"output": str(output), "verdicts": verdicts}, as_json=as_json)
    failed = [part.name for part in parts if part.verdict == "FAIL"]
    if check and failed:
        raise EquipixError(f"beyond the limits of {limits}: {', '.join(failed)}")

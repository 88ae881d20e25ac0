"""The command init: a commented file to fill in, with the image files of a folder."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from equipix.cli import terminal
from equipix.experiment.draft import draft_manifest
from equipix.findings import say
from equipix.io.paths import write_whole
from equipix.report.limits import limits_template

commands = typer.Typer()


@commands.command(epilog="Example: equipix init experiment measurement/")
def init(
    kind: Annotated[
        Literal["experiment", "levels", "camera", "limits"],
        typer.Argument(help="The file: for calibrate, nuc fit, emva, or report --limits."),
    ],
    folder: Annotated[
        Path,
        typer.Argument(
            exists=True,
            file_okay=False,
            help="Where the images are, and two folders deep. Their names say what they are: dark; "
            "hole or aperture with before or after and the name of an exposure; science, object, "
            "target, bias and mask are not used; all others have light. What is not used is "
            "listed. Without images the file holds examples.",
        ),
    ] = Path(),
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The file: .toml; in FOLDER unless given."),
    ] = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Write a commented experiment.toml, levels.toml, camera.toml or limits.toml."""
    path = output or folder / f"{kind}.toml"
    terminal.check_output(path, force=force, suffixes=(".toml",))
    result: dict[str, Any] = {"output": str(path)}
    said = None
    if kind == "limits":
        text = limits_template()
    else:
        draft = draft_manifest(kind, folder, path.parent)
        text, said = draft.text, say(*draft.findings)
        result["files_found"] = draft.files_found
        result["files_not_used"] = draft.files_not_used
        result["values_to_fill_in"] = draft.values_to_fill_in
    with write_whole(path, force=force) as temporary:
        # A name that is no UTF-8 becomes one that does not exist: TOML cannot hold it.
        temporary.write_text(text, encoding="utf-8", errors="replace")
    terminal.show_result(result, said, as_json=as_json)

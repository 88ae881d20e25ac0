"""The command watch: what frames determine while the camera writes them."""

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from equipix._check import positive
from equipix.cli import terminal
from equipix.errors import InputError
from equipix.findings import Finding, say
from equipix.live.folder import WatchedFolder
from equipix.live.running import Estimate, Needed, Running

commands = typer.Typer()


@commands.command(epilog="Example: equipix watch measurement/ --until 1e-3")
def watch(
    folder: Annotated[
        Path,
        typer.Argument(
            exists=True, file_okay=False, help="Where the camera writes, with an experiment.toml."
        ),
    ],
    experiment: Annotated[
        Path | None,
        typer.Option(help="The experiment.toml, if it is not that of FOLDER."),
    ] = None,
    until: Annotated[
        float | None,
        typer.Option(help="End with status 0 when the expected error of M is at most this."),
    ] = None,
    max_shift: Annotated[
        tuple[int, int] | None,
        typer.Option(min=0, help="Travel (row, col) within which to look for a next position."),
    ] = None,
    workers: terminal.Workers = None,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print one JSON object a line; an error too, on stderr."),
    ] = False,
) -> None:
    """Show what frames determine while the camera writes them."""
    if until is not None:
        positive("until", until)
    watched = WatchedFolder(folder, experiment or folder / "experiment.toml", workers)
    for findings in watched.changes():
        said = say(*findings)
        if watched.running is None or not len(watched.running.positions):
            continue
        try:
            shown, met = _shown(watched, watched.running, until, max_shift)
        except InputError as error:  # such as frames without light: more may come
            say(Finding("estimate", str(error), "input"))
            continue
        _print(shown, said, as_json=as_json)
        if met:
            return


def _shown(
    watched: WatchedFolder,
    running: Running,
    until: float | None,
    max_shift: tuple[int, int] | None,
) -> tuple[dict[str, Any], bool]:
    """Collect what the frames so far determine, and whether that is enough."""
    positions = running.positions.tolist()
    found = running.estimate() if len(positions) > 1 else None
    met = found is not None and until is not None and found.meets(until) and running.has_dark
    needed = None if met else running.needed(max_shift)
    names = watched.names
    return {
        "positions": [{"exposure": names.get((r, c), ""), "shift": [r, c]} for r, c in positions],
        **_estimated(found),
        "until": until,
        "dark": running.has_dark,
        "met": met if until is not None else None,
        "next": None if needed is None else _next(needed),
        "calibration_findings": [] if found is None else [f.kind for f in found.findings],
    }, met


def _estimated(found: Estimate | None) -> dict[str, Any]:
    if found is None:
        none = ("components", "rms", "rms_by_cause", "tilt_std", "error_estimate")
        return {"determined": 0.0, **dict.fromkeys(none)}
    solved = found.calibration
    return {
        "determined": found.determined,
        "components": found.components,
        "rms": found.rms,
        "rms_by_cause": found.rms_by_cause,
        "tilt_std": list(found.tilt),
        "error_estimate": None if solved is None else solved.error_estimate,
    }


def _next(needed: Needed) -> dict[str, Any]:
    return {
        "shift": list(needed.position),
        "components": needed.components,
        "rms": needed.rms,
    }


def _print(shown: dict[str, Any], said: Any, *, as_json: bool) -> None:
    """Print one line of JSON, or of words."""
    if as_json:
        terminal.show_result(shown, said, as_json=True)
    else:
        print(_in_words(shown))  # noqa: T201
    sys.stdout.flush()


def _in_words(shown: dict[str, Any]) -> str:
    """Write what is determined, and what helps most, in one line."""
    count, last = len(shown["positions"]), shown["positions"][-1]
    row, col = last["shift"]
    words = [f"{count} position{'s' * (count > 1)}, the last {last['exposure']} ({row:g}, {col:g})"]
    if shown["components"] is None:
        words.append("nothing is determined by one")
    elif shown["components"] > 1:
        words.append(f"{shown['components']} parts that nothing compares")
    else:
        words += [f"{shown['determined']:.1%} of the pixels determined", *_error_in_words(shown)]
    if shown["calibration_findings"]:
        words.append(f"findings: {', '.join(shown['calibration_findings'])}")
    if not shown["dark"]:
        words.append("no frame of the dark yet")
    if shown["met"]:
        words.append(f"the accuracy {shown['until']:g} is met")
    if shown["next"] is not None:
        row, col = shown["next"]["shift"]
        parts, rms = shown["next"]["components"], shown["next"]["rms"]
        known = "error not known" if math.isnan(rms) else f"error {rms:.2e}"
        gives = f"{parts} parts" if parts > 1 else known
        words.append(f"next ({row:g}, {col:g}): {gives}")
    return "; ".join(words)


def _error_in_words(shown: dict[str, Any]) -> list[str]:
    """Write the expected error with its causes, or that it is not known."""
    if math.isnan(shown["rms"]):
        return ["expected error not known: take two frames or more at each position, pixels apart"]
    noise, dark, drift = (shown["rms_by_cause"][each] for each in ("noise", "dark", "drift"))
    known = "lamp drift not known yet" if math.isnan(drift) else f"lamp drift {drift:.1e}"
    down, right = shown["tilt_std"]
    words = [
        f"expected error {shown['rms']:.2e} (noise {noise:.1e}, dark {dark:.1e}, {known})",
        f"tilt ±{down:.1e}, ±{right:.1e} edge to edge (row, col)",
    ]
    if dark > max(noise, 0.0 if math.isnan(drift) else drift):
        words.append(
            "the dark limits most: more of its frames help if their noise is above a third of the "
            "ADC's step"
        )
    return words

"""Options, progress, messages and results at a terminal."""

from __future__ import annotations

import inspect
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer

from equipix.errors import FileError, InputError

Report = Callable[[int, int, str], None]

CALLED: ContextVar[Any] = ContextVar("CALLED", default=None)
"""The command, or the group of commands, that was called."""

_WHOLE = 1e9
"""Whole numbers below this are printed with all digits, as saturation levels are."""


@contextmanager
def progress_bars(*, announce: bool = False) -> Iterator[Report | None]:
    """Show bars on a terminal's stderr, one for each stage of the work, and none in a pipe.

    With `announce`, a pipe gets the name of each stage instead, on a line of its own.
    """
    if not sys.stderr.isatty():
        yield _Announcer() if announce else None
        return
    # Imported where bars are drawn: it takes as long as the rest of `equipix --help`.
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
    )

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    console = Console(stderr=True)
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as bars:
        stages: dict[str, Any] = {}

        def report(done: int, total: int, stage: str) -> None:
            if stage not in stages:
                stages[stage] = bars.add_task(stage, total=total)
            bars.update(stages[stage], completed=done, total=total)

        yield report


class _Announcer:
    """Writes the name of each stage once."""

    def __init__(self) -> None:
        self._stage = ""

    def __call__(self, done: int, total: int, stage: str) -> None:  # noqa: ARG002
        if stage != self._stage:
            print(f"equipix: {stage}", file=sys.stderr, flush=True)  # noqa: T201
            self._stage = stage


def say(kind: str, message: object) -> None:
    """Write one line to stderr: ``equipix: kind: message``, which names options."""
    text, called = " ".join(str(message).split()), CALLED.get()
    if called is not None:
        # Imported where there is a message: `equipix --help` needs none.
        from equipix.cli.terminal import in_options

        text = in_options(text, called)
    print(f"equipix: {kind}: {text}", file=sys.stderr)  # noqa: T201


def show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Replace `warnings.showwarning`: one line on stderr, no source code."""
    say("warning", message)


def show_result(result: dict[str, Any], *, as_json: bool) -> None:
    """Print a result as one JSON object or as a table."""
    if as_json:
        print(json.dumps(_json_value(result), allow_nan=False))  # noqa: T201
        return
    width = max(map(len, result))
    for name, value in result.items():
        words = _words(value).replace("\n", "\n" + " " * (width + 2))
        print(f"{name.replace('_', ' '):<{width}}  {words}")  # noqa: T201


def show_table(titles: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Print rows of words in columns under titles."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(*titles, box=SIMPLE_HEAD)
    for row in rows:
        table.add_row(*row)
    Console(soft_wrap=True).print(table)


def check_output(
    path: Path, *, force: bool, folder: bool = False, suffixes: tuple[str, ...] = ()
) -> None:
    """Refuse an output that cannot be written, before the work starts.

    Raises
    ------
    FileError
        If `path` exists and `force` is not given, is a file where a `folder` is wanted or the
        other way about, or its folder does not exist or is closed.
    InputError
        If `path` ends in none of `suffixes`.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(f"'{path}' ends in none of {', '.join(suffixes)}, which name the format")
    if path.exists() and path.is_dir() != folder:
        kind, wanted = ("file", "folder") if folder else ("folder", "file")
        raise FileError(f"'{path}' is a {kind}, expected the name of a {wanted}")
    if path.exists() and not force:
        raise FileError(f"'{path}' exists: name another output, or replace it with --force")
    if not path.parent.is_dir():
        raise FileError(f"'{path}' cannot be written: there is no folder '{path.parent}'")
    if not os.access(path.parent, os.W_OK):
        raise FileError(f"'{path}' cannot be written: folder '{path.parent}' is read-only")


def _json_value(value: Any) -> Any:
    """Replace numbers that JSON does not have by None."""
    if isinstance(value, dict):
        return {key: _json_value(item) for key, item in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _words(value: Any) -> str:
    match value:
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.0f}" if value.is_integer() and abs(value) < _WHOLE else f"{value:.4g}"
        case dict():
            return ", ".join(f"{name} {_words(item)}" for name, item in value.items()) or "none"
        case []:
            return "none"
        case [dict(), *_]:
            return "\n".join(map(_row, value))
        case [float(), *_]:
            return ", ".join(f"{item:.6g}" for item in value)
        case [str(), *_]:
            return ", ".join(value)
        case list() | tuple():
            return " × ".join(str(item) for item in value)
    return str(value)


def _row(fields: dict[str, Any]) -> str:
    """Words of a row: of a finding its kind and its message, else numbers with their names."""
    return f"{fields['kind']}: {fields['message']}" if "kind" in fields else _words(fields)


Force = Annotated[bool, typer.Option("--force", help="Replace an existing output.")]

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]

Workers = Annotated[int | None, typer.Option(min=1, help="Threads; all processors unless given.")]

Tolerance = Annotated[float, typer.Option(help="Largest relative error of the sensitivity.")]

MaxSweeps = Annotated[int | None, typer.Option(min=1, help="Stop after so many sweeps.")]

Uncertainty = Annotated[
    bool, typer.Option("--uncertainty", help="Find the standard deviation of every pixel.")
]

Saturation = Annotated[
    float | None, typer.Option(help="Saturation level in DN; the largest value unless given.")
]

Mask = Annotated[
    Path | None,
    typer.Option(help="An image or .npy: pixels that are not 0 in it are not used."),
]

Cfa = Annotated[
    str | None,
    typer.Option(
        help="Colour filters of the pixels: RGGB, GRBG, GBRG or BGGR, or the rows of one period, "
        "such as RRGG/RRGG/GGBB/GGBB, or RGBW/ of one row."
    ),
]

Sensor = Annotated[
    str | None,
    typer.Option(
        help="Name of the sensor that gave the frames: another than the file's is refused."
    ),
]


@contextmanager
def naming_mask(file: Path | None) -> Iterator[None]:
    """Name the file in messages on the mask that was read from it."""
    try:
        yield
    except InputError as error:
        if file is None or not str(error).startswith("'mask'"):
            raise
        raise InputError(f"{file}: {error}") from error


Picture = Annotated[
    Path | None, typer.Option("--output", "-o", help="A picture: .png, .pdf or .svg.")
]

Seed = Annotated[int, typer.Option("--rng", min=0, help="Seed of the random numbers.")]

Shape = Annotated[
    tuple[int, int], typer.Option(min=48, help="Rows and columns of the sensor, 48 or more.")
]

_VALUE = r"(?:'([^']*)'|(\w+(?:\.\w+)*))"


def in_options(message: str, called: Any) -> str:
    """Name the options of a command, or group, where a message names Python's keywords.

    A keyword that is no option stays where it is a key of a manifest or an argument of the command;
    of any other the message says that it is one of Python.
    """
    parameters = _parameters(called)
    options = {
        each.name: max(each.opts, key=len)
        for each in parameters
        if each.param_type_name == "option"
    }
    for name, option in options.items():
        message = _with_values(message, name, option)
    if ".toml: " in message:
        return message  # its quoted words are keys of that file
    for name, option in options.items():
        message = re.sub(rf"(?<!key )'{name}'(?! (?:in|of) )", option, message)
        if "_" in name:
            message = re.sub(rf"(?<![\w'/.\\-]){name}(?![\w'=/\\]|\.\w)", option, message)
    for name in _python_only() - {each.name for each in parameters}:
        message = message.replace(f"'{name}'", f"'{name}' (in Python)")
    return message


def _with_values(message: str, name: str, option: str) -> str:
    """Write ``name='value'`` and ``'name' (--name value)`` as ``--name value``."""
    message = re.sub(rf"'{name}' \(({option}[^)]*)\)", r"\1", message)
    message = re.sub(rf"\b{name}={_VALUE}", rf"{option} \1\2", message)
    message = message.replace(f"{option} True", option)
    return re.sub(rf"({option}(?: \w+)?)(?:, \1| \(\1\))", r"\1", message)


def _parameters(called: Any) -> list[Any]:
    """Parameters of a command, or of all commands of a group."""
    inner = getattr(called, "commands", {}).values()
    return [*called.params, *(each for command in inner for each in _parameters(command))]


@cache
def _python_only() -> frozenset[str]:
    """Keywords of what commands call that are no keys of manifests."""
    # Imported where there is a message: pydantic takes as long as the rest of `equipix --help`.
    from equipix.calibration.calibrate import calibrate
    from equipix.experiment.manifest import KEYS
    from equipix.measured.average import average
    from equipix.nuc.curve_fit import fit
    from equipix.scene.methods import METHODS

    called: list[Callable[..., object]] = [calibrate, average, fit, *METHODS.values()]
    return frozenset(name for each in called for name in inspect.signature(each).parameters) - KEYS

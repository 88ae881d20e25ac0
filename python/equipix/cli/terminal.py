"""Options, progress, messages and results at a terminal."""

import inspect
import json
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.models import OptionInfo

from equipix._check import Bools, Progress
from equipix.calibration.result import Calibration
from equipix.correction.correct_files import is_corrected, warn_of_corrected
from equipix.correction.polynomial import Polynomial
from equipix.errors import FileError, InputError
from equipix.experiment import image_files
from equipix.findings import Findings
from equipix.io.formats import raw_header, read_mask
from equipix.io.frames import FrameFiles
from equipix.io.paths import check_suffix, find_files, refuse_inputs
from equipix.measured.statistics import FrameStatistics
from equipix.nuc.response import Response
from equipix.report import limits
from equipix.report.figures import findings_entry, pair_in_words, summary, words_of

_Saved = Calibration | FrameStatistics | Polynomial | Response

_NO_NUMBER = r"\(?-?\b(?:inf|nan)\b.*"

_MOST_EXPOSURES = 12
"""Most exposures that are printed."""


@contextmanager
def progress_bars(*, announce: bool = False) -> Iterator[Progress | None]:
    """Show bars on a terminal's stderr, one for each stage of the work, and none in a pipe.

    With `announce`, a pipe gets the name of each stage instead, on a line of its own.
    """
    if not sys.stderr.isatty():
        yield _announcer() if announce else None
        return
    # Imported where bars are drawn: it takes as long as the rest of `equipix --help`.
    from rich import console, progress

    # Names may hold [ and ], which else are markup.
    stage = progress.TextColumn("{task.description}", markup=False)
    columns = (progress.BarColumn(), progress.MofNCompleteColumn(), progress.TimeElapsedColumn())
    err = console.Console(stderr=True)
    with progress.Progress(stage, *columns, console=err, transient=True) as bars:
        stages: dict[str, Any] = {}

        def report(done: int, total: int, stage: str) -> None:
            if stage not in stages:
                for each in bars.tasks:  # a solver that converged needs fewer passes than allowed
                    bars.update(each.id, total=each.completed)
                stages[stage] = bars.add_task(stage, total=total)
            bars.update(stages[stage], completed=done, total=total)

        yield report


def _announcer() -> Progress:
    """Return what writes the name of each stage once."""
    stages: set[str] = set()

    def report(done: int, total: int, stage: str) -> None:  # noqa: ARG001
        if stage not in stages:
            print(f"equipix: {stage}", file=sys.stderr, flush=True)  # noqa: T201
            stages.add(stage)

    return report


def show_result(result: dict[str, Any], found: Findings | None = None, *, as_json: bool) -> None:
    """Print a result as one JSON object or as a table, with its findings where it can have any.

    The object has a list of findings in any case.
    """
    result = result if found is None else result | findings_entry(found, as_json=as_json)
    if as_json:
        result = result if "findings" in result else result | findings_entry(())
        # JSON has no NaN and no infinity: null is what is not determined.
        print(json.dumps(json.loads(json.dumps(result), parse_constant=lambda _: None)))  # noqa: T201
        return
    exposures = result.get("exposures", [])
    rows = words_of(result, without=("exposures",))
    darks = {each["dark"] for each in exposures}
    if len(darks) == 1 and darks != {None}:
        rows.append(("dark", *darks))
    if len(exposures) > _MOST_EXPOSURES:
        rows.append(("exposures", f"{len(exposures)}: --json and equipix report list them"))
    width = max(len(name) for name, _ in rows)
    for name, words in rows:
        print(f"{name:<{width}}  {words}".replace("\n", "\n" + " " * (width + 2)))  # noqa: T201
    if 0 < len(exposures) <= _MOST_EXPOSURES:
        titles = ("exposure", "shift ± standard deviation (row, col), pixels", "flux", "dark")
        listed: list[tuple[str, ...]] = [
            (
                e["exposure"],
                pair_in_words(e["shift"], e["shift_std"]),
                f"{e['flux']:.5g}",
                e["dark"] or "not known",
            )
            for e in exposures
        ]
        known = 4 if len(darks) > 1 else 3
        show_table(titles[:known], [row[:known] for row in listed])


def show_saved(output: Path, result: _Saved, *, force: bool, as_json: bool) -> None:
    """Save a result, and print its main figures and its findings."""
    result.save(output, force=force)
    show_result({"output": str(output), **summary(result)}, result.findings, as_json=as_json)


def show_table(titles: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Print rows of words in columns under titles."""
    from rich import box, console, table
    from rich.text import Text

    # Names may hold [ and ], which else are markup.
    shown = table.Table(box=box.SIMPLE_HEAD)
    for title in titles:
        shown.add_column(Text(title))
    for title, *cells in rows:
        words = (re.sub(_NO_NUMBER, "not determined", cell) for cell in cells)
        shown.add_row(*map(Text, (title, *words)))
    console.Console(soft_wrap=True).print(shown)


def show_limits(judged: Mapping[str, Iterable[limits.Check]]) -> None:
    """Print figures of results with their limits."""
    for name, checks in judged.items():
        for each in checks:
            words = f"{name}: {each.name} {each.value}, expected {each.wanted}"
            print(f"{each.verdict:<10}  {words}")  # noqa: T201


def check_output(
    path: Path | None,
    inputs: Iterable[Path] = (),
    *,
    force: bool,
    folder: bool = False,
    suffixes: tuple[str, ...] = (),
) -> None:
    """Refuse an output that cannot be written, or is an input, before the work starts.

    Raises
    ------
    FileError
        If `path` exists and `force` is not given, is a file where a `folder` is wanted or the
        other way about, is one of the inputs, or its folder does not exist or is closed.
    InputError
        If `path` ends in none of `suffixes`.
    """
    if path is None:
        return
    if suffixes:
        check_suffix(path, suffixes)
    if path.exists() and path.is_dir() != folder:
        kind, wanted = ("file", "folder") if folder else ("folder", "file")
        raise FileError(f"'{path}' is a {kind}, expected the name of a {wanted}")
    if path.exists() and not force:
        raise FileError(f"'{path}' exists: name another output, or replace it with --force")
    if path.parent.is_file():
        raise FileError(f"'{path}' cannot be written: '{path.parent}' is a file, no folder")
    if not path.parent.is_dir():
        raise FileError(f"'{path}' cannot be written: there is no folder '{path.parent}'")
    if not os.access(path.parent, os.W_OK):
        raise FileError(f"'{path}' cannot be written: folder '{path.parent}' is read-only")
    refuse_inputs([path], list(inputs))


def raw_frames(
    frames: Iterable[str], correction: Path | None = None
) -> tuple[FrameFiles, Findings]:
    """Find raw frames; refuse files that equipix has saved, and warn of those it has corrected."""
    files = find_files(frames)
    headers = {file: raw_header(file) for file in files}
    marked = any(is_corrected(each.description) for each in headers.values())
    # The hash of a large correction takes seconds.
    origin = image_files.origin_of(correction) if correction is not None and marked else ""
    said = warn_of_corrected(headers, origin)
    first = headers[files[0]]
    count = sum(headers[file].shape[0] for file in files)
    return FrameFiles(tuple(files), (count, *first.shape[1:]), first.dtype), said


def given(*paths: Path | None) -> list[Path]:
    """Paths of options that are given."""
    return [path for path in paths if path is not None]


@contextmanager
def working(
    mask: Path | None = None, *, announce: bool = False
) -> Iterator[tuple[Progress | None, Bools | None]]:
    """Give bars of progress, and the mask in a file, which messages on the mask name."""
    excluded = None if mask is None else read_mask(mask)
    try:
        with progress_bars(announce=announce) as progress:
            yield progress, excluded
    except InputError as error:
        if mask is None or not str(error).startswith("'mask'"):
            raise
        raise InputError(f"{mask}: {error}") from error


_LAST = ("sensor", "workers", "force")
"""Options that stand behind those of a call."""


def options_of(
    *calls: Callable[..., object], suffix: str = "", **help_of: str | OptionInfo
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command, as its ``**options``, keywords of a call with their types and defaults.

    Of several calls, each of which has some of the keywords, the defaults are None. `help_of` has a
    line of help, or an option, for each keyword; an option is named like it, with a suffix.
    """
    known: dict[str, inspect.Parameter] = {}
    for call in calls:
        known |= inspect.signature(call, eval_str=True).parameters

    def option(name: str, asked: str | OptionInfo) -> inspect.Parameter:
        keyword = known[name.removesuffix(suffix)]
        kind, default = keyword.annotation, keyword.default
        if len(calls) > 1:
            kind, default = kind | None, None
        if isinstance(asked, str):
            asked = typer.Option(*([f"--{name}"] if kind is bool else []), help=asked)
        return keyword.replace(
            name=name, kind=keyword.KEYWORD_ONLY, default=default, annotation=Annotated[kind, asked]
        )

    def declared(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True)
        *mine, _ = own.parameters.values()
        place = min(k for k, each in enumerate(mine) if each.name in _LAST)
        mine = [each.replace(kind=each.KEYWORD_ONLY) for each in mine]
        mine[place:place] = [option(*each) for each in help_of.items()]
        command.__signature__ = own.replace(parameters=mine)  # type: ignore[attr-defined]
        return command

    return declared


Force = Annotated[bool, typer.Option("--force", help="Replace an output that exists.")]

Json = Annotated[
    bool,
    typer.Option("--json", help="Print the result as one JSON object; an error too, on stderr."),
]

Limits = Annotated[
    Path | None,
    typer.Option(help="Limits of the figures: .toml; equipix init limits writes usual ones."),
]

Check = Annotated[
    bool,
    typer.Option("--check", help="End with status 1 where one fails, or nothing is judged."),
]

Workers = Annotated[
    int | None, typer.Option(min=1, help="Number of threads; one for each processor unless given.")
]

Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Work on many frames at a time: on a running scheduler of dask, tcp://HOST:PORT, or "
        "on processes of this machine, local, so many as --workers."
    ),
]

Mask = Annotated[
    Path | None,
    typer.Option(help="An image, FITS or .npy file: pixels that are not 0 in it are left out."),
]

Cfa = Annotated[
    str | None,
    typer.Option(
        help="Colour filters of the pixels: RGGB, GRBG, GBRG or BGGR, or the rows of one period "
        "with / between them, such as RRGG/RRGG/GGBB/GGBB; RGB/ has a period of one row."
    ),
]

SubstrateC = Annotated[
    float | None,
    typer.Option(help="Temperature of the substrate in °C, for a correction that follows it."),
]

BiasV = Annotated[
    float | None, typer.Option(help="Bias in volts, for a correction that follows it.")
]

Sensor = Annotated[
    str | None,
    typer.Option(
        help="Name of the sensor that took the frames: a correction of another one is refused."
    ),
]


Picture = Annotated[
    Path | None, typer.Option("--output", "-o", help="A picture to draw: .png, .pdf or .svg.")
]

Seed = Annotated[int, typer.Option("--rng", min=0, help="Seed of the random numbers.")]

Shape = Annotated[
    tuple[int, int], typer.Option(min=48, help="Rows and columns of the sensor, each 48 or more.")
]

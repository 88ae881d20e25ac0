"""The commands of the command line, each imported when it is called."""

import json
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable
from contextvars import ContextVar
from functools import cache
from importlib import import_module
from inspect import signature
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command, get_group

from equipix._native import __version__
from equipix.errors import EquipixError, EquipixWarning

CALLED: ContextVar[Any] = ContextVar("CALLED", default=None)
"""The command, or the group of commands, that was called."""

COMMANDS = {
    "calibrate": ("calibrate", "Calibrate a sensor from the images of an experiment."),
    "watch": ("watch", "Show what frames determine while the camera writes them."),
    "inspect": ("calibrate", "Show main figures of a result, and draw its maps."),
    "compare": ("calibrate", "Show how far calibrations of one sensor agree."),
    "report": ("report", "Write results as one page, judged by limits."),
    "init": ("init", "Write a commented experiment.toml, levels.toml, camera.toml or limits.toml."),
    "emva": ("emva", "Figures of a camera after EMVA 1288, and a page of them."),
    "convert": ("report", "Write a result in another format, for other programs."),
    "average": ("frames", "Mean and variance of every pixel over many frames."),
    "correct": ("frames", "Correct frames by a calibration or by response curves."),
    "combine": ("corrections", "Make one correction of two that are applied in turn."),
    "lens": ("corrections", "Fit the fall-off of a lens to a flat frame, and save its gain."),
    "bolometer": ("corrections", "Fit a correction that follows temperature and bias."),
    "nuc": ("nuc", "Uniform source: fit response curves, find bad pixels, measure quality."),
    "scene": ("scene", "Learn gain and offset of each pixel from a moving scene."),
    "hardware": ("hardware", "Write a correction as words for a camera's electronics."),
    "simulate": ("simulate", "Write the images of a virtual experiment, and its truth."),
    "demo": ("simulate", "Calibrate a simulated CCD, and compare with the truth and a flat field."),
    "batch": ("batch", "Evaluate many manifests, on this machine or on a cluster."),
    "plan": ("plan", "Predict the errors of a pattern of shifts, or find better patterns."),
}
"""The module of each command, and its line in --help, which needs no import of the module."""


class _Commands(TyperGroup):
    """A group with names and lines of help, which imports a command when it is called."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.params += get_command(_verbose).params
        for name, (_, line) in COMMANDS.items():
            self.add_command(TyperCommand(name, help=line))

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, found, rest = super().resolve_command(ctx, args)
        if name is not None:
            found = command(name)
            # Of a group the command, whose options are not those of the others.
            inner = getattr(found, "commands", {})
            CALLED.set(next((inner[each] for each in rest if each in inner), found))
        return name, found, rest


app = typer.Typer(
    name="equipix",
    cls=_Commands,
    help="Pixel sensitivity of image sensors, measured without a uniform light source.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def command(name: str) -> Any:
    """Import a command, with its options and --verbose."""
    module = import_module(f"equipix.cli.{COMMANDS[name][0]}")
    found = get_group(module.commands).commands[name]
    for each in {found, *getattr(found, "commands", {}).values()}:
        each.params += get_command(_verbose).params
    return found


_USAGE: Any = typer.BadParameter.__base__
"""What typer raises of a wrong usage; it has no public name."""


def run(given: list[str]) -> None:
    """Run the command line, errors and warnings as one line each, with --json an error as JSON."""
    CALLED.set(None)
    options, names = _parted(given)
    as_json = "--json" in options
    if as_json:  # It may stand anywhere: typer takes it behind the name of a command alone.
        given = [*(each for each in options if each != "--json"), "--json", *names]
    with warnings.catch_warnings():
        warnings.simplefilter("always", EquipixWarning)
        warnings.showwarning = show_warning
        try:
            status = app(given, prog_name="equipix", standalone_mode=False)
            # Else Python writes what is left at its end, where no error is caught.
            sys.stdout.flush()
        except BrokenPipeError:
            # `| head` has read enough: what is left goes nowhere.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise SystemExit(1) from None
        except (EquipixError, OSError, MemoryError) as error:
            code = getattr(error, "code", "memory" if isinstance(error, MemoryError) else "file")
            _fail(str(error) or type(error).__name__, code, 1, as_json=as_json)
        except _USAGE as error:
            if not (words := _of_usage(error, given)):  # the help is printed: no command is named
                raise SystemExit(2) from None
            _fail(words, "usage", 2, as_json=as_json)
    if status == _INTERRUPTED:
        raise KeyboardInterrupt
    raise SystemExit(status or 0)


def _parted(given: list[str]) -> tuple[list[str], list[str]]:
    """Part a line before "--", behind which are names."""
    end = given.index("--") if "--" in given else len(given)
    return given[:end], given[end:]


_INTERRUPTED = 130
"""What typer returns after Ctrl-C."""

_PLAIN = {
    r"^Invalid value for '([\w-]+)'.*?: ": r"\1: ",
    r"Value error, (?:'.*?' is not one of (.*?)\.)?": r"expected one of \1",
    r"Input should be (?:a valid )?([^,]*).*": r"expected \1",
    r"greater than or equal to": "at least",
    r"less than or equal to": "at most",
    r"expected integer": "expected a whole number",
    r"expected number": "expected a number",
}
"""What stands in the place of words of typer and of pydantic, which checks for it."""


def _of_usage(error: Any, given: list[str]) -> str:
    """Say what is wrong with the usage; nothing where typer has printed the help instead."""
    text = error.format_message()
    for words, plain in _PLAIN.items():
        text = re.sub(words, plain, text)
    if checked := getattr(error.__cause__, "errors", None):
        text = text.replace(": expected", f" is {checked()[0]['input']!r}, expected", 1)
    name = next((each for each in given if each in COMMANDS), "")
    place = error.ctx.command_path if error.ctx else f"equipix {name}"
    called = CALLED.get()
    if called is not None and called.name not in place.split():
        place = f"{place} {called.name}"  # wrong before the command of a group began
    CALLED.set(None)  # options are named as they are
    return text and f"{text.rstrip('.')} (see {place} --help)"


def _fail(message: str, code: str, status: int, *, as_json: bool) -> NoReturn:
    """Write an error to stderr, and end; stdout is for results alone."""
    if as_json:
        told = {"error": _in_line(message), "code": code}
        print(json.dumps(told), file=sys.stderr)  # noqa: T201
    else:
        say("error", message)
    raise SystemExit(status) from None


def say(kind: str, message: object) -> None:
    """Write one line to stderr: ``equipix: kind: message``, which names options."""
    print(f"equipix: {kind}: {_in_line(message)}", file=sys.stderr)  # noqa: T201


def _in_line(message: object) -> str:
    """Write a message in one line, with the options of the command that was called."""
    text, called = " ".join(str(message).split()), CALLED.get()
    return text if called is None else in_options(text, called)


def show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Replace `warnings.showwarning`: one line on stderr, no source code."""
    say("warning", message)


class _Lines(logging.Handler):
    """Writes what the package logs as lines on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record."""
        seconds = record.relativeCreated / 1e3
        say(record.levelname.lower(), f"{seconds:.2f} s: {record.getMessage()}")


def _log(context: typer.Context, times: int) -> None:
    """Show what the package logs, of --verbose twice the details too.

    It may stand before the name of a command, behind it, or in both places.
    """
    context.meta["verbose"] = times = context.meta.get("verbose", 0) + times
    logger = logging.getLogger("equipix")
    logger.handlers = [each for each in logger.handlers if not isinstance(each, _Lines)]
    logger.setLevel(logging.NOTSET)
    if times:
        logger.addHandler(_Lines())
        logger.setLevel(logging.INFO if times == 1 else logging.DEBUG)


_verbose = typer.Typer(add_completion=False)
"""Holds the option that every command gets."""


@_verbose.command()
def _(
    _times: Annotated[
        int,
        typer.Option(
            "--verbose",
            "-v",
            count=True,
            callback=_log,
            expose_value=False,
            show_default=False,
            help="Show the steps of the work on stderr; -vv shows details.",
        ),
    ] = 0,
) -> None: ...


_VALUE = r"(?:'([^']*)'|\(([^,)]*),([^)]*)\)|(\w+(?:\.\w+)*))"

_CALLS = r"\bequipix\.(average|calibrate|nuc\.fit|plan)(?:(?<=plan)\.\w+)?(\([^)]*\))?(?!\.?\w)"
"""Names of functions that are commands, too."""


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
    message = re.sub(_CALLS, lambda found: f"equipix {found[1].replace('.', ' ')}", message)
    message = re.sub(r",? or None\b", "", message)
    for name, option in options.items():
        message = _with_values(message, name, option)
    if ".toml: " in message:
        return message  # its quoted words are keys of that file
    for name, option in options.items():
        message = re.sub(rf"(?<!key )'{name}'(?! (?:in|of) )", option, message)
        if "_" in name:
            message = re.sub(rf"(?<![\w'/.\\-]){name}(?![\w'=/\\]|\.\w)", option, message)
    message = message.replace("'shifts'", "'shift'")  # as manifests have it
    for name in _python_only() - {each.name for each in parameters}:
        message = message.replace(f"'{name}'", f"'{name}' (in Python)")
    return message


def _with_values(message: str, name: str, option: str) -> str:
    """Write ``name='value'`` and ``'name' (--NAME value)`` as ``--NAME value``."""
    message = re.sub(rf"(?<!=)'\w+' \(({option}[^)]*)\)", r"\1", message)
    message = re.sub(rf"\b{name}={_VALUE}", rf"{option} \1\2\3\4", message)
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
    return frozenset(name for each in called for name in signature(each).parameters) - KEYS


def _show_version(wanted: bool) -> None:
    if wanted:
        print(__version__)  # noqa: T201
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None: ...

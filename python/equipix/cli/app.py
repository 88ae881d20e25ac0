"""The commands of the command line, each imported when it is called."""

from __future__ import annotations

import warnings
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

from equipix._native import __version__
from equipix.cli.terminal import CALLED, say, show_warning
from equipix.errors import EquipixError, EquipixWarning

COMMANDS = {
    "calibrate": ("calibrate", "Calibrate a sensor from the images of an experiment."),
    "inspect": ("calibrate", "Show what a file of a correction, or of averaged frames, holds."),
    "compare": ("calibrate", "Show how far calibrations of one sensor agree."),
    "average": ("frames", "Mean and variance of every pixel over many frames."),
    "correct": ("frames", "Correct frames by a calibration or by response curves."),
    "nuc": ("nuc", "Uniform source: fit response curves, find bad pixels, measure quality."),
    "scene": ("scene", "Learn gain and offset of each pixel from a moving scene."),
    "hardware": ("hardware", "Write a correction as words for a camera's electronics."),
    "simulate": (
        "simulate",
        "Write the images of an experiment with a virtual camera, and its truth.",
    ),
    "demo": (
        "simulate",
        "Calibrate a simulated CCD from image files and compare with the truth and a flat field.",
    ),
    "plan": ("plan", "Predict the errors of a pattern of shifts, or find better patterns."),
}
"""The module of each command, and its line in --help, which needs no import of the module."""


class _Commands(TyperGroup):
    """A group with names and lines of help, which imports a command when it is called."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        for name, (_, line) in COMMANDS.items():
            self.add_command(TyperCommand(name, help=line))

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, found, rest = super().resolve_command(ctx, args)
        if name is not None:
            found = command(name)
            CALLED.set(found)
        return name, found, rest


app = typer.Typer(
    name="equipix",
    cls=_Commands,
    help="Pixel sensitivity of image sensors, measured without a uniform light source.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def command(name: str) -> Any:
    """Import a command, with its options."""
    module = import_module(f"equipix.cli.{COMMANDS[name][0]}")
    return get_group(module.commands).commands[name]


def run(arguments: list[str] | None) -> None:
    """Run the command line, errors and warnings as one line each."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", EquipixWarning)
        warnings.showwarning = show_warning
        try:
            app(arguments, prog_name="equipix")
        except (EquipixError, OSError, MemoryError) as error:
            say("error", error or type(error).__name__)
            raise SystemExit(1) from None


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

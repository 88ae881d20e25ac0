"""Commands that simulate: simulate, demo."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from equipix.cli.terminal import (
    Cfa,
    Force,
    Json,
    Seed,
    Shape,
    Workers,
    check_output,
    progress_bars,
    show_result,
    show_table,
)
from equipix.demo import run_demo, virtual_experiment
from equipix.errors import EquipixError
from equipix.io.paths import refuse_inputs
from equipix.pictures.canvas import check_picture, save_figure
from equipix.pictures.comparison import draw_demo

commands = typer.Typer()


@commands.command(epilog="Example: equipix simulate --shape 240 320 --frames 20 -o experiment")
def simulate(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to make.")],
    shape: Shape = (240, 320),
    frames: Annotated[int, typer.Option(min=1, help="Frames of an exposure.")] = 20,
    bit_depth: Annotated[int, typer.Option(min=8, max=16, help="Bits of the ADC.")] = 12,
    cfa: Cfa = None,
    rng: Seed = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write the images of an experiment with a virtual camera, and its truth."""
    check_output(output, force=force, folder=True)
    virtual = virtual_experiment(shape, frames=frames, bit_depth=bit_depth, cfa=cfa, rng=rng)
    with progress_bars() as progress:
        manifest = virtual.write(output, force=force, progress=progress)
    show_result({"experiment": str(manifest), "shape": list(shape)}, as_json=as_json)


@commands.command(epilog="Example: equipix demo -o demo.png")
def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The picture: .png, .pdf or .svg.")
    ] = Path("equipix-demo.png"),
    shape: Shape = (582, 782),
    frames: Annotated[int, typer.Option(min=2, help="Frames of an exposure.")] = 40,
    rng: Seed = 1,
    keep: Annotated[
        Path | None,
        typer.Option(help="Folder to make for the images; without it they are removed."),
    ] = None,
    workers: Workers = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Calibrate a simulated CCD from image files and compare with the truth and a flat field."""
    check_picture(output)
    check_output(output, force=force)
    if keep is not None:
        check_output(keep, force=force, folder=True)
        refuse_inputs([output, keep], [])
    with (
        tempfile.TemporaryDirectory(prefix="equipix-") as scratch,
        progress_bars(announce=True) as progress,
    ):
        folder = keep or Path(scratch) / "experiment"
        result = run_demo(
            folder,
            shape=shape,
            frames=frames,
            workers=workers,
            progress=progress,
            rng=rng,
            force=force,
        )
    save_figure(draw_demo(result), output, force=force)
    figures = {"picture": str(output), **result.figures()}
    if as_json:
        show_result(figures, as_json=True)
    else:
        _show_demo(figures)
    if not result.passed:
        raise EquipixError("the errors are larger than the noise explains")


def _show_demo(figures: dict[str, Any]) -> None:
    """Print the demo's errors beside what the noise predicts."""
    titles = {
        "noise predicts": "predicted_",
        "shift calibration": "",
        "flat field, source uneven by 1 %": "flat_field_",
    }
    show_table(
        ("rms error of the sensitivity", "pixels", "16×16 means"),
        [
            (title, *(f"{figures[prefix + name]:.2e}" for name in ("rms", "block_rms")))
            for title, prefix in titles.items()
        ],
    )
    names = ("sweeps", "converged", "error_estimate", "passed", "picture")
    show_result({name: figures[name] for name in names}, as_json=False)

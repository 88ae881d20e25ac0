"""Commands that simulate: simulate, demo."""

import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from equipix.cli import terminal
from equipix.demo import run_demo, virtual_experiment
from equipix.errors import EquipixError
from equipix.io.paths import refuse_inputs
from equipix.pictures import check_picture, draw_demo, save_figure

commands = typer.Typer()


@commands.command(epilog="Example: equipix simulate --shape 240 320 --frames 20 -o experiment")
def simulate(
    output: Annotated[Path, typer.Option("--output", "-o", help="The folder to write.")],
    shape: terminal.Shape = (240, 320),
    frames: Annotated[int, typer.Option(min=1, help="Number of frames of each exposure.")] = 20,
    bit_depth: Annotated[int, typer.Option(min=8, max=16, help="Bits of the ADC.")] = 12,
    cfa: terminal.Cfa = None,
    rng: terminal.Seed = 0,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Write the images of a virtual experiment, and its truth."""
    terminal.check_output(output, force=force, folder=True)
    virtual = virtual_experiment(shape, frames=frames, bit_depth=bit_depth, cfa=cfa, rng=rng)
    with terminal.working() as (progress, _):
        manifest = virtual.write(output, force=force, progress=progress)
    terminal.show_result({"experiment": str(manifest), "shape": list(shape)}, as_json=as_json)


@commands.command(epilog="Example: equipix demo -o demo.png")
def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The picture: .png, .pdf or .svg.")
    ] = Path("equipix-demo.png"),
    shape: terminal.Shape = (582, 782),
    frames: Annotated[int, typer.Option(min=2, help="Number of frames of each exposure.")] = 40,
    rng: terminal.Seed = 1,
    keep: Annotated[
        Path | None,
        typer.Option(help="A folder for the simulated images; unless given they are removed."),
    ] = None,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Calibrate a simulated CCD, and compare with the truth and a flat field."""
    check_picture(output)
    terminal.check_output(output, force=force)
    terminal.check_output(keep, force=force, folder=True)
    refuse_inputs(terminal.given(output, keep), [])
    with (
        tempfile.TemporaryDirectory(prefix="equipix-") as scratch,
        terminal.working(announce=True) as (progress, _),
    ):
        folder = keep or Path(scratch) / "experiment"
        common: dict[str, Any] = {"force": force, "workers": workers, "progress": progress}
        result = run_demo(folder, shape=shape, frames=frames, rng=rng, **common)
    save_figure(draw_demo(result), output, force=force)
    figures = {"picture": str(output), **result.figures()}
    if as_json:
        terminal.show_result(figures, as_json=True)
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
    terminal.show_table(
        ("rms error of the sensitivity", "pixels", "16×16 means"),
        [
            (title, *(f"{figures[prefix + name]:.2e}" for name in ("rms", "block_rms")))
            for title, prefix in titles.items()
        ],
    )
    names = ("sweeps", "converged", "error_estimate", "passed", "picture")
    terminal.show_result({name: figures[name] for name in names}, as_json=False)

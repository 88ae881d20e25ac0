"""The command about corrections from the scene: scene."""

from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from equipix.cli import terminal
from equipix.errors import FileError, InputError
from equipix.experiment.image_files import sha256_of, with_inputs
from equipix.io.formats import SAVED, SUFFIXES, raw_header
from equipix.io.paths import find_files, refuse_inputs
from equipix.io.record import read_record
from equipix.pictures import check_picture, draw_sequence, save_figure
from equipix.report.figures import of_scene
from equipix.scene.methods import METHODS, resumed
from equipix.scene.scene_correction import SceneCorrection, SceneState, check_range
from equipix.scene.sequence import SequenceResult, run_sequence

commands = typer.Typer()

_SHOWN = 10
"""Most points of the quality that are printed."""

_TIFF = (".tif", ".tiff")


@commands.command(epilog="Example: equipix scene frames/*.tif -o nuc.tif --method registered")
@terminal.options_of(
    *METHODS.values(),
    saturation="Raw value in DN from which a pixel is saturated; unless given, the largest of "
    "whole numbers.",
    step="Step of learning of local-mean (0.025 unless given), gated (0.06), registered (0.1).",
    width="Side in pixels of the neighbourhood of gated (11 unless given), constant-statistics and "
    "kalman (21).",
    threshold="Change of the local mean, relative to the range, from which gated learns; 0.02 "
    "unless given.",
    motion="Change, relative to the range, from which constant-statistics and kalman take a frame; "
    "0.004 unless given.",
    least_motion="Shift in pixels from which registered takes a pair of frames; 0.5 unless given.",
    block="Number of moving frames of a block of kalman; 50 unless given.",
)
def scene(
    frames: Annotated[
        list[str],
        typer.Argument(help="Raw frames in their order in time: image files or globs."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help=f"The correction: {SAVED}.")],
    method: Annotated[
        Literal["local-mean", "gated", "registered", "constant-statistics", "kalman"],
        typer.Option(help="How gain and offset follow from the frames."),
    ] = "registered",
    data_range: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="Lowest and highest raw value in DN; unless given, the range of whole numbers."
        ),
    ] = None,
    bit_depth: Annotated[
        int | None,
        typer.Option(min=1, max=16, help="Bits of the raw values, in the place of --data-range."),
    ] = None,
    mask: terminal.Mask = None,
    corrected: Annotated[
        Path | None,
        typer.Option(
            help="Also write all frames, each corrected by what was learned before it: .tif."
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            help="Draw a frame before and after, and the roughness over time: .png, .pdf or .svg."
        ),
    ] = None,
    state: Annotated[
        Path | None, typer.Option(help=f"Also save the state of learning, for --resume: {SAVED}.")
    ] = None,
    resume: Annotated[Path | None, typer.Option(help="Go on learning from a saved state.")] = None,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Learn gain and offset of each pixel from a moving scene."""
    outputs = {output: SUFFIXES, corrected: _TIFF, state: SUFFIXES, picture: ()}
    for path, suffixes in outputs.items():
        terminal.check_output(path, force=force, suffixes=suffixes)
    written = terminal.given(output, corrected, state, picture)
    refuse_inputs(written, [*find_files(frames), *terminal.given(resume, mask)])
    check_picture(picture)
    if bit_depth is not None:
        if data_range is not None:
            raise InputError("--bit-depth and --data-range exclude each other: leave out one")
        data_range = (0, 2**bit_depth - 1)
    with terminal.working(mask) as (progress, excluded):
        options |= {"data_range": data_range, "mask": excluded}
        chosen = {name: value for name, value in options.items() if value is not None}
        learning = _method(method, frames, chosen, resume, workers)
        done = run_sequence(learning, frames, output=corrected, force=force, progress=progress)
    result = learning.correction()
    used = sha256_of([*dict.fromkeys(find_files(frames)), *terminal.given(resume, mask)])
    metadata, said = with_inputs(result.metadata, used), done.findings + result.findings
    result = replace(result, metadata=metadata, findings=said)
    result.save(output, force=force)
    if state is not None:
        learning.save(state, force=force)
    if picture is not None:
        save_figure(draw_sequence(done, result), picture, force=force)
    figures = _summary(output, learning, done)
    terminal.show_result(figures, result.findings, as_json=as_json)


def _method(
    name: str, frames: list[str], options: dict[str, Any], resume: Path | None, workers: int | None
) -> SceneCorrection:
    """Make the correction, or read its state."""
    (_, rows, cols), dtype, *_ = raw_header(find_files(frames)[0])
    shape = (rows, cols)
    if resume is not None:
        if options:
            raise InputError(
                "'resume' (--resume) brings its options with it: leave out --data-range, "
                "--bit-depth, --mask, --saturation, --step, --width, --threshold, --motion, "
                "--least-motion and --block"
            )
        state = read_record(resume, SceneState)
        if state.shape != shape:
            raise FileError(
                f"{resume}: holds a state of a sensor {state.shape}, expected {shape}: name the "
                "state of this sensor"
            )
        if state.method != name:
            raise InputError(f"{resume}: is of --method {state.method}, not of {name}: name that")
        check_range(state.data_range, dtype, str(resume))
        return resumed(resume, state, workers=workers)
    if "data_range" not in options and dtype.kind != "u":
        raise InputError(
            f"the frames are {dtype}, whose range is unknown: give 'data_range' (--data-range "
            "LOW HIGH), or --bit-depth"
        )
    known = signature(METHODS[name]).parameters
    if unknown := [f"--{option.replace('_', '-')}" for option in options if option not in known]:
        raise InputError(f"--method {name} does not take {' and '.join(unknown)}: leave it out")
    return METHODS[name](shape, **{"data_range": dtype, **options}, workers=workers)


def _summary(output: Path, method: SceneCorrection, done: SequenceResult) -> dict[str, Any]:
    """Frames, spreads of the coefficients, and quality over time."""
    last = len(done.points) - 1
    every = max(1, -(-last // (_SHOWN - 1)))
    points = [*range(0, last, every), last]
    return {
        "output": str(output),
        "frames": done.frames,
        **of_scene(method),
        "roughness": [
            {
                "frame": done.points[i],
                "raw": round(done.raw[i], 5),
                "corrected": round(done.corrected[i], 5),
            }
            for i in points
        ],
    }

"""The command that makes a table of words of a correction."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from equipix._check import Floats, naming_memory
from equipix.cli import terminal
from equipix.correction.protocol import Correction, check_sensor
from equipix.errors import InputError
from equipix.findings import Finding, Findings, say, usable
from equipix.hardware.encode import line_of
from equipix.hardware.quality import Cost, Trial, trial, widths_of
from equipix.hardware.table import IMAGES, SUFFIXES, UPLOAD, Table
from equipix.hardware.words import WIDEST
from equipix.io.paths import refuse_inputs
from equipix.report.figures import summary
from equipix.saved_results import READ, load_correction

_OF_GAINS = ("output", "shape", "bits", "steps", "unusable_pixels", "correction_sha256")
"""Figures of a file of gains alone."""

commands = typer.Typer()


@commands.command(
    epilog="Example: equipix hardware response.tif -o table.hex --offset-bits 12 --gain-bits 14"
)
@terminal.options_of(
    Table.of,
    adc_bits=typer.Option(min=8, max=16, help="Bits of the ADC; those of the sensor."),
    dac_bits="Bits of the coarse offset, 8 to 16; 0 without a DAC.",
    offset_bits=typer.Option(min=8, max=16, help="Bits of the fine offset."),
    gain_bits=typer.Option(min=8, max=16, help="Bits of the gain."),
    out_bits=typer.Option(min=8, max=16, help="Bits of the output."),
    adc_step="DN in a step of the ADC, a power of two.",
    out_step="DN in a step of the output; by the range of the ADC.",
    dac_step="DN in a step of the DAC; the finest that fits.",
    offset_step="DN in a step of the offset; the finest that fits.",
    gain_step="Step of the gain; the finest that fits.",
    lowest="Corrected value in DN that the ADC must still see.",
    linearise=typer.Option(
        metavar="LOW HIGH",
        help="Raw values in DN between which a line replaces a curved correction.",
    ),
)
def hardware(
    context: typer.Context,
    result: Annotated[Path, typer.Argument(help=f"A correction: {READ}.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="Table: .bin, .hex ($readmemh) or .h (C); .tif: gains alone."
        ),
    ],
    frames: Annotated[
        list[str] | None,
        typer.Option(
            help="Raw frames of one steady even level, two or more: show the cost in C, and "
            "sufficient widths. Once for each level."
        ),
    ] = None,
    preset: Annotated[
        Literal["upload"] | None,
        typer.Option(
            help="upload: gains in steps of 1/1024 below 4 as .tif, for a camera's own flat-field "
            "correction."
        ),
    ] = None,
    substrate_c: terminal.SubstrateC = None,
    bias_v: terminal.BiasV = None,
    sensor: terminal.Sensor = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Write a correction as words for a camera's electronics."""
    terminal.check_output(output, [result], force=force, suffixes=(*SUFFIXES, *IMAGES))
    gains_alone = output.suffix.lower() in IMAGES
    if preset:
        given = {name for name in options if _is_given(context, name)}
        options |= _preset(output, {name: options[name] for name in given})
    if frames and gains_alone:
        raise InputError(
            f"'frames' is given, but '{output}' holds gains alone, and their cost is that of gains "
            f"and offsets: leave it out, or write {', '.join(SUFFIXES)}"
        )
    correction = load_correction(result, substrate_c=substrate_c, bias_v=bias_v)
    check_sensor(correction, sensor)
    table = Table.of(correction, **options)
    cost, said = _cost(result, correction, frames, options) if frames else ({}, ())
    if gains_alone:
        (offsets, _), _ = line_of(correction, options["linearise"], np.inf)
        said = say(*_lost_offsets(offsets, table))
    table.save(output, force=force)
    figures = {"output": str(output), **summary(table), **cost}
    if gains_alone:
        figures = {name: figures[name] for name in _OF_GAINS}
        figures |= {name: {"gain": figures[name]["gain"]} for name in ("bits", "steps")}
    terminal.show_result(figures, table.findings + said, as_json=as_json)


def _lost_offsets(offsets: Floats, table: Table) -> Findings:
    """Say how much the offsets differ that a file of gains alone does not hold."""
    lost = float(np.std(offsets[usable(table.flags)]))
    if lost < 2.0**table.format.adc / 2:
        return ()
    words = (
        f"the file holds gains alone, and the offsets of the correction differ by {lost:.3g} DN "
        "(standard deviation), which stay in frames that the gains multiply: let the camera "
        f"subtract its own offsets or dark first, or write {', '.join(SUFFIXES)}"
    )
    return (Finding("offsets", words, "input"),)


def _is_given(context: typer.Context, name: str) -> bool:
    """Whether an option is on the command line, its default included."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _preset(output: Path, given: dict[str, Any]) -> dict[str, Any]:
    """Return the options of the preset, which writes gains alone.

    Raises
    ------
    InputError
        If the output is no image, or another option of the words is given.
    """
    if output.suffix.lower() not in IMAGES:
        raise InputError(
            f"'{output}' is no image, but --preset upload writes one: name a file that ends in "
            f"{' or '.join(IMAGES)}, or leave it out"
        )
    for name, value in given.items():
        if name != "linearise" and value != UPLOAD.get(name):
            own = f"has {UPLOAD[name]:g}" if name in UPLOAD else "writes gains alone"
            raise InputError(f"'{name}' is {value!r}, but --preset upload {own}: leave one out")
    # Offsets are not written, so none is to be refused for its step.
    return UPLOAD | {"offset_bits": WIDEST}


def _cost(
    file: Path, correction: Correction, frames: list[str], options: dict[str, Any]
) -> tuple[dict[str, Any], Findings]:
    """Measure C of frames of each level by correction and table, and the widths that suffice."""
    refuse_inputs(map(Path, frames), [], "is named twice: name the frames of each level once")
    with naming_memory("measuring quality"), terminal.working() as (progress, _):
        shown = {"progress": progress}
        tried, said = zip(
            *(_tried(file, correction, each, options | shown) for each in frames), strict=True
        )
    widths = widths_of([level.by_width for level in tried])
    costs = {
        (number, plane): cost
        for number, level in enumerate(tried)
        for plane, cost in level.planes.items()
    }
    worst = max(costs, key=lambda place: costs[place].added)
    named = {
        (number, plane): {"frames": frames[number], **({"plane": plane} if plane else {})}
        for number, plane in costs
    }
    figures = {
        **_cost_figures(costs[worst]),
        "words_at_ends_of_adc": sum(level.at_ends for level in tried),
        "sufficient_bits": {each: getattr(widths, f"{each}_bits") for each in widths.worst},
    }
    if len(costs) > 1:
        figures |= {
            "worst": named[worst],
            "worst_at_sufficient_bits": [
                {"bits": name, **named[place]} for name, place in widths.worst.items()
            ],
            "costs": [named[place] | _cost_figures(cost) for place, cost in costs.items()],
        }
    found = [each for more in said for each in more]
    found += [each for cost in costs.values() for each in cost.before.findings]
    return figures, tuple(found)


def _tried(
    file: Path, correction: Correction, pattern: str, options: dict[str, Any]
) -> tuple[Trial, Findings]:
    """Measure the cost at one level, whose frames are read and left again."""
    raw, said = terminal.raw_frames([pattern], file)
    if len(raw) < 2:
        raise InputError(
            f"{pattern}: holds one frame, expected two or more: each 'frames' names all of a "
            'level, as "level/*.tif" does'
        )
    return trial(correction, np.stack([*raw]), stage=f"widths for {pattern}", **options), said


def _cost_figures(cost: Cost) -> dict[str, float]:
    return {
        "C": cost.before.ratio,
        "C_of_table": cost.after.ratio,
        "added_noise": cost.added,
    }

"""The command that makes a table of words of a correction."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from equipix._check import naming_memory
from equipix.cli.terminal import Force, Json, Sensor, check_output, show_result
from equipix.correction.protocol import Correction, check_sensor
from equipix.findings import usable
from equipix.hardware import quality
from equipix.hardware.quality import smallest_widths
from equipix.hardware.table import SUFFIXES, Table
from equipix.io.formats import refuse_saved
from equipix.io.frames import read_frames
from equipix.io.paths import find_files, refuse_inputs
from equipix.loading import load_correction

_SOUGHT = ("offset_bits", "gain_bits")
"""Widths of which the smallest that suffice are sought."""

commands = typer.Typer()


@commands.callback()
def _group() -> None: ...


@commands.command(
    epilog="Example: equipix hardware response.tif -o table.hex --offset-bits 12 --gain-bits 14"
)
def hardware(
    result: Annotated[Path, typer.Argument(help="A calibration or a response: .tif or .npz.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Table: .bin, .hex ($readmemh) or .h (C).")
    ],
    adc_bits: Annotated[int, typer.Option(help="Bits of the ADC, 8 to 16.")] = 14,
    dac_bits: Annotated[int, typer.Option(help="Bits of the coarse offset, 8 to 16.")] = 8,
    offset_bits: Annotated[int, typer.Option(help="Bits of the fine offset, 8 to 16.")] = 12,
    gain_bits: Annotated[int, typer.Option(help="Bits of the gain, 8 to 16.")] = 16,
    out_bits: Annotated[int, typer.Option(help="Bits of the output, 8 to 16.")] = 16,
    adc_step: Annotated[float, typer.Option(help="DN in a step of the ADC, a power of two.")] = 1.0,
    out_step: Annotated[
        float | None, typer.Option(help="DN in a step of the output; by the range of the ADC.")
    ] = None,
    dac_step: Annotated[
        float | None, typer.Option(help="DN in a step of the DAC; the finest that fits.")
    ] = None,
    offset_step: Annotated[
        float | None, typer.Option(help="DN in a step of the offset; the finest that fits.")
    ] = None,
    gain_step: Annotated[
        float | None, typer.Option(help="Step of the gain; the finest that fits.")
    ] = None,
    lowest: Annotated[
        float, typer.Option(help="Corrected value in DN that the ADC must still see.")
    ] = 0.0,
    linearise: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Raw values in DN between which a line replaces a curved correction."),
    ] = None,
    frames: Annotated[
        list[str] | None,
        typer.Option(
            help="Raw frames of one steady even level: show the cost in C, and sufficient widths."
        ),
    ] = None,
    sensor: Sensor = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write a correction as words for a camera's electronics."""
    check_output(output, force=force, suffixes=SUFFIXES)
    refuse_inputs([output], [result])
    correction = load_correction(result)
    check_sensor(correction, sensor)
    options: dict[str, Any] = {
        "adc_bits": adc_bits,
        "dac_bits": dac_bits,
        "offset_bits": offset_bits,
        "gain_bits": gain_bits,
        "out_bits": out_bits,
        "adc_step": adc_step,
        "out_step": out_step,
        "dac_step": dac_step,
        "offset_step": offset_step,
        "gain_step": gain_step,
        "lowest": lowest,
        "linearise": linearise,
    }
    table = Table.of(correction, **options)
    cost = _cost(correction, frames, options) if frames else {}
    table.save(output, force=force)
    show_result({"output": str(output), **_summary(table), **cost}, as_json=as_json)


def _summary(table: Table) -> dict[str, Any]:
    """Collect the main figures of a table."""
    told = asdict(table.format)
    steps = {name: 2.0 ** told[name] for name in ("adc", "coarse", "offset", "gain", "out")}
    return {
        "shape": list(table.shape),
        "bits": {name.removesuffix("_bits"): told[name] for name in told if "_bits" in name},
        "steps": steps,
        "base": table.format.base,
        "zero": table.format.zero,
        "unusable_pixels": int((~usable(table.flags)).sum()),
        "largest_error_dn": table.metadata["largest_error_dn"],
        **(
            {"sag_dn": table.metadata["linearised"]["sag_dn"]}
            if "linearised" in table.metadata
            else {}
        ),
        "correction_sha256": table.metadata["sha256"],
    }


def _cost(correction: Correction, source: list[str], options: dict[str, Any]) -> dict[str, Any]:
    """Measure C of frames of one level by correction and table, and the widths that suffice."""
    files = find_files(source)
    for file in files:
        refuse_saved(file)
    with naming_memory("measuring quality"):
        raw = read_frames(files)
        found = quality(correction, raw, **options)
        others = {name: value for name, value in options.items() if name not in _SOUGHT}
        widths = smallest_widths(correction, [raw], **others)
    return {
        "C": found.before.ratio,
        "C_of_table": found.after.ratio,
        "added_noise": found.added,
        "words_at_ends_of_adc": found.at_ends,
        "sufficient_bits": {
            "offset": widths.offset_bits,
            "gain": widths.gain_bits,
            "both": widths.both_bits,
        },
    }

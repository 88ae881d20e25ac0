"""The command that makes a table of words of a correction."""

from dataclasses import asdict
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from equipix._check import naming_memory
from equipix.cli import terminal
from equipix.correction.protocol import Correction, check_sensor
from equipix.errors import InputError
from equipix.findings import Findings, usable
from equipix.hardware.quality import quality, smallest_widths
from equipix.hardware.table import IMAGES, SUFFIXES, UPLOAD, Table
from equipix.hardware.words import STEPS
from equipix.saved_results import READ, load_correction

_SOUGHT = ("offset_bits", "gain_bits")
"""Widths of which the smallest that suffice are sought."""

commands = typer.Typer()


@commands.command(
    epilog="Example: equipix hardware response.tif -o table.hex --offset-bits 12 --gain-bits 14"
)
@terminal.options_of(
    Table.of,
    adc_bits="Bits of the ADC, 8 to 16; those of the sensor.",
    dac_bits="Bits of the coarse offset, 8 to 16; 0 without a DAC.",
    offset_bits="Bits of the fine offset, 8 to 16.",
    gain_bits="Bits of the gain, 8 to 16.",
    out_bits="Bits of the output, 8 to 16.",
    adc_step="DN in a step of the ADC, a power of two.",
    out_step="DN in a step of the output; by the range of the ADC.",
    dac_step="DN in a step of the DAC; the finest that fits.",
    offset_step="DN in a step of the offset; the finest that fits.",
    gain_step="Step of the gain; the finest that fits.",
    lowest="Corrected value in DN that the ADC must still see.",
    linearise="Raw values in DN between which a line replaces a curved correction.",
)
def hardware(
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
            help="Raw frames of one steady even level: show the cost in C, and sufficient widths."
        ),
    ] = None,
    preset: Annotated[
        Literal["upload"] | None,
        typer.Option(
            help="upload: gains in steps of 1/1024 below 4 and no DAC, for a camera's own "
            "flat-field correction."
        ),
    ] = None,
    sensor: terminal.Sensor = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Write a correction as words for a camera's electronics."""
    terminal.check_output(output, [result], force=force, suffixes=(*SUFFIXES, *IMAGES))
    correction = load_correction(result)
    check_sensor(correction, sensor)
    if preset:
        options |= _preset(options)
    table = Table.of(correction, **options)
    cost, said = _cost(correction, frames, options) if frames else ({}, ())
    table.save(output, force=force)
    figures = {"output": str(output), **_summary(table), **cost}
    terminal.show_result(figures, table.findings + said, as_json=as_json)


def _preset(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options of the preset; no other value may be given for one of them."""
    known = signature(Table.of).parameters
    for name, value in UPLOAD.items():
        if options[name] not in (value, known[name].default):
            raise InputError(
                f"'{name}' is {options[name]!r}, but '--preset upload' has {value:g}: leave one out"
            )
    return UPLOAD


def _summary(table: Table) -> dict[str, Any]:
    """Collect the main figures of a table."""
    form = asdict(table.format)
    linearised = table.metadata.get("linearised")
    return {
        "shape": list(table.shape),
        "bits": {name.removesuffix("_bits"): form[name] for name in form if "_bits" in name},
        "steps": {name: 2.0 ** form[name] for name in STEPS},
        "base": table.format.base,
        "zero": table.format.zero,
        "unusable_pixels": int((~usable(table.flags)).sum()),
        "largest_error_dn": table.metadata["largest_error_dn"],
        **({"sag_dn": linearised["sag_dn"]} if linearised else {}),
        "correction_sha256": table.metadata["sha256"],
    }


def _cost(
    correction: Correction, frames: list[str], options: dict[str, Any]
) -> tuple[dict[str, Any], Findings]:
    """Measure C of frames of one level by correction and table, and the widths that suffice."""
    with naming_memory("measuring quality"):
        raw, said = terminal.raw_frames(frames)
        found = quality(correction, raw, **options)
        others = {name: value for name, value in options.items() if name not in _SOUGHT}
        widths = smallest_widths(correction, [raw], **others)
    figures = {
        "C": found.before.ratio,
        "C_of_table": found.after.ratio,
        "added_noise": found.added,
        "words_at_ends_of_adc": found.at_ends,
        "sufficient_bits": {
            each: getattr(widths, f"{each}_bits") for each in ("offset", "gain", "both")
        },
    }
    return figures, said + found.before.findings

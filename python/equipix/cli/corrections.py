"""Commands that make corrections of other kinds: combine, lens, bolometer."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from equipix.bolometer import fit as fit_states
from equipix.bolometer.states import States
from equipix.calibration.result import Calibration
from equipix.cli import terminal
from equipix.cli.frames import averaged
from equipix.correction.polynomial import combine as combine_corrections
from equipix.errors import InputError
from equipix.experiment.image_files import sha256_of, with_inputs
from equipix.findings import Finding, say
from equipix.io.formats import SAVED, SUFFIXES
from equipix.io.paths import find_files, refuse_inputs
from equipix.io.record import read_record
from equipix.lens import LensFalloff
from equipix.lens import fit as fit_lens
from equipix.measured.average import average
from equipix.report.figures import summary
from equipix.saved_results import READ, load_correction

commands = typer.Typer()

_LEAST_FALLOFF = 1e-3
"""Share of the light that a lens takes in the corner, below which it may as well be the sensor."""

_OFFSET = (
    "no dark was subtracted from frames of whole numbers, so that an offset of the camera counts "
    "as light, and the fall-off is too weak: give dark frames (--dark), or frames that a response "
    "has corrected"
)


@commands.command(epilog="Example: equipix combine response.tif lens.tif -o both.tif")
def combine(
    first: Annotated[Path, typer.Argument(help=f"A correction of raw frames: {READ}.")],
    then: Annotated[Path, typer.Argument(help="Offset and gain of frames that it corrected.")],
    output: Annotated[Path, typer.Option("--output", "-o", help=f"The correction: {SAVED}.")],
    substrate_c: terminal.SubstrateC = None,
    bias_v: terminal.BiasV = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Make one correction of two that are applied in turn."""
    terminal.check_output(output, [first, then], force=force, suffixes=SUFFIXES)
    of_raw = load_correction(first, substrate_c=substrate_c, bias_v=bias_v)
    both = combine_corrections(of_raw, load_correction(then))
    hashes = sha256_of([first, then])
    if hashes[then] in _combined(of_raw.metadata):
        raise InputError(
            f"{first} was combined with {then} already, which would be applied twice: expected a "
            "correction of frames that the first has corrected"
        )
    both = replace(both, metadata=with_inputs(both.metadata, hashes))
    say(*both.findings)
    terminal.show_saved(output, both, force=force, as_json=as_json)


def _combined(metadata: dict[str, Any]) -> set[str]:
    """Hashes of the files of the corrections that one was combined of."""
    parts = [metadata[name] for name in ("first", "then") if name in metadata]
    found = set(metadata.get("inputs", {}).values()) if parts else set()
    return found.union(*map(_combined, parts))


@commands.command(epilog="Example: equipix lens flat/*.tif --dark 'dark/*.tif' -o lens.tif")
@terminal.options_of(
    fit_lens, law="cos4, the natural fall-off, or radial, a polynomial for lenses with vignetting."
)
def lens(
    frames: Annotated[list[str], typer.Argument(help="Frames of a uniform scene, or an average.")],
    output: Annotated[Path, typer.Option("--output", "-o", help=f"The gain: {SAVED}.")],
    dark: Annotated[
        list[str] | None, typer.Option(help="Dark frames or their average, to be subtracted.")
    ] = None,
    sensitivity: Annotated[
        Path | None,
        typer.Option(help="A calibration of the sensor without the lens, or by shifts."),
    ] = None,
    mask: terminal.Mask = None,
    cfa: terminal.Cfa = None,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Fit the fall-off of a lens to a flat frame, and save its gain."""
    terminal.check_output(output, terminal.given(sensitivity), force=force, suffixes=SUFFIXES)
    gain = None if sensitivity is None else read_record(sensitivity, Calibration).sensitivity
    flat = averaged(frames, dark, output, mask, workers=workers)
    said = flat.findings + (say(Finding("raw", _OFFSET, "input")) if flat.raw else ())
    found = fit_lens(flat.mean, sensitivity=gain, mask=flat.saturated > 0, cfa=cfa, **options)
    made = found.correction()
    least = float(1 / np.nanmax(made.coefficients[1]))
    if 1 - least < _LEAST_FALLOFF:
        said += say(Finding("falloff", _weak(found, 1 - least), "identifiability"))
    origin = {**made.metadata, "std": found.std, "least_illumination": least}
    origin["inputs"] = flat.metadata["inputs"]
    origin = with_inputs(origin, sha256_of(terminal.given(sensitivity)))
    made = replace(made, metadata=origin, findings=said)
    terminal.show_saved(output, made, force=force, as_json=as_json)


def _weak(found: LensFalloff, falloff: float) -> str:
    """Say that a fall-off is too weak to be that of a lens, and how far f is off by noise alone."""
    error = found.std.get("focal_length", 0)
    focal = f": f is {found.focal_length:.4g} ± {error:.2g} pixels by noise alone"
    return (
        f"the fall-off takes {falloff:.2g} of the light in the corner (limit {_LEAST_FALLOFF:g}), "
        f"too weak to determine a law{focal if found.law == 'cos4' else ''}, and large "
        "scales of the sensor's gain are as large: see that the flat has not been corrected "
        "for its fall-off already"
    )


@commands.command(
    epilog="Example: equipix bolometer 'shutter/*.tif' --substrate-c '0 20 40' --bias-v 2 "
    "--cold 'cold/*.tif' --hot 'hot/*.tif' -o dynamic.tif"
)
@terminal.options_of(
    fit_states,
    bias_order="Highest power of the squared bias; 1, or 0 of one bias, unless given.",
    regressor="What the polynomials are of: the temperature, or one over the absolute one.",
)
def bolometer(
    shutter: Annotated[
        list[str], typer.Argument(help="A file for each state: frames or an average of a shutter.")
    ],
    substrate_c: Annotated[
        str, typer.Option(help="Temperature of the substrate at each state in °C: '0 20 40'.")
    ],
    bias_v: Annotated[str, typer.Option(help="Bias at each state in volts, or one for all.")],
    output: Annotated[Path, typer.Option("--output", "-o", help=f"The correction: {SAVED}.")],
    cold: Annotated[
        list[str] | None, typer.Option(help="A cold black body, a file for each state.")
    ] = None,
    hot: Annotated[
        list[str] | None, typer.Option(help="A hot black body, a file for each state.")
    ] = None,
    order: Annotated[
        str, typer.Option(help="Highest power of the temperature, or auto: by held-out ones.")
    ] = "auto",
    mask: terminal.Mask = None,
    workers: terminal.Workers = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **options: Any,
) -> None:
    """Fit a correction that follows temperature and bias."""
    terminal.check_output(output, force=force, suffixes=SUFFIXES)
    if (cold is None) != (hot is None):
        raise InputError("--cold and --hot give the gain together: give both, or none")
    celsius, volts = _numbers("--substrate-c", substrate_c), _numbers("--bias-v", bias_v)
    volts = volts * len(celsius) if len(volts) == 1 else volts
    series = [find_files(names) for names in (shutter, cold, hot) if names is not None]
    files = [file for each in series for file in each]
    refuse_inputs(files, [], "is named twice: name each file once")
    refuse_inputs([output], [*files, *terminal.given(mask)])
    options["order"] = int(order) if order.isdecimal() else order
    # Checked before the files are read, which takes long.
    States.of(celsius, volts, len(series[0]), options["bias_order"], options["regressor"])
    for name, each in zip(("--cold", "--hot"), series[1:], strict=False):
        if len(each) != len(celsius):
            raise InputError(
                f"{name} names {len(each)} files, expected {len(celsius)}: one for each state"
            )
    with terminal.working(mask) as (progress, excluded):
        first, *bodies = (
            [average(file, workers=workers, progress=progress) for file in each] for each in series
        )
        options |= {"black_bodies": tuple(bodies) or None, "mask": excluded}
        found = fit_states(first, celsius, volts, **options)
    names = ("shutter", "cold", "hot")[: len(series)]
    states = [
        {**dict(zip(names, map(str, each), strict=True)), "substrate_c": at, "bias_v": v}
        for *each, at, v in zip(*series, celsius, volts, strict=True)
    ]
    metadata = with_inputs({**found.metadata, "states": states}, sha256_of(files))
    found = replace(found, metadata=metadata)
    found.save(output, force=force)
    result = {"output": str(output), "states": states, **summary(found)}
    terminal.show_result(result, found.findings, as_json=as_json)


def _numbers(option: str, text: str) -> list[float]:
    """Read numbers with spaces or commas between them."""
    try:
        return [float(each) for each in text.replace(",", " ").split()] or [float(text)]
    except ValueError:
        raise InputError(f"{option} is {text!r}, expected numbers such as '0 20 40'") from None

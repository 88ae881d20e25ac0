"""The words of a correction, from widths and steps as a user gives them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix._check import naming_memory, number
from equipix.correction.protocol import cfa_of, check_correction
from equipix.errors import InputError
from equipix.hardware.content import Content
from equipix.hardware.encode import Steps, encode, origin, refuse_far_offsets
from equipix.hardware.line import line_of
from equipix.hardware.words import check_width, chosen_exponent, exponent_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from equipix.correction.protocol import Correction


def content_of(
    correction: Correction,
    widths: Mapping[str, int],
    steps: Mapping[str, float | None],
    *,
    adc_step: float,
    lowest: float,
    linearise: tuple[float, float] | None,
) -> Content:
    """Make the parts of a table, as `Table.of` describes them.

    Raises
    ------
    InputError
        As of `Table.of`.
    """
    check_correction("correction", correction)
    bits = {name: check_width(name, width) for name, width in widths.items()}
    if not np.isfinite(number("lowest", lowest)):
        raise InputError(f"'lowest' is {lowest!r}, expected a corrected value in DN")
    exponents = _exponents(exponent_of("adc_step", adc_step), steps, bits)
    with naming_memory("making a table"):
        offset, gain, sag = line_of(correction, linearise)
        found = encode((offset, gain), correction.flags, bits, exponents, float(lowest))
        refuse_far_offsets(found, (offset, gain), bits, exponents, float(lowest))
    colours = cfa_of(correction)
    metadata = {
        **origin(correction),
        **({} if colours is None else {"cfa": colours.rows}),
        "lowest": float(lowest),
        "largest_error_dn": found.largest_error,
    }
    if linearise is not None:
        metadata["linearised"] = {"raw": [float(each) for each in linearise], "sag_dn": sag}
    return Content(found.format, found.coarse, found.offset, found.gain, found.flags, metadata)


def _exponents(adc: int, steps: Mapping[str, float | None], bits: Mapping[str, int]) -> Steps:
    """Exponents of the steps; unless given, the output has the range of the ADC."""
    out = chosen_exponent("out_step", steps["out_step"])
    return Steps(
        adc,
        chosen_exponent("dac_step", steps["dac_step"]),
        chosen_exponent("offset_step", steps["offset_step"]),
        chosen_exponent("gain_step", steps["gain_step"]),
        adc + bits["adc_bits"] - bits["out_bits"] if out is None else out,
    )

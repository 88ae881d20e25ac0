"""Widths of words, the steps that they stand for, and how values become words."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from equipix._check import Floats, is_whole, number
from equipix.errors import InputError
from equipix.measured.part import blocks

NARROWEST, WIDEST = 8, 16
"""Widths of words, in bits."""

WIDTHS = ("adc_bits", "dac_bits", "offset_bits", "gain_bits", "out_bits")
"""Names of the widths of a `Format`."""

STEPS = ("adc", "coarse", "offset", "gain", "out")
"""Names of the exponents of its steps."""

_EXPONENT = 40
"""Steps are from 2^-40 to 2^40 DN."""

_SUM_BITS = 58
"""Most bits that a term of the sum may take."""


@dataclass(frozen=True, kw_only=True)
class Format:
    """Widths of the words in bits, and the powers of two that one step of each stands for.

    Attributes
    ----------
    adc_bits, dac_bits, offset_bits, gain_bits, out_bits : int
        Widths, 8 to 16; of the DAC also 0, where there is none. The words of the offset are signed,
        in two's complement.
    adc, coarse, offset, out : int
        One step is 2 to this power, in DN of the correction.
    gain : int
        One step is 2 to this power, without a unit.
    base : int
        Output of the sum 0, in steps of the output; 32 bits.
    zero : int
        Corrected value of the output 0, in steps of the output; 32 bits.

    Raises
    ------
    InputError
        If a width or an exponent is out of range.
    """

    adc_bits: int
    dac_bits: int
    offset_bits: int
    gain_bits: int
    out_bits: int
    adc: int
    coarse: int
    offset: int
    gain: int
    out: int
    base: int
    zero: int = 0

    def __post_init__(self) -> None:
        """Refuse numbers out of range."""
        for name in WIDTHS:
            check_width(name, getattr(self, name))
        limits = dict.fromkeys(STEPS, _EXPONENT) | {"base": 2**31 - 1, "zero": 2**31 - 1}
        for name, limit in limits.items():
            value = getattr(self, name)
            if not isinstance(value, int) or abs(value) > limit:
                raise InputError(
                    f"'{name}' is {value!r}, expected a whole number from -{limit} to {limit}"
                )
        product, offset, out = self.shifts
        bits = max(32 + product, 16 + offset, out)
        if bits > _SUM_BITS:
            raise InputError(
                f"the steps 2^{self.adc} (ADC), 2^{self.offset} (offset), 2^{self.gain} (gain) and "
                f"2^{self.out} (output) make sums of {bits} bits, expected at most {_SUM_BITS}: "
                "take steps that differ less"
            )

    @property
    def stored(self) -> dict[str, int]:
        """Bits of the words of a pixel, by the names of a table's arrays."""
        widths = (self.dac_bits, self.offset_bits, self.gain_bits)
        return dict(zip(("coarse", "offset", "gain"), widths, strict=True))

    @property
    def shifts(self) -> tuple[int, int, int]:
        """Bits by which product and offset are raised, and their sum lowered, for the output."""
        lowest = min(self.gain + self.adc, self.offset, self.out)
        return self.gain + self.adc - lowest, self.offset - lowest, self.out - lowest

    @property
    def words(self) -> tuple[str, ...]:
        """What the words stand for, and the formula, line by line."""
        ahead = (
            f"after the DAC has subtracted coarse * 2^{self.coarse} DN from the raw value"
            if self.dac_bits
            else "of the raw value: no DAC subtracts anything ahead of the ADC"
        )
        dac = f"coarse: {self.dac_bits} bits, unsigned. " if self.dac_bits else ""
        return (
            f"x: word of the ADC, {self.adc_bits} bits, unsigned, in steps of 2^{self.adc} DN,",
            f"   {ahead}.",
            f"z = {self.base} + round((gain * x * 2^{self.gain + self.adc} + offset * "
            f"2^{self.offset}) / 2^{self.out}),",
            f"   rounded half to even, limited to 0 to {2**self.out_bits - 1}.",
            f"corrected value in DN: (z + {self.zero}) * 2^{self.out}",
            f"{dac}offset: {self.offset_bits} bits, two's complement.",
            *self.gain_words,
            "   Its z is 0.",
        )

    @property
    def gain_words(self) -> tuple[str, ...]:
        """What the words of the gain stand for, line by line."""
        return (
            f"gain: {self.gain_bits} bits, unsigned, in steps of 2^{self.gain}.",
            "gain 0: do not use this pixel.",
        )

    @property
    def largest_word(self) -> int:
        """Largest word of the ADC."""
        return int(2**self.adc_bits - 1)


def check_width(name: str, bits: object) -> int:
    """Refuse a width out of range."""
    without = " or 0" if name == "dac_bits" else ""
    if not is_whole(bits, NARROWEST, WIDEST) and not (without and is_whole(bits, 0, 0)):
        raise InputError(f"'{name}' is {bits!r}, expected {NARROWEST} to {WIDEST}{without} bits")
    return int(bits)  # type: ignore[call-overload, no-any-return]


def exponent_of(name: str, step: float) -> int:
    """Return the exponent of a step, which must be a power of two."""
    mantissa, exponent = math.frexp(number(name, step))
    if mantissa != 1 / 2 or abs(exponent - 1) > _EXPONENT:
        raise InputError(
            f"'{name}' is {step!r}, expected a power of two from 2^-{_EXPONENT} to 2^{_EXPONENT}, "
            "such as 0.25"
        )
    return exponent - 1


def chosen_exponent(name: str, step: float | None) -> int | None:
    """Return the exponent of a step; None where the finest one is to be found."""
    return None if step is None else exponent_of(name, step)


@dataclass(frozen=True)
class Words:
    """Words of one kind: how many bits they have, and which values of usable pixels they take."""

    name: str
    bits: int
    signed: bool = False
    lowest: int = 0
    floor: bool = False

    @property
    def limits(self) -> tuple[int, int]:
        """Lowest and highest word."""
        if self.signed:
            return -(2 ** (self.bits - 1)), 2 ** (self.bits - 1) - 1
        return self.lowest, 2**self.bits - 1

    def rounded(self, values: Floats, exponent: int) -> Floats:
        """Values in whole steps: half to even, or the next below."""
        steps = np.ldexp(values, -exponent)
        return np.asarray(np.floor(steps) if self.floor else np.rint(steps))

    def outside(self, values: Floats, exponent: int) -> int:
        """Count the values that do not fit."""
        (low, high), count = self.limits, 0
        for part in blocks((len(values), 1)):
            words = self.rounded(values[part], exponent)
            count += int(np.count_nonzero((words < low) | (words > high)))
        return count

    def finest(self, values: Floats, not_below: int) -> int:
        """Return the exponent of the finest step with which the largest values fit."""
        exponent, ends = not_below, np.array([values.min(), values.max()])
        largest = replace(self, lowest=-(2**self.bits))
        while exponent < _EXPONENT and largest.outside(ends, exponent):
            exponent += 1
        return exponent

    def encoded(self, values: Floats, exponent: int) -> Floats:
        """Round values to words, and refuse those of usable pixels that do not fit.

        Raises
        ------
        InputError
            With their number and the width that would hold them.
        """
        outside = self.outside(values, exponent)
        if outside:
            raise InputError(
                f"'{self.name}_bits' is {self.bits}: the {self.name} words of {outside} usable "
                f"pixels do not fit, with values from {values.min():.6g} to {values.max():.6g} and "
                f"a step of 2^{exponent}: {self._remedy(values, exponent)}"
            )
        return self.rounded(values, exponent)

    def wide_enough(self, values: Floats, step: Callable[[Self], int]) -> int:
        """Bits that hold all values, in steps that follow from the wider words; 0 if none do."""
        wider = (replace(self, bits=bits) for bits in range(self.bits + 1, WIDEST + 1))
        return next((each.bits for each in wider if not each.outside(values, step(each))), 0)

    def _remedy(self, values: Floats, exponent: int) -> str:
        bits = self.wide_enough(values, lambda _: exponent)
        others = f"another {self.name}_step, or flag these pixels"
        return f"{bits} bits would hold them; or take {others}" if bits else f"take {others}"

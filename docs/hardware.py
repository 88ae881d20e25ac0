"""Print the tables of hardware.md: `make figures`, or ``python docs/hardware.py``.

What words of a table cost in quality C, on simulated arrays whose truth is known, and the width at
which the adaptive loop stops converging, on the standard scene of `simulate.MovingScene`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import equipix
from equipix import hardware, nuc
from equipix.simulate import MovingScene, StaringArray

sys.path.append(str(Path(__file__).parents[1] / "tests"))
import reference
from reference.scene import LocalMean, neighbours

if TYPE_CHECKING:
    from collections.abc import Iterable

SHAPE = (96, 128)
LIGHTS = (3e6, 9.3e6, 14e6)
"""Photoelectrons of the levels at which C is measured."""

FRAMES = 16
LOWEST = 1000.0
"""Corrected value that the ADC must still see: the lowest level is at 2600 DN."""

WIDTHS = range(16, 7, -1)
SCENE = (64, 64)
MOVING = 2000
"""Moving frames of the loop; the stop of the scene comes beside them."""

SEEDS = (1, 2, 3)
STEPS = (4, 6, 8)
"""Steps of the loop are 2 to minus these powers."""

LOOP_WIDTHS = range(12, 3, -1)
ADC_BITS = 14


def two_point(material: str = "InSb", shape: tuple[int, int] = SHAPE) -> tuple[Any, Any]:
    """An array, and its two-point correction by levels of 64 frames."""
    array = StaringArray.of(material, shape, rng=1)
    levels = [
        equipix.average(array.frames(light, 64, rng=k)) for k, light in enumerate((3e6, 14e6))
    ]
    response = nuc.fit(levels, order=1)
    named = response.metadata | {"sensor": {"bit_depth": array.bit_depth}}
    return array, replace(response, metadata=named)


def frames_of(array: StaringArray) -> list[Any]:
    """Frames of each level at which C is measured."""
    return [
        np.stack(list(array.frames(light, FRAMES, rng=50 + k))) for k, light in enumerate(LIGHTS)
    ]


def print_widths() -> None:
    """What widths of the memories add to the spatial noise."""
    array, response = two_point()
    found = hardware.smallest_widths(response, frames_of(array), lowest=LOWEST)
    print("bits    offset    gain    both   (spatial noise added, over the temporal noise)")
    for bits in WIDTHS:
        cells = (found.added[name][bits] for name in ("offset", "gain", "both"))
        print(f"{bits:4d}" + "".join(f"{cell:10.3f}" for cell in cells))
    print(f"smallest: offset {found.offset_bits}, gain {found.gain_bits}, both {found.both_bits}")


def print_materials() -> None:
    """C of a correction and of its table, by material."""
    for material in ("PtSi", "InSb", "HgCdTe"):
        array, response = two_point(material)
        frames = frames_of(array)[1]
        cells = [
            hardware.quality(response, frames, offset_bits=b, gain_bits=b, lowest=LOWEST)
            for b in (8, 10, 12, 16)
        ]
        after = "".join(f"{cell.after.ratio:9.3f}" for cell in cells)
        widths = hardware.smallest_widths(response, frames_of(array), lowest=LOWEST)
        print(f"{material:7s}{cells[0].before.ratio:9.3f}{after}{widths.both_bits!s:>5s}")


def print_coarse() -> None:
    """What the coarse offset leaves to the fine one, on an array of wide spread of the offset."""
    array = StaringArray.of("InSb", SHAPE, rng=1)
    spread = np.random.default_rng(7).uniform(0, 4000, SHAPE)
    array = array.with_causes(offset_dn=300 + spread, well_e=4e7)
    levels = [equipix.average(array.frames(light, 64, rng=k)) for k, light in enumerate(LIGHTS[:2])]
    response = nuc.fit(levels, order=1)
    frames = np.stack(list(array.frames(6e6, FRAMES, rng=50)))
    print("DAC, bits   step, DN   offset step, DN   ADC of 12 bits: words at its ends   C")
    options = {"adc_bits": 12, "offset_bits": 12, "lowest": 2700.0}
    rows = [("off", hardware.quality(response, frames, dac_step=2.0**14, **options))]
    for bits in (8, 10, 12):
        found = hardware.quality(response, frames, dac_bits=bits, **options)
        rows.append((str(bits), found))
    for name, found in rows:
        f = found.table.format
        print(
            f"{name:>9s}{2.0**f.coarse:11g}{2.0**f.offset:18g}{found.at_ends:30d}"
            f"{found.after.ratio:12.3f}"
        )


@dataclass
class Falls:
    """Falls of the residual pattern, on one sequence with one step.

    Attributes
    ----------
    floats : float
        By `Loop`, in double precision.
    words : dict
        By the integer loop, for each width of both memories.
    error : float
        Rms of E over pixels and the last quarter of the frames, in double precision.
    largest : float
        Largest |E| of all frames with the memories as they start.
    """

    floats: float
    words: dict[int, float]
    error: float
    largest: float

    @property
    def stops_at(self) -> int | None:
        """Widest memories whose pattern falls less than half as much as in double precision."""
        return max(
            (bits for bits, fall in self.words.items() if 2 * fall < self.floats), default=None
        )


def falls(widths: Iterable[int], *, exponent: int, seed: int, moving: int = MOVING) -> Falls:
    """Falls of the residual pattern by the loop with the step 2^-exponent."""
    scene = MovingScene(seed=seed, shape=SCENE)
    sequence = list(scene.frames(moving + scene.stop[1] - scene.stop[0]))
    level = sequence[-1].level
    start = scene.residual_pattern(np.ones(SCENE), np.zeros(SCENE), level)
    words = [digitised(frame.values) for frame in sequence]

    def fall(gain: Any, offset: Any) -> float:
        return start / scene.residual_pattern(gain, offset, level)

    floats, error = in_floats(words, 2.0**-exponent)
    raw = (word / 2**ADC_BITS for word in words)
    return Falls(
        fall(floats.gain, floats.offset),
        {bits: fall(*in_words(words, bits, 2.0**-exponent)) for bits in widths},
        error,
        max(float(np.abs(around(y) - y).max()) for y in raw),
    )


def digitised(values: Any) -> Any:
    """Values on [0, 1] as words of the ADC, those beyond it limited."""
    return np.clip(np.rint(values * 2**ADC_BITS), 0, 2**ADC_BITS - 1).astype(np.uint16)


class Loop:
    """The loop of `reference.adapt_words` in double precision: what no memory rounds."""

    def __init__(self, shape: tuple[int, int], step: float) -> None:
        self.gain, self.offset, self.step = np.ones(shape), np.zeros(shape), step

    def update(self, y: Any) -> Any:
        """Take a frame on [0, 1]; the errors E of its corrected values."""
        corrected = self.gain * y + self.offset
        error = neighbours(corrected, LocalMean.KERNEL) - corrected
        self.gain = self.gain + self.step * error * y
        self.offset = self.offset + self.step * error
        self.gain, self.offset = self.gain - self.gain.mean() + 1, self.offset - self.offset.mean()
        return error


def in_floats(words: list[Any], step: float) -> tuple[Loop, float]:
    """The loop in double precision, and the rms of E over the last quarter of the frames."""
    loop = Loop(SCENE, step)
    squares = [np.mean(loop.update(word / 2**ADC_BITS) ** 2) for word in words]
    return loop, float(np.sqrt(np.mean(squares[-len(squares) // 4 :])))


def in_words(words: list[Any], bits: int, step: float) -> tuple[Any, Any]:
    """Gain and offset of the loop with integer memories; `AdaptiveLoop` has 8 bits or more."""
    if bits >= min(WIDTHS):
        loop = hardware.AdaptiveLoop(
            SCENE, adc_bits=ADC_BITS, gain_bits=bits, offset_bits=bits, step=step
        )
        loop.update(np.stack(words), workers=1)
        return loop.gain / 2.0 ** (bits - 1), loop.offset / 2.0**bits
    gain, offset = np.full(SCENE, 2 ** (bits - 1)), np.zeros(SCENE, int)
    for word in words:
        _, gain, offset = reference.adapt_words(
            word, gain, offset, widths=(ADC_BITS, bits, bits), step=step
        )
    return gain / 2.0 ** (bits - 1), offset / 2.0**bits


def around(values: Any) -> Any:
    """Mean of the four neighbours, the opposite one in place of one beyond the edge."""
    wide = np.pad(values, 1, mode="reflect")
    return (wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:]) / 4


def lost_at(error: float, exponent: int) -> int:
    """Widest memories that lose a change of η·error: half a step, 2^-bits / 2, is not below it.

    Steps of the offset are 2^-bits of the range. Those of the gain are twice as large, and its
    changes η·E·y are smaller.
    """
    return int(np.floor(exponent - 1 - np.log2(error)))


def print_loop() -> None:
    """Fall of the pattern by width and step, and the width at which the loop stops converging."""
    print(f"fall of the residual pattern after {MOVING} moving frames, the stop included")
    print(
        "step   seed  floats"
        + "".join(f"{b:7d}" for b in LOOP_WIDTHS)
        + "  stops at  lost at  frozen at"
    )
    stops: dict[int, list[int | None]] = {exponent: [] for exponent in STEPS}
    for exponent in STEPS:
        for seed in SEEDS:
            found = falls(LOOP_WIDTHS, exponent=exponent, seed=seed)
            cells = "".join(f"{found.words[bits]:7.2f}" for bits in LOOP_WIDTHS)
            stops[exponent].append(found.stops_at)
            lost, frozen = (lost_at(e, exponent) for e in (found.error, found.largest))
            print(
                f"2^-{exponent}{seed:6d}{found.floats:9.2f}{cells}{found.stops_at!s:>10s}"
                f"{lost:9d}{frozen:11d}",
                flush=True,
            )
    for exponent, bits in stops.items():
        print(f"with the step 2^-{exponent} the loop stops converging at {bits} bits, by seed")
    print("stops at: fall below half of that in double precision")
    print("lost at: half a step of the memory is the rms change; frozen at: the largest change")


if __name__ == "__main__":
    print_widths()
    print_materials()
    print_coarse()
    print_loop()

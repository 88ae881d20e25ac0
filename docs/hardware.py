"""Print the tables of hardware.md: `make figures`, or ``python docs/hardware.py``.

What words of a table cost in quality C, on simulated arrays whose truth is known, and the widths at
which the adaptive loop stops converging, on a moving scene.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import equipix
from equipix import hardware, nuc
from equipix.simulate import StaringArray

SHAPE = (96, 128)
LIGHTS = (3e6, 9.3e6, 14e6)
"""Photoelectrons of the levels at which C is measured."""

FRAMES = 16
LOWEST = 1000.0
"""Corrected value that the ADC must still see: the lowest level is at 2600 DN."""

WIDTHS = range(16, 7, -1)
SCENE = (64, 64)
ADC_BITS = 14


def two_point(material: str = "InSb", shape: tuple[int, int] = SHAPE) -> tuple[Any, Any]:
    """An array, and its two-point correction by levels of 64 frames."""
    array = StaringArray.of(material, shape, rng=1)
    levels = [
        equipix.average(array.frames(light, 64, rng=k)) for k, light in enumerate((3e6, 14e6))
    ]
    return array, nuc.fit(levels, order=1)


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


class Scene:
    """A moving scene seen by an array whose gains and offsets differ, on [0, 1]."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        side = 256
        f = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
        f[0, 0] = np.inf
        field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((side, side))) / f).real
        self._field = np.clip(field / field.std(), -2.5, 2.5)
        self.gain = 1 + 0.05 * rng.standard_normal(SCENE)
        self.offset = 0.1 * rng.standard_normal(SCENE)
        self._rng, self._angle, self._place = rng, 0.0, np.zeros(2)

    def level(self, index: int) -> float:
        """Mean light: a triangle from 0.25 to 0.75, 500 frames each way."""
        return float(0.25 + 0.5 * (1 - abs((index % 1000) / 500 - 1)))

    def frame(self, index: int) -> Any:
        """The next frame, in words of the ADC; the scene moves by whole pixels."""
        self._angle += 0.1 * self._rng.standard_normal()
        speed = 1.5 + 1.5 * np.sin(2 * np.pi * index / 61)
        self._place += speed * np.array([np.cos(self._angle), np.sin(self._angle)])
        seen = np.roll(self._field, np.rint(self._place).astype(int), (0, 1))
        light = self.level(index) + 0.1 * seen[: SCENE[0], : SCENE[1]]
        y = self.gain * light + self.offset + 0.002 * self._rng.standard_normal(SCENE)
        return np.clip(np.rint(y * 2**ADC_BITS), 0, 2**ADC_BITS - 1).astype(np.uint16)

    def pattern(self, gain: Any, offset: Any, index: int) -> float:
        """Residual pattern: rms of (gG − 1)b + gO + o, over mean(gG), less its mean."""
        product = gain * self.gain
        left = (product - 1) * self.level(index) + gain * self.offset + offset
        return float((left / product.mean()).std())


def falls(widths: list[int], count: int, *, step: float, seed: int) -> dict[int, float]:
    """Fall of the residual pattern after `count` frames, by the width of both memories.

    The width 0 stands for memories in double precision.
    """
    scene = Scene(seed)
    frames = np.stack([scene.frame(index) for index in range(count)])
    gain, offset = np.ones(SCENE), np.zeros(SCENE)
    start = scene.pattern(gain, offset, count - 1)
    for frame in frames:
        gain, offset = in_floats(frame / 2**ADC_BITS, gain, offset, step)
    found = {0: start / scene.pattern(gain, offset, count - 1)}
    for bits in widths:
        loop = hardware.Adaptive(
            SCENE, adc_bits=ADC_BITS, gain_bits=bits, offset_bits=bits, step=step
        )
        loop.update(frames, workers=1)
        now = loop.gain / 2.0 ** (bits - 1), loop.offset / 2.0**bits
        found[bits] = start / scene.pattern(*now, count - 1)
    return found


def in_floats(y: Any, gain: Any, offset: Any, step: float) -> tuple[Any, Any]:
    """One frame of the loop in double precision."""
    x = gain * y + offset
    wide = np.pad(x, 1, mode="reflect")
    error = (wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:]) / 4 - x
    gain, offset = gain + step * error * y, offset + step * error
    return gain - gain.mean() + 1, offset - offset.mean()


def stops(found: dict[int, float]) -> int | None:
    """The widest memories whose pattern falls less than half as much as in double precision."""
    bad = [bits for bits in found if bits and found[bits] < found[0] / 2]
    return max(bad, default=None)


def print_loop() -> None:
    """Fall of the pattern by width and step, three seeds."""
    widths = list(WIDTHS)
    print("step     seed   floats" + "".join(f"{bits:8d}" for bits in widths) + "   stops at")
    for exponent in (4, 6, 8):
        for seed in (1, 2, 3):
            found = falls(widths, 2000, step=2.0**-exponent, seed=seed)
            cells = "".join(f"{found[bits]:8.2f}" for bits in widths)
            print(f"2^-{exponent}{seed:9d}{found[0]:9.2f}{cells}{stops(found)!s:>11s}")


if __name__ == "__main__":
    print_widths()
    print_materials()
    print_coarse()
    print_loop()

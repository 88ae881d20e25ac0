"""What results hold, as maps with names and units, reduced to what a picture can show."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from equipix._check import Array, Bools, Floats
from equipix.bolometer.dynamic import DynamicCorrection
from equipix.calibration.result import Calibration
from equipix.comparison import Comparison
from equipix.correction.protocol import Correction
from equipix.findings import Flag, usable
from equipix.fitting.residuals import cell_side
from equipix.measured.noise import BLOCK
from equipix.measured.statistics import FrameStatistics
from equipix.metrics.maps import block_means
from equipix.nuc.response import Response
from equipix.scene.scene_correction import SceneCorrection

LARGEST = 1000
"""Most rows and columns of a map in a picture: larger ones are reduced by block means."""

_AT_ONCE = 2**24
"""Pixels of which block means are formed at once."""

Scale = Literal["level", "deviation", "size"]
"""Values around a level of their own, around 0, or above it."""


@dataclass(frozen=True, eq=False)
class Map:
    """A value of each pixel, or of each cell of the beam.

    Attributes
    ----------
    name, unit : str
        What it is, in words for a title; the unit is empty for a ratio.
    values : ndarray, shape (rows, cols)
        The values; NaN where there is none.
    scale : {"level", "deviation", "size"}
        Whether they lie around a level of their own, around 0, or above it.
    cell : int
        Pixels along the side of what has a value.
    unusable : ndarray of bool, shape (rows, cols), or None
        Pixels that the ends of the colours ignore.
    """

    name: str
    unit: str
    values: Array
    scale: Scale = "level"
    cell: int = 1
    unusable: Bools | None = None

    @property
    def title(self) -> str:
        """Name and unit."""
        return f"{self.name}, {self.unit}" if self.unit else self.name

    @cached_property
    def extremes(self) -> tuple[float, float]:
        """Smallest and largest value; NaN where there is none."""
        known = np.isfinite(self.values)
        if not known.any():
            return np.nan, np.nan
        first = self.values.flat[known.argmax()]
        smallest, largest = (
            end(self.values, where=known, initial=first) for end in (np.min, np.max)
        )
        return float(smallest), float(largest)

    def usual(self, values: Floats, step: int) -> Floats:
        """Those of the values of blocks of so many pixels that have no unusable one, if any."""
        known = np.isfinite(values)
        if self.unusable is None:
            return values[known]
        good = known & (_means(self.unusable, step) == 0)
        return values[good if good.any() else known]

    def words(self, step: int) -> str:
        """What a picture shows whose points are so many pixels wide, and the extremes."""
        smallest, largest = self.extremes
        points = "cells" if self.cell > 1 else "single pixels"
        means = f"means of {step}×{step} pixels; " if step > self.cell else ""
        cells = f"cells of {step}×{step} pixels, " if step == self.cell > 1 else f"{points} "
        return f"{means}{cells}from {smallest:.4g} to {largest:.4g} {self.unit}".strip()

    def reduced(self, largest: int = LARGEST) -> tuple[Floats, int]:
        """Means of blocks, at most so many along rows and columns, and the pixels along a block.

        Blocks at the last row and column may be smaller.
        """
        step = -(-max(self.values.shape) // largest)
        if step > 1:  # even: means over odd blocks of colour filters would show moiré
            step += step % 2
        rows = max(step, _AT_ONCE // self.values.shape[1] // step * step)
        parts = [self.values[first : first + rows] for first in range(0, len(self.values), rows)]
        return np.concatenate([_means(part, step) for part in parts]), step * self.cell


def _means(values: Array, step: int) -> Floats:
    """Means over blocks of the values that are known, NaN without any."""
    known = np.isfinite(values)
    total, count = np.where(known, values, 0.0), known.astype(np.int32)
    for axis in (0, 1):
        first = np.arange(0, values.shape[axis], step)
        total, count = (np.add.reduceat(each, first, axis) for each in (total, count))
    means: Floats = np.divide(total, count, where=count > 0, out=np.full(total.shape, np.nan))
    return means


def maps_of(result: Any) -> list[Map]:
    """Maps of a result, the most important first.

    Parameters
    ----------
    result : Calibration, Response, DynamicCorrection, FrameStatistics, SceneCorrection, Correction
        What `equipix.load` reads.

    Returns
    -------
    list of Map
        Flags are not among them: `flagged` counts and places them.
    """
    for kind, maps in _MAPS.items():
        if isinstance(result, kind):
            found = [each for each in maps(result) if np.isfinite(each.values).any()]
            break
    else:
        found = [*_of_correction(result)]
    flags = getattr(result, "flags", None)
    if flags is None or not flags.any():
        return found
    bad = ~usable(flags)
    same = [each.values.shape == bad.shape for each in found]
    return [replace(each, unusable=bad if x else None) for each, x in zip(found, same, strict=True)]


def _of_calibration(calibration: Calibration) -> Iterator[Map]:
    yield Map("Sensitivity M", "", calibration.sensitivity)
    if calibration.sensitivity_std is not None:
        yield Map("Standard deviation of M", "", calibration.sensitivity_std, "size")
    residuals = calibration.residual_map
    if residuals is not None:
        unit = "DN" if calibration.metadata["options"]["weights"] == "equal" else "σ"
        cell = cell_side(calibration.shape, len(calibration.shifts))
        name = "Residuals, rms" + (" of a row of each cell" if cell > 1 else "")
        yield Map(name, unit, residuals, "size", cell)
    over = "" if calibration.cfa is None else ", over the response of each colour"
    yield Map(f"Beam L{over}", "DN", calibration.beam)
    if calibration.dark is not None:
        yield Map("Dark", "DN", calibration.dark)


def _of_comparison(comparison: Comparison) -> Iterator[Map]:
    yield Map("Scatter of the sensitivities", "", comparison.agreement, "size")
    for number, (i, j) in enumerate(comparison.pairs):
        yield from difference_maps(f"Difference {i} − {j}", comparison.difference(number))


def difference_maps(name: str, difference: Floats) -> Iterator[Map]:
    """Maps of the difference of two sensitivities, of pixels and of block means."""
    yield Map(name, "", difference, "deviation")
    yield Map(f"{name}, 16×16 means", "", block_means(difference), "deviation", BLOCK)


def _of_response(response: Response) -> Iterator[Map]:
    names = ("Offset a", "Gain deviation K", "Curvature c", "Cubic term e")
    units = ("DN", "", "1/DN", "1/DN²")
    for name, unit, plane in zip(names, units, response.deviation, strict=False):
        yield Map(name, unit, plane, "deviation")
    yield Map("Reduced χ² of the fit", "", response.reduced_chi2, "size")
    if response.order > 1:
        yield Map("Error of the inverse", "DN", response.inverse_error, "size")


def _of_dynamic(correction: DynamicCorrection) -> Iterator[Map]:
    low, high = correction.axes.substrate_c
    middle = (low + high) / 2
    state = correction.correction(middle)
    offset, gain = np.where(usable(state.flags), state.coefficients, np.nan)
    yield Map(f"Offset at {middle:.4g} °C", "DN", offset)
    yield Map(f"Gain at {middle:.4g} °C", "", gain)


def _of_statistics(frames: FrameStatistics) -> Iterator[Map]:
    yield Map("Mean", "DN", frames.mean)
    yield Map("Standard deviation of a frame", "DN", np.sqrt(frames.variance), "size")
    if np.ptp(frames.count):
        yield Map("Samples that count", "", frames.count, "size")


def _of_scene(correction: SceneCorrection) -> Iterator[Map]:
    yield Map("Gain", "", correction.gain)
    yield Map("Offset", "DN", correction.offset, "deviation")


def _of_correction(correction: Correction) -> Iterator[Map]:
    names = ("Offset of the correction", "Gain of the correction")
    for power, plane in enumerate(correction.coefficients):
        if power == 0 and not np.nan_to_num(plane).any():
            continue  # of a gain alone
        name = names[power] if power < len(names) else f"Coefficient of degree {power}"
        yield Map(name, ("DN", "", "1/DN", "1/DN²")[power], plane)


_MAPS: dict[type, Callable[[Any], Iterator[Map]]] = {
    Calibration: _of_calibration,
    Comparison: _of_comparison,
    Response: _of_response,
    DynamicCorrection: _of_dynamic,
    FrameStatistics: _of_statistics,
    SceneCorrection: _of_scene,
}
"""What gives the maps of each kind of result; all others are corrections by coefficients."""


def flagged(flags: Array) -> dict[Flag, tuple[Array, Array]]:
    """Rows and columns of the pixels that have each flag; ``DO_NOT_USE`` stands beside others."""
    pixels = np.flatnonzero(flags)
    bits = flags.ravel()[pixels]
    found = {flag: pixels[bits & flag != 0] for flag in Flag if flag != Flag.DO_NOT_USE}
    return {flag: np.divmod(each, flags.shape[1]) for flag, each in found.items() if each.size}

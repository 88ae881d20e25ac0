"""Moves of the sensor, measured from images of a small aperture in the beam."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from equipix._check import Array, Bools, Floats
from equipix.errors import InputError
from equipix.experiment.image_files import raw_frames
from equipix.experiment.manifest import Exposure, Manifest, entry_files
from equipix.exposures.positions import in_beam, variance_in_beam
from equipix.exposures.spots import ShiftMeasurement, Spot, hot_places, measure_shift, mended
from equipix.findings import usable
from equipix.fitting.weighted import Weighted
from equipix.measured.colour import Filters
from equipix.measured.part import median
from equipix.measured.saturation import saturation_level

_AROUND = 8
"""Pixels to each side of a spot's middle that represent those under it."""

_UNEQUAL_PIXELS = 0.008
"""Error of a centroid by unequal pixels under the spot, in pixels: s/(2√π) for a disc of any size
and pixels of relative spread s, here that of a uniform ±5 %, usual before a calibration."""


@dataclass(frozen=True, eq=False)
class Equalisation:
    """What a first fit determines of the pixels under a spot.

    Attributes
    ----------
    gain : ndarray, shape (rows, cols)
        Sensitivity; 1 in pixels that are not to be used, which the centroid corrects itself.
    dark : ndarray, shape (rows, cols)
        The dark frame, in DN.
    variance : ndarray, shape (rows, cols)
        Relative variance of the sensitivity by noise, the beam being known: 1/(M² Σ w c²L²), times
        n/(n − 2) since a pixel's n measurements determine the beam too; with two, which determine
        no noise, times 2. NaN where unknown.
    darks : sequence of ndarray
        The dark of each exposure on the whole sensor, where they are known.
    corner : tuple of int
        The pixel (row, col) of the sensor that the maps begin at.
    """

    gain: Array
    dark: Array
    variance: Array
    darks: Sequence[Array] = ()
    corner: tuple[int, int] = (0, 0)

    @property
    def region(self) -> tuple[slice, slice]:
        """The rows and columns of the sensor that the maps are of."""
        rows, cols = (
            slice(first, first + size)
            for first, size in zip(self.corner, self.gain.shape, strict=True)
        )
        return rows, cols

    @classmethod
    def of(
        cls,
        weighted: Weighted,
        flags: Array,
        workers: int | None = None,
        darks: Sequence[Array] = (),
        corner: tuple[int, int] = (0, 0),
    ) -> Self:
        """Take it from the fit of exposures whose dark is known, or their darks are given.

        The exposures may be those of a part of the sensor that begins at `corner`.
        """
        exposures, fit = weighted.exposures, weighted.fit
        dark = next(iter(darks), None) if exposures.dark is None else exposures.dark
        if dark is None:
            raise InputError(
                "'calibration' holds no dark frame: give one that Experiment.run has made"
            )
        good = usable(flags)
        count = len(exposures)
        known = fit.information(workers=workers) * np.square(fit.sensitivity)
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = weighted.noise_variance * count / max(count - 2, 1) / known
        gain = np.where(good, fit.sensitivity, 1) * exposures.response
        gain = gain.astype(exposures.values.dtype)
        return cls(gain, dark, np.where(good, variance, np.nan), darks, corner)

    @classmethod
    def of_colours(cls, filters: Filters | None, darks: Sequence[Array]) -> Self | None:
        """Responses of the colours alone, before any fit; None of a sensor without filters."""
        if filters is None:
            return None
        gain = filters.map_of(darks[0].shape)
        return cls(gain, darks[0], np.full(gain.shape, np.nan), darks)

    def at(self, exposure: int) -> Self:
        """Return it for images with the dark of an exposure."""
        if not self.darks:
            return self
        return replace(self, dark=self.darks[exposure][self.region].astype(self.gain.dtype))

    def apply(self, frames: Array) -> Array:
        """Images of the aperture as equal pixels would have given them, where the maps are.

        A pixel without a dark takes the median, and the centroid corrects it as a bad one.
        """
        return self._of_equal_pixels(self._part(frames))

    @property
    def sensor(self) -> tuple[int, int]:
        """Rows and columns of the sensor."""
        rows, cols = self.darks[0].shape if self.darks else self.gain.shape
        return rows, cols

    def _part(self, frames: Array) -> Array:
        """Where the maps are."""
        if frames.shape[-2:] != self.sensor:
            raise InputError(
                f"'calibration' is of a sensor of {self.sensor}, the images of the aperture "
                f"have {frames.shape[-2:]} pixels"
            )
        return frames[..., *self.region]

    def _of_equal_pixels(self, part: Array) -> Array:
        dark = np.where(np.isnan(self.dark), median(self.dark), self.dark)
        return np.asarray((part - dark) / self.gain)

    def equal(self, raw: Iterable[Array], level: float | None, hot: Bools | None) -> Array:
        """Images of equal pixels, from some at a time, whose hot ones are mended."""
        part = np.concatenate([self._part(frames) for frames in raw])
        known = None if hot is None else hot[self.region]
        places = hot_places(part, saturation_level(part, level), known)
        return mended(self._of_equal_pixels(part), places)

    def unequal_pixels(self, spot: Spot) -> float:
        """Variance of a centroid by the pixels that are left unequal: s²/4π."""
        row, col = np.rint(spot.position - self.corner).astype(int)
        around = self.variance[
            max(row - _AROUND, 0) : row + _AROUND, max(col - _AROUND, 0) : col + _AROUND
        ]
        known = around[np.isfinite(around)]
        if not known.size:  # no light around the spot, or no noise known
            return _UNEQUAL_PIXELS**2
        return float(min(np.median(known) / (4 * np.pi), _UNEQUAL_PIXELS**2))


class Moves(NamedTuple):
    """Measured moves: shifts of the exposures and their standard errors (n, 2), the spots (m, 2).

    `radius` is that of the largest spot, in pixels.
    """

    shifts: Floats
    std: Floats
    spots: Floats
    radius: float = 0.0


def measured_moves(
    path: Path,
    manifest: Manifest,
    equalisation: Equalisation | None = None,
    *,
    hot: Bools | None = None,
) -> Moves:
    """Shift of each exposure and its standard error; see `Experiment.measure_shifts`.

    `hot` are the pixels that the dark frames show to be hot.
    """
    first, *others = manifest.exposure
    shifts, variances = ([each] for each in _given(first))
    places: list[Array] = []
    radius = 0.0
    for number, (old, new) in enumerate(zip(manifest.exposure, others, strict=False), start=1):
        shift, variance = _given(new)
        if new.shift is None:
            equal = None if equalisation is None else equalisation.at(number)
            spots, shape, size = _spots(path, manifest, new, equal, hot)
            radius = max(radius, size)
            places += (spots.before.position, spots.after.position)
            ends = ((spots.before, old.rotation), (spots.after, new.rotation))
            before, after = (in_beam(spot.position, turn, shape) for spot, turn in ends)
            shift = shifts[-1] + before - after
            noise = sum(variance_in_beam(np.square(spot.std), turn) for spot, turn in ends)
            unequal = sum(
                _UNEQUAL_PIXELS**2 if equalisation is None else equalisation.unequal_pixels(spot)
                for spot, _ in ends
            )
            variance = variances[-1] + noise + unequal
        shifts.append(shift)
        variances.append(variance)
    return Moves(np.array(shifts), np.sqrt(variances), np.reshape(places, (-1, 2)), radius)


_MARGIN, _RADII, _REACH = 128, 2.5, 2.0
"""Pixels beyond the outermost spots that are equalised too. At least so many; this many times the
radius of a spot, which then is an eighth of the part, so that its background shows; and this many
times the largest move, which the fit of the part must tell apart."""

_MOST = 0.5
"""Share of the sensor up to which a part of it stands for the pixels under the spots."""


def region_of_spots(
    moves: Moves, shape: tuple[int, int], period: tuple[int, int]
) -> tuple[slice, slice] | None:
    """Return the rows and columns around the spots; None if they are most of the sensor.

    They begin at a multiple of the `period` of colour filters.
    """
    reach = _REACH * np.ptp(moves.shifts, axis=0).max()
    margin = max(_MARGIN, _RADII * moves.radius, reach)
    region = []
    for places, size, step in zip(moves.spots.T, shape, period, strict=True):
        first = max(int(places.min() - margin), 0) // step * step
        region.append(slice(first, min(int(places.max() + margin) + 1, size)))
    rows, cols = region
    pixels = (rows.stop - rows.start) * (cols.stop - cols.start)
    return (rows, cols) if pixels <= _MOST * shape[0] * shape[1] else None


def _given(exposure: Exposure) -> tuple[Floats, Floats]:
    """Shift of an exposure in the manifest, and its variance; 0 unless given."""
    return np.array(exposure.shift or [0.0, 0.0]), np.square(exposure.shift_std or [0.0, 0.0])


def _spots(
    path: Path,
    manifest: Manifest,
    exposure: Exposure,
    equalisation: Equalisation | None,
    hot: Bools | None,
) -> tuple[ShiftMeasurement, tuple[int, int], float]:
    """Find the spots of the move to `exposure`, the shape of the sensor, and a spot's radius."""

    def images() -> list[Iterator[Array]]:
        entries = (exposure.aperture_before, exposure.aperture_after)
        files = (entry_files(path, each, manifest.layout) for each in entries if each is not None)
        return [raw_frames(each) for each in files]

    level = manifest.sensor.saturation_level
    try:
        if equalisation is None:
            return _found(images, level, hot)
        equal = (equalisation.equal(raw, level, hot) for raw in images())
        # In other units; the first measurement has checked that nothing saturates.
        return _moved(measure_shift(*equal), equalisation.corner), equalisation.sensor, 0.0
    except InputError as error:
        raise type(error)(f"{path}: move to exposure '{exposure.name}': {error}") from error


def _moved(found: ShiftMeasurement, corner: tuple[int, int]) -> ShiftMeasurement:
    """What was found in a part of the images that begins at a pixel."""
    first, second = (
        replace(spot, position=spot.position + corner) for spot in (found.before, found.after)
    )
    return replace(found, before=first, after=second)


def _found(
    images: Callable[[], list[Iterator[Array]]], level: float | None, hot: Bools | None
) -> tuple[ShiftMeasurement, tuple[int, int], float]:
    """Find the spots of a move in raw images, the shape of the sensor, and a spot's radius.

    Around the spots, where a coarse look at images of whole numbers shows that they are the only
    ones, else in whole images: so these say what is wrong with them.
    """
    raw = images()
    first = [next(frames) for frames in raw]
    rows, cols = first[0].shape[1:]
    shapes = {(rows, cols), first[1].shape[1:], (rows, cols) if hot is None else hot.shape}
    is_plain = len(shapes) == 1 and all(each.dtype.kind == "u" for each in first)
    with suppress(InputError):
        if is_plain and (around := _around_spots(first, level, hot)) is not None:
            region, radius = around
            parts = [
                np.concatenate([each[:, *region] for each in chain([start], frames)])
                for start, frames in zip(first, raw, strict=True)
            ]
            known = None if hot is None else hot[region]
            found = measure_shift(*parts, saturation=level, hot=known)
            return _moved(found, (region[0].start, region[1].start)), (rows, cols), radius
    del raw, first
    before, after = (np.concatenate(list(frames)) for frames in images())
    found = measure_shift(before, after, saturation=level, hot=hot)
    spots = ((before[0], found.before), (after[0], found.after))
    return found, (rows, cols), max(_size(image, spot.position)[0] for image, spot in spots)


_COARSE = 512
"""Rows and columns that show where a spot is and how large."""

_FEW = 8
"""Pairs of bright pixels side by side that are no spot: the search makes each pixel the median of
3×3, which leaves no line, and the smallest spot has sixteen."""


def _around_spots(
    images: Sequence[Array], level: float | None, hot: Bools | None
) -> tuple[tuple[slice, slice], float] | None:
    """Part of the images that holds all that is bright, and the radius of the larger spot.

    None where that part is most of the sensor, or where the sensor is small.
    """
    shape = images[0].shape[1:]
    step = min(shape) // _COARSE
    if step < 2:
        return None
    known = None if hot is None else hot[::step, ::step]
    parts = (frames[:, ::step, ::step] for frames in images)
    coarse = measure_shift(*parts, saturation=level, hot=known)
    spots = [step * each.position for each in (coarse.before, coarse.after)]
    sizes = [_size(frames[0], spot) for frames, spot in zip(images, spots, strict=True)]
    radius = max(radius for radius, _ in sizes)
    shifts = np.array([[0.0, 0.0], step * coarse.shift])
    moves = Moves(shifts, np.zeros_like(shifts), np.array(spots), radius)
    region = region_of_spots(moves, shape, (1, 1))
    if region is None:
        return None
    for frames, (_, half) in zip(images, sizes, strict=True):
        bright = frames[0] > frames.dtype.type(half)
        bright[region] = False
        if np.count_nonzero(bright[:, 1:] & bright[:, :-1]) >= _FEW:
            return None
    return region, radius


def _size(image: Array, position: Floats) -> tuple[float, float]:
    """Radius of a disc of as many pixels as are above half of a spot's level, and that half."""
    step = max(1, min(image.shape) // _COARSE)
    coarse = image[::step, ::step].astype(np.float64)
    row, col = (position / step).astype(int)
    base = np.median(coarse)
    top = np.median(coarse[max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2])
    half = float(base + top) / 2
    area = np.count_nonzero(coarse > half) * step**2
    return float(np.sqrt(area / np.pi)), half

"""Exposures of one beam: how they are fitted, predicted, and parts of them."""

import dataclasses
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from equipix import _native
from equipix._check import (
    Array,
    Bools,
    Floats,
    Method,
    Progress,
    as_mask,
    as_tolerance,
    check_progress,
    naming_memory,
    one_or_each,
    positive_count,
    positive_workers,
    union,
)
from equipix._native import Fit, Start
from equipix.errors import InputError
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Positions, name_of, nearest_whole
from equipix.measured.colour import Filters
from equipix.measured.defects import BadPixels
from equipix.measured.measured import Measured
from equipix.measured.saturation import clipping_advice

_BLOCK = 64
"""Rows of a block for medians."""

_REASONS = {  # the first that most pixels share: dark frames scatter more than a wrong model too
    "noisy": "scatters between frames by more than its noise model explains: correct the gain "
    "('gain_dn_per_e' in [sensor], 'variance' of calibrate), or leave it out",
    "hot": "is hot in the dark frames: give dark frames of the same camera and exposure time",
    "dead": "does not respond to light: is the dark that of these frames?",
}


@dataclass(frozen=True)
class FitOptions:
    """How to minimise the objective, and how far.

    Attributes
    ----------
    method : {"multiscale", "coordinate-descent"}
        The solver at shifts that differ by whole pixels.
    tolerance : float
        Largest relative error of the sensitivity at which the solver stops.
    max_sweeps : int or None
        Upper limit on passes over the data or its weights in a fit.
    workers : int or None
        Number of threads; None: as many as processors may be used.
    progress : callable or None
        Called as ``progress(done, total, stage)`` repeatedly.
    """

    method: Method = "multiscale"
    tolerance: float = 1e-6
    max_sweeps: int | None = None
    workers: int | None = None
    progress: Progress | None = None

    @property
    def whole_shifts(self) -> bool:
        """Whether the method takes shifts alone that differ by whole pixels: the core decides."""
        return _native.needs_whole_shifts(self.method)

    @classmethod
    def of(
        cls,
        method: Method,
        tolerance: float,
        max_sweeps: int | None,
        workers: int | None,
        progress: Progress | None,
    ) -> Self:
        """Check what the caller gave."""
        if method not in get_args(Method):
            raise InputError(f"'method' is {method!r}, expected one of {get_args(Method)}")
        check_progress(progress)
        most = None if max_sweeps is None else positive_count("max_sweeps", max_sweeps)
        return cls(method, as_tolerance(tolerance), most, positive_workers(workers), progress)


@contextmanager
def naming_exposures(names: Sequence[str]) -> Iterator[None]:
    """Name the exposure of an error that has its number alone, as those of the core."""
    try:
        yield
    except InputError as error:
        number = r"(?<=of )exposure (\d+)( \(from 0\))?"
        words = re.sub(number, lambda it: name_of(names, int(it[1])), str(error))
        raise type(error)(words) from error


@dataclass(frozen=True, eq=False, kw_only=True)
class Exposures(Measured):
    """Exposures of one beam: what is measured, where the sensor stood, and the fluxes.

    Attributes
    ----------
    positions : Positions
        Where the sensor stood.
    flux : Flux
        Relative flux of each exposure, and what is known of it.
    offset : bool
        Whether the values hold an offset of each pixel, to be fitted.
    relative : bool
        Whether the variances are relative, in an unknown unit.

    Notes
    -----
    Where there are `filters`, values and deviations are over the response of the pixel's colour, so
    that all pixels are alike; `noise` and `dark` are in DN.
    """

    positions: Positions
    flux: Flux
    offset: bool = False
    relative: bool = False

    @classmethod
    def of(
        cls,
        measured: Measured,
        positions: Positions,
        flux: Flux,
        *,
        mask: ArrayLike | None = None,
        offset: bool = False,
        dark_variance: ArrayLike | None = None,
    ) -> Self:
        """Check what the caller gave; the arguments are those of `equipix.calibrate`."""
        given = as_mask(mask, measured.values.shape)
        found = vars(measured) | {
            "mask": union(given, measured.mask),
            "raw": measured.raw and not offset,
            "dark_variance": _of_dark(dark_variance, measured, offset=offset),
        }
        exposures = cls(positions=positions, flux=flux, offset=offset, **found)
        exposures._refuse_nothing(given)
        shown = Filters.shown_by(measured.colours, exposures.values, exposures.mask)
        return exposures.behind(shown)

    def _refuse_nothing(self, given: Bools | None) -> None:
        """Refuse exposures that leave no value to use, if the mask `given` is not the reason."""
        if any(self.usable(k).any() for k in range(len(self))):
            return
        if not np.isfinite(self.values).any():
            raise InputError(
                "'frames' holds no finite number: every value is NaN, infinite or saturated"
            )
        free = dataclasses.replace(self, mask=given)
        left = np.any([free.usable(k) for k in range(len(self))], axis=0)
        if self.clipped is not None and left.any():
            raise InputError(f"'frames': {clipping_advice(self.clipped)}")
        for name, reason in _REASONS.items():
            found = getattr(self.bad_pixels, name)
            if found is not None and 2 * np.count_nonzero(left & found) > np.count_nonzero(left):
                raise InputError(f"'frames' leave no usable pixel: nearly each {reason}")

    def name_of(self, exposure: int) -> str:
        """Return how messages name an exposure."""
        return name_of(self.names, exposure)

    def used(self, fit: Fit, exposure: int) -> Bools:
        """Return which measurements of an exposure a fit used: usable ones that it did not lose."""
        used = self.usable(exposure)
        if fit.lost:
            used.flat[fit.lost[exposure]] = False
        return used

    @property
    def knows_noise(self) -> bool:
        """Whether variances of the values are known, and not their ratios alone."""
        return self.variance is not None and not self.relative

    @property
    def response(self) -> Floats | float:
        """What the values are over: the response of each pixel's colour (rows, cols), or 1."""
        return 1.0 if self.filters is None else self.filters.map_of(self.shape)

    def behind(self, filters: Filters | None) -> Self:
        """Return the exposures with values over the responses of the pixels' colours.

        Where no variance is known that of the values was equal: what follows is relative.
        """
        if filters is None:
            return self
        response = filters.map_of(self.shape)
        known = self.variance is not None
        given = np.ones(len(self)) if self.variance is None else self.variance
        given = given[:, None, None] if given.ndim == 1 else given
        dark, dtype = self.dark_variance, self.values.dtype
        return dataclasses.replace(
            self,
            values=self.values / response.astype(dtype),
            variance=(given / response**2).astype(dtype) if known or not self.noise else None,
            dark_variance=None if dark is None else dark / response**2,
            filters=filters,
            relative=not known and not self.noise,
        )

    def at(self, positions: Positions) -> Self:
        """Return the exposures at other positions."""
        return dataclasses.replace(self, positions=positions)

    def chosen(self, exposures: NDArray[np.int64]) -> Self:
        """Return some of the exposures."""
        positions, flux = self.positions.chosen(exposures), self.flux.chosen(exposures)
        return dataclasses.replace(super().chosen(exposures), positions=positions, flux=flux)

    def marked(self, **found: Bools | None) -> Self:
        """Return the exposures with bad pixels of some kinds in place of those found before."""
        return dataclasses.replace(self, bad_pixels=dataclasses.replace(self.bad_pixels, **found))

    def middle(self, side: int) -> tuple[slice, slice]:
        """Return the rows and columns of the central part, at most `side` pixels along an axis."""
        sizes = [min(size, side) for size in self.shape]
        first = [(size - part) // 2 for size, part in zip(self.shape, sizes, strict=True)]
        rows, cols = (slice(a, a + size) for a, size in zip(first, sizes, strict=True))
        return rows, cols

    def part(self, region: tuple[slice, slice]) -> Self:
        """Return the exposures of a part of the sensor, whole periods of filters from its corner.

        Views of the arrays, but for the values and what the solver needs in one piece.
        """
        first = np.array([each.start for each in region])
        sizes = np.array([each.stop for each in region]) - first
        if self.filters is not None and np.any(first % self.filters.colours.period):
            raise ValueError(f"{region} begins within a period of the colour filters")
        part = (..., *region)

        def of(array: Array | None) -> Array | None:
            is_map = array is not None and array.ndim > 1
            return np.ascontiguousarray(array[part]) if is_map and array is not None else array

        found = {name: of(pixels) for name, pixels in vars(self.bad_pixels).items()}
        return dataclasses.replace(
            self,
            values=np.ascontiguousarray(self.values[part]),
            positions=self.positions.of_window(first, sizes, self.shape),
            variance=of(self.variance),
            mask=of(self.mask),
            bad_pixels=BadPixels(**found),
            dark=None if self.dark is None else self.dark[part],
            dark_variance=of(self.dark_variance),
        )

    def window(self, side: int) -> Self:
        """Return the central part of the sensor, at most `side` pixels along each axis."""
        plain = dataclasses.replace(self, bad_pixels=BadPixels(), filters=None)
        return plain.part(self.middle(side))

    def fit(self, options: FitOptions, start: Start | None = None) -> Fit:
        """Fit sensitivity, beam and the other unknowns, from `start` on, which it consumes.

        Raises
        ------
        InputError
            If a value is out of range, an exposure shows no light, or what is sought cannot be
            determined by such exposures or by such a method.
        InsufficientMemoryError
            If there is not enough memory.
        """
        with naming_memory("calibrating"), naming_exposures(self.names):
            compiled = _native.Exposures(
                self.values,
                self.positions.shifts,
                shift_std=self.positions.std,
                rotation=self.positions.rotation.tolist(),
                flux=self.flux.values.tolist(),
                flux_model=self.flux.model,
                offset=self.offset,
                variance=self.variance,
                is_relative=self.relative,
                mask=self.mask,
                unreliable=self.bad_pixels.unreliable,
                workers=options.workers,
                progress=options.progress,
            )
            return compiled.fit(start=start, **vars(options))

    def light(self, fit: Fit, exposure: int, workers: int | None) -> Floats:
        """Return c · L(u) on each pixel in an exposure; NaN where the beam was not observed."""
        row, col = fit.shifts[exposure]
        turn = int(self.positions.rotation[exposure])
        light = fit.beam.light(self.shape, (row, col), turn, workers=workers)
        return np.asarray(fit.flux[exposure] * light)

    def residuals(self, fit: Fit, workers: int | None) -> Floats:
        """Return y − c · L(u) · M(p) − O(p), (n, rows, cols); NaN where nothing is predicted."""
        residuals = np.empty(self.values.shape)
        for k in range(len(self)):
            residuals[k] = self.residual(fit, k, workers)
        return residuals

    def residual(self, fit: Fit, exposure: int, workers: int | None) -> Floats:
        """Return y − c · L(u) · M(p) − O(p) of one exposure.

        NaN where nothing is predicted, and where the fit lost the measurement: M was fitted
        without it.
        """
        residual = self.light(fit, exposure, workers)
        residual *= fit.sensitivity
        np.subtract(self.values[exposure], residual, out=residual)
        if fit.offset is not None:
            residual -= fit.offset
        if fit.lost:
            residual.flat[fit.lost[exposure]] = np.nan
        return residual

    def deviation(self, exposure: int) -> Floats:
        """Return the standard deviation of the values of an exposure; 1 where weights are equal."""
        variance = 1.0 if self.variance is None else self.variance[exposure]
        return np.asarray(np.sqrt(variance, dtype=np.float64))

    def weighted_squares(self, squares: Array) -> Floats:
        """Return squares over variances; NaN where nothing is measured."""
        used = np.isfinite(squares)
        if self.mask is not None:
            used &= ~self.mask
        scale = np.ones(1) if self.variance is None else self.variance
        weighted = np.full(squares.shape, np.nan)
        scale = scale if scale.ndim == 3 else scale[:, None, None]
        np.divide(squares, scale, out=weighted, where=used)
        return weighted

    def cells(self, grid: Array, fit: Fit, exposure: int) -> Array:
        """Return a view of the cells of the beam's grid that are nearest to each pixel."""
        turn = int(self.positions.rotation[exposure])
        rows, cols = self.shape if turn % 180 == 0 else self.shape[::-1]
        corner = np.add(fit.beam.origin, fit.shifts[exposure])
        row, col = nearest_whole(corner).astype(int)
        return np.rot90(grid[row : row + rows, col : col + cols], turn // 90)

    def medians(self) -> Floats:
        """Return the median of value/flux in each pixel; NaN where nothing is measured."""
        result = np.empty(self.shape)
        for start in range(0, len(result), _BLOCK):
            rows = slice(start, start + _BLOCK)
            values = self.values[:, rows] / self.flux.values[:, None, None]
            usable = np.isfinite(values)
            if self.mask is not None:
                usable &= ~self.mask[..., rows, :]
            values[~usable] = np.nan
            result[rows] = _medians(values)
        return result


def _medians(values: Array) -> Array:
    """Medians along the first axis of the values that are not NaN."""
    values.sort(axis=0)  # NaN last
    count = np.isfinite(values).sum(axis=0)
    middle = [np.maximum(index, 0)[None] for index in ((count - 1) // 2, count // 2)]
    return np.asarray(np.mean([np.take_along_axis(values, i, axis=0)[0] for i in middle], axis=0))


def _of_dark(given: ArrayLike | None, measured: Measured, *, offset: bool) -> Floats | None:
    """Variance of the dark that was subtracted from all, given or that of the averages."""
    if given is not None and offset:
        raise InputError(
            "'dark_variance' is that of a dark that was subtracted, but 'dark' is 'fit': give one "
            "of the two"
        )
    if offset:
        return None
    if given is None:
        return measured.dark_variance
    return np.array(one_or_each("dark_variance", given, measured.shape, ndim=(0, 2)))

"""A sample of residuals, and tests of it.

Residuals of a right model are white. Tests take residuals (..., rows, cols), NaN where there are
none: images of neighbouring pixels in their last two axes. None needs a variance.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from equipix._check import Array, Bools, Floats
from equipix._native import Fit
from equipix.exposures.positions import Positions, in_beam, nearest_whole
from equipix.fitting.weighted import Weighted
from equipix.measured.noise import ROBUST, nanmedian_abs

FEWEST = 1000
"""Least degrees of freedom of a fit whose residuals say anything."""

EXACT = 0.3
"""Largest `Residuals.inexactness` at which F is as good as at its minimum."""

SAMPLED = 2**18
"""Measurements of a sample, and of a map: a correlation of 1.2 % is then five standard errors."""

_BAND = 32
"""Rows of a band: several blocks of neighbours, and more than most shifts."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals in bands of whole rows, spread evenly over the sensor.

    Attributes
    ----------
    values : ndarray, shape (n, bands, rows of a band, cols)
        (y − c L M)/σ; in the units of the frames where no variance is known. NaN where nothing is
        measured or predicted.
    light : ndarray of the same shape
        c L.
    response : ndarray of the same shape
        M/σ.
    rows : ndarray, shape (bands, rows of a band), int
        The row of the sensor of each row.
    share : float
        Degrees of freedom of the fit over its measurements: the mean square of residuals where
        variances are right.
    scale : float
        The variance of a value of weight 1, so the mean square of an error of measurement.
    error : float
        Estimated error of M.
    """

    values: Floats
    light: Floats
    response: Floats
    rows: Array
    share: float
    scale: float
    error: float

    @property
    def inexactness(self) -> float:
        """Estimated error of M over the relative noise that the fit leaves.

        F may still decrease by the order of its square. Infinite where there is no noise.
        """
        power, square = (np.nansum(np.square(each)) for each in (self.signal, self.values))
        if not (self.share > 0 and square > 0):
            return float("inf")
        return float(self.error * (self.share * power / square) ** 0.5)

    @property
    def signal(self) -> Floats:
        """The expected signal c L M/σ."""
        return self.light * self.response

    @property
    def slopes(self) -> Floats:
        """Slopes M/σ · ∂(c L) along rows and columns, (2, n, ...): what errors of shifts leave."""
        return np.stack([_slope(self.light, axis) * self.response for axis in (-2, -1)])


def _slope(light: Floats, axis: int) -> Floats:
    """Mean of the steps to both neighbours, or to the one that is predicted; 0 without any."""
    ends = [(0, 0)] * light.ndim
    ends[axis] = (1, 1)
    steps = np.pad(np.diff(light, axis=axis), ends, constant_values=np.nan)
    both = np.stack([np.delete(steps, end, axis) for end in (0, -1)])
    return np.asarray(np.nansum(both, axis=0) / np.maximum(np.isfinite(both).sum(axis=0), 1))


def sampled(weighted: Weighted, most: int = SAMPLED, workers: int | None = None) -> Residuals:
    """Residuals of a fit, of at most about so many measurements."""
    exposures, testing = weighted.exposures, tested(weighted.fit)
    used = sum(
        np.count_nonzero(exposures.used(weighted.fit, k) & testing, axis=1)
        for k in range(len(exposures))
    )
    count = most // (len(exposures) * exposures.shape[1])
    return _of_rows(weighted, bands(np.asarray(used), count), workers)


def cell_side(shape: tuple[int, int], exposures: int) -> int:
    """Pixels along the side of a cell of `rms_map`."""
    return -(-shape[0] * shape[1] * exposures // SAMPLED)


def rms_map(weighted: Weighted, workers: int | None = None) -> Array:
    """Rms residual over the exposures in square cells of pixels; float32, NaN where there is none.

    A cell of a large sensor is judged by one of its rows.
    """
    exposures = weighted.exposures
    height, width = exposures.shape
    side = cell_side(exposures.shape, len(exposures))
    rows = np.arange(side // 2, max(height // side, 1) * side, side)[:, None]
    values = _of_rows(weighted, rows, workers).values[:, :, 0]
    inner = values[..., : max(width // side, 1) * side]
    cells = np.square(inner).reshape(*inner.shape[:2], -1, min(side, width))
    counts = np.isfinite(cells).sum(axis=(0, 3))
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.nansum(cells, axis=(0, 3)) / counts), np.float32)


def _of_rows(weighted: Weighted, rows: Array, workers: int | None) -> Residuals:
    """Residuals of these rows (bands, rows of a band)."""
    exposures, fit = weighted.exposures, weighted.fit
    every, searched, testing = range(len(exposures)), in_search(fit), tested(fit)
    shape = (len(exposures), *rows.shape, exposures.shape[1])
    values, light, response = np.empty(shape), np.empty(shape), np.empty(shape)
    size = (rows.shape[1], exposures.shape[1])
    for b, first in enumerate(rows[:, 0].tolist()):
        part = slice(first, first + size[0])
        corners = exposures.positions.corners((first, 0), size, exposures.shape)
        for k, (row, col) in enumerate(np.array(fit.shifts) + corners):
            turn = int(exposures.positions.rotation[k])
            seen = fit.beam.light(size, (row, col), turn, workers=workers)
            np.multiply(fit.flux[k], seen, out=light[k, b])
            response[k, b] = fit.sensitivity[part]
            values[k, b] = exposures.values[k, part] - light[k, b] * response[k, b]
            if fit.offset is not None:
                values[k, b] -= fit.offset[part]
    for k in every:
        values[k, ~(exposures.used(fit, k) & testing)[rows]] = np.nan
    variance = exposures.variance
    if variance is not None:
        deep = variance[:, rows] if variance.ndim == 3 else variance[:, None, None, None]
        root = np.sqrt(deep, dtype=np.float64)
        values /= root
        response /= root
    measured = sum(np.count_nonzero(exposures.used(fit, k) & searched) for k in every)
    share = fit.degrees_of_freedom / max(measured, 1)
    error = float(fit.error_estimate[-1])
    return Residuals(values, light, response, rows, share, weighted.noise_variance, error)


def in_search(fit: Fit) -> Bools:
    """Pixels whose measurements F contains."""
    # Without a component, measurements are not used.
    known = fit.component_labels >= 0
    return known if fit.few is None else known & ~fit.few


def tested(fit: Fit) -> Bools:
    """Pixels whose residuals test the model: of which M does not follow its prior."""
    return in_search(fit) if fit.prior is None else in_search(fit) & (fit.prior == 0)


def bands(measured: Array, most: int) -> Array:
    """Rows (bands, rows of a band): all, as one band, or bands of some, spread evenly.

    `measured` is the number of measurements of each row. Bands lie where these are at least half as
    many as in the fullest band: masks, as of discs, may leave nothing in most rows.
    """
    count, number = len(measured), most // _BAND
    if number * _BAND >= count or count <= _BAND:
        return np.arange(count)[None]
    inside = np.convolve(measured, np.ones(_BAND), "valid")
    full = np.flatnonzero(inside >= inside.max() / 2)
    first = [-_BAND]
    for row in full[np.linspace(0, len(full) - 1, max(number, 2)).round().astype(int)].tolist():
        if row >= first[-1] + _BAND:
            first.append(row)
    return np.array(first[1:])[:, None] + np.arange(_BAND)


def axes_of(turn: int) -> Array:
    """Steps along the axes of a turned sensor, in the beam, as rows."""
    return np.array([in_beam(p, turn, (1, 1)) - in_beam((0, 0), turn, (1, 1)) for p in np.eye(2)])


def on_sensor(positions: Positions) -> Floats:
    """Shifts (n, 2) along the axes of the sensor, where all exposures are turned alike."""
    return np.asarray(positions.shifts @ axes_of(int(positions.rotation[0])).T)


def left_by(columns: Array, values: Array) -> tuple[Floats, int]:
    """What least squares along columns leaves of values, and the rank of the columns."""
    found, _, rank, _ = np.linalg.lstsq(columns, values, rcond=None)
    return np.asarray(values - columns @ found), int(rank)


def testable(rows: Array, shifts: Floats, shape: tuple[int, int], weights: Floats) -> Floats:
    """Share of each measurement (n, bands, rows, cols) that the beam does not take.

    It is 1 − ω/Σω over the exposures, of these weights, that see its cell, in units of that over
    all: 1 where all see it. At least two weights are above 0.
    """
    count = len(shifts)
    moves = nearest_whole(shifts[:, None] - shifts)
    seen = []
    for axis, places in enumerate((rows.ravel(), np.arange(shape[1]))):
        at = places + moves[..., axis, None]
        seen.append(((at >= 0) & (at < shape[axis])).astype(np.float64))
    # Each exposure sees its own cells.
    shares = weights * (1 - np.eye(count)), weights + np.zeros((count, 1))
    others, all_of_them = (
        np.einsum("kjr,kjc,kj->krc", *seen, share).reshape(count, *rows.shape, shape[1])
        for share in shares
    )
    # Not as a difference from 1: one exposure may have nearly all the weight.
    most = (shares[0].sum(axis=1) / weights.sum())[:, None, None, None]
    return np.asarray(others / all_of_them / most)


_CLIPPED = 4.0
"""Standard deviations at which residuals are cut off, so that a few false values do not decide."""


class Correlation(NamedTuple):
    """Correlation of the residuals of neighbouring pixels, along one axis.

    `size` is the mean product over the mean square, `z` the same in standard errors, `product` the
    mean product in the units of the squared residuals.
    """

    size: float
    z: float
    product: float


def lag_one(residuals: NDArray[np.floating], share: float) -> tuple[Correlation, Correlation]:
    """Correlation of residuals one row and one column apart.

    Parameters
    ----------
    residuals : ndarray, shape (..., rows, cols)
        Residuals of a fit; NaN where there are none.
    share : float
        Degrees of freedom over measurements: the fit makes residuals dependent on each other.

    Returns
    -------
    rows, cols : Correlation
        Of neighbours in one column, and of neighbours in one row.

    Notes
    -----
    With r = Q e, e white of variance σ² and Q a projection of rank f that is nearly invariant to
    translations, the sum of all products r r' has the variance σ⁴f. The sum of their squares
    expects σ⁴f²/N: products of pairs that share a pixel or a cell of the beam are dependent.
    """
    cut = clipped(residuals)
    pairs = ((cut[..., 1:, :], cut[..., :-1, :]), (cut[..., 1:], cut[..., :-1]))
    square = float(np.nanmean(np.square(cut))) if np.isfinite(cut).any() else math.nan
    rows, cols = (_correlation(a * b, square, share) for a, b in pairs)
    return rows, cols


def _correlation(products: Floats, square: float, share: float) -> Correlation:
    known = products[np.isfinite(products)]
    spread = math.sqrt(float(known @ known) / share) if share > 0 else 0.0
    if not (known.size and spread > 0):
        return Correlation(0.0, 0.0, 0.0)
    mean = float(known.mean())
    return Correlation(mean / square, float(known.sum()) / spread, mean)


def clipped(residuals: NDArray[np.floating]) -> Floats:
    """Residuals cut off at four standard deviations of their exposure, the first axis."""
    axes = tuple(range(1, residuals.ndim))
    scale = ROBUST * nanmedian_abs(residuals)
    limits = _CLIPPED * scale.reshape((-1, *(1 for _ in axes)))
    return np.asarray(np.clip(residuals, -limits, limits), np.float64)


def in_blocks(image: Array, side: int) -> Array:
    """Sums over blocks of `side` pixels square in the last two axes, smaller ones at the end."""
    for axis, size in ((-2, image.shape[-2]), (-1, image.shape[-1])):
        image = np.add.reduceat(image, np.arange(0, size, side), axis=axis)
    return image

"""Beam between pixels, fluxes, shifts and offsets in one dense fit, for tiny sensors.

    F = Σ w·(y − c·L(u)·M − O)² + τ‖G a‖² + Σ (ln c − ln c₀)²/s_c² + Σ (d − d₀)²/s_d²

with L(u) = Σ_j a_j·B(u − j), B the cubic B-spline along rows and columns (de Boor, A Practical
Guide to Splines, 1978), or a_u itself where all shifts are known and whole, but for a fraction that
they have in common, and G the fourth differences. Gauss-Newton steps in all unknowns at once, each
a dense least-squares problem of least norm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

Array: TypeAlias = "NDArray[Any]"

SMOOTHING = 1e-5
EXACT_SHIFT = 1e-6
ROUNDING = 1e-6
FOURTH = np.array([1, -4, 6, -4, 1])


@dataclass(frozen=True)
class JointSolution:
    """What `joint` found.

    Attributes
    ----------
    sensitivity : ndarray, shape (rows, cols)
        M, of mean 1 over the measured pixels; NaN where nothing was measured.
    dark : ndarray, shape (rows, cols)
        The offset O; 0 unless it was sought.
    beam : ndarray, shape of the grid
        L at the cells; NaN where it is undetermined.
    beam_origin : tuple of int or float
        Cell, or place between cells, of pixel (0, 0) of the unrotated sensor at shift 0.
    flux : ndarray, shape (n,)
        c of each exposure.
    shifts : ndarray, shape (n, 2)
        d of each exposure.
    objective : list of float
        F before each step; τ follows the weights, so it may rise a little.
    covariance : ndarray, shape (rows * cols, rows * cols)
        Covariance of the sensitivity; the penalty counts as a measurement.
    dark_std : ndarray, shape (rows, cols)
        Standard deviation of the offset.
    dark_along_std : float
        Standard deviation of b, the least-squares part b·M of the offsets' errors.
    shift_std : ndarray, shape (n, 2)
        Standard deviation of the shifts less their mean by the prior's weights, if sought.
    """

    sensitivity: Array
    dark: Array
    beam: Array
    beam_origin: tuple[float, float]
    flux: Array
    shifts: Array
    objective: list[float]
    covariance: Array
    dark_std: Array
    dark_along_std: float
    shift_std: Array

    @property
    def std(self) -> Array:
        """Standard deviation of the sensitivity, shape (rows, cols)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)).reshape(self.sensitivity.shape))


def joint(
    frames: ArrayLike,
    shifts: ArrayLike,
    *,
    variance: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    flux: ArrayLike | str | None = None,
    flux_std: ArrayLike | None = None,
    time: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    shift_std: ArrayLike | None = None,
    dark: str = "subtracted",
    steps: int = 30,
) -> JointSolution:
    """Minimise F over M and L, and over fluxes, shifts and offsets as asked.

    Parameters
    ----------
    frames, shifts, variance, mask, flux, flux_std, time, rotation, shift_std, dark : array_like
        As for `equipix.calibrate`; the variance is 1 unless given, also beside priors.
    steps : int
        Largest number of steps.

    Returns
    -------
    JointSolution
        All that was sought.

    Notes
    -----
    Cost: (measurements + 2·cells)·(unknowns)² per step. It looks for no components: the
    measurements have to compare all pixels that they reach.
    """
    values = np.array(frames, float)
    count, rows, cols = values.shape
    pixels = rows * cols
    sigma2 = np.ones(1) if variance is None else np.asarray(variance, float)
    sigma2 = sigma2[:, None, None] if sigma2.ndim == 1 else sigma2
    used = np.isfinite(values) & ~np.broadcast_to(False if mask is None else mask, values.shape)
    root = np.sqrt(np.where(used, 1 / sigma2, 0)).ravel()
    values = np.where(used, values, 0).ravel()
    weight = np.bincount(np.tile(np.arange(pixels), count), root**2)

    turns = np.zeros(count, int) if rotation is None else np.asarray(rotation, int) // 90
    measured, fraction = np.array(shifts, float), np.zeros(2, int)
    if shift_std is None and _differ_by_whole(measured) and np.any(measured[0] % 1):
        fraction = measured[0] % 1
        measured = np.rint(measured - fraction)
    given = np.ones(count) if flux is None or isinstance(flux, str) else np.asarray(flux, float)
    by_theta, open_ways = _flux_columns(flux, flux_std, time, measured, turns)
    by_zeta, shift_prior = _shift_columns(shift_std, count)
    flux_prior = np.eye(by_theta.shape[1]) if flux_std is not None else by_theta[:0]
    priors = _diagonal_blocks(flux_prior, shift_prior)
    grid = _Grid((rows, cols), measured, turns, by_zeta.size > 0 or bool(np.any(measured % 1)))

    sizes = [pixels, pixels if dark == "fit" else 0, grid.size, by_theta.shape[1], by_zeta.shape[1]]
    ends = np.cumsum(sizes)
    x = np.zeros(ends[-1])
    # An even beam, and M as its measurements then show it.
    bright = values[root > 0].mean()
    mean = (root**2 * values / given.repeat(pixels)).reshape(count, pixels).sum(axis=0)
    x[:pixels] = np.where(weight > 0, mean / np.where(weight > 0, weight, 1) / bright, 1)
    x[ends[1] : ends[2]] = bright

    history: list[float] = []
    for _ in range(steps):
        sensitivity, offset, beam, theta, zeta = np.split(x, ends[:-1])
        places = measured + (by_zeta @ zeta).reshape(count, 2)
        c = (given * np.exp(by_theta @ theta)).repeat(pixels)
        m = np.tile(sensitivity, count)
        see, down, along = grid.factors(places)
        on_pixels = np.tile(np.eye(pixels), (count, 1))
        model = c * (see @ beam) * m
        # The derivatives of c·L·M + O by M, O, a, θ and ζ.
        gradient = np.hstack(
            [
                (c * (see @ beam))[:, None] * on_pixels,
                on_pixels[:, : sizes[1]],
                (c * m)[:, None] * see,
                model[:, None] * by_theta.repeat(pixels, axis=0),
                (c * m * (down @ beam))[:, None] * by_zeta[0::2].repeat(pixels, axis=0)
                + (c * m * (along @ beam))[:, None] * by_zeta[1::2].repeat(pixels, axis=0),
            ]
        )
        residual = values - model - (np.tile(offset, count) if dark == "fit" else 0)
        weights = (root * c * m) ** 2 @ see
        # The beam has no scale of its own: what differs from its multiples is penalised.
        rough = grid.penalty(weights)
        relative = np.eye(grid.size) - np.outer(beam, weights * beam) / (weights @ beam**2)
        matrix = np.zeros((len(root) + len(rough) + len(priors), len(x)))
        matrix[: len(root)] = root[:, None] * gradient
        matrix[len(root) : len(root) + len(rough), ends[1] : ends[2]] = rough @ relative
        matrix[len(root) + len(rough) :, ends[2] :] = priors
        wanted = [root * residual, -rough @ beam, -priors @ x[ends[2] :]]
        history.append(sum(float(part @ part) for part in wanted))
        determined = np.any(matrix != 0, axis=0)
        change = np.linalg.lstsq(matrix[:, determined], np.concatenate(wanted), rcond=1e-12)[0]
        x[determined] += change
        # Of M alone: cells that hardly anything determines go on by rounding.
        if np.abs(change[: np.sum(determined[:pixels])]).max() < 1e-12 * np.abs(x[:pixels]).max():
            break

    sensitivity, offset, beam, theta, zeta = np.split(x, ends[:-1])
    places = measured + (by_zeta @ zeta).reshape(count, 2)
    logs = np.log(given) + by_theta @ theta
    sensitivity = found = np.where(weight > 0, sensitivity, np.nan)
    beam = grid.at_cells(beam, weights)
    if isinstance(flux, str):
        if open_ways.size:
            slope = open_ways.T @ (open_ways @ grid.slope(sensitivity))
            sensitivity = sensitivity * np.exp(-grid.unshifted @ slope)
            beam = beam * np.exp(grid.cells @ slope)
            logs = logs - places @ slope
        beam, logs = beam * np.exp(logs.mean()), logs - logs.mean()

    scale = np.nanmean(sensitivity)
    # Measurements and priors scatter by 1 in these units; so does the penalty, which leaves open
    # what it alone decides.
    response = np.zeros(matrix.T.shape)
    response[determined] = np.linalg.pinv(matrix[:, determined], rcond=1e-12)
    of_gain, of_dark, _, _, of_zeta = np.split(response, ends[:-1])
    if open_ways.size:
        # The gauge takes the slope out of a change of ln M.
        of_gain = of_gain * (sensitivity / found)[:, None]
        valid = sensitivity > 0
        slopes = grid.slope_of(valid, (of_gain.T / sensitivity)[:, valid].T)
        slopes = open_ways.T @ (open_ways @ slopes)
        of_gain = of_gain - sensitivity[:, None] * (grid.unshifted @ slopes)
    of_mean = np.outer(sensitivity / scale, of_gain[weight > 0].mean(axis=0))
    of_gain = (of_gain - of_mean) / scale
    dark_std, dark_along_std = np.zeros(pixels), 0.0
    if sizes[1]:
        dark_std = np.sqrt(np.sum(of_dark**2, axis=1))
        m = np.where(weight > 0, sensitivity / scale, 0)
        dark_along_std = float(np.linalg.norm(m @ of_dark) / np.sum(m**2))
    left = np.zeros((count, 2))
    if by_zeta.size:
        left = np.sum((by_zeta @ of_zeta) ** 2, axis=1).reshape(count, 2)
    return JointSolution(
        sensitivity=(sensitivity / scale).reshape(rows, cols),
        dark=(offset if sizes[1] else np.zeros(pixels)).reshape(rows, cols),
        beam=(beam * scale).reshape(grid.shape),
        beam_origin=tuple((grid.origin - fraction).tolist()),
        flux=np.exp(logs),
        shifts=places + fraction,
        objective=history,
        covariance=of_gain @ of_gain.T,
        dark_std=dark_std.reshape(rows, cols),
        dark_along_std=dark_along_std,
        shift_std=np.sqrt(left),
    )


def _differ_by_whole(shifts: Array) -> bool:
    """Whether shifts differ by whole pixels, but for rounding."""
    moves = shifts - shifts[0]
    return bool(np.all(np.abs(moves - np.rint(moves)) < ROUNDING))


def _flux_columns(
    flux: ArrayLike | str | None,
    flux_std: ArrayLike | None,
    time: ArrayLike | None,
    shifts: Array,
    turns: Array,
) -> tuple[Array, Array]:
    """T of ln c = ln c₀ + T·θ, and in which directions a tilt of ln M hides what T leaves out.

    M → M·exp(b·p), L → L·exp(−b·u) and ln c → ln c + b·d changes no measurement, unless exposures
    are turned against each other: then only a factor between L and c is undetermined.
    """
    count = len(shifts)
    if flux_std is not None:
        return np.diag(np.broadcast_to(np.asarray(flux_std, float), count)), np.empty((0, 2))
    constant = np.ones((count, 1))
    turned = bool(np.any(turns != turns[0]))
    hidden = constant if turned else np.hstack([constant, shifts])
    if isinstance(flux, str) and flux == "fit":
        left, sizes, _ = np.linalg.svd(hidden)
        open_ways = np.empty((0, 2)) if turned else np.eye(2)
        return left[:, np.sum(sizes > 1e-9 * sizes[0]) :], open_ways
    if isinstance(flux, str):
        times = np.asarray(time, float)
        distinct = times - hidden @ np.linalg.lstsq(hidden, times)[0]
        if np.linalg.norm(distinct) > 1e-9 * np.linalg.norm(times):
            return (times - times.mean())[:, None] / np.ptp(times), np.empty((0, 2))
        growth = np.linalg.lstsq(shifts - shifts.mean(axis=0), times)[0]
        return np.empty((count, 0)), (growth / np.linalg.norm(growth))[None]
    return np.empty((count, 0)), np.empty((0, 2))


def _shift_columns(shift_std: ArrayLike | None, count: int) -> tuple[Array, Array]:
    """Z of d = d₀ + Z·ζ, by exposure and axis, and the prior's (d − d₀)/s_d by ζ.

    To move all exposures alike moves but the beam: the mean of d − d₀, weighted by 1/s_d², is 0.
    """
    if shift_std is None:
        return np.empty((2 * count, 0)), np.empty((0, 0))
    std = np.asarray(shift_std, float)
    std = np.maximum(
        np.broadcast_to(std[:, None] if std.ndim == 1 else std, (count, 2)), EXACT_SHIFT
    )
    precision = std**-2 / np.sum(std**-2, axis=0)
    columns = np.zeros((count, 2, count, 2))
    for axis in (0, 1):
        centred = np.eye(count) - precision[:, axis]
        columns[:, axis, :, axis] = centred * std[:, axis]
    by_zeta = columns.reshape(2 * count, 2 * count)
    return by_zeta, by_zeta / std.reshape(-1, 1)


def _diagonal_blocks(first: Array, second: Array) -> Array:
    blocks = np.zeros(np.add(first.shape, second.shape))
    blocks[: len(first), : first.shape[1]] = first
    blocks[len(first) :, first.shape[1] :] = second
    return blocks


def _cubic(x: Array) -> tuple[Array, Array]:
    """B(x) and dB/dx, the cubic B-spline with knots at whole numbers and its slope."""
    t = np.abs(x)
    near, far = t < 1, (t >= 1) & (t < 2)
    value = np.where(near, 2 / 3 - t**2 + t**3 / 2, 0) + np.where(far, (2 - t) ** 3 / 6, 0)
    slope = np.where(near, 1.5 * t**2 - 2 * t, 0) - np.where(far, (2 - t) ** 2 / 2, 0)
    return value, slope * np.sign(x)


class _Grid:
    """The beam's cells, enough for fitted shifts to move by a pixel.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    shifts : ndarray, shape (n, 2)
        Shifts of the exposures.
    turns : ndarray of int, shape (n,)
        Quarter turns of the exposures.
    is_spline : bool
        Whether the beam is a spline, or a value in each cell.
    """

    def __init__(
        self, shape: tuple[int, int], shifts: Array, turns: Array, is_spline: bool
    ) -> None:
        windows = [np.indices(shape if turn % 2 == 0 else shape[::-1]) for turn in turns]
        turned = [np.rot90(w, turn, (1, 2)) for w, turn in zip(windows, turns, strict=True)]
        self._points = np.stack([points.reshape(2, -1).T for points in turned])
        self.unshifted = self._points[0]
        seen = self._points + shifts[:, None]
        low = np.minimum(np.floor(seen.min(axis=(0, 1))), 0).astype(int) - 3
        high = np.maximum(np.ceil(seen.max(axis=(0, 1))), np.subtract(shape, 1)).astype(int) + 3
        self.shape = tuple(int(size) for size in high - low + 1)
        self.size = self.shape[0] * self.shape[1]
        self.origin = (-int(low[0]), -int(low[1]))
        self.cells = np.indices(self.shape).reshape(2, -1).T + low
        self._is_spline = is_spline

    def factors(self, shifts: Array) -> tuple[Array, Array, Array]:
        """B(u − j) and its slopes along rows and columns: (measurements, cells) each."""
        u = (self._points + shifts[:, None]).reshape(-1, 2)
        return self._factors(u)

    def _factors(self, u: Array) -> tuple[Array, Array, Array]:
        rows, cols = (np.unique(self.cells[:, axis]) for axis in (0, 1))
        if not self._is_spline:
            see = np.all(u[:, None] == self.cells, axis=2).astype(float)
            return see, 0 * see, 0 * see
        (r, dr), (c, dc) = _cubic(u[:, :1] - rows), _cubic(u[:, 1:] - cols)
        pairs = ((r, c), (dr, c), (r, dc))
        see, down, along = (np.einsum("ui,uj->uij", *pair).reshape(len(u), -1) for pair in pairs)
        return see, down, along

    def penalty(self, weights: Array) -> Array:
        """√τ·G: fourth differences of five seen cells; τ by a cell's mean weight, by weight."""
        if not self._is_spline:
            return np.empty((0, self.size))
        index = np.arange(self.size).reshape(self.shape)
        lines = [
            index[i : i + 5, j] for i in range(self.shape[0] - 4) for j in range(self.shape[1])
        ]
        lines += [
            index[i, j : j + 5] for i in range(self.shape[0]) for j in range(self.shape[1] - 4)
        ]
        counted = [line for line in lines if np.all(weights[line] > 0)]
        rough = np.zeros((len(counted), self.size))
        for row, line in zip(rough, counted, strict=True):
            row[line] = FOURTH
        return np.asarray(np.sqrt(SMOOTHING * np.sum(weights**2) / np.sum(weights)) * rough)

    def at_cells(self, beam: Array, weights: Array) -> Array:
        """L at the cells; NaN where coefficients that it takes are not seen."""
        see = self._factors(self.cells.astype(float))[0]
        return np.where(see @ (weights <= 0) > 0, np.nan, see @ beam)

    def slope(self, sensitivity: Array) -> Array:
        """The least-squares slope of ln M along the rows and columns of the beam."""
        valid = sensitivity > 0
        return self.slope_of(valid, np.log(sensitivity[valid]))

    def slope_of(self, valid: Array, values: Array) -> Array:
        """The least-squares slope of values of valid pixels."""
        plane = np.column_stack([np.ones(valid.sum()), self.unshifted[valid]])
        return np.asarray(np.linalg.lstsq(plane, values)[0][1:])

"""What the data say of given fluxes: the drift of the lamp, and the tilt that it hides."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from equipix._check import Bools, Floats, ReadOnly
from equipix.fitting.error_bars import ErrorBars
from equipix.fitting.residuals import EXACT, FEWEST, Residuals, left_by, on_sensor, testable
from equipix.fitting.stated_errors import flux_variance
from equipix.fitting.weighted import Weighted
from equipix.measured.noise import ROBUST, chi2_tail
from equipix.plan.drift import (
    affine_columns,
    slope_covariance,
    slopes_by_fluxes,
    unit_times,
)

_WARNED = 1e-3
"""Probability of a scatter of fluxes without drift below which `calibrate` warns."""

_VISIBLE = 1e-6
"""Share of the variance of a trend below which what it leaves is rounding."""

_ALONE, _LIKELY = 2e-3, 0.05
"""One flux explains what fluxes leave if it leaves less than this share of the squares, or if noise
leaves more with this probability. The step is linear: one that was wrong by up to 30 % left 1.3e-3.
"""

_NAMED = 2
"""Most exposures that are named: the two of an arm of a cross leave the same residual."""

_LEAST = 1e-3
"""Share of the least variance of a flux below which an ε² is as good as 0."""

_POINTS, _ROUNDS = 41, 4
"""Points at which the likelihood is compared, and rounds, each between those beside the best."""

_BLOCK, _FAR = 16, 5.0
"""Columns of a block, and how many standard deviations off it is left out."""


@dataclass(frozen=True, eq=False)
class Drift(ReadOnly):
    """Drift of the lamp against the fluxes that were given.

    Attributes
    ----------
    size : float
        Standard deviation ε of ln c of an exposure about what was given, that of noise subtracted;
        0 where the fluxes scatter no more than noise lets them.
    flux_std : float
        Standard error of the flux of an exposure of mean weight, by noise and by shifts that were
        not refined.
    degrees_of_freedom : int
        Number of combinations of fluxes that leave a residual, n − 3 (n − 4 for a linear trend),
        less those that noisy exposures alone show: (tr Q)²/tr Q², rounded, with Q what the columns
        of errors without a residual leave of the identity, over the variances of fluxes. Errors of
        the tilt over its standard deviation are at most as far out as those of Student's t with so
        many: as t where the drift is above five standard errors, and between that and the normal
        law where it is smaller.
    probability : float
        That fluxes scatter so much without drift.
    slope_covariance : ndarray, shape (2, 2)
        Covariance of the slope of ln M, per pixel, that such a drift hides.
    tilt_std : ndarray, shape (2,)
        Standard deviation of the hidden tilt, edge to edge (row, col), of independent errors.
    trend_tilt : ndarray, shape (2,)
        Size of the hidden tilt, edge to edge, if the lamp drifted linearly in the order of the
        exposures and left this residual; 0 where the trend was fitted or leaves none.
    alone : tuple of (str, float)
        Exposures each of which, if its light was so many times what its flux says, makes the others
        agree with theirs. None where more than two do, or with one degree of freedom.
    """

    size: float
    flux_std: float
    degrees_of_freedom: int
    probability: float
    slope_covariance: Annotated[Floats, "float64", "2 2"]
    tilt_std: Annotated[Floats, "float64", "2"]
    trend_tilt: Annotated[Floats, "float64", "2"]
    alone: tuple[tuple[str, float], ...] = ()

    @property
    def is_added(self) -> bool:
        """Whether error bars contain it: without a threshold, below which they were too small."""
        return self.size > 0

    @property
    def is_certain(self) -> bool:
        """Whether the data contradict the fluxes: `calibrate` warns."""
        # Of like exposures the second is the first; a noisy one alone is no drift of the lamp.
        freedom = self.degrees_of_freedom
        of_size = chi2_tail(freedom * (1 + (self.size / self.flux_std) ** 2), freedom)
        return max(self.probability, of_size) < _WARNED

    @property
    def words(self) -> str:
        """What is wrong, the value, the limit and the remedy."""
        rows, cols = self.tilt_std
        return (
            f"the data contradict the fluxes: they differ from those given by {self.size:.1e}, rms "
            f"(standard error {self.flux_std:.1e}, {self.degrees_of_freedom} degrees of freedom)"
            f"{self._words_of_one}. First check the shifts: in a smooth beam wrong ones look the "
            "same. A drift of the lamp hides a tilt of the sensitivity, edge to edge, of probably "
            f"{rows:.1e} along rows and {cols:.1e} along columns{self._words_of_trend}: give "
            "fluxes of a monitor, or add an exposure turned by 90 or 180 degrees and use flux='fit'"
        )

    @property
    def _words_of_one(self) -> str:
        found = ", or ".join(f"{name} by {times - 1:+.2%}" for name, times in self.alone)
        return f", as if one exposure had other light than its flux says: {found}" if found else ""

    @property
    def _words_of_trend(self) -> str:
        rows, cols = self.trend_tilt
        if not np.any(self.trend_tilt > self.tilt_std):
            return ""
        return (
            f" ({rows:.1e} and {cols:.1e} if it is linear in the order of the exposures: then give "
            "'time' and flux='linear')"
        )

    def variance_of(self, weights: Floats, response: Floats) -> Floats:
        """Variance of Σ weights · ln M by the hidden tilt, for each of a stack (m, rows, cols)."""
        places = _places(response)
        along = np.einsum("mrc,arc->ma", weights, places)
        return np.asarray(np.einsum("ma,ab,mb->m", along, self.slope_covariance, along))

    def variance_map(self, response: Floats) -> Floats:
        """Variance of ln M in each pixel by the hidden tilt, in the gauge mean(M) = 1."""
        places = _places(response)
        return np.asarray(np.einsum("arc,ab,brc->rc", places, self.slope_covariance, places))


def _places(response: Floats) -> Floats:
    """Coordinates (2, rows, cols) from where a tilt leaves M as it is: its centre of gravity."""
    places = np.indices(response.shape, dtype=np.float64)
    known = np.isfinite(response)
    weights = np.where(known, response, 0)
    total = weights.sum()
    return np.asarray(places - (np.sum(places * weights, axis=(1, 2)) / total)[:, None, None])


def lamp_drift(weighted: Weighted, residuals: Residuals) -> Drift | None:
    """Estimate the drift of the lamp from the residuals of a fit with given fluxes.

    Parameters
    ----------
    weighted : Weighted
        Exposures and their fit.
    residuals : Residuals
        Their residuals, or those of a sample.

    Returns
    -------
    Drift or None
        None where the fluxes were fitted freely or with a prior, where exposures are turned against
        each other, with a fitted dark, where no combination of fluxes leaves a residual, and where
        the fit is too far from its minimum.

    Notes
    -----
    One linearised step with free fluxes. The slope of F gives b_k = Σ w m (y − m), m = c L M being
    the expected signal, and the step is v = b/S, S_k = Σ w m² t. The share t of a measurement that
    the beam does not take is (1 − ω/Σω)/(1 − ω/Ω), with Σω the weight of all exposures that see its
    cell and Ω that of all. Errors of ln c that are affine in the shifts leave no residual. What
    they leave of v, each exposure over its standard error, has a sum of squares that without drift
    follows χ² of as many degrees of freedom f as there are other combinations. ε² is what, added to
    all variances of v, makes what is left most likely (the first maximum of the restricted
    likelihood, Patterson and Thompson, Biometrika 58 (1971) 545): where these are all V it is
    |P v|²/f − V, with P the projector on those combinations, and a noisy exposure neither hides nor
    feigns a drift of the others. The variance of v is that of noise and that of shifts which have a
    prior and were not refined: the square of the mean slope of ln L times the variance of the
    shift. Sums are over blocks of pixels; one whose own flux is far from the median of its exposure
    is left out, so that dust looks like no drift.
    """
    exposures, fit = weighted.exposures, weighted.fit
    if exposures.offset or exposures.positions.are_turned:
        return None
    if exposures.flux.kind not in ("known", "linear"):
        return None
    if fit.degrees_of_freedom < FEWEST or not residuals.inexactness <= EXACT:
        return None
    shifts = on_sensor(exposures.positions)
    columns = affine_columns(shifts, exposures.flux.time)
    freedom = len(shifts) - columns.shape[1]
    if freedom < 1 or np.linalg.matrix_rank(columns) < columns.shape[1]:
        return None
    fluxes, variances = _free_fluxes(residuals, shifts, exposures.shape)
    if not np.isfinite([*variances, weighted.reduced_chi2]).all():
        return None
    weights = 1 / variances
    variances *= max(residuals.scale, weighted.reduced_chi2)
    variances += _solver_error(fit.error_estimate[-1], shifts, exposures.shape) ** 2
    variances += flux_variance(weighted, residuals)
    flux_std = float(1 / np.sqrt(np.mean(1 / variances)))
    size = _size(columns, fluxes, variances)
    covariance = slope_covariance(shifts, size, exposures.flux.time, weights)
    tilt = np.sqrt(np.diag(covariance)) * exposures.shape
    probability = chi2_tail(_scatter(columns, fluxes, variances), freedom)
    total = variances + size**2
    trend = np.zeros(2)
    if exposures.flux.time is None:
        trend = np.abs(_slope_of_trend(columns, fluxes, total, weights)) * exposures.shape
    known = _combinations(columns, total)
    names = [exposures.name_of(k) for k in range(len(exposures))]
    alone = _alone(names, columns, fluxes, variances) if known > 1 else ()
    return Drift(size, flux_std, known, probability, covariance, tilt, trend, alone)


def _scatter(columns: Floats, fluxes: Floats, variances: Floats) -> float:
    """Sum of squares over their variances of what columns leave of fluxes."""
    roots = np.sqrt(variances)
    left = left_by(columns / roots[:, None], fluxes / roots)[0]
    return float(left @ left)


def _alone(
    names: Sequence[str], columns: Floats, fluxes: Floats, variances: Floats
) -> tuple[tuple[str, float], ...]:
    """Exposures each of whose flux explains what columns leave, and the factor on it."""
    roots = np.sqrt(variances)
    seen, _ = left_by(columns / roots[:, None], np.diag(1 / roots))
    squares = np.sum(seen**2, axis=0)
    known = squares > _VISIBLE / variances
    sizes = np.divide(seen.T @ (fluxes / roots), squares, where=known, out=np.zeros(len(roots)))
    of_all, freedom = _scatter(columns, fluxes, variances), len(roots) - columns.shape[1]
    left = of_all - sizes**2 * squares
    found = [
        (name, float(np.exp(size)))
        for name, size, each in zip(names, sizes, left, strict=True)
        if each < _ALONE * of_all or chi2_tail(float(each), freedom - 1) > _LIKELY
    ]
    return tuple(found) if len(found) <= _NAMED else ()


def _combinations(columns: Floats, variances: Floats) -> int:
    """Combinations of fluxes that show how they scatter, all of one variance counting as f."""
    roots = np.sqrt(variances)
    axes = np.linalg.qr(columns / roots[:, None])[0]
    left = (np.eye(len(roots)) - axes @ axes.T) / (roots[:, None] * roots)
    return max(1, round(float(np.trace(left) ** 2 / np.sum(left**2))))


def _size(columns: Floats, fluxes: Floats, variances: Floats) -> float:
    """The ε of the first maximum of the restricted likelihood; 0 if noise is enough."""

    def unlikely(square: float) -> float:
        total = variances + square
        # Not the determinant of a product: noisy exposures may have next to no weight.
        corner = np.linalg.qr(columns / np.sqrt(total)[:, None], mode="r")
        information = 2 * np.sum(np.log(np.abs(np.diag(corner))))
        return float(np.sum(np.log(total)) + information + _scatter(columns, fluxes, total))

    # Beyond the whole sum of squares the likelihood falls.
    largest = _scatter(columns, fluxes, np.ones(len(fluxes)))
    least = _LEAST * float(variances.min())
    if largest <= least:
        return 0.0
    squares = np.concatenate([[0.0], np.geomspace(least, largest, _POINTS)])
    for _ in range(_ROUNDS):
        # The first minimum: one noisy exposure that is wrong makes another, of a drift of all.
        rises = np.diff([unlikely(square) for square in squares]) > 0
        best = int(np.argmax(rises)) if rises.any() else len(rises)
        found = float(squares[best])
        around = squares[max(best - 1, 0)], squares[min(best + 1, len(squares) - 1)]
        squares = np.linspace(*around, _POINTS)
    return found**0.5 if found > least else 0.0


def with_hidden_tilt(bars: ErrorBars, drift: Drift, response: Floats) -> ErrorBars:
    """Add the tilt that a drift of the lamp hides, where the data show a drift."""
    if not drift.is_added:
        return bars
    hidden = response * np.sqrt(drift.variance_map(response))
    std = np.hypot(bars.sensitivity, hidden).astype(bars.sensitivity.dtype)
    return bars._replace(sensitivity=std, tilt=np.hypot(bars.tilt, drift.tilt_std))


def _free_fluxes(
    residuals: Residuals, shifts: Floats, shape: tuple[int, int]
) -> tuple[Floats, Floats]:
    """Errors of ln c as given, and their variances where a value of weight 1 has variance 1."""
    known = np.isfinite(residuals.values)
    signal = np.where(known, residuals.signal, 0)
    weights = np.sum(signal**2, axis=(1, 2, 3)) / np.maximum(known.sum(axis=(1, 2, 3)), 1)
    if not weights.all():
        return np.zeros(len(shifts)), np.full(len(shifts), np.inf)
    share = testable(residuals.rows, shifts, shape, weights)
    places = np.arange(0, shape[1], _BLOCK)
    strengths, slopes = (
        np.add.reduceat(each.sum(axis=2), places, axis=2)
        for each in (signal**2 * share, np.where(known, residuals.values, 0) * signal)
    )
    agree = _agreeing(strengths, slopes)
    strength, slope = (np.sum(each, axis=(1, 2), where=agree) for each in (strengths, slopes))
    none = np.full(len(shifts), np.inf)
    variances = np.divide(1.0, strength, where=strength > 0, out=none)
    return np.asarray(np.divide(slope, strength, where=strength > 0, out=0 * slope)), variances


def _agreeing(strengths: Floats, slopes: Floats) -> Bools:
    """Blocks whose flux is near the median of their exposure: dust and reflections are no drift."""
    known = strengths > 0
    fluxes = np.divide(slopes, strengths, where=known, out=np.zeros_like(slopes))
    centres = [
        np.median(each[use]) if use.any() else 0 for each, use in zip(fluxes, known, strict=True)
    ]
    distances = np.abs(fluxes - np.reshape(centres, (-1, 1, 1))) * np.sqrt(np.maximum(strengths, 0))
    scale = ROBUST * np.median(distances[known]) if known.any() else 0.0
    return np.asarray(known & (distances <= _FAR * scale))


def _slope_of_trend(columns: Floats, fluxes: Floats, variances: Floats, weights: Floats) -> Floats:
    """Slope of ln M (row, col) that a trend in the order of exposures hides if it leaves these."""
    roots = np.sqrt(variances)
    order = unit_times(np.arange(len(columns)))
    visible, rest = (left_by(columns / roots[:, None], each / roots)[0] for each in (order, fluxes))
    if not visible @ visible > _VISIBLE * np.sum((order / roots) ** 2):
        return np.zeros(2)
    hidden = slopes_by_fluxes(columns, weights) @ order
    return np.asarray(hidden * (visible @ rest) / (visible @ visible))


def _solver_error(error: float, shifts: Floats, shape: tuple[int, int]) -> float:
    """Flux that an error of M of the sensor's own size leaves: its second difference."""
    reach = np.ptp(shifts, axis=0) / np.maximum(shape, 1)
    return float(error * np.sum((np.pi * reach) ** 2) / 2)

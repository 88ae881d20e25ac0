"""Whether residuals are those of a right model, and what the likely cause is if not."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from equipix._check import Array, Bools, Floats
from equipix._native import Fit
from equipix.diagnosis import causes
from equipix.exposures.exposures import Exposures, FitOptions
from equipix.findings import usable
from equipix.fitting.residuals import (
    EXACT,
    FEWEST,
    Correlation,
    Residuals,
    lag_one,
    on_sensor,
    testable,
    tested,
)
from equipix.fitting.stated_errors import without_shift_errors
from equipix.fitting.weighted import Weighted
from equipix.fitting.windows import (
    OfNoise,
    misplaced,
    of_noise,
    simulated_chi2,
    squares,
    standing_out,
)

_SIGMAS = 5.0
"""Standard errors that noise does not reach."""

_LEAST = 0.03
"""Deviation of reduced χ² from 1 that does no harm: error bars are wrong by half of it."""

_CORRELATED = 0.01
"""Correlation of neighbouring residuals that does no harm: a misfit of a tenth of the noise."""

_MOST = 0.5
"""Share of an excess from which a cause is the likely one."""

_NO_NOISE = 100.0
"""Factor on all variances that is no mistake in noise, which is known to some factor."""

_ENOUGH = 0.9
"""Share of what more unknowns explain from which fewer are the cause."""

_ABOVE = 3.0
"""Steps of a beam from cell to cell, in noise of a measurement, from which they are its own."""

_FLAGGED = 0.1
"""Share of degrees of freedom up to which those of flagged pixels are left out."""

_FINE = 6.0
"""Shortest period, in pixels, that a spline through cells holds."""


@dataclass(frozen=True)
class Misfit:
    """What residuals show.

    Attributes
    ----------
    chi2 : float
        Reduced χ²; NaN without variances.
    limit : float or None
        How far from 1 noise brings it; None where it is not beyond.
    correlation : Correlation
        That of neighbouring residuals, along the axis where it is the larger.
    cause : str
        Likely cause: "flux", "shifts", "illumination", "order", "rows", "columns", "exposure",
        "region", "signal", "structure", "noise" or "unknown".
    remedy : str
        The cause in words, and what to do.
    """

    chi2: float
    limit: float | None
    correlation: Correlation
    cause: str
    remedy: str

    @property
    def excess(self) -> float:
        """Factor on variances of M where the beam is finer than its spline; else 1.

        What the spline leaves is a noise of its own to M, whose pixels average over exposures at
        different fractions of a pixel. Other misfits are no noise, and their size in M is unknown.
        """
        return max(1.0, self.chi2) if self.cause == "structure" and self.chi2 > 0 else 1.0

    @property
    def words(self) -> str:
        """What is wrong, the value, the limit and the remedy."""
        if self.limit is not None:
            return (
                f"the residuals are {self.chi2**0.5:.3g} times as large as the variances predict "
                f"(reduced chi-square {self.chi2:.3g}, expected 1 ± {self.limit:.2g}): "
                f"{self.remedy}"
            )
        if not abs(self.correlation.z) > _SIGMAS:
            return self.remedy
        return (
            f"residuals of neighbouring pixels are correlated by {self.correlation.size:.1%}, "
            f"{abs(self.correlation.z):.0f} standard errors (limit {_SIGMAS:g}): {self.remedy}"
        )


def misfit(
    weighted: Weighted, flags: Array, residuals: Residuals, options: FitOptions
) -> Misfit | None:
    """Test the residuals of a fit; None where nothing speaks against it.

    Notes
    -----
    Two questions. Where variances are known, reduced χ² of the pixels that are not flagged must be
    within five standard errors of 1, or within 3 %; where it is not, and the degrees of freedom
    leave a doubt, these are those of simulated noise. And residuals of neighbouring pixels must not
    be correlated by more than five standard errors and 1 %, which requires no variances. A fit that
    has not come to its minimum, or data without noise, answer neither: of the first it is asked
    only whether an exposure is flipped.
    """
    inexactness, simulation = residuals.inexactness, cache(partial(of_noise, weighted, options))
    if weighted.fit.degrees_of_freedom < FEWEST:
        return None
    if not inexactness < 1:
        failed = weighted.fit.ended != "converged"
        words = misplaced(weighted.exposures, (), None, options) if failed else None
        nothing = Correlation(0.0, 0.0, 0.0)
        return None if words is None else Misfit(float("nan"), None, nothing, "order", words)
    left = without_shift_errors(weighted, residuals)
    unexplained = float(np.nansum(left.values**2) / np.nansum(residuals.values**2))
    residuals, chi2, std = left, float("nan"), float("nan")
    if weighted.exposures.knows_noise:
        chi2, std = unexplained * weighted.reduced_chi2, weighted.chi2_std
    high, low = _beyond(chi2, std, inexactness)
    if high or low:
        chi2 *= _share_of_good(weighted, flags, options)
        high, low = _beyond(chi2, std, inexactness)
    low = low and _is_low(chi2, std, weighted.exposures, residuals)
    # F over all measurements needs no degrees of freedom: their number is at most that.
    surely = high and chi2 * residuals.share > 1 + _limit(std)
    is_open = (high or low) and not surely and not _is_counted(weighted.fit)
    if is_open and (noise := simulation()) is not None:
        simulated = simulated_chi2(weighted, noise, options)
        chi2, std = unexplained * simulated.value, simulated.std
        high, low = _beyond(chi2, std, inexactness)
        low = low and _is_low(chi2, std, weighted.exposures, residuals)
    limit = _limit(std) if high or low else None
    largest = _neighbours(weighted, residuals, simulation)
    correlated = _is_correlated(largest) and inexactness <= EXACT
    if not correlated:
        # The pattern of one exposure that is flipped is white, and needs no variance to be seen.
        worst = standing_out(_flat(residuals.values))
        words = None if worst is None else misplaced(weighted.exposures, (), worst, options)
        if words is not None:
            return Misfit(chi2, limit, largest, "order", words)
    if limit is None and not correlated:
        return None
    found = _common(weighted, residuals, largest, options) if correlated else None
    cause = found or _cause(weighted, residuals, correlated=bool(correlated), low=low)
    return Misfit(chi2, limit, largest, *cause)


def _neighbours(
    weighted: Weighted, residuals: Residuals, simulation: Callable[[], OfNoise | None]
) -> Correlation:
    """Correlation of neighbours along the axis where it is the larger, less that of noise.

    A spline follows slow waves of noise better than fast ones, most at the edges, where few
    exposures see it: the residuals that it leaves are correlated negatively. A window of simulated
    noise has a larger share of edges than the whole sensor, so its correlation is the larger.
    """
    both = lag_one(residuals.values, residuals.share)
    largest = max(both, key=lambda each: abs(each.z))
    if weighted.fit.beam.coefficients is None or largest.z > 0 or not _is_correlated(largest):
        return largest
    if (noise := simulation()) is None:
        return largest
    simulated = lag_one(noise.residuals.values, noise.residuals.share)
    pairs = zip(both, simulated, strict=True)
    return max((_less(*pair) for pair in pairs), key=lambda each: abs(each.z))


def _less(found: Correlation, simulated: Correlation) -> Correlation:
    """A correlation, less the part that it has in common with that of noise."""
    share = min(max(simulated.size / found.size, 0.0), 1.0) if found.size else 0.0
    return Correlation(*((1 - share) * each for each in found))


def _is_correlated(neighbours: Correlation) -> bool:
    return abs(neighbours.z) > _SIGMAS and abs(neighbours.size) > _CORRELATED


def _limit(std: float) -> float:
    return max(_LEAST, _SIGMAS * std)


def _share_of_good(weighted: Weighted, flags: Array, options: FitOptions) -> float:
    """Reduced χ² without pixels that are flagged, which may follow no model, over that with all."""
    exposures, fit = weighted.exposures, weighted.fit
    flagged = tested(fit) & ~usable(flags)
    times = sum((exposures.used(fit, k) & flagged).astype(np.intp) for k in range(len(exposures)))
    freedom = float(np.maximum(np.subtract(times, 1), 0).sum())
    # Of many side by side the cells that only they see would be unknowns less, too.
    if not 0 < freedom < _FLAGGED * weighted.expected_misfit:
        return 1.0
    left = fit.misfit - squares(exposures, fit, flagged, options)
    return left / fit.misfit / (1 - freedom / weighted.expected_misfit)


def _is_counted(fit: Fit) -> bool:
    """Whether degrees of freedom are only counted: neither penalty nor prior holds numbers."""
    return fit.beam.coefficients is None and (fit.prior is None or not fit.prior.any())


def _beyond(chi2: float, std: float, inexactness: float) -> tuple[bool, bool]:
    """Whether χ² is above what noise reaches, and below."""
    return chi2 * (1 - inexactness**2) > 1 + _limit(std), chi2 < 1 - _limit(std)


def _is_low(chi2: float, std: float, exposures: Exposures, residuals: Residuals) -> bool:
    """Whether χ² is below what noise reaches without the rounding that frames do not average out.

    Where the beam moves a pixel by less than a step between exposures, all of them round alike: M
    follows that, and the residuals are without it.
    """
    response = np.broadcast_to(exposures.response, exposures.shape)[residuals.rows]
    shares = []
    for k, model in enumerate(exposures.noise):
        values = exposures.values[k, residuals.rows] * response
        signal = np.maximum(values[np.isfinite(values)], 0)
        shares.append(np.mean(model.rounding(signal) / model.variance(signal)))
    return chi2 < 1 - _limit(std) - (float(np.mean(shares)) if shares else 0.0)


def _cause(
    weighted: Weighted, residuals: Residuals, *, correlated: bool, low: bool
) -> tuple[str, str]:
    """The likely cause and its remedy, where neighbours show none that they have in common."""
    values, signal = (_flat(each) for each in (residuals.values, residuals.signal))
    if low:
        return "noise", (
            "the variances are too large, so error bars are too. Are they those of one frame, not "
            "of the mean, is the noise of the dark counted in every exposure, or were the frames "
            "smoothed or clipped?"
        )
    noise = residuals.share * residuals.scale
    expected = noise * np.count_nonzero(np.isfinite(values))
    excess = float(np.nansum(values**2)) - expected
    inside = np.where(_flat(_seen_by_all(weighted, residuals)), values, np.nan)
    if weighted.exposures.knows_noise and causes.by_signal(inside, signal) > _MOST:
        return "signal", (
            "they grow with the signal: give 'variance' as a NoiseModel with photon noise, and see "
            "whether the response is linear"
        )
    found = _local(weighted.exposures, values, residuals, noise, excess)
    if found is not None:
        return found
    if not correlated and excess > _NO_NOISE * expected:
        return "unknown", (
            "noise is not so far from what was stated. Check the shifts, for a factor as of "
            "binning or the pixel pitch, and that variances are in the units of the values, squared"
        )
    if not correlated:
        return "noise", (
            "they are white, so the variances are too small. Multiply them by reduced chi-square"
        )
    return "unknown", (
        "no single cause was found. Check the shifts and their orientation, reflections, and an "
        "illumination that changes; if there is dust use robust=True"
    )


def _common(
    weighted: Weighted, residuals: Residuals, largest: Correlation, options: FitOptions
) -> tuple[str, str] | None:
    """A cause of correlated residuals: fluxes, shifts, rows, columns, one place, fine structure."""
    values, signal = (_flat(each) for each in (residuals.values, residuals.signal))
    excess = abs(largest.product) * np.count_nonzero(np.isfinite(values))
    noise = max(float(np.nanmean(values**2)) - abs(largest.product), 0.0)
    found = _of_exposures(weighted, residuals, largest)
    if found is not None and found[0] == "flux":
        return found
    light, response = (_flat(each) for each in (residuals.light, residuals.response))
    pairs = causes.maybe_exchanged(values, light, response)
    worst = standing_out(values)
    if pairs or worst is not None:
        words = misplaced(weighted.exposures, pairs, worst, options)
        if words is not None:
            return "order", words
    slopes = np.stack([_flat(each) for each in residuals.slopes])
    by_exposures = causes.by_illumination(values, signal, slopes, noise).explained
    lines = [causes.by_lines(values, axis, noise).explained for axis in (1, 2)]
    # A spline's finest pattern follows what moves, or rows that flicker; what is itself finer
    # leaves residuals that no few numbers for each exposure explain.
    few = max(by_exposures if found is not None else 0.0, *lines)
    is_explained = few > _MOST * float(np.nansum(values**2))
    if not is_explained and _is_fine(weighted, residuals):
        return "structure", (
            "the beam is finer than a spline of one knot a pixel can follow (periods below some "
            f"{_FINE:g} pixels): move by whole pixels, or defocus the beam"
        )
    if found is not None:
        return found
    remaining = causes.by_patterns(values, [signal, *slopes], noise).remaining
    for axis, name in ((2, "rows"), (1, "columns")):
        parts = [causes.by_lines(each, axis, noise).explained for each in (values, remaining)]
        if max(parts) > _MOST * excess:
            return name, (
                f"they are common to the pixels of {name}, as noise of the read-out is: subtract "
                "it with reference pixels. Error bars do not contain it"
            )
    return _local(weighted.exposures, values, residuals, noise, excess)


def _of_exposures(
    weighted: Weighted, residuals: Residuals, largest: Correlation
) -> tuple[str, str] | None:
    """A cause with few numbers for each exposure: its flux, its shift, the shape of its beam.

    That with the fewest counts, if it explains nine tenths of what all explain. Measurements in
    cells that all exposures see are compared: of others the beam takes more.
    """
    inside = np.where(_seen_by_all(weighted, residuals), residuals.values, np.nan)
    common = max(lag_one(inside, residuals.share), key=lambda each: abs(each.product))
    if not common.product:
        inside, common = residuals.values, largest
    values, signal = _flat(inside), _flat(residuals.signal)
    slopes = np.stack([_flat(each) for each in residuals.slopes])
    excess = abs(common.product) * np.count_nonzero(np.isfinite(values))
    noise = max(float(np.nanmean(values**2)) - abs(common.product), 0.0)
    illumination = causes.by_illumination(values, signal, slopes, noise).explained
    lines = [causes.by_lines(values, axis, noise).explained for axis in (1, 2)]
    limit = max(_MOST * excess, _ENOUGH * max(illumination, *lines))
    if causes.by_patterns(values, [signal], noise).explained > limit:
        factors = causes.coefficients(values, [signal])[:, 0]
        worst = int(np.abs(factors).argmax())
        # The sensitivity takes 1/n of what an error of a flux leaves.
        error = factors[worst] / (1 - 1 / len(factors))
        return "flux", (
            "exposures differ by a factor that no tilt explains, most "
            f"{weighted.exposures.name_of(worst)}, by some {error:+.0%}: use flux='fit' "
            "or 'flux_std'"
        )
    moves = [signal, *slopes]
    if causes.by_patterns(values, moves, noise).explained > limit:
        stated = weighted.exposures.positions.std is not None
        return "shifts", (
            "they are proportional to the slope of the beam: check the shifts"
            f"{_scale_words(weighted, causes.coefficients(values, moves)[:, 1:])}"
            f"{', which are wrong by more than their' if stated else ', or give'} 'shift_std'"
        )
    if illumination > limit:
        return "illumination", (
            "the illumination changes its shape between exposures: keep lamp, optics and stray "
            "light still, and take the exposures faster. Exposures in another order, flipped, "
            "turned or at other shifts than given look the same: check these first"
        )
    return None


def _local(
    exposures: Exposures, values: Floats, residuals: Residuals, noise: float, excess: float
) -> tuple[str, str] | None:
    """A cause in one exposure or in one region."""
    explained, (row, col) = causes.by_region(values, noise)
    if explained > _MOST * excess:
        at = f"({residuals.rows.ravel()[min(row, residuals.rows.size - 1)]}, {col})"
        return "region", (
            f"they are largest in a region, around pixel {at}: look for dust or a reflection, "
            "mask it or use robust=True"
        )
    explained, worst = causes.by_exposure(values, noise)
    # Sensitivity and beam each take 1/n of what is wrong with one exposure.
    if explained > _MOST * (1 - 1 / len(values)) ** 2 * excess:
        return "exposure", (
            f"{exposures.name_of(worst)} has the most: check it, leave it out or use robust=True"
        )
    return None


def _scale_words(weighted: Weighted, found: Floats) -> str:
    """By how much the shifts seem too large along each axis, where one factor explains errors."""
    positions = weighted.exposures.positions
    if positions.rotation.any():
        return ""
    away = positions.shifts - positions.shifts.mean(axis=0)
    errors = found - found.mean(axis=0)
    left = 1 - 1 / len(positions)
    words = []
    for name, d, e in zip(("rows", "columns"), away.T, errors.T, strict=True):
        length = float(d @ d)
        factor = float(d @ e) / length if length > 0 else 0.0
        # One wrong shift, less the mean of all, explains so much of the squares.
        by_one = float(np.max(e**2)) / left
        by_scale = factor**2 * length
        if _ENOUGH * by_scale > max(_MOST * float(e @ e), by_one) and abs(factor) > 1e-3:
            # The sensitivity takes 1/n of what an error of a shift leaves.
            words.append(f"{-factor / left:+.1%} along {name}")
    return f" (their scale seems wrong by about {' and '.join(words)})" if words else ""


def _is_fine(weighted: Weighted, residuals: Residuals) -> bool:
    """Whether a beam between pixels has structure that is finer than a spline holds.

    A wave of period P and amplitude A has second differences of amplitude 4 A sin²(π/P), which for
    P < 6 are larger than A.
    """
    beam = weighted.fit.beam.values
    if weighted.fit.beam.coefficients is None or min(beam.shape) < 8:
        return False
    logarithm = np.log(beam, where=beam > 0, out=np.full(beam.shape, np.nan))
    differences = [np.diff(logarithm, 2, axis=axis) for axis in (0, 1)]
    fine = max(float(np.nanmean(each**2)) for each in differences)
    steps = max(float(np.nanmean(np.diff(logarithm, axis=axis) ** 2)) for axis in (0, 1))
    relative = np.nanmean(residuals.values**2) / np.nanmean(residuals.signal**2)
    # Second over first differences are 2 sin(π/P); in those of noise alone nothing is fine.
    return steps > _ABOVE**2 * float(relative) and fine > 4 * np.sin(np.pi / _FINE) ** 2 * steps


def _seen_by_all(weighted: Weighted, residuals: Residuals) -> Bools:
    """Measurements in cells that all exposures see: elsewhere the beam takes more of a residual."""
    positions, shape = weighted.exposures.positions, weighted.exposures.shape
    if positions.are_turned:
        return np.isfinite(residuals.values)
    return np.asarray(
        testable(residuals.rows, on_sensor(positions), shape, np.ones(len(positions))) > 1 - 1e-9
    )


def _flat(image: Array) -> Array:
    """Bands (n, bands, rows, cols) as one image of all their rows for each exposure."""
    return image.reshape(len(image), -1, image.shape[-1])

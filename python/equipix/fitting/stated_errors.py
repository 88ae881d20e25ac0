"""Stated variances, priors and shifts that the data contradict.

An error δ of a shift changes a measurement by δ·∇L, and so the flux of its exposure by δ times the
mean slope of ln L.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from equipix._check import Array, Floats
from equipix.exposures.exposures import Exposures
from equipix.exposures.positions import WIDEST
from equipix.fitting.residuals import Residuals, axes_of, left_by, sampled
from equipix.fitting.weighted import Options, Weighted, weighted_fit
from equipix.fitting.windows import misplaced
from equipix.measured.noise import NoiseModel, chi2_tail, photon_transfer
from equipix.plan.drift import undetermined_fluxes

_RARE = 1e-3
"""Probability of such deviations from a prior below which it is contradicted."""

_FACTOR = 1.5
"""Least factor by which a prior is widened: error bars scatter by as much with few exposures."""


class Contradiction(NamedTuple):
    """A prior that the data contradict.

    `name` is the keyword, `factor` the deviations in standard deviations, rms, `freedom` the
    number of combinations of the values that the data determine, and `worst` the two exposures with
    the largest deviations, the largest first; `remedy` says what to check.
    """

    name: str
    factor: float
    freedom: int
    worst: tuple[int, int]
    remedy: str = "check how they were measured, and that no exposure is flipped or exchanged"

    @property
    def words(self) -> str:
        """What is wrong, the value, the limit and the remedy."""
        what = {"flux_std": "fluxes", "shift_std": "shifts"}[self.name]
        return (
            f"the data contradict '{self.name}': the {what} found differ from those given by "
            f"{self.factor:.1f} of their standard deviations, rms ({self.freedom} degrees of "
            f"freedom, expected 1). It was multiplied by {self.factor:.1f}, and the fit repeated: "
            f"{self.remedy}"
        )


def widened(weighted: Weighted, options: Options) -> Weighted:
    """Repeat a fit with wider priors where the data contradict those given.

    Notes
    -----
    Deviations x of what was found from what was given, in standard deviations of the prior, are
    taken without what the data do not determine: a common factor of the fluxes, where no exposure
    is turned also what is affine in the shifts, and a displacement common to all shifts. Their sum
    of squares follows χ² of the remaining degrees of freedom f where the prior is right, and is
    less where the data hold little beside it. The factor is √(Σ x²/f). A flipped exposure, or two
    that are exchanged, are fitted with shifts far from those given: those furthest are tried.
    """
    if weighted.fit.ended != "converged":
        return weighted
    asked = (_of_fluxes(weighted), _of_shifts(weighted, options))
    found = [each for each in asked if each is not None]
    if not found:
        return weighted
    exposures = weighted.exposures
    for each in found:
        exposures = _wider(exposures, each)
    replaced = {**weighted.replaced, **{each.name: each.words for each in found}}
    return weighted.again(exposures, options.fit)._replace(replaced=replaced)


def _of_fluxes(weighted: Weighted) -> Contradiction | None:
    flux, positions = weighted.exposures.flux, weighted.exposures.positions
    if flux.kind != "prior" or flux.std is None:
        return None
    columns = undetermined_fluxes(positions, None)
    deviations = np.log(np.array(weighted.fit.flux) / flux.values)
    std = flux.std
    if positions.std is not None:
        # Shifts that were not refined leave a flux in a beam with a slope.
        std = np.sqrt(std**2 + flux_variance(weighted, sampled(weighted)))
    return _contradiction("flux_std", deviations[:, None], std[:, None], columns)


def _of_shifts(weighted: Weighted, options: Options) -> Contradiction | None:
    """Test shifts; say which exposure is flipped, or which two are exchanged, if that is why."""
    positions = weighted.exposures.positions
    if positions.std is None or weighted.fit.refinement != "refined":
        return None
    deviations = np.array(weighted.fit.shifts) - positions.shifts
    found = _contradiction("shift_std", deviations, positions.std, np.ones((len(positions), 1)))
    if found is None:
        return None
    words = misplaced(weighted.exposures, [found.worst], found.worst[0], options.fit)
    return found if words is None else found._replace(remedy=words)


def _contradiction(
    name: str, deviations: Floats, std: Floats, columns: Floats
) -> Contradiction | None:
    """Test deviations (n, axes), each axis without its part along the columns."""
    total, freedom = np.zeros(len(deviations)), 0
    for values, scale in zip(deviations.T, std.T, strict=True):
        known = scale > 0
        left, unknowns = left_by(columns[known] / scale[known, None], values[known] / scale[known])
        total[known] += left**2
        freedom += len(left) - unknowns
    if freedom < 1:
        return None
    factor = (float(total.sum()) / freedom) ** 0.5
    if chi2_tail(float(total.sum()), freedom) >= _RARE or factor < _FACTOR:
        return None
    first, second = np.argsort(-total)[:2].tolist()
    return Contradiction(name, factor, freedom, (first, second))


def _wider(exposures: Exposures, found: Contradiction) -> Exposures:
    """Exposures with one prior multiplied by its factor."""
    flux, positions = exposures.flux, exposures.positions
    if found.name == "flux_std" and flux.std is not None:
        flux = dataclasses.replace(flux, std=found.factor * flux.std)
    elif positions.std is not None:
        std = np.minimum(found.factor * positions.std, WIDEST)
        positions = dataclasses.replace(positions, std=std)
    return dataclasses.replace(exposures, flux=flux, positions=positions)


_MOST_FRAMES = 30
"""Frames from which the scatter of sample variances does little: error bars are off by 3 %."""

_FEWEST_PIXELS = 1000
"""Least number of pairs of neighbours in an exposure."""

_SLOPE = 0.5
"""Slope of squared residuals against variances, above which these are no sample variances."""

_LIKE = 0.1
"""Relative difference of the fourth moment from that of sample variances."""


def sampled_frames(variance: Array | None) -> float | None:
    """Number of frames whose sample variances these seem to be; None if they do not.

    Parameters
    ----------
    variance : ndarray, shape (n, rows, cols) or (n,), or None
        Variances of the values.

    Notes
    -----
    For v₁ and v₂ of two neighbours with the same expectation, each following χ² of N − 1 degrees of
    freedom, x = (v₁ − v₂)/(v₁ + v₂) has the mean square 1/N and the fourth moment 3/(N(N + 2)).
    What belongs to the pixels is common to the exposures: its mean square, from products of
    different exposures, is subtracted.
    """
    if variance is None or variance.ndim != 3:
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        pairs = np.diff(variance, axis=2) / (variance[:, :, 1:] + variance[:, :, :-1])
    pairs = pairs[:, np.isfinite(pairs).all(axis=0)]
    count = len(pairs)
    if count < 2 or pairs.shape[1] < _FEWEST_PIXELS:
        return None
    squares = np.square(pairs, dtype=np.float64)
    total = np.square(pairs.sum(axis=0, dtype=np.float64))
    common = float(np.mean(total - squares.sum(axis=0))) / (count * (count - 1))
    square = float(squares.mean()) - max(common, 0.0)
    if not square > 1 / _MOST_FRAMES:
        return None
    frames = 1 / square
    fourth = float(np.mean(squares**2)) * frames * (frames + 2) / 3
    return frames if abs(fourth - 1) < _LIKE else None


def steadied(weighted: Weighted, exposures: Exposures, options: Options) -> Weighted:
    """Fit with a noise model of each exposure if the variances given scatter like sample variances.

    `exposures` are those of the fit as they were given, without variances where a model has them.
    """
    is_given = exposures.knows_noise and not exposures.offset
    frames = sampled_frames(exposures.variance) if is_given else None
    variance = exposures.variance
    workers = options.fit.workers
    if frames is None or variance is None or _explains_residuals(weighted, variance, workers):
        return weighted
    usable, number, response = exposures.usable(), max(2, round(frames)), exposures.response
    period = (1, 1) if exposures.filters is None else exposures.filters.colours.period
    in_dn = (
        (y * response, v * response**2) for y, v in zip(exposures.values, variance, strict=True)
    )
    models = tuple(
        NoiseModel.fit(photon_transfer(signal, each, usable[k], number, period=period))
        for k, (signal, each) in enumerate(in_dn)
    )
    exposures = dataclasses.replace(exposures, variance=None, noise=models)
    steady = weighted_fit(exposures, options, weighted.fit.start())
    return steady._replace(replaced={"variance": words(frames)})


def _explains_residuals(weighted: Weighted, variance: Array, workers: int | None) -> bool:
    """Whether squared residuals r² follow the scatter of the variances v, as they do true ones.

    The slope of r² against v, from differences of neighbours, is near 1 for true variances, and
    near 0 for sample variances, whose scatter is independent of that of the mean.
    """
    exposures, fit = weighted.exposures, weighted.fit
    along = square = 0.0
    for k in range(len(exposures)):
        residual = exposures.residual(fit, k, workers)
        residual[~exposures.used(fit, k)] = np.nan
        of_residuals = np.diff(np.square(residual, dtype=np.float64), axis=1)
        of_variances = np.diff(variance[k].astype(np.float64), axis=1)
        known = np.isfinite(of_residuals) & np.isfinite(of_variances)
        along += float(np.sum(of_residuals[known] * of_variances[known]))
        square += float(np.sum(np.square(of_variances[known])))
    return along >= _SLOPE * square


def words(frames: float) -> str:
    """What is wrong, the value, the limit and the remedy."""
    return (
        f"'variance' scatters from pixel to pixel like sample variances of {frames:.1f} frames "
        f"(limit {_MOST_FRAMES}): as weights these bias the result and its error bars. They were "
        "replaced by a noise model fitted over all pixels of each exposure: give a NoiseModel, or "
        "FrameStatistics"
    )


_ON_A_LINE = 1e-9
"""Shifts refined along one direction moved less than this across it, relative to it."""

_UNEXPLAINED = 1e-3
"""Probability of errors so large below which their standard deviations do not explain them."""


class Unrefined(NamedTuple):
    """Directions in the beam along which shifts stayed as given.

    `slopes` (directions, n, bands, rows, cols) are M/σ · ∂(c L) along each, `std` (directions, n)
    the standard deviations of the shifts.
    """

    slopes: Floats
    std: Floats


def unrefined(weighted: Weighted, residuals: Residuals) -> Unrefined | None:
    """Find the slopes and standard deviations of shifts that the fit left as given.

    None where shifts count as exact, or were refined along both axes.
    """
    positions, fit = weighted.exposures.positions, weighted.fit
    if positions.std is None:
        return None
    directions = np.eye(2)
    if fit.refinement == "refined":
        _, lengths, directions = np.linalg.svd(np.array(fit.shifts) - positions.shifts)
        if not lengths[1] <= _ON_A_LINE * lengths[0]:
            return None
        directions = directions[1:]
    axes = [axes_of(turn).T for turn in positions.rotation.tolist()]
    slopes = np.einsum("da,nab,bnkrc->dnkrc", directions, axes, residuals.slopes)
    return Unrefined(slopes, np.sqrt(directions**2 @ np.square(positions.std).T))


def flux_variance(weighted: Weighted, residuals: Residuals) -> Floats:
    """Variance of ln c of each exposure by shifts that were not refined, shape (n,)."""
    found = unrefined(weighted, residuals)
    if found is None:
        return np.zeros(len(residuals.values))
    signal = np.where(np.isfinite(residuals.values), residuals.signal, 0)
    sums = np.einsum("dnkrc,nkrc->dn", np.where(signal == 0, 0, found.slopes), signal)
    power = np.einsum("nkrc,nkrc->n", signal, signal)
    means = np.divide(sums, power, where=power > 0, out=np.zeros_like(sums))
    return np.asarray(np.sum((means * found.std) ** 2, axis=0))


def without_shift_errors(weighted: Weighted, residuals: Residuals) -> Residuals:
    """Residuals without what the stated errors of unrefined shifts explain.

    The errors are those of least squares with their prior. Where they are larger than it allows,
    residuals are as they were.
    """
    found = unrefined(weighted, residuals)
    if found is None:
        return residuals
    values, total, freedom = residuals.values.copy(), 0.0, -len(found.std)
    for k, (each, std) in enumerate(zip(values, found.std.T, strict=True)):
        known, used = np.isfinite(each), std > 0
        slopes = found.slopes[used, k][:, known]
        errors, squares = _with_prior(slopes, each[known], std[used], residuals.scale)
        each[known] -= errors @ slopes
        total, freedom = total + squares, freedom + int(used.sum())
    if freedom < 1 or chi2_tail(total, freedom) < _UNEXPLAINED:
        return residuals
    return dataclasses.replace(residuals, values=values)


def _with_prior(slopes: Floats, values: Floats, std: Floats, scale: float) -> tuple[Floats, float]:
    """Errors of a shift, and their squares over those expected of prior and noise.

    With A = SᵀS/σ² and Λ = diag(1/std²) they are (A + Λ)⁻¹ Sᵀr/σ². The least-squares errors have
    the covariance A⁻¹ + Λ⁻¹, so that the squares are rᵀS (A + AΛ⁻¹A)⁻¹ Sᵀr/σ⁴.
    """
    normal = slopes @ slopes.T / scale
    product = slopes @ values / scale
    errors = np.linalg.solve(normal + np.diag(std**-2), product)
    spread = normal + normal @ np.diag(std**2) @ normal
    squares = product @ np.linalg.pinv(spread, hermitian=True) @ product
    return np.asarray(errors), float(squares)

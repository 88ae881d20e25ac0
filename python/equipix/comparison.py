"""How far several calibrations of one sensor agree, and how far they should."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from equipix._check import Array, ArrayLike, Bools, Floats, Ints, as_array, check_count
from equipix.calibration.result import Calibration
from equipix.errors import InputError
from equipix.findings import determined, usable
from equipix.measured.noise import BLOCK
from equipix.metrics.correctability import fisher_quantile, student_quantile
from equipix.metrics.maps import block_means, relative_error, rms, slope_pixels, tilt
from equipix.shown import Brief, Shown

_FALSE = 0.01
"""Probability that noise alone fails one of the checks of a pair, which have even shares of it."""

_EXACT = 1e-4
"""Least relative standard error of what is predicted."""

_LEAST = 1e-9
"""Least λ(q): that of a wave which no exposure determines."""

_MOST_BLOCKS = 16
"""Blocks whose uncertainty represents all: each takes about as long as a calibration."""


class Check(NamedTuple):
    """A difference, what uncertainties predict, and the ratios between which noise leaves both."""

    what: str
    found: float
    predicted: float
    low: float
    high: float

    @property
    def times(self) -> float:
        """Found over predicted."""
        return self.found / self.predicted

    @property
    def passed(self) -> bool:
        """Whether the ratio lies within its limits."""
        return self.low <= self.times <= self.high


@dataclass(frozen=True, eq=False)
class Comparison(Brief, Shown):
    """Agreement of several calibrations of one sensor: the result of `compare`.

    Attributes
    ----------
    sensitivities : ndarray, shape (n, rows, cols), float64
        The sensitivities in one gauge, mean 1 over the pixels that are good in all; NaN elsewhere.
    agreement : ndarray, shape (rows, cols), float64
        Standard deviation of the sensitivity over the calibrations, of one of them.
    pairs : ndarray, shape (pairs, 2), int64
        Which two calibrations, from 0, are compared.
    rms : ndarray, shape (pairs,), float64
        Root mean square over the pixels of the relative difference of two sensitivities.
    block_rms : ndarray, shape (pairs,), float64
        The same of means over blocks of 16×16 pixels: what is left at large scales.
    largest : ndarray, shape (pairs,), float64
        Largest absolute relative difference of a pixel.
    open_tilt : ndarray of bool, shape (pairs,)
        Whether free fluxes leave the tilt of one of the two undetermined: then the slope of ln of
        their ratio is no difference, and is left out of all figures.
    predicted_rms, predicted_block_rms : ndarray, shape (pairs,), float64, or None
        What the uncertainties of two independent calibrations predict for `rms` and `block_rms`,
        with the estimated errors of their solvers; NaN where it is not known. Both None where
        `predicted_rms` is known of no pair.
    checks : tuple of tuple of Check
        Of each pair what is judged: ``what``, ``found``, ``predicted``, and between which ratios
        ``low`` and ``high`` of both noise leaves it. Empty where nothing is predicted.
    verdicts : tuple of str
        Of each pair whether it agrees within the noise of both, by the rule of `compare`, or why it
        is not judged.
    """

    sensitivities: Array
    agreement: Array
    pairs: Ints
    rms: Array
    block_rms: Array
    largest: Array
    open_tilt: Bools
    predicted_rms: Array | None = None
    predicted_block_rms: Array | None = None
    checks: tuple[tuple[Check, ...], ...] = ()
    verdicts: tuple[str, ...] = ()

    def difference(self, pair: int) -> Array:
        """Relative difference of the sensitivities of a pair, (M₁ − M₂)/M₂, shape (rows, cols).

        Without its slope where `open_tilt` is true.
        """
        first, second = self.sensitivities[self.pairs[pair]]
        return _difference(first, second, bool(self.open_tilt[pair]))


def compare(
    calibrations: Sequence[Calibration], *, predicted: ArrayLike | None = None
) -> Comparison:
    """Compare calibrations of one sensor, from experiments independent of each other.

    Parameters
    ----------
    calibrations : sequence of Calibration
        Two or more, of sensors of one shape.
    predicted : array_like, shape (n, 2), optional
        Of each calibration the root mean square of its relative error that is expected in single
        pixels and in means over blocks of 16×16, as `equipix.simulate.noise_prediction` gives.
        Unless given it is computed from `sensitivity_std`; that of the blocks by
        `Calibration.std_of` of 16 of them, where neither was read from a file. A pair of which one
        has none above 0, or a solver that failed, is not judged.

    Returns
    -------
    Comparison
        Agreement map and, for each pair, how far the two are from each other.

    Raises
    ------
    InputError
        If there are fewer than two calibrations, of different shapes, without a common good
        pixel, or smaller than a block of 16×16 pixels; or if what is `predicted` is not finite
        and above 0.

    Notes
    -----
    Common errors of two calibrations, such as a wrong dark level, leave no difference. A shift
    error or lamp drift does: it differs between experiments and changes M at large scales, so it
    dominates the block means. A tilt that free fluxes leave undetermined is no difference, and is
    left out (`Comparison.open_tilt`).

    `Comparison.verdicts` judges each pair. Found over predicted must lie between limits that noise
    alone crosses in at most 1 % of the pairs; each check has an even share of it. The estimated
    errors of both solvers are part of what is predicted, in quadrature. Solvers may have left less:
    lower limits are those without these errors.

    - The rms over pixels, without the tilt. Its square over the predicted one follows Fisher's
      distribution. Errors of waves of M have variances 1/λ(q) (`equipix.plan.error_budget`), so
      the found one has (Σ 1/λ)²/Σ 1/λ² degrees of freedom, with the waves of the rectangle around
      the pixels that both know, times their share of it. Error bars with a relative standard
      error e (``metadata["uncertainty"]``) have 1/(2e²). Both calibrations are taken to have waves
      and draws in common, which widens the limits.
    - The tilt along rows and along columns, over `tilt_std` of both, by the normal distribution.
      Where a calibration knows pixels that the other one lacks, `tilt_std` rises as that of noise
      of single pixels would, which is at most too much.
      Where the drift of a lamp is part of `tilt_std`, by Student's t with its degrees of freedom.
    - The rms of block means, upwards, where it is predicted and no drift of a lamp is part of it.
      That of 16 blocks has 16 degrees of freedom; that of `predicted` counts as exact.

    References
    ----------
    .. [1] S. E. Stukachev, I. E. Kozhevatov, "Calibration method for spatial distribution of light
       sensitivity of matrix photo receivers", Radiophysics and Quantum Electronics, 2011, figure 5.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import calibrate, compare, cross_pattern, simulate
    >>> rng = np.random.default_rng(1)
    >>> truth = simulate.paper_sensitivity((48, 64), rng=rng)
    >>> beam = simulate.gaussian_beam(truth.shape)
    >>> calibrations = []
    >>> for arms in ((5, 7), (7, 11)):
    ...     shifts = cross_pattern(*arms)
    ...     frames = simulate.exposures(truth, beam, shifts)
    ...     calibrations.append(calibrate(frames + rng.normal(0, 1e-3, frames.shape), shifts))
    >>> result = compare(calibrations, predicted=[(5.5e-4, 5.3e-5), (5.7e-4, 5.6e-5)])
    >>> bool(0.9 < result.rms[0] / result.predicted_rms[0] < 1.1)
    True
    """
    several = isinstance(calibrations, list | tuple)
    if not several or not all(hasattr(each, "sensitivity") for each in calibrations):
        raise InputError("'calibrations' is not a list of results of calibrate")
    count = len(calibrations)
    if count < 2:
        raise InputError(f"'calibrations' has {count} entries, expected two or more")
    shapes = [calibration.shape for calibration in calibrations]
    if len(set(shapes)) > 1:
        raise InputError(f"'calibrations' are of sensors of shapes {shapes}, expected one shape")
    sensitivities = _in_one_gauge(calibrations)
    pairs = np.array(list(combinations(range(count), 2)))
    is_open = np.array([_leaves_tilt(each) for each in calibrations])
    open_tilt = is_open[pairs].any(axis=1)
    differences = [
        _difference(sensitivities[i], sensitivities[j], bool(left))
        for (i, j), left in zip(pairs, open_tilt, strict=True)
    ]
    compared = sensitivities
    if is_open.any():
        compared = np.stack([_levelled(each, sensitivities[0]) for each in sensitivities])
    given = None if predicted is None else _checked_prediction(predicted, count)
    reasons = [_not_judged(each, is_given=given is not None) for each in calibrations]
    expected = np.full((count, 2), np.nan)
    for k in (k for k, reason in enumerate(reasons) if not reason):
        expected[k] = _expected(calibrations[k]) if given is None else given[k]
    checks = tuple(
        ()
        if any(reasons[k] for k in pair)
        else _checks(
            [calibrations[k] for k in pair],
            sensitivities[pair],
            differences[number],
            np.square(expected[pair]),
            is_given=given is not None,
        )
        for number, pair in enumerate(pairs)
    )
    return Comparison(
        sensitivities=sensitivities,
        agreement=compared.std(axis=0, ddof=1),
        pairs=pairs,
        open_tilt=open_tilt,
        rms=np.array([rms(each) for each in differences]),
        block_rms=np.array([rms(block_means(each)) for each in differences]),
        largest=np.array([np.nanmax(np.abs(each)) for each in differences]),
        checks=checks,
        verdicts=tuple(
            _verdict(each, [reasons[k] for k in pair])
            for each, pair in zip(checks, pairs, strict=True)
        ),
        **_predictions(calibrations, expected, pairs),
    )


def _verdict(checks: tuple[Check, ...], reasons: Sequence[str] = ()) -> str:
    """Words on the checks of a pair, or on the reasons why there are none, of either."""
    if not checks:
        both = zip(reasons, ("the first", "the second"), strict=True)
        return f"not judged: {', '.join(reason.format(which) for reason, which in both if reason)}"
    for words, failed in (
        ("differ by more than their noise", [c for c in checks if c.times > c.high]),
        ("agree better than their noise", [c for c in checks if not c.passed]),
    ):
        if failed:
            ratios = (
                f"{c.what} {c.times:.3g} times as predicted (limits {c.low:.3g} to {c.high:.3g})"
                for c in failed
            )
            return f"{words}: {', '.join(ratios)}"
    return "agree within their noise"


def _checks(
    pair: Sequence[Calibration], maps: Array, difference: Array, variances: Array, *, is_given: bool
) -> tuple[Check, ...]:
    """Judge a pair by the rule of `compare`.

    `variances` are those expected of each in pixels and in block means; `is_given` where the caller
    predicted them.
    """
    drifts = [c.drift.degrees_of_freedom for c in pair if c.drift is not None and c.drift.is_added]
    tilts = np.square([np.zeros(2) if c.tilt_std is None else c.tilt_std for c in pair])
    pixels = difference if is_given else _difference(maps[0], maps[1], True)
    count = [slope_pixels(each.sensitivity, each.flags) for each in pair]
    both = np.isfinite(pixels) & count[0] & count[1]
    slopes = np.abs(tilt(maps[0] / maps[1], both))
    with np.errstate(divide="ignore", invalid="ignore"):
        # As noise of single pixels tilts fewer of them: that of slow waves rises by less.
        tilts *= np.maximum([_levers(each) / _levers(both) for each in count], 1)
    judged = np.flatnonzero((np.isfinite(tilts) & (tilts > 0)).all(axis=0) & np.isfinite(slopes))
    means = block_means(difference)
    blocks = bool(np.isfinite(variances[:, 1]).all() and np.isfinite(means).any()) and not drifts
    tail = _FALSE / (1 + len(judged) + blocks)
    evenness, exactness, predicted = 1.0, _EXACT, variances[:, 0]
    if not is_given:
        predicted, exactness, evenness = _of_bars(pair, np.isfinite(pixels))
    found = evenness * _freedom(pair, predicted, np.isfinite(pixels), without_tilt=not is_given)
    low, high = (
        max(fisher_quantile(p, found, 0.5 / exactness**2), 0.0) ** 0.5  # 0 of very few pixels
        for p in (tail / 2, 1 - tail / 2)
    )
    what = "pixels, rms" if is_given else "pixels without tilt, rms"
    limits = [(what, rms(pixels), float(predicted.sum()), low, high)]
    high = student_quantile(1 - tail / 2, min(drifts, default=0))
    for axis in judged:
        name = f"tilt along {('rows', 'columns')[axis]}"
        limits.append((name, float(slopes[axis]), float(tilts[:, axis].sum()), 0.0, high))
    if blocks:
        found = _freedom(pair, variances[:, 1], np.isfinite(means), without_tilt=False, side=BLOCK)
        high = (
            fisher_quantile(1 - tail, found, 0.5 / _EXACT**2 if is_given else _MOST_BLOCKS) ** 0.5
        )
        limits.append(("16×16 means, rms", rms(means), float(variances[:, 1].sum()), 0.0, high))
    solver = sum(each.error_estimate**2 for each in pair)
    return tuple(
        # The estimate is no bound: solvers may as well have left nothing.
        Check(what, found, total**0.5, low * (variance / total) ** 0.5, high)
        for what, found, variance, low, high in limits
        for total in [variance + solver]
    )


def _of_bars(pair: Sequence[Calibration], known: Bools) -> tuple[Floats, float, float]:
    """Variances of both without their tilts, by their error bars over known pixels.

    Beside them the relative standard error of the root of their sum, and the share of pixels that
    would scatter as much if all had the same variance.
    """
    maps, variances, exactness = np.zeros(known.sum()), [], []
    # Mean square of a plane whose tilt is 1 from edge to edge: a twelfth where all are known.
    spread = np.var(np.nonzero(known), axis=1) / np.square(known.shape)
    for each in pair:
        std, drift = each.sensitivity_std, each.drift
        assert std is not None
        variance = np.square(std[known].astype(np.float64) / each.sensitivity[known])
        tilts = np.zeros(2) if each.tilt_std is None else np.square(each.tilt_std)
        if drift is not None and drift.is_added:
            variance -= drift.variance_map(each.sensitivity)[known]
            tilts = tilts - np.square(drift.tilt_std)
        maps += variance
        of_tilt = (spread * tilts)[np.isfinite(tilts)].sum()
        variances.append(max(variance.mean() - of_tilt, _EXACT * variance.mean()))
        exactness.append(each.metadata["uncertainty"]["relative_standard_error"])
    shares = np.array(variances)
    common = float(shares @ exactness / shares.sum())
    return shares, max(common, _EXACT), float(maps.mean() ** 2 / np.mean(maps**2))


def _levers(known: Bools) -> Floats:
    """Sum over pixels of their squared distances from the middle, along rows and columns."""
    sums = []
    for counts in (known.sum(axis=1), known.sum(axis=0)):
        places = np.arange(len(counts))
        middle = counts @ places / max(counts.sum(), 1)
        sums.append(counts @ np.square(places - middle))
    return np.array(sums)


def _freedom(
    pair: Sequence[Calibration],
    variances: Floats,
    known: Bools,
    *,
    without_tilt: bool,
    side: int = 1,
) -> float:
    """Degrees of freedom of the mean square of two errors, of pixels or of means over blocks.

    `known` are the pixels or the blocks that the mean is over.
    """
    # Tr (C₁ + C₂)² is largest where both have their waves in common.
    roots = [
        v / _waves(c, known, without_tilt, side) ** 0.5
        for c, v in zip(pair, variances, strict=True)
    ]
    return float(variances.sum() / sum(roots)) ** 2


def _waves(calibration: Calibration, known: Bools, without_tilt: bool, side: int) -> float:
    """Find (Σ 1/λ)²/Σ 1/λ² over waves of whole numbers of half periods along rows and columns.

    They are those of the rectangle around what is known, which has its share of them.
    """
    sizes = np.ptp(np.nonzero(known), axis=1) + 1
    count, sums = len(calibration.shifts), np.zeros(2)
    down, right = (
        np.exp(1j * np.pi * np.outer(np.arange(size) / (size * side), along))
        for size, along in zip(sizes, calibration.shifts.T, strict=True)
    )
    for number, row in enumerate(down):
        # cos · cos is two waves, of both signs along the columns.
        shared = (np.abs(right @ row) ** 2 + np.abs(right @ row.conj()) ** 2) / (2 * count)
        # The mean is no wave; the first ones are the tilt.
        errors = 1 / np.maximum(count - shared, _LEAST)[max(0, 1 + without_tilt - number) :]
        sums += errors.sum(), errors @ errors
    # Of one line or block no wave may be left.
    waves = sums[0] ** 2 / sums[1] if sums[1] else 0.0
    return max(float(waves * known.sum() / sizes.prod()), 1.0)


def _leaves_tilt(calibration: Calibration) -> bool:
    """Whether free fluxes leave the tilt of a calibration undetermined."""
    std = calibration.tilt_std
    if std is not None and not np.isfinite(std).all():
        return True
    return any(finding.kind == "tilt" for finding in calibration.findings)


def _difference(first: Array, second: Array, open_tilt: bool) -> Array:
    """Relative difference of two sensitivities, without its slope where a tilt is open."""
    return relative_error(_levelled(first, second) if open_tilt else first, second)


def _levelled(sensitivity: Array, like: Array) -> Array:
    """Sensitivity times the tilt that brings the slope of ln of the ratio to another to 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(sensitivity / like)
    valid = np.isfinite(ratio)
    places = np.indices(ratio.shape)[:, valid].T
    places = places - places.mean(axis=0)
    slope = np.linalg.lstsq(places, ratio[valid] - ratio[valid].mean())[0]
    levelled = sensitivity.copy()
    levelled[valid] *= np.exp(-places @ slope)
    return np.asarray(levelled * (np.nanmean(like) / np.nanmean(levelled)))


def _in_one_gauge(calibrations: Sequence[Calibration]) -> Array:
    """Sensitivities of mean 1 over the pixels that are good in all, NaN elsewhere."""
    maps = np.stack([each.sensitivity.astype(np.float64) for each in calibrations])
    good = np.isfinite(maps).all(axis=0)
    for each in calibrations:
        good &= usable(each.flags)
    if not good.any():
        raise InputError("'calibrations' have no pixel that is good in all of them")
    maps[:, ~good] = np.nan
    return np.asarray(maps / np.nanmean(maps, axis=(1, 2), keepdims=True))


def _not_judged(calibration: Calibration, *, is_given: bool) -> str:
    """Why nothing is judged with a calibration; empty if nothing stands against it."""
    if not np.isfinite(calibration.error_estimate):
        return "the solver of {} failed"
    if is_given:
        return ""
    if calibration.sensitivity_std is None:
        return "{} has no standard deviations (calibrate with --uncertainty)"
    return "" if _of_pixels(calibration) > 0 else "all standard deviations of {} are 0"


def _of_pixels(calibration: Calibration) -> float:
    """Rms over usable pixels of the relative standard deviations that are known."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.asarray(calibration.sensitivity_std) / calibration.sensitivity
    return rms(relative[np.isfinite(relative) & usable(calibration.flags)])


def _expected(calibration: Calibration) -> tuple[float, float]:
    """Rms of the relative error in pixels and in block means; of these NaN if read from a file."""
    if calibration.weighted is None:
        return _of_pixels(calibration), np.nan
    blocks = rms(np.asarray(calibration.std_of(_some_blocks(calibration))))
    return _of_pixels(calibration), blocks


def _some_blocks(calibration: Calibration) -> Array:
    """Weights of the means over some blocks, each less the mean over all: shape (m, rows, cols)."""
    good = determined(calibration.sensitivity, calibration.flags)
    rows, cols = (size // BLOCK for size in calibration.shape)
    chosen = np.unique(np.linspace(0, rows * cols - 1, _MOST_BLOCKS).round().astype(int))
    weights = []
    for row, col in zip(*np.divmod(chosen, cols), strict=True):
        block = np.zeros(calibration.shape, bool)
        block[BLOCK * row : BLOCK * (row + 1), BLOCK * col : BLOCK * (col + 1)] = True
        block &= good
        if block.any():
            weights.append(block / block.sum() - good / good.sum())
    return np.array(weights)


def _checked_prediction(predicted: ArrayLike, count: int) -> Array:
    """Errors that a caller predicts in pixels and in blocks, checked."""
    errors = as_array("predicted", predicted, ndim=2).astype(np.float64)
    check_count("predicted", len(errors), count)
    if errors.shape[1] != 2:
        raise InputError(f"'predicted' has shape {errors.shape}, expected ({count}, 2)")
    if not (np.isfinite(errors) & (errors > 0)).all():
        raise InputError(f"'predicted' is {errors.tolist()}, expected finite numbers above 0")
    return errors


def _predictions(
    calibrations: Sequence[Calibration], expected: Array, pairs: Ints
) -> dict[str, Array]:
    """Errors of two calibrations and of their solvers in quadrature, in pixels and in blocks."""
    solver = np.array([each.error_estimate for each in calibrations])
    variances = expected**2 + solver[:, None] ** 2
    rms, block_rms = np.sqrt(variances[pairs].sum(axis=1)).T
    known = np.isfinite(rms).any()
    return {"predicted_rms": rms, "predicted_block_rms": block_rms} if known else {}

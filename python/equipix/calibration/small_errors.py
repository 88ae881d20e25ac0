"""Small errors that all exposures have in common: a curved response, an offset, crosstalk."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix.calibration.residuals import EXACT, FEWEST
from equipix.calibration.verdicts import Verdict
from equipix.errors import InputError, InsufficientMemoryError
from equipix.exposures.options import FitOptions

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from equipix._native import Fit
    from equipix._types import Floats
    from equipix.calibration.residuals import Residuals
    from equipix.calibration.weights import Weighted
    from equipix.exposures.exposures import Exposures

_SIGMAS = 6.0
"""Standard errors that noise does not reach."""

_AS_LIKELY = 10.0
"""Difference of t² up to which another cause explains the residuals as well: of normal noise, less
than one in a hundred of wrong causes are better by so much."""

_CLEAR, _FAINTEST = 30.0, 0.05
"""Signal over noise that all but this share of values must have. The noise of M and L displaces the
estimate by 1.2 √N of its standard error over the square of that, with N values."""

_MEASUREMENTS = 2**17
"""Most measurements of the window that is fitted again for each cause."""

_STEP = 0.05
"""Size of the error that is added, over the signal, rms: its effect is nearly linear."""

_EXACT = 10.0
"""What it leaves in the residuals over what the solver may leave there."""


_MOST = 0.4
"""Share of the excess of a misfit from which an error is its cause: a flipped dark leaves its own
pattern and the one that it should have had, a half each."""

_TOLERANCE, _PRODUCTS = 1e-7, 200
"""Exactness of the fits that are compared, and the products that they may take."""

_STRONGER = {
    "sign",
    "unit",
    "orientation",
    "repeated",
    "saturation",
    "variance",
    "prior",
    "drift",
    "colour",
}
"""Kinds of verdicts whose causes leave what looks like a small error."""


class Cause(NamedTuple):
    """An error in words, at its size, the remedy, and the largest size that sensors have."""

    words: Callable[[float], str]
    remedy: str
    most: float = np.inf


_SEE_DARK = "see that a dark of the same settings was subtracted, once, and is not flipped"

_CURVED = Cause(
    lambda size: f"a response that is {size:+.2%} off a line at the largest signal",
    "correct the frames by response curves first (equipix.nuc.fit), or use less light",
    0.15,
)
_CROSSTALK = Cause(
    lambda size: f"crosstalk of {size:.2%} to each neighbour",
    "use a beam with less structure, or frames without sharpening or smoothing",
    0.03,
)
_OFFSET = Cause(
    lambda size: f"an offset of {size:+.2%} of the largest signal in all values",
    _SEE_DARK,
    0.15,
)
_PATTERN = Cause(
    lambda size: f"the pattern of the dark, {size:+.1%} of it",
    _SEE_DARK,
)


@dataclass(frozen=True)
class SmallError:
    """An error of the values that residuals show.

    Attributes
    ----------
    words, remedy : str
        What it is, with its size, and what to do.
    sigmas : float
        Its size in standard errors.
    effect : float
        Root mean square of its effect on M.
    share : float
        Share that it explains of what the squares of residuals have above noise; NaN without
        variances.
    """

    words: str
    remedy: str
    sigmas: float
    effect: float
    share: float


def with_small_errors(
    found: list[Verdict], weighted: Weighted, residuals: Residuals, options: FitOptions
) -> list[Verdict]:
    """Verdicts, with that on small errors: where no other one explains them better."""
    kinds = {each.kind for each in found}
    if kinds & _STRONGER or not residuals.inexactness <= EXACT:
        return found
    errors = small_errors(weighted, options)
    if not errors or ("misfit" in kinds and not errors[0].share > _MOST):
        return found
    others = [each for each in found if each.kind != "misfit"]
    return [*others, Verdict("misfit", _words(errors))]


def _words(errors: list[SmallError]) -> str:
    first = errors[0]
    likely = ", or ".join(each.words for each in errors)
    return (
        f"the residuals show {likely}: {abs(first.sigmas):.0f} standard errors (limit "
        f"{_SIGMAS:g}), and an error of the sensitivity of {first.effect:.1e} rms: "
        + "; or ".join(each.remedy for each in errors)
    )


def small_errors(weighted: Weighted, options: FitOptions) -> list[SmallError]:
    """Find the likely small errors of all values, the likeliest first; none where noise hides them.

    Notes
    -----
    An error a z of the values y changes M and L, and leaves a P z in the residuals r. P z is found
    by a fit of y + ε z to a central window: the change of the residuals is ε P z. So the estimate
    is a = ⟨r, P z⟩ / ⟨P z, P z⟩ in the products that weights make, and its variance
    σ²/⟨P z, P z⟩ [1]_, to which the noise of the dark adds. What M and L absorb, such as a power
    law of the response, is not found. Nothing is tested where the shifts have errors that are not
    refined, and where fluxes are fitted, which take most of such errors: what is left is small and
    not of one cause. Nor behind colour filters, where such an error differs between colours.

    References
    ----------
    .. [1] C. R. Rao, "Large sample tests of statistical hypotheses concerning several parameters
       with applications to problems of estimation", Proc. Camb. Phil. Soc. 44 (1948) 50-57.
    """
    fit = weighted.fit
    # Errors of shifts that are not refined leave residuals of their own.
    given = weighted.exposures.positions.std is not None and fit.refinement != "refined"
    fitted = weighted.exposures.flux.kind in ("fit", "linear")
    if given or fitted or weighted.exposures.filters is not None:
        return []
    if fit.degrees_of_freedom < FEWEST or fit.ended != "converged":
        return []
    try:
        found = list(_tested(weighted, options))
    except (InputError, InsufficientMemoryError):
        # All arguments are valid for the whole sensor: the window has too little light or memory.
        return []
    found.sort(key=lambda each: -abs(each.sigmas))
    least = max(_SIGMAS**2, found[0].sigmas ** 2 - _AS_LIKELY) if found else 0.0
    return [each for each in found if each.sigmas**2 >= least]


def _tested(weighted: Weighted, options: FitOptions) -> Iterator[SmallError]:
    """Each error that is tested."""
    window, start = _window(weighted)
    exact = FitOptions(tolerance=_TOLERANCE, max_sweeps=_PRODUCTS, workers=options.workers)
    fit = window.fit(exact, start)
    own = _scaled(window, fit, options)
    square, noise = float(np.nansum(own**2)), weighted.noise_variance * fit.degrees_of_freedom
    signal = window.values - window.residuals(fit, options.workers)
    clear = np.sqrt(window.weighted_squares(signal**2) / weighted.noise_variance)
    if not (np.isfinite(clear).any() and np.nanquantile(clear, _FAINTEST) > _CLEAR):
        return
    whole = float(np.nansum(clear**2) * weighted.noise_variance) ** 0.5
    for cause, error in _errors(signal, window):
        if not np.isfinite(error).any():
            continue
        size = _STEP * float(np.sqrt(np.nanmean(signal**2) / np.nanmean(error**2)))
        values = window.values + np.nan_to_num(size * error).astype(window.values.dtype)
        changed = dataclasses.replace(window, values=values)
        other = changed.fit(exact, fit)
        left = (_scaled(changed, other, options) - own) / size
        power = float(np.nansum(left**2))
        solver = float(fit.error_estimate[-1] + other.error_estimate[-1]) * whole
        if other.ended != "converged" or not size * power**0.5 > _EXACT * solver:
            continue
        found = float(np.nansum(own * left)) / power
        if cause is _PATTERN:
            found += _noise_of_dark(weighted.exposures)
        if not abs(found) < cause.most:
            continue
        variance = max(square, noise) / fit.degrees_of_freedom / power
        std = (variance + _by_noise_of_dark(weighted.exposures, window, left) / power**2) ** 0.5
        effect = abs(found / size) * _scatter(other, fit)
        explained = found**2 * power / (square - noise) if square > noise else np.nan
        share = np.nan if window.variance is None else explained
        yield SmallError(cause.words(found), cause.remedy, found / std, effect, share)


def _noise_of_dark(exposures: Exposures) -> float:
    """Share of the variance of the dark's pattern that is noise: all values lack it by itself."""
    if exposures.dark is None or exposures.dark_variance is None:
        return 0.0
    return min(1.0, float(np.mean(exposures.dark_variance) / np.var(exposures.dark)))


def _by_noise_of_dark(exposures: Exposures, window: Exposures, left: Floats) -> float:
    """Variance of ⟨r, P z⟩ by the noise of the dark, which all measurements of a pixel share."""
    if exposures.dark_variance is None:
        return 0.0
    roots = np.sqrt(window.weighted_squares(np.ones(left.shape)))
    shared = np.nansum(roots * left, axis=0)
    return float(np.mean(exposures.dark_variance) * np.sum(shared**2))


def _scatter(other: Fit, fit: Fit) -> float:
    """Root mean square of the relative change of M from one fit to another."""
    lit = (fit.sensitivity > 0) & (fit.flags == 0)
    return float(np.std(other.sensitivity[lit] / fit.sensitivity[lit]))


def _window(weighted: Weighted) -> tuple[Exposures, Fit | None]:
    """All exposures and their fit, or a central window of large ones."""
    exposures = weighted.exposures
    side = int((_MEASUREMENTS / len(exposures)) ** 0.5)
    if side >= max(exposures.shape):
        return exposures, weighted.fit
    return exposures.window(side), None


def _errors(signal: Floats, window: Exposures) -> Iterator[tuple[Cause, Floats]]:
    """Errors of a unit size, and their words at a size."""
    top = float(np.nanmax(signal))
    yield _CURVED, signal**2 / top
    yield _CROSSTALK, sum(np.roll(signal, n, axis) for n in (1, -1) for axis in (1, 2)) - 4 * signal
    if not window.offset:
        yield _OFFSET, np.full(signal.shape, top)
    if window.dark is not None and np.ptp(window.dark) > 0:
        yield _PATTERN, np.broadcast_to(window.dark - np.median(window.dark), signal.shape)


def _scaled(window: Exposures, fit: Fit, options: FitOptions) -> Floats:
    """Residuals times the roots of their weights; NaN where nothing is known."""
    residuals = window.residuals(fit, options.workers)
    if fit.prior is not None:
        # There M follows its prior, so residuals are no test of the model.
        residuals[:, fit.prior > 0] = np.nan
    squares = window.weighted_squares(np.square(residuals))
    return np.asarray(np.copysign(np.sqrt(squares), residuals))

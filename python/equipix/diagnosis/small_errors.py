"""Small errors that all exposures have in common: a curved response, an offset, crosstalk."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from equipix._check import Array, Floats
from equipix._native import Fit
from equipix.diagnosis.evidence import Evidence
from equipix.exposures.exposures import Exposures, FitOptions
from equipix.findings import usable
from equipix.fitting.error_bars import with_dark_misfit
from equipix.fitting.residuals import EXACT, FEWEST, tested
from equipix.fitting.weighted import Options, Weighted
from equipix.fitting.windows import if_there_is_light, simulated, window_of

_SIGMAS = 6.0
"""Standard errors that noise does not reach."""

_AS_LIKELY = 10.0
"""Difference of t² up to which another cause explains the residuals as well: of normal noise, less
than one in a hundred of wrong causes are better by so much."""

_CLEAR, _FAINTEST = 30.0, 0.05
"""Signal over noise that all but this share of values must have. Where the noise of M and L is
larger, more than its square displaces the estimate."""

_COARSE = 4.0
"""Variance of the dark over the pixels, in that of its noise, from which its pattern is known: that
of 0.3 DN, in whole numbers, is itself an error of rounding, which the residuals hold too."""

_STEP = 0.005
"""Size of the error that is added, over the signal, rms: its effect is nearly linear. Of 0.05 the
rest displaced crosstalk by four standard errors where the dark was that of one frame."""

_EXACT = 10.0
"""What it leaves in the residuals over what the solver may leave there."""


_MOST = 0.4
"""Share of the excess of a misfit from which an error is its cause: a flipped dark leaves its own
pattern and the one that it should have had, a half each."""

_TOLERANCE, _PRODUCTS = 1e-8, 200
"""Exactness of the fits that are compared, and the products that they may take."""


class Cause(NamedTuple):
    """An error of a unit size for a signal and a dark, in words at its size, and the remedy."""

    error: Callable[[Floats, Array], Floats]
    words: Callable[[float], str]
    remedy: str
    most: float = np.inf
    """The largest size that sensors have."""


def _from_neighbours(signal: Floats) -> Floats:
    """Σ (neighbour − own); a pixel at the edge has fewer neighbours."""
    wide = np.pad(signal, ((0, 0), (1, 1), (1, 1)), mode="edge")
    along_rows, along_cols = np.diff(wide[:, :, 1:-1], 2, axis=1), np.diff(wide[:, 1:-1], 2, axis=2)
    return np.asarray(along_rows + along_cols)


_SEE_DARK = "see that a dark of the same settings was subtracted, once, and is not flipped"

_CURVED = Cause(
    lambda signal, _: signal**2 / float(np.nanmax(signal)),
    lambda size: f"a response that is {size:+.2%} off a line at the largest signal",
    "correct the frames by response curves first (equipix.nuc.fit), or use less light",
    0.15,
)

_CROSSTALK = Cause(
    lambda signal, _: _from_neighbours(signal),
    lambda size: f"crosstalk of {size:.2%} to each neighbour",
    "use a beam with less structure, or frames without sharpening or smoothing",
    0.03,
)

_OFFSET = Cause(
    lambda signal, _: np.full(signal.shape, float(np.nanmax(signal))),
    lambda size: f"an offset of {size:+.2%} of the largest signal in all values",
    _SEE_DARK,
    0.15,
)

_PATTERN = Cause(
    lambda signal, dark: np.broadcast_to(dark - np.median(dark), signal.shape),
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


def small_errors_found(evidence: Evidence) -> str | None:
    """Say which small errors the residuals show, if they explain a misfit that they have.

    Values of flagged pixels that are not proportional to light are none, and residuals of a beam
    finer than its spline have their cause.
    """
    weighted = evidence.weighted
    if not evidence.residuals.inexactness <= EXACT or weighted.excess > 1:
        return None
    exposures = weighted.exposures.without(~usable(evidence.flags))
    errors = small_errors(weighted._replace(exposures=exposures), evidence.options.fit)
    if not errors or (evidence.misfit is not None and not errors[0].share > _MOST):
        return None
    first, likely = errors[0], ", or ".join(each.words for each in errors)
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
    σ²/⟨P z, P z⟩ [1]_, to which the noise of the dark adds. Noise is also in M, L and z: without
    any error of the values ⟨r, P z⟩ has a mean that is quadratic in it. Where ⟨r, P z⟩ is larger
    than noise, its mean over fits of simulated noise of both signs is subtracted. What M and L
    absorb, such as a power law of the response, is not found. Nothing is tested where the shifts
    have errors that are not refined, and where fluxes are fitted, which take most of such errors:
    what is left is small and not of one cause. Nor behind colour filters, where such an error
    differs between colours.

    References
    ----------
    .. [1] C. R. Rao, "Large sample tests of statistical hypotheses concerning several parameters
       with applications to problems of estimation", Proc. Camb. Phil. Soc. 44 (1948) 50-57.
    """
    fit = weighted.fit
    # Errors of shifts that are not refined leave residuals of their own.
    given = weighted.exposures.positions.std is not None and fit.refinement != "refined"
    fitted = weighted.exposures.flux.is_fitted
    if given or fitted or weighted.exposures.filters is not None:
        return []
    if fit.degrees_of_freedom < FEWEST or fit.ended != "converged":
        return []
    found = sorted(_tested(weighted, options) or [], key=lambda each: -abs(each.sigmas))
    least = max(_SIGMAS**2, found[0].sigmas ** 2 - _AS_LIKELY) if found else 0.0
    return [each for each in found if each.sigmas**2 >= least]


@if_there_is_light()
def _tested(weighted: Weighted, options: FitOptions) -> list[SmallError] | None:
    """Each error that is larger than noise."""
    window, known = window_of(weighted.exposures, weighted.fit)
    exact = FitOptions(tolerance=_TOLERANCE, max_sweeps=_PRODUCTS, workers=options.workers)
    start = None if known is None else known.start()
    part = with_dark_misfit(Weighted(window, window.fit(exact, start), None), Options(options))
    here = _Fitted.of(window, part.fit, options)
    fit, own, signal = part.fit, here.residuals, here.signal
    square, noise = float(np.nansum(own**2)), part.noise_variance * part.expected_misfit
    squares = window.weighted_squares(signal**2)
    clear = np.sqrt(squares / part.noise_variance)
    if not (np.isfinite(clear).any() and np.nanquantile(clear, _FAINTEST) > _CLEAR):
        return []
    whole = float(np.nansum(squares)) ** 0.5
    roots = np.sqrt(window.weighted_squares(np.ones(window.values.shape)))
    noisy: list[_Fitted] = []
    found = []
    for cause in _causes(window, signal):
        left, other, size = here.left_by(cause, exact)
        power = float(np.nansum(left**2))
        solver = float(fit.error_estimate[-1] + other.error_estimate[-1]) * whole
        if other.ended != "converged" or not size * power**0.5 > _EXACT * solver:
            continue
        variance = max(part.noise_variance, part.reduced_chi2) * power
        if window.dark_variance is not None:
            variance += float(np.sum(window.dark_variance * np.nansum(roots * left, axis=0) ** 2))
        product = float(np.nansum(own * left))
        if not abs(product) > _SIGMAS * variance**0.5:
            continue
        # The mean over both signs of the noise has only what is quadratic in it.
        if not noisy:
            both = (simulated(part, options, sign) for sign in (1, -1))
            noisy = [_Fitted.of(each, each.fit(exact, fit.start()), options) for each in both]
        by_noise = np.mean([each.product(cause, exact) for each in noisy], axis=0)
        estimate = (product - float(by_noise.sum())) / power
        if not abs(estimate) < cause.most:
            continue
        # What is quadratic in noise scatters in the measurements as in the simulation.
        variance += 2 * float(np.sum((by_noise - by_noise.mean()) ** 2))
        sigmas = estimate * power / variance**0.5
        effect = abs(estimate / size) * _scatter(other, fit)
        explained = estimate**2 * power / (square - noise) if square > noise else np.nan
        share = np.nan if window.variance is None else explained
        found.append(SmallError(cause.words(estimate), cause.remedy, sigmas, effect, share))
    return found


def _causes(window: Exposures, signal: Floats) -> Iterator[Cause]:
    """Errors that the measurements can show."""
    yield _CURVED
    if np.isfinite(_from_neighbours(signal)).any():
        yield _CROSSTALK
    if not window.offset:
        yield _OFFSET
    if window.dark is not None:
        noise = 0.0 if window.dark_variance is None else float(np.mean(window.dark_variance))
        # Without hot pixels, which would make any dark one with a pattern.
        clipped = np.clip(window.dark, *np.quantile(window.dark, [0.01, 0.99]))
        if np.var(clipped) > _COARSE * noise:
            yield _PATTERN


class _Fitted(NamedTuple):
    """A window and its fit: residuals times √w, and the values that it expects."""

    window: Exposures
    fit: Fit
    residuals: Floats
    signal: Floats

    @classmethod
    def of(cls, window: Exposures, fit: Fit, options: FitOptions) -> Self:
        """Take both from one evaluation of the fit."""
        residuals = window.residuals(fit, options.workers)
        signal = np.asarray(window.values - residuals)
        return cls(window, fit, _scaled(window, fit, residuals), signal)

    def left_by(self, cause: Cause, options: FitOptions) -> tuple[Floats, Fit, float]:
        """What an error of unit size leaves in residuals; the fit that shows it, its size."""
        window, signal = self.window, self.signal
        dark = np.zeros(window.shape) if window.dark is None else window.dark
        error = cause.error(signal, dark)
        size = _STEP * float(np.sqrt(np.nanmean(signal**2) / np.nanmean(error**2)))
        values = window.values + np.nan_to_num(size * error).astype(window.values.dtype)
        changed = dataclasses.replace(window, values=values)
        fit = changed.fit(options, self.fit.start())
        left = _scaled(changed, fit, changed.residuals(fit, options.workers)) - self.residuals
        return left / size, fit, size

    def product(self, cause: Cause, options: FitOptions) -> Floats:
        """Sum of r · P z over the exposures of each pixel."""
        left, *_ = self.left_by(cause, options)
        return np.asarray(np.nansum(self.residuals * left, axis=0))


def _scatter(other: Fit, fit: Fit) -> float:
    """Root mean square of the relative change of M from one fit to another."""
    lit = (fit.sensitivity > 0) & (fit.flags == 0)
    return float(np.std(other.sensitivity[lit] / fit.sensitivity[lit]))


def _scaled(window: Exposures, fit: Fit, residuals: Floats) -> Floats:
    """Residuals times the roots of their weights; NaN where nothing is known."""
    residuals[:, ~tested(fit)] = np.nan
    squares = window.weighted_squares(np.square(residuals))
    return np.asarray(np.copysign(np.sqrt(squares), residuals))

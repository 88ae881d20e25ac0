"""Whether the data confirm the sign of the shifts."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix.errors import InputError, InsufficientMemoryError
from equipix.exposures.options import FitOptions

if TYPE_CHECKING:
    from equipix._native import Fit
    from equipix._types import Array, Bools, Progress, ShiftSign
    from equipix.exposures.exposures import Exposures
    from equipix.exposures.positions import Positions

_MOST_EXPOSURES = 12
"""Most exposures of the test, from first to last: each has a flux to be fitted."""

_SIGMAS = 6.0
"""Standard deviations √(2/dof) of F that noise does not reach."""

_FEWEST = 1000
"""Degrees of freedom below which F scatters by more than √(2/dof)."""

_WIDE, _LEAST = 4, 80
"""Side of the window in largest shifts, and the pixels that it may have whatever they are."""

_COARSE, _MOST_COARSE = 1e-2, 300
"""Tolerance and most products of the first fits, sufficient in a beam with structure."""

_FINER, _MOST_FINE = 0.3, 100
"""Tolerance, relative to the remaining noise, and most products of later fits."""

_ROUNDS = 4
"""Rounds of finer fits, and of leaving out outliers."""

_OUTLIER = 30.0
"""Median absolute residuals, 20 standard deviations: no noise, nor the waves of a wrong sign."""

_BLOCK, _MOST = 4, 2 / 3
"""Pixels along a block, and the share of blocks where the better fit must be better. A grain of
dust changes F by more than noise does, but in few blocks only."""


class _Residuals(NamedTuple):
    """Residuals of a fit.

    `left` is F for each degree of freedom, `squares` its parts (n, rows, cols), `noise` the root of
    it relative to the signal, `error` the estimated error of M, `stuck` that it did not converge.
    """

    left: float
    freedom: int
    squares: Array
    noise: float
    error: float
    stuck: bool

    @property
    def settled(self) -> bool:
        """Whether F is as good as at its minimum."""
        return self.error <= _FINER * self.noise

    @property
    def least(self) -> float:
        """Lower limit of `left`: it may still decrease by the order of Σ w y²·error².

        The measured decrease was 80 times smaller.
        """
        return self.left if self.settled else self.left * (1 - (self.error / self.noise) ** 2)


class SignTest(NamedTuple):
    """Outcome of the comparison.

    `given` and `reversed` are F per degree of freedom with the shifts as given and reversed; NaN
    where the sign is undetermined.
    """

    sign: ShiftSign
    given: float = float("nan")
    reversed: float = float("nan")


def shift_sign(exposures: Exposures, fit: Fit, options: FitOptions) -> SignTest:
    """Compare the fit with the shifts as given to that with d → −d.

    Parameters
    ----------
    exposures : Exposures
        The measurements, their weights, and the shifts as they were given.
    fit : Fit
        Their fit: the free fluxes start from its fluxes.
    options : FitOptions
        Number of threads and progress.

    Returns
    -------
    SignTest
        The sign with the lower F, if F is lower by more than 6·√(2/dof) of itself, and in two
        thirds of all blocks of 4×4 pixels. Undetermined without a comparison where an offset is
        sought.

    Notes
    -----
    F/dof has the standard deviation √(2/dof) of itself. Fluxes are free in both fits, since in a
    smooth beam the residuals of reversed shifts are degenerate with a lamp drift. A Gaussian beam
    leaves none: ln L is quadratic, and 1/L for L, M·L² for M and other fluxes fit as well.

    F is accurate where the estimated error of M is below 0.3 of the relative noise that the fit
    leaves (it was then at most 2e-4 of itself above its minimum); else it is reduced by the square
    of error over noise. Only the higher F must be accurate, since the lower one can only decrease.
    Outliers of one of the fits, such as dust, are left out of both.
    """
    if exposures.offset:
        return SignTest("undetermined")
    count = len(exposures)
    asked = np.unique(np.linspace(0, count - 1, _MOST_EXPOSURES).round().astype(int))
    exposures = dataclasses.replace(
        exposures,
        flux=exposures.flux.free(np.array(fit.flux)),
        positions=dataclasses.replace(exposures.positions, std=None),
    )
    side = _side(exposures.positions.chosen(asked), exposures.shape)
    # The window first: the exposures chosen are copied.
    windows = [each.window(side).chosen(asked) for each in (exposures, exposures.reversed())]
    if len(asked) < 3 or (len(asked) - 2) * windows[0].values[0].size < _FEWEST:
        return SignTest("undetermined")
    try:
        found = _residuals(windows, options)
    except (InputError, InsufficientMemoryError):
        # All arguments are valid for the whole sensor: the window has too little light or memory.
        return SignTest("undetermined")
    lower = _lower(found)
    if lower is None:
        return SignTest("undetermined")
    sign: ShiftSign = "contradicted" if lower else "confirmed"
    return SignTest(sign, found[0].left, found[1].left)


def _side(positions: Positions, shape: tuple[int, int]) -> int:
    """Pixels along the window: some four times the largest shift s.

    Where that is large, it is the smallest that leaves half a measurement a pixel for the test:
    (n − 1)·w² − (w + s)² ≥ w²/2, the cells being at most (w + s)². 0 if nothing moves.
    """
    # Where the sensor's middle looks: a quarter turn exchanges its coordinates.
    turned = positions.rotation % 180 == 90
    middle = (np.array(shape) - 1) / 2
    middles = np.where(turned[:, None], middle[::-1], middle)
    reach = max(float(np.ptp(middles + sign * positions.shifts, axis=0).max()) for sign in (1, -1))
    enough: float = reach / (max(len(positions) - 1.5, 1.5) ** 0.5 - 1)
    return round(min(_WIDE * reach, max(_LEAST, enough)))


def _residuals(windows: list[Exposures], options: FitOptions) -> list[_Residuals]:
    """Residuals with the shifts as given and with all of them reversed, as exact as necessary."""
    noises: list[float | None] = [None, None]

    def fit(k: int) -> _Residuals:
        return _fitted(windows[k], noises[k], options)

    found = [fit(0), fit(1)]
    for _ in range(_ROUNDS):
        outliers = _outliers(found)
        if outliers.any():
            windows = [window.without(outliers) for window in windows]
            found = [fit(0), fit(1)]
            continue
        unsettled = [k for k in (0, 1) if not (found[k].settled or found[k].stuck)]
        if not unsettled or _lower(found) is not None:
            break
        for k in unsettled:
            noises[k] = found[k].noise
            found[k] = fit(k)
    return found


def _fitted(window: Exposures, noise: float | None, options: FitOptions) -> _Residuals:
    """Fit beam and sensitivity, with free fluxes: coarsely, or finer than that noise."""
    tolerance = _COARSE if noise is None else max(_FINER * noise, np.finfo(float).eps)
    fit = window.fit(
        FitOptions(
            tolerance=tolerance,
            max_sweeps=_MOST_COARSE if noise is None else _MOST_FINE,
            workers=options.workers,
            progress=None if options.progress is None else _named(options.progress),
        )
    )
    left = fit.misfit / max(fit.degrees_of_freedom, 1)
    power = np.nanmean(window.weighted_squares(np.square(window.values, dtype=np.float64)))
    return _Residuals(
        left=left,
        freedom=fit.degrees_of_freedom,
        squares=window.weighted_squares(np.square(window.residuals(fit, options.workers))),
        noise=(left / float(power)) ** 0.5,
        error=float(fit.error_estimate[-1]),
        stuck=fit.ended != "converged",
    )


def _lower(fits: list[_Residuals]) -> int | None:
    """Which fit has the lower F, if the other F is accurate and far above it, in most blocks."""
    freedom = min(fit.freedom for fit in fits)
    lower = int(fits[1].left < fits[0].left)
    low, high = fits[lower], fits[1 - lower]
    if freedom < _FEWEST or high.noise == 0:
        return None
    # Written so that NaN gives no decision.
    if not high.least > (1 + _SIGMAS * (2 / freedom) ** 0.5) * low.left:
        return None
    excess = high.squares - low.squares
    blocks = _sums_of_blocks(np.nansum(excess, axis=0))
    measured = _sums_of_blocks(np.isfinite(excess).any(axis=0).astype(int)) > 0
    return lower if np.mean(blocks[measured] > 0) > _MOST else None


def _sums_of_blocks(image: Array) -> Array:
    """Sums over blocks of `_BLOCK` pixels square."""
    for axis, size in enumerate(image.shape):
        image = np.add.reduceat(image, np.arange(0, size, _BLOCK), axis=axis)
    return image


def _outliers(fits: list[_Residuals]) -> Bools:
    """Outliers of one of the fits, such as measurements of dust."""
    limits = [_OUTLIER**2 * np.nanmedian(fit.squares) for fit in fits]
    outliers: Bools = np.any(
        [fit.squares > limit for fit, limit in zip(fits, limits, strict=True)], axis=0
    )
    return outliers


def _named(progress: Progress) -> Progress:
    """Progress with the name of this stage."""
    return lambda done, total, _: progress(done, total, "sign of shifts")

"""Fits of a central window, as exact as a comparison of their residuals requires."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import numpy as np

from equipix.calibration.residual_tests import Correlation, in_blocks, lag_one
from equipix.errors import InputError, InsufficientMemoryError
from equipix.exposures.options import FitOptions

if TYPE_CHECKING:
    from collections.abc import Callable

    from equipix._native import Fit
    from equipix._types import Array, Bools, Floats, Progress
    from equipix.exposures.exposures import Exposures

_Asked = ParamSpec("_Asked")
_Answer = TypeVar("_Answer")

_COARSE, _MOST_COARSE = 1e-2, 300
"""Tolerance and most products of the first fits, sufficient in a beam with structure."""

_FINER, _MOST_FINE = 0.3, 100
"""Tolerance, relative to the remaining noise, and most products of later fits."""

_SIGMAS = 6.0
"""Standard deviations √(2/dof) of F that noise does not reach."""

_FEWEST = 1000
"""Degrees of freedom below which F scatters by more than √(2/dof)."""

_ODD = 30.0
"""Median absolute residuals, 20 standard deviations: no noise, nor the waves of a wrong sign."""

_RARE = 0.02
"""Share of outliers up to which they are those of dust. In fine structure a wrong orientation has
as large residuals, everywhere."""

_BLOCK, _MOST = 4, 2 / 3
"""Pixels along a block, and the share of blocks where the better fit must be better. A grain of
dust changes F by more than noise does, but in few blocks only."""

_MEASUREMENTS = 2**17
"""Most measurements of a window that stands for the whole sensor."""

_WHITE = 5.0
"""Standard errors of a correlation that white residuals do not reach."""

_SLIGHT = 5e-3
"""Misfit relative to the signal, rms, of which nothing is concluded. A reflection of 0.5 % that
moves against the beam has less: it leaves white residuals in a wrong orientation."""

_OVERWHELMING = 30.0
"""How much larger than the misfit that remains a misfit must be to be of another cause."""


@dataclass(frozen=True, eq=False)
class WindowFit:
    """A fit of a window.

    Attributes
    ----------
    fit : Fit
        The fit, with free fluxes.
    left : float
        F for each degree of freedom.
    freedom : int
        Degrees of freedom.
    share : float
        Degrees of freedom over measurements.
    power : float
        Mean of w y²: what `left` is compared with.
    residuals : ndarray, shape (n, rows, cols)
        Residuals times √w.
    """

    fit: Fit
    left: float
    freedom: int
    share: float
    power: float
    residuals: Floats

    @classmethod
    def of(
        cls, window: Exposures, options: FitOptions, before: WindowFit | None = None
    ) -> WindowFit:
        """Fit beam and sensitivity: coarsely, or finer than the noise that a fit before left."""
        noise = None if before is None else before.noise
        tolerance = _COARSE if noise is None else max(_FINER * noise, np.finfo(float).eps)
        fit = window.fit(
            FitOptions(
                tolerance=tolerance,
                max_sweeps=_MOST_COARSE if noise is None else _MOST_FINE,
                workers=options.workers,
                progress=None if options.progress is None else _named(options.progress),
            ),
            None if before is None else before.fit,
        )
        squares = window.weighted_squares(np.square(window.values, dtype=np.float64))
        residuals = window.residuals(fit, options.workers)
        scaled = np.copysign(np.sqrt(window.weighted_squares(np.square(residuals))), residuals)
        share = fit.degrees_of_freedom / max(int(np.count_nonzero(np.isfinite(scaled))), 1)
        return cls(
            fit=fit,
            left=fit.misfit / max(fit.degrees_of_freedom, 1),
            freedom=fit.degrees_of_freedom,
            share=share,
            power=float(np.nanmean(squares)),
            residuals=scaled,
        )

    @cached_property
    def neighbours(self) -> tuple[Correlation, Correlation]:
        """Correlation of neighbouring residuals, along both axes."""
        return lag_one(self.residuals, self.share)

    @property
    def noise(self) -> float:
        """Root mean square of the noise relative to the signal, as the fit leaves it."""
        return float((self.left / self.power) ** 0.5)

    @property
    def error(self) -> float:
        """Estimated error of M."""
        return float(self.fit.error_estimate[-1])

    @property
    def settled(self) -> bool:
        """Whether F is as good as at its minimum, as it is where nothing is left."""
        return self.error <= _FINER * self.noise or self.left == 0

    @property
    def final(self) -> bool:
        """Whether another fit would not be more exact."""
        return self.settled or self.fit.ended not in ("converged", "sweeps used")

    @property
    def least(self) -> float:
        """Lower limit of `left`: it may still decrease by the order of Σ w y²·error².

        The measured decrease was 80 times smaller.
        """
        if self.settled:
            return self.left
        return max(0.0, self.left * (1 - (self.error / self.noise) ** 2))

    @property
    def is_white(self) -> bool:
        """Whether neighbouring residuals are uncorrelated."""
        return max(abs(each.z) for each in self.neighbours) < _WHITE

    @property
    def is_within_noise(self) -> bool:
        """Whether variances that are known explain F. A NaN counts as explained."""
        return not self.left > 1 + _SIGMAS * (2 / max(self.freedom, 1)) ** 0.5

    def is_far_above(self, low: WindowFit) -> bool:
        """Whether its F is above that of another fit by more than noise and small errors explain.

        Written so that NaN gives no decision.
        """
        freedom = min(self.freedom, low.freedom)
        if freedom < _FEWEST or self.noise == 0:
            return False
        if not self.least > (1 + _SIGMAS * (2 / freedom) ** 0.5) * low.left:
            return False
        misfit = (self.least - low.left) * low.share
        if not misfit > _SLIGHT**2 * low.power:
            return False
        remaining = max(abs(each.product) for each in low.neighbours)
        return (low.is_white or misfit > _OVERWHELMING * remaining) and self._in_most_blocks(low)

    def cannot_be_far_above(self, low: WindowFit) -> bool:
        """Whether its F is too low already: finer fits only lower it."""
        return not (self.left - low.least) * low.share > _SLIGHT**2 * low.power

    def _in_most_blocks(self, low: WindowFit) -> bool:
        excess = np.square(self.residuals) - np.square(low.residuals)
        blocks = in_blocks(np.nansum(excess, axis=0), _BLOCK)
        measured = in_blocks(np.isfinite(excess).any(axis=0).astype(int), _BLOCK) > 0
        return bool(measured.any() and np.mean(blocks[measured] > 0) > _MOST)

    def outliers(self) -> Bools:
        """Outliers, such as measurements of dust; none where there are so many that it is not."""
        squares: Array = np.square(self.residuals)
        odd = np.asarray(squares > _ODD**2 * np.nanmedian(squares))
        return np.asarray(odd & (odd.mean() < _RARE))


def window_of(exposures: Exposures, fit: Fit) -> tuple[Exposures, Fit | None]:
    """Return all exposures and their fit, or a central window of large ones, which has none yet."""
    side = int((_MEASUREMENTS / len(exposures)) ** 0.5)
    if side >= max(exposures.shape):
        return exposures, fit
    return exposures.window(side), None


def if_there_is_light(question: Callable[_Asked, _Answer]) -> Callable[_Asked, _Answer | None]:
    """Return a question of fits of a window that answers None in too little light or memory.

    All arguments are valid for the whole sensor.
    """

    @functools.wraps(question)
    def asked(*args: _Asked.args, **kwargs: _Asked.kwargs) -> _Answer | None:
        try:
            return question(*args, **kwargs)
        except (InputError, InsufficientMemoryError):
            return None

    return asked


def _named(progress: Progress) -> Progress:
    """Progress with the name of this stage."""
    return lambda done, total, _: progress(done, total, "sign of shifts")

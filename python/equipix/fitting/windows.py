"""Fits of a small window: other models, simulated noise, exposures out of place."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from equipix._check import Array, Bools, Floats, staged
from equipix._native import Fit, Start
from equipix.errors import InputError, InsufficientMemoryError
from equipix.exposures.exposures import Exposures, FitOptions
from equipix.fitting.error_bars import with_dark_misfit
from equipix.fitting.residuals import (
    EXACT,
    FEWEST,
    Correlation,
    Residuals,
    in_blocks,
    lag_one,
    sampled,
    tested,
)
from equipix.fitting.weighted import Options, Weighted

_COARSE, _MOST_COARSE = 1e-2, 300
"""Tolerance and most products of the first fits, sufficient in a beam with structure."""

_FINER, _MOST_FINE = 0.3, 100
"""Tolerance of finer fits, relative to the noise that remains, and most products of all that start
from another."""

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
        cls,
        window: Exposures,
        options: FitOptions,
        start: Start | None = None,
        tolerance: float = _COARSE,
    ) -> WindowFit:
        """Fit beam and sensitivity to such an error of M, from another fit on if there is one."""
        most = _MOST_COARSE if start is None else _MOST_FINE
        progress = staged(options.progress, "sign of shifts")
        stop = FitOptions("multiscale", tolerance, most, options.workers, progress)
        fit = window.fit(stop, start)
        squares = window.weighted_squares(np.square(window.values, dtype=np.float64))
        residuals = window.residuals(fit, options.workers)
        scaled = np.copysign(np.sqrt(window.weighted_squares(np.square(residuals))), residuals)
        freedom = fit.degrees_of_freedom
        left = fit.misfit / max(freedom, 1)
        share = freedom / max(int(np.count_nonzero(np.isfinite(scaled))), 1)
        return cls(fit, left, freedom, share, float(np.nanmean(squares)), scaled)

    def finer(self, window: Exposures, options: FitOptions) -> WindowFit:
        """Return a fit whose error is smaller than the noise that this one leaves."""
        tolerance = max(_FINER * self.noise, np.finfo(float).eps)
        return WindowFit.of(window, options, self.fit.start(), tolerance)

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


@contextmanager
def if_there_is_light() -> Iterator[None]:
    """Let a question of fits of a window answer None in too little light or memory.

    All arguments are valid for the whole sensor.
    """
    with suppress(InputError, InsufficientMemoryError):
        yield


class Chi2(NamedTuple):
    """Reduced χ², and its standard error where model and variances are right."""

    value: float
    std: float


class OfNoise(NamedTuple):
    """A central window with its fit, the fit of simulated noise there, and what that leaves."""

    part: Weighted
    other: Weighted
    residuals: Residuals


def simulated_chi2(weighted: Weighted, found: OfNoise, options: FitOptions) -> Chi2:
    """Reduced χ² by the degrees of freedom that simulated measurements have.

    Notes
    -----
    The measurements are c L M + d + σ e on a central window, with the c, L and M of its fit, the
    given variances σ², normal e, and an error d of the dark that all exposures share. F of their
    fit, over what it is expected to be, is the factor by which degrees of freedom are counted
    wrongly: a spline's penalty determines cells that only noisy pixels see, and a prior on M dim
    pixels. That of the whole sensor is divided by it [1]_. Pixels whose M follows the prior are
    left out of F.

    References
    ----------
    .. [1] B. Efron, R. J. Tibshirani, "An Introduction to the Bootstrap" (1993), section 6.5: the
       parametric bootstrap.
    """
    part, other, _ = found
    free = tested(part.fit)
    factor = squares(other.exposures, other.fit, free, options) / part.expected_misfit
    left = squares(weighted.exposures, weighted.fit, tested(weighted.fit), options)
    std = float(np.hypot(weighted.chi2_std, part.chi2_std))
    return Chi2(left / factor / weighted.expected_misfit, std)


@if_there_is_light()
def of_noise(weighted: Weighted, options: FitOptions) -> OfNoise | None:
    """Fit simulated noise on a central window.

    None where the window has too few degrees of freedom, or the fit is not exact enough.
    """
    # Coordinate descent would take thousands of sweeps for large-scale errors of this fit alone.
    options = dataclasses.replace(options, progress=None, method="multiscale")
    window, fit = window_of(weighted.exposures, weighted.fit)
    part = weighted
    if fit is None:
        part = with_dark_misfit(Weighted(window, window.fit(options), None), Options(options))
    right = simulated(part, options)
    other = Weighted(right, right.fit(options, part.fit.start()), None)
    residuals = sampled(other, workers=options.workers)
    exact = residuals.inexactness <= EXACT
    found = OfNoise(part, other, residuals)
    return found if part.fit.degrees_of_freedom >= FEWEST and exact else None


def simulated(part: Weighted, options: FitOptions, sign: int = 1) -> Exposures:
    """Exposures of the values that a fit expects, and noise; as they are where it expects none.

    The noise is that of the measurements, and an error of the dark that all exposures share. Both
    are the same numbers in every call, times `sign`.
    """
    window, rng = part.exposures, np.random.default_rng(0)
    values, dark = window.values - window.residuals(part.fit, options.workers), window.dark
    if window.dark_variance is not None:
        error = sign * np.sqrt(window.dark_variance) * rng.standard_normal(window.shape)
        values += error
        dark = None if dark is None else dark - error
    for k, each in enumerate(values):
        scale = sign * part.noise_variance**0.5 * window.deviation(k)
        each += scale * rng.standard_normal(window.shape)
    values = np.where(np.isfinite(values), values, window.values).astype(window.values.dtype)
    return dataclasses.replace(window, values=values, dark=dark)


def squares(exposures: Exposures, fit: Fit, where: Bools, options: FitOptions) -> float:
    """Σ w r² of some pixels, one exposure at a time: large sensors must fit."""
    total = 0.0
    for k in range(len(exposures)):
        scaled = exposures.residual(fit, k, options.workers) / exposures.deviation(k)
        total += float(np.nansum(np.square(scaled[where & exposures.usable(k)])))
    return total


_SIDE = 128
"""Pixels along a window that is fitted in either order."""

_LEFT = 0.1
"""Share of F above noise that the right order leaves at most."""

_FLIPS = {"upside down": (0,), "mirrored left to right": (1,), "turned by 180 degrees": (0, 1)}


@if_there_is_light()
def misplaced(
    exposures: Exposures, pairs: Sequence[tuple[int, int]], worst: int | None, options: FitOptions
) -> str | None:
    """Which pair is exchanged, or how the worst exposure is flipped or its shift reversed.

    In words, or None. Fits of a central window are compared, in all orders, with that as given.
    Shifts are held: those that are found follow the mistake. Unless given, the worst exposure is
    that which stands out.
    """
    exposures = exposures.at(dataclasses.replace(exposures.positions, std=None))
    window = exposures.window(_SIDE)
    given = WindowFit.of(window, options)
    worst = standing_out(given.residuals) if worst is None else worst
    tried = {
        f"{exposures.name_of(i)} and {exposures.name_of(j)} fit better each at the shift of the "
        "other: check the order of the frames and of 'shifts'": _exchanged(window, i, j)
        for i, j in pairs
    }
    if worst is not None:
        tried |= {
            f"{exposures.name_of(worst)} fits better {flip}: give its frames as the others are, "
            "or its 'rotation'": _flipped(exposures, window, worst, axes)
            for flip, axes in _FLIPS.items()
        }
        tried |= _reversed(exposures, worst)
    if not tried:
        return None
    fits = {words: WindowFit.of(each, options) for words, each in tried.items()}
    best = min(fits, key=lambda words: fits[words].left)
    return best if _explains(fits[best], given, knows_noise=exposures.knows_noise) else None


def _explains(best: WindowFit, given: WindowFit, *, knows_noise: bool) -> bool:
    """Whether another order leaves little of what noise does not explain of the order given.

    Where noise is not known, and may be none, all that is left may be what the solver leaves.
    """
    is_noise = given.is_within_noise if knows_noise else given.cannot_be_far_above(best)
    noise = 1.0 if knows_noise else 0.0
    return not is_noise and best.left - noise < _LEFT * (given.left - noise)


def _exchanged(window: Exposures, i: int, j: int) -> Exposures:
    """Return the exposures, each of two at the place of the other."""
    order = np.arange(len(window))
    order[[i, j]] = j, i
    return window.at(window.positions.chosen(order))


def _reversed(exposures: Exposures, exposure: int) -> dict[str, Exposures]:
    """Return the window with the shift of one exposure reversed along one axis, and along both.

    Not where the positions would then be farther apart than the window is wide.
    """
    positions, sizes = exposures.positions, np.minimum(exposures.shape, _SIDE)
    row, col = positions.shifts[exposure].tolist()
    found = {}
    for shift in ((-row, col), (row, -col), (-row, -col)):
        shifts = positions.shifts.copy()
        shifts[exposure] = shift
        if shift == (row, col) or np.any(np.ptp(shifts, axis=0) >= sizes):
            continue
        words = (
            f"{exposures.name_of(exposure)} fits better at the shift ({shift[0] + 0.0:g}, "
            f"{shift[1] + 0.0:g}) than at ({row:g}, {col:g}): check its signs"
        )
        found[words] = exposures.at(dataclasses.replace(positions, shifts=shifts)).window(_SIDE)
    return found


def _flipped(
    exposures: Exposures, window: Exposures, exposure: int, axes: tuple[int, ...]
) -> Exposures:
    """Return the window with one exposure flipped, as the camera wrote it, about the middle."""
    values = window.values.copy()
    middle = exposures.middle(_SIDE)
    sizes = enumerate(zip(middle, exposures.shape, strict=True))
    source = tuple(
        slice(size - part.stop, size - part.start) if axis in axes else part
        for axis, (part, size) in sizes
    )
    dark = 0.0 if exposures.dark is None else exposures.dark
    response, dark = (np.broadcast_to(x, exposures.shape) for x in (exposures.response, dark))
    frame = exposures.values[exposure][source] * response[source] + dark[source]
    values[exposure] = (np.flip(frame, axes) - dark[middle]) / response[middle]
    return dataclasses.replace(window, values=values)


_FAR_ABOVE = 4.0
"""Mean square of an exposure over that of others from which it may be flipped: its pattern is then
in its residuals, and a share 1/n of it in those of the others."""


def standing_out(residuals: Floats) -> int | None:
    """Find the exposure whose mean square is far above that of the others; None if none is."""
    mean, _ = mean_squares(residuals)
    worst = int(mean.argmax())
    return worst if mean[worst] > _FAR_ABOVE * float(np.median(mean)) else None


def mean_squares(residuals: Floats) -> tuple[Floats, Array]:
    """Mean square of each exposure, and of how many measurements."""
    count = np.isfinite(residuals).sum(axis=(1, 2))
    return np.nansum(residuals**2, axis=(1, 2)) / np.maximum(count, 1), count

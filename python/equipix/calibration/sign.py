"""Whether the data confirm the sign of the shifts."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from equipix import _native
from equipix._types import Progress, ShiftSign
from equipix.errors import InputError, InsufficientMemoryError, ShiftSignWarning
from equipix.prediction import positions, predictions

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from equipix.uncertainty import Measurements


_MOST_EXPOSURES = 12
"""Exposures that are asked, from first to last: each has a flux to be found."""

_SIGMAS = 6.0
"""Standard deviations √(2/dof) of F that chance does not reach."""

_FEWEST = 1000
"""Degrees of freedom below which F scatters by more than its standard deviation says."""

_WIDE, _LEAST = 4, 80
"""Side of the window in largest shifts, and the pixels that it may have whatever they are."""

_COARSE, _MOST_COARSE = 1e-2, 300
"""Tolerance and most products of the first fits, which tell structure."""

_FINER, _MOST_FINE = 0.3, 100
"""Tolerance, in parts of the noise that is left, and most products of later ones."""

_ROUNDS = 4
"""Of finer fits, and of leaving out what stands far outside."""

_ODD = 30.0
"""Median absolute residuals, 20 standard deviations: no noise, nor the waves of a wrong sign."""

_BLOCK, _MOST = 4, 2 / 3
"""Pixels along a block, and the share of blocks where a fit that is better must be better: what a
grain of dust does to F is more than chance does, but it does it in a few places."""


class _Fit(NamedTuple):
    """What a fit leaves.

    `left` is F for each degree of freedom, `squares` its parts (n, rows, cols), `noise` the root of
    it relative to the signal, `error` the estimated error of M, `stuck` that it did not converge.
    """

    left: float
    freedom: int
    squares: NDArray[Any]
    noise: float
    error: float
    stuck: bool

    @property
    def settled(self) -> bool:
        """Whether F is as good as at its minimum."""
        return self.error <= _FINER * self.noise

    @property
    def least(self) -> float:
        """What `left` counts for: what it may still lose is of the order of Σ w y²·error².

        Measured, it was 80 times less.
        """
        return self.left if self.settled else self.left * (1 - (self.error / self.noise) ** 2)


def shift_sign(
    measured: Measurements,
    shifts: NDArray[Any],
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> ShiftSign:
    """Compare the fit with the shifts as given to that with d → −d; warn if the latter is better.

    Parameters
    ----------
    measured : Measurements
        The measurements, their weights, and the fluxes to start from.
    shifts : ndarray, shape (n, 2)
        The shifts (row, col) as they were given, in pixels.
    workers : int, optional
        Number of threads.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` now and then.

    Returns
    -------
    {"confirmed", "contradicted", "undetermined"}
        The sign with the lower F, if F is lower by more than 6·√(2/dof) of itself, and in two
        thirds of all blocks of 4×4 pixels.

    Warns
    -----
    ShiftSignWarning
        If the data contradict the sign.

    Notes
    -----
    F/dof has the standard deviation √(2/dof) of itself. Fluxes are free in both fits, since what
    reversed shifts leave of a smooth beam looks like a drifting lamp; of a Gaussian one nothing is
    left: ln L is quadratic, and with 1/L for L, M·L² for M and fluxes to match they fit as well.

    F is known where the estimated error of M is below 0.3 of the relative noise that the fit leaves
    (it was then at most 2e-4 of itself above its minimum); else it counts less by the square of
    error over noise. That is asked of the higher F alone; one that is lower before its end is lower
    still at it. What one of the fits leaves far outside the
    others, such as dust, is left out of both.
    """
    asked = np.unique(np.linspace(0, len(shifts) - 1, _MOST_EXPOSURES).round().astype(int))
    shifts = shifts[asked]
    window = _Window.cut(measured, asked, _side(measured, asked, shifts))
    if len(shifts) < 3 or (len(shifts) - 2) * window.values[0].size < _FEWEST:
        return "undetermined"
    try:
        fits = _fits(window, shifts, workers, progress)
    except (InputError, InsufficientMemoryError):
        # All arguments are good for the whole sensor: the window has too little light or room.
        return "undetermined"
    lower = _lower(fits)
    if lower is None:
        return "undetermined"
    if lower == 0:
        return "confirmed"
    warnings.warn(
        "the data contradict the sign of the shifts: reversed, with free fluxes, they leave "
        f"{fits[1].left / fits[0].left:.2g} times the squared residuals; a shift grows when the "
        "sensor moves towards larger rows and columns: give 'shifts' of the other sign, or "
        "exchange the images of the aperture before and after the moves",
        ShiftSignWarning,
        stacklevel=3,
    )
    return "contradicted"


def _side(measured: Measurements, asked: NDArray[Any], shifts: NDArray[Any]) -> int:
    """Pixels along the window: some four times the largest shift s.

    Where that is many it is as small as leaves half a measurement a pixel to judge by:
    (n − 1)·w² − (w + s)² ≥ w²/2, the cells being at most (w + s)². 0 if nothing moves.
    """
    # Where the sensor's middle looks: a quarter turn exchanges its coordinates.
    turned = np.array(measured.rotation)[asked] % 180 == 90
    middle = (np.array(measured.frames.shape[1:]) - 1) / 2
    middles = np.where(turned[:, None], middle[::-1], middle)
    reach = max(float(np.ptp(middles + sign * shifts, axis=0).max()) for sign in (1, -1))
    enough: float = reach / (max(len(shifts) - 1.5, 1.5) ** 0.5 - 1)
    return round(min(_WIDE * reach, max(_LEAST, enough)))


def _fits(
    window: _Window, shifts: NDArray[Any], workers: int | None, progress: Progress | None
) -> list[_Fit]:
    """The fits with the shifts as given and with all of them reversed, as fine as it takes."""

    def fit(k: int) -> _Fit:
        return window.fit((shifts, -shifts)[k], noises[k], workers, progress)

    noises: list[float | None] = [None, None]
    fits = [fit(0), fit(1)]
    for _ in range(_ROUNDS):
        odd = _odd(fits)
        if odd.any():
            window = window.without(odd)
            fits = [fit(0), fit(1)]
            continue
        unsettled = [k for k in (0, 1) if not (fits[k].settled or fits[k].stuck)]
        if not unsettled or _lower(fits) is not None:
            break
        for k in unsettled:
            noises[k] = fits[k].noise
            fits[k] = fit(k)
    return fits


def _lower(fits: list[_Fit]) -> int | None:
    """Which fit has the lower F, if the other's is known and far above it, in most places."""
    freedom = min(fit.freedom for fit in fits)
    lower = int(fits[1].left < fits[0].left)
    low, high = fits[lower], fits[1 - lower]
    if freedom < _FEWEST or high.noise == 0:
        return None
    # So that NaN decides nothing.
    if not high.least > (1 + _SIGMAS * (2 / freedom) ** 0.5) * low.left:
        return None
    excess = high.squares - low.squares
    blocks = _sums_of_blocks(np.nansum(excess, axis=0))
    measured = _sums_of_blocks(np.isfinite(excess).any(axis=0).astype(int)) > 0
    return lower if np.mean(blocks[measured] > 0) > _MOST else None


def _sums_of_blocks(image: NDArray[Any]) -> NDArray[Any]:
    """Sums over blocks of `_BLOCK` pixels square."""
    for axis, size in enumerate(image.shape):
        image = np.add.reduceat(image, np.arange(0, size, _BLOCK), axis=axis)
    return image


def _odd(fits: list[_Fit]) -> NDArray[np.bool_]:
    """Which measurements one of the fits leaves far outside the others, such as of dust."""
    limits = [_ODD**2 * np.nanmedian(fit.squares) for fit in fits]
    odd: NDArray[np.bool_] = np.any(
        [fit.squares > limit for fit, limit in zip(fits, limits, strict=True)], axis=0
    )
    return odd


class _Window(NamedTuple):
    """The central part of the measurements, and how its places follow from those of the whole."""

    values: NDArray[Any]
    variance: NDArray[Any] | None
    mask: NDArray[np.bool_] | None
    flux: list[float]
    rotation: list[int]
    corners: NDArray[np.int64]

    @classmethod
    def cut(cls, measured: Measurements, asked: NDArray[Any], side: int) -> _Window:
        """The central pixels of the exposures asked, at most `side` along each axis."""
        shape = np.array(measured.frames.shape[1:])
        sizes = np.minimum(shape, side)
        first = (shape - sizes) // 2
        last = shape - sizes - first
        rows, cols = (slice(a, a + size) for a, size in zip(first, sizes, strict=True))
        part = (..., rows, cols)
        variance, mask = measured.variance, measured.mask
        if variance is not None:
            variance = (variance[part] if variance.ndim == 3 else variance)[asked]
        if mask is not None:
            mask = mask[part][asked] if mask.ndim == 3 else np.ascontiguousarray(mask[part])
        rotation = np.array(measured.rotation)[asked].tolist()
        # A p₀ + t of the sensor less t of the window: the window's corner at shift 0.
        corners = {
            0: first,
            90: (first[1], last[0]),
            180: last,
            270: (last[1], first[0]),
        }
        return cls(
            np.ascontiguousarray(measured.frames[part][asked]),
            variance,
            mask,
            np.array(measured.flux)[asked].tolist(),
            rotation,
            np.array([corners[turn] for turn in rotation]),
        )

    def without(self, odd: NDArray[np.bool_]) -> _Window:
        """The same without some measurements."""
        return self._replace(mask=odd if self.mask is None else odd | self.mask)

    def fit(
        self,
        shifts: NDArray[Any],
        noise: float | None,
        workers: int | None,
        progress: Progress | None,
    ) -> _Fit:
        """Fit beam and sensitivity, with free fluxes: coarsely, or finer than that noise."""
        places = shifts + self.corners
        places -= np.floor(places.min(axis=0))
        tolerance = _COARSE if noise is None else max(_FINER * noise, np.finfo(float).eps)
        solution = _native.calibrate_frames(
            self.values,
            places.astype(np.float64),
            shift_std=None,
            rotation=self.rotation,
            flux=self.flux,
            flux_model=("fit", []),
            offset=False,
            variance=self.variance,
            mask=self.mask,
            method="multiscale",
            tolerance=tolerance,
            max_sweeps=_MOST_COARSE if noise is None else _MOST_FINE,
            workers=workers,
            progress=None if progress is None else _as_check(progress),
        )
        freedom = solution.degrees_of_freedom
        left = solution.misfit / max(freedom, 1)
        return _Fit(
            left,
            freedom,
            self._squares(solution),
            (left / self._power()) ** 0.5,
            float(solution.error_estimate[-1]),
            solution.ended != "converged",
        )

    def _squares(self, solution: _native.Solution) -> NDArray[Any]:
        """Weighted squares of residuals; NaN where nothing is measured or predicted."""
        shifts, flux = np.array(solution.shifts), np.array(solution.flux)
        places = positions(solution.beam_origin, shifts, np.array(self.rotation), flux)
        frames = predictions(solution.sensitivity, solution.beam, places)
        return self._weighted(np.square(self.values - np.array(list(frames))))

    def _power(self) -> float:
        """Mean of w y² over the measurements used."""
        return float(np.nanmean(self._weighted(np.square(self.values, dtype=np.float64))))

    def _weighted(self, squares: NDArray[Any]) -> NDArray[Any]:
        """Squares by their variances; NaN where nothing is measured."""
        used = np.isfinite(squares)
        if self.mask is not None:
            used &= ~self.mask
        variance = self.variance
        if variance is None:
            scale = np.ones(1)
        else:
            scale = variance if variance.ndim == 3 else variance[:, None, None]
        weighted = np.full(squares.shape, np.nan)
        np.divide(squares, scale, out=weighted, where=used)
        return weighted


def _as_check(progress: Progress) -> Progress:
    """Progress under a name of its own."""
    return lambda done, total, _: progress(done, total, "sign of shifts")

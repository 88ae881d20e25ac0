"""Orientations that leave no residual: what their fluxes say, and how far their M are apart.

In a smooth beam the shifts in another orientation fit with other fluxes and another M. The fluxes
that were given may exclude it, or the orientation as given.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix.calibration.significance import chi2_tail
from equipix.drift import affine_columns
from equipix.exposures.orientation import Orientation

if TYPE_CHECKING:
    from collections.abc import Mapping

    from equipix._types import Array, Floats
    from equipix.calibration.window_fit import WindowFit
    from equipix.exposures.exposures import Exposures
    from equipix.exposures.flux import Flux
    from equipix.exposures.positions import Positions

_RARE = 1e-3
"""Probability of such fluxes below which an orientation does not agree with those given."""

_SMALLER = 0.1
"""How far off its fluxes are, relative to those of the orientation as given, where it is likely."""

_ABOVE = 3.0
"""How many times the noise of a pixel a difference of M must be to be said."""

_PLACES = 33
"""Places along each side of the sensor where the difference of M is evaluated."""


class Hidden(NamedTuple):
    """Another orientation that fits equally well.

    `difference` is the rms difference of its ln M over the sensor, and `is_likely` says whether its
    fluxes agree with those given while those of the orientation as given do not.
    """

    hidden: Orientation
    difference: float
    is_likely: bool


class _Fluxes(NamedTuple):
    """How far fluxes are from those given, rms, and whether they agree with them."""

    distance: float
    agree: bool


def hidden(
    fits: Mapping[Orientation, WindowFit],
    windows: Mapping[Orientation, Exposures],
    flux: Flux,
    shape: tuple[int, int],
) -> Hidden | None:
    """Find the orientation that no measurement excludes and whose M is farthest from that as given.

    Parameters
    ----------
    fits, windows : mapping
        Fits with free fluxes in the orientations that their residuals do not exclude, the one as
        given among them, and what was fitted.
    flux : Flux
        The fluxes that were given for these exposures.
    shape : tuple of int
        Sizes of the sensor (rows, cols).

    Returns
    -------
    Hidden or None
        The likely one if there is one. Else, where fluxes are free or have a prior, one that agrees
        with it; None where M is the same in all of them within its noise.
    """
    given = Orientation()
    fluxes = {way: _fluxes(fit, windows[way], flux) for way, fit in fits.items()}
    others = [way for way in fits if way != given]
    likely = [way for way in others if _is_likely(fluxes[way], fluxes[given])]
    if likely:
        best = min(likely, key=lambda way: fluxes[way].distance)
        return Hidden(best, _difference(fits[best], fits[given], shape)[0], is_likely=True)
    if flux.kind not in ("fit", "prior"):
        return None
    found = [
        Hidden(way, size, is_likely=False)
        for way in others
        if fluxes[way].agree
        for size, noise in [_difference(fits[way], fits[given], shape)]
        if size > _ABOVE * noise
    ]
    return max(found, key=lambda each: each.difference, default=None)


def _is_likely(other: _Fluxes, given: _Fluxes) -> bool:
    """Whether other fluxes agree with those given, and those of the shifts as given do not."""
    return not given.agree and other.distance < _SMALLER * given.distance


def _fluxes(fit: WindowFit, window: Exposures, flux: Flux) -> _Fluxes:
    """Compare fitted fluxes with those given, without what the shifts leave undetermined."""
    if flux.kind == "fit":
        return _Fluxes(0.0, agree=True)
    columns = _undetermined(window.positions, flux)
    deviations = np.log(np.array(fit.fit.flux) / flux.values)
    rest = deviations - columns @ np.linalg.lstsq(columns, deviations, rcond=None)[0]
    freedom = len(rest) - int(np.linalg.matrix_rank(columns))
    if freedom < 1:
        return _Fluxes(0.0, agree=True)
    pixels = np.isfinite(fit.residuals).sum(axis=(1, 2)).mean()
    # Without noise there is rounding.
    error = max(fit.noise / np.sqrt(pixels), np.finfo(float).eps)
    std = np.hypot(error, 0.0 if flux.std is None else flux.std)
    agree = chi2_tail(float(np.sum((rest / std) ** 2)), freedom) >= _RARE
    return _Fluxes(float(np.sqrt(rest @ rest / freedom)), agree)


def _undetermined(positions: Positions, flux: Flux) -> Floats:
    """Combinations of ln c (n, columns) that leave no residual or belong to a trend."""
    if len(set(positions.rotation.tolist())) > 1:
        return np.ones((len(positions), 1))
    return affine_columns(positions.shifts, flux.time)


def _difference(one: WindowFit, other: WindowFit, shape: tuple[int, int]) -> tuple[float, float]:
    """Rms difference of ln M over the sensor, by its quadratic part, and the error of a pixel.

    Where an orientation is not determined ln L is quadratic, and so is the difference of ln M. The
    window is in the middle of the sensor: there both have their origin. The second is that of
    noise or of the solver.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        difference = np.log(one.fit.sensitivity / other.fit.sensitivity)
    window = difference.shape
    known = np.isfinite(difference).ravel()
    extent = np.array(shape) / window
    columns = _powers(window, np.ones(2))[known]
    found = np.linalg.lstsq(columns, difference.ravel()[known], rcond=None)[0]
    # A sensor may have many pixels, and a quadratic needs few.
    bend = _powers((_PLACES, _PLACES), extent)[:, 3:] @ found[3:]
    noise = other.noise / (len(other.residuals) - 1) ** 0.5
    return float(bend.std()), max(noise, one.error, other.error) * float(extent.prod())


def _powers(counts: tuple[int, ...], extent: Array) -> Floats:
    """1, r, c, r², r c and c² (places, 6) on a grid of that extent about the middle."""
    sides = zip(counts, extent.tolist(), strict=True)
    r, c = (np.linspace(-half, half, count) for count, half in sides)
    rows, cols = (each.ravel() for each in np.meshgrid(r, c, indexing="ij"))
    return np.stack([np.ones(rows.size), rows, cols, rows**2, rows * cols, cols**2], axis=1)

"""Photons of a black body within a band, and the cut-off wavelength of HgCdTe."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from equipix._types import Floats

_SECOND_RADIATION = 14387.768775
"""hc/k in µm K."""

_EV_UM = 1.239841984
"""hc in eV µm."""

_STEPS = 2048
"""Intervals of the integral over the wavelength; Simpson's rule errs by less than 1e-9 of it."""


def photon_exitance(wavelength_um: ArrayLike, temperature_k: float) -> Floats:
    """Photons of a black body per second, area and wavelength, up to a constant factor.

    Parameters
    ----------
    wavelength_um : array_like
        Wavelength λ in µm.
    temperature_k : float
        Temperature T in kelvin.

    Returns
    -------
    ndarray, float64
        Number λ⁻⁴ / (exp(hc/λkT) − 1), λ in µm: Planck's law over the energy of a photon.
    """
    wavelength = np.asarray(wavelength_um, np.float64)
    return np.asarray(wavelength**-4 / np.expm1(_SECOND_RADIATION / (wavelength * temperature_k)))


def band_photons(start_um: float, cutoff_um: ArrayLike, temperature_k: float) -> Floats:
    """Photons of a black body from a wavelength to each of many cut-off wavelengths.

    Parameters
    ----------
    start_um : float
        Shortest wavelength, such as the edge of a filter, in µm.
    cutoff_um : array_like
        Longest wavelength of each pixel, in µm.
    temperature_k : float
        Temperature in kelvin.

    Returns
    -------
    ndarray, of the shape of `cutoff_um`
        ∫ of `photon_exitance` from start to cut-off, per µm³.

    Raises
    ------
    InputError
        If a number is not finite and above 0, or a cut-off below the start.

    Notes
    -----
    Simpson's rule in 2048 intervals up to the longest cut-off, and in the part of an interval that
    a cut-off leaves. The spread of the cut-offs does not matter.

    Examples
    --------
    >>> from equipix.simulate import blackbody
    >>> low, high = blackbody.band_photons(3.0, 5.1, 290.0), blackbody.band_photons(3.0, 5.1, 310.0)
    >>> round(float(high / low), 2)
    2.03
    """
    cutoff = np.asarray(cutoff_um, np.float64)
    for name, values in (("start_um", start_um), ("temperature_k", temperature_k)):
        if not 0 < values < np.inf:
            raise InputError(f"'{name}' is {values!r}, expected a finite number above 0")
    wrong = cutoff[~((cutoff >= start_um) & (cutoff < np.inf))]
    if wrong.size:
        raise InputError(f"'cutoff_um' holds {wrong.flat[0]:g}, expected {start_um:g} or more")
    ends = np.linspace(start_um, float(cutoff.max()), _STEPS + 1)
    below = np.concatenate([[0.0], np.cumsum(_integral(ends[:-1], ends[1:], temperature_k))])
    interval = np.clip(np.searchsorted(ends, cutoff, side="right") - 1, 0, _STEPS - 1)
    return np.asarray(below[interval] + _integral(ends[interval], cutoff, temperature_k))


def _integral(start: Floats, end: Floats, temperature_k: float) -> Floats:
    """Simpson's rule over one short interval each."""
    ends = photon_exitance(start, temperature_k) + photon_exitance(end, temperature_k)
    middle = photon_exitance((start + end) / 2, temperature_k)
    return np.asarray((end - start) / 6 * (ends + 4 * middle))


def hgcdte_cutoff(composition: ArrayLike, temperature_k: float = 77.0) -> Floats:
    """Cut-off wavelength of Hg₁₋ₓCdₓTe, in µm.

    Parameters
    ----------
    composition : array_like
        Fraction x of Cd, 0.15 to 0.5.
    temperature_k : float
        Temperature of the detector in kelvin.

    Returns
    -------
    ndarray, float64
        Wavelength hc/E_g with the band gap E_g in eV.

    Notes
    -----
    E_g = −0.302 + 1.93x − 0.81x² + 0.832x³ + 5.35e-4·T·(1 − 2x) [1]_.

    References
    ----------
    .. [1] G. L. Hansen, J. L. Schmit, T. N. Casselman, "Energy gap versus alloy composition and
       temperature in Hg1−xCdxTe", Journal of Applied Physics 53 (1982) 7099-7101.

    Examples
    --------
    >>> from equipix.simulate import blackbody
    >>> round(float(blackbody.hgcdte_cutoff(0.225)), 1)
    10.0
    """
    x = np.asarray(composition, np.float64)
    gap = -0.302 + 1.93 * x - 0.81 * x**2 + 0.832 * x**3 + 5.35e-4 * temperature_k * (1 - 2 * x)
    return np.asarray(_EV_UM / gap)

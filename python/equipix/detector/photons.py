"""Photons of black bodies, cut-off of HgCdTe, heat of a bias pulse."""

from collections.abc import Callable

import numpy as np

from equipix._check import ArrayLike, Floats, number, positive
from equipix.errors import InputError

_SECOND_RADIATION = 14387.768775
"""hc/k in µm K."""

EV_UM = 1.239841984
"""hc in eV µm."""

_GAP, _GAP_PER_K = (-0.302, 1.93, -0.81, 0.832), 5.35e-4
"""Coefficients of the band gap of HgCdTe in eV by powers of x, and of T(1 − 2x) in eV/K."""

LARGEST_X = 0.6
"""Largest composition to which the band gap was fitted, besides CdTe itself."""

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


def band_photons(
    start_um: float,
    cutoff_um: ArrayLike,
    temperature_k: float,
    *,
    response: Callable[[Floats], Floats] | None = None,
) -> Floats:
    """Photons of a black body from a wavelength to each of many cut-off wavelengths.

    Parameters
    ----------
    start_um : float
        Shortest wavelength, such as the edge of a filter, in µm.
    cutoff_um : array_like
        Longest wavelength of each pixel, in µm.
    temperature_k : float
        Temperature in kelvin.
    response : callable, optional
        Factor at each wavelength in µm, such as the transmission of a filter; 1 unless given. It
        must be smooth over a two-thousandth of the band.

    Returns
    -------
    ndarray, of the shape of `cutoff_um`
        ∫ of `photon_exitance` times `response` from start to cut-off, per µm³.

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
    >>> from equipix.detector import photons
    >>> low, high = photons.band_photons(3.0, 5.1, 290.0), photons.band_photons(3.0, 5.1, 310.0)
    >>> round(float(high / low), 2)
    2.03
    """
    cutoff = np.asarray(cutoff_um, np.float64)
    positive("start_um", start_um)
    positive("temperature_k", temperature_k)
    wrong = cutoff[~((cutoff >= start_um) & (cutoff < np.inf))]
    if wrong.size:
        raise InputError(f"'cutoff_um' holds {wrong.flat[0]:g}, expected {start_um:g} or more")
    ends = np.linspace(start_um, float(cutoff.max()), _STEPS + 1)

    def integrand(wavelength: Floats) -> Floats:
        photons = photon_exitance(wavelength, temperature_k)
        return photons if response is None else photons * response(wavelength)

    below = np.concatenate([[0.0], np.cumsum(_integral(integrand, ends[:-1], ends[1:]))])
    interval = np.clip(np.searchsorted(ends, cutoff, side="right") - 1, 0, _STEPS - 1)
    return np.asarray(below[interval] + _integral(integrand, ends[interval], cutoff))


def _integral(integrand: Callable[[Floats], Floats], start: Floats, end: Floats) -> Floats:
    """Simpson's rule over one short interval each."""
    ends = integrand(start) + integrand(end)
    return np.asarray((end - start) / 6 * (ends + 4 * integrand((start + end) / 2)))


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
    >>> from equipix.detector import photons
    >>> round(float(photons.hgcdte_cutoff(0.225)), 1)
    10.0
    """
    return np.asarray(EV_UM / hgcdte_gap(composition, temperature_k))


def hgcdte_gap(composition: ArrayLike, temperature_k: float = 77.0) -> Floats:
    """Band gap of Hg₁₋ₓCdₓTe in eV; parameters and formula are those of `hgcdte_cutoff`.

    Parameters
    ----------
    composition : array_like
        Fraction x of Cd.
    temperature_k : float
        Temperature of the detector in kelvin.

    Returns
    -------
    ndarray, float64
        Band gap E_g in eV.
    """
    x = np.asarray(composition, np.float64)
    gap = _GAP[0] + x * (_GAP[1] + x * (_GAP[2] + x * _GAP[3]))
    return np.asarray(gap + _GAP_PER_K * temperature_k * (1 - 2 * x))


def hgcdte_composition(cutoff_um: float, temperature_k: float = 77.0) -> float:
    """Fraction x of Cd at which Hg₁₋ₓCdₓTe has a cut-off wavelength.

    Parameters
    ----------
    cutoff_um : float
        Cut-off wavelength in µm.
    temperature_k : float
        Temperature of the detector in kelvin, below 1000.

    Returns
    -------
    float
        The real root of the cubic of `hgcdte_cutoff`; the gap rises with x, so there is one.

    Raises
    ------
    InputError
        If no x from 0 to 0.6, where the formula holds, has this cut-off.

    Examples
    --------
    >>> from equipix.detector import photons
    >>> round(photons.hgcdte_composition(10.0), 4)
    0.2254
    """
    low, high = (float(hgcdte_cutoff(x, temperature_k)) for x in (LARGEST_X, 0.0))
    high = high if high > 0 else np.inf  # a gap below 0 has no cut-off
    if not low <= cutoff_um <= high:
        raise InputError(
            f"'cutoff_um' is {cutoff_um!r}, but HgCdTe of x from 0 to {LARGEST_X} at "
            f"{temperature_k:g} K has {low:.3g} µm or more"
        )
    thermal = _GAP_PER_K * temperature_k
    gap = EV_UM / cutoff_um
    constant, linear, square, cube = _GAP
    roots = np.roots([cube, square, linear - 2 * thermal, constant + thermal - gap])
    return float(roots[np.argmin(np.abs(roots.imag))].real)


ZERO_C = 273.15
"""Kelvin at 0 °C."""

_RADIATION = 3.741771852e8
"""First radiation constant 2πhc² in W µm⁴/m²."""

_PULSE_STEPS = 4
"""Runge-Kutta steps of a bias pulse; eight change no temperature by more than 1e-9 K."""


def exitance(band_um: tuple[float, float], kelvin: float) -> float:
    """Power of a black body within a band, per area.

    Parameters
    ----------
    band_um : tuple of float
        Shortest and longest wavelength in µm.
    kelvin : float
        Temperature in kelvin.

    Returns
    -------
    float
        In W/m²: ∫ c₁ λ⁻⁵ / (exp(c₂/λT) − 1) dλ with c₁ = 2πhc².
    """
    per_wavelength = band_photons(*band_um, kelvin, response=lambda wavelength: 1 / wavelength)
    return _RADIATION * float(per_wavelength)


def kelvin_of(name: str, celsius: float) -> float:
    """A temperature in kelvin, checked."""
    kelvin = number(name, celsius) + ZERO_C
    if not 0 < kelvin < np.inf:
        raise InputError(f"'{name}' is {celsius!r} °C, expected more than {-ZERO_C:g} °C")
    return kelvin


def integrated(rate: Callable[[Floats], Floats], start: Floats, duration_s: float) -> Floats:
    """Value after some time, by Runge-Kutta steps of fourth order.

    Parameters
    ----------
    rate : callable
        Change per second of a value.
    start : ndarray
        Value at the beginning.
    duration_s : float
        Time in seconds.

    Returns
    -------
    ndarray
        Value at the end.
    """
    now, step = start, duration_s / _PULSE_STEPS
    for _ in range(_PULSE_STEPS):
        first = rate(now)
        second = rate(now + step / 2 * first)
        third = rate(now + step / 2 * second)
        now = now + step / 6 * (first + 2 * (second + third) + rate(now + step * third))
    return now

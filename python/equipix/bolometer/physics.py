"""Light and heat of a bolometer: power of a black body, and the temperature in a bias pulse."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix._check import number
from equipix.errors import InputError
from equipix.simulate.blackbody import band_photons

if TYPE_CHECKING:
    from collections.abc import Callable

    from equipix._types import Floats

ZERO_C = 273.15
"""Kelvin at 0 °C."""

_RADIATION = 3.741771852e8
"""First radiation constant 2πhc² in W µm⁴/m²."""

_STEPS = 4
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
    now, step = start, duration_s / _STEPS
    for _ in range(_STEPS):
        first = rate(now)
        second = rate(now + step / 2 * first)
        third = rate(now + step / 2 * second)
        now = now + step / 6 * (first + 2 * (second + third) + rate(now + step * third))
    return now

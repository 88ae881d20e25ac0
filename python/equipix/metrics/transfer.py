"""Photon transfer and linearity after EMVA 1288 release 4.0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from equipix._check import as_array, check_type, naming_memory
from equipix.errors import EquipixWarning, InputError, warn
from equipix.metrics.moments import moments, signed_root

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from equipix._types import Bools, Floats
    from equipix.frames import FrameStatistics

_LOWER = 0.05
"""Fall of the signal where the light rises, above which light and levels do not belong together."""

_MOST_EFFICIENT = 1.1
"""Largest quantum efficiency that may be one, with its error: a photon frees one electron."""

_SEQUENCES = (list, tuple, np.ndarray)
"""Types of a sequence of levels: a text, and one average, are none."""

_TRANSFER = 0.7
"""Highest signal, over that at saturation, that counts for gain and responsivity."""

_LINEAR = (0.05, 0.95)
"""Lowest and highest signal, over that at saturation, that count for the linearity."""


@dataclass(frozen=True)
class EmvaTransfer:
    """Gain, noise and linearity of a camera, the result of `emva_transfer`.

    Attributes
    ----------
    gain_dn_per_e : float
        K, slope of the variance over the signal, in DN per electron.
    read_noise_e : float
        Temporal noise of a frame without light, quantisation of 1/12 DN² removed, in electrons;
        with the sign of its variance estimate.
    responsivity : float
        R, slope of the signal over the light, in DN per unit of `light`.
    quantum_efficiency : float
        R/K, where the light is in photons per pixel; NaN, with a warning, where it is above 1.1, so
        that the light is in another unit. Another unit may also make a number below that, which
        nothing shows.
    saturation_dn : float
        Signal, less the dark, at the level of the largest temporal noise.
    linearity_error : float
        Mean of the absolute relative deviations from a line, from 5 to 95 % of saturation.
    """

    gain_dn_per_e: float
    read_noise_e: float
    responsivity: float
    quantum_efficiency: float
    saturation_dn: float
    linearity_error: float


@naming_memory("photon transfer")
def emva_transfer(
    dark: Sequence[ArrayLike | FrameStatistics],
    bright: Sequence[ArrayLike | FrameStatistics],
    light: ArrayLike,
) -> EmvaTransfer:
    r"""Photon-transfer gain, read noise, responsivity and linearity error.

    Parameters
    ----------
    dark, bright : sequence of arrays of shape (n, rows, cols), or of FrameStatistics
        Raw frames without light and with it, two or more at each exposure; as many darks as levels,
        or one for all.
    light : array_like, shape (levels,)
        Light of each level: photons per pixel, or in any unit.

    Returns
    -------
    EmvaTransfer
        K, R, read noise, saturation and linearity error.

    Raises
    ------
    InputError
        If the numbers of levels do not fit, values are not finite, too few levels lie below
        saturation, `dark` is brighter than `bright`, or their light does not differ, or the signal
        falls by more than 5 % where the light rises.

    Warns
    -----
    EquipixWarning
        If the quantum efficiency would be above 1.1: the light is not in photons per pixel.

    Notes
    -----
    With the dark subtracted from mean μ and variance σ², K is the slope of σ² over μ and R that of
    μ over the light, both lines through 0, of levels up to 70 % of saturation. Saturation is the
    level of the largest temporal variance. The line of the linearity error minimises relative
    deviations, Σ (y − a − b·light)²/y² [1]_.

    References
    ----------
    .. [1] European Machine Vision Association, "EMVA Standard 1288", release 4.0 linear, 2021.
    """
    levels = as_array("light", light, ndim=1).astype(np.float64)
    for name, given in (("dark", dark), ("bright", bright)):
        check_type(name, given, _SEQUENCES, "a list of frames or averages, one a level")
    if len(bright) != len(levels) or len(dark) not in (1, len(levels)):
        raise InputError(
            f"'bright' has {len(bright)} levels, 'dark' {len(dark)} and 'light' {len(levels)} "
            "values: expected as many of each, or one 'dark' for all"
        )
    if not (np.isfinite(levels).all() and (levels >= 0).all()):
        wrong = levels[~(np.isfinite(levels) & (levels >= 0))][0]
        raise InputError(f"'light' holds {wrong:g}, expected finite numbers not below 0")
    off = np.array([_mean_and_variance("dark", each) for each in dark])
    on = np.array([_mean_and_variance("bright", each) for each in bright])
    signal, variance = (on - off).T
    _refuse_dark(off[:, 0], on[:, 0])
    largest = int(np.argmax(on[:, 1]))
    saturation = float(signal[largest])
    below = signal <= _TRANSFER * saturation
    linear = (signal >= _LINEAR[0] * saturation) & (signal <= _LINEAR[1] * saturation)
    if np.count_nonzero(linear) < 3 or not (signal[below] > 0).any():
        raise InputError(
            f"'bright': {np.count_nonzero(linear)} levels lie between 5 and 95 % of saturation at "
            f"{saturation:.6g} DN, expected three or more"
        )
    if not np.ptp(levels[linear]) > 0:
        raise InputError(
            f"'light' is {levels[linear][0]:g} at all levels between 5 and 95 % of saturation, "
            "expected values that rise with the signal"
        )
    if not levels[below].any():
        raise InputError("'light' is 0 at all levels up to 70 % of saturation, expected light")
    _refuse_falling(levels, signal, linear)
    gain = _slope(signal[below], variance[below])
    responsivity = _slope(levels[below], signal[below])
    if not gain > 0:
        raise InputError(f"'bright': the noise does not rise with the signal, the gain is {gain:g}")
    read = float(off[:, 1].mean()) - 1 / 12
    return EmvaTransfer(
        gain,
        signed_root(read) / gain,
        responsivity,
        _efficiency(responsivity / gain),
        saturation,
        _linearity_error(levels[linear], signal[linear]),
    )


def _mean_and_variance(name: str, frames: ArrayLike | FrameStatistics) -> tuple[float, float]:
    found = moments(name, frames)
    return float(found.mean.mean()), found.variance


def _refuse_dark(dark: Floats, bright: Floats) -> None:
    """Refuse levels of which none is brighter than its dark: the two are exchanged."""
    if not np.any(bright > dark):
        raise InputError(
            f"'bright' has means up to {bright.max():.6g} DN, 'dark' from {dark.min():.6g} DN: no "
            "level is brighter than its dark, expected light: see that they are not exchanged"
        )


def _refuse_falling(light: Floats, signal: Floats, linear: Bools) -> None:
    """Refuse light that is not that of its levels: a signal that falls where the light rises."""
    order = np.flatnonzero(linear)[np.lexsort((signal[linear], light[linear]))]
    highest = np.maximum.accumulate(signal[order])
    falls = np.flatnonzero(signal[order] < (1 - _LOWER) * highest)
    if falls.size:
        after = order[falls[0]]
        before = order[int(np.argmax(signal[order[: falls[0]]]))]
        raise InputError(
            f"'light' is {light[before]:g} at level {before} and {light[after]:g} at level {after},"
            f" where the signal is {signal[before]:.6g} and {signal[after]:.6g} DN: expected light "
            "that rises with the signal, one value for each level in the order of 'bright'"
        )


def _efficiency(found: float) -> float:
    """Quantum efficiency, unless it is none."""
    if found <= _MOST_EFFICIENT:
        return found
    warn(
        f"'light' gives a quantum efficiency of {found:.4g} (limit {_MOST_EFFICIENT:g}), so it is "
        "NaN: light in photons per pixel and exposure gives one; in another unit the responsivity "
        "is in DN per that unit",
        EquipixWarning,
    )
    return float("nan")


def _slope(x: Floats, y: Floats) -> float:
    """Slope of the least-squares line through 0."""
    return float(x @ y / (x @ x))


def _linearity_error(light: Floats, signal: Floats) -> float:
    """Mean absolute relative deviation from the line of least relative deviations."""
    design = np.stack([1 / signal, light / signal], axis=1)
    (offset, slope), *_ = np.linalg.lstsq(design, np.ones(len(signal)), rcond=None)
    line = offset + slope * light
    return float(np.mean(np.abs(signal - line) / line))

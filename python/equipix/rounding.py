r"""Noise of values that are rounded: what frames show of it, and what they never average out.

A value y = μ + σ n, n normal, is rounded to x, a multiple of q. Where μ is as likely anywhere
between two steps, the error x − y is uniform and does not correlate with n [1]_, so

.. math:: \langle (x - \mu)^2 \rangle = \sigma^2 + q^2/12 .

A part of it is the same in every frame of a pixel, since x has the mean μ + β(μ) with

.. math::
    \beta = \frac{q}{\pi} \sum_{k \ge 1} \frac{(-1)^k}{k} e^{-2\pi^2 k^2 v} \sin(2\pi k\mu/q),
    \qquad
    B = \langle \beta^2 \rangle
      = q^2 \sum_{k \ge 1} \frac{e^{-4\pi^2 k^2 v}}{2\pi^2 k^2} , \qquad v = \sigma^2/q^2 .

So frames scatter by s² = σ² + q²/12 − B, and the mean of n frames is off by s²/n + B.

References
----------
.. [1] B. Widrow, I. Kollár, "Quantization Noise", Cambridge University Press, 2008, chapters
   4 and 5.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

UNIFORM = 1 / 12
"""Variance of a value that is uniform over one step."""

_SMALL = 0.02
"""Variance in squared steps below which series are taken of what is left by Poisson's formula."""

_FINE = 1.0
"""Variance in squared steps above which rounding averages out: B is below 1e-18 there."""

_TERMS = 7
"""Terms of a series: at `_SMALL` the eighth is below 1e-11."""

_GRID = 1001
"""Spreads between 0 and one step that are compared."""

_LEAST_APART = 0.1
"""Least part of B that counts as different between pixels."""

_FEWEST = 8
"""Different values that must all be multiples of a step before it is one."""


def unaveraged(v: ArrayLike) -> NDArray[Any]:
    """Variance B of the rounding that a mean keeps, at noise of variance `v`, both in q².

    Notes
    -----
    Below v = 0.02 the series converges slowly, and Poisson's formula of its derivative in v,
    1 − Σ exp(−m²/4v)/√(4πv), leaves B = 1/12 + v − √(v/π) with an error below 3e-8.
    """
    v = np.asarray(v, np.float64)
    if v.size and v.min() > _FINE:
        return np.zeros(v.shape)
    few = np.maximum(v, _SMALL)
    total = sum(np.exp(-4 * np.pi**2 * k**2 * few) / (2 * np.pi**2 * k**2) for k in _terms())
    return np.asarray(np.where(v < _SMALL, UNIFORM + v - np.sqrt(v / np.pi), total))


def scatter(v: ArrayLike) -> NDArray[Any]:
    """Mean variance s² between frames at noise of variance `v`, both in q²."""
    v = np.asarray(v, np.float64)
    return np.asarray(v + UNIFORM - unaveraged(v))


def scatter_slope(v: ArrayLike) -> NDArray[Any]:
    """Derivative of `scatter`; infinite at 0."""
    v = np.asarray(v, np.float64)
    few = np.maximum(v, _SMALL)
    total = 1 + 2 * sum(np.exp(-4 * np.pi**2 * k**2 * few) for k in _terms())
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(v < _SMALL, 0.5 / np.sqrt(np.pi * v), total))


def largest_scatter(v: ArrayLike) -> NDArray[Any]:
    """Variance between frames of a pixel half-way between two steps, where it is largest, in q².

    Notes
    -----
    There the mean of x is μ, and ⟨(x − μ)²⟩ = v + 1/12 + Σ exp(−2π²k²v) (1/(π²k²) + 4v). Below
    v = 0.02 only two values occur: 1/4.
    """
    v = np.asarray(v, np.float64)
    if v.size and v.min() > _FINE:
        return np.asarray(v + UNIFORM)
    few = np.maximum(v, _SMALL)
    waves = sum(
        np.exp(-2 * np.pi**2 * k**2 * few) * (1 / (np.pi * k) ** 2 + 4 * few) for k in _terms()
    )
    return np.asarray(np.where(v < _SMALL, 0.25, few + UNIFORM + waves))


def unaveraged_apart(v: float, between: float, of_noise: float) -> float:
    """Part of B that differs between pixels whose means are less than a step apart, in q².

    Parameters
    ----------
    v : float
        Variance of the noise of one frame.
    between : float
        Variance of the means between pixels.
    of_noise : float
        Part of it that is noise of the means.

    Returns
    -------
    float
        At least a tenth of B: means that are all equal do not show how far apart the light was.

    Notes
    -----
    Over pixels whose light is spread normally by w, β has the mean that it has at a noise of v + w.
    That part, B(v + w) on average, is common to them, and B(v) − B(v + w) is left. The means are
    spread by w + B(v) − B(v + w) and their noise, which gives w.
    """
    w = np.linspace(0, 1, _GRID) ** 2
    whole = float(unaveraged(v))
    left = whole - unaveraged(v + w)
    return max(_LEAST_APART * whole, float(np.interp(between - of_noise, w + left, left)))


def step_of(values: NDArray[Any]) -> float:
    """Step of which all values are multiples: 0 of values that are not whole, else 1 or more.

    Parameters
    ----------
    values : ndarray
        Values of frames, or their sums over frames.

    Returns
    -------
    float
        The greatest common divisor of the whole numbers; 1 of less than eight different ones,
        which may have one by chance.
    """
    known = values[np.isfinite(values)]
    whole = np.rint(known)
    rounding = 4 * np.finfo(np.float64).eps * np.abs(known) + 1e-9
    # Beyond some 5e14 a float64 does not tell whether it is whole.
    if not known.size or np.any((np.abs(known - whole) > rounding) | (rounding > 0.5)):
        return 0.0
    different = np.unique(whole)
    if len(different) < _FEWEST:
        return 1.0
    return float(np.gcd.reduce(different.astype(np.int64)))


def _terms() -> range:
    return range(1, _TERMS + 1)

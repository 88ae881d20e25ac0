"""Spatial non-uniformity after EMVA 1288 release 4.0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix._check import naming_memory, number
from equipix.errors import InputError
from equipix.metrics.moments import Moments, moments, signed_root

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from equipix._types import Floats
    from equipix.frames import FrameStatistics

_BOXES = (7, 11)
"""Widths of the running means of the high-pass."""


class Split(NamedTuple):
    """A non-uniformity and its parts, each with the sign of its variance estimate."""

    total: float
    row: float
    column: float
    pixel: float


@dataclass(frozen=True)
class EmvaSpatial:
    """Non-uniformity of a camera, the result of `emva_spatial`.

    Attributes
    ----------
    dsnu : Split
        Dark signal non-uniformity, of unfiltered images: in electrons where the gain is given,
        else in DN.
    prnu : Split
        Photo response non-uniformity relative to the mean signal; of high-passed images, unless
        these were not wanted.
    dark_mean, bright_mean : float
        Means of the two levels, in DN.
    """

    dsnu: Split
    prnu: Split
    dark_mean: float
    bright_mean: float


@naming_memory("EMVA 1288 non-uniformity")
def emva_spatial(
    dark: ArrayLike | FrameStatistics,
    bright: ArrayLike | FrameStatistics,
    *,
    gain_dn_per_e: float | None = None,
    highpass: bool = True,
) -> EmvaSpatial:
    r"""DSNU and PRNU with their parts by rows, columns and pixels.

    Parameters
    ----------
    dark, bright : array_like of shape (n, rows, cols), or FrameStatistics
        Raw frames without light, and at half of saturation; release 4.0 wants 100 or more of each.
    gain_dn_per_e : float, optional
        Gain K of the camera, in DN per electron: see `emva_transfer`.
    highpass : bool
        Whether the PRNU is that of high-passed images, as release 4.0 wants.

    Returns
    -------
    EmvaSpatial
        Each number has the sign of its variance estimate, so it is never NaN: a part that is
        smaller than its noise, or than the bias below, may be negative.

    Raises
    ------
    InputError
        If the shapes do not fit, values are missing, or there is no light.

    Notes
    -----
    Of the mean of n frames of R rows and C columns, σ² the temporal variance of one frame, the
    variances s² of all values, s²_cav of the column means and s²_rav of the row means are reduced
    by σ²/n, σ²/(nR) and σ²/(nC). With D = RC − R − C [1]_,

    .. math::
       s_{col}^2 = [(RC - R) s_{cav}^2 - C (s^2 - s_{rav}^2)] / D, \quad
       s_{row}^2 = [(RC - C) s_{rav}^2 - R (s^2 - s_{cav}^2)] / D, \quad
       s_{pix}^2 = RC (s^2 - s_{cav}^2 - s_{rav}^2) / D .

    DSNU = s_dark/K; PRNU = √(s²_bright − s²_dark)/(μ_bright − μ_dark). The high-pass subtracts
    running means over 7×7, then 11×11, then 3×3 binomial weights; borders are reflected. The noise
    of the filtered image is taken as that of the unfiltered one: its variance is 1.1 % smaller.

    The parts are the standard's, and not without bias. Where rows, columns and pixels are drawn
    with variances r, c and p, the expectation of s²_pix is lower than p by

    .. math:: RC [r (C - 1) + c (R - 1)] / [D (RC - 1)] \approx r/R + c/C ,

    which makes it negative where lines or stripes prevail; that of s²_col is higher than c by about
    r/R², that of s²_row than r by about c/C². `three_d_noise` has no such bias.

    References
    ----------
    .. [1] European Machine Vision Association, "EMVA Standard 1288, Standard for characterization
       of image sensors and cameras", release 4.0 linear, 2021.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import metrics
    >>> rng = np.random.default_rng(1)
    >>> sensor = 1000 * (1 + 0.01 * rng.standard_normal((60, 80)))
    >>> dark = 50 + rng.standard_normal((32, 60, 80))
    >>> found = metrics.emva_spatial(dark, dark + sensor, highpass=False)
    >>> round(found.prnu.total, 3)
    0.01
    """
    off, on = moments("dark", dark), moments("bright", bright)
    if off.mean.shape != on.mean.shape or min(off.mean.shape) < 2:
        raise InputError(
            f"'bright' has frames of {on.mean.shape}, 'dark' of {off.mean.shape}: expected one "
            "shape of two or more rows and columns"
        )
    signal = float(on.mean.mean() - off.mean.mean())
    if not signal > 0:
        raise InputError(
            f"'bright' has the mean {on.mean.mean():.6g} DN, 'dark' {off.mean.mean():.6g}: "
            "expected more light"
        )
    if gain_dn_per_e is not None and not number("gain_dn_per_e", gain_dn_per_e) > 0:
        raise InputError(f"'gain_dn_per_e' is {gain_dn_per_e!r}, expected a number above 0")
    dsnu = _roots(split_variances(off) / (gain_dn_per_e or 1.0) ** 2)
    filtered = [
        each._replace(mean=high_passed(each.mean)) if highpass else each for each in (on, off)
    ]
    variances = split_variances(filtered[0]) - split_variances(filtered[1])
    prnu = _roots(variances / signal**2)
    return EmvaSpatial(dsnu, prnu, float(off.mean.mean()), float(on.mean.mean()))


def split_variances(found: Moments) -> Floats:
    """Variance over all values, and its parts by rows, columns and pixels, noise removed."""
    rows, cols = found.mean.shape
    noise, size = found.variance / found.frames, rows * cols
    s = found.mean.var(ddof=1) - noise
    cav = found.mean.mean(axis=0).var(ddof=1) - noise / rows
    rav = found.mean.mean(axis=1).var(ddof=1) - noise / cols
    rest = size - rows - cols
    column = ((size - rows) * cav - cols * (s - rav)) / rest
    row = ((size - cols) * rav - rows * (s - cav)) / rest
    pixel = size * (s - cav - rav) / rest
    return np.array([s, row, column, pixel])


def high_passed(image: Floats) -> Floats:
    """Return an image less its running means over 7×7, 11×11 and 3×3 binomial weights."""
    low = image
    for width in _BOXES:
        low = _along_both(low, np.full(width, 1 / width))
    return image - _along_both(low, np.array([0.25, 0.5, 0.25]))


def _along_both(image: Floats, weights: Floats) -> Floats:
    """Weighted running mean along rows and columns; borders are reflected, edge values doubled."""
    half = len(weights) // 2
    for axis in (0, 1):
        pads = [(half, half) if each == axis else (0, 0) for each in (0, 1)]
        padded, size = np.pad(image, pads, mode="symmetric"), image.shape[axis]
        parts = (np.take(padded, range(k, k + size), axis) for k in range(len(weights)))
        image = np.asarray(sum(weight * part for weight, part in zip(weights, parts, strict=True)))
    return image


def _roots(variances: Floats) -> Split:
    return Split(*(signed_root(float(each)) for each in variances))

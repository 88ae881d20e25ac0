"""EMVA 1288: spatial figures, photon transfer, linearity."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from equipix._check import (
    Array,
    ArrayLike,
    Bools,
    Floats,
    as_array,
    check_count,
    check_type,
    naming_memory,
    number,
    one_or_each,
)
from equipix.errors import InputError
from equipix.findings import Finding, say
from equipix.measured.statistics import FrameStatistics
from equipix.metrics.correctability import student_quantile
from equipix.metrics.frame_noise import Moments, moments, signed_root
from equipix.shown import Brief

_BOXES = (7, 11, 2, 2)
"""Widths of the running means of the high-pass: two over 2 are binomial weights over 3."""

_REACH = sum(width - 1 for width in _BOXES) // 2
"""Pixels on each side that a high-passed one depends on."""

_AT_ONCE = 2**18
"""Pixels that are high-passed at once: they stay in the cache of a processor."""


class Split(NamedTuple):
    """A non-uniformity and its parts, each with the sign of its variance estimate."""

    total: float
    row: float
    column: float
    pixel: float

    def __repr__(self) -> str:
        """Short form: the total and its parts."""
        parts = (f"{name} {value:.4g}" for name, value in self._asdict().items())
        return f"<Split: {', '.join(parts)}>"


@dataclass(frozen=True)
class EmvaSpatial(Brief):
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
    frames: ArrayLike | FrameStatistics,
    dark: ArrayLike | FrameStatistics,
    *,
    gain_dn_per_e: float | None = None,
    highpass: bool = True,
) -> EmvaSpatial:
    r"""DSNU and PRNU with their parts by rows, columns and pixels.

    Parameters
    ----------
    frames, dark : array_like of shape (n, rows, cols), or FrameStatistics
        Raw frames at half of saturation, and without light; release 4.0 wants 100 or more of each.
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
    of the filtered image is taken as that of the unfiltered one: its variance is 1.1 % smaller. For
    the same reason the PRNU of a white pattern is 0.6 % too low.

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
    >>> found = metrics.emva_spatial(dark + sensor, dark, highpass=False)
    >>> round(found.prnu.total, 3)
    0.01
    """
    if gain_dn_per_e is not None and not number("gain_dn_per_e", gain_dn_per_e) > 0:
        raise InputError(f"'gain_dn_per_e' is {gain_dn_per_e!r}, expected a number above 0")
    off, on = moments("dark", dark), moments("frames", frames)
    return spatial_of(on, off, gain_dn_per_e or 1.0, highpass=highpass)


def spatial_of(on: Moments, off: Moments, gain: float, *, highpass: bool = True) -> EmvaSpatial:
    """Evaluate moments with light and without; see `emva_spatial`."""
    rows, cols = off.mean.shape
    if off.mean.shape != on.mean.shape or rows * cols <= rows + cols:
        raise InputError(
            f"'frames' are of {on.mean.shape}, 'dark' of {off.mean.shape}: expected one "
            "shape of two or more rows and columns, above 2 x 2"
        )
    dark_mean, bright_mean = float(off.mean.mean()), float(on.mean.mean())
    signal = bright_mean - dark_mean
    if not signal > 0:
        raise InputError(
            f"'frames' have the mean {bright_mean:.6g} DN, 'dark' {dark_mean:.6g}: expected more "
            "light"
        )
    dsnu = _roots(split_variances(off) / gain**2)
    lit, unlit = (
        split_variances(each._replace(mean=high_passed(each.mean)) if highpass else each)
        for each in (on, off)
    )
    prnu = _roots((lit - unlit) / signal**2)
    return EmvaSpatial(dsnu, prnu, dark_mean, bright_mean)


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


def high_passed(image: Array) -> Array:
    """Return an image less its running means over 7×7, 11×11 and 3×3 binomial weights.

    Borders are reflected, edge values doubled. Floating point keeps its precision.
    """
    found = np.empty(image.shape, np.result_type(image, np.float32))
    size, columns = image.shape[0], (_REACH, _REACH)
    band = max(4 * _REACH, _AT_ONCE // image.shape[1])
    for first in range(0, size, band):
        last = min(first + band, size)
        rows = np.arange(first - _REACH, last + _REACH) % (2 * size)
        part = image[np.minimum(rows, 2 * size - 1 - rows)].astype(np.float64)
        low = np.pad(part, ((0, 0), columns), mode="symmetric")
        for width in _BOXES:
            for axis in (0, 1):
                low = _running_mean(low, width, axis)
        found[first:last] = image[first:last] - low
    return found


def _running_mean(image: Floats, width: int, axis: int) -> Floats:
    """Means over `width` rows (axis 0) or columns, of whole windows only."""
    ends = image.shape[axis] - width + 1
    parts = [image[k : k + ends] if axis == 0 else image[:, k : k + ends] for k in range(width)]
    total = parts[0] + parts[1]
    for part in parts[2:]:
        total += part
    total /= width
    return total


def _roots(variances: Floats) -> Split:
    return Split(*(signed_root(float(each)) for each in variances))


_LOWER = 0.05
"""Fall of the signal where the light rises, above which light and levels do not belong together."""

MOST_EFFICIENT = 1.1
"""Largest quantum efficiency that may be one, with its error: a photon frees one electron."""

_SEQUENCES = (list, tuple, np.ndarray)
"""Types of a sequence of levels: a text, and one average, are none."""

TRANSFER = 0.7
"""Highest signal, over that at saturation, that counts for gain and responsivity."""

_LINEAR = (0.05, 0.95)
"""Lowest and highest signal, over that at saturation, that count for the linearity."""

QUANTISED = 0.24
"""Least variance of a dark signal in DN²: below it quantisation hides the noise."""

TIMES = 3
"""Fewest exposure times of which a dark current is determined."""

_HALF = 0.5
"""Largest error of the variance of a dark at the time 0, over its value."""

_CERTAIN = 0.95
"""Probability that an error of a line is not exceeded."""


@dataclass(frozen=True)
class EmvaTransfer(Brief):
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
    line : tuple of float
        Offset in DN and slope of that line.
    saturation_light : float
        Light at saturation: the saturation capacity in photons, where the light is in photons.
    dark_noise_dn : float
        Temporal noise of a frame without light, quantisation included, in DN. Below 0.49 DN
        quantisation hides it: this number and `read_noise_e` then state no more than that they are
        below 0.49 DN and 0.40/K.
    dark_current_mean, dark_current_variance : float
        Electrons per second by the means and by the variances of the darks; NaN of fewer than three
        exposure times, and where it may be 0 by its error of 95 %. By the variances also NaN where
        quantisation hides one.
    """

    gain_dn_per_e: float
    read_noise_e: float
    responsivity: float
    quantum_efficiency: float
    saturation_dn: float
    linearity_error: float
    line: tuple[float, float]
    saturation_light: float
    dark_noise_dn: float
    dark_current_mean: float
    dark_current_variance: float

    @property
    def saturation_e(self) -> float:
        """Saturation capacity in electrons."""
        return self.responsivity / self.gain_dn_per_e * self.saturation_light

    @property
    def _dark_variance(self) -> float:
        """Variance without light that counts, in electrons."""
        return max(self.dark_noise_dn * abs(self.dark_noise_dn), QUANTISED) / self.gain_dn_per_e**2

    @property
    def threshold_e(self) -> float:
        """Absolute sensitivity threshold in electrons: the signal equals its noise."""
        return float(np.sqrt(self._dark_variance + 0.25) + 0.5)

    @property
    def threshold_light(self) -> float:
        """Absolute sensitivity threshold in photons, where the light is in photons."""
        return self.threshold_e * self.gain_dn_per_e / self.responsivity

    @property
    def snr_max(self) -> float:
        """Signal over noise at saturation, of photon noise alone."""
        return float(np.sqrt(self.saturation_e))

    @property
    def dynamic_range(self) -> float:
        """Saturation capacity over absolute sensitivity threshold."""
        return self.saturation_light / self.threshold_light

    def snr(self, light: ArrayLike, dsnu_e: float = 0.0, prnu: float = 0.0) -> Floats:
        """Signal over noise by the model of the camera.

        Parameters
        ----------
        light : array_like
            Light, in the unit of the levels.
        dsnu_e, prnu : float
            Non-uniformity that counts as noise: in electrons, and relative to the signal.

        Returns
        -------
        ndarray, of the shape of `light`
            The ratio.
        """
        electrons = self.responsivity / self.gain_dn_per_e * np.asarray(light, np.float64)
        noise = self._dark_variance + dsnu_e**2 + electrons + (prnu * electrons) ** 2
        return np.asarray(electrons / np.sqrt(noise))


@naming_memory("photon transfer")
def emva_transfer(
    frames: Sequence[ArrayLike | FrameStatistics],
    dark: Sequence[ArrayLike | FrameStatistics],
    light: ArrayLike,
    *,
    exposure_s: ArrayLike | None = None,
) -> EmvaTransfer:
    r"""Photon-transfer gain, read noise, saturation, sensitivity threshold and linearity error.

    Parameters
    ----------
    frames, dark : sequence of arrays of shape (n, rows, cols), or of FrameStatistics
        Raw frames with light and without it, two or more at each exposure; as many darks as levels,
        or one for all.
    light : array_like, shape (levels,)
        Light of each level: photons per pixel, or in any unit.
    exposure_s : array_like, shape (levels,), optional
        Exposure time of each level and its dark, in seconds. Where they determine them, the noise
        without light is that at the time 0, and there is a dark current: see the notes.

    Returns
    -------
    EmvaTransfer
        K, R, read noise, saturation, sensitivity threshold, dynamic range and linearity error.

    Raises
    ------
    InputError
        If the numbers of levels do not fit, values are not finite, too few levels lie below
        saturation, `dark` is brighter than `frames`, or their light does not differ, or the signal
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

    With η = R/K, the noise σ_d without light in electrons and that of quantisation σ_q² = 1/12 DN²

    .. math::
       \mu_{p.min} = \left(\sqrt{\sigma_d^2 + \sigma_q^2/K^2 + 1/4} + 1/2\right) / \eta, \quad
       \mathrm{SNR}_{max} = \sqrt{\eta \mu_{p.sat}}, \quad
       \mathrm{DR} = \mu_{p.sat} / \mu_{p.min} .

    There a variance without light counts as 0.24 DN² at least. The dark current is the slope of
    the means of the darks over the exposure time, divided by K, and that of their variances,
    divided by K². A dark of several levels counts once. A slope counts if its error, of 95 % by
    Student's t, is below its size: otherwise it may as well be 0. The variance at the time 0 counts
    if its error is at most half of it, or 0.12 DN²; otherwise σ_d is that of the darks as they are.
    A negative one is 0 up to twice its error. Beyond that it contradicts the exposure times, and
    `dark_noise_dn` is negative.

    References
    ----------
    .. [1] European Machine Vision Association, "EMVA Standard 1288", release 4.0 linear, 2021.
    """
    levels = as_array("light", light, ndim=1).astype(np.float64)
    for name, given in (("frames", frames), ("dark", dark)):
        check_type(name, given, _SEQUENCES, "a list of frames or averages, one a level")
    if len(frames) != len(levels) or len(dark) not in (1, len(levels)):
        raise InputError(
            f"'frames' has {len(frames)} levels, 'dark' {len(dark)} and 'light' {len(levels)} "
            "values: expected as many of each, or one 'dark' for all"
        )
    if not (np.isfinite(levels).all() and (levels >= 0).all()):
        wrong = levels[~(np.isfinite(levels) & (levels >= 0))][0]
        raise InputError(f"'light' holds {wrong:g}, expected finite numbers not below 0")
    times = None
    if exposure_s is not None:
        times = one_or_each("exposure_s", exposure_s, levels.shape, ndim=(1,))
        check_count("dark", len(dark), len(levels), "value of 'exposure_s'")
    off = np.array([mean_and_variance("dark", each) for each in dark])
    on = np.array([mean_and_variance("frames", each) for each in frames])
    found = transfer_of(on, off, levels, times)
    efficiency = found.responsivity / found.gain_dn_per_e
    if np.isnan(found.quantum_efficiency):
        words = (
            f"'light' gives a quantum efficiency of {efficiency:.4g} (limit {MOST_EFFICIENT:g}), "
            "so it is NaN: light in photons per pixel and exposure gives one; in another unit the "
            "responsivity is in DN per that unit"
        )
        say(Finding("unit", words, "input"))
    return found


def transfer_of(
    on: Floats,
    off: Floats,
    levels: Floats,
    times: Floats | None,
    light: str = "'light'",
    names: Sequence[str] = (),
) -> EmvaTransfer:
    """Evaluate means and variances (levels, 2) with light and without; see `emva_transfer`.

    Messages call the light and the levels as given; without names levels are numbered.
    """
    signal, variance = (on - off).T
    _refuse_dark(off[:, 0], on[:, 0])
    largest = int(np.argmax(on[:, 1]))
    saturation = float(signal[largest])
    below = signal <= TRANSFER * saturation
    linear = linear_levels(signal, saturation)
    if np.count_nonzero(linear) < 3 or not (signal[below] > 0).any():
        darker = np.count_nonzero(signal < 0)
        todo = "add levels from dark to above saturation"
        if 2 * darker > len(signal):
            todo = f"{darker} of {len(signal)} are darker than their dark: give the darks of these"
        raise InputError(
            f"'frames': {np.count_nonzero(linear)} levels lie between 5 and 95 % of saturation at "
            f"{saturation:.6g} DN, expected three or more: {todo}"
        )
    if not np.ptp(levels[linear]) > 0:
        raise InputError(
            f"{light} is {levels[linear][0]:g} at all levels between 5 and 95 % of saturation, "
            "expected values that rise with the signal"
        )
    if not levels[below].any():
        raise InputError(f"{light} is 0 at all levels up to 70 % of saturation, expected light")
    if (falls := _falling(levels, signal, linear, below)) is not None:
        at = [names[k] if names else f"level {k}" for k in falls]
        (weak, strong), (high, low) = levels[falls], signal[falls]
        is_dark = low < _LINEAR[0] * saturation
        raise InputError(
            f"{light} is {weak:g} at {at[0]} and {strong:g} at {at[1]}, where the signal is "
            f"{high:.6g} and {low:.6g} DN: expected light that rises with the signal, one value "
            "for each level"
            + ("" if names else " in the order of 'frames'")
            + (f", and frames with light at {at[1]}" if is_dark else "")
        )
    gain = _slope(signal[below], variance[below])
    responsivity = _slope(levels[below], signal[below])
    if not gain > 0:
        raise InputError(f"'frames': the noise does not rise with the signal, the gain is {gain:g}")
    dark_variance, slopes = float(off[:, 1].mean()), np.full(2, np.nan)
    if times is not None and len(np.unique(times)) >= TIMES:
        slopes, _, at_zero = dark_lines(times, off)
        if off[:, 1].min() < QUANTISED:
            slopes[1], dark_variance = np.nan, float(np.fmin(at_zero, off[:, 1].min()))
        elif np.isfinite(at_zero):
            dark_variance = at_zero
    efficiency = responsivity / gain
    line = _line(levels[linear], signal[linear])
    fitted = line[0] + line[1] * levels[linear]
    return EmvaTransfer(
        gain,
        signed_root(float(dark_variance) - 1 / 12) / gain,
        responsivity,
        efficiency if efficiency <= MOST_EFFICIENT else float("nan"),
        saturation,
        float(np.mean(np.abs(signal[linear] - fitted) / fitted)),
        line,
        float(levels[largest]),
        signed_root(float(dark_variance)),
        float(slopes[0] / gain),
        float(slopes[1] / gain**2),
    )


class DarkLines(NamedTuple):
    """Lines through the means and variances of darks over the exposure time.

    The slopes, NaN where their error of 95 % leaves the sign open; what they are below by that; and
    the variance at the time 0, NaN where its error is too large.
    """

    slopes: Floats
    below: Floats
    at_zero: float


def dark_lines(times: Floats, off: Floats) -> DarkLines:
    """Fit lines to means and variances (levels, 2) of darks at three times or more.

    A dark that serves several levels counts once: repeated, it would be taken for more data.
    """
    _, first = np.unique(np.column_stack([times, off]), axis=0, return_index=True)
    times, off = (each[np.sort(first)] for each in (times, off))
    middle, freedom = times.mean(), len(times) - 2
    spread = np.sum((times - middle) ** 2)
    rise = off - off[0]  # exactly 0, and no slope by rounding, where one dark serves all levels
    slopes = (times - middle) @ rise / spread
    left = rise - rise.mean(axis=0) - np.outer(times - middle, slopes)
    error = np.sqrt(np.sum(left**2, axis=0) / freedom)
    error *= student_quantile((1 + _CERTAIN) / 2, freedom)
    of_slopes = error / np.sqrt(spread)
    known = of_slopes < np.abs(slopes)
    at_zero = float(off[:, 1].mean() - middle * slopes[1])
    of_zero = float(error[1] * np.sqrt(1 / len(times) + middle**2 / spread))
    if -of_zero / _HALF < at_zero < 0:  # 0, by its error
        at_zero = 0.0
    is_known = of_zero <= _HALF * max(abs(at_zero), QUANTISED)
    known_slopes = np.where(known, slopes, np.nan)
    return DarkLines(known_slopes, slopes + of_slopes, at_zero if is_known else float("nan"))


def mean_and_variance(name: str, frames: ArrayLike | FrameStatistics) -> tuple[float, float]:
    """Mean of all values, and temporal variance of one frame."""
    found = moments(name, frames)
    return float(found.mean.mean()), found.variance


def linear_levels(signal: Floats, saturation: float) -> Bools:
    """Levels that count for the linearity."""
    return np.asarray((signal >= _LINEAR[0] * saturation) & (signal <= _LINEAR[1] * saturation))


def _refuse_dark(dark: Floats, bright: Floats) -> None:
    """Refuse levels of which none is brighter than its dark: the two are exchanged."""
    if not np.any(bright > dark):
        raise InputError(
            f"'frames' has means up to {bright.max():.6g} DN, 'dark' from {dark.min():.6g} DN: no "
            "level is brighter than its dark, expected light: see that they are not exchanged"
        )


def _falling(light: Floats, signal: Floats, linear: Bools, below: Bools) -> list[int] | None:
    """Two levels of which the second has more light and less signal, if there are any.

    The first counts for the linearity, the second for that or for the slopes: frames without light
    in place of a bright level do.
    """
    counts = linear | below
    order = np.flatnonzero(counts)[np.lexsort((signal[counts], light[counts]))]
    compared = np.where(linear[order], signal[order], -np.inf)
    falls = np.flatnonzero(signal[order] < (1 - _LOWER) * np.maximum.accumulate(compared))
    if not falls.size:
        return None
    return [int(order[np.argmax(compared[: falls[0]])]), int(order[falls[0]])]


def _slope(x: Floats, y: Floats) -> float:
    """Slope of the least-squares line through 0."""
    return float(x @ y / (x @ x))


def _line(light: Floats, signal: Floats) -> tuple[float, float]:
    """Offset and slope of the line of least relative deviations."""
    design = np.stack([1 / signal, light / signal], axis=1)
    (offset, slope), *_ = np.linalg.lstsq(design, np.ones(len(signal)), rcond=None)
    return float(offset), float(slope)

r"""Averaged frames, their dark, and their light between frames.

Frames of light 1 + δ make a pixel of signal μ scatter by μ² var(δ) besides its noise. The means of
the frames show it. Where a share f of a pixel's samples is missing, frames are means over different
pixels, so samples count there as differences to the first value of their pixel. With N = Σ (1 − f)
samples in the average frame the means have the variance

.. math:: V = \bar\mu^2 \operatorname{var}(\delta) + \sum (1 - f) \sigma^2 / N^2 , \qquad
    \bar\mu = \sum_\text{follow} (1 - f) \mu / N ,

with the signals of the pixels that follow the light.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from equipix._check import Array, Floats, check_maps
from equipix.errors import InputError
from equipix.findings import Finding, Rule
from equipix.io.formats import FrameFile, refuse_saved
from equipix.io.record import Counts, Doubles, Record, read_record
from equipix.io.viewed import Viewed
from equipix.measured.noise import scatter_limit, step_of
from equipix.measured.part import median

_MAPS = ("mean", "variance", "variance_of_mean", "count", "saturated")

_SAMPLED = 4096  # pixels that show the step between values

DARKER = 0.25
"""Share of the dark by which frames are not darker than it: a dark drifts by less."""


@dataclass(frozen=True, eq=False, repr=False)
class FrameStatistics(Record, kind="frame statistics", version=3):
    """Mean and scatter of repeated frames of one scene, as read-only arrays.

    `equipix.average`, experiment.toml and the command line take the file that `save` writes in the
    place of the frames.

    Attributes
    ----------
    mean : ndarray, shape (rows, cols), float64
        Mean of the frames, the dark mean subtracted if there was one, in DN.
    variance : ndarray, shape (rows, cols), float64
        Unbiased sample variance of one frame, in DN²; NaN where fewer than two samples count.
    variance_of_mean : ndarray, shape (rows, cols), float64
        Variance of `mean`, in DN²: ``variance / count``, plus that of the dark mean.
    count : ndarray, shape (rows, cols), uint32
        Number of samples that went into the mean.
    saturated : ndarray, shape (rows, cols), uint32
        Number of samples at or above the saturation level.
    dark : FrameStatistics or None
        The dark frames whose mean was subtracted, where they were given as statistics. They show
        which pixels are hot, and how noisy a frame without light is.
    saturation : float or None
        The level that samples were compared with, in DN; None if there was none.
    raw : bool
        Whether no dark was subtracted from whole numbers, as cameras write them.
    reject : float or None
        The deviation, in standard deviations, beyond which samples were left out; None where all
        count.
    step : float
        Step between the values of the frames, in DN: 1 of whole numbers, 16 of 12 bits that were
        shifted to 16; 0 of values that are not whole.
    light_variance : float or None
        Unbiased variance of the means of the frames over the pixels that are not masked, in DN²:
        that of the light, and of the noise over the number of pixels. Where samples are missing it
        is that of their differences to the first values of their pixels. None of one frame, or
        where it is not known: a saved average does not show it without the pixels of another mask.
    metadata : dict
        Versions, options and times, as JSON values; ``equipix average`` adds the hashes of files.
    findings : tuple of Finding
        What limits the result, where it was asked, as ``equipix average`` does.
    """

    mean: Doubles
    variance: Doubles
    variance_of_mean: Doubles
    count: Counts
    saturated: Counts
    dark: FrameStatistics | None = None
    saturation: float | None = None
    raw: bool = False
    reject: float | None = None
    step: float = 0.0
    light_variance: float | None = None
    metadata: dict[str, Any] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        """Refuse maps of different shapes."""
        super().__post_init__()
        dark = {} if self.dark is None else {"dark": self.dark.mean}
        check_maps("FrameStatistics", self.maps | dark)

    def __repr__(self) -> str:
        """Short form: sizes, number of frames, mean."""
        rows, cols = self.mean.shape
        return (
            f"<FrameStatistics of {rows} x {cols} pixels, {self.count.max()} frames, mean "
            f"{np.nanmean(self.mean):.5g} DN>"
        )

    def viewed(self) -> Viewed:
        """Return the mean with its standard deviation, as other programs show them."""
        flags, std = np.zeros(self.mean.shape, np.uint32), np.sqrt(self.variance_of_mean)
        return Viewed.of("mean", self.mean, flags, std)

    @property
    def maps(self) -> dict[str, Array]:
        """The five maps by their names."""
        return {name: getattr(self, name) for name in _MAPS}


def is_average(file: FrameFile) -> bool:
    """Whether a file holds an average in the place of frames. A calibration is an error."""
    if file.kind not in (None, FrameStatistics.KIND):
        refuse_saved(file.path)
    return file.kind is not None


def saved_shape(path: Path) -> tuple[int, int] | None:
    """Rows and columns of the averages in a file; None of frames. A calibration is an error."""
    if not is_average(FrameFile(path)):
        return None
    rows, cols = read_record(path, FrameStatistics).mean.shape
    return rows, cols


def _step(mean: Array, variance: Array, count: Array) -> float:
    """Step between the values of frames, of a sample of the pixels.

    Sums over frames are multiples of it. Those of a pixel whose frames are equal are multiples of
    their number as well, so there the mean counts.
    """
    sample = np.linspace(0, mean.size - 1, min(mean.size, _SAMPLED)).astype(np.intp)
    means, variances, counts = (each.ravel()[sample] for each in (mean, variance, count))
    return step_of(means * np.where(variances > 0, counts, 1))


def _masked(statistics: FrameStatistics, mask: Array | None) -> FrameStatistics:
    """Return averages without the pixels of a mask."""
    if mask is None:
        return statistics
    kept: Any = {
        name: np.where(mask, values.dtype.type(0 if values.dtype.kind == "u" else np.nan), values)
        for name, values in statistics.maps.items()
    }
    return dataclasses.replace(statistics, **kept)


def subtracted(
    statistics: FrameStatistics, dark: FrameStatistics | Array | None
) -> FrameStatistics:
    """Subtract the mean of a dark; refuse one that does not fit."""
    if dark is None:
        return statistics
    if statistics.dark is not None:
        if isinstance(dark, FrameStatistics) and same_statistics(statistics.dark, dark):
            return statistics
        raise InputError(
            "'frames' is an average from which another dark than 'dark' is subtracted already: "
            "give the frames, or the dark that was subtracted"
        )
    if isinstance(dark, FrameStatistics):
        refuse_subtracted(dark)
    mean = dark.mean if isinstance(dark, FrameStatistics) else dark
    if mean.shape != statistics.mean.shape:
        raise InputError(
            f"'dark' has shape {mean.shape}, expected {statistics.mean.shape} like the frames"
        )
    if not np.isfinite(mean).any():
        raise InputError("'dark' holds no finite number: give the mean of dark frames")
    variance = dark.variance_of_mean if isinstance(dark, FrameStatistics) else 0.0
    return dataclasses.replace(
        statistics,
        mean=statistics.mean - mean,
        variance_of_mean=statistics.variance_of_mean + variance,
        dark=dark if isinstance(dark, FrameStatistics) else None,
        raw=False,
    )


def _on_bright_dark(statistics: FrameStatistics) -> str | None:
    """Say that a dark is not that of the frames, or was subtracted from them before."""
    if statistics.dark is None or not np.isfinite(statistics.mean).any():
        return None
    level, below = median(statistics.dark.mean), -median(statistics.mean)
    if level > 0 and below > DARKER * level:
        return (
            f"the frames are darker than 'dark' by {below:.4g} of {level:.4g} DN in the median "
            f"(limit {DARKER:.0%}): see that frames and dark are not exchanged, and give frames "
            "from which no dark was subtracted"
        )
    return None


SATURATED = "expose less, or correct the level ('saturation', 'bit_depth', average --saturation)"
"""What to do where most pixels reach the saturation level."""

FEWEST_USABLE = 0.5
"""Least share of the pixels that are not masked to measure with."""


def _on_saturation(statistics: FrameStatistics) -> str | None:
    """Say that less than half of the pixels are free of saturation."""
    total, count = map(np.count_nonzero, (statistics.count, statistics.saturated))
    if total - count >= FEWEST_USABLE * total:
        return None
    share = f"{count} of {total} unmasked pixels (limit {1 - FEWEST_USABLE:.0%})"
    return f"{share} reach the saturation level of {statistics.saturation} DN: {SATURATED}"


def _on_light(statistics: FrameStatistics) -> str | None:
    """Say that frames are of several levels of light."""
    light = light_of(statistics)
    if not light.over_noise > STRAY:
        return None
    return f"{light.words} (limit {STRAY:g}): see that all are of one measurement"


AVERAGED: tuple[Rule[FrameStatistics], ...] = (
    Rule("saturation", "input", _on_saturation),
    Rule("bright_dark", "input", _on_bright_dark),
    Rule("light", "misfit", _on_light),
)
"""What is asked of an average."""


def refuse_subtracted(dark: FrameStatistics, place: str = "'dark'") -> None:
    """Refuse as a dark an average that holds no dark level; `place` is for the message."""
    if dark.dark is not None:
        raise InputError(
            f"{place}: its dark was already subtracted; 'dark' needs frames or an average without "
            "a dark"
        )


def same_statistics(one: FrameStatistics | None, other: FrameStatistics | None) -> bool:
    """Whether two averages are the same measurement: one object, or equal to the last bit."""
    if one is None or other is None or one is other:
        return one is other
    pairs = zip(one.maps.values(), other.maps.values(), strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


_LARGEST = 0.5
"""Relative variation up to which frames are those of one light; above, offsets vary."""

STRAY = 10.0
"""Variance in common over that of noise, which only frames of different things have."""


class Light(NamedTuple):
    """Variance that all pixels of some frames have in common."""

    relative: float = 0.0
    """Of the light, over its squared mean."""
    offset: float = 0.0
    """Of all values alike, in DN², where the frames have no light."""
    over_noise: float = 0.0
    """Mean over the pixels, over the variance that is left: noise."""

    def variance(self, signal: Array) -> Floats:
        """Variance that it adds to one frame of a pixel of this signal, in DN²."""
        return np.asarray(self.relative * np.square(signal, dtype=np.float64) + self.offset)

    @property
    def words(self) -> str:
        """What varies, by how much, and over the noise."""
        what = f"offset varies by {self.offset**0.5:.3g} DN"
        if self.relative:
            what = f"light varies by {self.relative**0.5:.2%}"
        return f"the {what} rms between the frames and adds {self.over_noise:.3g} times the noise"


def light_of(frames: FrameStatistics) -> Light:
    """What the means of frames show beyond noise, which passes six standard deviations nowhere.

    Saturated pixels do not follow the light. Of frames from which no dark was subtracted the signal
    holds the dark level.
    """
    count = int(frames.count.max())
    known = np.isfinite(frames.mean) & np.isfinite(frames.variance)
    if frames.light_variance is None or count < 2 or not known.any():
        return Light()
    variance = frames.light_variance
    if known.all() and frames.count.min() == count:  # usually: then no map is made
        samples = float(known.size)
        if variance <= scatter_limit(count) * (float(frames.variance.sum()) / samples) / samples:
            return Light()
    share = np.where(known, frames.count / count, 0)
    samples = float(share.sum())
    scatter = float((share[known] * frames.variance[known]).sum()) / samples
    if variance <= scatter_limit(count) * scatter / samples:
        return Light()
    follows = known & (frames.saturated == 0)
    mean = float((share[follows] * frames.mean[follows]).sum()) / samples
    light = Light(offset=variance)
    if variance < (_LARGEST * mean) ** 2:
        light = Light(relative=variance / mean**2)
    common = float(light.variance(frames.mean[follows]).mean()) if follows.any() else 0.0
    own = max(float(frames.variance[follows].mean()) - common, 1e-3 * common)
    return light._replace(over_noise=common / own)

r"""Light that varies between the frames of one level: what it adds to the scatter of each pixel.

Frames of light 1 + δ make a pixel of signal μ scatter by μ² var(δ) besides its noise. The means of
the frames show it. Where a share f of a pixel's samples is missing, frames are means over different
pixels, so samples count there as differences to the first value of their pixel. With N = Σ (1 − f)
samples in the average frame the means have the variance

.. math:: V = \bar\mu^2 \operatorname{var}(\delta) + \sum (1 - f) \sigma^2 / N^2 , \qquad
    \bar\mu = \sum_\text{follow} (1 - f) \mu / N ,

with the signals of the pixels that follow the light.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix.noise import scatter_limit

if TYPE_CHECKING:
    from equipix._types import Array, Floats
    from equipix.frames import FrameStatistics

_LARGEST = 0.5
"""Relative variation up to which frames are those of one light; above, offsets vary."""

NAMED = 0.1
"""Variance by the light over that of noise, above which it is worth a word."""


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
    def is_large(self) -> bool:
        """Whether noise would be larger by a tenth or more with it."""
        return self.over_noise > NAMED

    @property
    def words(self) -> str:
        """What varies, by how much, and over the noise."""
        what = (
            f"light varies by {self.relative**0.5:.2%}"
            if self.relative
            else (f"offset varies by {self.offset**0.5:.3g} DN")
        )
        return (
            f"the {what} rms between the frames, which adds {self.over_noise:.3g} times the noise"
        )


def light_of(frames: FrameStatistics) -> Light:
    """What the means of frames show beyond noise, which passes six standard deviations nowhere.

    Saturated pixels do not follow the light. Of frames from which no dark was subtracted the signal
    holds the dark level.
    """
    count = int(frames.count.max())
    known = np.isfinite(frames.mean) & np.isfinite(frames.variance)
    if frames.light_variance is None or count < 2 or not known.any():
        return Light()
    share = np.where(known, frames.count / count, 0)
    samples = float(share.sum())
    scatter = float((share[known] * frames.variance[known]).sum()) / samples
    variance = frames.light_variance
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

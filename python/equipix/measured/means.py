"""Averages of exposures or levels, reduced one by one."""

import copy
import dataclasses
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Self

import numpy as np
from numpy.typing import DTypeLike

from equipix._check import EXPOSURES, Array, Bools, Floats, Pixels, Words
from equipix.errors import InputError
from equipix.measured import defects
from equipix.measured.colour import Colours, Filters, mean_rise, pattern_of, planes_of
from equipix.measured.noise import NoiseModel, photon_transfer
from equipix.measured.part import chosen, median, spread
from equipix.measured.saturation import Clipping, clipping_of, highest, refuse_saturated, unclipped
from equipix.measured.statistics import STRAY, FrameStatistics, Light, light_of, same_statistics

_NAMED = 0.1
"""Variance by the light over that of noise, above which it is worth a word."""


@dataclass(kw_only=True, eq=False)
class Averaged:
    """The part of the `FrameStatistics` of each exposure that a calibration needs.

    Attributes
    ----------
    count : int
        Number of exposures.
    dtype : dtype
        Of the mean frames that are kept.
    gain : float, optional
        Gain of the camera where it is known, in DN per electron.
    saturation : float, optional
        Level that was averaged with, in DN, where it is known; for messages.
    saturation_key : str
        What messages call that level.
    words : Words
        What messages call the frames.
    colours : Colours, optional
        Colour filters of the pixels; unless given those that stand out of the first frames.
    values : ndarray, shape (n, rows, cols)
        Mean frames, the dark subtracted; NaN where a sample saturates, which is left out of that
        exposure alone.
    raw : bool
        Whether no dark was subtracted from averages of whole numbers.
    darks : sequence of FrameStatistics
        The dark frames that the darks of the exposures are made of; by default that of the first.
    black : ndarray, shape (rows, cols), or None
        Dark level that was subtracted from all where there are no dark frames, in DN.
    dark : FrameStatistics or None
        The dark that was subtracted from all; None of several.
    frames : list of int
        Number of frames of each exposure.
    names : list of str
        Name of each exposure; empty where it has none.
    step : float
        Largest step between the values of frames, in DN; 0 if they are not whole.
    light : list of Light
        What the variances of each exposure have of light that varied between its frames.
    clipped : Clipping or None
        A saturation level that was not given, if the values show one.
    pedestal : float
        Value from which noise models count the signal, in DN: 0 unless of `counted_from_lowest`.
    """

    count: int
    dtype: DTypeLike = np.float64
    gain: float | None = None
    saturation: float | None = None
    saturation_key: str = "saturation"
    words: Words = EXPOSURES
    colours: Colours | None = None
    darks: Sequence[FrameStatistics] = ()
    black: Array | None = None
    frames: list[int] = field(init=False, default_factory=list)
    names: list[str] = field(init=False, default_factory=list)
    light: list[Light] = field(init=False, default_factory=list)
    raw: bool = field(init=False, default=True)
    step: float = field(init=False, default=0.0)
    clipped: Clipping | None = field(init=False, default=None)
    pedestal: float = field(init=False, default=0.0)
    _is_counted: bool = field(init=False, default=False)
    _first_dark: FrameStatistics | None = field(init=False, default=None)
    _shares: list[tuple[float, ...]] = field(init=False, default_factory=list)
    _of_dark: list[float] = field(init=False, default_factory=list)
    _points: list[Array] = field(init=False, default_factory=list)
    _screened: int = field(init=False, default=0)  # samples of a pixel compared with the others

    @classmethod
    def of(
        cls,
        frames: Sequence[FrameStatistics],
        *,
        words: Words = EXPOSURES,
        colours: Colours | None = None,
    ) -> Self:
        """Reduce the statistics of all exposures."""
        levels = {each.saturation for each in frames}
        saturation = levels.pop() if len(levels) == 1 else None
        averaged = cls(count=len(frames), saturation=saturation, words=words, colours=colours)
        for each in frames:
            averaged.add(each)
        return averaged

    def add(
        self, frames: FrameStatistics, name: str = "", shares: tuple[float, ...] | None = None
    ) -> None:
        """Add the next exposure, which may have a name, and shares of `darks` in its dark.

        Raises
        ------
        InputError
            If it has another shape than the first, another dark, or no finite value that does not
            saturate; with the first exposure, if its dark has none.
        """
        exposure, shape = len(self.frames), frames.mean.shape
        if exposure == 0:
            self._missing = np.zeros(shape, np.uint32)
            self._first_dark = frames.dark
            if not self.darks and frames.dark is not None:
                self.darks = (frames.dark,)
            for dark in self.darks:
                self._refuse_saturated("'dark'", dark)
                self._screen(dark)
                self.step = max(self.step, dark.step)
            self.values = np.empty((self.count, *shape), self.dtype)
            self.variances = np.empty((self.count, *shape), np.float32)
            self.saturated = np.zeros(shape, bool)
            self.always_saturated = np.ones(shape, bool)
            shown = pattern_of(frames.mean) if self.colours is None else self.colours
            self._period = (1, 1) if shown is None else shown.period
        if shape != self.saturated.shape:
            raise InputError(
                f"{self.words.argument} holds means of shapes {self.saturated.shape} and {shape}, "
                "expected one"
            )
        if shares is None and not same_statistics(frames.dark, self._first_dark):
            raise InputError(
                f"{self.words.place(exposure)} has another dark than the first: average all with "
                "one 'dark'"
            )
        saturates = frames.saturated > 0
        which = self.words.place(exposure, name)
        _refuse_no_variance(which, frames)
        self._refuse_saturated(which, frames)
        clipped = clipping_of(frames)
        self.clipped = highest([self.clipped, clipped])
        self.raw &= frames.raw
        self.values[exposure] = frames.mean
        self.values[exposure][saturates] = np.nan
        self.variances[exposure] = frames.variance
        self.saturated |= saturates
        self.always_saturated &= saturates
        count = int(frames.count.max())
        self.frames.append(count)
        self.names.append(name)
        self._screen(frames)
        self._shares.append(shares or (1.0,) * len(self.darks))
        if self._first_dark is None:
            self._of_dark.append(_added_by_dark(frames, count))
        # Clipped samples scatter less: their bins would have most of the weight in the noise model.
        free = ~saturates if clipped is None else ~saturates & unclipped(frames, clipped)
        self.step = max(self.step, frames.step)
        self.light.append(light_of(frames))
        self._points.append(_points(frames, frames.mean, free, self.light[-1], self._period))

    def with_room(self, count: int) -> Self:
        """Return a copy with room for `count` exposures, those of this one among them."""
        grown = copy.copy(self)
        for known in ("noise", "filters"):  # of all exposures; what is known of the darks stands
            vars(grown).pop(known, None)
        grown.count = count
        for name, kept in vars(self).items():
            if isinstance(kept, list):
                setattr(grown, name, [*kept])
        added = len(self.frames)
        for name in ("values", "variances"):
            held: Array = getattr(self, name)
            stack = np.empty((count, *held.shape[1:]), held.dtype)
            stack[:added] = held[:added]
            setattr(grown, name, stack)
        for name in ("saturated", "always_saturated", "_missing"):
            setattr(grown, name, getattr(self, name).copy())
        return grown

    def _screen(self, frames: FrameStatistics) -> None:
        """Count the samples that were left out as those of cosmic rays."""
        if frames.reject is None:
            return
        self._missing += np.where(frames.count > 0, frames.count.max() - frames.count, np.uint32(0))
        self._screened += int(frames.count.max())

    def counted_from_lowest(self) -> Self:
        """Return averages whose noise models count raw signals from the lowest of several.

        Raw values contain the level without light, which adds no photon noise.
        """
        if self._is_counted or not self.raw or self.count < 2:
            return self
        counted = copy.copy(self)
        for known in ("noise", "filters"):
            vars(counted).pop(known, None)
        counted._is_counted = True
        counted.pedestal = float(np.nanmin(counted._lowest))
        return counted

    @cached_property
    def filters(self) -> Filters | None:
        """Colour filters of the pixels, where they are given or stand out of the values."""
        if not self._is_counted:
            return Filters.shown_by(self.colours, self.values)
        return Filters.of(self.colours, *mean_rise(self.values))

    @property
    def _lowest(self) -> Floats:
        """Median of the lowest level in the colour of each pixel."""
        shape = self.saturated.shape
        lowest = np.empty(shape)
        for plane in planes_of(None if self.filters is None else self.filters.colours, shape):
            part = np.unravel_index(chosen(plane), shape)
            lowest[plane] = min(median(each[part]) for each in self.values)
        return lowest

    @cached_property
    def noise(self) -> NoiseModel | None:
        """Noise model of one frame, fitted over the pixels of all frames by `photon_transfer`.

        None without scatter: of single frames, and of equal ones that are not rounded.
        """
        more = [self._more_noise(shares) for shares in self._shares]
        pairs = zip(self._points, more, strict=True)
        points = [each - (self.pedestal, added, 0) for each, added in pairs]
        known = any(map(len, points))
        for each, added in zip(self._dark_points, self._beside_least, strict=True):
            points.append(each - (0, added, 0))
            known |= self.gain is not None and len(each) > 0
        every = np.concatenate(points)
        if not known or (self.step == 0 and not np.any(every[:, 1] > 0)):
            return None
        return NoiseModel.fit(every, gain=self.gain, step=self.step)

    @cached_property
    def _dark_points(self) -> list[Array]:
        """Points of the photon-transfer curve of each dark, at signal 0."""
        return [_points_of_dark(each) for each in self.darks]

    @cached_property
    def _beside_least(self) -> list[float]:
        """Variance of a frame of each dark above the least: dark current has photon noise, too."""
        if not all(map(len, self._dark_points)):
            return [0.0] * len(self.darks)
        found = [float(np.average(v, weights=f)) for _, v, f in (p.T for p in self._dark_points)]
        return [each - min(found) for each in found]

    def _more_noise(self, shares: tuple[float, ...]) -> float:
        """Variance of a frame of an exposure above that of the noise model, by its dark."""
        return sum(a * b for a, b in zip(shares, self._beside_least, strict=True))

    @property
    def dark(self) -> FrameStatistics | None:
        """The dark that was subtracted from all; None of several."""
        return self._first_dark if len(set(self._shares)) <= 1 else None

    def raw_values(self, exposure: int, pixels: Pixels = ...) -> Array:
        """Mean of an exposure before the dark was subtracted, of all pixels or of some."""
        values: Array = self.values[exposure][pixels]
        if not self.darks:
            return values if self.black is None else values + self.black[pixels]
        pairs = zip(self._shares[exposure], self.darks, strict=True)
        return np.asarray(values + sum(share * dark.mean[pixels] for share, dark in pairs))

    @property
    def unsteady(self) -> str:
        """The exposure whose light varied most between its frames, or the dark; or nothing."""
        stray = max(map(light_of, self.darks), key=lambda each: each.over_noise, default=Light())
        if stray.over_noise > STRAY:
            return f"'dark': {stray.words} (limit {STRAY:g}). See that all its frames are dark"
        worst = max(range(len(self.light)), key=lambda k: self.light[k].over_noise)
        if not self.light[worst].over_noise > _NAMED:
            return ""
        which = self.words.place(worst, self.names[worst])
        return (
            f"{which}: {self.light[worst].words} (limit {_NAMED:g}). It was "
            f"taken out of the noise model. See that all frames are of one {self.words.one}, let "
            "the source settle, or average more frames"
        )

    def models(self, noise: NoiseModel, dark_variance: float = 0.0) -> tuple[NoiseModel, ...]:
        """Noise model of each mean frame less a dark of that variance, from that of one frame.

        What the dark of an exposure has beside `dark_variance` of all is added.
        """
        _, own = self._dark_variances(noise)
        return tuple(
            _noisier(noise, self._more_noise(shares)).of_mean(each, dark_variance=dark_variance + v)
            for each, v, shares in zip(self.frames, own, self._shares, strict=True)
        )

    def dark_variance(self, noise: NoiseModel | None) -> Floats | None:
        """Variance of the dark that is common to all exposures, from the noise of one frame.

        From the darks alone where no exposure shows that noise. Of a dark that is not kept it is
        what the averages state; None without any.
        """
        if self.darks:
            common, _ = self._dark_variances(noise)
            return np.broadcast_to(np.asarray(common), self.saturated.shape)
        stated = float(np.mean(self._of_dark))
        return np.full(self.saturated.shape, stated) if stated > 0 else None

    def _dark_variances(self, noise: NoiseModel | None) -> tuple[Floats | None, list[float]]:
        """Variance of darks that counts as common to all exposures, and what each has beside it.

        Darks Σ s D of two exposures have the covariance Σ s s' var(D). Its mean over all pairs
        counts as that of all: where exposures have equal weights, the error of M and F are those of
        the darks. A variance that all pixels have is one number.
        """
        if not self.darks:
            return None, [0.0] * len(self.frames)
        pairs = zip(self.darks, self._beside_least, strict=True)
        variances = [
            variance_of_dark_alone(each)
            if noise is None
            else _variance_of_dark(each, _noisier(noise, more))
            for each, more in pairs
        ]

        def covariance(one: tuple[float, ...], other: tuple[float, ...]) -> Floats:
            triples = zip(one, other, variances, strict=True)
            return np.asarray(sum(a * b * variance for a, b, variance in triples))

        counts = Counter(self._shares)
        if len(counts) == 1:
            (shares,) = counts
            return covariance(shares, shares), [0.0] * len(self.frames)
        pairs_of_all = len(self.frames) * (len(self.frames) - 1)
        common = np.asarray(
            sum(
                counts[a] * (counts[b] - (a == b)) / pairs_of_all * covariance(a, b)
                for a, b in product(counts, repeat=2)
            )
        )
        beside = {each: np.maximum(covariance(each, each) - common, 0) for each in counts}
        own = {each: median(variance) for each, variance in beside.items()}
        return common, [own[each] for each in self._shares]

    def bad_pixels(self, noise: NoiseModel | None) -> defects.BadPixels:
        """Bad pixels found before any fit; `noise` is the model of one frame, if known."""
        noisy = None
        if noise is not None:
            noise = _noisier(noise, max(self._beside_least, default=0.0))
            measured = self.values, self.variances, self.frames
            lowest = self._lowest if self._is_counted else None
            noisy = defects.noisy_pixels(*measured, noise, self.light, lowest=lowest)
            if self._screened:
                noisy |= defects.often_rejected(self._missing, self._screened)
        hot = np.zeros(self.saturated.shape, bool)
        for dark in self.darks:
            hot |= defects.hot_pixels(dark, noise) | (dark.saturated > 0)
        dead = None
        if noise is not None or self.darks:
            dead = self._dead(noise) & ~hot
        return defects.BadPixels(saturated=self.saturated, dead=dead, hot=hot, noisy=noisy)

    def _refuse_saturated(self, which: str, frames: FrameStatistics) -> None:
        saturates = frames.saturated > 0
        refuse_saturated(which, frames.mean, saturates, self.saturation, self.saturation_key)

    def _dead(self, noise: NoiseModel | None) -> Bools:
        """Pixels that are dead in every exposure in which they do not saturate."""
        models = None
        if noise is not None:
            of_dark = self.dark_variance(noise)
            models = self.models(noise, 0.0 if of_dark is None else median(of_dark))
        usual = 1.0 if self.filters is None else self.filters.map_of(self.saturated.shape)
        signals = self.values - self._lowest if self._is_counted else self.values
        dead: Bools = defects.dead_pixels(signals, models, usual)
        if models is not None:
            dead |= defects.blind_pixels(signals, models, usual)
        measured = np.zeros_like(dead)
        for each in self.values:
            measured |= np.isfinite(each)
        return dead & measured


def _refuse_no_variance(which: str, frames: FrameStatistics) -> None:
    """Refuse averages of several samples without a finite variance that is not negative."""
    if frames.variance.min() >= 0 and frames.variance.max() < np.inf:
        return  # usually: then no map is made
    several = (frames.count > 1) & np.isfinite(frames.mean)
    wrong = several & ~(np.isfinite(frames.variance) & (frames.variance >= 0))
    if wrong.any():
        raise InputError(
            f"{which}: 'variance' holds {frames.variance[wrong][0]:g}, expected finite numbers not "
            "below 0 where 'count' is above 1"
        )


def _added_by_dark(frames: FrameStatistics, count: int) -> float:
    """Variance that a dark adds to the mean, as `variance_of_mean` has it: its median."""
    if count < 2:
        return 0.0
    part = spread(frames.mean.size)
    of_mean, of_frame = (
        each.reshape(-1)[part] for each in (frames.variance_of_mean, frames.variance)
    )
    return max(0.0, median(of_mean - of_frame / count))


def _noisier(noise: NoiseModel, added: float) -> NoiseModel:
    """Noise model with so much more variance without light."""
    return dataclasses.replace(noise, read_noise=float(np.sqrt(noise.read_noise**2 + added)))


def _variance_of_dark(dark: FrameStatistics, noise: NoiseModel) -> Floats:
    """Variance of the mean of dark frames, from the noise of one frame.

    One frame shows no noise, and what exposures in bright light say of that of the dark may be far
    off: its scatter between neighbours, which holds its pattern too, stands for it. Of pixels that
    all have as many frames it is one number.
    """
    least, most = int(dark.count.min()), int(dark.count.max())
    of_frame = _between_neighbours(dark.mean) if most <= 1 else noise.scatter(0.0)
    scatter = of_frame / np.maximum(most if least == most else dark.count, 1)
    of_mean = noise.of_mean(most)
    return np.asarray(scatter + of_mean.rounding_apart(0.0, dark.mean, raw=True))


def variance_of_dark_alone(dark: FrameStatistics) -> Floats:
    """Variance of the mean of dark frames, from these alone: where no exposure shows its noise."""
    points = _points_of_dark(dark)
    if len(points) == 0:
        points = np.array([(0.0, _between_neighbours(dark.mean), 1.0)])
    if dark.step == 0 and not np.any(points[:, 1] > 0):
        return np.zeros(())  # equal frames that are not rounded show none
    return _variance_of_dark(dark, NoiseModel.fit(points, step=dark.step))


def _between_neighbours(frame: Array) -> float:
    """Variance of pixels about their neighbours, in DN²: half that of differences.

    Of normal differences 68.27 % lie within one standard deviation; bad pixels do not count.
    """
    steps = np.abs(np.diff(frame.ravel().astype(np.float64)))
    return float(np.nanpercentile(steps, 68.27) ** 2 / 2)


def _points(
    frames: FrameStatistics,
    signal: Array,
    free: Bools,
    light: Light,
    period: tuple[int, int] = (1, 1),
) -> Array:
    """Points of the photon-transfer curve of the pixels that are `free` of saturation.

    A pixel without a dark has a variance, but no signal.
    """
    known = free & np.isfinite(frames.mean)
    common = None if light == Light() else light.variance(frames.mean)
    count = int(frames.count.max())
    return photon_transfer(signal, frames.variance, known, count, frames.step, common, period)


def _points_of_dark(dark: FrameStatistics) -> Array:
    """Points of the curve of dark frames, at signal 0: what pixels have in common is an offset."""
    light = light_of(dark)
    if light.relative:
        light = Light(offset=dark.light_variance or 0.0)
    return _points(dark, np.zeros(dark.mean.shape), dark.saturated == 0, light)

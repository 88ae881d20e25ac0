"""Levels of a uniform source: references, noise, usable pixels."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from equipix import _native
from equipix._check import Array, Bools, By, Floats, Ints, Words, as_mask, union
from equipix.errors import InputError
from equipix.findings import Finding, Rule, ask, say
from equipix.measured.colour import Colours, Filters, mean_rise
from equipix.measured.defects import DEAD_RESPONSE, SIGMAS, BadPixels, response_outliers
from equipix.measured.means import Averaged
from equipix.measured.measured import Measured, averaged_of, check_levels, measured_of
from equipix.measured.noise import MEDIAN_SQUARE, NoiseModel, block_medians, of_blocks
from equipix.measured.part import ENOUGH, chosen, known_part, median, spread
from equipix.measured.statistics import FrameStatistics
from equipix.nuc.level_rules import GIVEN, Given

_LEVELS = Words("'levels'", "level", pixel_variances=False)  # they would make weights noisy

_FORMS = {1: "line", 2: "quadratic", 3: "cubic"}
"""Form that the core fits for each order above 0; that of order 0 is named by what is corrected."""

FEWEST_VALID = 0.5
"""Least share of the pixels that must have a value at every level."""

_ROUNDING = 1e-9
"""Relative difference below which two means are equal, where no noise is known."""

_SAMPLED = 10_000
"""Most pixels of which scatters and the median of a level less the dark are taken."""


class LevelNoise(NamedTuple):
    """Variance of a level's mean, in DN²: ``constant + slope · (value − dark)``."""

    constant: float
    slope: float
    dark: float

    def variance(self, value: Array | float) -> Floats:
        """Variance at this value in DN."""
        return np.asarray(self.constant + self.slope * np.maximum(value - self.dark, 0))


@dataclass(frozen=True, eq=False, kw_only=True)
class Levels(Measured):
    """Mean frames of a uniform source at several levels, checked; NaN where not to be used.

    Attributes
    ----------
    references : ndarray, shape (n,), float64
        Mean V̄ of each level over the pixels that are good and have a value at every level.
    good : ndarray of bool, shape (rows, cols)
        These pixels.
    level_noise : tuple of LevelNoise, or None
        Noise of the mean frames, without that of the dark; None if it is unknown.
    frame_noise : float or None
        Noise of one frame at the lowest level, in DN, where averages give it, else that of a value
        given; None if it is unknown.
    findings : tuple of Finding
        What limits them.
    """

    references: Floats
    good: Bools
    level_noise: tuple[LevelNoise, ...] | None
    frame_noise: float | None = None
    findings: tuple[Finding, ...] = ()

    def of_pixels(self, pixels: Bools) -> Self:
        """Return the levels of some pixels as one row of them, with references of their own."""

        def chosen(image: Array | None) -> Array | None:
            return None if image is None else image[pixels][None]

        values = np.ascontiguousarray(self.values[:, pixels][:, None])
        good = self.good[pixels][None]
        return dataclasses.replace(
            self,
            values=values,
            good=good,
            references=_references(values, good),
            bad_pixels=BadPixels(dead=chosen(self.bad_pixels.dead)),
            dark=chosen(self.dark),
            dark_variance=chosen(self.dark_variance),
            colours=None,
            filters=None,
        )

    @property
    def variances(self) -> Floats:
        """Variance of a pixel's value at each level; 1 where no noise is known."""
        if self.level_noise is None:
            return np.ones(len(self))
        pairs = zip(self.level_noise, self.references, strict=True)
        return np.array([float(noise.variance(reference)) for noise, reference in pairs])

    def chosen(self, exposures: Ints) -> Self:
        """Return some of the levels, with their references."""
        noise = self.level_noise
        return dataclasses.replace(
            super().chosen(exposures),
            references=self.references[exposures],
            level_noise=None if noise is None else tuple(noise[level] for level in exposures),
        )

    def part(self) -> Self:
        """Return the levels of a part of the good pixels, evenly over the sensor, as one row."""
        if np.count_nonzero(self.good) <= ENOUGH:
            return self
        pixels = np.zeros(self.shape, bool)
        pixels.flat[chosen(self.good)] = True
        return self.of_pixels(pixels)

    def counting(self, alike: Bools) -> Self:
        """Return the levels with references of those of the good pixels that are alike."""
        good = self.good.copy()
        good[self.good] = alike
        return dataclasses.replace(self, good=good, references=_references(self.values, good))

    def limits(self) -> Floats:
        """Lowest and highest V̄ at which each pixel has a value, shape (2, rows, cols)."""
        found = np.full((2, *self.good.shape), np.nan)
        low, high = found
        for value, reference in zip(self.values, self.references, strict=True):
            known = np.isfinite(value)
            np.fmin(low, reference, out=low, where=known)
            np.fmax(high, reference, out=high, where=known)
        return found

    def distinct(self) -> int:
        """Count the levels whose means differ by more than six standard deviations of a pixel's.

        Where no noise is known, by more than the median deviation of the pixels' differences: that
        is of noise between levels of one light, and of gains between others.
        """
        order = np.argsort(self.references)
        sigma = np.sqrt(self.variances) if self.level_noise else np.zeros(len(self))
        count, last = 1, order[0]
        for level in order[1:]:
            smallest = SIGMAS * np.hypot(sigma[level], sigma[last])
            smallest = max(smallest, _ROUNDING * abs(self.references[level]))
            if not self.level_noise:
                smallest = max(smallest, _scatter(self.values, int(last), int(level)))
            if self.references[level] - self.references[last] > smallest:
                count, last = count + 1, level
        return count

    def fit(
        self, order: int, by: By, *, workers: int | None
    ) -> tuple[Floats, Floats, Floats, Array]:
        """Fit polynomials of an order: coefficients, variances, misfit, levels used."""
        return _native.fit_response(
            self.values,
            self.references.tolist(),
            form=_FORMS.get(order, by),
            noise=self.level_noise,
            workers=workers,
        )


def levels_of(
    levels: ArrayLike | Sequence[FrameStatistics] | Averaged,
    *,
    variance: ArrayLike | NoiseModel | Sequence[NoiseModel] | None = None,
    mask: ArrayLike | None = None,
    saturation: float | None = None,
    cfa: ArrayLike | Colours | None = None,
) -> Levels:
    """Check what the caller gave; the arguments are those of `equipix.nuc.fit`."""
    check_levels(levels)
    averaged = averaged_of(levels, _LEVELS, Colours.of(cfa))
    if averaged is not None:
        averaged = averaged.counted_from_lowest()
    source = levels if averaged is None else averaged
    measured = measured_of(source, variance, saturation, words=_LEVELS, colours=Colours.of(cfa))
    if measured.variance is not None:
        _check_variance(measured.variance)
    given = as_mask(mask, measured.values.shape)
    said = say(*ask(GIVEN, Given(measured, averaged, given)))
    noise = _noise_of(measured, 0.0 if averaged is None else averaged.pedestal)
    # Arrays hold values where they saturate, averages NaN.
    excluded = given if averaged is not None else union(given, measured.mask)
    values = measured.values if excluded is None else np.where(excluded, np.nan, measured.values)
    filters = _filters(values, measured.colours)
    stuck: Bools | None = None
    if averaged is not None:
        stuck = averaged.always_saturated
    elif measured.mask is not None:
        stuck = np.logical_and.reduce(measured.mask)
    bad_pixels = _with_stuck(values, measured.bad_pixels, stuck, given)
    bad_pixels = _with_odd_responses(values, noise, bad_pixels, filters)
    good = _good(values, bad_pixels, given)
    references = _references(values, good)
    own = {
        "values": values,
        "bad_pixels": bad_pixels,
        "filters": filters,
        "mask": None,
        "variance": None,
        "noise": (),  # in values and level_noise
        "raw": measured.raw and averaged is not None,
        "references": references,
        "good": good,
        "level_noise": noise,
        "frame_noise": _frame_noise(averaged if variance is None else None, noise, references),
    }
    checked = Levels(**vars(measured) | own)
    return dataclasses.replace(checked, findings=said + say(*ask(_CHECKED, checked)))


def _check_variance(variance: Array) -> None:
    """Refuse variances that are not above 0."""
    wrong = variance[~(np.isfinite(variance) & (variance > 0))]
    if wrong.size:
        raise InputError(f"'variance' holds {wrong[0]:g}, expected finite numbers above 0, in DN²")


def _filters(values: Array, colours: Colours | None) -> Filters | None:
    """Colour filters as the rise from the lowest to the highest level shows them."""
    if not all(np.isfinite(each).any() for each in values):
        return None if colours is None else Filters.of(colours, values[0])
    return Filters.of(colours, *mean_rise(values))


def _references(values: Array, usable: Bools) -> Floats:
    """Mean V̄ of each level over usable pixels."""
    return np.array([each[usable].mean(dtype=np.float64) for each in values])


def _frame_noise(
    averaged: Averaged | None, noise: tuple[LevelNoise, ...] | None, references: Floats
) -> float | None:
    """Noise of one frame at the lowest level; of a value that is given where no more is known."""
    lowest = int(np.argmin(references))
    if averaged is not None and averaged.noise is not None:
        signal = references[lowest] - averaged.pedestal
        return float(np.sqrt(averaged.noise.variance(signal)))
    return None if noise is None else float(np.sqrt(noise[lowest].variance(references[lowest])))


def _noise_of(measured: Measured, pedestal: float) -> tuple[LevelNoise, ...] | None:
    """Noise of each mean frame, from noise models or one variance a level.

    What rounding leaves in a mean is that at the median of the level, less what all pixels have in
    common, which V̄ takes.
    """
    if measured.noise:
        pairs = zip(measured.noise, measured.values, strict=True)
        return tuple(_level_noise(model, values, pedestal) for model, values in pairs)
    if measured.variance is None:
        return None
    return tuple(LevelNoise(float(each), 0.0, 0.0) for each in measured.variance)


def _level_noise(model: NoiseModel, values: Array, pedestal: float) -> LevelNoise:
    signal = max(0.0, median(values) - pedestal)
    slope = model.gain / model.frames
    common = float(model.rounding(signal)) - model.rounding_apart(signal, values)
    return LevelNoise(float(model.variance(signal)) - common - slope * signal, slope, pedestal)


def _with_stuck(
    values: Array, bad_pixels: BadPixels, stuck: Bools | None, mask: Bools | None
) -> BadPixels:
    """Add pixels that saturate at each level, also where their neighbours are far below.

    At the lowest level the neighbours have less than half of what the array has at the highest.
    """
    if stuck is None or not all(np.isfinite(each).any() for each in values):
        return bad_pixels
    if mask is not None:
        stuck = stuck & ~mask.reshape(-1, *stuck.shape).any(axis=0)
    if not stuck.any():
        return bad_pixels
    means = [median(each) for each in values]
    around = of_blocks(block_medians(values[int(np.argmin(means))]), stuck.shape)
    stuck = stuck & (around < DEAD_RESPONSE * max(means))
    return dataclasses.replace(bad_pixels, hot=union(bad_pixels.hot, stuck))


def _with_odd_responses(
    values: Array,
    noise: tuple[LevelNoise, ...] | None,
    bad_pixels: BadPixels,
    filters: Filters | None,
) -> BadPixels:
    """Add pixels that rise by less than half, or more than twice, as much as their neighbours.

    From the lowest to the highest level at which a pixel has a value.
    """
    if len(values) < 2 or not all(np.isfinite(each).any() for each in values):
        return bad_pixels
    means = np.array([median(each) for each in values])
    order = np.argsort(means)
    rise, std = _rise(values, means, noise, order[0], order[-1])
    # A rise within the noise is refused later, with the number of levels that differ.
    if not rise:
        return bad_pixels
    # Of a colour of less response the noise is that of the array, which is the larger one.
    colours = 1.0 if filters is None else filters.map_of(values.shape[1:])
    response = (values[order[-1]] - values[order[0]]) / (rise * colours)
    stds = np.broadcast_to(std / (rise * colours), response.shape)
    missing = np.isnan(response)
    if missing.any():
        # As at a level where a pixel saturates: it is judged by those where it does not.
        stds = stds.copy()
        known = np.isfinite(values[:, missing][order])
        pairs = np.stack([known.argmax(axis=0), len(order) - 1 - known[::-1].argmax(axis=0)])
        for first, last in np.unique(pairs, axis=1).T.tolist():
            low, high = order[first], order[last]
            rise, std = _rise(values, means, noise, low, high)
            if first < last and rise:
                pixels = np.zeros_like(missing)
                pixels[missing] = (pairs == [[first], [last]]).all(axis=0)
                usual = rise * np.broadcast_to(colours, response.shape)[pixels]
                response[pixels] = (values[high][pixels] - values[low][pixels]) / usual
                stds[pixels] = std / usual
    dead, hot = response_outliers(response, lambda: stds)
    return dataclasses.replace(
        bad_pixels, dead=union(bad_pixels.dead, dead), hot=union(bad_pixels.hot, hot)
    )


def _rise(
    values: Array, means: Floats, noise: tuple[LevelNoise, ...] | None, low: int, high: int
) -> tuple[float, float]:
    """Rise of the means from one level to another and the noise of a pixel's; 0 within noise."""
    rise = float(means[high] - means[low])
    variance = sum(float(noise[each].variance(means[each])) for each in (low, high)) if noise else 0
    std = float(np.sqrt(variance))
    if rise <= SIGMAS * std or (not noise and rise <= _scatter(values, low, high)):
        return 0.0, std
    return rise, std


def _scatter(values: Array, low: int, high: int) -> float:
    """Scatter between pixels of the rise from one level to another: of noise and of gains."""
    sample = spread(values[0].size, _SAMPLED)
    below, above = (values[level].reshape(-1)[sample].astype(np.float64) for level in (low, high))
    rise = above - below
    known = rise[np.isfinite(rise)]
    return float(np.median(np.abs(known - np.median(known)))) if known.size else 0.0


def _good(values: Array, bad_pixels: BadPixels, mask: Bools | None) -> Bools:
    """Good pixels with a value at every level; refused where they are few."""
    bad = union(bad_pixels.dead, bad_pixels.hot, bad_pixels.noisy)
    usable = np.ones(values.shape[1:], bool)
    for each in values:
        usable &= np.isfinite(each)
    if bad is not None:
        usable &= ~bad
    wanted = np.ones_like(usable)
    if mask is not None:
        wanted &= ~mask.reshape(-1, *usable.shape).all(axis=0)
    share = float(usable.sum() / int(wanted.sum()))
    if share < FEWEST_VALID or not usable.any():
        missing = [1 - np.mean(np.isfinite(each[wanted])) for each in values]
        odd = 0.0 if bad is None else float(np.mean(bad[wanted]))
        raise InputError(
            f"'levels': {share:.1%} of the pixels are good and have a value at every level, "
            f"expected {FEWEST_VALID:.0%} or more. {_cause(values, missing, odd)}"
        )
    return usable


def _on_bright_dark(levels: Levels) -> str | None:
    """Say that the median of a level less the dark is below 0 by more than the noise of a value.

    Where no noise is known the scatter of the level takes its place. Medians are those of a sample
    of the usable pixels.
    """
    if levels.dark is None:
        return None
    sample = chosen(levels.good, _SAMPLED)
    of_dark = 0.0 if levels.dark_variance is None else median(levels.dark_variance)
    below = []
    for level, every in enumerate(levels.values):
        each = every.reshape(-1)[sample]
        middle = float(np.median(each))
        if levels.level_noise is None:
            sigma = float(np.median(np.abs(each - middle))) / np.sqrt(MEDIAN_SQUARE)
        else:
            sigma = np.sqrt(float(levels.level_noise[level].variance(middle)) + of_dark)
        if middle < -SIGMAS * sigma:
            below.append(f"{middle:.6g} DN at level {level}")
    if not below:
        return None
    return (
        f"the dark is brighter than a level of 'levels': the median less the dark is "
        f"{' and '.join(below)}. Give the dark frames of these levels, or none"
    )


_CHECKED: tuple[Rule[Levels], ...] = (
    Rule("cfa", "misfit", lambda levels: levels.filters.words if levels.filters else None),
    Rule("bright_dark", "input", _on_bright_dark),
)
"""What is asked of levels that can be fitted."""


def _cause(values: Array, missing: Sequence[float], odd: float) -> str:
    """Say which level has few values, or why pixels are odd, and what to do."""
    worst = int(np.argmax(missing))
    said = (
        f"Level {worst} has no value in {missing[worst]:.1%} (saturated, masked or not finite), "
        f"and {odd:.1%} are dead, hot or noisy: "
    )
    # Noise judged by few values makes the rest odd.
    if missing[worst] >= min(odd, 1 - FEWEST_VALID):
        return said + (
            "leave out levels that saturate, or expose less; if they do not, correct 'bit_depth' "
            "or 'saturation', which are too low for these values"
        )
    means = ", ".join(f"{np.nanmedian(each):.6g}" for each in values)
    if np.nanmedian(values, axis=(1, 2)).min() < 0:
        return said + (
            f"the dark is brighter than a level, as the medians less the dark are {means} DN: give "
            "the dark frames of these levels, or none"
        )
    return said + (
        f"the medians of the levels are {means} DN: give levels that differ by more than the "
        "noise, and the noise of these frames"
    )


_FEW = 0.05
"""Largest share of pixels that are left out because they deviate from the others."""


def alike_pixels(squares: Floats) -> Bools:
    """Find pixels that do not deviate from the others.

    Parameters
    ----------
    squares : ndarray, shape (orders, pixels)
        Mean square residual of each pixel at each order.

    Returns
    -------
    ndarray of bool, shape (pixels,)
        False where at some order it is above 36 times the variance of the normal variable whose
        square has the median of the array, of 2¹⁹ pixels where there are more; of more than one
        pixel in twenty, for those that deviate most.
    """
    limits = [SIGMAS**2 / MEDIAN_SQUARE * np.median(known_part(each)) for each in squares]
    excess, most = np.zeros(squares.shape[1]), int(_FEW * squares.shape[1])
    for each, limit in zip(squares, limits, strict=True):
        if limit > 0:  # the median of exact levels may be 0
            np.fmax(excess, each / limit, out=excess)
    if not most:
        return np.ones(excess.size, bool)
    if np.count_nonzero(excess > 1) <= most:
        return np.asarray(excess <= 1)
    # Of more than `most`, those that deviate most are left out.
    return np.asarray(excess <= np.partition(excess, -most - 1)[-most - 1])

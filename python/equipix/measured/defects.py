"""Which pixels must not be used: dead, hot, noisy, blind, unlike their neighbours."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from equipix._check import Array, Bools, Ints, ReadOnly, number, union
from equipix.errors import InputError
from equipix.measured.noise import (
    BLOCK,
    ROBUST,
    NoiseModel,
    block_medians,
    nanmedian,
    of_blocks,
    scatter_limit,
)
from equipix.measured.part import blocks, known_part, median
from equipix.measured.statistics import FrameStatistics, Light, light_of
from equipix.shown import Brief

SIGMAS = 6.0
"""Standard deviations that noise does not reach on a sensor of some million pixels."""

HOT_SIGMAS = 10.0
"""Limit of a hot dark level in standard deviations of the others: dark levels have long tails."""

DEAD_RESPONSE = 0.5
"""Response relative to the neighbours below which a pixel is dead."""

_CHANCE = 1e-7
"""Probability below which a number of samples left out is no chance."""

_ROUNDS = 3
"""Rounds in which the share of samples left out is found without the pixels found before."""

_STEP = 1.1
"""Response of a block over that of the one beside it from which a step may lie between them."""

_LARGEST_STEP = 10.0
"""Response of a block over that of the one beside it up to which both may be good."""

_REACH = 5
"""Pixels on each side of a pixel in its row and column that it is compared with beside a step."""

_OWN = 3
"""Rank of their values that counts: the middle of one side, which two bad pixels do not move."""

_AROUND = 5
"""Side of the square of blocks that a block is compared with."""


@dataclass(frozen=True, eq=False)
class BadPixels(ReadOnly):
    """Bad pixels found before the last fit: maps (rows, cols) of bool, or None.

    Attributes
    ----------
    saturated : ndarray of bool or None
        A sample reaches the saturation level in some exposure.
    dead : ndarray of bool or None
        No response to light: see `dead_pixels` and `equipix.measured.defects`.
    hot : ndarray of bool or None
        A high dark level or much dark noise: see `hot_pixels`.
    noisy : ndarray of bool or None
        More scatter between frames than the noise explains: see `noisy_pixels`.
    contradictory : ndarray of bool or None
        Another response before than after some moment, as under dust that fell; or most of the
        measurements left out by a robust calibration, or all but one. The fit flags them, and their
        sensitivity counts neither for its mean nor for its slope.
    faint : ndarray of bool or None
        Light so weak that the noise of the dark leaves M less known than in bright pixels; treated
        likewise.
    """

    saturated: Bools | None = None
    dead: Bools | None = None
    hot: Bools | None = None
    noisy: Bools | None = None
    contradictory: Bools | None = None
    faint: Bools | None = None

    @property
    def unreliable(self) -> Bools | None:
        """Pixels whose sensitivity counts neither for its mean nor for its slope."""
        return union(self.contradictory, self.faint)


def dead_pixels(
    signals: Array, models: Sequence[NoiseModel] | None, usual: Array | float = 1.0
) -> Array:
    """Find pixels whose response to light is below half of that of their neighbours.

    Parameters
    ----------
    signals : ndarray, shape (n, rows, cols)
        Dark-subtracted means of the exposures, in DN.
    models : sequence of NoiseModel, optional
        Those of `signals`, one an exposure: a pixel must be below by more than noise explains.
    usual : ndarray of shape (rows, cols), optional
        Response of good pixels, such as those of the colours of their filters.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        True where this holds in every exposure with a measurement, and where none has one; the
        neighbours' response is the median of a block of 16×16 pixels.
    """
    dead = np.ones(signals.shape[1:], dtype=bool)
    for k, signal in enumerate(signals):
        around = block_medians(signal if np.ndim(usual) == 0 else signal / usual)
        for rows, medians in _bands(around):
            usual_here = usual if np.ndim(usual) == 0 else np.asarray(usual)[rows]
            least = DEAD_RESPONSE * usual_here * of_blocks(medians, signal[rows].shape)
            # A comparison with NaN is false: a missing measurement does not exclude a dead pixel.
            suspects = np.nonzero(dead[rows] & ~(signal[rows] >= least))
            value = signal[rows][suspects]
            margin = 0.0 if models is None else SIGMAS * np.sqrt(models[k].variance(value))
            dead[rows] = False
            dead[rows][suspects] = ~(value + margin >= least[suspects])
    return dead


def _bands(medians: Array) -> Iterator[tuple[slice, Array]]:
    """Rows of each row of blocks, with the medians of these blocks."""
    return ((slice(BLOCK * k, BLOCK * (k + 1)), medians[k : k + 1]) for k in range(len(medians)))


def hot_pixels(dark: FrameStatistics, noise: NoiseModel | None) -> Array:
    """Find pixels whose dark level or dark noise is far above that of the others.

    Parameters
    ----------
    dark : FrameStatistics
        The averaged dark frames.
    noise : NoiseModel, optional
        The noise of the good pixels; without it only the level counts.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        True where the level is more than 10 standard deviations above the median (estimated by
        1.4826 times the median absolute deviation, and at least one DN or one step between values),
        or the variance beyond what noise and rounding explain. Medians are those of 2¹⁹ pixels,
        evenly over the sensor, where there are more.
    """
    part = known_part(dark.mean)
    usual = median(part)
    spread = max(1.0, dark.step, ROBUST * median(np.abs(part - usual)))
    hot: Bools = np.empty(dark.mean.shape, bool)
    frames, limit, light = int(dark.count.max()), np.inf, Light()
    if noise is not None and frames > 1:
        limit = scatter_limit(frames, sigmas=SIGMAS) * float(noise.largest_scatter(0.0))
        light = light_of(dark)
    for rows in blocks(hot.shape):
        hot[rows] = dark.mean[rows] - usual > HOT_SIGMAS * spread
        hot[rows] |= dark.variance[rows] > _with_light(limit, light.variance(dark.mean[rows]))
    return hot


def noisy_pixels(
    values: Array,
    variances: Array,
    frames: Sequence[int],
    noise: NoiseModel,
    light: Sequence[Light],
    *,
    lowest: Array | None = None,
    times: float = 1.0,
) -> Bools:
    """Find pixels that scatter between frames by more than the noise explains.

    Parameters
    ----------
    values, variances : ndarray, shape (n, rows, cols)
        Mean and sample variance of each exposure, in DN and DN².
    frames : sequence of int
        Number of frames of each exposure.
    noise : NoiseModel
        That of one frame of a good pixel.
    light : sequence of Light
        What the variances of each exposure have of light that varied between its frames.
    lowest : ndarray, shape (rows, cols), optional
        Level without light, where `values` hold it.
    times : float
        Noise above which a pixel is noisy, over that of a good pixel of its signal: with 1 all that
        is beyond chance.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        True where this holds in every exposure that shows a scatter.
    """
    noisy = np.ones(values.shape[1:], dtype=bool)
    for rows in blocks(noisy.shape):
        seen = np.zeros_like(noisy[rows])
        for value, variance, count, shared in zip(values, variances, frames, light, strict=True):
            if count < 2:
                continue
            known = np.isfinite(variance[rows]) & np.isfinite(value[rows])
            seen |= known
            # The first exposure leaves few pixels to ask the next one about.
            asked = noisy[rows] & known
            mean = value[rows][asked]
            signal = mean if lowest is None else mean - lowest[rows][asked]
            of_chance = scatter_limit(count, sigmas=SIGMAS) * noise.largest_scatter(signal)
            limit = np.maximum(of_chance, times**2 * noise.scatter(signal))
            noisy[rows][asked] = variance[rows][asked] > _with_light(limit, shared.variance(mean))
        noisy[rows] &= seen
    return noisy


def often_rejected(missing: Array, samples: int) -> Bools:
    """Find pixels of which samples were left out more often than chance explains.

    A pixel that jumps between levels loses the samples of the rarer one: those that are left show
    little noise, and their mean is that of one level.

    Parameters
    ----------
    missing : ndarray, shape (rows, cols), of whole numbers
        Samples that were left out.
    samples : int
        All samples of a pixel.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        True where the binomial distribution of so many samples, each left out with the share of
        the other pixels, gives a probability below 1e-7.
    """
    found = np.zeros(missing.shape, bool)
    for _ in range(_ROUNDS if missing.any() else 0):
        others = missing[~found]
        # One more than there are: of none the share would be 0.
        share = (float(others.sum()) + 1) / (samples * others.size + 1)
        found = np.asarray(missing >= _binomial_limit(samples, share))
    return found


def flickering_pixels(steps: Array, variance: Array, frames: int, sigmas: float) -> Bools:
    """Find pixels whose noise is slower than white noise, by von Neumann's ratio.

    Parameters
    ----------
    steps : ndarray, shape (rows, cols)
        Sum of the squared differences of successive frames.
    variance : ndarray, shape (rows, cols)
        Sample variance.
    frames : int
        Number of frames.
    sigmas : float
        Standard deviations by which the ratio must lie below that of white noise.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        Where it does.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = steps / (variance * (frames - 1))
    deviation = (ratio - 2) / 2 * np.sqrt((frames**2 - 1) / max(1, frames - 2))
    return np.asarray(deviation < -sigmas)


def _binomial_limit(samples: int, share: float) -> int:
    """Return the smallest number that is reached with a probability below 1e-7."""
    if share >= 1:
        return samples + 1
    logs = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, samples + 1)))])
    hits = np.arange(samples + 1)
    terms = logs[-1] - logs - logs[::-1] + hits * np.log(share)
    terms += (samples - hits) * np.log1p(-share)
    above = np.cumsum(np.exp(terms)[::-1])[::-1]
    return int(np.count_nonzero(above >= _CHANCE))


def _with_light(limit: Array | float, light: Array) -> Array:
    """Largest variance by noise of variance up to `limit` and light: their deviations add up."""
    return np.asarray((np.sqrt(limit) + np.sqrt(light)) ** 2)


def response_outliers(
    sensitivity: Array, std: Callable[[], Array], *, least: float = DEAD_RESPONSE
) -> tuple[Array, Array]:
    """Find pixels whose sensitivity is below half, or above twice, that of their neighbours.

    Parameters
    ----------
    sensitivity : ndarray, shape (rows, cols)
        Sensitivity M; NaN where undetermined.
    std : callable
        Gives the standard deviations of M, which is asked only if there are suspects: M must be
        beyond the limit by more than chance explains.
    least : float
        Sensitivity below which a pixel is dead, over that of its neighbours.

    Returns
    -------
    dead, hot : ndarray of bool, shape (rows, cols)
        Of the two kinds; the neighbours' sensitivity is the median of a block of 16×16 pixels, or
        of the 5×5 blocks around where that is below half or above twice theirs: of a region of
        bad pixels that fills most of a block. Beside a step of the response it is that of the
        pixel's own side.

    Notes
    -----
    The medians of adjacent blocks differ by more than a tenth beside a step. A pixel there is
    compared with the five pixels on each side of it in its row, and in its column. Beside a
    straight step one of these sides at least is the pixel's own. So the third lowest of the ten is
    no higher than usual for a pixel of the weak side. In a line along the step all are of the
    pixel's own side, and the third lowest is usual there even if two are bad. Hence for a dead
    pixel the higher of these values of its row and its column counts, for a hot one the lower of
    the third highest. A pair, a block of 2×2 and three in a line along a step are found. The value
    is limited to the range of the medians. For a dead pixel those below a tenth of the largest are
    left out: dead regions.

    Four or more in a line along a step may as well be a bend of it: beside 0.15 a column of 0.1 is
    not told from the other side. They are found only if they are dead, or hot, beside that as well.
    The same holds for a pixel beside a step at an angle to rows and columns, or of the outermost
    row or column where a step meets it.
    """
    dead, hot = np.zeros(sensitivity.shape, bool), np.zeros(sensitivity.shape, bool)
    with np.errstate(invalid="ignore"):
        # Where no pixel is twice as sensitive as another, none is twice its neighbours' median.
        lowest, highest = (f.reduce(sensitivity, axis=None) for f in (np.fmin, np.fmax))
        if not lowest < max(least, DEAD_RESPONSE) * highest:
            return dead, hot
    # The noise of a dead region may make its median negative.
    usual, deviation = np.maximum(_usual(sensitivity), 0), std()
    lowest, highest = _range_around(usual)
    alive, _ = _range_around(usual, 1 / _LARGEST_STEP)
    stepped = highest > _STEP * lowest
    for found, sign, limit, extreme, floor in (
        (dead, -1, least, highest, alive),
        (hot, 1, 1 / DEAD_RESPONSE, lowest, lowest),
    ):
        suspects = _beyond(sensitivity, limit * extreme, sign)
        at = suspects[0] // BLOCK, suspects[1] // BLOCK
        beside = np.clip(_on_its_side(sensitivity, suspects, sign), floor[at], highest[at])
        around = np.where(stepped[at], beside, usual[at])
        beyond = sign * (sensitivity[suspects] - limit * around)
        found[suspects] = beyond > SIGMAS * deviation[suspects]
    return dead, hot


def _beyond(image: Array, limits: Array, sign: int) -> tuple[Ints, Ints]:
    """Places of pixels below (`sign` -1) or above the limits of their blocks."""
    found = []
    for rows, limit in _bands(limits):
        row, col = np.nonzero(sign * (image[rows] - of_blocks(limit, image[rows].shape)) > 0)
        found.append((row + rows.start, col))
    row, col = (np.concatenate(each) for each in zip(*found, strict=True))
    return row, col


def _usual(image: Array) -> Array:
    """Medians of blocks, but of an odd block the median of the 5×5 blocks around.

    A block is odd where its median is below half or above twice that of the blocks around, and most
    of these are within that of their median: most of its pixels are bad. Where half of a sensor
    responds weakly no block is odd. In steep light every block may be so, hence this is for
    responses alone.
    """
    medians, reach = block_medians(image), _AROUND // 2
    padded = np.pad(medians, reach, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (_AROUND, _AROUND))
    around = nanmedian(windows, axis=(2, 3))
    usual = _are_alike(windows, around[..., None, None]).sum(axis=(2, 3))
    most = 2 * usual > np.isfinite(windows).sum(axis=(2, 3))
    odd = most & ~_are_alike(medians, around)
    return np.where(odd, around, medians)


def _range_around(usual: Array, least: float = 0.0) -> tuple[Array, Array]:
    """Lowest and highest response of each block and those beside it.

    Blocks below `least` times the highest do not count.
    """
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(usual, 1, mode="edge"), (3, 3))
    highest = np.fmax.reduce(windows, axis=(2, 3))
    counted = np.where(windows >= least * highest[..., None, None], windows, np.nan)
    return np.fmin.reduce(counted, axis=(2, 3)), highest


def _on_its_side(image: Array, pixels: tuple[Array, ...], sign: int) -> Array:
    """Usual response on each pixel's side of a step, to find dead (`sign` -1) or hot pixels."""
    rows, cols = pixels
    # The differences go on beyond the border, so that a step at an angle does not turn back there.
    padded = np.pad(image, _REACH, mode="reflect", reflect_type="odd")
    steps = np.delete(np.arange(2 * _REACH + 1), _REACH)[:, None]
    lines = padded[rows + steps, cols + _REACH], padded[rows + _REACH, cols + steps]
    # A missing value may be of the pixel's own side.
    known = [np.where(np.isnan(line), -np.inf, -sign * line) for line in lines]
    ranked = [np.sort(line, axis=0)[_OWN - 1] for line in known]
    return np.asarray(-sign * np.maximum(*ranked))


def _are_alike(values: Array, usual: Array) -> Array:
    """Which responses are between half and twice the usual one."""
    return (values >= DEAD_RESPONSE * usual) & (values * DEAD_RESPONSE <= usual)


_WELL_ABOVE = 10.0
"""Signal of the pixels around, over the limit of noise, from which they see light beyond doubt:
light that fades passes the limit of noise slowly, a dead region ends within a pixel."""


def blind_pixels(signals: Array, models: Sequence[NoiseModel], usual: Array | float = 1.0) -> Bools:
    """Find pixels that are at the dark in every exposure, however many lie side by side.

    Parameters
    ----------
    signals : ndarray, shape (n, rows, cols)
        Dark-subtracted means of the exposures, in DN.
    models : sequence of NoiseModel, one an exposure
        Those of `signals`.
    usual : ndarray of shape (rows, cols), optional
        Response of good pixels, such as those of the colours of their filters.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        True where no exposure has a signal above six standard deviations of the dark, and where
        along rows or columns the nearest other pixels on both sides see so much light in every
        exposure that a good pixel here would be ten times above that; and where along rows and
        columns these are such pixels themselves. One side may be the edge of the sensor.

    Notes
    -----
    A region without light in the beam lies elsewhere in each exposure, so that the pixels beside
    what is dark in all of them are dark in some. That does not hold where all shifts run along the
    region, as along the shadow of a wire: its pixels are found as well, though they may be good.
    They have no light in any exposure, so nothing determines their sensitivity either way.
    """
    limits = [SIGMAS * float(np.sqrt(model.variance(np.zeros(())))) for model in models]
    dark = np.ones(signals.shape[1:], dtype=bool)
    for signal, limit in zip(signals, limits, strict=True):
        # A comparison with NaN is false: a missing measurement neither is light nor excludes it.
        dark &= ~(signal > limit)
    if not dark.any():
        return dark
    good = np.broadcast_to(usual, dark.shape)

    def light(place: tuple[Ints, Ints]) -> Array:
        """Least light of the exposures over the limit of noise, over that of a good pixel."""
        pairs = zip(signals, limits, strict=True)
        least = np.minimum.reduce([signal[place] / limit for signal, limit in pairs])
        return np.asarray(least / good[place])

    wanted = np.broadcast_to(_WELL_ABOVE / np.asarray(usual), dark.shape)
    found = _between_lit(dark, light, wanted) | _between_lit(dark.T, _turned(light), wanted.T).T
    # What such pixels enclose along rows and columns is where dead rows cross dead columns, as in
    # the corners of a frame of them.
    dark &= ~found

    def edges(place: tuple[Ints, Ints]) -> Array:
        return found[place].astype(np.float64)

    half = np.broadcast_to(0.5, dark.shape)
    enclosed = _between_lit(dark, edges, half) & _between_lit(dark.T, _turned(edges), half.T).T
    return found | enclosed


_Light = Callable[[tuple[Ints, Ints]], Array]
"""Gives the light at places (rows, cols)."""


def _turned(light: _Light) -> _Light:
    """Light at places (cols, rows)."""
    return lambda place: light((place[1], place[0]))


def _between_lit(dark: Bools, light: _Light, wanted: Array) -> Bools:
    """Which dark pixels have lit ones as the nearest others of their row, on both sides.

    The light beyond the edges of the sensor is infinite: one side may lie there.
    """
    found, pixels = np.zeros(dark.shape, bool), np.nonzero(dark)
    row, col = pixels
    if not row.size:
        return found
    # Dark pixels beside each other in a row are a run, which has one pixel before and one behind.
    first = np.r_[True, (np.diff(row) != 0) | (np.diff(col) != 1)]
    last = np.r_[first[1:], True]
    run = np.cumsum(first) - 1
    ends = (col[first] - 1, col[last] + 1)
    before, after = (_lit_at(light, row[first], each, dark.shape[1])[run] for each in ends)
    lit = (before > wanted[pixels]) & (after > wanted[pixels])
    found[pixels] = lit & (np.minimum(before, after) < np.inf)
    return found


def _lit_at(light: _Light, row: Ints, col: Ints, cols: int) -> Array:
    """Light at these places; infinite beyond the edges of the sensor."""
    inside = (col >= 0) & (col < cols)
    found = np.full(len(col), np.inf)
    found[inside] = light((row[inside], col[inside]))
    return found


_WIDTH, _EVERY = 11, 2
"""Rows and columns of the square with whose median a pixel is compared, and every how many of them
count: clusters of 5×5 pixels are less than half of it."""

_LEAST_FRAMES = 51
"""Frames from which deviations are compared: of n frames that do not depend on each other a
deviation errs by 1/√(2(n − 1)), of which the limit 1/2 is then five times."""


def unresponsive(gain: Array, deviation: Array, frames: int) -> Array:
    """Pixels of less than half the response of their neighbours.

    Parameters
    ----------
    gain : ndarray, shape (rows, cols)
        Gain of each pixel, the inverse of its response.
    deviation : ndarray, shape (rows, cols)
        Standard deviation of each pixel over the frames.
    frames : int
        Number of frames.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        Pixels whose gain, or whose deviation from 51 frames on, has that response.
    """
    limit = DefectLimits.response
    weak: Array = ~((gain > 0) & (gain <= 1 / limit))
    if frames >= _LEAST_FRAMES:
        weak |= deviation < limit * _median(deviation)
    return weak


def _median(values: Array) -> Array:
    """Median over the square around each pixel, reflected about the edge pixels."""
    padded = np.pad(values, _WIDTH // 2, mode="reflect")
    squares = np.lib.stride_tricks.sliding_window_view(padded, (_WIDTH, _WIDTH))
    median: Array = np.median(squares[:, :, ::_EVERY, ::_EVERY], axis=(2, 3))
    return median


@dataclass(frozen=True)
class DefectLimits(Brief):
    """Limits of `find_defects`, each adjustable.

    Attributes
    ----------
    response : float
        Response below which a pixel is dead, over that of its neighbours: 1/2 in GB/T 17444-2013
        [1]_, over the mean response, of which an uneven source would make dead corners.
    gain : float
        1/(1 + K) above which a pixel does not respond: K → −1 has no bound.
    noise : float
        Noise above which a pixel is noisy (overheated), over that which pixels of its signal have
        in common: 2 in GB/T 17444-2013, over the mean noise.
    correlation : float
        Standard deviations by which von Neumann's ratio of a noisy pixel must lie below that of
        white noise for flicker.
    range : float
        Share of the array's range of levels in which a pixel must have values.
    misfit : float
        Standard deviations beyond which the misfit of a curve is not that of the others: of noise,
        and of what the order lacks in all pixels.

    References
    ----------
    .. [1] GB/T 17444-2013, "Measuring methods for parameters of infrared focal plane arrays".
    """

    response: float = 0.5
    gain: float = 10.0
    noise: float = 2.0
    correlation: float = 5.0
    range: float = 0.5
    misfit: float = 6.0

    def __post_init__(self) -> None:
        """Refuse limits that are not above 0."""
        for name, value in vars(self).items():
            if not number(name, value) > 0:
                raise InputError(f"'{name}' (--{name}-limit) is {value!r}, expected more than 0")

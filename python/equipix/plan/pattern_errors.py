"""Errors of a pattern of shifts: by noise, by frequency, by errors of the shifts."""

from dataclasses import dataclass
from functools import cached_property
from math import ceil, lgamma

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander

from equipix._check import Array, Floats, Ints, naming_memory
from equipix.exposures.exposures import Exposures, FitOptions
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Positions
from equipix.measured.measured import measured_of

_INSIDE = 32
"""Rows (or columns) that stand for all those away from the edges: as many as sum a beam of a sixth
of the sensor exactly."""

_SMALLEST, _SPANS, _OF_A_STRIP = 256, 2, 16
"""The part of a large sensor that is drawn: so many pixels, or spans of the shifts, wide. At two
spans opposite edges do not meet. Of a strip, narrower than that, 16 spans of its length are."""

_DEEP, _SPANS_OF_DEEP = 3, 8
"""Corners that add so many times the variance of all other pixels show nearly periodic waves, which
reach far from edges and corners: then so many spans are drawn."""

_PER_EDGE = 0.5
"""Longer paths add to the variance at an edge a share of what paths of one step add there: for
shifts of 20 to 50 pixels between 0.1 and 0.9 of it."""

_FEWEST, _MOST, _PIXELS = 3, 24, 200_000
"""Draws of noise: as many as have so many pixels in all, between two bounds. Of a part of a sensor
that share of them is made, and at least one: their errors count by that share."""

_NOISE, _TOLERANCE = 1e-3, 1e-4
"""Of the draws: small enough to be linear. A tolerance of 1e-5 changes the rms by 0.1 %."""

_LONGEST, _BINS = 32, 1024
"""Waves along an axis that are taken one by one, and into how many parts the others are divided."""


@dataclass(frozen=True, eq=False)
class LocalVariance:
    """Variance of M for noise of variance 1, but for a factor near 1 over the whole sensor.

    With M = 1 and unit weights the least-squares problem S g = b has S = D_M − B·D_L⁻¹·Bᵀ, and
    noise of variance 1 leaves g of covariance S⁻¹. With S = D_M − K D_M, the probability that a
    walk from pixel p to a cell, and from there to a pixel of that cell, returns is the diagonal

        K_p = Σ_k c_k⁴ L(u_k)² / C(u_k) / D_M(p),   D_M(p) = Σ_k c_k² L(u_k)²,

    C(u) being the sum of c² of the exposures that cover cell u: fewer of them near the edges. So
    (S⁻¹)_pp ≈ 1 / (D_M (1 − K)); longer paths are included by `factor`.
    """

    shape: tuple[int, int]
    positions: Ints
    powers: Floats
    width: float | None

    def at(self, rows: Array, cols: Array) -> Floats:
        """Evaluate it on a grid of rows and columns, (rows, cols), infinite where undetermined."""
        powers2 = self.powers**2
        light = [_light(*each, self.width) for each in self._axes(rows, cols)]
        seen_by = [_seen_by(*each) for each in self._axes(rows, cols)]
        weights: Floats = np.zeros((len(rows), len(cols)))
        returning = np.zeros_like(weights)
        for power2, lit_down, lit_right, down, right in zip(powers2, *light, *seen_by, strict=True):
            weight = power2 * np.outer(lit_down, lit_right)
            weights += weight
            returning += power2 * weight / ((down * powers2) @ right.T)
        # Alone in all its cells, a pixel is compared with nothing.
        rest = weights - returning
        return np.divide(1, rest, where=rest > 1e-9 * weights, out=np.full_like(rest, np.inf))

    @cached_property
    def mean(self) -> float:
        """Mean over the pixels that are determined; infinite if none is.

        Away from the edges it changes with the beam alone, as a smooth function.
        """
        spans = np.ptp(self.positions, axis=0).tolist()
        (rows, heights), (cols, widths) = map(_places, self.shape, spans)
        found = self.at(rows, cols)
        known = np.isfinite(found)
        areas = np.outer(heights, widths)
        total = np.sum(areas, where=known)
        return float(np.sum(found * areas, where=known) / total) if total else np.inf

    def _axes(self, rows: Array, cols: Array) -> list[tuple[int, Array, Ints]]:
        return list(zip(self.shape, (rows, cols), self.positions.T, strict=True))


def _seen_by(size: int, places: Array, positions: Ints) -> Floats:
    """Whether exposure l covers the cell that place i sees in exposure k: (k, i, l)."""
    away = places[None, :, None] + positions[:, None, None] - positions
    return ((away >= 0) & (away < size)).astype(np.float64)


def _light(size: int, places: Array, positions: Ints, width: float | None) -> Floats:
    """Square of a Gaussian beam's factor along one axis, at each place: (k, i)."""
    away = places + positions[:, None] - (size - 1) / 2
    return np.ones(away.shape) if width is None else np.exp(-2 * (away / width) ** 2)


def _places(size: int, span: int) -> tuple[Floats, Floats]:
    """Places along an axis over which a sum, with these weights, is that over all pixels.

    Within a span of an edge all pixels; of those between, the nodes of Gauss' quadrature for sums
    over equidistant points, exact for polynomials of degree 63.
    """
    inside = size - 2 * span
    if inside <= _INSIDE:
        return np.arange(float(size)), np.ones(size)
    # The recurrence of the polynomials that are orthogonal on these points (Gram's).
    k = np.arange(1, _INSIDE)
    beside = np.sqrt(k**2 * (inside**2 - k**2) / (4 * (4 * k**2 - 1)))
    nodes, vectors = np.linalg.eigh(np.diag(beside, 1) + np.diag(beside, -1))
    edge = np.arange(float(span))
    places = np.concatenate([edge, (size - 1) / 2 + nodes, size - span + edge])
    return places, np.concatenate([np.ones(span), inside * vectors[0] ** 2, np.ones(span)])


def factor(shape: tuple[int, int], positions: Ints, powers: Floats) -> float:
    """What `LocalVariance` must be multiplied by, under an even beam.

    It counts the longer ways, and nearly periodic waves with them, by draws of noise on a part of
    the sensor that has corners, edges and little else. The sum of the variances over a larger
    sensor is that of a sensor without edges for each pixel, a share for each pixel of an edge, and
    one for the four corners. The first is the mean of 1/λ over all waves; the second is known well
    enough, since edges are a small part of a large sensor; the third follows from the draws. Of a
    strip the ends count as on the part, which is too much where shifts are nearly periodic.
    """
    is_strip = np.any(np.array(shape) < _SPANS * np.ptp(positions, axis=0))
    spans = _OF_A_STRIP if is_strip else _SPANS
    whole = LocalVariance(shape, positions, powers, None)
    found, corners = _from_part(whole, spans)
    if corners > _DEEP:
        found, _ = _from_part(whole, _SPANS_OF_DEEP)
    return found


def _from_part(whole: LocalVariance, spans: int) -> tuple[float, float]:
    """That factor, and what corners add in a part so many spans wide, as a share of all else.

    0 where that is not asked: the part is the whole, or a strip that has all but its ends.
    """
    shape, positions, powers = whole.shape, whole.positions, whole.powers
    wide = np.maximum(_SMALLEST, spans * np.ptp(positions, axis=0)).tolist()
    rows, cols = map(min, shape, wide)
    share = rows * cols / (shape[0] * shape[1])
    part = LocalVariance((rows, cols), positions, powers, None)
    drawn = _drawn(part, 1 if spans == _OF_A_STRIP else share)
    if spans == _OF_A_STRIP or part.shape == shape:
        return drawn, 0.0
    of_part, of_whole = (_of_waves(each) * (1 + _PER_EDGE * _edges(each)) for each in (part, whole))
    corners = drawn / of_part - 1
    return float(of_whole * (1 + corners * share)), corners


def _drawn(local: LocalVariance, share: float) -> float:
    """Mean variance of M in draws of noise over that of `local`; only a share of the draws."""
    powers, variance = local.powers, local.at(*map(np.arange, local.shape))
    rng = np.random.default_rng(0)
    light = powers[:, None, None] * np.ones((1, *local.shape))
    positions, flux = Positions.of(local.positions), Flux.of(powers, None, None, len(powers))
    # A bare fit, without the tests of what is given. One thread: on so small a part two are slower.
    options = FitOptions(tolerance=_TOLERANCE, workers=1)
    ratios: list[float] = []
    draws = min(max(_PIXELS // variance.size, _FEWEST), _MOST)
    for _ in range(ceil(share * draws)):
        with naming_memory("planning"):
            measured = measured_of(light + _NOISE * rng.standard_normal(light.shape))
            exposures = Exposures(positions=positions, flux=flux, **vars(measured))
        solved = exposures.fit(options)
        error = (solved.sensitivity - np.nanmean(solved.sensitivity)) / _NOISE
        valid = np.isfinite(error) & np.isfinite(variance)
        ratios.append(float(np.sum(error**2, where=valid) / np.sum(variance, where=valid)))
    return float(np.mean(ratios))


def _edges(local: LocalVariance) -> float:
    """What edges add to the variance by paths of one step, as a share of it."""
    powers2 = local.powers**2
    return float(local.mean * (powers2.sum() - np.sum(powers2**2) / powers2.sum()) - 1)


def _of_waves(local: LocalVariance) -> float:
    """Mean of 1/λ over the waves of a sensor without edges, over that of paths of one step.

    The waves are those without a slope at its edges. Of waves longer than a few pixels each counts;
    of the others many are alike, and a dip that is narrower than their distance is taken for as
    deep as it is on average there.
    """
    powers2 = local.powers**2
    (rows, heights), (cols, widths) = map(_waves, local.shape)
    variances = np.diag(np.cov(local.positions.T, bias=True, aweights=powers2))
    steps = np.add.outer(*(v * w**2 for v, w in zip(variances, (heights, widths), strict=True)))
    total = np.sum(powers2)
    shares = np.outer(heights, widths)
    shares[0, 0] = 0
    values = [symbol(rows, sign * cols, local.positions, powers2) for sign in (1, -1)]
    inverse = [np.sum(shares / np.maximum(each, total * steps / 12)) for each in values]
    # The mean of λ, and of paths of one step, is Σ c² − Σ c⁴ / Σ c².
    return float(np.mean(inverse) / np.pi**2 * (total - np.sum(powers2**2) / total))


def _waves(size: int) -> tuple[Floats, Floats]:
    """Angular frequencies of waves along an axis, from 0 to π, and how much of that each covers."""
    long = min(size, _LONGEST)
    ends = np.linspace(long, size, min(size - long, _BINS) + 1)
    places = np.concatenate([np.arange(long), (ends[1:] + ends[:-1] - 1) / 2])
    return np.pi / size * places, np.pi / size * np.concatenate([np.ones(long), np.diff(ends)])


_DEGREE = 6
"""Of the polynomials: 3 leaves 0.3 % of the error, measured against `calibrate`; 6, 0.1 %."""

_NODES = 10
"""Of the quadrature along an axis: exact for products of two such polynomials and more."""


def shift_error_effect(
    shape: tuple[int, int], shifts: Floats, powers: Floats, width: float | None, error: float
) -> tuple[float, tuple[float, float]]:
    """Root mean square of M's error, and its tilt, that independent errors of shifts leave.

    An even beam, without a width, leaves none.

    An error δ of d_k changes ln y_k by δ·∇ln L(u_k), and ln L = −|u|²/D². What M and L then make
    of it is smooth: minimise Σ_k ∫ c_k² L² [h_k(p) − g(p) − f(p + d_k)]² over polynomials g on
    the sensor and f on the beam, for each h_k that one exposure's error along one axis makes.
    """
    if width is None or not error:
        return 0.0, (0.0, 0.0)
    places, weights = _nodes(shape)
    low = shifts.min(axis=0) - 0.5
    extent = np.ptp(shifts, axis=0) + shape
    on_sensor = _basis(places, np.array([-0.5, -0.5]), np.array(shape, float))
    count, centre = len(shifts), (np.array(shape) - 1) / 2
    equations, causes = [], np.zeros((2 * count, count, len(weights)))
    for k, (shift, power) in enumerate(zip(shifts, powers, strict=True)):
        seen = places + shift[:, None]
        away = seen - centre[:, None]
        light = power * np.exp(-(away[0] ** 2 + away[1] ** 2) / width**2)
        root = np.sqrt(weights) * light
        equations.append(root[:, None] * np.hstack([on_sensor, _basis(seen, low, extent)]))
        causes[2 * k : 2 * k + 2, k] = root * (-2 * error / width**2) * away
    matrix = np.concatenate(equations)
    found = np.linalg.lstsq(matrix, causes.reshape(2 * count, -1).T, rcond=1e-10)[0]
    errors = on_sensor @ found[: on_sensor.shape[1]]
    errors -= weights @ errors
    # Least-squares slopes: the two axes of the sensor are orthogonal.
    slopes = []
    for axis in places:
        lever = weights * (axis - weights @ axis)
        slopes.append(float(np.linalg.norm(lever @ errors) / (lever @ axis)))
    tilt = [size * slope if size > 1 else 0.0 for size, slope in zip(shape, slopes, strict=True)]
    return float(np.sqrt(np.sum(weights @ errors**2))), (tilt[0], tilt[1])


def _nodes(shape: tuple[int, int]) -> tuple[Floats, Floats]:
    """Gauss-Legendre nodes over the area of the pixels, (2, m), and weights that add up to 1."""
    nodes, weights = leggauss(_NODES)
    rows, cols = ((size - 1 + size * nodes) / 2 for size in shape)
    places = np.stack([np.repeat(rows, _NODES), np.tile(cols, _NODES)])
    return places, np.outer(weights, weights).ravel() / 4


def _basis(places: Floats, low: Floats, extent: Floats) -> Floats:
    """Products of Legendre polynomials on a rectangle: (places, functions)."""
    across = [
        legvander(2 * (along - start) / length - 1, _DEGREE)
        for along, start, length in zip(places, low, extent, strict=True)
    ]
    products = across[0][:, :, None] * across[1][:, None, :]
    return np.asarray(products.reshape(places.shape[1], -1))


_FINER = 64
"""Steps within one of the grid of frequencies, to each side, that the smallest λ is refined by."""

_PASSES, _PASSES_OF_A_WAVE, _WEAK, _WEAKEST = 20, 0.55, 0.2, 1e-4
"""Products without weak waves, and of each weak wave with λ/n a quarter of that of `_WEAK`; λ/n
below which a wave is weak, and one that is as good as undetermined. Fitted to 102 patterns of five
to nine positions at 391×291 and 782×582, 19 to 955 products: the rms deviation is a fifth."""

_FREQUENCIES = 512
"""Between 0 and half a cycle per pixel: finer than the dips of patterns up to this many pixels."""


@dataclass(frozen=True, eq=False, repr=False)
class Spectrum:
    """The symbol of the least-squares problem for waves of the sensitivity, far from the edges.

    Attributes
    ----------
    rows : ndarray, shape (513,), float64
        Frequencies along the rows' axis, in cycles per pixel, from 0 to 1/2.
    cols : ndarray, shape (1025,), float64
        Frequencies along the columns' axis, from −1/2 to 1/2.
    values : ndarray, shape (513, 1025), float64
        λ(q) from 0 (an undetermined wave) to n. For random noise σ the variance of the
        wave's amplitude is proportional to σ²/λ.
    worst : tuple of float
        Frequency (row, col) of the smallest λ away from long waves: a nearly periodic one, whose
        phase is about the same in all exposures. NaN if all waves are long.
    smallest : float
        λ there.
    passes : float
        Products with the data that `calibrate` is expected to take for such shifts, whatever the
        size of the sensor: within a factor of two up to 60 of them. At whole shifts of one
        orientation it takes hardly more than 100. Between pixels `passes` only compares patterns.
    """

    rows: Floats
    cols: Floats
    values: Array
    worst: tuple[float, float]
    smallest: float
    passes: float

    def __repr__(self) -> str:
        """Short form: the worst wave."""
        return (
            f"<Spectrum: λ falls to {self.smallest:.3g} at ({self.worst[0]:.3f}, "
            f"{self.worst[1]:.3f}) cycles per pixel>"
        )


def symbol(rows: Floats, cols: Floats, shifts: Array, powers2: Floats) -> Floats:
    """Evaluate λ(q) on a grid of angular frequencies, (rows, cols).

    It is Σ c² − |Σ c² e^{iq·d}|² / Σ c², or n − |Σ e^{iq·d}|²/n for c = 1.
    """
    down = np.exp(1j * np.outer(rows, shifts[:, 0])) * powers2
    right = np.exp(1j * np.outer(shifts[:, 1], cols))
    total = np.sum(powers2)
    sums = down @ right
    return np.asarray(total - (sums.real**2 + sums.imag**2) / total)


def spectrum(shifts: Array, powers: Floats) -> Spectrum:
    """Evaluate λ(q) on a grid, and find the worst wave."""
    rows = np.linspace(0, 0.5, _FREQUENCIES + 1)
    cols = np.linspace(-0.5, 0.5, 2 * _FREQUENCIES + 1)
    values = symbol(2 * np.pi * rows, 2 * np.pi * cols, shifts, powers**2)
    # A wave is long if its phases scatter by less than a radian over the exposures, where λ is
    # still close to n·qᵀ·cov(d)·q.
    covariance = (2 * np.pi) ** 2 * np.cov(shifts.T, bias=True)
    scatter = (
        covariance[0, 0] * rows[:, None] ** 2
        + 2 * covariance[0, 1] * rows[:, None] * cols
        + covariance[1, 1] * cols**2
    )
    short = np.where(scatter < 1, np.inf, values)
    row, col = np.unravel_index(short.argmin(), short.shape)
    passes = _passes(short / np.sum(powers**2))
    if np.isinf(short[row, col]):
        return Spectrum(rows, cols, values, (np.nan, np.nan), np.nan, passes)
    worst = float(rows[row]), float(cols[col])
    return Spectrum(rows, cols, values, worst, float(values[row, col]), passes)


def _passes(short: Floats) -> float:
    """Predict the products of conjugate gradients from λ/n of all waves but long ones.

    Each wave with a local minimum of λ leaves an eigenvalue, or some, below those of all others:
    the deeper it is, the more products it takes.
    """
    # Beyond its edges the spectrum goes on: it repeats, and is the same for q and −q.
    around = np.concatenate([short[1:2, ::-1], short, short[-2:-1, ::-1]])
    around = np.concatenate([around[:, -2:-1], around, around[:, 1:2]], axis=1)
    lowest = np.minimum(np.minimum(around[:-2], around[1:-1]), around[2:])
    lowest = np.minimum(np.minimum(lowest[:, :-2], lowest[:, 1:-1]), lowest[:, 2:])
    rows, cols = np.nonzero((short == lowest) & (short < _WEAK))
    # The last column is the first. Of the first and last row each wave is there twice.
    counts = np.where(cols == short.shape[1] - 1, 0, np.where(rows % _FREQUENCIES == 0, 0.5, 1))
    depths = np.sqrt(_WEAK / np.maximum(short[rows, cols], _WEAKEST)) - 1
    return float(_PASSES + _PASSES_OF_A_WAVE * np.sum(counts * depths))


def usual_passes(patterns: Array) -> Floats:
    """Predict the products for patterns (..., n, 2), as if their positions were chosen at random.

    The phases of a wave at the positions are then independent, and the waves with λ/n < t are
    those within a ball of n − 1 dimensions: their share is c·t^((n − 1)/2). Around each minimum λ₀
    it is (t − λ₀) / (4π √det Σ), with Σ the covariance of the positions. So the depths of `_passes`
    add up to π √det Σ · c · (n − 1)/(n − 4) · t^((n − 3)/2) at t = `_WEAK`. Of fewer than five
    positions the deepest minima decide: they count as five.
    """
    count = max(patterns.shape[-2], 5)
    half = (count - 1) / 2
    share = half * np.log(count / (4 * np.pi)) - lgamma(half + 1) + np.log(count) / 2
    of_spread = np.pi * np.exp(share + (half - 1) * np.log(_WEAK)) * (count - 1) / (count - 4)
    away = patterns - patterns.mean(axis=-2, keepdims=True)
    covariances = np.swapaxes(away, -1, -2) @ away / patterns.shape[-2]
    # Of positions on a line rounding may leave less than 0.
    spread = np.sqrt(np.maximum(np.linalg.det(covariances), 0))
    return np.asarray(_PASSES + _PASSES_OF_A_WAVE * of_spread * spread)


def smallest_near(found: Spectrum, shifts: Array) -> float:
    """Refine the smallest λ between the frequencies of the spectrum, for fluxes of 1.

    Shifts between pixels may make a wave periodic whose frequency is none of the grid's.
    """
    steps = np.linspace(-1, 1, 2 * _FINER + 1) / (2 * _FREQUENCIES)
    rows, cols = (2 * np.pi * (steps + middle) for middle in found.worst)
    return float(symbol(rows, cols, shifts, np.ones(len(shifts))).min())

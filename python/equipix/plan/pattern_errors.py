"""Errors of a pattern of shifts: by noise, by frequency, by errors of the shifts."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander

from equipix._check import Array, Floats, Ints, naming_memory
from equipix.exposures.exposures import Exposures, FitOptions
from equipix.exposures.flux import Flux
from equipix.exposures.positions import Positions
from equipix.measured.measured import measured_of

_BLOCK = 64
"""Rows at a time, at least."""

_SMALLEST, _SPANS = 256, 8
"""The part of a large sensor that is drawn: so many pixels, or spans of the shifts, wide. Of four
spans the error of five positions near the corners of a square came out 9 % too large."""

_FEWEST, _MOST, _PIXELS = 3, 24, 200_000
"""Draws of noise: as many as have so many pixels in all, between two bounds."""

_NOISE, _TOLERANCE = 1e-3, 1e-4
"""Of the draws: small enough to be linear. A tolerance of 1e-5 changes the rms by 0.1 %."""


def local_variance(
    shape: tuple[int, int],
    positions: Ints,
    powers: Floats,
    width: float | None,
    *,
    scale: float = 1.0,
) -> Iterator[Floats]:
    """Variance of M for noise of variance 1, but for a factor near 1 over the whole sensor.

    With M = 1 and unit weights the least-squares problem S g = b has S = D_M − B·D_L⁻¹·Bᵀ, and
    noise of variance 1 leaves g of covariance S⁻¹. With S = D_M − K D_M, the probability that a
    walk from pixel p to a cell, and from there to a pixel of that cell, returns is the diagonal

        K_p = Σ_k c_k⁴ L(u_k)² / C(u_k) / D_M(p),   D_M(p) = Σ_k c_k² L(u_k)²,

    C(u) being the sum of c² of the exposures that cover cell u: fewer of them near the edges. So
    (S⁻¹)_pp ≈ 1 / (D_M (1 − K)); longer paths are included by `factor`.
    """
    rows, cols = shape
    places = positions - positions.min(axis=0)
    spans = places.max(axis=0)
    seen_by = [_seen_by(size, places[:, axis]) for axis, size in enumerate(shape)]
    light = [_light(size, positions[:, axis], width) for axis, size in enumerate(shape)]
    powers2 = powers**2
    # As many rows as the exposures are apart: then few cells belong to two blocks.
    height = max(_BLOCK, int(spans[0]))
    for start in range(0, rows, height):
        part = slice(start, min(start + height, rows))
        cells = slice(part.start, part.stop + spans[0])
        seen = (seen_by[0][cells] * powers2) @ seen_by[1].T
        weights: Floats = np.zeros((part.stop - part.start, cols))
        returning = np.zeros_like(weights)
        for k, (row, col) in enumerate(places):
            weight = powers2[k] * np.outer(light[0][k, part], light[1][k])
            weights += weight
            returning += powers2[k] * weight / seen[row : row + len(weight), col : col + cols]
        # Alone in all its cells, a pixel is compared with nothing.
        rest = weights - returning
        yield scale * np.divide(
            1, rest, where=rest > 1e-9 * weights, out=np.full_like(rest, np.inf)
        )


def _seen_by(size: int, places: Ints) -> Floats:
    """Whether exposure l covers row (or column) i of the beam, counted from the first: (i, l)."""
    away = np.arange(size + places.max())[:, None] - places
    return ((away >= 0) & (away < size)).astype(np.float64)


def _light(size: int, positions: Ints, width: float | None) -> Floats:
    """Square of a Gaussian beam's factor along one axis, at each row (or column): (k, i)."""
    places = np.arange(size) + positions[:, None] - (size - 1) / 2
    return np.ones(places.shape) if width is None else np.exp(-2 * (places / width) ** 2)


def factor(shape: tuple[int, int], positions: Ints, powers: Floats) -> float:
    """What `local_variance` must be multiplied by, from draws of noise.

    It counts the longer ways, and nearly periodic waves with them. It falls with the size of the
    sensor, in spans of the shifts, to a limit; of a large one a part is solved, under an even beam.
    """
    spans = np.ptp(positions, axis=0).tolist()
    rows, cols = (
        min(size, max(_SMALLEST, _SPANS * span)) for size, span in zip(shape, spans, strict=True)
    )
    rng = np.random.default_rng(0)
    local = np.concatenate(list(local_variance((rows, cols), positions, powers, None)))
    light = powers[:, None, None] * np.ones((1, rows, cols))
    ratios: list[float] = []
    for _ in range(min(max(_PIXELS // local.size, _FEWEST), _MOST)):
        frames = light + _NOISE * rng.standard_normal(light.shape)
        # A bare fit, without the test of the sign. One thread: on so small a part two are slower.
        options = FitOptions(tolerance=_TOLERANCE, workers=1)
        with naming_memory("planning"):
            measured, flux = measured_of(frames), Flux.of(powers, None, None, len(powers))
            exposures = Exposures.of(measured, Positions.of(positions), flux)
        solved = exposures.fit(options)
        error = (solved.sensitivity - np.nanmean(solved.sensitivity)) / _NOISE
        valid = np.isfinite(error) & np.isfinite(local)
        ratios.append(float(np.sum(error**2, where=valid) / np.sum(local, where=valid)))
    return float(np.mean(ratios))


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
    """

    rows: Floats
    cols: Floats
    values: Array
    worst: tuple[float, float]
    smallest: float

    def __repr__(self) -> str:
        """Short form: the worst wave."""
        return (
            f"<Spectrum: λ falls to {self.smallest:.3g} at ({self.worst[0]:.3f}, "
            f"{self.worst[1]:.3f}) cycles per pixel>"
        )


def spectrum(shifts: Array, powers: Floats) -> Spectrum:
    """Evaluate λ(q) = Σ c² − |Σ c² e^{iq·d}|² / Σ c², which is n − |Σ e^{iq·d}|²/n for c = 1."""
    rows = np.linspace(0, 0.5, _FREQUENCIES + 1)
    cols = np.linspace(-0.5, 0.5, 2 * _FREQUENCIES + 1)
    down = np.exp(2j * np.pi * np.outer(rows, shifts[:, 0])) * powers**2
    right = np.exp(2j * np.pi * np.outer(shifts[:, 1], cols))
    total = np.sum(powers**2)
    values = total - np.abs(down @ right) ** 2 / total
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
    if np.isinf(short[row, col]):
        return Spectrum(rows, cols, values, (np.nan, np.nan), np.nan)
    worst = float(rows[row]), float(cols[col])
    return Spectrum(rows, cols, values, worst, float(values[row, col]))


def smallest_near(found: Spectrum, shifts: Array) -> float:
    """Refine the smallest λ between the frequencies of the spectrum, for fluxes of 1.

    Shifts between pixels may make a wave periodic whose frequency is none of the grid's.
    """
    steps = np.linspace(-1, 1, 2 * _FINER + 1) / (2 * _FREQUENCIES)
    down, right = (
        np.exp(2j * np.pi * np.outer(steps + middle, along))
        for middle, along in zip(found.worst, shifts.T, strict=True)
    )
    count = len(shifts)
    return float((count - np.abs(down @ right.T) ** 2 / count).min())

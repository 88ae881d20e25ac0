"""Effect of errors of shifts: large-scale errors that leave almost no residual."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander

from equipix._types import Floats

_DEGREE = 6
"""Of the polynomials: 3 leaves 0.3 % of the error, measured against `calibrate`; 6, 0.1 %."""

_NODES = 10
"""Of the quadrature along an axis: exact for products of two such polynomials and more."""


@dataclass(frozen=True, eq=False)
class _Nodes:
    """Quadrature nodes on the sensor, as flat arrays."""

    rows: Floats
    cols: Floats
    weights: Floats


def shift_error_effect(
    shape: tuple[int, int], shifts: Floats, powers: Floats, width: float, error: float
) -> tuple[float, tuple[float, float]]:
    """Root mean square of M's error, and its tilt, that independent errors of shifts leave.

    An error δ of d_k changes ln y_k by δ·∇ln L(u_k), and ln L = −|u|²/D². What M and L then make
    of it is smooth: minimise Σ_k ∫ c_k² L² [h_k(p) − g(p) − f(p + d_k)]² over polynomials g on
    the sensor and f on the beam, for each h_k that one exposure's error along one axis makes.
    """
    nodes = _nodes(shape)
    low = shifts.min(axis=0) - 0.5
    extent = np.ptp(shifts, axis=0) + shape
    on_sensor = _basis(nodes.rows, nodes.cols, np.array([-0.5, -0.5]), np.array(shape, float))
    count, centre = len(shifts), (np.array(shape) - 1) / 2
    equations, causes = [], np.zeros((2 * count, count, len(nodes.rows)))
    for k, (shift, power) in enumerate(zip(shifts, powers, strict=True)):
        rows, cols = nodes.rows + shift[0], nodes.cols + shift[1]
        away = rows - centre[0], cols - centre[1]
        light = power * np.exp(-(away[0] ** 2 + away[1] ** 2) / width**2)
        root = np.sqrt(nodes.weights) * light
        on_beam = _basis(rows, cols, low, extent)
        equations.append(root[:, None] * np.hstack([on_sensor, on_beam]))
        causes[2 * k, k] = root * (-2 * error / width**2) * away[0]
        causes[2 * k + 1, k] = root * (-2 * error / width**2) * away[1]
    matrix = np.concatenate(equations)
    found = np.linalg.lstsq(matrix, causes.reshape(2 * count, -1).T, rcond=1e-10)[0]
    errors = on_sensor @ found[: on_sensor.shape[1]]
    errors -= nodes.weights @ errors
    # Least-squares slopes: the two axes of the sensor are orthogonal.
    tilt = [_slope(axis, errors, nodes) for axis in (nodes.rows, nodes.cols)]
    sizes = [size if size > 1 else 0 for size in shape]
    rms = np.sqrt(np.sum(nodes.weights @ errors**2))
    return float(rms), (float(sizes[0] * tilt[0]), float(sizes[1] * tilt[1]))


def _nodes(shape: tuple[int, int]) -> _Nodes:
    """Gauss-Legendre nodes over the area of the pixels; the weights add up to 1."""
    nodes, weights = leggauss(_NODES)
    rows, cols = ((size - 1 + size * nodes) / 2 for size in shape)
    return _Nodes(
        np.repeat(rows, _NODES), np.tile(cols, _NODES), np.outer(weights, weights).ravel() / 4
    )


def _basis(rows: Floats, cols: Floats, low: Floats, extent: Floats) -> Floats:
    """Products of Legendre polynomials on a rectangle: (places, functions)."""
    across = [
        legvander(2 * (places - start) / length - 1, _DEGREE)
        for places, start, length in zip((rows, cols), low, extent, strict=True)
    ]
    products = across[0][:, :, None] * across[1][:, None, :]
    return np.asarray(products.reshape(len(rows), -1))


def _slope(places: Floats, errors: Floats, nodes: _Nodes) -> float:
    """Root of the summed squares of the slopes of several errors along an axis."""
    lever = nodes.weights * (places - nodes.weights @ places)
    return float(np.linalg.norm(lever @ errors) / (lever @ places))

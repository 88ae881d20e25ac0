"""A scene that moves over an array with gain and offset of its own in each pixel."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from equipix._check import ArrayLike, Floats, check_shape
from equipix.errors import InputError
from equipix.shown import Brief

_FIELD = 1024
"""Rows and columns of the field, which is periodic."""

_CLIPPED = 2.5
"""Largest value of the field in standard deviations."""

_TURN = 0.1
"""Standard deviation of the change of direction from frame to frame, in radians."""

_SPEED, _PERIOD = 1.5, 61
"""Mean and amplitude of the speed in pixels a frame, and the period of its change in frames."""

_LOW, _HIGH, _RAMP = 0.25, 0.75, 500
"""Ends of the triangle of the mean level, and the frames of one of its sides."""


class Frame(NamedTuple):
    """A simulated frame.

    Attributes
    ----------
    values : ndarray, shape (rows, cols)
        Raw values on the scale [0, 1]; offsets and noise may exceed it.
    level : float
        Mean level b of the scene.
    moving : bool
        Whether the scene moves on after this frame.
    """

    values: Floats
    level: float
    moving: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class MovingScene(Brief):
    """A textured scene that moves over an array of pixels with different gains and offsets.

    Frames are y = G x + O + noise of the scene x = b + contrast · S(p + c). S is a periodic random
    field of 1024×1024 cells with amplitude 1/f, unit rms, clipped at 2.5. It is sampled at the
    position c by cubic B-splines. The speed is 1.5 + 1.5·sin(2πt/61) pixels a frame, and the
    direction is a random walk of 0.1 rad a frame. The mean level b is a triangle from 0.25 to 0.75,
    500 frames each way. The defaults are the standard scene of the package's tests.

    Attributes
    ----------
    seed : int
        Seed of field, pattern, path and noise, each with random numbers of its own.
    shape : tuple of int
        Rows and columns of the array, at most 1020.
    stop : tuple of int
        First frame of the stop, and the first after it.
    running : bool
        Whether b runs on during the stop.
    contrast, gain_spread, offset_spread, noise : float
        Standard deviations of scene, gain, offset and noise, on the scale [0, 1].

    Examples
    --------
    >>> from equipix.simulate import MovingScene
    >>> scene = MovingScene(seed=1, shape=(32, 32))
    >>> first = next(scene.frames(1))
    >>> first.level
    0.25
    """

    seed: int
    shape: tuple[int, int] = (256, 256)
    stop: tuple[int, int] = (250, 350)
    running: bool = False
    contrast: float = 0.1
    gain_spread: float = 0.05
    offset_spread: float = 0.1
    noise: float = 0.002

    def __post_init__(self) -> None:
        """Refuse an array that the periodic field does not cover once."""
        if max(check_shape(self.shape)) > _FIELD - 4:
            raise InputError(
                f"'shape' is {self.shape}, expected at most {_FIELD - 4} pixels a side"
            )

    def _random(self, purpose: int) -> np.random.Generator:
        """Give the random numbers of one purpose: field, pattern, path or noise."""
        return np.random.default_rng([self.seed, purpose])

    @cached_property
    def coefficients(self) -> Floats:
        """Coefficients of the field's cubic B-spline, shape (1024, 1024)."""
        frequency = np.fft.fftfreq(_FIELD)
        radius = np.hypot(frequency[:, None], frequency[: _FIELD // 2 + 1])
        radius[0, 0] = np.inf
        white = np.fft.rfft2(self._random(0).standard_normal((_FIELD, _FIELD)))
        field = np.fft.irfft2(white / radius, s=(_FIELD, _FIELD))
        field = np.clip(field / field.std(), -_CLIPPED, _CLIPPED)
        spline = (2 + np.cos(2 * np.pi * frequency)) / 3
        spectrum = np.fft.rfft2(field) / (spline[:, None] * spline[: _FIELD // 2 + 1])
        return np.asarray(np.fft.irfft2(spectrum, s=(_FIELD, _FIELD)))

    @cached_property
    def gain(self) -> Floats:
        """Gain G of each pixel."""
        return 1 + self.gain_spread * self._random(1).standard_normal(self.shape)

    @cached_property
    def offset(self) -> Floats:
        """Offset O of each pixel, on the scale [0, 1]."""
        return self.offset_spread * self._random(2).standard_normal(self.shape)

    def scene(self, position: ArrayLike) -> Floats:
        """Field S seen from a position (row, col) in cells."""
        start = np.floor(position).astype(int)
        first, second = (_taps(fraction) for fraction in np.asarray(position) - start)
        rows, cols = (
            (start[axis] - 1 + np.arange(self.shape[axis] + 3)) % _FIELD for axis in range(2)
        )
        window = self.coefficients[np.ix_(rows, cols)]
        height, width = self.shape
        window = sum(tap * window[i : i + height] for i, tap in enumerate(first))
        return np.asarray(sum(tap * window[:, i : i + width] for i, tap in enumerate(second)))

    def frames(self, count: int) -> Iterator[Frame]:
        """Frames of the sequence, from its start.

        Parameters
        ----------
        count : int
            Number of frames, those of the stop included.

        Yields
        ------
        Frame
            Values, mean level, and whether the scene moves.
        """
        path, noise = self._random(3), self._random(4)
        position, direction = path.uniform(0, _FIELD, 2), path.uniform(0, 2 * np.pi)
        moved = 0
        for index in range(count):
            still = self.stop[0] <= index < self.stop[1]
            level = _level(index if self.running else moved)
            light = level + self.contrast * self.scene(position)
            values = self.gain * light + self.offset
            values += self.noise * noise.standard_normal(self.shape)
            yield Frame(values, level, not still)
            if not still:
                speed = _SPEED + _SPEED * np.sin(2 * np.pi * moved / _PERIOD)
                position = position + speed * np.array([np.sin(direction), np.cos(direction)])
                direction += _TURN * path.standard_normal()
                moved += 1

    def residual_pattern(self, gain: ArrayLike, offset: ArrayLike, level: float) -> float:
        """Spatial rms of what a correction g·y + o leaves at a level b.

        Parameters
        ----------
        gain, offset : array_like, shape (rows, cols)
            Coefficients g and o, for values on the scale [0, 1].
        level : float
            Mean level b of the scene.

        Returns
        -------
        float
            Standard deviation over all pixels of (gG − 1)·b + (gO + o), divided by mean(gG).
        """
        response = np.asarray(gain) * self.gain
        left = (response - 1) * level + np.asarray(gain) * self.offset + np.asarray(offset)
        return float(np.std(left) / np.mean(response))

    def gain_error(self, gain: ArrayLike) -> float:
        """Rms of gG / mean(gG) − 1 over all pixels, for gains g of a correction."""
        response = np.asarray(gain) * self.gain
        return float(np.std(response) / np.mean(response))


def _taps(fraction: float) -> Floats:
    """Weights of the four coefficients of a cubic B-spline behind a fraction of a cell."""
    f, g = fraction, 1 - fraction
    inner = [4 - 6 * f**2 + 3 * f**3, 4 - 6 * g**2 + 3 * g**3]
    return np.array([g**3, *inner, f**3]) / 6


def _level(index: int) -> float:
    """Mean level b at a frame of the triangle."""
    phase = index % (2 * _RAMP)
    return _LOW + (_HIGH - _LOW) * (1 - abs(phase - _RAMP) / _RAMP)

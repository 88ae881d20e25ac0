"""Mutants of the corrections from the scene fail what the corrections meet.

The NumPy reference on a small moving scene, with one fault each. The compiled methods agree with
the reference to rounding, see test_scene.py, so a fault of theirs is one against it.
"""

from __future__ import annotations

import numpy as np
import pytest

from equipix.simulate import MovingScene
from reference import scene as reference

SHAPE, FRAMES = (64, 64), 500
FALL, GAIN_FALL = 18, 1.15
"""Fall of the pattern of Registered after 500 moving frames; of the gain error, an eighth of the
fall of 2.2 after 2000 in docs/scene.md, since a frozen gain stays at 1."""


@pytest.fixture(scope="module")
def moving():
    return MovingScene(seed=1, shape=SHAPE, stop=(0, 0))


@pytest.fixture(scope="module")
def frames(moving):
    return list(moving.frames(FRAMES))


class Registered(reference.Registered):
    def __init__(self, step=0.1, **options):
        super().__init__(SHAPE, step, 0.5, 8, **options)


class WrongSign(Registered):
    def __init__(self):
        super().__init__(step=-0.1)


class WrongMotion(Registered):
    def motion(self, before, after):
        move, agreement = super().motion(before, after)
        return -move, agreement


class WholePixels(Registered):
    def motion(self, before, after):
        move, agreement = super().motion(before, after)
        return np.rint(move), agreement


class FullBand(Registered):
    def __init__(self):
        super().__init__(cutoff=0.5)


class FrozenGain(Registered):
    def update(self, y):
        super().update(y)
        self.gain = np.ones(SHAPE)


class Ungauged(reference.LocalMean):
    """Without parts nothing is given back."""

    def pull(self, errors, *pulls):
        super().pull(errors, *((y, error, 0 * part) for y, error, part in pulls))


class Kalman(reference.Kalman):
    def __init__(self):
        super().__init__(SHAPE, 21, 50, 0.004, (0.05, 0.1), 1e6)


class FrozenKalman(Kalman):
    def learn(self):
        super().learn()
        self.state[0] = 1
        self.gain = np.ones(SHAPE)


def falls(method, moving, frames):
    """Falls of pattern and gain error, and the mean response."""
    for frame in frames:
        method.update(frame.values)
    ones, level = np.ones(SHAPE), frames[-1].level
    left = moving.residual_pattern(method.gain, method.offset, level)
    gains = moving.gain_error(ones) / moving.gain_error(method.gain)
    return moving.residual_pattern(ones, 0 * ones, level) / left, gains


def test_registered_meets_what_its_mutants_fail(moving, frames):
    pattern, gains = falls(Registered(), moving, frames)
    assert pattern >= FALL
    assert gains >= GAIN_FALL


@pytest.mark.long
@pytest.mark.parametrize("mutant", [WrongSign, WrongMotion, WholePixels, FullBand])
def test_the_pattern_tells(moving, frames, mutant):
    with np.errstate(all="ignore"):
        pattern, _ = falls(mutant(), moving, frames)
    assert not pattern >= FALL


@pytest.mark.long
def test_the_gain_error_tells_a_frozen_gain(moving, frames):
    for method, mutant in ((None, FrozenGain), (Kalman, FrozenKalman)):
        if method is not None:
            assert falls(method(), moving, frames)[1] >= GAIN_FALL
        assert falls(mutant(), moving, frames)[1] < GAIN_FALL


def test_the_mean_response_tells_a_missing_gauge(moving, frames, monkeypatch):
    def response(made):
        method = made(SHAPE, 0.45)
        for frame in frames:
            method.update(frame.values)
        return np.mean(method.gain * moving.gain)

    assert abs(response(reference.LocalMean) - 1) < 0.01
    monkeypatch.setattr(reference, "held", lambda gain, offset: (gain, offset))
    assert not abs(response(Ungauged) - 1) < 0.01

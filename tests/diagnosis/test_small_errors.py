"""Small errors that all exposures have in common: found where residuals show them."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

import equipix
from equipix import errors, simulate

SHAPE, CROSS = (96, 128), equipix.cross_pattern(5, 7)
NOISE, LIGHT = 0.5, 1000.0


def laplacian(signal):
    """Σ (neighbour − own) over the neighbours that there are."""
    left = np.zeros(signal.shape)
    for axis in (1, 2):
        steps = np.diff(signal, axis=axis)
        before, after = ([(0, 0)] * 3 for _ in range(2))
        before[axis], after[axis] = (0, 1), (1, 0)
        left += np.pad(steps, before) - np.pad(steps, after)
    return left


KINDS = {
    "none": lambda s: s,
    "curved": lambda s: s - 0.06 * s**2 / s.max(),
    "offset": lambda s: s - 100,
    "crosstalk": lambda s: s + 0.01 * laplacian(s),
}


def experiment(kind, seed, shape=SHAPE, width=100, noise=NOISE):
    rng = np.random.default_rng(seed)
    truth = simulate.paper_sensitivity(shape, rng=rng)
    beam = simulate.gaussian_beam(shape, width=width)
    if kind == "crosstalk":
        # In a smooth beam M absorbs it: crosstalk of 1 % is below a standard error.
        beam = simulate.wavy_beam(shape, rng=rng)
    signal = LIGHT * simulate.exposures(truth, beam, CROSS)
    return KINDS[kind](signal) + noise * rng.standard_normal(signal.shape)


def said(frames, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", errors.EquipixWarning)
        cal = equipix.calibrate(frames, CROSS, workers=1, **options)
    return [each.message for each in cal.findings if each.kind == "misfit"]


VARIANCE = np.full(5, NOISE**2)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("curved", r"response that is -(5|6|7)\.\d+% off a line at the largest signal"),
        ("offset", r"an offset of -(8|9|10)(\.\d+)?% of the largest signal"),
        ("crosstalk", r"crosstalk of (0\.[89]|1\.[012])\d% to each neighbour"),
    ],
)
def test_an_error_is_named_with_its_size(kind, words):
    for options in ({"variance": VARIANCE}, {}):
        (message,) = said(experiment(kind, 1), **options)
        assert re.search(words, message)
        assert "error of the sensitivity of" in message


def test_a_dark_that_was_subtracted_twice_or_flipped_is_found():
    rng = np.random.default_rng(4)
    offset = 200 + 20 * rng.standard_normal(SHAPE)
    signal = experiment("none", 4, noise=0)
    dark = equipix.average(offset + rng.standard_normal((16, *SHAPE)))

    def averages(raw):
        noise = (rng.standard_normal((4, *SHAPE)) for _ in raw)
        return [equipix.average(x + e, dark=dark) for x, e in zip(raw, noise, strict=True)]

    (message,) = said(averages(signal))
    assert re.search(r"the pattern of the dark, -(99|100)\.?\d*% of it", message)
    (message,) = said(averages(signal + offset[::-1]))
    assert "and is not flipped" in message
    assert said(averages(signal + offset)) == []


def test_pixels_that_are_flagged_are_no_evidence():
    """Dead pixels are constant where the fit takes them for faint: an offset of all values."""
    rng = np.random.default_rng(3)
    frames = experiment("none", 3, (48, 64), 60)
    dead = rng.random((48, 64)) < 0.03
    frames[:, dead] = 0.02 * LIGHT + NOISE * rng.standard_normal((5, dead.sum()))
    assert said(frames, variance=VARIANCE) == []


def test_a_dark_of_few_frames_is_no_error():
    """Its noise is in the residuals and in M, and so in what an error of all values would leave."""
    for seed in range(3):
        rng = np.random.default_rng([5, seed])
        truth = simulate.cosine_sensitivity(SHAPE, rng=rng)
        beam = simulate.wavy_beam(SHAPE, contrast=0.3, rng=rng)
        frames = simulate.exposures(truth, beam, CROSS)
        frames += 1e-3 * rng.standard_normal(frames.shape)
        frames += np.sqrt(32e-6) * rng.standard_normal(SHAPE)
        assert said(frames, variance=np.full(5, 1e-6), dark_variance=32e-6) == []


def test_without_noise_nothing_is_told():
    assert said(experiment("none", 1, noise=0)) == []


@pytest.mark.study
def test_right_models_stay_silent(draws, figure):
    seeds = draws(300)
    false = sum(
        bool(said(experiment("none", seed, (48, 64), 60), variance=VARIANCE)) for seed in seeds
    )
    figure(
        "false findings on right models, small errors", f"{false} of {len(seeds)}", "at most 1 %"
    )
    # Wanted at most 1 %, and three standard errors of what was drawn.
    assert false <= 0.01 * len(seeds) + 3 * (0.01 * len(seeds)) ** 0.5


@pytest.mark.study
@pytest.mark.parametrize("kind", ["curved", "offset", "crosstalk"])
def test_each_error_is_the_first_cause(kind, draws, figure):
    words = {"curved": "off a line", "offset": "an offset of", "crosstalk": "crosstalk of"}[kind]
    seeds = draws(40)
    right = sum(
        any(words in text for text in said(experiment(kind, seed), variance=VARIANCE))
        for seed in seeds
    )
    figure(f"{kind}: named", f"{right} of {len(seeds)}", "nine of ten")
    assert right >= 0.9 * len(seeds) - 3 * (0.09 * len(seeds)) ** 0.5


def test_a_curved_response_is_found_beside_a_level_that_clips():
    """Pixels that the caller masks show a saturation level; it explains no curve of the others."""
    frames = experiment("curved", 1)
    mask = np.zeros(SHAPE, bool)
    mask.flat[np.random.default_rng(5).choice(mask.size, 20, replace=False)] = True
    frames[:, mask] = np.ceil(1.2 * frames.max())
    with pytest.warns(errors.EquipixWarning):
        cal = equipix.calibrate(frames, CROSS, variance=np.full(5, NOISE**2), mask=mask)
    assert [each.kind for each in cal.findings] == ["saturation", "misfit"]

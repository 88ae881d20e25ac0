"""Findings over right and wrong models: how many are false, and which cause each names first.

Prints how often a finding falls on right models of each kind, and for each wrong model how often it
is noticed and how often its true cause is the first that is named.

    python docs/wrong_models.py [RIGHT [WRONG]]

RIGHT is the number of right models in all (2000), WRONG that of each wrong model (20).
"""

from __future__ import annotations

import sys
import warnings
from collections import Counter

import numpy as np

import equipix
from equipix import simulate
from equipix.errors import EquipixWarning

SHAPE = (40, 50)
CROSS = equipix.cross_pattern(5, 7).astype(float)
SEVEN = np.array([(0, 0), (3, 9), (9, 2), (-7, 8), (5, -9), (-3, -8), (-9, 1)], float)
CAUSES = (
    "saturation",
    "unit",
    "repeated",
    "sign",
    "drift",
    "prior",
    "variance",
    "misfit",
    "orientation",
    "tilt",
)
"""Kinds of findings that name a cause."""


def speckle(rng, period):
    """Random waves of a range of periods around one, 10 % rms."""
    waves = 60
    k = 2 * np.pi / (period * rng.uniform(0.8, 1.2, waves))
    angle, phase = rng.uniform(0, 2 * np.pi, (2, waves))

    def beam(rows, cols):
        arguments = zip(k * np.sin(angle), k * np.cos(angle), phase, strict=True)
        structure = sum(np.cos(a * rows + b * cols + start) for a, b, start in arguments)
        return 1 + 0.1 * np.sqrt(2 / waves) * structure + 0 * (rows + cols)

    return beam


def smooth(rng):
    """A Gaussian beam, in the middle or beside it."""
    centre = np.array(SHAPE) / 2 + rng.uniform(-30, 30, 2)
    return simulate.gaussian_beam(SHAPE, width=rng.uniform(50, 200), centre=tuple(centre))


def structured(rng):
    """A beam with structure that a spline follows."""
    return simulate.wavy_beam(SHAPE, rng=rng)


FRESH = 4000
"""First seed: thresholds were set and looked at on smaller ones."""

BEAMS = (
    smooth,
    structured,
    lambda rng: simulate.tilted_beam(SHAPE, slope=tuple(rng.uniform(-0.2, 0.2, 2))),
    lambda rng: simulate.striped_beam(SHAPE, period=rng.uniform(15, 60)),
    lambda rng: speckle(rng, 10),
)


def any_beam(rng):
    """One of all kinds."""
    return BEAMS[rng.integers(len(BEAMS))](rng)


def places(rng):
    """Shifts by whole pixels or between them."""
    shifts = (CROSS, SEVEN)[rng.integers(2)].copy()
    if rng.random() < 0.5:
        shifts[1:] += rng.uniform(-0.5, 0.5, shifts[1:].shape)
    return shifts


def photograph(rng, beam, shifts, noise=1e-3, sensor=None, **how):
    """Frames of a sensor with white noise, and options with their variance."""
    truth = simulate.cosine_sensitivity(SHAPE, rng=rng) if sensor is None else sensor
    frames = simulate.exposures(truth, beam, shifts, **how)
    variance = np.broadcast_to(np.square(noise), frames.shape).copy()
    frames = frames + noise * rng.standard_normal(frames.shape)
    return frames, variance[:, 0, 0] if np.ndim(noise) == 0 else variance


def plain(rng):
    """Return whole and fractional shifts, with variances or without."""
    shifts, noise = places(rng), 10 ** rng.uniform(-4, -2)
    frames, variance = photograph(rng, any_beam(rng), shifts, noise)
    return frames, shifts, {"variance": variance if rng.random() < 0.7 else None}


def flux_priors(rng):
    """Return fluxes that scatter as their prior states."""
    shifts, std = places(rng), 10 ** rng.uniform(-4, -2)
    flux = np.exp(std * rng.standard_normal(len(shifts)))
    frames, variance = photograph(rng, any_beam(rng), shifts, flux=flux)
    return frames, shifts, {"variance": variance, "flux": np.ones(len(shifts)), "flux_std": std}


def shift_priors(rng):
    """Return shifts that scatter as their prior states."""
    true, std = places(rng), 10 ** rng.uniform(-2, -1)
    given = true + std * rng.standard_normal(true.shape)
    frames, variance = photograph(rng, any_beam(rng), true)
    return frames, given, {"variance": variance, "shift_std": std}


def both_priors(rng):
    """Return fluxes and shifts that scatter as their priors state."""
    true, std = places(rng), 10 ** rng.uniform(-2, -1)
    given = true + std * rng.standard_normal(true.shape)
    flux = np.exp(1e-3 * rng.standard_normal(len(true)))
    frames, variance = photograph(rng, any_beam(rng), true, flux=flux)
    priors = {"flux": np.ones(len(true)), "flux_std": 1e-3, "shift_std": std}
    return frames, given, {"variance": variance} | priors


def masks(rng):
    """Return pixels, single measurements and corners that are masked."""
    shifts = places(rng)
    frames, variance = photograph(rng, any_beam(rng), shifts)
    rows, cols = np.indices(SHAPE)
    kinds = (
        rng.random(SHAPE) < 0.05,
        rng.random(frames.shape) < 0.05,
        np.hypot(rows - 20, cols - 25) > 24,
    )
    return frames, shifts, {"variance": variance, "mask": kinds[rng.integers(3)]}


def dead_pixels(rng):
    """Return dead and stuck pixels in plain arrays."""
    shifts = places(rng)
    frames, variance = photograph(rng, any_beam(rng), shifts)
    bad = rng.random(SHAPE) < 10 ** rng.uniform(-3, -1.3)
    level = np.where(rng.random(SHAPE) < 0.7, 0.0, rng.choice([0.1, 3.0]))[bad]
    frames[:, bad] = level + 1e-3 * rng.standard_normal((len(shifts), bad.sum()))
    return frames, shifts, {"variance": variance}


def uneven_variances(rng):
    """Return variances that differ by a factor of a million between pixels."""
    shifts = places(rng)
    std = 1e-4 * 10 ** rng.uniform(0, 3, SHAPE)
    frames, variance = photograph(rng, any_beam(rng), shifts, noise=std)
    return frames, shifts, {"variance": variance}


def weak_light(rng):
    """Return a corner or a half of the sensor in weak light."""
    shifts, beam, faint = places(rng), any_beam(rng), 10 ** rng.uniform(-3, -1)
    rows, cols = np.indices(SHAPE)
    edge = (cols - 25, np.hypot(rows, cols) - 30)[rng.integers(2)]
    sensor = simulate.cosine_sensitivity(SHAPE, rng=rng)
    shade = faint + (1 - faint) / (1 + np.exp(-edge / 2))
    frames, variance = photograph(rng, beam, shifts, sensor=sensor * shade)
    return frames, shifts, {"variance": variance}


def dust(rng):
    """Return a grain in one exposure, with robust weights."""
    shifts = places(rng)
    sensor = simulate.cosine_sensitivity(SHAPE, rng=rng)
    frames, variance = photograph(rng, any_beam(rng), shifts, sensor=sensor)
    row, col = rng.integers(10, 25), rng.integers(10, 35)
    frames[rng.integers(len(shifts)), row : row + 4, col : col + 4] *= rng.uniform(0.2, 0.95)
    return frames, shifts, {"variance": variance, "robust": True}


def free_fluxes(rng):
    """Return any fluxes, fitted, with an exposure that is turned."""
    shifts = np.vstack([places(rng), [(4, -3)]])
    rotation = np.zeros(len(shifts), int)
    rotation[-1] = (90, 180)[rng.integers(2)]
    flux = np.exp(1e-2 * rng.standard_normal(len(shifts)))
    frames, variance = photograph(rng, any_beam(rng), shifts, flux=flux, rotation=rotation)
    return frames, shifts, {"variance": variance, "flux": "fit", "rotation": rotation}


def linear_fluxes(rng):
    """Return a lamp that drifts linearly in time."""
    shifts = places(rng)
    time = np.arange(len(shifts)) * 10.0
    flux = 1 + rng.normal(0, 1e-3) * np.arange(len(shifts))
    frames, variance = photograph(rng, any_beam(rng), shifts, flux=flux)
    return frames, shifts, {"variance": variance, "flux": "linear", "time": time}


def photon_noise(rng):
    """Return averages of frames with photon noise and its model."""
    shifts, beam = places(rng), any_beam(rng)
    sensor = simulate.cosine_sensitivity(SHAPE, rng=rng)
    signal = 1e4 * simulate.exposures(sensor, beam, shifts)
    frames = signal + np.sqrt(100 + np.maximum(signal, 0)) * rng.standard_normal(signal.shape)
    return frames, shifts, {"variance": equipix.NoiseModel(10.0, 1.0)}


def few_darks(rng):
    """Return a dark whose noise is up to that of one frame, where each exposure has 32."""
    shifts, std = places(rng), 1e-3 * 32 ** (0.5 * rng.random())
    beams = (any_beam, lambda rng: simulate.wavy_beam(SHAPE, contrast=0.3, rng=rng))
    frames, variance = photograph(rng, beams[rng.integers(2)](rng), shifts)
    frames += std * rng.standard_normal(SHAPE)
    return frames, shifts, {"variance": variance, "dark_variance": std**2}


def averages(rng):
    """Return averages of frames of 16 bits with photon noise, less one dark average."""
    shifts, count = places(rng), int(2 ** rng.integers(2, 5))
    offset = 300 + 10 * rng.standard_normal(SHAPE)
    sensor = simulate.cosine_sensitivity(SHAPE, rng=rng)
    signals = 1e4 * simulate.exposures(sensor, any_beam(rng), shifts)

    def taken(signal):
        std = np.sqrt(30 + np.maximum(signal, 0))
        values = offset + signal + std * rng.standard_normal((count, *SHAPE))
        return np.clip(np.rint(values), 0, 65535).astype(np.uint16)

    dark = equipix.average(taken(np.zeros(SHAPE)))
    return [equipix.average(taken(signal), dark=dark) for signal in signals], shifts, {}


def colours(rng):
    """Return pixels behind a Bayer pattern."""
    shifts, response = places(rng), rng.uniform(0.4, 1, 3)
    sensor = simulate.cosine_sensitivity(SHAPE, rng=rng)
    sensor *= np.tile(response[[[0, 1], [1, 2]]], (SHAPE[0] // 2, SHAPE[1] // 2))
    frames, variance = photograph(rng, any_beam(rng), shifts, sensor=sensor)
    return frames, shifts, {"variance": variance, "cfa": "RGGB"}


RIGHT = (
    plain,
    flux_priors,
    shift_priors,
    both_priors,
    masks,
    dead_pixels,
    uneven_variances,
    weak_light,
    dust,
    free_fluxes,
    linear_fluxes,
    photon_noise,
    few_darks,
    averages,
    colours,
)


def given_as(change, kind):
    """Return a wrong model whose shifts are changed in a beam of that kind."""

    def model(rng):
        true = places(rng)
        frames, variance = photograph(rng, kind(rng), true)
        return frames, change(rng, true), {"variance": variance}

    return model


def reversed_axes(rng, shifts):
    """Reverse one axis or both."""
    return shifts * np.array([(-1, -1), (-1, 1), (1, -1)])[rng.integers(3)]


def rotated_stage(_, shifts, degrees=1.0):
    """Turn the axes of the stage."""
    angle = np.deg2rad(degrees)
    turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
    return shifts @ turn


def drifting(kind):
    """Return a lamp whose drift nobody states."""

    def model(rng):
        shifts = places(rng)
        flux = np.exp(1e-2 * rng.standard_normal(len(shifts)))
        frames, variance = photograph(rng, kind(rng), shifts, flux=flux)
        return frames, shifts, {"variance": variance}

    return model


def each_exposure(rng, shifts, beams):
    """Frames, each of its own beam."""
    sensor = simulate.cosine_sensitivity(SHAPE, rng=rng)
    pairs = zip(shifts, beams, strict=True)
    frames = np.concatenate([simulate.exposures(sensor, b, s[None]) for s, b in pairs])
    variance = np.full(len(shifts), 1e-6)
    return frames + 1e-3 * rng.standard_normal(frames.shape), shifts, {"variance": variance}


def moving_beam(rng):
    """Return a beam that moves by half a pixel between exposures."""
    shifts, beam = places(rng), structured(rng)
    frames, variance = photograph(rng, beam, shifts + 0.5 * rng.standard_normal(shifts.shape))
    return frames, shifts, {"variance": variance}


def breathing_beam(rng):
    """Return a beam whose width changes by some per cent between exposures."""
    shifts = places(rng)
    widths = 60 * np.exp(0.03 * rng.standard_normal(len(shifts)))
    return each_exposure(rng, shifts, [simulate.gaussian_beam(SHAPE, width=w) for w in widths])


def mixed(rng):
    """Return two exposures that are exchanged."""
    shifts = places(rng)
    frames, variance = photograph(rng, structured(rng), shifts)
    order = np.arange(len(shifts))
    first, second = rng.choice(len(shifts), 2, replace=False)
    order[[first, second]] = order[[second, first]]
    return frames[order], shifts, {"variance": variance}


def duplicated(rng):
    """Return one exposure for two positions."""
    shifts = places(rng)
    frames, variance = photograph(rng, any_beam(rng), shifts)
    first, second = rng.choice(len(shifts), 2, replace=False)
    frames[second] = frames[first]
    return frames, shifts, {"variance": variance}


def flicker(rng):
    """Return a lamp that flickers while the rows are read."""
    shifts = places(rng)
    frames, variance = photograph(rng, any_beam(rng), shifts)
    phase = rng.uniform(0, 2 * np.pi, (len(shifts), 1, 1))
    rows = np.arange(SHAPE[0])[:, None]
    frames *= 1 + 5e-3 * np.sin(2 * np.pi * rows / rng.uniform(5, 15) + phase)
    return frames, shifts, {"variance": variance}


def fine_speckle(rng):
    """Return speckle that a spline cannot follow."""
    shifts = (CROSS, SEVEN)[rng.integers(2)] + 0.0
    shifts[1:] += rng.uniform(-0.5, 0.5, shifts[1:].shape)
    frames, variance = photograph(rng, speckle(rng, rng.uniform(2, 3.5)), shifts)
    return frames, shifts, {"variance": variance}


def hidden_mirror(rng):
    """Return an axis reversed in a smooth beam, where fluxes are free or hardly known."""
    true = places(rng)
    frames, variance = photograph(rng, smooth(rng), true)
    known = ({"flux": "fit"}, {"flux": np.ones(len(true)), "flux_std": 1e-2})[rng.integers(2)]
    return frames, reversed_axes(rng, true), {"variance": variance} | known


WRONG = {
    "sign, structured": (given_as(reversed_axes, structured), r"orientation of the shifts"),
    "sign, smooth": (given_as(reversed_axes, smooth), r"orientation of the shifts"),
    "sign, smooth, fluxes free": (hidden_mirror, r"orientation of the shifts"),
    "axes exchanged": (
        given_as(lambda _, s: s[:, ::-1].copy(), structured),
        r"orientation of the shifts",
    ),
    "scale 5 %": (given_as(lambda _, s: 1.05 * s, structured), r"check the shifts|micrometres"),
    "stage 1 degree": (given_as(rotated_stage, structured), r"check the shifts"),
    "drift, structured": (drifting(structured), r"contradict the fluxes"),
    "drift, smooth": (drifting(smooth), r"contradict the fluxes"),
    "moving beam": (moving_beam, r"check the shifts"),
    "breathing beam": (breathing_beam, r"illumination changes its shape"),
    "exposures mixed": (mixed, r"check the order of the frames"),
    "exposure duplicated": (duplicated, r"exposure .* and .* are equal"),
    "flicker": (flicker, r"common to the pixels of rows"),
    "fine speckle": (fine_speckle, r"finer than"),
}
"""Each wrong model, and what names its cause."""


def findings(frames, shifts, options):
    """Findings of one calibration; None where it is refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EquipixWarning)
        try:
            return equipix.calibrate(frames, shifts, tolerance=1e-4, **options).findings
        except equipix.errors.InputError:
            return None


def first_cause(found):
    """The first finding that names a cause; None without any."""
    return next((each.message for each in found if each.kind in CAUSES), None)


def right_models(count):
    """Print the findings on right models of each kind."""
    total: Counter[str] = Counter()
    for k, model in enumerate(RIGHT):
        seeds = range(FRESH + k, FRESH + count, len(RIGHT))
        told: Counter[str] = Counter()
        for seed in seeds:
            found = findings(*model(np.random.default_rng([1, seed])))
            told.update({each.kind for each in found} if found is not None else ["refused"])
        total += told
        print(f"{model.__name__:17} {len(seeds):5}  {dict(told)}", flush=True)
    print(f"{'all':17} {count:5}  {dict(total)}", flush=True)


def wrong_models(count):
    """Print how often each wrong model is noticed, and its cause named first."""
    import re

    for name, (model, pattern) in WRONG.items():
        noticed, right = 0, 0
        told: Counter[str] = Counter()
        for seed in range(FRESH, FRESH + count):
            found = findings(*model(np.random.default_rng([2, seed])))
            first = "refused" if found is None else first_cause(found)
            noticed += first is not None
            right += first is not None and re.search(pattern, first) is not None
            told.update([next((v.kind for v in found or () if v.kind in CAUSES), "none")])
        print(
            f"{name:26} noticed {noticed:3}, right {right:3} of {count}  {dict(told)}", flush=True
        )


if __name__ == "__main__":
    numbers = [int(each) for each in sys.argv[1:]]
    wrong_models(numbers[1] if len(numbers) > 1 else 20)
    right_models(numbers[0] if numbers else 2000)

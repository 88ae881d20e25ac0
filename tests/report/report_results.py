"""Small results of all kinds, for what shows them."""

from __future__ import annotations

import dataclasses

import numpy as np

import equipix
from equipix import bolometer, hardware, nuc, simulate
from equipix.findings import Finding
from given import learned

SHAPE = (24, 32)


def measured(level, count=6, seed=0):
    """Raw frames of an even light."""
    rng = np.random.default_rng([seed, level])
    noise = np.sqrt(level + 4) * rng.standard_normal((count, *SHAPE))
    return np.rint(50 + level + noise).astype(np.uint16)


def calibration(**options):
    """A calibration with error bars, a dead pixel and a finding."""
    shifts = equipix.cross_pattern(3, 5) + 0.25 * np.eye(5, 2)
    truth = simulate.paper_sensitivity(SHAPE, rng=1)
    truth[5, 7] = 0.05
    frames = simulate.exposures(truth, simulate.gaussian_beam(SHAPE, width=60), shifts)
    frames += 1e-3 * np.random.default_rng(2).standard_normal(frames.shape)
    found = equipix.calibrate(
        frames, shifts, variance=np.full(5, 1e-6), uncertainty=True, **options
    )
    finding = Finding("drift", "the lamp drifts by <2 %: measure it & give 'flux'", "misfit")
    return dataclasses.replace(found, findings=(*found.findings, finding))


def every_kind():
    """Results by what they are."""
    dark = equipix.average(measured(0), saturation=4095)
    levels = [equipix.average(measured(level), dark=dark) for level in (500, 1500, 3000)]
    response = nuc.fit(levels, order=2)
    line = nuc.fit(levels, order=1)
    celsius = np.arange(4.0) * 10
    shutter = [500 + 3 * each + measured(100, seed=4)[0] / 50 for each in celsius]
    return {
        "calibration": calibration(),
        "response": response,
        "averages": levels[0],
        "polynomial": equipix.combine(response, nuc.fit([each.mean for each in levels], order=1)),
        "dynamic": bolometer.fit(shutter, celsius, 2.0, order=1),
        "scene": learned("constant-statistics", SHAPE),
        "table": hardware.Table.of(line, offset_bits=12, gain_bits=12),
    }

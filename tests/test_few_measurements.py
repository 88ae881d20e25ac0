"""Pixels with one or two measurements of more exposures follow the beam."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import simulate

SIDE = 64
NOISE = 0.01


def discs(seed, *, limb=0.9, side=SIDE, flux=None, noise=NOISE):
    """Nine pictures of a disc that is darker at its limb, with spots, and their masks."""
    rng = np.random.default_rng(seed)
    shape = (side, side)
    spots = rng.uniform(-0.6, 0.6, (6, 2))
    radius, centre = 0.4 * side, np.array(shape) / 2

    def beam(row, col):
        r, c = (row - centre[0]) / radius, (col - centre[1]) / radius
        light = 0.4 + 0.6 * np.sqrt(np.clip(1 - r**2 - c**2, 0, 1))
        for spot in spots:
            light = light * (1 - 0.3 * np.exp(-((r - spot[0]) ** 2 + (c - spot[1]) ** 2) / 0.02))
        return light

    shifts = rng.uniform(-0.1, 0.1, (9, 2)) * side
    truth = 1 + 0.03 * rng.standard_normal(shape)
    frames = simulate.exposures(truth, beam, shifts, flux=flux)
    frames += noise * rng.standard_normal(frames.shape)
    rows, cols = np.indices(shape) - centre[:, None, None]
    away = [np.hypot(rows + d, cols + e) for d, e in shifts]
    return frames, shifts, np.array(away) > limb * radius, truth


@pytest.mark.study
def test_standard_deviations_of_discs_with_masks_of_their_own(draws, figure):
    squares, few_squares = [], []
    for seed in draws(20):
        frames, shifts, mask, truth = discs(seed)
        cal = equipix.calibrate(
            frames, shifts, mask=mask, variance=np.full(9, NOISE**2), uncertainty=True
        )
        assert cal.converged
        few = cal.weighted.fit.few
        times = (~mask).sum(axis=0)
        assert (times[few] <= 2).all()
        known = np.isfinite(cal.sensitivity_std)
        assert known[few].all()
        z = (cal.sensitivity / (truth / truth[known].mean()) - 1) / cal.sensitivity_std
        few_squares.append(np.mean(z[few] ** 2))
        squares.append(np.mean(z[known & ~few] ** 2))
    for name, found in (("few measurements", few_squares), ("others", squares)):
        z = float(np.sqrt(np.mean(found)))
        figure(f"z of pixels with {name}", z, "0.97 to 1.03")
        # The scatter between experiments, of half a thousand pixels or more each.
        error = 3 * np.std(found) / len(found) ** 0.5 if len(found) > 5 else 0.05
        assert abs(z - 1) < 0.03 + error


@pytest.mark.filterwarnings("ignore::equipix.errors.EquipixWarning")
def test_free_fluxes_and_refined_shifts_converge():
    rng = np.random.default_rng(1)
    frames, shifts, mask, _ = discs(1, limb=1.0, flux=rng.uniform(0.95, 1.05, 9))
    measured = shifts + 0.1 * rng.standard_normal(shifts.shape)
    cal = equipix.calibrate(
        frames, measured, mask=mask, variance=np.full(9, NOISE**2), flux="fit", shift_std=0.1
    )
    assert cal.converged
    assert cal.sweeps <= 200


@pytest.mark.filterwarnings("ignore::equipix.errors.EquipixWarning")
def test_experiments_of_two_exposures_keep_all_pixels():
    frames, shifts, _, _ = discs(2)
    mask = np.zeros((2, SIDE, SIDE), bool)
    mask[1, 20:30, 20:30] = True
    cal = equipix.calibrate(frames[:2], shifts[:2], mask=mask, variance=np.full(2, NOISE**2))
    assert cal.weighted.fit.few is None


def with_edge(edge, rng, clean, mask):
    """A circle, a threshold on noisy frames, or half of the measurements along the edge.

    The noise of those frames is not that of the fit, which a threshold would select.
    """
    if edge == "threshold":
        return clean + NOISE * rng.standard_normal(mask.shape) < 0.6
    grown = mask.copy()
    for step in (1, 2, 4):
        for axis in (1, 2):
            grown |= np.roll(grown, step, axis) | np.roll(grown, -step, axis)
    missing = rng.random(mask.shape) < (0.5 if edge == "frayed" else 0)
    return mask | (grown & missing)


@pytest.mark.study
@pytest.mark.filterwarnings("ignore::equipix.errors.EquipixWarning")
@pytest.mark.parametrize("edge", ["circle", "threshold", "frayed"])
def test_large_discs_converge_and_raise_no_alarm(edge, draws, figure):
    passes, lost = [], []
    for seed in draws(20):
        rng = np.random.default_rng(1000 + seed)
        limb, flux = rng.uniform(0.8, 1.02), rng.uniform(0.95, 1.05, 9)
        frames, shifts, mask, _ = discs(seed, limb=limb, side=512, flux=flux)
        clean, *_ = discs(seed, limb=limb, side=512, flux=flux, noise=0)
        measured = shifts + 0.3 * rng.standard_normal(shifts.shape)
        mask = with_edge(edge, rng, clean, mask)
        cal = equipix.calibrate(
            frames, measured, mask=mask, variance=np.full(9, NOISE**2), flux="fit", shift_std=0.3
        )
        lost.append(sum(map(len, cal.weighted.fit.lost)) / np.count_nonzero(~mask))
        if cal.converged:
            passes.append(cal.sweeps)
            # That free fluxes leave the tilt open is no alarm.
            assert {verdict.kind for verdict in cal.verdicts} == {"tilt"}
    of_discs = f"of discs of 512×512 pixels, edge of masks: {edge}"
    figure(f"share that converges {of_discs}", len(passes) / len(lost), "1")
    figure(f"most passes {of_discs}", max(passes), "at most 100")
    figure(f"largest share of measurements lost {of_discs}", max(lost), "at most 0.01")
    assert max(lost) <= 0.01
    if edge == "circle":
        assert len(passes) == len(lost)
        assert max(passes) <= 100
    else:
        # Of ragged edges some leave cells that fit any value; the result says so.
        assert len(passes) >= 0.75 * len(lost)
        assert np.median(passes) <= 100

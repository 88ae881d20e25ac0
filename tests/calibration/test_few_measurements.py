"""Pixels with one or two measurements of more exposures follow the beam."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import simulate

SIDE = 64
NOISE = 0.01

KEPT = 243
"""Most passes of discs of 512×512 pixels while pixels with few measurements stayed in the search;
see docs/method.md."""


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


def counted(cal):
    """The measurements that a calibration used, without lost ones."""
    exposures, fit = cal.weighted.exposures, cal.weighted.fit
    return np.array([exposures.used(fit, k) for k in range(len(exposures))])


def in_blocks(used):
    """The measurements that are in a block of 4×4 of their exposure."""
    rows, cols = used.shape[1:]
    windows = np.lib.stride_tricks.sliding_window_view(used, (4, 4), (1, 2)).all(axis=(3, 4))
    found = np.zeros_like(used)
    for row, col in np.ndindex(4, 4):
        found[:, row : row + rows - 3, col : col + cols - 3] |= windows
    return found


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
        assert (counted(cal).sum(axis=0)[few] <= 2).all()
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


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::equipix.errors.EquipixWarning")
def test_free_fluxes_and_refined_shifts_converge():
    rng = np.random.default_rng(1)
    frames, shifts, mask, _ = discs(1, limb=1.0, flux=rng.uniform(0.95, 1.05, 9))
    measured = shifts + 0.1 * rng.standard_normal(shifts.shape)
    cal = equipix.calibrate(
        frames, measured, mask=mask, variance=np.full(9, NOISE**2), flux="fit", shift_std=0.1
    )
    assert cal.converged
    assert cal.sweeps < KEPT


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::equipix.errors.EquipixWarning")
def test_experiments_of_two_exposures_keep_all_pixels():
    frames, shifts, _, _ = discs(2)
    mask = np.zeros((2, SIDE, SIDE), bool)
    mask[1, 20:30, 20:30] = True
    cal = equipix.calibrate(frames[:2], shifts[:2], mask=mask, variance=np.full(2, NOISE**2))
    assert cal.weighted.fit.few is None


SMALL = (24, 40)
APART = np.array([[0, 0], [0.3, 5.2], [0.1, 14.6], [5.45, 0.1], [6.8, 0.35]])
MIXED = np.array([[0, 0], [0, 5], [-5, 0], [3.4, -6.2], [3, -3]])


def fitted(shifts, mask, *, rotation=None, std=None, missing="masked"):
    """A small sensor in a beam with structure, with noise of 0.1 %."""
    rng = np.random.default_rng(3)
    truth = simulate.cosine_sensitivity(SMALL, rng=1)
    beam = simulate.wavy_beam(SMALL, contrast=0.3, rng=1)
    frames = simulate.exposures(truth, beam, shifts, rotation=rotation)
    frames += 1e-3 * rng.standard_normal(frames.shape)
    if missing == "NaN":
        frames[mask], mask = np.nan, None
    return equipix.calibrate(
        frames, shifts, mask=mask, rotation=rotation, shift_std=std, variance=np.full(5, 1e-6)
    )


def frayed(seed=0):
    """Half of the last eight columns, at random."""
    missing = np.random.default_rng(seed).uniform(size=(5, *SMALL)) < 0.5
    return (np.arange(SMALL[1]) >= SMALL[1] - 8) & missing


def lost_by_the_rule(used, shifts, rotation, *, fitted):
    """What is lost by the words of lost.rs, where no part of the sensor is wide or sparse."""
    margin, (rows, cols) = int(fitted), used.shape[1:]
    block = in_blocks(used)

    def cells(k, row, col):
        turned = [(row, col), (col, rows - 1 - row), (rows - 1 - row, cols - 1 - col)]
        place = [*turned, (cols - 1 - col, row)][rotation[k] // 90] + shifts[k]
        last = np.floor(place) + 1 if fitted else np.ceil(place)
        return [range(int(np.floor(p)) - 1, int(q) + 2) for p, q in zip(place, last, strict=True)]

    lost = np.zeros_like(used)
    while True:
        left = used & ~lost
        stays = left.sum(axis=0) > 2
        seen = np.zeros((200, 200))
        for k, row, col in np.argwhere(left & stays):
            seen[np.ix_(*cells(k, row, col))] += 16 if block[k, row, col] else 1
        found = lost.copy()
        for k, row, col in np.argwhere(used & ~(block & stays)):
            around = [range(r.start - margin, r.stop + margin) for r in cells(k, row, col)]
            found[k, row, col] |= (seen[np.ix_(*around)] < 16).any()
        if (found == lost).all():
            return lost
        lost = found


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::equipix.errors.EquipixWarning")
@pytest.mark.parametrize("shifts", [APART, MIXED], ids=["apart", "mixed"])
@pytest.mark.parametrize("rotation", [[0] * 5, [0, 90, 180, 270, 0]], ids=["", "turned"])
@pytest.mark.parametrize(("std", "missing"), [(None, "masked"), (None, "NaN"), (0.05, "masked")])
def test_what_is_lost_is_lost_by_the_rule(shifts, rotation, std, missing):
    mask = frayed()
    cal = fitted(shifts, mask, rotation=rotation, std=std, missing=missing)
    lost = ~mask & ~counted(cal)
    # Places from 0 to 200: all cells are behind them.
    wanted = lost_by_the_rule(~mask, shifts + 60, rotation, fitted=std is not None)
    assert wanted.sum() > 20
    np.testing.assert_array_equal(lost, wanted)


@pytest.mark.long
@pytest.mark.parametrize("std", [None, 0.05])
def test_lost_measurements_count_neither_in_d_nor_in_residuals(std):
    cal = fitted(APART, frayed(), std=std)
    exposures, fit = cal.weighted.exposures, cal.weighted.fit
    assert sum(map(len, fit.lost)) > 20
    squares = [exposures.light(fit, k, None) ** 2 / 1e-6 for k in range(5)]
    used = counted(cal)
    known = np.isfinite(cal.sensitivity)
    total = np.sum(np.where(used, squares, 0), axis=0)
    information = fit.information(workers=1)
    # Each of five terms is rounded some five times at either side, and their sums four times.
    rtol = 20 * np.finfo(float).eps
    np.testing.assert_allclose(information[known], total[known], rtol=rtol)
    assert not information[~np.any(used, axis=0)].any()
    np.testing.assert_array_equal(known, np.any(used, axis=0))
    residuals = exposures.residuals(fit, None)
    assert np.isnan(residuals[~frayed() & ~used]).all()
    assert np.isfinite(residuals[used]).all()


def most_passes(shifts):
    """Twice those of the same sensor without a mask: the edge of a mask hardly slows a search.

    Cells that nothing determines slow it by a factor of ten and more.
    """
    whole = fitted(shifts, np.zeros((5, *SMALL), bool))
    assert whole.converged
    return 2 * whole.sweeps


@pytest.mark.long
@pytest.mark.parametrize("size", [(1, 1), (2, 2), (3, 3), (24, 3), (4, 4)])
def test_islands_and_strips_in_the_dark_do_no_harm(size):
    mask = np.zeros((5, *SMALL), bool)
    mask[2, :, 30:] = True
    row = max(0, 10 - size[0] // 2)
    mask[2, row : row + size[0], 36 : 36 + size[1]] = False
    cal = fitted(APART, mask)
    assert cal.converged
    assert cal.sweeps <= most_passes(APART)
    assert cal.findings == ()


@pytest.mark.long
@pytest.mark.parametrize("seed", range(6))
def test_ragged_edges_at_mostly_whole_shifts_converge(seed):
    cal = fitted(MIXED, frayed(seed))
    assert cal.converged
    assert cal.sweeps <= most_passes(MIXED)


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


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::equipix.errors.EquipixWarning")
@pytest.mark.parametrize("edge", ["circle", "threshold", "frayed"])
@pytest.mark.parametrize("std", [None, 0.3])
def test_what_discs_lose_is_lost_by_the_rule(edge, std):
    frames, shifts, mask, _ = discs(0)
    clean, *_ = discs(0, noise=0)
    mask = with_edge(edge, np.random.default_rng(1000), clean, mask)
    variance = np.full(9, NOISE**2)
    cal = equipix.calibrate(frames, shifts, mask=mask, variance=variance, shift_std=std)
    wanted = lost_by_the_rule(~mask, shifts + 60, [0] * 9, fitted=std is not None)
    assert wanted.any()
    np.testing.assert_array_equal(~mask & ~counted(cal), wanted)


@pytest.mark.study
@pytest.mark.filterwarnings("ignore::equipix.errors.EquipixWarning")
@pytest.mark.parametrize("edge", ["circle", "threshold", "frayed"])
def test_large_discs_converge_and_raise_no_alarm(edge, draws, figure):
    passes, lost, most = [], [], []
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
        assert cal.converged
        left, used = counted(cal), ~mask
        # Nothing is lost but what is in no block, or of a pixel with few measurements.
        may_be_lost = used & (~in_blocks(used) | (left.sum(axis=0) <= 2))
        assert not (used & ~left & ~may_be_lost).any()
        lost.append(1 - np.count_nonzero(left) / np.count_nonzero(used))
        most.append(np.count_nonzero(may_be_lost) / np.count_nonzero(used))
        # That free fluxes leave the tilt open is no alarm.
        assert {finding.kind for finding in cal.findings} == {"tilt"}
        passes.append(cal.sweeps)
    of_discs = f"of discs of 512×512 pixels, edge of masks: {edge}"
    figure(f"most passes {of_discs}", max(passes), f"below {KEPT}")
    figure(f"median of passes {of_discs}", float(np.median(passes)), "none")
    figure(f"largest share of measurements lost {of_discs}", max(lost), f"at most {max(most):.3g}")
    assert max(passes) < KEPT

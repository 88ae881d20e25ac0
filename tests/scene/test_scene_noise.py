"""Corrections from the scene where the video is noisy, still or of no scene at all."""

from __future__ import annotations

import itertools
import warnings

import numpy as np
import pytest

import equipix
from equipix import errors, scene
from equipix.findings import ask, say
from equipix.io.formats import load_pages, save_pages
from equipix.scene.methods import METHODS
from equipix.scene.scene_correction import _RULES, _Learned
from equipix.simulate import MovingScene

SHAPE = (64, 64)
NAMES = tuple(METHODS)
WANTED = {0.01: 15, 0.02: 15, 0.05: 8, 0.1: 4}
"""Falls of Registered after 20 000 frames of this noise, at a contrast of 10 %."""
WIDE = (128, 128)
FLOORS = (600, 1000, 1060, 2000, 2060)
"""Frames at which the floor is tested: its copies are made at powers of two, as 1024."""


def made(name, shape=SHAPE, **options):
    return METHODS[name](shape, (0, 1), workers=1, **options)


def run(moving, method, count, every=25):
    """Pattern and gain error over those of raw frames, every so many frames."""
    ones, found = np.ones(moving.shape), []
    for index, frame in enumerate(moving.frames(count)):
        method.update(frame.values)
        if index % every == every - 1:
            raw = moving.residual_pattern(ones, 0 * ones, frame.level)
            left = moving.residual_pattern(method.gain, method.offset, frame.level)
            gains = moving.gain_error(method.gain) / moving.gain_error(ones)
            found.append((left / raw, gains))
    return np.array(found)


@pytest.mark.parametrize("name", NAMES)
def test_noise_of_a_tenth_of_the_range_raises_neither_pattern_nor_gain_error(name):
    moving = MovingScene(seed=1, shape=SHAPE, noise=0.1)
    pattern, gains = run(moving, made(name), 1000).T
    assert pattern.max() <= 1
    assert gains.max() <= 1.05
    assert pattern[-1] < 0.5


@pytest.mark.study
@pytest.mark.parametrize("contrast", [0.1, 0.03])
@pytest.mark.parametrize("noise", WANTED)
def test_no_method_diverges_in_twenty_thousand_frames(contrast, noise, figure, pytestconfig):
    """At 64×64 pixels; the whole study takes 128×128 where the contrast is 10 %."""
    whole = pytestconfig.option.study_share == 1
    shape = WIDE if whole and contrast == 0.1 else SHAPE
    for name in NAMES:
        moving = MovingScene(seed=1, shape=shape, noise=noise, contrast=contrast)
        pattern, gains = run(moving, made(name, shape), 20_000, every=100).T
        least = WANTED[noise] if (name, contrast) == ("registered", 0.1) else 1
        what = f"{name}, noise {noise:.0%}, contrast {contrast:.0%}, 20 000 frames"
        figure(f"fall of the pattern, {what}", 1 / pattern[-1], f"{least} or more")
        figure(f"largest gain error, {what}", gains.max(), "1.05 or less")
        assert pattern.max() <= 1, name
        assert gains.max() <= 1.05, name
        assert 1 / pattern[-1] >= least, name


@pytest.mark.long
@pytest.mark.parametrize("name", ["local-mean", "gated", "registered"])
def test_gains_of_edges_are_as_good_as_those_of_the_middle(name):
    moving = MovingScene(seed=1, shape=SHAPE, noise=0.1)
    method = made(name)
    run(moving, method, 1500)
    response = method.gain * moving.gain
    edge = np.ones(SHAPE, bool)
    edge[4:-4, 4:-4] = False
    # Standard deviations of 960 and 3136 pixels err by 2.3 and 1.3 %; three times both.
    assert np.std(response[edge]) < 1.08 * np.std(response[~edge])


def sequences():
    """Frames of no moving scene, with noise of 0.5 % and a pattern of 3 %."""
    random, moving = np.random.default_rng(6), MovingScene(seed=6, shape=SHAPE)
    pattern = 0.03 * random.standard_normal(SHAPE)
    still = moving.scene(np.array([3.0, 5.0]))

    def blocks(_):
        return np.kron(random.standard_normal((8, 8)), np.ones((8, 8)))

    def half(index):
        seen = moving.scene(np.array([3.0 + 1.5 * index, 5.0]))
        seen[:, :32] = still[:, :32]
        return seen

    def person(index):
        seen = still.copy()
        left = index % 56
        seen[20:40, left : left + 8] = 3.0
        return seen

    kinds = {
        "unrelated": lambda _: moving.scene(random.uniform(0, 1024, 2)),
        "blocks": blocks,
        "still": lambda _: still,
        "half": half,
        "person": person,
    }
    return {
        kind: [
            0.5 + 0.1 * light(index) + pattern + 0.005 * random.standard_normal(SHAPE)
            for index in range(240)
        ]
        for kind, light in kinds.items()
    }


@pytest.fixture(scope="module")
def unmoved():
    return sequences()


@pytest.mark.parametrize("kind", ["unrelated", "blocks", "still", "half", "person"])
@pytest.mark.parametrize("name", NAMES)
def test_no_moving_scene_teaches_nothing_or_is_named(name, kind, unmoved):
    method = made(name)
    for values in unmoved[kind]:
        method.update(values)
    if np.all(method.gain == 1) and np.all(method.offset == 0):
        return
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        method.correction()
    assert any(
        "of the field" in str(each.message) or "counted" in str(each.message) for each in found
    )


def test_registered_learns_nothing_from_still_or_unrelated_frames(unmoved):
    for kind in ("unrelated", "blocks", "still"):
        method = made("registered")
        for values in unmoved[kind]:
            method.update(values)
        # One pair in a hundred may pass by chance: of 239 more than 8 have a probability of 1e-3.
        assert method.frames <= 8, kind


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_the_standard_scene_has_no_finding(name):
    for seed in range(20):
        method = made(name)
        for frame in MovingScene(seed=seed, shape=SHAPE, stop=(100, 140)).frames(200):
            method.update(frame.values)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert method.frames_foreign == 0
            assert not method.correction().flags.any()


@pytest.mark.study
@pytest.mark.parametrize("name", NAMES)
def test_a_calibrated_camera_loses_at_most_the_floor_that_is_stated(name, draws, figure):
    """A pattern of 0.1 % of the range, which is below what the methods leave, at 128×128 pixels.

    The errors are waves of some ten pixels or more, of which a smaller array has too few: at 64×64
    the pattern of a single experiment scatters by twice as much about the one that is stated.
    """
    ones, ratios, worse = np.ones(WIDE), [], []
    for seed in draws(20):
        moving = MovingScene(
            seed=seed, shape=WIDE, gain_spread=0.001, offset_spread=0.001, noise=0.01, stop=(0, 0)
        )
        method = made(name, WIDE)
        total = 0.0
        for count, frame in enumerate(moving.frames(FLOORS[-1]), 1):
            method.update(frame.values)
            total += frame.level
            if count in FLOORS:
                before, after = (
                    moving.residual_pattern(gain, offset, total / count)
                    for gain, offset in ((ones, 0 * ones), (method.gain, method.offset))
                )
                ratios.append(after / method.floor)
                worse.append(np.sqrt(max(after**2 - before**2, 0)) / method.floor)
        assert method.correction().metadata["scene"]["floor_dn"] == method.floor
    figure(f"pattern over the stated floor, {name}, largest", max(ratios), "1 or less")
    figure(f"what is added to the pattern, over that floor, {name}", max(worse), "1 or less")
    figure(f"stated floor over the pattern, {name}, largest", 1 / min(ratios), "1.5 or less")
    # Half of what Kalman leaves are waves beyond 28 pixels, of which the array has (128/28)² π, 66:
    # a single rms of them scatters by 1/√(2 · 66) about the one that is stated.
    assert max(worse) <= (1.09 if name == "kalman" else 1)
    assert min(ratios) >= 1 / 1.5


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("name", NAMES)
def test_a_dead_row_and_a_cluster_spoil_no_good_pixel(name, given):
    moving = MovingScene(seed=3, shape=SHAPE)
    dead = np.zeros(SHAPE, bool)
    dead[30] = dead[8:12, 40:44] = True
    good = ~dead
    plain, method = made(name), made(name, mask=dead if given else None)
    for frame in moving.frames(800):
        plain.update(frame.values)
        method.update(np.where(dead, 0.1, frame.values))
    left = [np.std((each.gain * moving.gain)[good]) for each in (plain, method)]
    # 1.04 is what filling the gaps by their neighbours costs those beside them, a tenth of pixels.
    assert left[1] < 1.1 * left[0]
    assert np.all(method.correction().flags[dead] > 0)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "registered"])
@pytest.mark.parametrize("kind", ["black", "shutter", "half"])
def test_foreign_frames_are_noticed_and_change_nothing(name, kind):
    moving, random = MovingScene(seed=1, shape=SHAPE, stop=(0, 0)), np.random.default_rng(3)
    method = made(name)
    given = [frame.values for frame in moving.frames(130)]
    for values in given[:120]:
        method.update(values)
    gain, offset = method.gain, method.offset
    noise = 0.002 * random.standard_normal(SHAPE)
    foreign = {
        "black": noise,
        "shutter": 0.5 * moving.gain + moving.offset + noise,
        "half": np.where(np.arange(64)[:, None] < 36, given[120], noise),
    }[kind]
    method.update(foreign)
    assert method.frames_foreign == 1
    np.testing.assert_array_equal(method.gain, gain)
    np.testing.assert_array_equal(method.offset, offset)
    for values in given[120:]:
        method.update(values)
    assert method.frames_foreign == 1


def test_a_range_that_frames_do_not_reach_is_named_before_and_after_loading(tmp_path):
    method = scene.LocalMean(SHAPE, "uint16")
    for frame in MovingScene(seed=1, shape=SHAPE).frames(32):
        method.update(np.clip(np.rint(16383 * frame.values), 0, 16383).astype(np.uint16))
    method.save(tmp_path / "state.npz")
    for each in (method, equipix.load(tmp_path / "state.npz")):
        with pytest.warns(errors.InputWarning, match=r"data_range=\(0, 16383\).*--bit-depth 14"):
            each.correction()


def test_gains_that_spread_are_named():
    gains, method = np.array([-0.04, 1.0, 50.0]), made("local-mean")
    for frame in MovingScene(seed=1, shape=SHAPE).frames(32):
        method.update(frame.values)
    with pytest.warns(errors.InputWarning, match=r"the gains spread by 23 \(limit 0.3\)"):
        say(*ask(_RULES, _Learned(method, None, None, gains)))


def test_a_correction_from_few_frames_says_so():
    method = made("local-mean")
    frames = MovingScene(seed=1, shape=SHAPE).frames(32)
    for frame in itertools.islice(frames, 2):
        method.update(frame.values)
    with pytest.warns(
        errors.InputWarning, match=r"only 2 of the frames counted \(limit 32, from which 'floor'"
    ):
        found = method.correction().findings
    assert [each.kind for each in found] == ["few"]
    for frame in itertools.islice(frames, 29):
        method.update(frame.values)
    assert method.floor is None
    method.update(next(frames).values)
    assert method.floor is not None
    assert method.correction().findings == ()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("page", ["gain", "history_mean", "field_mean", "late_pattern"])
def test_a_state_of_which_a_value_was_changed_is_refused(name, page, tmp_path):
    method = made(name)
    for frame in MovingScene(seed=1, shape=SHAPE).frames(60):
        method.update(frame.values)
    method.save(tmp_path / "state.npz")
    pages, content = load_pages(tmp_path / "state.npz")
    changed = pages[f"maps.{page}"].copy()
    changed[3, 4] += np.float32(0.5)
    save_pages(tmp_path / "changed.npz", pages | {f"maps.{page}": changed}, content)
    with pytest.raises(errors.FileError, match=f"changed.npz: is damaged: .*maps.{page}"):
        equipix.load(tmp_path / "changed.npz")

"""Corrections from the scene: quality on the standard scene, states, refusals."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import Flag, errors
from equipix.io.formats import load_pages
from equipix.io.record import read_record
from equipix.saved_results import load_correction
from equipix.scene.methods import METHODS, resumed
from equipix.scene.scene_correction import SceneState
from equipix.simulate import MovingScene
from records import rewrite
from reference import scene as reference

SHAPE = (48, 64)
NAMES = tuple(METHODS)
DESCENTS = ("local-mean", "gated", "registered")


def made(name, shape=SHAPE, data_range=(0, 1), **options):
    return METHODS[name](shape, data_range, **options)


def frames(count, *, seed=5, shape=SHAPE, **options):
    return [frame.values for frame in MovingScene(seed=seed, shape=shape, **options).frames(count)]


@pytest.fixture(scope="module")
def run():
    """Falls of pattern and gain error after 500 moving frames, growth over the stop."""
    moving = MovingScene(seed=1)
    methods = {name: made(name, moving.shape) for name in NAMES}
    methods["gate off"] = made("gated", moving.shape, threshold=0)
    found = {name: [] for name in methods}
    for index, frame in enumerate(moving.frames(600)):
        for name, method in methods.items():
            method.update(frame.values)
            if index in (249, 349):
                # The level is paused, so coefficients alone can change the pattern.
                found[name].append(moving.residual_pattern(method.gain, method.offset, frame.level))
    ones = np.ones(moving.shape)
    raw = moving.residual_pattern(ones, 0 * ones, frame.level)
    return {
        name: {
            "fall": raw / moving.residual_pattern(method.gain, method.offset, frame.level),
            "gain": moving.gain_error(ones) / moving.gain_error(method.gain),
            "growth": found[name][1] / found[name][0],
            "response": np.mean(method.gain * moving.gain),
        }
        for name, method in methods.items()
    }


class TestStandardScene:
    """The figures that hold on the standard scene; docs/scene.py prints them for three seeds."""

    @pytest.mark.long
    @pytest.mark.parametrize(
        ("name", "fall"),
        [
            ("local-mean", 5),
            ("gated", 6),
            ("registered", 12),
            ("constant-statistics", 8),
            ("kalman", 8),
        ],
    )
    def test_the_pattern_falls(self, run, name, fall):
        assert run[name]["fall"] >= fall

    @pytest.mark.parametrize("name", ["registered", "constant-statistics", "kalman"])
    def test_the_gain_error_falls(self, run, name):
        """By at least a quarter of the way to its figure after 2000 frames, 1.8 or 2.5."""
        final = 1.8 if name == "registered" else 2.5
        assert run[name]["gain"] >= 1 + (final - 1) / 4

    @pytest.mark.parametrize("name", NAMES[1:])
    def test_a_stop_leaves_the_pattern(self, run, name):
        assert run[name]["growth"] < 1.1

    def test_without_a_gate_the_scene_becomes_a_pattern(self, run):
        assert run["gate off"]["growth"] >= 2

    @pytest.mark.parametrize("name", NAMES)
    def test_the_mean_response_stays(self, run, name):
        assert abs(run[name]["response"] - 1) < 0.01


REQUIRED = {
    "local-mean": (5, 8, 0),
    "gated": (6, 6, 0),
    "registered": (12, 18, 1.8),
    "constant-statistics": (8, 12, 2.5),
    "kalman": (8, 12, 2.5),
}
"""Falls of the pattern after 500 and 2000 moving frames, and of the gain error after 2000."""


@pytest.mark.long
@pytest.mark.parametrize(("seed", "count"), [(1, 2000), (2, 500), (3, 500)])
def test_the_falls_on_a_part_of_the_standard_scene(seed, count):
    """Of 96x96 pixels, for time; ``python docs/scene.py --check`` has all, of three seeds."""
    moving = MovingScene(seed=seed, shape=(96, 96))
    methods = {name: made(name, moving.shape) for name in NAMES}
    ones = np.ones(moving.shape)
    for index, frame in enumerate(moving.frames(count + 100)):
        for method in methods.values():
            method.update(frame.values)
        if index not in (599, 2099):
            continue
        raw = moving.residual_pattern(ones, 0 * ones, frame.level)
        for name, method in methods.items():
            fall = raw / moving.residual_pattern(method.gain, method.offset, frame.level)
            assert fall >= REQUIRED[name][index // 2099], (name, index)
    if count == 2000:
        for name, method in methods.items():
            gains = moving.gain_error(ones) / moving.gain_error(method.gain)
            assert gains >= REQUIRED[name][2], name


def test_a_level_that_changes_during_a_stop_updates_nothing():
    moving = MovingScene(seed=3, shape=(96, 96), stop=(60, 110), running=True)
    methods = {name: made(name, moving.shape) for name in NAMES[1:]}
    for index, frame in enumerate(moving.frames(110)):
        for method in methods.values():
            method.update(frame.values)
        if index == 59:
            level = frame.level
            before = {
                name: moving.residual_pattern(method.gain, method.offset, level)
                for name, method in methods.items()
            }
    for name, method in methods.items():
        assert moving.residual_pattern(method.gain, method.offset, level) < 1.1 * before[name]


class TestReference:
    """The compiled methods against NumPy in double precision.

    Values of order 1 are rounded to 2⁻²⁴ some 10² times in each frame, more in squares; over n
    frames the differences of the coefficients add up to at most n · 10² · 2⁻²⁴, since every step
    contracts.
    """

    ROUNDING = 100 * 2.0**-24

    @pytest.fixture
    def values(self):
        return frames(24)

    def compare(self, method, slow, values, allowed):
        for value in values:
            corrected = slow.gain * value + slow.offset
            np.testing.assert_allclose(method.update(value), corrected, atol=allowed)
            slow.update(value)
            np.testing.assert_allclose(method.gain, slow.gain, atol=allowed)
            np.testing.assert_allclose(method.offset, slow.offset, atol=allowed)
        assert np.abs(method.gain - 1).max() > 100 * allowed

    @pytest.mark.parametrize("kernel", [((0, 1, 0), (1, 0, 1), (0, 1, 0)), ((1, 2, 4, 2, 1),)])
    def test_local_mean(self, values, kernel):
        slow = reference.LocalMean(SHAPE, 0.1, kernel)
        method = made("local-mean", step=0.1, kernel=kernel)
        self.compare(method, slow, values, len(values) * self.ROUNDING)

    def test_gated(self, values):
        slow = reference.Gated(SHAPE, 0.2, 11, 0.02, 100.0)
        self.compare(made("gated", step=0.2), slow, values, len(values) * self.ROUNDING)

    def test_registered(self, values):
        slow = reference.Registered(SHAPE, 0.1, 0.5, 8)
        # A phase of an amplitude near 0 turns by its rounding: the shift errs by some 1e-5 pixel,
        # times the largest slope of the scene, 0.3 a pixel.
        allowed = len(values) * (self.ROUNDING + 0.1 * 0.3 * 1e-5)
        self.compare(made("registered"), slow, values, allowed)
        assert len(slow.moves) == len(values) - 1

    def test_constant_statistics(self):
        values = frames(48)
        slow = reference.ConstantStatistics(SHAPE, 21, 4000, 0.004, 100)
        # A deviation counts from 1e-3 on, a tenth of its neighbourhood's 1e-2. Four roundings of
        # values of order 1 change it by a share 4 · 2⁻²⁴ / 1e-3, and its gain by that times a
        # weight of 24/124 and a ratio of at most 10.
        self.compare(made("constant-statistics"), slow, values, 2 * 4 * 2.0**-24 / 1e-3)

    def test_kalman(self, values):
        slow = reference.Kalman(SHAPE, 21, 8, 0.004, (0.05, 0.1), 1e4)
        method = made("kalman", block=8, memory=1e4)
        self.compare(method, slow, values, len(values) * self.ROUNDING)
        for values_, variance in ((method.gain_std, slow.covariance[..., 0, 0]),):
            wanted = np.sqrt(variance) / slow.state[0] ** 2
            np.testing.assert_allclose(values_, wanted, rtol=1e-3)


def test_the_standard_deviations_of_kalman_are_those_of_its_errors():
    moving = MovingScene(seed=2, shape=(128, 128))
    method = made("kalman", moving.shape)
    for frame in moving.frames(700):
        method.update(frame.values)

    def detail(error):
        """Errors within a neighbourhood: wider ones are not determined."""
        return np.std(error - reference.box(error, 21))

    gain = detail(method.gain - 1 / moving.gain)
    offset = detail(method.offset + moving.offset / moving.gain)
    # 600 moving frames are 12 blocks, with one estimate of the variance each, which errs by √(2/12)
    # if the pixels of a block had one error in common, and the standard deviation by half of it:
    # 0.2, of which this is twice.
    assert 0.6 < gain / np.sqrt(np.mean(method.gain_std**2)) < 1.4
    assert 0.6 < offset / np.sqrt(np.mean(method.offset_std**2)) < 1.4


@pytest.mark.parametrize("name", NAMES)
class TestEveryMethod:
    def learned(self, name, count=80, **options):
        method = made(name, **options)
        for value in frames(count):
            method.update(value)
        return method

    @pytest.mark.parametrize("suffix", [".npz", ".tif"])
    def test_a_saved_state_goes_on_with_the_same_bytes(self, name, suffix, tmp_path):
        values = frames(130)
        method = made(name)
        for value in values[:75]:
            method.update(value)
        method.save(tmp_path / f"state{suffix}")
        loaded = equipix.load(tmp_path / f"state{suffix}")
        assert type(loaded) is type(method)
        assert loaded.options == method.options
        for value in values[75:]:
            np.testing.assert_array_equal(method.update(value), loaded.update(value))
        np.testing.assert_array_equal(method.gain, loaded.gain)
        np.testing.assert_array_equal(method.offset, loaded.offset)
        assert method.frames == loaded.frames

    def test_the_bytes_do_not_depend_on_workers(self, name):
        one, three = self.learned(name, workers=1), self.learned(name, workers=3)
        assert np.any(one.gain != 1)
        np.testing.assert_array_equal(one.gain, three.gain)
        np.testing.assert_array_equal(one.offset, three.offset)

    def test_the_gauge_holds_at_every_step(self, name):
        method = made(name)
        for value in frames(60):
            method.update(value)
            # A value is rounded to half a unit in the last place of a number below 2, at most.
            assert abs(np.mean(method.gain, dtype=float) - 1) < 2.0**-22
            assert abs(np.mean(method.offset, dtype=float)) < 2.0**-22

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_bad_and_dropped_frames_change_no_state(self, name, bad, tmp_path):
        method = self.learned(name)
        method.save(tmp_path / "before.npz")
        value = frames(81)[-1]
        value[3, 5] = bad
        corrected = method.update(value)
        assert not np.isfinite(corrected[3, 5])
        assert np.count_nonzero(~np.isfinite(corrected)) == 1
        method.update(np.zeros(SHAPE))
        method.save(tmp_path / "after.npz")
        assert (tmp_path / "before.npz").read_bytes() == (tmp_path / "after.npz").read_bytes()

    def test_a_frame_far_outside_of_the_range_is_refused(self, name):
        method = self.learned(name)
        before = method.gain
        value = frames(1)[0]
        value[3, 5] = 40
        with pytest.raises(errors.InputError, match=r"'frame' holds values more than one span"):
            method.update(value)
        np.testing.assert_array_equal(method.gain, before)

    def test_the_result_corrects_as_the_next_update_does(self, name):
        """In DN, of whole numbers with a range that does not begin at 0."""
        low, high = 4000, 12_000
        values = [np.rint(low + (high - low) * value).astype(np.uint16) for value in frames(81)]
        method = made(name, data_range=(low, high))
        for value in values[:-1]:
            method.update(value)
        result = method.correction()
        assert isinstance(result, equipix.Polynomial)
        assert result.metadata["scene"]["method"] == name
        # 8000 DN in single precision, through three roundings.
        np.testing.assert_allclose(
            result.correct(values[-1]), method.update(values[-1]), atol=4 * 8000 * 2.0**-23
        )

    def test_a_state_of_another_version_or_in_the_place_of_a_correction_is_refused(
        self, name, tmp_path
    ):
        method = made(name)
        method.save(tmp_path / "state.npz")
        with pytest.raises(
            errors.FileError, match=r"expected a correction: save its correction\(\)"
        ):
            load_correction(tmp_path / "state.npz")
        rewrite(tmp_path / "state.npz", version=SceneState.VERSION + 1)
        with pytest.raises(errors.FileError, match=r"state.npz: holds state .* of version 6"):
            equipix.load(tmp_path / "state.npz")

    def test_a_damaged_state_is_refused(self, name, tmp_path):
        method = made(name)
        method.save(tmp_path / "state.npz")
        gain = load_pages(tmp_path / "state.npz")[0]["maps.gain"]
        for name_of, damaged, message in (
            ("maps.offset", None, "array 'maps.offset' is missing"),
            ("maps.gain", gain[:-1], "47"),
            ("maps.gain", gain + np.float32(np.nan), "NaN"),
        ):
            method.save(tmp_path / "damaged.npz", force=True)
            rewrite(tmp_path / "damaged.npz", arrays={name_of: damaged})
            with pytest.raises(errors.FileError, match=f"damaged.npz: is damaged: .*{message}"):
                equipix.load(tmp_path / "damaged.npz")

    def test_another_shape_is_refused(self, name):
        with pytest.raises(errors.InputError, match=r"'frame' is float64 of shape \(64, 48\)"):
            made(name).update(np.ones((64, 48)))


@pytest.mark.parametrize("name", NAMES[1:])
def test_a_scene_that_never_moves_is_reported(name):
    rng = np.random.default_rng(1)
    still = frames(1)[0]
    method = made(name)
    for _ in range(60):
        method.update(still + 0.002 * rng.standard_normal(SHAPE))
    with pytest.raises(errors.InputError, match="take a moving scene"):
        method.correction()


@pytest.mark.parametrize(
    ("name", "bound"),
    [("local-mean", 0.5), ("gated", None), ("registered", 0.25)],
)
def test_steps_above_the_bound_are_refused_with_the_bound(name, bound):
    with pytest.raises(errors.InputError, match=r"'step' is 0.9, .*stability bound") as refused:
        made(name, step=0.9)
    if bound:
        assert f"below {bound:.4f}" in str(refused.value)
        made(name, step=0.99 * bound)
        with pytest.raises(errors.InputError, match="'step'"):
            made(name, step=bound)
    with pytest.raises(errors.InputError, match="'step' is 0, expected above 0"):
        made(name, step=0.0)


def test_local_mean_diverges_above_the_bound_and_not_below():
    """A checkerboard at y = 1: the eigenvalue of the bound."""
    board = np.indices((16, 16)).sum(axis=0) % 2 * 2.0 - 1
    for step, grows in ((0.49, False), (0.51, True)):
        slow = reference.LocalMean((16, 16), step)
        slow.follow = lambda _: None  # the centre stays at 0, so that y is as far as it can be
        slow.offset = 1e-6 * board
        size = [np.std(slow.gain + slow.offset)]
        for _ in range(50):
            slow.update(np.ones((16, 16)))
            size.append(np.std(slow.gain + slow.offset))
        assert (size[-1] > size[0]) == grows


@pytest.mark.parametrize("move", [(0.5, 0.5), (0.0, 0.5), (1.5, 1.5), (0.05, 0.05), (-2.3, 3.7)])
def test_the_operator_of_registered_is_symmetric_with_eigenvalues_up_to_four(move):
    """Of offsets alone: the step changes them by −η (S − 1)ᵀ M (S − 1) o."""
    shape = (10, 12)
    method = reference.Registered(shape, 1.0, 0.5, 8)
    columns = []
    for unit in np.eye(120):
        method.offset = unit.reshape(shape)
        zeros = np.zeros(shape)
        error = method.error(zeros, zeros, np.array(move))
        columns.append((method.transposed(error, np.array(move)) - error).ravel())
    operator = np.array(columns).T
    rounding = 120 * 4 * 2.0**-52
    np.testing.assert_allclose(operator, operator.T, atol=rounding)
    values = np.linalg.eigvalsh(operator)
    assert -rounding < values[0]
    assert values[-1] < 4


@pytest.mark.study
@pytest.mark.parametrize("move", [(1.5, 1.5), (0.5, 0.5), (0.0, 0.5)])
def test_an_even_pan_never_lets_a_pattern_grow(move):
    """Of the reference, without scene and noise: there one-sided differences grew at any step."""
    moving = MovingScene(seed=1, shape=(20, 24), stop=(0, 0))
    method = reference.Registered(moving.shape, 0.249, 0.5, 8)
    method.usual = 1e9
    size = [1.0]
    for index in range(2000):
        first, second = (
            moving.gain * (0.5 + 0.45 * np.cos(0.1 * i)) + moving.offset for i in (index, index + 1)
        )
        error = method.gain * moving.gain - 1, method.gain * moving.offset + method.offset
        size.append(np.sqrt(sum(np.sum((each - each.mean()) ** 2) for each in error)))
        method.learn(first, second, np.array(move))
    assert size[-1] < size[1001] < size[101] < size[1]


@pytest.mark.long
def test_an_even_pan_leaves_the_fall():
    moving = MovingScene(seed=1, shape=(64, 64))
    noise = np.random.default_rng(8)
    method = made("registered", moving.shape)
    left = []
    for index in range(1500):
        level = 0.5 - 0.25 * np.cos(0.01 * index)
        light = level + 0.1 * moving.scene(np.array([7.0, 11.0]) + index * np.array([1.5, 1.5]))
        values = moving.gain * light + moving.offset
        method.update(values + 0.002 * noise.standard_normal(moving.shape))
        if index in (499, 1499):
            left.append(moving.residual_pattern(method.gain, method.offset, 0.5))
    assert left[1] < left[0]


FOREIGN = ("counter", "black", "shutter", "full", "half")


def foreign(kind, moving, random):
    """Frames of no scene, as cameras deliver them."""
    shape = moving.shape
    frame = np.zeros(shape)
    if kind == "counter":
        frame[0, 0] = 0.3
    elif kind == "black":
        frame = 0.002 * random.standard_normal(shape)
    elif kind == "shutter":
        frame = moving.gain * 0.5 + moving.offset + 0.002 * random.standard_normal(shape)
    elif kind == "full":
        frame[:] = 1
        frame[5, 5] = 0.99
    return frame


@pytest.fixture(scope="module")
def settled(tmp_path_factory):
    """A state of Registered after 600 frames, the frames after it, and the scene."""
    moving = MovingScene(seed=1, shape=(64, 64))
    given = list(moving.frames(630))
    method = made("registered", moving.shape)
    for frame in given[:600]:
        method.update(frame.values)
    path = tmp_path_factory.mktemp("settled") / "state.npz"
    method.save(path)
    return moving, given, path


@pytest.mark.parametrize("kind", FOREIGN)
def test_foreign_frames_leave_what_registered_has_learned(settled, kind):
    moving, given, path = settled
    random = np.random.default_rng(3)
    plain, method = equipix.load(path), equipix.load(path)
    for index, frame in enumerate(given[600:]):
        plain.update(frame.values)
        values = foreign(kind, moving, random) if index == 5 else frame.values.copy()
        if kind == "half" and index == 5:
            values = frame.values.copy()
            values[32:] = 0
        method.update(values)
        if index >= 5:
            wanted, got = (
                moving.residual_pattern(each.gain, each.offset, frame.level)
                for each in (plain, method)
            )
            # Two pairs of thirty are lacking, each of which changes the pattern by a few percent.
            assert got < 1.05 * wanted


@pytest.mark.parametrize("side", [24, 32, 48, 64, 96, 128])
def test_unrelated_frames_are_no_pairs(side):
    """Of 200 pairs at most 1 % on average: more than 7 have a probability of 1e-3."""
    moving, random = MovingScene(seed=3, shape=(side, side)), np.random.default_rng(side)
    method = made("registered", moving.shape)
    for _ in range(201):
        method.update(0.5 + 0.1 * moving.scene(random.uniform(0, 1024, 2)))
    assert method.frames <= 7


def test_a_lasting_change_of_the_frames_is_taken_in_the_end(settled):
    """Ten times the difference: refused at first, until the usual difference has grown."""
    _, _, path = settled
    method = equipix.load(path)
    before = method.frames
    other = MovingScene(seed=1, shape=(64, 64), gain_spread=0.2, offset_spread=0.2)
    for frame in other.frames(60):
        method.update(frame.values)
    assert method.frames > before


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_saturated_pixels_are_not_learned_from(name):
    """At a limit that 15 % of the values reach, the gains stay better than none at all.

    More than half of what clipping costs in the pattern is kept; of ConstantStatistics a part,
    since it keeps saturated pixels of other neighbourhoods.
    """
    moving, limit = MovingScene(seed=1, shape=(64, 64), stop=(0, 0)), 0.75
    plain, blind = made(name, (64, 64)), made(name, (64, 64))
    aware = made(name, (64, 64), saturation=limit)
    for frame in moving.frames(500):
        clipped = np.minimum(frame.values, limit)
        plain.update(frame.values)
        blind.update(clipped)
        aware.update(clipped)
    left = [
        moving.residual_pattern(method.gain, method.offset, 0.4) for method in (plain, blind, aware)
    ]
    lost = [np.log(each / left[0]) for each in left[1:]]
    assert lost[0] > np.log(1.5)
    assert lost[1] < (lost[0] if name == "constant-statistics" else lost[0] / 2)
    assert moving.gain_error(aware.gain) < moving.gain_error(np.ones(moving.shape))


def test_whole_numbers_saturate_at_the_top_of_their_type():
    values = [np.clip(np.rint(255 * value), 0, 255).astype(np.uint8) for value in frames(60)]
    own = made("local-mean", data_range="uint8")
    given = made("local-mean", data_range="uint8", saturation=255)
    for value in values:
        value[10:20, 10:20] = 255
        own.update(value)
        given.update(value)
    np.testing.assert_array_equal(own.gain, given.gain)
    # Pixels that are always saturated differ by the gauge alone, which is common to all.
    assert np.ptp(own.gain[11:19, 11:19]) < 60 * 2.0**-22
    other = made("local-mean", data_range="uint8", saturation=300)
    for value in values:
        other.update(value)
    assert np.any(other.gain != own.gain)


@pytest.mark.parametrize("name", ["gated", "constant-statistics", "kalman"])
@pytest.mark.parametrize("width", [1, 10, 49])
def test_a_width_out_of_range_is_refused(name, width):
    with pytest.raises(
        errors.InputError, match=f"'width' is {width}, expected an odd number from 3"
    ):
        made(name, width=width)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("local-mean", {"kernel": np.ones((2, 3))}, "'kernel' has shape"),
        ("local-mean", {"kernel": [[1.0]]}, "'kernel' has no stable step"),
        ("local-mean", {"kernel": [[1.0, -2.0, 1.0]]}, "'kernel' has the sum 0"),
        ("local-mean", {"data_range": (5, 5)}, "'data_range'"),
        ("local-mean", {"data_range": "float32"}, "'data_range'"),
        ("registered", {"most_motion": 0}, "'most_motion' is 0"),
        ("registered", {"cutoff": 0.7}, "'cutoff' is 0.7"),
        ("kalman", {"block": 7}, "'block' is 7"),
        ("kalman", {"width": 2.5}, "'width' is 2.5"),
        ("constant-statistics", {"window": 1}, "'window' is 1"),
        ("gated", {"threshold": -1.0}, "'threshold' is -1"),
        ("gated", {"shape": (8, 64)}, "'shape' has shape"),
    ],
)
def test_numbers_out_of_range_are_refused(name, options, message):
    with pytest.raises(errors.InputError, match=message):
        made(name, **options)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("stuck", "noise"), [(0.1, 0.0), (0.1, 0.002), (1.0, 0.0)])
def test_a_dead_pixel_is_flagged_and_does_not_change_the_others(name, stuck, noise, tmp_path):
    good, other = made(name), made(name)
    random = np.random.default_rng(4)
    for value in frames(600):
        good.update(value)
        dead = value.copy()
        dead[20, 30] = stuck + noise * random.standard_normal()
        other.update(dead)
    other.save(tmp_path / "state.npz")
    for result in (other.correction(), equipix.load(tmp_path / "state.npz").correction()):
        assert result.flags[20, 30] == Flag.DEAD | Flag.DO_NOT_USE
        assert np.count_nonzero(result.flags) == 1
    assert not good.correction().flags.any()
    if name in ("constant-statistics", "kalman"):
        apart = np.hypot(*np.meshgrid(np.arange(48) - 20, np.arange(64) - 30, indexing="ij")) > 31
        # Its gain, 10 at most, changes the gauge by 9 of 3072 pixels.
        assert np.max(np.abs(other.gain / good.gain - 1)[apart]) < 9 / 3072 * 1.1


def test_few_frames_that_count_are_told():
    """At a contrast of 1.5 % most phases are those of the pattern, which stands still."""
    method = made("registered", (64, 64))
    moving = MovingScene(seed=1, shape=(64, 64), contrast=0.015, stop=(0, 0))
    for frame in moving.frames(300):
        method.update(frame.values)
    assert method.frames_taken == 300
    assert 0 < method.frames < 30
    with pytest.warns(errors.InputWarning, match=f"{method.frames} of 300 frames counted"):
        result = method.correction()
    held = result.metadata["scene"]
    assert (held["frames"], held["frames_taken"]) == (method.frames, 300)


def test_floats_far_from_zero_are_scaled_before_they_are_rounded():
    """Of doubles over (1e8, 1e8 + 1): in single precision all of them were the same."""
    far, near = made("local-mean", data_range=(1e8, 1e8 + 1)), made("local-mean")
    for value in frames(20):
        far.update(1e8 + value)
        near.update(value)
    # 1e8 + y is rounded to 2⁻²⁷ · ½.
    np.testing.assert_allclose(far.gain, near.gain, atol=20 * (2.0**-24 + 2.0**-27))
    assert np.ptp(far.gain) > 1e-3


@pytest.mark.parametrize("data_range", [(0, 1e-46), (0, 1e300)])
def test_a_range_beyond_single_precision_is_refused(data_range):
    with pytest.raises(errors.InputError, match="'range' is"):
        made("local-mean", data_range=data_range)


def test_a_finite_value_beyond_single_precision_is_refused():
    value = frames(1)[0]
    value[3, 5] = 1e300
    with pytest.raises(errors.InputError, match="more than one span outside"):
        made("local-mean").update(value)


class TestDamagedStates:
    """Metadata that no `save` wrote."""

    def refused(self, tmp_path, message, name="kalman", arrays=None, **fields):
        path = tmp_path / "state.npz"
        made(name).save(path, force=True)
        rewrite(path, {key.replace("__", "."): each for key, each in fields.items()}, arrays)
        with pytest.raises(errors.FileError, match=message):
            equipix.load(path)

    @pytest.mark.parametrize("shape", [5, None, [48], [48.5, 64]])
    def test_shapes(self, tmp_path, shape):
        self.refused(tmp_path, "is damaged: ", shape=shape)

    def test_a_method_that_is_no_name(self, tmp_path):
        self.refused(tmp_path, "is damaged: 'method' is", method=["kalman"])
        self.refused(tmp_path, "is damaged: 'another'", method="another")

    def test_options_of_another_method(self, tmp_path):
        self.refused(tmp_path, "is damaged: .*'step'", options={"step": 0.1})

    @pytest.mark.parametrize("count", [50, 999, 1.7, -1, True])
    def test_counts(self, tmp_path, count):
        self.refused(tmp_path, "is damaged: .*(count|negative)", counts__count=count)

    def test_negative_variances(self, tmp_path):
        maps = {"maps.history_variance": np.full(SHAPE, -1, np.float32)}
        self.refused(tmp_path, "holds -1 in the map", arrays=maps)


def test_workers_are_checked_before_the_state(tmp_path):
    made("gated").save(tmp_path / "state.npz")
    state = read_record(tmp_path / "state.npz", SceneState)
    with pytest.raises(errors.InputError, match="'workers' is 0"):
        resumed("state.npz", state, workers=0)


def test_what_was_learned_from_can_be_corrected():
    """Values above the level that counts as saturated too, as of a hot pixel."""
    method = made("local-mean", (48, 64), saturation=0.9)
    for frame in MovingScene(seed=1, shape=(48, 64)).frames(32):
        values = frame.values.copy()
        values[3, 4] = 1.05
        method.update(values)
    assert np.isfinite(method.correction().correct(values)).all()


@pytest.mark.parametrize("name", NAMES)
def test_frames_of_fewer_bits_than_the_range_are_refused(name):
    method = METHODS[name]((48, 64), "uint16")
    with pytest.raises(
        errors.InputError, match=r"'frame': .* 0 to 65535 DN, but the frames are uint8, up"
    ):
        method.update(np.ones((48, 64), np.uint8))
    assert method.frames_taken == 0
    METHODS[name]((48, 64), (0, 510)).update(np.ones((48, 64), np.uint8))

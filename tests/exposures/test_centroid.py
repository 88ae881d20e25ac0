"""Spot centroid: against the reference, simulated truth, laws, bad input and image files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import tifffile

import equipix
from equipix.errors import InputError, SpotError
from reference import centroid as reference

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

SHAPE = (80, 96)
EPS = float(np.finfo(np.float64).eps)
GAIN = 0.2  # DN per electron
PROBLEMS = {
    "missing": "no spot",
    "cut": "cut by the edge",
    "doubled": "doubled spot",
    "saturated": "saturated spot",
}


def rounding(shape: tuple[int, ...]) -> float:
    """Bound of the rounding of a sum over an image of places times signal, over the flux.

    The signal's modulus sums to some 4 times the flux at most, places reach the image's size.
    """
    return 4 * EPS * float(np.prod(shape[-2:])) * max(shape)


def gaussian(centre: Any, width: float, shape: tuple[int, int] = SHAPE) -> NDArray[Any]:
    rows, cols = np.indices(shape)
    return np.exp(-((rows - centre[0]) ** 2 + (cols - centre[1]) ** 2) / (2 * width**2))


def disc(centre: Any, radius: float, blur: float, shape: tuple[int, int] = SHAPE) -> NDArray[Any]:
    """Top hat with an outline like that of a hole out of focus."""
    rows, cols = np.indices(shape)
    distance = np.hypot(rows - centre[0], cols - centre[1]) - radius
    return 1 / (1 + np.exp(1.702 * distance / blur))


def vignetted(level: float, shape: tuple[int, int] = SHAPE) -> NDArray[Any]:
    """Background that falls by 30 % from the centre to the corners, as cos⁴."""
    rows, cols = np.indices(shape)
    centre = (np.array(shape) - 1) / 2
    r2 = (rows - centre[0]) ** 2 + (cols - centre[1]) ** 2
    return level / (1 + 0.2 * r2 / (centre @ centre)) ** 2


def frames(
    mean: NDArray[Any], count: int, rng: np.random.Generator, read: float = 1.5
) -> NDArray[Any]:
    """Frames with photon noise and read noise, digitised."""
    noise = rng.standard_normal((count, *mean.shape)) * np.sqrt(GAIN * mean + read**2)
    return np.clip(np.round(mean + noise), 0, 65535).astype(np.uint16)


# Against the reference


def random_scene(rng: np.random.Generator) -> NDArray[Any]:
    """Frames of a scene that has one good spot as a rule, in any dtype and memory layout."""
    shape = (int(rng.integers(16, 120)), int(rng.integers(16, 120)))
    centre = rng.uniform(0.3, 0.7, 2) * shape
    scene = vignetted(100, shape) + rng.choice([2, 60, 150]) * gaussian(
        centre, rng.uniform(1.5, 4), shape
    )
    if rng.random() < 0.2:
        scene += 80 * gaussian(rng.uniform(0, 1, 2) * shape, rng.uniform(1, 5), shape)
    scene[rng.integers(0, shape[0], 4), rng.integers(0, shape[1], 4)] = [0, 0, 250, 250]
    count = int(rng.integers(1, 5))
    stack = scene + 2 * rng.standard_normal((count, *shape))
    dtype = rng.choice([np.uint8, np.uint16, np.int32, np.float32, np.float64])
    stack = np.clip(stack, 0, 255).astype(dtype)
    match rng.integers(4):
        case 0:
            stack = np.asfortranarray(stack)
        case 1:
            stack = stack.repeat(2, axis=2)[:, :, ::2]
        case 2:
            stack = stack.astype(stack.dtype.newbyteorder(">"))
    stack.setflags(write=False)
    return stack[0] if count == 1 and rng.random() < 0.5 else stack


def outcome(call: Callable[[], Any]) -> Any:
    """What a call returns, or the kind of problem that it raises."""
    try:
        return call()
    except SpotError as error:
        return next(kind for kind, words in PROBLEMS.items() if words in str(error))
    except ValueError as error:
        return str(error)


@pytest.mark.long
def test_agrees_with_the_reference() -> None:
    rng = np.random.default_rng(1)
    seen = []
    for _ in range(200):
        scene = random_scene(rng)
        got = outcome(lambda scene=scene: equipix.measure_shift(scene, scene))
        wanted = outcome(lambda scene=scene: reference.measure_shift(scene, scene))
        if isinstance(wanted, str):
            assert got == wanted
            seen.append(wanted)
            continue
        bound = rounding(scene.shape)
        np.testing.assert_allclose(got.before.position, wanted.before.position, rtol=0, atol=bound)
        np.testing.assert_allclose(got.before.std, wanted.before.std, rtol=0, atol=bound)
        assert np.array_equal(got.shift, (0, 0))
        assert np.array_equal(got.std, np.hypot(got.before.std, got.after.std))
        seen.append("found")
    counts = {kind: seen.count(kind) for kind in seen}
    assert counts["found"] > 60, counts
    assert {"missing", "cut", "doubled"} <= set(counts)


# Against the truth

SCENES = {
    "gaussian, 16 frames": (lambda c: 2000 * gaussian(c, 3), 16),
    "gaussian, 2 frames": (lambda c: 2000 * gaussian(c, 2), 2),
    "faint, 16 frames": (lambda c: 60 * gaussian(c, 2.5), 16),
    "disc, 16 frames": (lambda c: 2700 * disc(c, 8, 1.2), 16),
    "small disc, 4 frames": (lambda c: 1000 * disc(c, 3.5, 0.8), 4),
    "large disc, 4 frames": (lambda c: 500 * disc(c, 12, 1.5), 4),
    "disc, single frame": (lambda c: 2700 * disc(c, 8, 1.2), 1),
}


@pytest.mark.study
@pytest.mark.parametrize("scene", SCENES)
def test_standard_error(
    scene: str, draws: Callable[[int], range], figure: Callable[..., None]
) -> None:
    """Errors of the shift are one standard error wide: 1.0 ± 0.1.

    The spread of 2 × 400 z-scores has a standard error of 1/√1600 = 0.025; the mean, of 0.035.
    """
    spot, count = SCENES[scene]
    rng = np.random.default_rng(len(scene))
    z = []
    for _ in draws(400):
        place = np.array(SHAPE) / 2 + rng.uniform(-4, 4, 2)
        move = rng.uniform(-7, 7, 2)
        before, after = (
            frames(spot(centre) + vignetted(60), count, rng) for centre in (place, place - move)
        )
        measured = equipix.measure_shift(before, after)
        z.append((measured.shift - move) / measured.std)
    error = 1 / np.sqrt(2 * len(z))
    limit = max(0.1, 3 * error / np.sqrt(2))
    figure("z of measured shifts, spread", np.std(z), f"1 ± {limit:.2f}")
    figure("z of measured shifts, mean", np.mean(z), f"0 ± {4 * error:.2f}")
    assert np.std(z) == pytest.approx(1, abs=limit)
    assert abs(np.mean(z)) < 4 * error


@pytest.mark.parametrize(
    ("spot", "bound"),
    [
        (lambda c: gaussian(c, 1.2), 2e-5),
        (lambda c: gaussian(c, 4), 2e-5),
        (lambda c: disc(c, 4, 1.0), 1e-4),
        (lambda c: disc(c, 11, 1.5), 1e-4),
    ],
)
def test_fractions_of_a_pixel_bring_no_bias(
    spot: Callable[[Any], NDArray[Any]], bound: float
) -> None:
    """The bounds are what the window leaves out, as documented: this disc's outline has wings."""
    for fraction in np.linspace(0, 1, 11):
        move = np.array([fraction, 0.37 * fraction])
        measured = equipix.measure_shift(1000 * spot((40, 48)), 1000 * spot((40, 48) - move))
        np.testing.assert_allclose(measured.shift, move, rtol=0, atol=bound)


@pytest.mark.study
def test_what_is_normal_on_a_sensor_is_no_obstacle(
    draws: Callable[[int], range], figure: Callable[..., None]
) -> None:
    """Spot of 0.3 % of the image, hot and dead pixels, vignetting, 5 % non-uniformity.

    White non-uniformity of rms s moves the centroid of a disc by s/(2√π) rms. Dead pixels right on
    the outline are not put there: they are the documented limit.
    """
    shape, spread = (240, 320), 0.05
    rng = np.random.default_rng(5)
    radius = np.sqrt(0.003 * np.prod(shape) / np.pi)
    pattern = spread / np.sqrt(3) / (2 * np.sqrt(np.pi)) * np.sqrt(2)
    rows, cols = np.indices(shape)
    z = []
    for _ in draws(60):
        sensor = 1 + rng.uniform(-spread, spread, shape)
        before = rng.uniform(60, 180, 2)
        centres = (before, before - rng.uniform(-20, 20, 2))
        hot, dead = rng.choice(sensor.size, (2, 80), replace=False)
        distance = [np.abs(np.hypot(rows - r, cols - c) - radius) for r, c in centres]
        dead = dead[np.min(distance, axis=0).ravel()[dead] > 4]
        row, col = before.astype(int)
        alone = np.hypot(rows - row, cols - col).ravel() > 6  # no clusters with the pairs below
        hot, dead = hot[alone[hot]], dead[alone[dead]]
        stacks = []
        for centre in centres:
            image = sensor * (2500 * disc(centre, radius, 1.0, shape) + vignetted(100, shape)) + 60
            image.ravel()[hot] = 5000
            image.ravel()[dead] = 60
            image[row, col : col + 2] = 5000  # pairs, within the spot before the move
            image[row - 4 : row - 2, col] = 60
            stacks.append(np.minimum(frames(image, 8, rng), 4095))
        measured = equipix.measure_shift(*stacks, saturation=4095)
        error = measured.shift - (centres[0] - centres[1])
        z.append(error / np.hypot(measured.std, pattern))
    assert np.abs(z).max() < 4.5
    # 120 values: the spread's standard error is 0.065; what mends a pixel is not its own value.
    limit = 4 / np.sqrt(4 * len(z))
    figure("z of measured shifts among defects, spread", np.std(z), f"1 ± {limit:.2f}")
    assert np.std(z) == pytest.approx(1, abs=limit)


def test_a_low_spot_on_a_bright_vignetted_background() -> None:
    """The spot is lower than the background's own variation."""
    rng = np.random.default_rng(6)
    before, after = (
        frames(vignetted(1000) + 150 * gaussian(c, 3), 4, rng) for c in ((50, 40), (46.5, 47.25))
    )
    measured = equipix.measure_shift(before, after)
    assert np.all(np.abs(measured.shift - (3.5, -7.25)) < 4 * measured.std)


def test_an_experiment_on_disk(data_dir: Path) -> None:
    """Moves as in the file of truth, but for noise and the sensor's non-uniformity."""
    truth = np.load(data_dir / "experiment-320x240-truth.npz")
    sensitivity = truth["sensitivity"]
    white = np.std(np.diff(sensitivity[np.all(sensitivity > 0.5, axis=1)], axis=1)) / np.sqrt(2)
    pattern = white / (2 * np.sqrt(np.pi)) * np.sqrt(2)
    folder = data_dir / "experiment-320x240" / "aperture"
    for k, move in enumerate(np.diff(truth["shifts"], axis=0), start=1):
        before, after = (
            tifffile.imread(folder / f"p{k}-{when}.tif") for when in ("before", "after")
        )
        measured = equipix.measure_shift(before, after, saturation=4095)
        assert np.all(np.abs(measured.shift - move) < 4 * np.hypot(measured.std, pattern))
        assert np.all(measured.std < 0.002)


# Laws


@pytest.fixture
def pair() -> tuple[NDArray[Any], NDArray[Any]]:
    """Two images of a lopsided spot on black, far from each other."""
    rng = np.random.default_rng(7)
    spot = np.zeros(SHAPE)
    spot[34:46, 40:50] = np.round(1000 * (1 + 0.2 * rng.random((12, 10))))
    other = spot.copy()
    other[40, 45] *= 1.5
    return np.roll(spot, (-3, 5), (0, 1)), other


def test_a_roll_by_whole_pixels_is_measured_exactly(pair: Any) -> None:
    before, _ = pair
    measured = equipix.measure_shift(before, np.roll(before, (4, -7), (0, 1)))
    assert np.array_equal(measured.shift, (-4, 7))


@pytest.mark.parametrize("scale", [0.25, 1e-3, 1e6])
def test_brightness_and_offset_do_not_matter(pair: Any, scale: float) -> None:
    wanted = equipix.measure_shift(*pair)
    for image in (scale * pair[0], scale * (pair[0] + 500)):
        got = equipix.measure_shift(image, scale * pair[1])
        np.testing.assert_allclose(got.shift, wanted.shift, rtol=0, atol=rounding(SHAPE))


def test_transposing_and_mirroring(pair: Any) -> None:
    wanted = equipix.measure_shift(*pair).shift
    for turned, expected in (
        ([image.T for image in pair], wanted[::-1]),
        ([image[::-1] for image in pair], wanted * (-1, 1)),
        ([image[:, ::-1] for image in pair], wanted * (1, -1)),
        (pair[::-1], -wanted),
    ):
        got = equipix.measure_shift(*turned).shift
        np.testing.assert_allclose(got, expected, rtol=0, atol=rounding(SHAPE))


def test_equal_frames_have_no_error(pair: Any) -> None:
    measured = equipix.measure_shift(np.stack([pair[0]] * 4), np.stack([pair[1]] * 3))
    assert np.array_equal(measured.std, (0, 0))


def test_a_steady_hot_pixel_counts_for_nothing(pair: Any) -> None:
    wanted = equipix.measure_shift(*pair)
    hot = [image.copy() for image in pair]
    hot[0][20, 20] = hot[1][60, 71] = 1e6
    got = equipix.measure_shift(*hot)
    np.testing.assert_allclose(got.shift, wanted.shift, rtol=0, atol=rounding(SHAPE))


# Bad input

GOOD = 1000 * gaussian((40, 48), 3)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros(SHAPE), "no spot: its brightest area stands 0.000 above"),
        (np.full(SHAPE, 7, np.uint8), "no spot"),
        (np.random.default_rng(8).normal(100, 5, SHAPE), "no spot"),
        (np.where(np.indices(SHAPE).sum(0) == 80, 1e4, 0), "no spot"),
        (1000 * gaussian((2, 48), 3), r"cut by the edge: .* at \(.*\) needs rows -\d+ to"),
        (1000 * gaussian((40, 92), 3), r"columns \d+ to 1\d\d of a \(80, 96\) sensor"),
        (1000 * gaussian((40, 48), 12), "cut by the edge"),
        (GOOD + 900 * gaussian((60, 20), 2.5), r"doubled .* \(40.0, 48.0\) and .* \(60.0, 20.0\)"),
    ],
    ids=["zero", "flat", "noise", "line", "edge", "corner", "too wide", "doubled"],
)
@pytest.mark.parametrize("argument", ["before", "after"])
def test_a_spot_that_cannot_be_measured(image: Any, words: str, argument: str) -> None:
    pair = (image, GOOD) if argument == "before" else (GOOD, image)
    with pytest.raises(SpotError, match=f"'{argument}' has .*{words}"):
        equipix.measure_shift(*pair)


def test_saturation() -> None:
    scene = np.round(np.minimum(5000 * gaussian((40, 48), 3), 4095))
    reaching = int(np.count_nonzero(scene == 4095))
    with pytest.raises(SpotError, match=rf"'after' .*saturated .* {reaching} .* reach 4095"):
        equipix.measure_shift(GOOD, scene, saturation=4095)
    with pytest.raises(SpotError, match=r"'before' .*saturated"):
        equipix.measure_shift((scene / 4095 * 255).astype(np.uint8), GOOD)
    equipix.measure_shift(GOOD, scene)  # floats have no level of their own
    equipix.measure_shift(GOOD, scene.astype(np.uint16))
    # One frame of many that reaches the level spoils the mean; a hot pixel does not.
    stack = np.stack([GOOD] * 5)
    stack[3, 40, 48] = 1000.5
    with pytest.raises(SpotError, match=r"1 of its pixels reach 1000.5, the first at \(40, 48\)"):
        equipix.measure_shift(GOOD, stack, saturation=1000.5)
    stack[:, 40, 60] = 4095
    stack[3, 40, 48] = 1000
    equipix.measure_shift(GOOD, stack, saturation=4095)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.where(GOOD > 500, np.nan, GOOD), "is NaN at frame 0, row 37, column"),
        (np.where(GOOD > 999, np.inf, GOOD), "is inf at frame 0, row 40, column 48"),
        (1e300 * GOOD, "numbers below 1e100"),
        (np.zeros((0, 80, 96)), r"\(0, 80, 96\)"),
        (np.zeros((3, 0, 96)), "shape"),
        (np.zeros(80), "2 or 3 dimensions"),
        (GOOD.astype(complex), "dtype complex128"),
        ("spot.tif", "dtype"),
        (GOOD[:, :-1], r"\(80, 96\)"),
    ],
)
def test_images_that_are_none(image: Any, words: str) -> None:
    with pytest.raises(InputError, match=f"'after' .*{words}|'before' .*{words}"):
        equipix.measure_shift(image, GOOD)
    with pytest.raises(InputError, match=f"'after' .*{words}"):
        equipix.measure_shift(GOOD, image)


def test_images_that_are_too_small() -> None:
    with pytest.raises(InputError, match=r"'before' .*\(1, 1, 1\), expected .* of 16 rows"):
        equipix.measure_shift(np.zeros((1, 1)), np.zeros((1, 1)))


@pytest.mark.parametrize("saturation", [np.nan, "full", True, [4095]])
def test_saturation_that_is_no_level(saturation: Any) -> None:
    with pytest.raises(InputError, match="'saturation' is"):
        equipix.measure_shift(GOOD, GOOD, saturation=saturation)


def test_cross_pattern() -> None:
    pattern = equipix.cross_pattern(11, -19)
    assert pattern.tolist() == [[0, 0], [0, 11], [0, -19], [11, 0], [-19, 0]]
    assert pattern.dtype == np.int64
    for arms in ((0, 5), (5, 0), (5, 5), (5.5, 7), (True, 7), ("5", 7)):
        with pytest.raises(InputError, match=r"'first'|'second'"):
            equipix.cross_pattern(*arms)

"""Hot pixels in the image of a hole are mended; a spot that light saturates is refused."""

from __future__ import annotations

import re

import numpy as np
import pytest
import tifffile

import equipix
from equipix import Experiment, errors, simulate
from reference import centroid as reference

SHAPE, LEVEL, CENTRE, RADIUS = (80, 96), 4095, (40.3, 47.6), 8.0
SIGMA = 1.2
"""Width of the outline: that of a sharp image of a hole."""


def disc(centre=CENTRE, height=3276.0):
    """A spot at 80 % of the range, as README advises, with a sharp outline."""
    rows, cols = np.indices(SHAPE)
    distance = np.hypot(rows - centre[0], cols - centre[1]) - RADIUS
    return 60 + height / (1 + np.exp(1.702 * distance / 0.8))


def gaussian(centre=CENTRE, height=3276.0):
    rows, cols = np.indices(SHAPE)
    r2 = (rows - centre[0]) ** 2 + (cols - centre[1]) ** 2
    return 60 + height * np.exp(-r2 / (2 * SIGMA**2))


def frames(mean, hot=(), count=8, seed=1):
    """Frames of 12 bits with photon noise; pixels at `hot` saturate."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((count, *SHAPE)) * np.sqrt(0.2 * mean + 2)
    stack = np.clip(np.rint(mean + noise), 0, LEVEL).astype(np.uint16)
    for place in hot:
        stack[:, place[0], place[1]] = LEVEL
    return stack


def places():
    """From the middle of the spot over its rim to the background, in three directions."""
    for angle in (0.0, 0.6, 2.2):
        for radius in np.arange(0, 13, 1.5):
            yield tuple(
                np.rint(CENTRE + radius * np.array([np.sin(angle), np.cos(angle)])).astype(int)
            )


@pytest.mark.parametrize("spot", [disc, gaussian])
def test_a_hot_pixel_does_not_move_the_spot(spot):
    clean = frames(spot())
    wanted = equipix.measure_shift(clean, clean, saturation=LEVEL)
    for place in places():
        hot = frames(spot(), [place])
        found = equipix.measure_shift(hot, clean, saturation=LEVEL)
        # The noise of the neighbours is that of the lost value: three standard errors.
        assert (np.abs(found.shift - wanted.shift) < 3 * found.std).all(), place


def test_the_reference_mends_the_same():
    rng = np.random.default_rng(4)
    for _ in range(20):
        centre = CENTRE + rng.uniform(-3, 3, 2)
        hot = rng.integers((25, 30), (55, 65), (3, 2))
        stack = frames(disc(centre), hot.tolist(), count=int(rng.integers(1, 4)))
        try:
            wanted = reference.locate(stack, saturation=LEVEL)
        except ValueError as error:
            assert str(error) == "saturated"
            with pytest.raises(errors.SpotError, match="saturated"):
                equipix.measure_shift(stack, stack, saturation=LEVEL)
            continue
        found = equipix.measure_shift(stack, stack, saturation=LEVEL)
        # Sums over 7680 pixels of places up to 96 times signal, over the flux: as in test_centroid.
        bound = 4 * np.finfo(float).eps * stack[0].size * 96
        np.testing.assert_allclose(found.before.position, wanted.position, rtol=0, atol=bound)


@pytest.mark.parametrize("spot", [disc, gaussian])
@pytest.mark.parametrize("over", [1.02, 1.2, 2.0])
def test_a_saturated_spot_is_refused(spot, over):
    # The middle of a pixel, so that the narrow spot saturates one pixel alone at first.
    bright = frames(spot((40.0, 48.0), over * (LEVEL - 60)))
    with pytest.raises(errors.SpotError, match=r"'before' .*saturated spot"):
        equipix.measure_shift(bright, bright, saturation=LEVEL)


def test_a_pixel_that_dark_frames_show_may_be_hot_in_some_frames_only():
    place = (40, 55)  # on the rim
    flickering = frames(disc(), [place])
    flickering[3, 40, 55] = 2000
    with pytest.raises(errors.SpotError, match="saturated"):
        equipix.measure_shift(flickering, flickering, saturation=LEVEL)
    known = np.zeros(SHAPE, bool)
    known[place] = True
    found = equipix.measure_shift(flickering, frames(disc()), saturation=LEVEL, hot=known)
    assert np.abs(found.shift).max() < 0.01


def test_two_hot_pixels_side_by_side_are_refused_on_the_rim():
    hot = frames(disc(), [(40, 55), (41, 55)])
    with pytest.raises(errors.SpotError, match="saturated"):
        equipix.measure_shift(hot, hot, saturation=LEVEL)


@pytest.mark.parametrize("hot", [np.zeros((3, 4), bool), np.zeros(SHAPE)])
def test_hot_pixels_that_are_no_map_are_refused(hot):
    with pytest.raises(errors.InputError, match="'hot' has"):
        equipix.measure_shift(disc(), disc(), hot=hot)


def test_an_experiment_with_a_hot_pixel_in_its_spots(tmp_path):
    """The pixel saturates in all files, the dark frames included."""
    rng = np.random.default_rng(3)
    shifts = [(0, 0), (0, 5), (0, 7), (5, 0), (7, 0)]
    virtual = simulate.experiment(
        simulate.paper_sensitivity((64, 80), rng=rng),
        simulate.gaussian_beam((64, 80), width=200),
        shifts,
        frames=4,
        aperture_frames=8,
        dead=0,
        hot=0,
        rng=rng,
    )
    path = virtual.write(tmp_path / "experiment")
    clean, _ = Experiment.load(path).measure_shifts()
    image = tifffile.imread(path.parent / "aperture/p1-before.tif").mean(axis=0)
    row, col = np.unravel_index(np.argmax(image), image.shape)
    for file in path.parent.glob("*/*.tif"):
        stack = tifffile.imread(file)
        stack[:, row, col + 3] = 4095
        tifffile.imwrite(file, stack, photometric="minisblack")
    experiment = Experiment.load(path)
    found, std = experiment.measure_shifts()
    assert np.abs(found - clean).max() < 0.03
    calibration = experiment.run(tolerance=1e-4)
    again = np.array(calibration.metadata["measured_shifts"])
    # Four standard errors of up to four moves.
    np.testing.assert_allclose(again, virtual.truth.shifts, atol=4 * std.max())
    assert calibration.flags[row, col + 3] & equipix.Flag.HOT
    text = re.sub("bit_depth = 12", "bit_depth = 10", path.read_text())
    path.write_text(text)
    with pytest.raises(errors.EquipixError, match="correct 'bit_depth'"):
        Experiment.load(path).run()

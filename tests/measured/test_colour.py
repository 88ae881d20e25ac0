"""Patterns of colour filters: how they are given, and which shifts suffice for them."""

import numpy as np
import pytest

from equipix import cross_pattern, errors, metrics, plan, simulate
from equipix.measured.colour import Colours, _may_repeat

BAYER = ("RGGB", "GRBG", "GBRG", "BGGR")
QUAD = "RRGG/RRGG/GGBB/GGBB"
X_TRANS = "GBGGRG/RGRBGB/GBGGRG/GRGGBG/BGBRGR/GRGGBG"


@pytest.mark.parametrize(
    "cfa",
    ["RGGB", "RG/GB", ["RG", "GB"], [["R", "G"], ["G", "B"]], np.array([["R", "G"], ["G", "B"]])],
)
def test_a_pattern_is_read_in_each_form(cfa):
    colours = Colours.of(cfa)
    assert colours.pattern == (("R", "G"), ("G", "B"))
    assert colours.labels == ("R", "G", "B")
    assert str(colours) == "RGGB"
    assert colours.numbers((3, 3)).tolist() == [[0, 1, 0], [1, 2, 1], [0, 1, 0]]
    assert Colours.of(colours) == colours


def test_a_pattern_writes_itself_as_it_is_read():
    for cfa in (*BAYER, QUAD, X_TRANS, "RGBW/", "R/G/G/B"):
        assert str(Colours.of(cfa)) == cfa
    for rows in (1, 2, 4, 8):
        for cols in (1, 2, 4):
            labels = np.resize(list("RGBWC"), (rows, cols))
            assert Colours.of(str(Colours.of(labels))) == Colours.of(labels)
    long = Colours.of([["R", "Gr"], ["Gb", "B"]])
    assert Colours.of(long.written) == long
    assert Colours.of(None) is None


@pytest.mark.parametrize(
    ("cfa", "words"),
    [
        ("RGB", "'RGB', expected four letters"),
        ("", "expected four letters"),
        ("RG/G", "expected four letters"),
        ("/", "expected four letters"),
        ([["R", "G"], ["G"]], "expected four letters"),
        ([["R", ""]], "expected four letters"),
        (1.5, "expected four letters"),
        ([], "expected four letters"),
        (np.full((9, 2), "R"), "period of 9×2 pixels, expected at most 8×8"),
    ],
)
def test_what_is_no_pattern_is_refused(cfa, words):
    with pytest.raises(errors.InputError, match=words):
        Colours.of(cfa)


@pytest.mark.parametrize("cfa", BAYER)
@pytest.mark.parametrize(
    ("arms", "together", "alone"), [((11, 19), 1, 36), ((5, 7), 1, 3), ((10, 18), 4, 4)]
)
def test_components_are_counted_with_one_beam_and_for_each_colour_alone(cfa, arms, together, alone):
    found = plan.identify((48, 52), cross_pattern(*arms), cfa=cfa)
    assert (found.components, sum(found.by_colour.values())) == (together, alone)
    # The two greens of even moves never meet.
    assert found.by_colour["G"] == {(11, 19): 4, (5, 7): 1, (10, 18): 2}[arms]
    assert f"each colour alone: {alone}" in repr(found)


@pytest.mark.study
@pytest.mark.parametrize(
    ("cfa", "exposures", "travel"),
    [("RGGB", 5, 20), ("BGGR", 7, 12), (QUAD, 6, 30), (X_TRANS, 6, 40)],
)
def test_suggested_shifts_suffice_for_each_colour_alone(cfa, exposures, travel):
    shape = (48, 52)
    for found in plan.suggest(shape, exposures, travel, cfa=cfa, drift=1e-5):
        assert np.ptp(found.shifts, axis=0).max() <= travel
        seen = plan.identify(shape, found.shifts, cfa=cfa)
        assert seen.components == 1
        assert set(seen.by_colour.values()) == {1}


def test_too_little_travel_for_each_colour_is_refused():
    with pytest.raises(errors.InputError, match="every pixel of each colour alone"):
        plan.suggest((48, 52), 4, 10, cfa="RGGB", drift=1e-5)


def test_a_filtered_sensitivity_has_the_responses_of_its_colours():
    truth = simulate.filtered(np.ones((4, 4)), QUAD, response={"R": 1, "G": 2, "B": 3})
    assert truth[[0, 0, 2, 3], [0, 2, 0, 3]].tolist() == [1, 2, 2, 3]
    with pytest.raises(errors.InputError, match=r"\['W'\], whose response is not known"):
        simulate.filtered(np.ones((4, 4)), "RGBW")


def test_a_relative_error_takes_the_mean_of_each_colour():
    truth = simulate.filtered(np.ones((6, 6)), "RGGB")
    measured = simulate.filtered(np.ones((6, 6)), "RGGB", response={"R": 3, "G": 2, "B": 1})
    assert np.abs(metrics.relative_error(measured, truth, cfa="RGGB")).max() < 1e-15
    assert np.abs(metrics.relative_error(measured, truth)).max() > 1


@pytest.mark.parametrize("period", [(1, 2), (2, 2), (3, 1), (4, 2), (5, 3), (6, 6), (7, 1), (8, 8)])
def test_a_pattern_that_may_stand_out_is_looked_for(period):
    rng = np.random.default_rng(period)
    size = (70, 90)
    repeats = [-(-length // step) for length, step in zip(size, period, strict=True)]
    for scatter in (0.001, 0.01, 0.02):
        once = 0.02 * rng.choice([-1, 1], period)
        once.flat[0], once.flat[-1] = 0.02, -0.02  # not all alike
        response = 1 + np.tile(once, repeats)[: size[0], : size[1]]
        image = response * rng.normal(1, scatter, size)
        image.flat[rng.choice(image.size, 200)] = np.resize([0, 10, np.nan], 200)
        # Medians vary as the pixels within the places do, or more.
        assert _may_repeat(image)
    flat = rng.normal(1, 0.02, size)
    assert not _may_repeat(flat)


@pytest.mark.parametrize("share", [0.0, 0.15, 0.3, 0.45])
@pytest.mark.parametrize("outlier", [0.7, 1.4, 10.0])
def test_outliers_of_one_side_hide_no_pattern(share, outlier):
    rng = np.random.default_rng(round(100 * share))
    for levels, scatter in (((0.95, 1.05), 0.005), ((0.95, 1.05), 0.01), ((1, 1, 1, 1.1), 0.01)):
        response = np.resize(levels, (128, 128))
        image = response * rng.normal(1, scatter, response.shape)
        image[rng.random(response.shape) < share] = outlier
        assert _may_repeat(image)

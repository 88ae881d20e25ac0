"""Arguments of another kind: every public function names them, and what it wanted."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import equipix
from equipix import bolometer, detector, errors, hardware, lens, metrics, nuc, scene, simulate
from equipix.lens import cos4

SHAPE = (24, 32)


def frames(value, rng, count=4):
    noise = np.random.default_rng(rng).standard_normal((count, *SHAPE))
    return np.rint(value + np.sqrt(value) * noise).astype(np.uint16)


LIGHT = (200.0, 900.0, 1800.0, 2700.0)
STACKS = [frames(each, k) for k, each in enumerate(LIGHT)]
LEVELS = [equipix.average(each) for each in STACKS]
RESPONSE = nuc.fit(LEVELS)
ROWS, COLS = np.mgrid[: SHAPE[0], : SHAPE[1]]
FLAT = 1000 * cos4((ROWS - 12.0) ** 2 + (COLS - 15.0) ** 2, 60.0)
GAIN = lens.fit(FLAT).correction()
SQUARED = dataclasses.replace(GAIN, coefficients=GAIN.coefficients**2)
ARRAY = simulate.BolometerArray.of(SHAPE, rng=1)
CELSIUS = [-20.0, 0.0, 20.0, 40.0, 60.0]
SHUTTER = np.stack([ARRAY.mean(each) for each in CELSIUS])

CALLS = {
    nuc.fit: {
        "levels": LEVELS,
        "order": 1,
        "by": "offset",
        "variance": None,
        "mask": None,
        "saturation": None,
        "workers": None,
    },
    nuc.find_defects: {"response": RESPONSE, "frames": STACKS[1], "limits": None},
    nuc.DefectLimits: {"response": 0.5, "noise": 2.0},
    RESPONSE.correct: {"frames": STACKS[1], "dark": "stored", "flagged": "nan", "out": None},
    RESPONSE.extrapolated: {"frames": STACKS[1], "dark": "stored"},
    RESPONSE.with_flags: {"flags": np.zeros(SHAPE, np.uint32)},
    metrics.correctability: {"frames": STACKS[1], "mask": None, "confidence": 0.95},
    metrics.validity_interval: {"times": [0.0, 1.0], "ratios": [0.1, 0.2]},
    metrics.emva_spatial: {"frames": STACKS[1], "dark": frames(50, 9), "gain_dn_per_e": None},
    metrics.emva_transfer: {"frames": STACKS, "dark": [frames(50, 9)], "light": list(LIGHT)},
    metrics.netd: {"cold": STACKS[0], "hot": STACKS[1], "delta_k": 5.0},
    metrics.roughness: {"frame": FLAT},
    metrics.three_d_noise: {"frames": STACKS[1]},
    lens.fit: {"frame": FLAT, "law": "cos4", "sensitivity": None, "mask": None},
    equipix.Corrector: {
        "correction": RESPONSE,
        "dtype": "uint16",
        "bit_depth": None,
        "flagged": None,
        "dark": "stored",
        "sensor": None,
        "workers": None,
    },
    equipix.Corrector(RESPONSE).apply: {"frames": STACKS[1], "out": None},
    equipix.combine: {"first": GAIN, "then": SQUARED},
    equipix.Polynomial: {"coefficients": GAIN.coefficients, "flags": GAIN.flags},
    bolometer.fit: {
        "shutter": SHUTTER,
        "substrate_c": CELSIUS,
        "bias_v": 2.0,
        "black_bodies": None,
        "order": 3,
        "bias_order": None,
        "regressor": "temperature",
        "mask": None,
    },
    metrics.non_uniformity: {"frames": SHUTTER, "span": 1e4},
    detector.composition_tolerance: {
        "material": detector.HgCdTe(start_um=3.0, cutoff_um=5.1),
        "references_k": (290.0, 310.0),
        "scene_k": 300.0,
        "charge_e": 2e7,
        "filled_k": None,
        "by": "offset",
    },
}
"""Public functions with arguments that are right."""

WRONG = {
    "a name": "r1.tif",
    "a path": Path("r1.tif"),
    "None": None,
    "a dict": {"noise": 2.0},
    "an empty list": [],
    "an object": object(),
    "an average": LEVELS[0],
    "a response": RESPONSE,
    "a small array": np.ones((3, 4)),
    "a negative number": -1,
    "not a number": np.nan,
    "a mixture": [LEVELS[0], RESPONSE],
    "names": ["a.tif", "b.tif"],
    "texts": np.array(["a"]),
    "a complex array": np.ones(SHAPE) * 1j,
    "limits": nuc.DefectLimits(),
}


@pytest.mark.filterwarnings("ignore::equipix.errors.EquipixWarning")
@pytest.mark.parametrize("function", CALLS, ids=lambda each: each.__qualname__)
@pytest.mark.parametrize("wrong", WRONG)
def test_is_refused_by_the_name_of_the_argument(function, wrong):
    function(**CALLS[function])
    for name in CALLS[function]:
        try:
            function(**CALLS[function] | {name: WRONG[wrong]})
        except errors.InputError as error:
            # Of two that must fit together the message names the second, of a pair the part.
            others = {"times": "'ratios'", "black_bodies": "'cold'"}
            assert f"'{name}" in str(error) or others.get(name, "''") in str(error)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: nuc.find_defects("r1.tif"), "'response' is 'r1.tif', .*equipix.load"),
        (lambda: nuc.find_defects(GAIN), "'response' is of type Polynomial, expected a Response"),
        (lambda: nuc.find_defects(RESPONSE, limits={}), "'limits' is of type dict, .*DefectLimits"),
        (lambda: metrics.emva_transfer(STACKS, "d.tif", LIGHT), "'dark' is 'd.tif', .* a list of"),
        (lambda: metrics.emva_transfer(LEVELS[0], [STACKS[0]], LIGHT), "'frames' is of type Frame"),
        (lambda: metrics.netd(*STACKS[:2], "5 K"), "'delta_k' is '5 K', expected a number"),
        (lambda: metrics.correctability(STACKS[0], confidence="high"), "'confidence' is 'high'"),
        (lambda: equipix.Polynomial([[1.0]], GAIN.flags), "'coefficients' is of type list"),
        (lambda: RESPONSE.with_flags(-1), r"'flags' has shape \(\), expected 2 dimensions"),
        (lambda: RESPONSE.with_flags(np.full(SHAPE, -1)), "'flags' holds -1, expected bits"),
        (lambda: RESPONSE.with_flags(np.full(SHAPE, 2**32)), "'flags' holds 4294967296, expected"),
        (lambda: RESPONSE.with_flags(np.full(SHAPE, 1.5)), "'flags' is float64 of shape"),
        (lambda: RESPONSE.with_flags(np.ones((3, 4), int)), r"'flags' is int64 of shape \(3, 4\)"),
    ],
)
def test_messages_say_what_is_wanted(call, message):
    with pytest.raises(errors.InputError, match=message):
        call()


FRAMES_OF = {
    "calibrate": ("frames", lambda given: equipix.calibrate(given, equipix.cross_pattern(3, 5))),
    "nuc.fit": ("levels", nuc.fit),
    "bolometer.fit": ("shutter", lambda given: bolometer.fit(given, CELSIUS, bias_v=2.0)),
    "find_defects": ("frames", lambda given: nuc.find_defects(RESPONSE, given)),
    "correct": ("frames", RESPONSE.correct),
    "Corrector": ("frames", equipix.Corrector(RESPONSE).apply),
    "lens.fit": ("frame", lens.fit),
    "scene": ("frame", scene.LocalMean(SHAPE, (0, 1)).update),
    "three_d_noise": ("frames", metrics.three_d_noise),
}


@pytest.mark.parametrize("call", FRAMES_OF)
@pytest.mark.parametrize(
    "given", [RESPONSE, lens.fit(FLAT), scene.LocalMean(SHAPE, (0, 1))], ids=type
)
def test_a_result_in_the_place_of_frames_is_named(call, given):
    name, take = FRAMES_OF[call]
    kind = f"of type {type(given).__name__}, expected an array of numbers$"
    with pytest.raises(errors.InputError, match=f"'{name}' is {kind}"):
        take(given)
    with pytest.raises(errors.InputError, match=f"'{name}' holds a value {kind}"):
        take([given] * 5)


@pytest.mark.parametrize("call", sorted(FRAMES_OF.keys() - {"nuc.fit"}))  # names equipix.average
def test_a_generator_in_the_place_of_frames_is_named(call):
    name, take = FRAMES_OF[call]
    with pytest.raises(errors.InputError, match=f"'{name}' is of type generator.* make a list of"):
        take(each for each in STACKS)


@pytest.mark.parametrize("call", sorted(FRAMES_OF.keys() - {"find_defects"}))  # takes it
def test_one_average_in_the_place_of_frames_is_named(call):
    name, take = FRAMES_OF[call]
    remedy = "give its 'mean'|one FrameStatistics, expected a list: one for each"
    with pytest.raises(errors.InputError, match=f"'{name}' is .*({remedy})"):
        take(LEVELS[0])


def test_only_a_response_is_inverted_exactly():
    assert RESPONSE.correct(STACKS[1], exact=True).shape == STACKS[1].shape
    for correction in (GAIN, hardware.Table.of(RESPONSE)):
        with pytest.raises(errors.InputError, match="'exact' is True, but only a Response has"):
            correction.correct(STACKS[1], exact=True)


def test_the_largest_number_of_flags_is_taken():
    flags = np.full(SHAPE, 2**32 - 1)
    assert (RESPONSE.with_flags(flags).flags == flags).all()

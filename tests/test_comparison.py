"""Several calibrations of one sensor against each other."""

from __future__ import annotations

import dataclasses
import hashlib
import html
import json
import re
from statistics import NormalDist

import numpy as np
import pytest

import equipix
from equipix import cli, errors, simulate
from equipix.comparison import Check, _freedom, _verdict
from equipix.metrics.correctability import fisher_quantile, student_quantile
from equipix.pictures import draw_comparison
from equipix.report import page as report_page
from equipix.report.figures import rows_of

SHAPE = (96, 128)
ARMS = ((5, 7), (7, 11), (11, 19))
NOISE = 1e-3


@pytest.fixture(scope="module")
def experiments():
    """Three calibrations of one sensor from independent exposures, and what noise predicts."""
    rng = np.random.default_rng(1)
    truth = simulate.cosine_sensitivity(SHAPE, rng=rng)
    truth /= truth.mean()
    beam = simulate.gaussian_beam(SHAPE, width=400)
    calibrations, predicted = [], []
    for arms in ARMS:
        shifts = equipix.cross_pattern(*arms)
        frames = simulate.exposures(truth, beam, shifts)
        frames += NOISE * rng.standard_normal(frames.shape)
        calibrations.append(equipix.calibrate(frames, shifts))
        draws = [
            simulate.noise_prediction(truth, beam, shifts, NOISE**2, draws=1, rng=seed)
            for seed in range(12)
        ]
        predicted.append(draws)
    return truth, calibrations, np.array(predicted)


def test_they_agree_as_their_uncertainties_predict(experiments):
    _, calibrations, draws = experiments
    mean, scatter = (f(draws**2, axis=1) for f in (np.mean, lambda x, axis: x.std(axis, ddof=1)))
    result = equipix.compare(calibrations, predicted=np.sqrt(mean))
    for k, (i, j) in enumerate(result.pairs):
        # A mean square scatters as the draws show it to; so does their mean, by √12 less.
        margin = 4 * np.hypot(scatter[i], scatter[j]) * np.sqrt(1 + 1 / 12)
        got = np.array([result.rms[k], result.block_rms[k]]) ** 2
        wanted = np.array([result.predicted_rms[k], result.predicted_block_rms[k]]) ** 2
        solver = sum(calibrations[each].error_estimate ** 2 for each in (i, j))
        np.testing.assert_allclose(wanted, mean[i] + mean[j] + solver, rtol=1e-12)
        # Twice the margin: the difference of two has their covariance's scatter besides.
        assert (np.abs(got - wanted) < 2 * margin).all()


def test_uncertainties_predict_without_being_told(experiments, tmp_path):
    """By the error maps, and by 16 blocks each, what the draws say: within their scatter."""
    _, calibrations, draws = experiments
    rng = np.random.default_rng(5)
    known = []
    for calibration, arms in zip(calibrations[:2], ARMS, strict=False):
        shifts = equipix.cross_pattern(*arms)
        frames = np.stack([calibration.predict(shift) for shift in shifts])
        frames += NOISE * rng.standard_normal(frames.shape)
        variance = np.full(5, NOISE**2)
        known.append(equipix.calibrate(frames, shifts, variance=variance, uncertainty=True))
    result = equipix.compare(known)
    scatter = draws[:2].std(axis=1, ddof=1) / np.sqrt(draws.shape[1])
    wanted = np.sqrt(np.sum(np.mean(draws[:2] ** 2, axis=1), axis=0))
    # The map is exact to 2 % and the mean of the draws to their standard error, times four.
    margin = 4 * np.hypot(0.02 * wanted[0], np.hypot(*scatter)[0])
    assert result.predicted_rms[0] == pytest.approx(wanted[0], abs=margin)
    # 16 of 48 blocks stand for all. The mean square of 16 variances that differ by up to eight
    # times, those at corners being the largest, is the whole's to within half of it.
    assert result.predicted_block_rms[0] ** 2 == pytest.approx(wanted[1] ** 2, rel=0.5)
    assert equipix.compare(calibrations).predicted_rms is None
    for number, each in enumerate(known):
        each.save(tmp_path / f"{number}.npz")
    files = [equipix.load(tmp_path / f"{number}.npz") for number in range(2)]
    read = equipix.compare(files)
    np.testing.assert_array_equal(read.predicted_rms, result.predicted_rms)
    assert np.isnan(read.predicted_block_rms).all()  # a file holds no measurements
    sensitivity = files[0].sensitivity.copy()
    sensitivity[30, 40] *= 1.1
    far = dataclasses.replace(files[0], sensitivity=sensitivity)
    picture = draw_comparison(equipix.compare([far, files[1]]), ["one", "other"])
    (axes,) = (each for each in picture.axes if each.get_title() == "Differences of pixels")
    bars = np.concatenate([bar.get_data().values for bar in axes.patches])
    assert axes.get_ylim()[0] < bars[bars > 0].min()  # that of one pixel far out


def test_the_agreement_map_is_the_scatter_of_one(experiments):
    _, calibrations, draws = experiments
    agreement = equipix.compare(calibrations).agreement
    # Its mean square is the mean variance of the three, over 12 288 pixels with 2 degrees each.
    expected = np.mean(draws[..., 0] ** 2)
    assert np.mean(agreement**2) == pytest.approx(expected, rel=4 * np.sqrt(2 / (2 * 12_288)) * 2)


def test_a_tilt_stands_out_at_large_scales(experiments):
    """Lamp drift tilts one of them by 5e-4 rms: the blocks show it, the pixels hardly."""
    _, calibrations, draws = experiments
    first, second, _ = calibrations
    tilt = 5e-4 * np.sqrt(12) * np.linspace(-0.5, 0.5, SHAPE[1])
    tilted = type(second)(**(vars(second) | {"sensitivity": second.sensitivity * (1 + tilt)}))
    predicted = np.sqrt(np.mean(draws[:2] ** 2, axis=1))
    result = equipix.compare([first, tilted], predicted=predicted)
    assert result.block_rms[0] > 2 * result.predicted_block_rms[0]
    assert result.rms[0] < 1.5 * result.predicted_rms[0]


def test_an_undetermined_tilt_is_no_difference(experiments, tmp_path, capsys):
    """The same frames with known fluxes and with free ones, whose slope is set to 0."""
    truth, _, _ = experiments
    shifts = equipix.cross_pattern(7, 11)
    beam = simulate.gaussian_beam(SHAPE, width=400)
    frames = simulate.exposures(truth, beam, shifts)
    frames += NOISE * np.random.default_rng(2).standard_normal(frames.shape)
    known = equipix.calibrate(frames, shifts)
    with pytest.warns(errors.IdentifiabilityWarning, match="leave a tilt"):
        free = equipix.calibrate(frames, shifts, flux="fit")
    result = equipix.compare([known, free, known])
    assert result.open_tilt.tolist() == [True, False, True]
    # Fitting two fluxes more of 61 440 values changes M by much less than the noise of its means.
    assert result.block_rms[0] < NOISE / 16
    assert abs(result.difference(0)).max() == pytest.approx(result.largest[0])
    assert np.sqrt(np.mean(result.agreement**2)) < NOISE / 16
    # A calibration whose tilt is determined is compared with it.
    tilted = type(known)(
        **(
            vars(known)
            | {"sensitivity": known.sensitivity * np.exp(np.linspace(0, 0.02, SHAPE[1]))}
        )
    )
    assert equipix.compare([known, tilted]).block_rms[0] > 0.005
    assert equipix.compare([tilted, free]).block_rms[0] < NOISE / 16
    files = [str(tmp_path / name) for name in ("known.npz", "free.npz")]
    for file, calibration in zip(files, (known, free), strict=True):
        calibration.save(file)
    with pytest.raises(SystemExit):
        cli.main(["compare", *files])
    assert (
        "left out: free fluxes leave it undetermined in one or more of" in capsys.readouterr().out
    )


def test_the_gauge_and_bad_pixels_play_no_part(experiments):
    _, calibrations, _ = experiments
    first, second, _ = calibrations
    sensitivity = 3 * second.sensitivity
    flags = second.flags.copy()
    sensitivity[3, 4], flags[3, 4] = 100, equipix.Flag.HOT | equipix.Flag.DO_NOT_USE
    sensitivity[5, 6] = np.nan
    changed = type(second)(**(vars(second) | {"sensitivity": sensitivity, "flags": flags}))
    plain, other = equipix.compare([first, second]), equipix.compare([first, changed])
    assert np.argwhere(np.isnan(other.agreement)).tolist() == [[3, 4], [5, 6]]
    valid = np.isfinite(other.agreement)
    # The means, over 2 of 12 288 pixels fewer, shift all differences alike.
    np.testing.assert_allclose(
        other.difference(0)[valid], plain.difference(0)[valid], rtol=0, atol=4 * 0.1 / 12_288
    )


def test_bad_arguments_are_named(experiments):
    _, calibrations, _ = experiments
    with pytest.raises(errors.InputError, match="1 entries, expected two"):
        equipix.compare(calibrations[:1])
    with pytest.raises(errors.InputError, match="'predicted' has 2 entries"):
        equipix.compare(calibrations, predicted=np.ones((2, 2)))
    with pytest.raises(errors.InputError, match=r"'predicted' has shape \(3, 1\)"):
        equipix.compare(calibrations, predicted=np.ones((3, 1)))
    for wrong in (0, -1e-3, np.nan, np.inf):
        with pytest.raises(errors.InputError, match="'predicted' is .* finite numbers above 0"):
            equipix.compare(calibrations, predicted=[[1e-3, 1e-4], [1e-3, wrong], [1e-3, 1e-4]])
    shape, shifts = (40, 50), equipix.cross_pattern(5, 7)
    frames = simulate.exposures(np.ones(shape), simulate.gaussian_beam(shape), shifts)
    small = equipix.calibrate(frames, shifts)
    with pytest.raises(errors.InputError, match="expected one shape"):
        equipix.compare([small, calibrations[0]])
    no_good = type(small)(**(vars(small) | {"flags": small.flags | 1}))
    with pytest.raises(errors.InputError, match="no pixel that is good"):
        equipix.compare([small, no_good])


def test_the_command_line_refuses_one_calibration_given_twice(experiments, tmp_path, capsys):
    _, calibrations, _ = experiments
    path = str(tmp_path / "cal.tif")
    calibrations[0].save(path)
    with pytest.raises(SystemExit) as done:
        cli.main(["compare", path, path])
    assert done.value.code == 1
    assert "hold one calibration" in capsys.readouterr().err


def test_the_command_line_compares_files(experiments, tmp_path, capsys):
    _, calibrations, _ = experiments
    files = []
    for number, calibration in enumerate(calibrations):
        files.append(str(tmp_path / f"cal{number}.tif"))
        calibration.save(files[-1])
    picture = tmp_path / "agreement.png"
    with pytest.raises(SystemExit) as done:
        cli.main(["compare", *files, "-o", str(picture), "--json"])
    assert not done.value.code
    found = json.loads(capsys.readouterr().out)
    result = equipix.compare(calibrations)
    assert found["pixels"] == SHAPE[0] * SHAPE[1]
    assert [pair["files"] for pair in found["pairs"]] == [files[:2], files[::2], files[1:]]
    assert [pair["rms"] for pair in found["pairs"]] == result.rms.tolist()
    assert [pair["block_rms"] for pair in found["pairs"]] == result.block_rms.tolist()
    assert picture.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(SystemExit) as done:
        cli.main(["compare", *files])
    assert "16×16" in capsys.readouterr().out


SMALL = (48, 64)
BEAM = simulate.gaussian_beam(SMALL, width=100)
TRUTH = simulate.cosine_sensitivity(SMALL, rng=1)


def nine(first, second):
    """Two crosses with one middle."""
    return np.vstack([equipix.cross_pattern(*first), equipix.cross_pattern(*second)[1:]])


PATTERNS = (
    *(equipix.cross_pattern(*arms) for arms in ((5, 7), (7, 11), (3, 8), (6, 13))),
    *(nine((5, 7), (11, 13)), nine((4, 9), (10, 14))),
)


def measured(seed, pattern, *, known=True, moved=0.0, lamp=0.0, noise=NOISE):
    """A calibration with error bars; one shift and the lamp may be other than is told."""
    shifts, rng = PATTERNS[pattern], np.random.default_rng([3, seed])
    true = shifts.astype(float)
    true[3, 1] += moved
    frames = simulate.exposures(TRUTH, BEAM, true) * (1 + lamp * shifts[:, 1, None, None])
    frames += noise * rng.standard_normal(frames.shape)
    variance = np.full(len(shifts), NOISE**2) if known else None
    return equipix.calibrate(frames, shifts, variance=variance, uncertainty=True)


@pytest.mark.study
def test_noise_alone_rarely_makes_a_difference(draws, figure):
    seeds, false, times = draws(200), 0, []
    for seed in seeds:
        first, second = seed % 6, (seed + 1 + seed // 6 % 5) % 6
        pair = [measured(2 * seed, first, known=seed % 2), measured(2 * seed + 1, second)]
        result = equipix.compare(pair)
        times.append([each.times for each in result.checks[0][:3]])
        false += result.verdicts[0] != "agree within their noise"
    figure(f"verdicts against {len(seeds)} right pairs", false, "at most 1 %")
    assert false <= 0.01 * len(seeds)
    # The rms over 3072 pixels scatters by 1.3 %, and its map is exact to 2 %; tilts are normal,
    # but where a drift is added to their error bars.
    assert np.mean([each[0] for each in times]) == pytest.approx(1, abs=0.01)
    assert np.sqrt(np.mean(np.square([each[1:] for each in times]))) < 1.2


@pytest.mark.study
@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"moved": 0.5}, "pixels without tilt"),
        ({"lamp": 3e-5}, "tilt along columns"),
        ({"noise": 1.3 * NOISE}, "pixels without tilt"),
    ],
    ids=["a shift by half a pixel", "the lamp by 3e-5 a pixel of the stage", "noise of 1.3 times"],
)
def test_errors_of_one_experiment_are_seen(draws, figure, wrong, what):
    """With nine exposures; a tilt of 3e-5 a pixel is 1.9e-3 from edge to edge."""
    seeds, seen = draws(20), 0
    for seed in seeds:
        pair = [measured(900 + seed, 4), measured(950 + seed, 5, **wrong)]
        (verdict,) = equipix.compare(pair).verdicts
        seen += verdict.startswith("differ by more than their noise") and what in verdict
    figure(f"differences by {what} seen in {len(seeds)}", seen, "all")
    assert seen == len(seeds)


def test_the_verdict_has_a_rule(alike, tmp_path):
    """Limits of the rms follow from the degrees of freedom, those of tilts from their law."""
    pair = alike
    pixels, *tilts, blocks = equipix.compare(pair).checks[0]
    assert [each.what for each in tilts] == ["tilt along rows", "tilt along columns"]
    # Four checks share 1 %: normal for both sides of a tilt; the map is exact to 2 %.
    for each in tilts:
        assert each.high == pytest.approx(NormalDist().inv_cdf(1 - 0.0025 / 2), rel=1e-6)
    sigmas = NormalDist().inv_cdf(1 - 0.0025 / 2)
    exactness = pair[0].metadata["uncertainty"]["relative_standard_error"]
    least = sigmas * np.hypot(exactness, 1 / np.sqrt(2 * TRUTH.size))
    assert least < pixels.high - 1 < 1.5 * least
    assert blocks.what == "16×16 means, rms"
    for number, each in enumerate(pair):
        each.save(tmp_path / f"{number}.npz")
    read = equipix.compare([equipix.load(tmp_path / f"{k}.npz") for k in range(2)])
    assert [each.what for each in read.checks[0]] == [pixels.what, *(each.what for each in tilts)]
    same = equipix.compare([pair[0], pair[0]])
    assert same.verdicts[0].startswith("agree better than their noise: pixels without tilt")
    assert len(repr(same)) <= 120


def test_a_check_passes_within_its_limits_alone():
    ratios = {0.9: False, 0.95: True, 1.05: True, 1.1: False, np.nan: False, np.inf: False}
    for ratio, passed in ratios.items():
        assert Check("it", ratio * 2e-3, 2e-3, 0.95, 1.05).passed is passed
    agreement = [_verdict((Check("it", ratio, 1, 0.95, 1.05),)) for ratio in ratios]
    assert [each.startswith("agree within") for each in agreement] == [*ratios.values()]


@pytest.fixture(scope="module")
def alike():
    """A pair with error bars that agrees."""
    return [measured(1, 4), measured(2, 5)]


def test_errors_of_the_solver_are_no_difference(alike):
    """Of each the estimate counts once in what is predicted, in pixels, tilts and blocks."""
    first, second = alike
    plain = equipix.compare(alike).checks[0]
    coarse = dataclasses.replace(first, error_estimate=3e-3)
    found = equipix.compare([coarse, second]).checks[0]
    assert len(found) == 4
    for each, was in zip(found, plain, strict=True):
        assert each.predicted == pytest.approx(np.hypot(was.predicted, 3e-3), rel=1e-4)
        assert each.high == pytest.approx(was.high, rel=1e-9)
        # A solver that left nothing of it is not too good.
        assert each.low * each.predicted == pytest.approx(was.low * was.predicted, rel=1e-9)


def test_a_drift_in_error_bars_widens_the_tilt_alone(alike):
    """Student's t with its degrees of freedom; block means, which it tilts, are not judged."""
    first, second = alike
    tilt = np.array([3e-3, 4e-3])
    drift = dataclasses.replace(
        first.drift,
        size=1e-3,
        degrees_of_freedom=2,
        slope_covariance=np.diag((tilt / SMALL) ** 2),
        tilt_std=tilt,
    )
    was = dataclasses.replace(first.drift, size=0.0, tilt_std=np.zeros(2))
    hidden = first.sensitivity * np.sqrt(drift.variance_map(first.sensitivity))
    pair = [
        dataclasses.replace(
            first,
            drift=drift,
            sensitivity_std=np.hypot(first.sensitivity_std, hidden),
            tilt_std=np.hypot(first.tilt_std, tilt),
        ),
        dataclasses.replace(second, drift=None),
    ]
    plain, *_ = equipix.compare([dataclasses.replace(first, drift=was), pair[1]]).checks[0]
    pixels, *tilts = equipix.compare(pair).checks[0]
    assert [each.what for each in tilts] == ["tilt along rows", "tilt along columns"]
    for axis, each in enumerate(tilts):
        assert each.high == pytest.approx(student_quantile(1 - 0.01 / 3 / 2, 2), rel=1e-9)
        std = np.sqrt(sum(c.tilt_std[axis] ** 2 + c.error_estimate**2 for c in pair))
        assert each.predicted == pytest.approx(std, rel=1e-9)
    # The pixels' part is without it, to the rounding of float32 error bars.
    assert pixels.predicted == pytest.approx(plain.predicted, rel=1e-3)


def test_error_bars_that_are_inexact_or_uneven_widen_the_limits(alike):
    exactness = alike[0].metadata["uncertainty"]["relative_standard_error"]
    plain = equipix.compare(alike).checks[0][0]
    inexact = [
        dataclasses.replace(
            each, metadata={**each.metadata, "uncertainty": {"relative_standard_error": 0.1}}
        )
        for each in alike
    ]
    sigmas = NormalDist().inv_cdf(1 - 0.0025 / 2)
    high = equipix.compare(inexact).checks[0][0].high
    assert high == pytest.approx(1 + sigmas * 0.1, rel=0.1)  # of second order: (3 · 0.1)²
    uneven = []
    for each in alike:
        std = each.sensitivity_std.copy()
        std[:, : SMALL[1] // 8] *= 8
        uneven.append(dataclasses.replace(each, sensitivity_std=std))
    found = equipix.compare(uneven).checks[0][0]
    # An eighth of the pixels has 64 times the variance of the others: few count.
    shares = np.array([64, *[1] * 7])
    evenness = shares.mean() ** 2 / np.mean(shares**2)
    scatters = [np.hypot(exactness, (2 * TRUTH.size * e) ** -0.5) for e in (1, evenness)]
    ratio = (found.high - 1) / (plain.high - 1)
    assert ratio == pytest.approx(scatters[1] / scatters[0], rel=0.15)


@pytest.mark.parametrize("used", [SMALL[1], 20])
def test_the_tilt_in_error_bars_is_no_part_of_the_pixels(alike, used):
    """Also where the pixels that are known span a part of the sensor alone."""
    flags = np.zeros(SMALL, np.uint32)
    flags[:, used:] = equipix.Flag.DO_NOT_USE
    middle = np.array([SMALL[0] - 1, used - 1]) / 2  # of the known pixels
    extent = (np.indices(SMALL) - middle[:, None, None]) / np.reshape(SMALL, (2, 1, 1))
    tilt = np.array([3e-3, 4e-3])
    was, now = [], []
    for each in alike:
        hidden = each.sensitivity * np.sqrt(np.tensordot(tilt**2, extent**2, 1))
        known = dataclasses.replace(each, flags=each.flags | flags, drift=None)
        was.append(dataclasses.replace(known, tilt_std=1e-9 * tilt))
        std = np.hypot(each.sensitivity_std, hidden).astype(np.float32)
        now.append(dataclasses.replace(known, sensitivity_std=std, tilt_std=tilt))
    before, after = (equipix.compare(pair).checks[0][0].predicted for pair in (was, now))
    # Rounding of error bars in float32, whose squares are some ten times as large.
    assert after == pytest.approx(before, rel=1e-5)


def with_exactness(calibration, exactness, share=1.0):
    """A calibration whose error bars are exact to this, and scaled."""
    return dataclasses.replace(
        calibration,
        sensitivity_std=(calibration.sensitivity_std * share).astype(np.float32),
        metadata={
            **calibration.metadata,
            "uncertainty": {"relative_standard_error": exactness},
        },
    )


@pytest.mark.parametrize("wide", [0, 1])
def test_the_exactness_of_wider_error_bars_counts_for_more(alike, wide):
    """By their shares of the variance of the difference; nine of ten are of bars thrice as wide."""
    pair = [
        with_exactness(each, 0.2 if k == wide else 1e-3, 3.0 if k == wide else 1.0)
        for k, each in enumerate(alike)
    ]
    shares = np.square([np.nanmean(each.sensitivity_std / each.sensitivity) for each in pair])
    common = float(shares @ [0.2 if k == wide else 1e-3 for k in range(2)] / shares.sum())
    freedom = 0.5 / common**2
    # The degrees of freedom of the map, of thousands of pixels, add 1/100 to those of the bars.
    high = fisher_quantile(1 - 0.0025 / 2, 1e9, freedom) ** 0.5
    assert equipix.compare(pair).checks[0][0].high == pytest.approx(high, rel=0.02)


def test_two_drifts_have_the_quantile_of_the_fewer_degrees_of_freedom(alike):
    pair = [
        dataclasses.replace(
            each, drift=dataclasses.replace(each.drift, size=1e-9, degrees_of_freedom=freedom)
        )
        for each, freedom in zip(alike, (6, 2), strict=True)
    ]
    for order in (pair, pair[::-1]):
        for check in equipix.compare(order).checks[0][1:3]:
            assert check.high == pytest.approx(student_quantile(1 - 0.01 / 3 / 2, 2), rel=1e-9)


def test_block_means_are_exact_to_their_number_unless_they_are_predicted(alike):
    """Those of 16 blocks have 16 degrees of freedom, those that a caller gives count as exact."""
    high, exact = (
        equipix.compare(alike, predicted=given).checks[0][-1].high
        for given in (None, [(1e-3, 1e-4)] * 2)
    )
    blocks = np.ones(np.array(SMALL) // 16, bool)
    freedom = _freedom(alike, np.ones(2), blocks, without_tilt=False, side=16)
    for found, beside in ((high, 16), (exact, 1e9)):
        wanted = fisher_quantile(1 - 0.0025, freedom, beside) ** 0.5
        # Pairs have nearly equal variances, of which the freedom of both depends weakly.
        assert found == pytest.approx(wanted, rel=0.05)
    assert high > 1.2 * exact


def test_few_pixels_have_few_degrees_of_freedom():
    """Noise in parts of a sensor crossed limits that were those of the whole in five of twelve."""
    pair, whole = [measured(1, 0), measured(2, 1)], np.zeros(SMALL, bool)
    for row, col in np.ndindex(3, 4):
        known = whole.copy()
        known[16 * row : 16 * row + 16, 16 * col : 16 * col + 16] = True
        flags = np.where(known, 0, equipix.Flag.DO_NOT_USE).astype(np.uint32)
        parts = [
            dataclasses.replace(each, flags=each.flags | flags, weighted=None) for each in pair
        ]
        # A check fails in 0.33 % of the pairs, one of twelve in 4 %; these are not among them.
        assert equipix.compare(parts).checks[0][0].passed
    # The part is like a sensor of its size, and half of its pixels have half of its waves.
    alone, odd = np.ones((16, 16), bool), np.indices(SMALL).sum(axis=0) % 2 == 1
    freedom, half, own = (
        _freedom(pair, np.ones(2), each, without_tilt=True) for each in (known, known & odd, alone)
    )
    assert freedom == own
    assert half == pytest.approx(own / 2, rel=1e-12)


@pytest.mark.parametrize("predicted", [None, [(1e-3, 1e-4)] * 2])
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (1, 64), (2, 2), (16, 16)])
def test_very_few_pixels_do_not_contradict(alike, shape, predicted):
    known = np.zeros(SMALL, bool)
    known[: shape[0], : shape[1]] = True
    few = [
        dataclasses.replace(
            each,
            sensitivity=np.where(known, each.sensitivity, np.nan),
            drift=None,
            tilt_std=None,
            weighted=None,
        )
        for each in alike
    ]
    assert "differ by more" not in equipix.compare(few, predicted=predicted).verdicts[0]


def test_pixels_that_one_lacks_tilt_the_others_more(alike):
    """Tilts of a whole sensor and a part, or of two parts, were 1.2 to 1.5 times as predicted."""
    first, second = (dataclasses.replace(each, drift=None, weighted=None) for each in alike)
    known = np.where(np.arange(SMALL[1]) < 20, second.sensitivity, np.nan)
    part = dataclasses.replace(second, sensitivity=known)
    assert not first.flags.any()
    # Squared distances of the columns 0 to 63 and 0 to 19 from their middle; 64 and 20 in a row.
    levers = np.array([64 / 20, 64 * np.var(np.arange(64)) / (20 * np.var(np.arange(20)))])
    wanted = np.sqrt(first.tilt_std**2 * levers + part.tilt_std**2)
    solver = first.error_estimate**2 + part.error_estimate**2
    for pair in ([first, part], [part, first]):
        found = [check.predicted for check in equipix.compare(pair).checks[0][1:3]]
        np.testing.assert_allclose(found, np.sqrt(wanted**2 + solver), rtol=1e-12)


@pytest.mark.parametrize("number", [0, 1])
def test_a_pixel_far_out_in_one_of_the_two_is_no_tilt(alike, number):
    """M at a corner three times as large counts for no slope of ln M."""
    sensitivity, changed = alike[number].sensitivity.copy(), list(alike)
    sensitivity[0, 0] *= 3
    changed[number] = dataclasses.replace(alike[number], sensitivity=sensitivity)
    for was, now in zip(
        equipix.compare(alike).checks[0][1:3],
        equipix.compare(changed).checks[0][1:3],
        strict=True,
    ):
        # A corner's weight is 6/3072, and its noise 8e-4.
        assert now.found == pytest.approx(was.found, abs=4 * 8e-4 * 6 / 3072)


NOT_JUDGED = (
    ({"sensitivity_std": None}, "the first has no standard deviations (calibrate with"),
    ({"sensitivity_std": np.zeros(SMALL)}, "all standard deviations of the first are 0"),
    ({"error_estimate": np.inf}, "the solver of the first failed"),
    ({"error_estimate": np.nan}, "the solver of the first failed"),
)
TOLD = [(5.5e-4, 5.3e-5)] * 3


@pytest.mark.parametrize(("change", "words"), NOT_JUDGED)
def test_a_pair_that_is_not_judged_says_why(alike, change, words):
    """The pair of the two others is judged."""
    first, second = alike
    wrong = dataclasses.replace(first, **change)
    result = equipix.compare([wrong, first, second])
    assert result.checks[:2] == ((), ())
    assert all(verdict.startswith(f"not judged: {words}") for verdict in result.verdicts[:2])
    assert np.isfinite(result.predicted_rms).tolist() == [False, False, True]
    assert result.verdicts[2] == equipix.compare(alike).verdicts[0]
    swapped = equipix.compare([first, wrong])
    assert swapped.verdicts[0].startswith(f"not judged: {words.replace('first', 'second')}")
    assert (swapped.predicted_rms, swapped.predicted_block_rms) == (None, None)


def test_what_is_told_judges_no_pair_whose_solver_failed(alike):
    first, second = alike
    for change, words in NOT_JUDGED:
        result = equipix.compare(
            [dataclasses.replace(first, **change), first, second], predicted=TOLD
        )
        failed = "solver" in words
        assert [bool(checks) for checks in result.checks] == [not failed, not failed, True]
        assert np.isnan(result.predicted_rms).tolist() == [failed, failed, False]
        assert result.verdicts[0].startswith("not judged: the solver of the first") is failed


def test_predictions_are_those_of_the_verdict(alike, tmp_path, run):
    """With the errors of both solvers, in quadrature."""
    coarse = dataclasses.replace(alike[0], error_estimate=3e-3)
    result = equipix.compare([coarse, alike[1]], predicted=TOLD[:2])
    pixels, *_, blocks = result.checks[0]
    solver = 3e-3**2 + alike[1].error_estimate ** 2
    for check, rms, told in (
        (pixels, result.predicted_rms, TOLD[0][0]),
        (blocks, result.predicted_block_rms, TOLD[0][1]),
    ):
        assert check.predicted == pytest.approx(np.sqrt(2 * told**2 + solver), rel=1e-12)
        assert rms[0] == pytest.approx(check.predicted, rel=1e-12)
    rows = {each[0]: each for each in rows_of(equipix.compare([coarse, alike[1]]), 0)}
    assert float(rows["pixels, rms"][2]) > 3e-3
    for number, each in enumerate((coarse, alike[1])):
        each.save(tmp_path / f"{number}.npz")
    printed = run("compare", *(tmp_path / f"{k}.npz" for k in range(2)), "--json")[1]
    assert json.loads(printed)["pairs"][0]["predicted_rms"] > 3e-3


@pytest.mark.parametrize(
    ("freedom", "quantile"), [(0, 2.5758), (1, 63.657), (2, 9.9248), (6, 3.7074), (30, 2.7500)]
)
def test_quantiles_are_those_of_tables(freedom, quantile):
    """Of Student's t at 0.995; of the normal distribution for a freedom of 0."""
    assert student_quantile(0.995, freedom) == pytest.approx(quantile, rel=2e-5)


def check_pairs(files, limits, run):
    """What --check says of a pair that agrees, of one that differs, and of one without bars."""
    assert run("compare", *files[:2], "--check")[0] == 0
    status, _, told = run("compare", *files[:3], "--check")
    assert status == 1
    assert re.search(
        r"tilted\.tif: tilt along columns, over predicted is \d+.*, expected 0 to", told
    )
    assert f"{files[0]} − {files[1]}" not in told
    status, _, told = run("compare", files[0], files[3], "--check")
    assert status == 1
    assert "nothing is judged of" in told
    assert ": the second has no standard deviations (calibrate with --uncertainty), or give" in told
    limits.write_text("[comparison]\nrms = 1e-6\nlargest = 1\n")
    asked = ("compare", *files[:2], "--limits", limits, "--check")
    status, printed, told = run(*asked)
    assert status == 1
    assert re.search("rms is .*, expected at most 1e-06", told)
    assert re.search("PASS .*other.tif: largest ", printed)
    (pair,) = json.loads(run(*asked, "--json")[1])["pairs"]
    assert [each["passed"] for each in pair["checks"]] == [True] * 3
    assert [each["verdict"] for each in pair["limits"]][-2:] == ["FAIL", "PASS"]


@pytest.mark.long
def test_a_page_and_words_have_the_verdict(tmp_path, run, monkeypatch):
    files = [tmp_path / f"{name}.tif" for name in ("one", "other", "tilted", "plain")]
    calibrations = [measured(1, 4), measured(2, 5), measured(3, 5, lamp=3e-5)]
    calibrations.append(dataclasses.replace(calibrations[0], sensitivity_std=None, tilt_std=None))
    calibrations[3] = dataclasses.replace(
        calibrations[3], sensitivity=calibrations[1].sensitivity[::-1]
    )
    for file, each in zip(files, calibrations, strict=True):
        each.save(file)
    page, judged = tmp_path / "page.html", []

    def counted(*arguments, judge=report_page.checked):
        judged.append(arguments)
        return judge(*arguments)

    monkeypatch.setattr(report_page, "checked", counted)
    status, out, err = run("compare", *files[:3], "-o", page)
    assert (status, err, len(judged)) == (0, "", 3)
    assert f"{files[0]} − {files[1]}: agree within their noise\n" in out
    assert re.search(r"other\.tif − .*tilted\.tif: differ by more .*: tilt along columns \d", out)
    assert re.search(
        r"pixels without tilt, rms +\d\S+e-04 +\d\S+e-04 +\d\S* +0\.9\d+ to 1\.0\d+", out
    )
    text = html.unescape(page.read_text(encoding="utf-8"))
    for words in (
        *("Agree within their noise.", 'aria-label="Difference: single pixels', "PASS", "FAIL"),
        *("Difference, 16×16 means", "Scatter of the sensitivities", "Histogram of difference"),
        *("Spectrum of difference", "largest of a pixel"),
    ):
        assert words in text
    found = json.loads(run("compare", files[0], files[3], "--json")[1])
    assert found["pairs"][0]["verdict"].startswith("not judged: the second has no standard")
    assert found["pairs"][0]["checks"] == []
    assert run("compare", *files[:2], "-o", tmp_path / "page.htm")[0] == 1
    # The page has the content of its files, and what failed.
    assert hashlib.sha256(files[2].read_bytes()).hexdigest() in text
    assert text.count("None: nothing contradicts the result.") == 1
    check_pairs(files, tmp_path / "limits.toml", run)
    result = equipix.compare(calibrations[:2])
    assert len(result.plot().axes) > 5
    assert "agree within their noise" in result._repr_html_()

"""Reports: what stands on a page, its limits, and the command."""

from __future__ import annotations

import base64
import dataclasses
import html
import inspect
import json
import os
import re
import tomllib
import warnings
from enum import Flag
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from report_results import SHAPE, calibration, every_kind, measured

import equipix
from equipix import batch, detector, hardware, lens, metrics, nuc, plan, scene, simulate
from equipix.errors import FileError
from equipix.findings import Finding, usable
from equipix.pictures import new_figure
from equipix.report import camera
from equipix.report.drawing import (
    draw_convergence,
    draw_histogram,
    draw_map,
    draw_profiles,
    draw_shifts,
    draw_spectrum,
    limits_of,
)
from equipix.report.figures import summary, words_of
from equipix.report.limits import (
    CalibrationLimits,
    CameraLimits,
    LimitsFile,
    checked,
    limits_template,
    read_limits,
)
from equipix.report.maps import Map, maps_of
from equipix.report.page import mapped, page, part_of, provenance_of
from equipix.scene.methods import METHODS
from given import learned, written_camera

NOTHING = LimitsFile()


@pytest.fixture(scope="module")
def results():
    return every_kind()


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A calibration on disk."""
    path = tmp_path_factory.mktemp("saved") / "cal.tif"
    calibration().save(path)
    return path


class Checked(HTMLParser):
    """Elements of a page that must be closed in their order."""

    EMPTY = frozenset({"meta", "img", "br", "link"})

    def __init__(self, text):
        super().__init__()
        self.open = []
        self.addresses = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.addresses += [value for name, value in attrs if name in ("src", "href")]
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, _tag, attrs):
        self.addresses += [value for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.mark.long
def test_each_kind_of_result_has_a_part(results):
    parts = [part_of(name, each, NOTHING, share=4) for name, each in results.items()]
    text = page(parts, "All")
    checked = Checked(text)
    assert checked.open == []
    # Nothing is asked of a network.
    assert all(each.startswith(("data:image/png;base64,", "#")) for each in checked.addresses)
    for name, part in zip(results, parts, strict=True):
        assert part.maps, name
        assert part.figures, name
        assert f">{name}</h2>" in text


def test_a_long_table_is_folded_and_printed(results):
    part = part_of("cal", results["calibration"], NOTHING)
    few, many = (part.tables[0]._replace(rows=[("a",) * 6] * count) for count in (40, 41))
    text = page([part._replace(tables=[few, many])], "One")
    assert "<details open><summary>40 rows" in text
    assert "<details><summary>41 rows" in text
    assert re.search(r'"beforeprint", .*"details"\)\) each\.open = true', text)


@pytest.mark.long
def test_findings_stand_in_the_page_as_text(results):
    text = page([part_of("cal", results["calibration"], NOTHING)], "One")
    assert "the lamp drifts by <2 %" not in text
    assert "The lamp drifts by <2 %: measure it & give 'flux'." in html.unescape(text)


def test_values_under_the_pointer_are_those_of_the_map(results):
    cal = results["calibration"]
    shown = part_of("cal", cal, NOTHING).maps[0]
    words = np.frombuffer(base64.b64decode(shown["coded"]), "<u2").reshape(shown["rows"], -1)
    low, high = float(shown["low"]), float(shown["high"])
    known = np.isfinite(cal.sensitivity)
    np.testing.assert_array_equal(words > 0, known)
    read = low + (high - low) * (words[known] - 1.0) / 65534
    # Rounded to the nearest of 65 534 steps.
    np.testing.assert_allclose(read, cal.sensitivity[known], atol=0.51 * (high - low) / 65534)


def test_flagged_pixels_do_not_scale_a_map(results):
    response = results["response"]
    planes = response.deviation.copy()
    planes[1, 3:6, 4] = 50.0
    flags = response.flags.copy()
    flags[3:6, 4] |= np.uint32(equipix.Flag.DO_NOT_USE)
    good = planes[1][usable(flags)]
    for largest in (480, 16):  # single pixels, and means of blocks
        bad = dataclasses.replace(response, deviation=planes, flags=flags)
        shown = mapped(maps_of(bad)[1], largest)
        assert float(shown["last"]) <= abs(good).max() * 1.001
        assert float(shown["high"]) > 10  # what a pointer reads is the value itself


def test_curves_of_a_response_are_of_offset_and_gain(results):
    titles = [each["title"] for each in part_of("r", results["response"], NOTHING).plots]
    assert {
        f"{kind} of {name}"
        for kind in ("Histogram", "Spectrum")
        for name in ("offset a", "gain deviation K")
    } <= set(titles)
    assert len(titles) == len(set(titles))


def test_provenance_is_in_words():
    metadata = {
        "levels": [{"name": "1", "value": None}, {"name": "2", "frames": [1, 2.5]}],
        "options": {"robust": True, "shifts": [[0, 1], [2, 3]], "mask": []},
    }
    assert provenance_of(metadata) == [
        ("levels 1: name", "1"),
        ("levels 1: value", "none"),
        ("levels 2: name", "2"),
        ("levels 2: frames", "1, 2.5"),
        ("options: robust", "yes"),
        ("options: shifts", "(0, 1), (2, 3)"),
        ("options: mask", "none"),
    ]


@pytest.mark.parametrize(("shape", "step"), [((30, 40), 1), ((30, 41), 2), ((81, 100), 4)])
def test_maps_are_reduced_to_block_means(shape, step):
    values = np.random.default_rng(0).standard_normal(shape)
    values[4, 5] = np.nan
    reduced, found = Map("it", "", values).reduced(40)
    assert found == step
    assert reduced.shape == tuple(-(-size // step) for size in shape)
    assert max(reduced.shape) <= 40
    for row, col in ((1, 2), (-1, 0), (-1, -1)):
        first, left = (at % size * step for at, size in zip((row, col), reduced.shape, strict=True))
        block = values[first : first + step, left : left + step]
        assert reduced[row, col] == pytest.approx(np.nanmean(block))


@pytest.mark.parametrize("shape", [(2, 1000), (1000, 3), (1, 1)])
def test_maps_of_few_rows_or_columns_are_drawn(shape):
    values = np.arange(np.prod(shape), dtype=float).reshape(shape)
    drawn = mapped(Map("it", "", values), 40)
    assert (drawn["rows"], drawn["cols"]) == tuple(-(-size // drawn["step"]) for size in shape)
    assert drawn["ends"] == list(shape)
    figure = new_figure(2, 2)
    draw_map(axes := figure.subplots(), Map("it", "", values))
    assert (axes.get_xlim()[1], axes.get_ylim()[0]) == (shape[1] - 0.5, shape[0] - 0.5)


def test_extremes_are_of_known_values():
    values = np.array([[np.nan, 3.0, -np.inf], [1.5, np.inf, 2.0]])
    assert Map("it", "", values).extremes == (1.5, 3.0)
    assert Map("it", "", np.array([[7, 2]], np.uint16)).extremes == (2.0, 7.0)
    assert np.isnan(Map("it", "", np.full((2, 2), np.nan)).extremes).all()


def test_large_maps_are_reduced_in_parts(monkeypatch):
    values = np.random.default_rng(0).standard_normal((50, 60))
    whole, _ = Map("it", "", values).reduced(20)
    monkeypatch.setattr("equipix.report.maps._AT_ONCE", 60 * 7)
    parts, _ = Map("it", "", values).reduced(20)
    np.testing.assert_array_equal(parts, whole)


def test_maps_of_a_scene_have_its_gain_and_offset_in_dn():
    method = scene.LocalMean(SHAPE, (1000.0, 5000.0))
    rng = np.random.default_rng(1)
    pattern = 20 * rng.standard_normal(SHAPE)
    with warnings.catch_warnings(action="ignore"):  # nothing moves in these frames
        for light in rng.uniform(2000, 4000, 20):
            method.update(light + pattern + 300 * rng.standard_normal(SHAPE))
    assert np.std(method.offset) > 1
    gain, offset = maps_of(method)
    np.testing.assert_array_equal(gain.values, method.gain)
    np.testing.assert_array_equal(offset.values, method.offset)
    assert offset.unit == "DN"


def test_maps_without_a_value_are_left_out(results):
    assert all(np.isfinite(each.values).any() for one in results.values() for each in maps_of(one))


def test_blocks_of_colour_filters_leave_no_moire():
    values = np.tile([[1.0, 2.0], [2.0, 5.0]], (45, 60))
    assert np.ptp(Map("it", "", values).reduced(50)[0]) == 0


@pytest.mark.long
def test_errors_of_m_count_the_drift_once(results):
    """Error bars contain the tilt that a drift hides; the solver's estimate is none of them."""
    cal, shape = results["calibration"], np.array(SHAPE)
    covariance = np.diag((np.array([3e-3, 4e-3]) / shape) ** 2)
    drift = dataclasses.replace(
        cal.drift, size=1e-3, slope_covariance=covariance, tilt_std=np.array([3e-3, 4e-3])
    )
    hidden = cal.sensitivity * np.sqrt(drift.variance_map(cal.sensitivity))
    noise = np.full(SHAPE, 2e-3)
    drifting = dataclasses.replace(
        cal,
        drift=drift,
        sensitivity_std=np.hypot(noise, hidden),
        tilt_std=np.array([5e-3, 5e-3]),
        error_estimate=1.5e-5,
    )
    (table,) = (each for each in part_of("it", drifting, NOTHING).tables if "cause" in each.title)
    assert [row[:2] for row in table.rows] == [
        ("Noise, of a pixel", "0.002"),
        ("Noise, of the tilt", "0.004, 0.003"),
        ("Drift of the lamp", "0.003, 0.004"),
    ]
    assert table.caption == (
        "The estimated error that the solver left, 1.5e-05, is no standard deviation."
    )
    steady = dataclasses.replace(drift, size=0.0, tilt_std=np.zeros(2))
    plain = dataclasses.replace(cal, drift=steady, findings=(), sensitivity_std=None, tilt_std=None)
    (table,) = (each for each in part_of("it", plain, NOTHING).tables if "cause" in each.title)
    assert table.rows == [
        ("Noise, of a pixel", "not known", "calibrate with --uncertainty"),
        ("Noise, of the tilt", "not known", "calibrate with --uncertainty"),
        (
            "Drift of the lamp",
            "0, 0",
            "in the tilt; the drift is smaller than the noise of the fluxes",
        ),
    ]
    failed = Finding("uncertainty", "the fit is too far from its minimum", "convergence")
    plain = dataclasses.replace(plain, drift=None, findings=(failed,))
    (table,) = (each for each in part_of("it", plain, NOTHING).tables if "cause" in each.title)
    assert {row[1] for row in table.rows} == {"not known"}
    assert "see its findings" in table.rows[0]
    for kind, why in (("known", "not estimated"), ("fit", "the fluxes were fitted")):
        options = {**plain.metadata["options"], "flux": kind}
        fluxes = dataclasses.replace(plain, metadata={**plain.metadata, "options": options})
        tables = part_of("it", fluxes, NOTHING).tables
        (table,) = (each for each in tables if "cause" in each.title)
        assert table.rows[-1][2] == f"in the tilt; {why}"


def test_dead_and_hot_pixels_are_listed_before_those_of_a_mask(results):
    flags = np.zeros(SHAPE, np.uint32)
    flags[:12] = equipix.Flag.NO_FLAT_FIELD | equipix.Flag.DO_NOT_USE
    flags[20, 3] = equipix.Flag.DEAD | equipix.Flag.DO_NOT_USE
    flags[22, 30] = equipix.Flag.HOT | equipix.Flag.DO_NOT_USE
    masked = dataclasses.replace(results["calibration"], flags=flags)
    table = part_of("it", masked, NOTHING).tables[-1]
    assert table.rows[:3] == [
        ("20, 3", "do not use, dead"),
        ("22, 30", "do not use, hot"),
        ("0, 0", "do not use, no flat field"),
    ]
    assert len(table.rows) == 200
    assert table.caption == "dead 1, hot 1, no flat field 384. 200 of 386 are listed."


@pytest.mark.long
def test_shifts_and_fluxes_are_listed(results):
    cal = results["calibration"]
    table = part_of("it", cal, NOTHING).tables[0]
    assert table.head == (
        *("Exposure", "Given or measured (row, col)", "Used (row, col)", "Turned", "Flux"),
    )
    assert [row[0] for row in table.rows] == ["0", "1", "2", "3", "4"]
    row, col = cal.shifts[1]
    assert table.rows[1] == ("1", "given", f"{row:.4f}, {col:.4f}", "0°", "1")
    darks = ["[[dark]] 1", *4 * ["[[dark]] 2"]]
    dark = dataclasses.replace(cal, metadata=cal.metadata | {"darks": darks})
    table = part_of("it", dark, NOTHING).tables[0]
    assert [table.head[-1], *(row[-1] for row in table.rows)] == ["Dark", *darks]


def test_colours_are_said_of_response_and_beam():
    shape, shifts = (16, 20), equipix.cross_pattern(3, 5)
    truth = simulate.filtered(simulate.paper_sensitivity(shape, rng=1), "RGGB")
    beam = simulate.gaussian_beam(shape, width=60, amplitude=8000)
    cal = equipix.calibrate(simulate.exposures(truth, beam, shifts), shifts, cfa="RGGB")
    figures = dict(words_of(summary(cal)))
    told = figures["mean response of each colour (M has mean 1 within each)"]
    assert told.startswith(f"R {cal.colour_response['R']:.4g}, G ")
    assert "Beam L, over the response of each colour" in [each.name for each in maps_of(cal)]


def test_ids_of_a_page_are_unique(results):
    part = part_of("cal", results["calibration"], NOTHING)
    text = page([part, part], "Two")
    ids = re.findall(r'\bid="([^"]*)"', text)
    assert len(ids) == len(set(ids)) > 100
    used = re.findall(r'(?:href="#|url\(#)([^")]*)', text)
    assert set(used) <= set(ids)
    assert "fewer points than on a page of one" in text
    assert "fewer points than on a page of one" not in page([part], "One")


def test_curves_have_names_units_and_signs(results):
    cal = results["calibration"]
    figure = new_figure(4, 4)
    axes = figure.subplots(2, 3).ravel()
    values = np.add.outer(np.arange(4.0), 10 * np.arange(6.0))
    draw_profiles(axes[0], Map("It", "DN", values))
    lines = {line.get_label(): line.get_ydata().tolist() for line in axes[0].lines}
    assert lines == {
        "of each row": [25.0, 26.0, 27.0, 28.0],
        "of each column": [1.5, 11.5, 21.5, 31.5, 41.5, 51.5],
    }
    assert axes[0].get_title() == "Medians: It, DN"
    draw_shifts(axes[1], cal)
    np.testing.assert_array_equal(axes[1].lines[0].get_xydata(), cal.shifts[:, ::-1])
    assert [each.get_text() for each in axes[1].texts] == ["0", "1", "2", "3", "4"]
    assert axes[1].yaxis_inverted()
    draw_convergence(axes[2], cal)
    (line,) = axes[2].lines
    np.testing.assert_array_equal(line.get_xdata(), cal.history["sweep"])
    np.testing.assert_array_equal(line.get_ydata(), cal.history["error_estimate"])
    stripes = np.tile([0.0, 2.0], (8, 4))  # of columns: a peak of rows alone, at half a cycle
    draw_spectrum(axes[3], Map("It", "DN", stripes))
    along = {line.get_label(): line.get_xydata()[-1].tolist() for line in axes[3].lines}
    # A wave of amplitude 1 over 8 pixels: |Σ ±1| / √8.
    assert along["along rows"] == [0.5, pytest.approx(8**0.5)]
    assert along["along columns"] == [0.5, 0]
    assert (axes[3].get_xlabel(), axes[3].get_ylabel()) == ("cycles per pixel", "DN")
    draw_histogram(axes[4], Map("It", "", np.array([[1.0, 2.0, 2.0, np.nan]])))
    assert axes[4].patches[0].get_data().values.sum() == 3
    assert axes[4].get_xlabel().startswith("relative;")
    wide = new_figure(5.2, 3.8).subplots()
    draw_histogram(wide, Map("M", "", np.linspace(0.8966, 1.088, 99)[None]))
    # Seven numbers of three decimals fit below the histogram of a page.
    assert np.sum(abs(wide.get_xticks() - 0.9923) < 0.1) <= 7
    assert limits_of(Map("it", "", values, "deviation"), np.array([-1.0, 3.0])) == (
        pytest.approx(-3, rel=1e-2),
        pytest.approx(3, rel=1e-2),
    )


class TestLimits:
    @pytest.mark.long
    def test_the_template_is_read_and_judges(self, tmp_path, results):
        path = tmp_path / "limits.toml"
        path.write_text(limits_template())
        tables = {"calibration", "response", "correction", "camera", "comparison"}
        assert {*tomllib.loads(path.read_text())} == tables
        part = part_of("cal", results["calibration"], read_limits(path))
        assert {check.name for check in part.checks} == {
            *("flagged_share", "findings", "sensitivity_std", "tilt_std", "reduced_chi2"),
            *("error_estimate", "converged"),
        }

    @pytest.mark.long
    @pytest.mark.parametrize(
        ("text", "passed"),
        [
            ("sensitivity_std = 1e-2", True),
            ("sensitivity_std = 1e-9", False),
            ("reduced_chi2 = [0.5, 2]", True),
            ("reduced_chi2 = [2, 3]", False),
            ("converged = true", True),
            ("converged = false", False),
            ('findings = "warning"', True),
            ('findings = "note"', False),
            ("flagged_share = 0.5", True),
            ("flagged_share = 0", False),
        ],
    )
    def test_both_sides(self, tmp_path, results, text, passed):
        path = tmp_path / "limits.toml"
        path.write_text(f"[calibration]\n{text}\n")
        part = part_of("cal", results["calibration"], read_limits(path))
        assert [check.passed for check in part.checks] == [passed]
        assert part.verdict == ("PASS" if passed else "FAIL")

    @pytest.mark.long
    def test_a_figure_that_is_not_known_fails(self, tmp_path):
        """Not one that a result cannot have, such as a misfit without degrees of freedom."""
        path = tmp_path / "limits.toml"
        path.write_text("[response]\nreduced_chi2 = [0, 10]\n")
        levels = [equipix.average(measured(level)) for level in (9, 500, 1500)]
        assert part_of("one", nuc.fit(levels), read_limits(path)).verdict == "PASS"
        flat = nuc.fit([[[1.0, 2.0, 3.0]], [[2.0, 4.0, 6.0]]])
        (check,) = (part := part_of("two", flat, read_limits(path))).checks
        assert (check.value, check.verdict, part.verdict) == (
            *("this result has none", "not judged"),
            "",
        )
        alike = nuc.fit([level.mean for level in levels])  # a misfit, and no noise to judge it by
        (check,) = part_of("three", alike, read_limits(path)).checks
        assert (check.value, check.verdict) == ("not known", "FAIL")

    def test_standard_deviations_that_are_not_known_name_their_option(self, tmp_path, results):
        path = tmp_path / "limits.toml"
        path.write_text("[calibration]\nsensitivity_std = 1\ntilt_std = 1\n")
        plain = dataclasses.replace(results["calibration"], sensitivity_std=None, tilt_std=None)
        checks = part_of("it", plain, read_limits(path)).checks
        assert {check.value for check in checks} == {"not known (calibrate with --uncertainty)"}
        assert not any(check.passed for check in checks)

    @pytest.mark.parametrize("kind", ["averages", "scene"])
    def test_results_without_flags_or_findings_are_not_judged_by_them(
        self, tmp_path, results, kind
    ):
        path = tmp_path / "limits.toml"
        path.write_text('[correction]\nflagged_share = 0\nfindings = "note"\n')
        part = part_of(kind, results[kind], read_limits(path))
        has_findings = kind == "averages"
        assert {check.name: check.passed for check in part.checks} == {
            "findings": True if has_findings else None,
            "flagged_share": None,
        }
        text = page([part], "One")
        assert ("no findings" in text) is not has_findings
        assert ("nothing contradicts" in text) is has_findings
        assert text.count(">not judged<") == (1 if has_findings else 3)

    def test_one_of_several_figures_is_enough_to_fail(self):
        limits = CalibrationLimits(tilt_std=0.01)
        for values, passed in (((0.01, 0.01), True), ((0.001, 0.02), False)):
            (check,) = checked(limits, {"tilt_std": dict(zip("rc", values, strict=True))}, ())
            assert check.passed is passed
            assert check.value == ", ".join(f"{each:g}" for each in values)

    def test_figures_of_cameras_have_a_largest_or_a_smallest_value(self):
        limits = CameraLimits(snr_max_db=38, prnu_percent=1)
        for snr, prnu, passed in ((38, 1, [True, True]), (37, 2, [False, False])):
            checks = checked(limits, {"snr_max_db": snr, "prnu_percent": prnu}, ())
            assert [check.passed for check in checks] == passed
        assert [check.wanted for check in checks] == ["at least 38", "at most 1"]
        (check,) = checked(CameraLimits(dsnu_e=1), {}, ())
        assert (check.value, check.verdict) == ("not known", "FAIL")

    @pytest.mark.parametrize(
        ("limits", "value", "note", "words", "passed"),
        [
            (CameraLimits(dark_noise_e=1), 0.9, "below", "below 0.9", True),
            (CameraLimits(dark_noise_e=1), 1.1, "below", "below 1.1", False),
            (CameraLimits(dark_noise_e=1), 0.9, "above", "above 0.9", False),
            (CameraLimits(snr_max_db=38), 39, "above", "above 39", True),
            (CameraLimits(snr_max_db=38), 37, "above", "above 37", False),
            (CameraLimits(snr_max_db=38), 39, "below", "below 39", False),
            (CameraLimits(dsnu_e=1), np.nan, "not measured", "not measured", False),
        ],
    )
    def test_a_bound_passes_where_all_that_it_allows_does(self, limits, value, note, words, passed):
        (name,) = limits.model_dump(exclude={"findings"}, exclude_none=True)
        checks = checked(limits, {name: value}, (), {name: note})
        (check,) = (each for each in checks if each.name == name)
        assert (check.value, check.passed) == (words, passed)

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            (
                "[calibration]\nsensitivty_std = 1",
                r"key 'sensitivty_std' in \[calibration\]: did you mean 'sensitivity_std'\?",
            ),
            ("[calibrations]\nconverged = true", r"'calibrations': did you mean 'calibration'\?"),
            ("[calibration]\nconverged = 1", "'converged' .* holds 1, expected true or false"),
            ("[calibration]\nreduced_chi2 = 1", r"'reduced_chi2' .* holds 1, expected \[low, high"),
            ("[calibration]\nreduced_chi2 = [2, 1]", r"holds \[2, 1\], expected .* not above"),
            ("[calibration]\nflagged_share = 1.5", "holds 1.5, expected a share from 0 to 1"),
            ("[response]\nflagged_share = nan", "holds nan, expected a share from 0 to 1"),
            ("[calibration]\ntilt_std = -1", "holds -1, expected a number from 0 on"),
            ("[camera]\ndsnu_e = inf", "holds inf, expected a number of electrons"),
            ("[calibration", "not valid TOML"),
        ],
    )
    def test_mistakes_are_named(self, tmp_path, text, words):
        path = tmp_path / "limits.toml"
        path.write_text(text)
        with pytest.raises(FileError, match=words):
            read_limits(path)


class TestCommand:
    def test_writes_a_page(self, saved, tmp_path, run):
        out = tmp_path / "report.html"
        status, printed, _ = run("report", saved, "-o", out)
        assert status == 0
        assert "not judged (give --limits)" in printed
        text = out.read_text(encoding="utf-8")
        assert len(text) < 15e6
        assert re.search(r"<h3>Provenance</h3>", text)

    @pytest.mark.long
    def test_ends_with_1_beyond_a_limit_if_asked_to(self, saved, tmp_path, run):
        limits, out = tmp_path / "limits.toml", tmp_path / "report.html"
        status, _, _ = run("init", "limits", tmp_path)
        assert status == 0
        arguments = ("report", saved, "-o", out, "--limits", limits)
        assert run(*arguments)[0] == 0
        status, _, told = run(*arguments, "--check", "--force")
        assert status == 1
        assert f"{saved}: findings is warning, expected at most note" in told
        assert "FAIL" in out.read_text(encoding="utf-8")
        printed = json.loads(run(*arguments, "--force", "--json")[1])
        assert printed["limits"][str(saved)][0] == {
            "figure": "findings",
            "found": "warning",
            "wanted": "at most note",
            "verdict": "FAIL",
        }

    def test_a_check_of_nothing_fails(self, saved, tmp_path, run):
        limits = tmp_path / "limits.toml"
        limits.write_text("[response]\nflagged_share = 0.01\n")
        status, _, told = run(
            *("report", saved, "-o", tmp_path / "it.html", "--limits", limits, "--check")
        )
        assert status == 1
        assert f"nothing is judged of {saved}: {limits} has no limit" in told

    def test_names_of_files_need_not_be_utf8(self, saved, tmp_path, run):
        name = tmp_path / os.fsdecode(b"\xff.tif")
        name.write_bytes(saved.read_bytes())
        assert run("report", name, "-o", tmp_path / "it.html", "--json")[0] == 0
        assert "?.tif</h2>" in (tmp_path / "it.html").read_text(encoding="utf-8")

    @pytest.mark.long
    def test_too_large_a_page_is_refused(self, saved, tmp_path, run, monkeypatch):
        monkeypatch.setattr("equipix.report.page._MOST_BYTES", 100_000)
        status, _, told = run("report", saved, "-o", tmp_path / "it.html")
        assert status == 1
        assert re.search(r"it.html' would have 0\.\d MB, at most 0: write fewer results", told)
        assert not (tmp_path / "it.html").exists()

    @pytest.mark.parametrize("arguments", [(), ("SAVED",), ("-o", "OUT.html")])
    def test_needs_results_and_a_page(self, tmp_path, run, arguments):
        assert run("report", *arguments)[0] == 2
        assert not [*tmp_path.iterdir()]

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (("SAVED", "-o", "OUT.pdf"), "ends in '.pdf', expected the suffix .html"),
            (("SAVED", "-o", "OUT.html", "--check"), "--check needs --limits"),
            (("missing.tif", "-o", "OUT.html"), "missing.tif: does not exist"),
            (("SAVED", "SAVED", "-o", "OUT.html"), "is named twice: name each result once"),
        ],
    )
    def test_refuses(self, saved, tmp_path, run, arguments, words):
        given = [each.replace("SAVED", str(saved)) for each in arguments]
        given = [each.replace("OUT", str(tmp_path / "out")) for each in given]
        status, _, told = run("report", *given)
        assert status == 1
        assert words in told
        assert not [*tmp_path.iterdir()]


@pytest.mark.long
def test_a_picture_of_each_kind(results, tmp_path):
    for name, each in results.items():
        figure = each.plot()
        titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
        assert len(titles) >= 4, name
    each.plot().savefig(tmp_path / "it.png", dpi=30)


@pytest.mark.long
def test_inspect_draws(saved, tmp_path, run):
    out = tmp_path / "cal.png"
    assert run("inspect", saved, "-o", out)[0] == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    status, _, told = run("inspect", saved, "-o", out)
    assert status == 1
    assert "exists" in told


def test_notebooks_show_results(results):
    for name, each in results.items():
        text = each._repr_html_()
        assert Checked(text).open == [], name
        assert len(text) < 200_000, name


def test_notebooks_without_the_libraries_show_words(results, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "jinja2", None)
    assert results["calibration"]._repr_html_() is None


class TestCamera:
    @pytest.mark.long
    def test_writes_a_page_of_all_figures(self, tmp_path, run):
        out = tmp_path / "camera.html"
        status, printed, told = run("emva", written_camera(tmp_path), "-o", out)
        assert (status, told) == (0, "")
        text = out.read_text(encoding="utf-8")
        checked = Checked(text)
        assert checked.open == []
        assert all(each.startswith("data:image/png;base64,") for each in checked.addresses)
        figures = re.findall(r'<th scope="row">([^<]*)</th><td>([^<]*)</td></tr>', text)
        _, *listed = re.findall(r"^ +(\S.*?)  +(?:(\S+) +)?(\S.*?) *$", printed, re.MULTILINE)
        assert len(listed) > 25
        words = dict(figures)
        for name, unit, number in listed:
            assert f"{number} {unit}".strip() in words[name].split(", ")
        for title in (
            *("Responsivity", "Photon transfer", "Deviation from linearity", "Mean of the dark"),
            *("Signal-to-noise ratio", "Spectrum of dark signal"),
            *(f"Profiles of photo response along {along}" for along in ("rows", "columns")),
            "Histogram of photo response, high-passed",
        ):
            assert f'aria-label="{title}"' in text
        assert text.count('class="map"') == 2
        status, _, told = run("emva", tmp_path, "-o", out)
        assert status == 1
        assert "exists" in told

    def test_is_judged_by_limits(self, tmp_path, run):
        limits, out = tmp_path / "limits.toml", tmp_path / "it.html"
        path = written_camera(tmp_path, count=6, spatial=0)
        limits.write_text("[camera]\nquantum_efficiency_percent = 99\ndark_noise_e = 1e3\n")
        asked = ("emva", path, "--limits", limits, "--check")
        status, printed, told = run(*asked, "-o", out)
        assert status == 1
        assert re.search("quantum_efficiency_percent is .*, expected at least 99", told)
        assert "dark_noise_e" not in told
        assert f"PASS        {path}: dark_noise_e" in printed
        assert "at least 99" in out.read_text(encoding="utf-8")
        found = json.loads(run(*asked, "--json")[1])["limits"]
        assert [each["verdict"] for each in found] == ["FAIL", "PASS"]
        limits.write_text("[camera]\ndark_noise_e = 1e3\n")
        assert run(*asked)[0] == 0

    def test_what_was_not_measured_says_what_to_add(self, tmp_path, run):
        """And a bound is shown as one. All of it fails: a limit asks for the figure."""
        limits = tmp_path / "limits.toml"
        keys = ("dsnu_e", "prnu_percent", "dark_current_mean_e_per_s")
        lines = ["[camera]", *(f"{key} = 1e9" for key in (*keys, "dark_noise_e"))]
        limits.write_text("\n".join(lines))
        path = written_camera(tmp_path, count=6, spatial=0, gain=0.01)
        path.write_text(re.sub(r"exposure_s = .*", "exposure_s = 0.01", path.read_text()))
        asked = ("emva", path, "--limits", limits)
        judged = json.loads(run(*asked, "--json")[1])["limits"]
        found = {each["figure"]: (each["found"], each["verdict"]) for each in judged}
        assert found["dsnu_e"] == found["prnu_percent"] == ("not measured (add [spatial])", "FAIL")
        assert found["dark_current_mean_e_per_s"] == (
            *("not measured (add levels and darks of 3 exposure times)", "FAIL"),
        )
        number, verdict = found["dark_noise_e"]
        assert re.fullmatch(r"below \d+\.?\d*", number)
        assert verdict == "PASS"
        status, printed, told = run(*asked, "--check")
        assert status == 1
        assert "prnu_percent is not measured (add [spatial]), expected at most 1e+09" in told
        assert "dark current by the mean" in printed
        assert "dark_noise_e" not in told

    def test_is_judged_once(self, tmp_path, run, monkeypatch):
        limits = tmp_path / "limits.toml"
        limits.write_text("[camera]\ndark_noise_e = 1e3\n")
        path, judged = written_camera(tmp_path, count=6, spatial=0), []

        def counted(*arguments, judge=camera.checked):
            judged.append(arguments)
            return judge(*arguments)

        monkeypatch.setattr(camera, "checked", counted)
        asked = ("emva", path, "-o", tmp_path / "it.html", "--limits", limits, "--check")
        assert run(*asked)[0] == 0
        assert len(judged) == 1

    @pytest.mark.long
    def test_planes_are_parts_and_columns(self, tmp_path, run):
        path, out = written_camera(tmp_path, cfa="RGGB", count=18, spatial=0), tmp_path / "it.html"
        status, printed, told = run("emva", path, "-o", out)
        assert (status, told) == (0, "")
        text = out.read_text(encoding="utf-8")
        for plane in ("R", "G1", "G2", "B"):
            assert f", plane {plane}</h2>" in text
        assert re.search(r"figure +unit +R +G1 +G2 +B", printed)
        assert text.count("<h3>Planes side by side</h3>") == 1
        assert printed.endswith(f"output  {out}\n")
        found = json.loads(run("emva", path, "--json")[1])
        assert {*found} == {"findings", "output", "R", "G1", "G2", "B"}
        assert (found["output"], found["findings"]) == (None, [])
        assert found["R"]["gain_dn_per_e"] == pytest.approx(0.25, rel=0.2)
        assert found["B"]["findings"] == []

    def test_what_is_not_known_is_null(self, tmp_path, run):
        path = written_camera(tmp_path, count=6, spatial=0)
        path.write_text(re.sub(r"exposure_s = .*", "exposure_s = 0.01", path.read_text()))
        found = json.loads(run("emva", path, "--json")[1])
        assert found["dark_current_mean_e_per_s"] is None
        assert not any(key.startswith(("dsnu", "prnu")) for key in found)

    @pytest.mark.parametrize("name", ["out.pdf", "camera.toml"])
    def test_outputs_that_are_no_page_are_refused(self, tmp_path, run, name):
        path = written_camera(tmp_path, count=6, spatial=0)
        status, _, told = run("emva", path, "-o", tmp_path / name, "--force")
        assert status == 1
        assert f"ends in '{Path(name).suffix}', expected the suffix .html" in told


@pytest.mark.parametrize("step", [0.25, 1.0, 3.0])
def test_bins_of_a_histogram_hold_whole_steps(step):
    """Each of 32 values stands as often: bins have as many values each, but the last."""
    axes = new_figure(3, 3).subplots()
    draw_histogram(axes, Map("Dark", "DN", step * (np.arange(3072.0).reshape(48, 64) % 32) - 7.1))
    counts = axes.patches[0].get_data().values
    assert counts.sum() == 3072
    assert len({*counts[:-1].tolist()}) == 1


def test_curves_take_the_colour_of_the_text(results):
    """Letters without a fill of their own are black, also on a dark screen."""
    part = part_of("cal", results["calibration"], NOTHING)
    assert "figure svg { fill: currentColor; }" in page([part], "One")
    for plot in part.plots:
        legend = plot["svg"].partition('id="legend')[2]
        assert "fill: #ffffff" not in legend


def public_classes():
    """Classes among the public names, but protocols and bits."""
    public = [getattr(equipix, name) for name in equipix.__all__]
    modules = [equipix, *filter(inspect.ismodule, public)]
    found = [getattr(module, name) for module in modules for name in getattr(module, "__all__", ())]
    return {
        each
        for each in filter(inspect.isclass, found)
        if not issubclass(each, Exception | Flag) and each is not equipix.Correction
    }


@pytest.mark.long
def test_short_forms_are_a_line(results, tmp_path):
    """Of each public class, and of what public functions give."""
    cal, response, raw = results["calibration"], results["response"], measured(1500)
    shape, shifts = (48, 64), equipix.cross_pattern(3, 5)
    line = nuc.fit([equipix.average(measured(level)) for level in (500, 1500, 3000)])
    truth = simulate.paper_sensitivity(shape, rng=1)
    virtual = simulate.experiment(truth, simulate.gaussian_beam(shape), shifts, rng=2)
    rows, cols = np.mgrid[:24, :32]
    fallen = 1000 / (1 + ((rows - 12.0) ** 2 + (cols - 15.0) ** 2) / 60.0**2) ** 2
    disc = 1000.0 * (np.hypot(rows - 12, cols - 15) < 6)
    band = detector.HgCdTe(start_um=3.0, cutoff_um=5.1)
    manifest = virtual.write(tmp_path / "experiment")
    camera = equipix.CameraExperiment.load(written_camera(tmp_path, count=18, shape=(16, 20)))
    figures = camera.figures()[""]
    (tmp_path / "levels.toml").write_text(
        "".join(f'[[level]]\nframes = "experiment/frames/p{k}.tif"\n' for k in range(2))
    )
    row = batch.Row("a", "a/experiment.toml", reason="the file is missing")
    shown = [
        *results.values(),
        *(learned(name, SHAPE) for name in METHODS),
        *(cal.orientation, cal.drift, *cal.findings, equipix.compare([cal, cal])),
        *(equipix.Corrector(response), nuc.DefectLimits(), nuc.find_defects(response, raw)),
        *(metrics.correctability(raw), metrics.three_d_noise(raw)),
        *(metrics.emva_spatial(raw, measured(0)), metrics.emva_spatial(raw, measured(0)).dsnu),
        *(equipix.NoiseModel(read_noise=3.123456789, gain=1 / 7), lens.fit(fallen)),
        *(plan.error_budget(shape, shifts, noise=1e-3), plan.identify(shape, shifts)),
        *(plan.suggest(shape, 5, (9, 9), noise=1e-3, rng=1)[0], equipix.measure_shift(disc, disc)),
        *(virtual, virtual.camera, virtual.truth, simulate.MovingScene(seed=1, shape=shape)),
        simulate.StaringArray.of("InSb", shape, rng=1),
        simulate.BolometerArray.of(shape, rng=1),
        *(band, detector.ShortPass(edge_um=5.0), detector.composition_tolerance(band)),
        *(hardware.AdaptiveLoop((8, 8)), hardware.quality(line, raw), camera),
        hardware.smallest_widths(line, [raw]),
        *(figures, figures.transfer, equipix.Experiment.load(manifest)),
        equipix.LevelExperiment.load(tmp_path / "levels.toml"),
        *(equipix.Running(shape), batch.Lot((row,)), row),
    ]
    assert public_classes() <= {type(each) for each in shown}
    for each in shown:
        text = repr(each)
        assert len(text) <= 120, text
        assert "\n" not in text
        assert " at 0x" not in text
        for number in re.findall(r"\d+\.\d+", text):
            assert len(number.replace(".", "").lstrip("0")) <= 5, text


@pytest.mark.parametrize("far", [1 + 1e-7, 1e20, -1e30])
def test_a_histogram_of_equal_values_has_the_one_that_is_far_out(far):
    """Also of a large map, of which the step is that of a choice of values."""
    values = np.ones((400, 400))
    values[1, 1] = far
    axes = new_figure(4, 3).subplots()
    draw_histogram(axes, Map("Dark", "DN", values))
    (bars,) = axes.patches
    counts, edges, _ = bars.get_data()
    assert sorted(counts[counts > 0]) == [1, values.size - 1]
    assert edges[0] <= min(1, far) < max(1, far) <= edges[-1]


@pytest.mark.parametrize("draw", [draw_histogram, draw_spectrum])
def test_a_value_whose_square_overflows_is_drawn(draw):
    """NumPy warned of its square, and the spectrum was infinite."""
    values = np.random.default_rng(1).standard_normal((40, 40))
    values[1, 1] = 1e300
    axes = new_figure(4, 3).subplots()
    draw(axes, Map("Dark", "DN", values))
    for line in axes.lines:
        assert np.isfinite(line.get_ydata()).all()

"""Reports: what stands on a page, its limits, and the command."""

from __future__ import annotations

import base64
import html
import inspect
import json
import re
import tomllib
from enum import Flag
from html.parser import HTMLParser

import numpy as np
import pytest
from report_results import SHAPE, calibration, every_kind, measured

import equipix
from equipix import detector, hardware, lens, metrics, nuc, plan, simulate
from equipix.errors import FileError
from equipix.report.limits import LimitsFile, limits_template, read_limits
from equipix.report.maps import Map, maps_of
from equipix.report.page import page, part_of
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


@pytest.mark.parametrize(("shape", "step"), [((30, 40), 1), ((30, 41), 2), ((81, 100), 3)])
def test_maps_are_reduced_to_block_means(shape, step):
    values = np.random.default_rng(0).standard_normal(shape)
    values[4, 5] = np.nan
    reduced, found = Map("it", "", values).reduced(40)
    assert found == step
    assert reduced.shape == tuple(size // step for size in shape)
    assert max(reduced.shape) <= 40
    block = values[step : 2 * step, 2 * step : 3 * step]
    assert reduced[1, 2] == pytest.approx(np.nanmean(block))


def test_large_maps_are_reduced_in_parts(monkeypatch):
    values = np.random.default_rng(0).standard_normal((50, 60))
    whole, _ = Map("it", "", values).reduced(20)
    monkeypatch.setattr("equipix.report.maps._AT_ONCE", 60 * 7)
    parts, _ = Map("it", "", values).reduced(20)
    np.testing.assert_array_equal(parts, whole)


def test_maps_without_a_value_are_left_out(results):
    assert all(np.isfinite(each.values).any() for one in results.values() for each in maps_of(one))


class TestLimits:
    def test_the_template_is_read_and_judges(self, tmp_path, results):
        path = tmp_path / "limits.toml"
        path.write_text(limits_template())
        assert {*tomllib.loads(path.read_text())} == {"calibration", "response", "correction"}
        part = part_of("cal", results["calibration"], read_limits(path))
        assert {check.name for check in part.checks} == {
            *("flagged_share", "findings", "sensitivity_std", "tilt_std", "reduced_chi2"),
            *("error_estimate", "converged"),
        }

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

    def test_a_figure_that_is_not_known_fails(self, tmp_path):
        path = tmp_path / "limits.toml"
        path.write_text("[response]\nreduced_chi2 = [0, 10]\n")
        line = equipix.nuc.fit([equipix.average(measured(level)) for level in (9, 500, 1500)])
        assert part_of("one", line, read_limits(path)).verdict == "PASS"
        flat = equipix.nuc.fit([[[1.0, 2.0, 3.0]], [[2.0, 4.0, 6.0]]])
        (check,) = part_of("two", flat, read_limits(path)).checks
        assert (check.value, check.passed) == ("not known", False)

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
        assert "not judged" in printed
        text = out.read_text(encoding="utf-8")
        assert len(text) < 15e6
        assert re.search(r"<h3>Provenance</h3>", text)

    def test_ends_with_1_beyond_a_limit_if_asked_to(self, saved, tmp_path, run):
        limits, out = tmp_path / "limits.toml", tmp_path / "report.html"
        status, _, _ = run("init", "limits", tmp_path)
        assert status == 0
        arguments = ("report", saved, "-o", out, "--limits", limits)
        assert run(*arguments)[0] == 0
        status, _, told = run(*arguments, "--check", "--force")
        assert status == 1
        assert f"beyond the limits of {limits}: {saved}" in told
        assert "FAIL" in out.read_text(encoding="utf-8")

    @pytest.mark.parametrize("arguments", [(), ("SAVED",), ("-o", "OUT.html")])
    def test_needs_results_and_a_page(self, tmp_path, run, arguments):
        assert run("report", *arguments)[0] == 2
        assert not [*tmp_path.iterdir()]

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (("SAVED", "-o", "OUT.pdf"), "ends in none of .html"),
            (("SAVED", "-o", "OUT.html", "--check"), "--check needs --limits"),
            (("missing.tif", "-o", "OUT.html"), "missing.tif: does not exist"),
        ],
    )
    def test_refuses(self, saved, tmp_path, run, arguments, words):
        given = [each.replace("SAVED", str(saved)) for each in arguments]
        given = [each.replace("OUT", str(tmp_path / "out")) for each in given]
        status, _, told = run("report", *given)
        assert status == 1
        assert words in told
        assert not [*tmp_path.iterdir()]


def test_a_picture_of_each_kind(results, tmp_path):
    for name, each in results.items():
        figure = each.plot()
        titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
        assert len(titles) >= 4, name
    each.plot().savefig(tmp_path / "it.png", dpi=30)


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
            *("Signal-to-noise ratio", "Spectrum of dark signal", "Profiles of photo response"),
            "Histogram of photo response, high-passed",
        ):
            assert f'aria-label="{title}"' in text
        assert text.count('class="map"') == 2
        status, _, told = run("emva", tmp_path, "-o", out)
        assert status == 1
        assert "exists" in told

    def test_planes_are_parts_and_columns(self, tmp_path, run):
        path, out = written_camera(tmp_path, cfa="RGGB", count=6, spatial=0), tmp_path / "it.html"
        status, printed, told = run("emva", path, "-o", out)
        assert (status, told) == (0, "")
        text = out.read_text(encoding="utf-8")
        for plane in ("R", "G1", "G2", "B"):
            assert f", plane {plane}</h2>" in text
        assert re.search(r"figure +unit +R +G1 +G2 +B", printed)
        found = json.loads(run("emva", path, "--json")[1])
        assert [*found] == ["output", "R", "G1", "G2", "B", "findings"]
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
        assert "ends in none of .html" in told


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
    camera = equipix.CameraExperiment.load(written_camera(tmp_path, count=6))
    figures = camera.figures()[""]
    (tmp_path / "levels.toml").write_text(
        "".join(f'[[level]]\nframes = "experiment/frames/p{k}.tif"\n' for k in range(2))
    )
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
    ]
    assert public_classes() <= {type(each) for each in shown}
    for each in shown:
        text = repr(each)
        assert len(text) <= 120, text
        assert "\n" not in text
        assert " at 0x" not in text
        for number in re.findall(r"\d+\.\d+", text):
            assert len(number.replace(".", "").lstrip("0")) <= 5, text

"""What the words say holds: README, the pages of docs, docstrings and examples run."""

from __future__ import annotations

import doctest
import importlib
import inspect
import os
import pkgutil
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import before_after
import numpy as np
import pytest
import typer.main
from astropy.io import fits

import equipix
import key_tables
from equipix import errors, metrics
from equipix.cli.app import app
from equipix.diagnosis.inputs import BEFORE
from equipix.diagnosis.rules import AFTER, LAST
from equipix.experiment.manifest import (
    CameraManifest,
    LevelManifest,
    Manifest,
    Sensor,
    example_of,
    keys_of,
    table_of,
)
from equipix.findings import WARNINGS
from equipix.report.camera import figures_of
from equipix.report.limits import LimitsFile
from given import written_camera

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    str(page.relative_to(ROOT)) for folder in ("", "docs") for page in (ROOT / folder).glob("*.md")
)
TEXTS = {page: (ROOT / page).read_text() for page in PAGES}
README = TEXTS["README.md"]
GUIDE = (
    "README.md",
    *(f"docs/{page}.md" for page in ("averages", "calibration", "correcting", "shifts")),
)
"""README, and the pages whose blocks go on where those of README end."""
MODULES = [module.name for module in pkgutil.walk_packages(equipix.__path__, "equipix.")]


def blocks(language: str, *pages: str) -> list[str]:
    """The code blocks of pages in a language."""
    block = re.compile(rf"^ *```{language}\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
    return [found for page in pages for found in block.findall(TEXTS[page])]


def table(header: str, page: str) -> list[list[str]]:
    """The cells of the tables of a page whose first line begins with these cells."""
    table = re.compile(rf"^\| {re.escape(header)} \|.*\n\|[-|]+\n((?:\|.*\n)+)", re.MULTILINE)
    rows = [
        line.strip("| ").split(" | ")
        for body in table.findall(TEXTS[page])
        for line in body.splitlines()
    ]
    assert rows
    return [[cell.strip() for cell in row] for row in rows]


def test_the_python_of_readme_and_pages_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec("\n".join(blocks("python", *GUIDE)), names)
    cal, truth = equipix.load("first.tif"), names["truth"]
    error = metrics.relative_error(cal.sensitivity, truth)
    # The largest of 19 200 normal values of this rms stays below 6 of them.
    assert np.abs(error).max() < 6 * names["camera"].noise_prediction(rng=1)[0]
    assert names["equal"].shape == truth.shape
    assert names["usable"].all()


def write_night(folder: Path) -> None:
    """Frames of two exposure times, and darks of two others, as the commands name them."""
    folder.mkdir()
    rng = np.random.default_rng(1)
    for name, time, level in [
        *((f"dark-{time}s-{k}", time, 100) for time in (1, 4) for k in (1, 2)),
        *((f"m31-{time}s", time, 300) for time in (1, 2)),
    ]:
        frame = rng.poisson(level + 10 * time, (120, 160)).astype(np.uint16)
        kind = "Dark Frame" if level == 100 else "Light Frame"
        cards = {"EXPTIME": float(time), "CCD-TEMP": -10.0, "IMAGETYP": kind, "OBJECT": "M 31"}
        fits.writeto(folder / f"{name}.fits", frame, fits.Header(cards))


@pytest.mark.long
def test_the_commands_of_readme_and_pages_run(tmp_path):
    write_night(tmp_path / "night")
    commands = [block for block in blocks("sh", *GUIDE) if block.startswith("equipix")]
    script = "\n".join(commands)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(
        ["bash", "-euc", script],
        cwd=tmp_path,
        env=os.environ | {"PATH": path},
        check=True,
        capture_output=True,
        timeout=300,
    )
    assert equipix.load(tmp_path / "cal.tif").converged
    assert len(list((tmp_path / "corrected").glob("*.tif"))) == 5
    assert (tmp_path / "plan.png").exists()
    head = fits.getheader(tmp_path / "m31.fits")
    assert (head["OBJECT"], head["BUNIT"], head["BITPIX"]) == ("M 31", "adu", -32)
    assert head["EQUIPIX"].startswith("corrected by equipix, correction sha256 ")
    text = re.search(r"^    (dark: .*)$", TEXTS["docs/correcting.md"], re.MULTILINE)
    assert text is not None
    lines = list(fits.getheader(tmp_path / "night/corrected/m31-2s.fits")["HISTORY"])
    assert text[1] in lines


def test_the_manifests_of_the_pages_are_valid():
    text, region, darks, layout = blocks("toml", "docs/experiment.md")
    known = tomllib.loads(text)
    assert len(Manifest.model_validate(known).exposure) == 3
    several = Manifest.model_validate(known | tomllib.loads(darks) | tomllib.loads(layout))
    assert [each.exposure_s for each in several.dark] == [1, 4]
    assert several.layout.pixel == "Mono12p"
    assert len(Sensor.model_validate(tomllib.loads(region)["sensor"]).region) == 1
    (levels,) = blocks("toml", "docs/nuc.md")
    assert len(LevelManifest.model_validate(tomllib.loads(levels)).level) == 1
    (camera,) = blocks("toml", "docs/camera.md")
    assert len(CameraManifest.model_validate(tomllib.loads(camera)).exposure) == 2


@pytest.mark.parametrize("name", key_tables.TABLES)
def test_the_tables_of_keys_are_those_of_the_schema(name):
    page, model = key_tables.TABLES[name]
    assert key_tables.reference(model) in TEXTS[f"docs/{page}"]
    assert key_tables.with_table(TEXTS[f"docs/{page}"], name, model) == TEXTS[f"docs/{page}"]


@pytest.mark.parametrize("model", [Manifest, LevelManifest, CameraManifest, LimitsFile])
def test_every_key_has_what_it_must_hold_its_meaning_and_an_example(model):
    for path, field in keys_of(model):
        assert field.title, path
        if table_of(field.annotation) is None:
            assert field.description, path
            assert example_of(field) is not None, path


def test_the_codes_of_errors_are_those_of_the_readme():
    codes = {code[1:-1] for _, code, _ in table("exit status", "README.md") if "`" in code}
    raised = {getattr(errors, name) for name in errors.__all__ if name.endswith("Error")}
    assert codes == {each.code for each in raised} | {"usage", "interrupted"}


def test_the_page_describes_every_figure_of_a_camera(tmp_path):
    (found,) = equipix.CameraExperiment.load(written_camera(tmp_path)).figures().values()
    cells = " ".join(cell for _, cell, _ in table("figure | key in `--json`", "docs/camera.md"))
    assert {*re.findall(r"`(\w+)`", cells)} == {each.key for each in figures_of(found)}


@pytest.mark.long
def test_the_errors_of_the_page_are_those_of_the_example(capsys):
    runpy.run_path(str(ROOT / "examples/precision.py"), run_name="__main__")
    _, *lines = capsys.readouterr().out.splitlines()
    lines.remove("lamp drift, error of M that it adds for 5 and for 9 exposures:")
    rows = [line.replace("e-0", "e-").split() for line in lines[:6]]
    page = "docs/calibration.md"
    assert rows == table("frames N", page) + table("change of the flux, rms", page)
    simulated, predicted = (float(line.rsplit(" ", 1)[1]) for line in lines[6:])
    # 455 124 errors scatter by 0.1 %; the prediction is an approximation good to some per cent.
    assert simulated == pytest.approx(predicted, rel=0.05)


def test_the_picture_of_the_readme_shows_what_it_says(capsys):
    before_after.photograph()
    printed = re.findall(r"\d\.\d%", capsys.readouterr().out)
    said = [value for _, value in table("one frame, good pixels", "README.md")]
    assert said == [value.replace("%", " %") for value in printed]


def test_the_make_targets_of_the_readme_exist():
    targets = re.findall(r"^make (\w+)", "\n".join(blocks("sh", "README.md")), re.MULTILINE)
    makefile = (ROOT / "Makefile").read_text()
    assert targets == ["demo", "test"]
    assert all(f"\n{target}:" in makefile for target in targets)


def test_the_readme_names_every_command():
    named = re.findall(r"^\| `equipix (\w+)", README, re.MULTILINE)
    assert sorted(named) == sorted(typer.main.get_command(app).commands)


@pytest.mark.parametrize(
    ("header", "page", "result"),
    [
        ("`cal.`", "docs/calibration.md", equipix.Calibration),
        ("`response.`", "docs/nuc.md", equipix.nuc.Response),
    ],
)
def test_the_pages_name_attributes_that_exist(header, page, result):
    named = {name for row in table(header, page) for name in re.findall(r"`(\w+)", row[0])}
    assert len(named) > 5
    assert named <= {*result.__dataclass_fields__, *dir(result)}


def test_the_page_describes_every_finding_and_its_warning():
    rows = table("finding", "docs/calibration.md")
    described = {kind.strip('`"'): warning.strip("`") for kind, warning, _ in rows}
    rules = [*BEFORE, *AFTER, *LAST]
    assert described == {rule.kind: WARNINGS[rule.concern].__name__ for rule in rules}


def test_the_page_describes_every_flag():
    rows = table("flag", "docs/calibration.md")
    described = {name.strip("`").removeprefix("Flag.") for name, *_ in rows}
    assert described == {flag.name for flag in equipix.Flag} - {"DO_NOT_USE"}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    path = ROOT / page
    links = re.findall(r"\]\((?!https?:)([^)#]+)", TEXTS[page])
    assert [link for link in links if not (path.parent / link).exists()] == []


@pytest.mark.parametrize("page", sorted({*PAGES} - {"CHANGELOG.md", "docs/studies.md"}))
def test_scripts_and_tests_that_pages_name_exist(page):
    named = r"(?:(?:benches|docs|examples|tools)/\w+|tests/(?:\w+/)*test_\w+)\.(?:py|rs)"
    assert [each for each in re.findall(named, TEXTS[page]) if not (ROOT / each).exists()] == []


@pytest.mark.parametrize("page", PAGES)
def test_links_to_sections_lead_to_headings(page):
    path = ROOT / page
    for target, section in re.findall(r"\]\((?!https?:)([^)#]*)#([^)]+)\)", path.read_text()):
        headings = re.findall(
            r"^#+ (.*)", (path.parent / target if target else path).read_text(), re.MULTILINE
        )
        slugs = [re.sub(r"[^\w\- ]", "", each).lower().replace(" ", "-") for each in headings]
        assert section in slugs


@pytest.mark.long
@pytest.mark.parametrize("module", MODULES)
def test_the_examples_of_docstrings_run(module):
    result = doctest.testmod(importlib.import_module(module))
    assert result.failed == 0


def test_docstrings_have_examples_to_run():
    finder = doctest.DocTestFinder()
    examples = [
        test.name
        for module in MODULES
        for test in finder.find(importlib.import_module(module))
        if test.examples
    ]
    assert {
        "equipix.calibration.calibrate.calibrate",
        "equipix.exposures.spots.measure_shift",
    } <= set(examples)


@pytest.mark.parametrize("name", [name for name in equipix.__all__ if not name.startswith("_")])
def test_public_names_are_documented(name):
    thing = getattr(equipix, name)
    assert inspect.getdoc(thing)
    # A class without words of its own would show those of its base.
    if inspect.isclass(thing):
        assert thing.__doc__


def figures(name, capsys):
    """The numbers in each line that an example prints."""
    runpy.run_path(str(ROOT / f"examples/{name}.py"), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    return [[float(each) for each in re.findall(r"[-+]?\d\.\d+(?:e-\d+)?", line)] for line in lines]


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
def test_the_example_between_pixels(capsys):
    rounded, measured, refined, true, left = (each[0] for each in figures("subpixel", capsys))
    assert rounded > 5 * true
    assert refined < 1.1 * true < measured
    assert left < 0.01


@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
def test_the_example_of_a_monitor(capsys):
    steady, monitor = figures("drift_monitor", capsys)
    # 1 % against 0.02 % of error in the fluxes makes as much of a difference in the tilt.
    assert monitor[1] < steady[1] / 5
    assert monitor[0] < steady[0]


def test_the_example_of_a_turned_exposure(capsys):
    turned, alike, fluxes = figures("drift_rotated", capsys)
    assert turned[1] == pytest.approx(0.04, abs=0.001)
    assert alike[1] == 0
    assert turned[0] < alike[0] / 5
    assert fluxes[0] < 1e-4


def test_the_example_of_two_levels(capsys):
    (sensitivity, dark), (corrected,) = figures("two_levels", capsys)
    # Ten exposures, but levels that differ by 0.6 tell the gain: some 1.2·5e-4/√10/0.4 each.
    assert sensitivity < 1e-3 > dark
    assert corrected < 3 * 5e-4


def test_the_example_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["calibrate.py", str(tmp_path / "cal.tif")])
    runpy.run_path(str(ROOT / "examples/calibrate.py"), run_name="__main__")
    rms, predicted = re.findall(r"\d\.\d+e-\d+", capsys.readouterr().out.splitlines()[-1])
    # 19 192 errors: their rms scatters by 0.5 %, the prediction's mean of four draws by half that.
    assert float(rms) < 1.03 * float(predicted)
    assert equipix.load(tmp_path / "cal.tif").converged


@pytest.mark.long
def test_the_plan_of_the_examples_comes_true(capsys):
    runpy.run_path(str(ROOT / "examples/plan.py"), run_name="__main__")
    rms, predicted = re.findall(r"\d\.\d+e-\d+", capsys.readouterr().out.splitlines()[-1])
    # Noise dominates: 10 % of the prediction, and a draw of the tilt that is part of it.
    assert float(rms) == pytest.approx(float(predicted), rel=0.2)

"""tools/same_bytes.py finds a build the same as itself, and sees every kind of difference."""

from __future__ import annotations

import copy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import equipix
import same_bytes

PACKAGES = Path(equipix.__file__).parents[1]
TOOLS = Path(same_bytes.__file__).parent
CASES = ("whole float32", "robust with", "coordinate descent, too few")

ALTERED = """
import dataclasses

_calibrate = globals().get("calibrate") or __getattr__("calibrate")

def calibrate(frames, shifts, **options):
    found = _calibrate(frames, shifts, **options)
    sensitivity = found.sensitivity.copy()
    sensitivity[3, 4] *= 1 + 2e-7
    return dataclasses.replace(found, sensitivity=sensitivity)
"""

RENAMED = """
measure_move = globals().get("measure_shift") or __getattr__("measure_shift")
globals().pop("measure_shift", None)
del _HOMES["measure_shift"]
"""


@pytest.fixture(scope="module")
def outcome():
    build = same_bytes.Build(Path(sys.executable), PACKAGES, TOOLS / "byte_cases.py")
    return same_bytes.run(build, CASES)


def differences(old, new):
    found = same_bytes.compared(old, new)
    return {case: fields for case, fields in found.items() if fields}


def altered(outcome, case, **fields):
    arrays = copy.deepcopy(outcome.arrays)
    arrays[case].update(fields)
    return same_bytes.Outcome(arrays, outcome.notes, outcome.numpy)


def checkout(folder, addition=""):
    """Copies of the installed package, whose first module ends with `addition`, and of tools."""
    shutil.copytree(PACKAGES / "equipix", folder / "python/equipix")
    shutil.copytree(TOOLS, folder / "tools")
    with (folder / "python/equipix/__init__.py").open("a") as file:
        file.write(addition)
    return str(folder)


@pytest.mark.long
def test_a_build_gives_the_same_bytes_as_itself(outcome, tmp_path, capsys):
    own = checkout(tmp_path / "own")
    assert same_bytes.main(["--with-builds", own, own, "--strict", "--only", *CASES]) == 0
    assert "3 cases: 3 same, 0 differ" in capsys.readouterr().out
    assert len(outcome.notes) == 3
    assert all(notes["error"] is None for notes in outcome.notes.values())


@pytest.mark.long
def test_a_build_that_alters_one_value_is_found(tmp_path, capsys):
    folders = [checkout(tmp_path / "old"), checkout(tmp_path / "new", ALTERED)]
    command = ["--with-builds", *folders, "--only", "whole float32", "noise and shifts"]
    assert same_bytes.main(command) == 1
    shown = capsys.readouterr().out
    assert "2 cases: 1 same, 1 differ" in shown
    # 2e-7 rounds to one or two spacings of float32, 2⁻²³ or 2⁻²⁴ each.
    (line,) = [line for line in shown.splitlines() if "sensitivity" in line]
    assert "1 of 2240 values" in line
    assert 2**-24 <= float(line.split("relative ")[1].split(",")[0]) <= 2 * 2**-23
    assert same_bytes.main([*command, "--allow", "sensitivity"]) == 0


@pytest.mark.long
def test_each_build_runs_the_cases_of_its_own_checkout(tmp_path, capsys):
    """The name of a function differs, the results do not."""
    old, new = checkout(tmp_path / "old"), checkout(tmp_path / "new", RENAMED)
    command = ["--with-builds", old, new, "--only", "noise and shifts"]
    assert same_bytes.main(command) == 1
    assert "has no attribute 'measure_shift'" in capsys.readouterr().out
    cases = tmp_path / "new/tools/byte_cases.py"
    text = cases.read_text().replace("equipix.measure_shift", "equipix.measure_move")
    cases.write_text(text)
    assert same_bytes.main(command) == 0
    assert "1 cases: 1 same, 0 differ" in capsys.readouterr().out
    cases.write_text(text.replace('"plans": plans', '"more noise and shifts": noise_and_shifts'))
    assert same_bytes.main(command) == 1
    shown = capsys.readouterr().out
    assert "2 cases: 1 same, 1 differ" in shown
    assert "case: only in the new" in shown
    assert same_bytes.main([*command, "--allow", "case"]) == 0


def test_a_case_that_one_build_lacks_is_a_difference(outcome):
    case = "whole float32"
    notes = {name: each for name, each in outcome.notes.items() if name != case}
    fewer = same_bytes.Outcome(outcome.arrays, notes, outcome.numpy)
    assert differences(outcome, fewer) == {case: {"case": "only in the old"}}
    assert differences(fewer, outcome) == {case: {"case": "only in the new"}}


def test_results_become_arrays_by_the_names_of_their_parts(monkeypatch):
    monkeypatch.setitem(same_bytes.FIELDS, "Given", "first:renamed second none")
    given = type("Given", (), {"renamed": 1.5, "second": {"a": 1, "b": [2]}, "none": None})()
    found = same_bytes.collected({"": given, "more": [given, np.arange(3)]})
    wanted = {"first": 1.5, "second 0": 1, "second 1": [2]}
    within = {f"more 0 {name}": value for name, value in wanted.items()} | {"more 1": [0, 1, 2]}
    assert {name: array.tolist() for name, array in found.items()} == wanted | within
    with pytest.raises(TypeError):
        same_bytes.collected({"unknown": object()})


@pytest.mark.parametrize("field", same_bytes.COMPARED)
def test_a_difference_in_any_field_is_found(outcome, field):
    case = "robust with a noise model"
    if field == "dark":
        new = altered(outcome, case, dark=np.zeros((40, 56)))
    else:
        array = outcome.arrays[case][field].copy()
        array.reshape(-1).view(np.uint8)[0] ^= 1
        new = altered(outcome, case, **{field: array})
    assert list(differences(outcome, new)) == [case]
    assert list(differences(outcome, new)[case]) == [field]


def test_warnings_are_compared_by_category_and_text(outcome):
    case = "coordinate descent, too few sweeps"
    ((category, text),) = outcome.notes[case]["warnings"]
    for pairs, fields in (
        ([], ["warnings", "texts"]),
        ([("UserWarning", text)], ["warnings"]),
        ([(category, text + "!")], ["texts"]),
    ):
        notes = outcome.notes | {case: {"warnings": pairs, "error": None}}
        new = same_bytes.Outcome(outcome.arrays, notes, outcome.numpy)
        assert list(differences(outcome, new)[case]) == fields


def test_an_error_is_a_difference_even_in_both(outcome):
    case = "whole float32"
    arrays = {name: fields for name, fields in outcome.arrays.items() if name != case}
    notes = outcome.notes | {case: {"warnings": [], "error": "InputError: no light"}}
    failed = same_bytes.Outcome(arrays, notes, outcome.numpy)
    assert "InputError" in differences(outcome, failed)[case]["error"]
    assert differences(failed, failed) == {case: {"error": "in both: InputError: no light"}}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ([1.0, 2.0], [1.0, 2.0], None),
        ([1.0, np.nan], [1.0, np.nan], None),
        ([1.0, 2.0], [1.0, 2.5], "relative 2.0e-01, 1 of 2 values"),
        ([1.0, 2.0], [1.0, np.nan], "relative 0.0e+00, 0 of 2 values, 1 more not finite in one"),
        ([0.0, 1.0], [-0.0, 1.0], "signs of zeros or bits of NaN alone"),
        ([1, 2, 3], [1, 0, 0], "2 of 3 values"),
        ([1.0], [[1.0]], "float64 (1,) -> float64 (1, 1)"),
        ([1.0], [1], "float64 (1,) -> int64 (1,)"),
        (["a"], ["b", "c"], "['a'] -> ['b', 'c']"),
    ],
)
def test_differences_are_told_in_words(old, new, words):
    assert same_bytes.difference(np.array(old), np.array(new)) == words


def test_standard_deviations_count_with_strict_alone():
    found = {"whole": {"tilt_std": "relative 1.0e-03, 2 of 2 values"}}
    assert same_bytes.table(found, same_bytes.REPORTED)[1] == 0
    text, faults = same_bytes.table(found, [])
    assert faults == 1
    assert "tilt_std: relative 1.0e-03" in text


def test_a_folder_without_a_package_is_refused(tmp_path, capsys):
    assert same_bytes.main(["--with-builds", str(tmp_path), str(tmp_path)]) == 2
    assert "expected a folder that holds python/equipix" in capsys.readouterr().err


def test_a_folder_without_cases_is_refused(tmp_path, capsys):
    own = checkout(tmp_path)
    (tmp_path / "tools/byte_cases.py").unlink()
    assert same_bytes.main(["--with-builds", own, own]) == 2
    assert "expected a folder that holds tools/byte_cases.py" in capsys.readouterr().err


def test_an_unknown_commit_is_refused_before_anything_is_built(capsys):
    assert same_bytes.main(["no-such-commit", "HEAD"]) == 2
    assert capsys.readouterr().err == "'no-such-commit' is no commit of this repository\n"


def test_help_names_the_options():
    command = [sys.executable, same_bytes.__file__, "--help"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for option in ("--with-builds", "--only", "--allow", "--strict"):
        assert option in shown

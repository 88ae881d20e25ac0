"""Errors as JSON, the steps of the work, and completion of a shell."""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys

import numpy as np
import pytest

import equipix
from equipix import cli, simulate


@pytest.fixture
def frames(tmp_path):
    """A file of three frames."""
    path = tmp_path / "frames.npy"
    np.save(path, np.random.default_rng(1).poisson(100, (3, 20, 30)).astype(np.uint16))
    return path


class TestJson:
    @pytest.mark.parametrize(
        ("arguments", "status", "code", "words"),
        [
            (("inspect", "none.tif"), 1, "file", "none.tif: does not exist"),
            (("average", "FRAMES", "-o", "OUT.png"), 1, "input", "ends in '.png', expected"),
            (
                ("average", "FRAMES", "-o", "OUT.npz", "--reject", "-1"),
                1,
                "input",
                "--reject is -1",
            ),
            (("average", "FRAMES"), 2, "usage", "Missing option"),
            (("average", "FRAMES", "--foo"), 2, "usage", "No such option: --foo"),
            (
                ("average", "FRAMES", "-o", "OUT.npz", "--workers", "x"),
                2,
                "usage",
                "--workers is 'x', expected a whole number (see equipix average --help)",
            ),
            (
                ("average", "FRAMES", "-o", "OUT.npz", "--workers", "0"),
                2,
                "usage",
                "--workers is '0', expected at least 1 (see equipix average --help)",
            ),
            (
                ("simulate", "-o", "OUT", "--bit-depth", "20"),
                2,
                "usage",
                "--bit-depth is '20', expected at most 16 (see equipix simulate --help)",
            ),
            (
                ("init", "foo"),
                2,
                "usage",
                "kind is 'foo', expected one of 'experiment', 'levels', 'camera', 'limits' (see",
            ),
            (("average", "--force=3"), 2, "usage", "not take a value (see equipix average --help)"),
            (("averag", "FRAMES"), 2, "usage", "Did you mean 'average'? (see equipix --help)"),
            (("nuc", "fot"), 2, "usage", "Did you mean 'fit'? (see equipix nuc --help)"),
        ],
    )
    def test_an_error_is_one_object(self, run, frames, tmp_path, arguments, status, code, words):
        given = [each.replace("FRAMES", str(frames)) for each in arguments]
        given = [each.replace("OUT", str(tmp_path / "out")) for each in given]
        found = run(*given, "--json")
        assert found[:2] == (status, "")
        told = json.loads(found[2])
        assert set(told) == {"error", "code"}
        assert told["code"] == code
        assert words in told["error"]
        assert run(*given) == (status, "", f"equipix: error: {told['error']}\n")
        assert not re.search("Value error|Input|Invalid", told["error"])
        assert sorted(each.name for each in tmp_path.iterdir()) == ["frames.npy"]

    def test_an_object_stands_behind_warnings(self, run, tmp_path):
        frames = np.full((3, 20, 30), 65535, np.uint16)
        np.save(tmp_path / "full.npy", frames)
        given = ("average", tmp_path / "full.npy", "-o", tmp_path / "a.npz", "--json")
        status, out, err = run(*given)
        assert status == 0
        assert json.loads(out)["findings"]
        assert err.startswith("equipix: warning: ")
        *_, last = run(*given)[2].splitlines()
        assert json.loads(last)["code"] == "file"

    def test_a_figure_beyond_its_limit_has_failed(self, run, tmp_path):
        pytest.importorskip("matplotlib")
        flat = equipix.Polynomial(np.ones((2, 20, 30)), np.ones((20, 30), np.uint32))
        flat.save(tmp_path / "flat.npz")
        (tmp_path / "limits.toml").write_text("[correction]\nflagged_share = 0.0\n")
        given = ("--limits", tmp_path / "limits.toml", "--check", "--json")
        status, out, err = run("report", tmp_path / "flat.npz", "-o", tmp_path / "r.html", *given)
        assert status == 1
        assert json.loads(out)["verdicts"] == {str(tmp_path / "flat.npz"): "FAIL"}
        assert json.loads(err)["code"] == "failed"

    def test_no_memory_has_a_code(self, run, frames, tmp_path, monkeypatch):
        def exhausted(*_, **__):
            raise MemoryError

        monkeypatch.setattr("equipix.measured.average.frame_files", exhausted)
        status, _, err = run("average", frames, "-o", tmp_path / "a.npz", "--json")
        assert status == 1
        assert json.loads(err)["code"] == "memory"

    def test_it_may_stand_anywhere_on_the_line(self, run):
        wanted = 1, "", '{"error": "none.tif: does not exist", "code": "file"}\n'
        for given in (("--json", "inspect"), ("inspect", "--json"), ("-v", "--json", "inspect")):
            assert run(*given, "none.tif") == wanted
        status, _, err = run("nuc", "--json", "fit", "none.toml", "-o", "o.tif")
        assert (status, json.loads(err)["code"]) == (1, "file")
        for given in (("nuc", "--json"), ("--json",)):
            status, out, err = run(*given)
            assert (status, out, json.loads(err)["code"]) == (2, "", "usage")

    def test_behind_two_dashes_it_is_a_name(self, run):
        status, out, err = run("inspect", "--", "--json")
        assert (status, out, err.split("ends")[0]) == (1, "", "equipix: error: --json: ")
        assert json.loads(run("--json", "inspect", "--", "--json")[2])["code"] == "input"

    @pytest.mark.parametrize("given", [("--json",), ()])
    def test_ctrl_c_has_a_code(self, run, frames, tmp_path, monkeypatch, given):
        def stopped(*_, **__):
            raise KeyboardInterrupt

        monkeypatch.setattr("equipix.measured.average.frame_files", stopped)
        status, out, err = run("average", frames, "-o", tmp_path / "a.npz", *given)
        assert (status, out) == (130, "")
        told = {"error": "stopped by Ctrl-C", "code": "interrupted"}
        line = json.dumps(told) if given else "equipix: error: stopped by Ctrl-C"
        assert err == f"{line}\n"

    def test_without_it_an_error_is_a_line(self, run):
        assert run("inspect", "none.tif")[2] == "equipix: error: none.tif: does not exist\n"


class TestVerbose:
    def test_the_steps_go_to_stderr(self, run, frames, tmp_path):
        given = ("average", frames, "-o", tmp_path / "a.npz", "--force", "--json")
        quiet = run(*given)
        status, out, err = run(*given, "-v")
        assert (status, out, quiet[2]) == (0, quiet[1], "")
        assert "averaged 3 frames of 20 × 30 pixels" in err
        assert "saturation level 65535.0, no dark subtracted" in err
        assert f"wrote {tmp_path / 'a.npz'}: frame statistics" in err
        assert all(line.startswith("equipix: info: ") for line in err.splitlines())
        twice = run(*given, "-vv")[2]
        assert f"reads {frames}" in twice
        assert "equipix: debug: " in twice
        for before in ("-v", "-vv"):
            assert "averaged 3 frames" in run(before, *given)[2]
        assert "equipix: debug: " in run("-v", *given, "-v")[2]
        # The next call is quiet again.
        assert run(*given) == quiet

    @pytest.mark.parametrize("called", [("nuc", "fit"), ("plan",), ("init",), ("nuc",), ()])
    def test_every_command_has_it(self, run, called):
        assert "--verbose" in run(*called, "--help")[1]

    def test_python_has_a_logger(self, frames, caplog):
        with caplog.at_level(logging.INFO, "equipix"):
            average = equipix.average(frames)
            equipix.nuc.fit([average.mean, average.mean * 2.0], order=1)
        assert "averaged 3 frames" in caplog.text
        assert "fits 2 levels of 20 × 30 pixels by order 1" in caplog.text

    @pytest.mark.parametrize("uncertainty", [False, True])
    def test_standard_deviations_are_named_when_they_begin(self, uncertainty, caplog):
        sensitivity = simulate.cosine_sensitivity((48, 48), rng=1)
        beam = simulate.gaussian_beam((48, 48), width=60)
        shifts = equipix.cross_pattern(5, 7)
        frames = simulate.exposures(sensitivity, beam, shifts)
        with caplog.at_level(logging.INFO, "equipix"):
            equipix.calibrate(frames, shifts, variance=np.full(5, 1e-6), uncertainty=uncertainty)
        said = [each.message.partition(" ")[0] for each in caplog.records]
        assert said == ["fitted:", *(["computes"] if uncertainty else [])]

    def test_nothing_is_printed_unless_asked_for(self, frames, capfd):
        equipix.average(frames)
        assert capfd.readouterr() == ("", "")
        assert any(
            isinstance(each, logging.NullHandler) for each in logging.getLogger("equipix").handlers
        )


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("equipix cali", {"calibrate"}),
        ("equipix calibrate --tol", {"--tolerance"}),
        ("equipix nuc ", {"fit", "defects", "quality"}),
        ("equipix nuc fit --ord", {"--order"}),
        ("equipix init l", {"levels", "limits"}),
    ],
)
def test_a_shell_completes(words, wanted):
    environment = os.environ | {
        "_EQUIPIX_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split(" ")) - 1),
    }
    command = [sys.executable, "-m", "equipix"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == wanted


def test_the_completion_of_a_shell_is_shown(capsys, monkeypatch):
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    with pytest.raises(SystemExit) as done:
        cli.main(["--show-completion", "bash"])
    assert done.value.code == 0
    assert "_EQUIPIX_COMPLETE=complete_bash" in capsys.readouterr().out


WITHOUT = """
import sys
from equipix.cli import main

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in {"matplotlib", "astropy", "h5py"}:
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Missing())
for command in sys.argv[1:]:
    try:
        main(command.split(" "))
    except SystemExit:
        pass
"""


def test_a_file_that_does_not_exist_is_said_before_a_library_is(tmp_path):
    (tmp_path / "there.fits").touch()
    commands = {
        "inspect none.fits": "none.fits: does not exist",
        "inspect none.nxs": "none.nxs: does not exist",
        "inspect there.fits": "FITS files need astropy",
        "inspect none.tif -o a.png": "none.tif: does not exist",
        "compare none.tif none.tif -o a.png": "none.tif: does not exist",
        "scene none.tif -o a.tif --picture a.png": "none.tif: does not exist",
        "demo -o a.png": "pictures need matplotlib",
    }
    called = [sys.executable, "-c", WITHOUT, *commands]
    done = subprocess.run(called, cwd=tmp_path, capture_output=True, text=True, check=True)
    for line, words in zip(done.stderr.splitlines(), commands.values(), strict=True):
        assert words in line

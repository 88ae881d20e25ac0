"""The commands combine, lens and bolometer do what Python does."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import equipix
from equipix import bolometer, hardware, lens, metrics, simulate
from equipix.io.frames import header, read_frames
from equipix.io.tiff import write_frames
from equipix.report.maps import maps_of

SHAPE = (48, 64)
NOISE = 3.0


def write(path, light, count=16):
    """Write frames of 12 bits with noise."""
    rng = np.random.default_rng(int(np.mean(light)))
    frames = np.rint(light + NOISE * rng.standard_normal((count, *np.shape(light))))
    write_frames(path, frames.clip(0, 4095).astype(np.uint16), nbytes=2 * frames.size)
    return path


@pytest.mark.parametrize("command", ["combine", "lens", "bolometer", "init"])
def test_help_has_an_example(run, command):
    status, out, _ = run(command, "--help")
    assert status == 0
    assert f"Example: equipix {command} " in out


class TestCombine:
    @pytest.mark.parametrize("dark", [True, False])
    def test_old_curves_and_the_shutter_of_today(self, run, tmp_path, monkeypatch, dark):
        """The recipe of docs/infrared.md, as it stands there."""
        monkeypatch.chdir(tmp_path)
        rng = np.random.default_rng(1)
        gain, offset = 1 + 0.05 * rng.standard_normal(SHAPE), 200 + 20 * rng.standard_normal(SHAPE)
        drift = 15 * rng.standard_normal(SHAPE)
        text = "[sensor]\nbit_depth = 12\n"
        for level in (500, 1500, 3000):
            write(tmp_path / f"{level}.tif", offset + gain * level)
            text += f'[[level]]\nframes = "{level}.tif"\n'
        if dark:
            write(tmp_path / "dark.tif", offset)
            text += '[dark]\nframes = "dark.tif"\n'
        (tmp_path / "levels.toml").write_text(text)
        assert run("nuc", "fit", "levels.toml", "-o", "curves.tif")[0] == 0
        write(tmp_path / "shutter.tif", offset + drift + gain * 1000)
        write(tmp_path / "raw.tif", offset + drift + gain * 2000)
        (tmp_path / "today.toml").write_text('[[level]]\nframes = "flat.tif"\n')
        assert run("correct", "curves.tif", "shutter.tif", "-o", "flat.tif")[0] == 0
        assert run("nuc", "fit", "today.toml", "--order", "0", "-o", "today.tif")[0] == 0
        status, out, err = run("combine", "curves.tif", "today.tif", "-o", "now.tif", "--json")
        assert (status, err) == (0, "")
        assert json.loads(out)["degree"] == 1
        spread = {}
        for name in ("curves", "now"):
            assert run("correct", f"{name}.tif", "raw.tif", "-o", f"by-{name}.tif")[0] == 0
            spread[name] = read_frames(f"by-{name}.tif").mean(axis=0).std()
        assert spread["curves"] > 14
        # Two means of 16 frames, and the curves' error, which is less.
        assert spread["now"] < NOISE * np.sqrt(3 / 16) * (1 + 3 / np.sqrt(2 * gain.size))
        inputs = equipix.load("now.tif").metadata["inputs"]
        assert {"curves.tif", "today.tif"} <= set(inputs)

    def test_is_what_python_combines(self, run, tmp_path):
        ramp = np.linspace(0.9, 1.1, 24).reshape(4, 6)
        levels = [equipix.average((level * ramp)[None]) for level in (100.0, 1000.0)]
        first = equipix.nuc.fit(levels)
        then = equipix.Polynomial(np.stack([0 * ramp, ramp]), np.zeros((4, 6), np.uint32))
        first.save(tmp_path / "a.npz")
        then.save(tmp_path / "b.npz")
        out = tmp_path / "c.npz"
        assert run("combine", tmp_path / "a.npz", tmp_path / "b.npz", "-o", out)[0] == 0
        wanted = equipix.combine(first, then)
        assert equipix.load(out).coefficients.tobytes() == wanted.coefficients.tobytes()
        status, _, err = run("combine", out, tmp_path / "b.npz", "-o", tmp_path / "d.npz")
        assert status == 1
        assert f"{out} was combined with {tmp_path / 'b.npz'} already, which would be" in err

    def test_says_what_limits_the_two(self, run, tmp_path):
        """Such as a lens that was fitted to frames with their dark."""
        flat = 1000 * np.ones((16, 20))
        equipix.nuc.fit([flat, 2 * flat]).save(tmp_path / "curves.npz")
        rows, cols = np.mgrid[:16, :20]
        light = 3000 / (1 + ((rows - 8) ** 2 + (cols - 9) ** 2) / 400) ** 2
        write(tmp_path / "flat.tif", light + 100)
        assert run("lens", tmp_path / "flat.tif", "-o", tmp_path / "lens.npz")[0] == 0
        given = (tmp_path / "curves.npz", tmp_path / "lens.npz", "-o", tmp_path / "both.npz")
        status, printed, err = run("combine", *given)
        assert status == 0
        assert "equipix: warning: no dark was subtracted from frames of whole numbers" in err
        assert re.search(r"findings +raw", printed)

    def test_refuses_what_python_refuses(self, run, tmp_path):
        for name, size in (("a", 4), ("b", 5)):
            flat = equipix.Polynomial(np.ones((2, size, 6)), np.zeros((size, 6), np.uint32))
            flat.save(tmp_path / f"{name}.npz")
        out = tmp_path / "c.npz"
        status, printed, err = run("combine", tmp_path / "a.npz", tmp_path / "b.npz", "-o", out)
        assert (status, printed) == (1, "")
        assert "'first' is of shape (4, 6), 'then' of (5, 6)" in err
        assert not out.exists()


class TestLens:
    @pytest.fixture
    def light(self):
        rows, cols = np.mgrid[:120, :160]
        return 3000 * (1 + ((rows - 62) ** 2 + (cols - 75) ** 2) / 300**2) ** -2.0

    def test_is_what_python_fits(self, run, tmp_path, light):
        flat, dark = (
            write(tmp_path / "flat.tif", light + 100),
            write(tmp_path / "dark.tif", 0 * light + 100),
        )
        out = tmp_path / "lens.tif"
        status, printed, err = run("lens", flat, "--dark", dark, "-o", out, "--json")
        assert (status, err) == (0, "")
        told = json.loads(printed)
        mean = equipix.average(flat, dark=equipix.average(dark)).mean
        found = lens.fit(mean)
        assert (told["law"], told["findings"]) == ("cos4", [])
        assert told["focal_length"] == found.focal_length
        assert told["std"] == found.std
        assert told["focal_length"] == pytest.approx(300, abs=5 * found.std["focal_length"])
        saved = equipix.load(out)
        assert saved.coefficients.tobytes() == found.correction().coefficients.tobytes()
        assert len(saved.metadata["inputs"]) == 2

    def test_a_flat_without_a_dark_is_a_finding(self, run, tmp_path, light):
        flat, out = write(tmp_path / "flat.tif", light + 100), tmp_path / "lens.tif"
        status, printed, err = run("lens", flat, "-o", out, "--law", "radial", "--json")
        assert status == 0
        assert err.startswith("equipix: warning: no dark was subtracted")
        assert [each["kind"] for each in json.loads(printed)["findings"]] == ["raw"]
        assert [each.kind for each in equipix.load(out).findings] == ["raw"]
        assert {"k1", "k2"} <= set(json.loads(printed))

    def test_a_flat_that_is_corrected_already_is_a_finding(self, run, tmp_path, light):
        np.save(tmp_path / "flat.npy", light ** (1 / 1000))
        given = (tmp_path / "flat.npy", "-o", tmp_path / "lens.tif", "--json")
        status, printed, err = run("lens", *given)
        found = lens.fit(light ** (1 / 1000))
        assert status == 0
        assert [each["kind"] for each in json.loads(printed)["findings"]] == ["falloff"]
        focal, error = found.focal_length, found.std["focal_length"]
        assert f"f is {focal:.4g} ± {error:.2g} pixels by noise alone" in err
        err = run("lens", *given, "--force", "--law", "radial")[2]
        assert "too weak to determine a law, and large scales" in err

    def test_figures_have_units_and_the_map_is_the_gain(self, run, tmp_path, light):
        np.save(tmp_path / "flat.npy", light)
        assert run("lens", tmp_path / "flat.npy", "-o", tmp_path / "lens.tif")[0] == 0
        saved = equipix.load(tmp_path / "lens.tif")
        assert [each.name for each in maps_of(saved)] == ["Gain of the correction"]
        status, printed, _ = run("inspect", tmp_path / "lens.tif")
        table = dict(re.split(r"  +", line, maxsplit=1) for line in printed.splitlines())
        assert status == 0
        assert table["focal length"] == "300 pixels"
        assert table["centre (row, col)"] == "62, 75 pixels"
        least = light.min() / 3000
        assert table["least illumination, relative to the centre"] == f"{least:.4g}"
        assert "focal length" in table["standard errors"]
        assert table["degree of the correction in raw values"] == "1"

    def test_the_gain_of_the_sensor_is_taken_out(self, run, tmp_path, light):
        rng = np.random.default_rng(1)
        gain = 1 + 0.1 * rng.standard_normal(light.shape)
        shifts = equipix.cross_pattern(5, 7)
        beam = simulate.gaussian_beam(light.shape)
        cal = equipix.calibrate(simulate.exposures(gain, beam, shifts), shifts)
        cal.save(tmp_path / "cal.tif")
        np.save(tmp_path / "flat.npy", light * gain)
        out, given = tmp_path / "lens.tif", ("--sensitivity", tmp_path / "cal.tif")
        assert run("lens", tmp_path / "flat.npy", "-o", out, *given)[0] == 0
        assert equipix.load(out).metadata["focal_length"] == pytest.approx(300, rel=1e-3)
        assert len(equipix.load(out).metadata["inputs"]) == 2


CELSIUS = (-20.0, 0.0, 20.0, 40.0, 60.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A file for each state of a shutter and of two black bodies."""
    folder = tmp_path_factory.mktemp("bolometer")
    array = simulate.BolometerArray.of((24, 32), rng=1)
    for k, celsius in enumerate(CELSIUS):
        for name, scene in (("shutter", None), ("cold", 0.0), ("hot", 40.0)):
            np.save(folder / f"{name}{k}.npy", array.mean(celsius, scene_c=scene))
    return folder


class TestBolometer:
    def command(self, folder, out, *more, celsius="-20 0 20, 40 60"):
        files = sorted(folder.glob("shutter*.npy"))
        return ("bolometer", *files, "--substrate-c", celsius, "--bias-v", "2", "-o", out, *more)

    def test_is_what_python_fits(self, run, folder, tmp_path):
        out = tmp_path / "dynamic.npz"
        bodies = ("--cold", folder / "cold*.npy", "--hot", folder / "hot*.npy", "--order", "2")
        status, printed, err = run(*self.command(folder, out, *bodies, "--json"))
        assert (status, err) == (0, "")
        stacks = [
            [equipix.average(folder / f"{name}{k}.npy") for k in range(5)]
            for name in ("shutter", "cold", "hot")
        ]
        wanted = bolometer.fit(
            stacks[0], CELSIUS, 2.0, black_bodies=(stacks[1], stacks[2]), order=2
        )
        saved = equipix.load(out)
        for name in ("offset", "gain", "level"):
            assert getattr(saved, name).tobytes() == getattr(wanted, name).tobytes()
        told = json.loads(printed)
        assert [each["substrate_c"] for each in told["states"]] == list(CELSIUS)
        for name in ("shutter", "cold", "hot"):
            assert told["states"][3][name] == str(folder / f"{name}3.npy")
        assert saved.metadata["states"] == told["states"]
        assert len(saved.metadata["inputs"]) == 15

    def test_chooses_the_order_and_prints_the_errors_of_each(self, run, folder, tmp_path):
        out = tmp_path / "dynamic.npz"
        status, printed, _ = run(*self.command(folder, out, "--regressor", "inverse"))
        saved = equipix.load(out)
        assert status == 0
        assert saved.axes.regressor == "inverse"
        assert saved.gain is None
        table = dict(re.split(r"  +", line, maxsplit=1) for line in printed.splitlines())
        errors = table["rms errors of predicted offsets, order 0 and up"]
        wanted = np.sqrt(saved.metadata["prediction_errors"])
        assert errors == ", ".join(f"{each:.6g}" for each in wanted) + " DN"
        assert table["dead pixels"] == "not determinable without black bodies"
        assert "temperature of the substrate -20 °C, bias 2 V" in table["states"]

    def test_a_black_body_in_another_order_is_named_as_its_option(self, run, folder, tmp_path):
        out = tmp_path / "dynamic.npz"
        bodies = {name: sorted(folder.glob(f"{name}*"), reverse=True) for name in ("cold", "hot")}
        more = [word for name, files in bodies.items() for file in files for word in (name, file)]
        more = [f"--{each}" if isinstance(each, str) else each for each in more]
        status, _, err = run(*self.command(folder, out, *more, "--order", "2"))
        assert status == 0
        assert "--cold at state 0 has the pattern of 'shutter' at state 4" in err

    def test_corrects_frames_at_a_state(self, run, folder, tmp_path):
        out, frames = tmp_path / "dynamic.npz", folder / "hot2.npy"
        assert run(*self.command(folder, out, "--order", "2"))[0] == 0
        done = tmp_path / "done.tif"
        state = ("--substrate-c", "20", "--bias-v", "2")
        status, printed, err = run("correct", out, frames, "-o", done, *state, "--json")
        assert (status, err) == (0, "")
        told = json.loads(printed)
        assert told["unit"] == "DN"
        wanted = equipix.load(out).correction(20, 2).correct(np.load(frames).astype(np.float32))
        np.testing.assert_array_equal(read_frames(done)[0], wanted)
        assert "substrate_c 20, bias_v 2" in header(done).description
        equipix.Polynomial(np.ones((2, 24, 32)), np.zeros((24, 32), np.uint32)).save(
            tmp_path / "plain.npz"
        )
        no = tmp_path / "no.tif"
        for words, *given in (
            ("give the state (--substrate-c)", out, frames),
            ("--substrate-c is missing, but", out, frames, "--bias-v", "2"),
            ("--substrate-c is 90 °C, but the references cover", out, frames, *state[:1], "90"),
            ("--substrate-c is given, but", tmp_path / "plain.npz", frames, *state[:2]),
        ):
            status, _, err = run("correct", *given, "-o", no)
            assert (status, words in err, no.exists()) == (1, True, False), err

    def test_other_commands_take_a_state_too(self, run, folder, tmp_path):
        out, plain = tmp_path / "dynamic.npz", tmp_path / "plain.npz"
        bodies = ("--cold", folder / "cold*.npy", "--hot", folder / "hot*.npy", "--order", "2")
        assert run(*self.command(folder, out, *bodies))[0] == 0
        equipix.Polynomial(
            np.stack([np.zeros((24, 32)), np.ones((24, 32))]), np.zeros((24, 32), np.uint32)
        ).save(plain)
        state, at = ("--substrate-c", "20", "--bias-v", "2"), equipix.load(out).correction(20, 2)
        assert run("combine", out, plain, *state, "-o", tmp_path / "both.npz")[0] == 0
        both = equipix.load(tmp_path / "both.npz")
        np.testing.assert_array_equal(both.coefficients, at.coefficients)
        assert run("hardware", out, *state, "-o", tmp_path / "table.bin")[0] == 0
        wanted = hardware.Table.of(at)
        np.testing.assert_array_equal(equipix.load(tmp_path / "table.bin").gain, wanted.gain)
        raw = np.load(folder / "hot2.npy") + np.random.default_rng(1).normal(size=(4, 24, 32))
        np.save(tmp_path / "raw.npy", raw)
        status, printed, _ = run("nuc", "quality", out, tmp_path / "raw.npy", *state, "--json")
        assert status == 0
        assert json.loads(printed)["C"] == metrics.correctability(at.correct(raw)).ratio

    def test_the_commands_of_the_page_run(self, run, folder, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        page = (Path(__file__).parents[2] / "docs/infrared.md").read_text()
        found = re.findall(r"```sh\n(equipix (?:bolometer|correct dynamic)(?:.|\n)*?)```", page)
        assert len(found) == 2
        for name in ("shutter", "cold", "hot"):
            (tmp_path / name).mkdir()
            for k, file in enumerate(sorted(folder.glob(f"{name}*.npy"))):
                frame = np.load(file).astype(np.float32)
                write_frames(tmp_path / name / f"{k}.tif", [frame], nbytes=1)
        (tmp_path / "raw").mkdir()
        write_frames(tmp_path / "raw/a.tif", [frame], nbytes=1)
        for line in found:
            status, _, err = run(*shlex.split(line.replace("\\\n", ""))[1:])
            assert status == 0, err
        assert "substrate_c 21.7, bias_v 2" in header(tmp_path / "corrected/a.tif").description

    def test_asks_for_the_bias_where_several_were_calibrated(self, run, folder, tmp_path):
        out, volts = tmp_path / "dynamic.npz", "1.8 2 2 2 2.2"
        command = [*self.command(folder, out, "--order", "1", "--bias-order", "1")]
        command[command.index("--bias-v") + 1] = volts
        assert run(*command)[0] == 0
        given = ("correct", out, folder / "hot2.npy", "--substrate-c", "20", "-o", tmp_path / "no")
        assert f"--bias-v is missing, but {out} follows it: give its value" in run(*given)[2]

    @pytest.mark.parametrize(
        ("more", "celsius", "words"),
        [
            ((), "0 20", "--substrate-c has 2 entries, expected 5"),
            ((), "warm", "--substrate-c is 'warm', expected numbers such as '0 20 40'"),
            ((), "", "--substrate-c is '', expected numbers"),
            (("--cold", "cold0.npy"), "-20 0 20 40 60", "--cold and --hot give the gain together"),
            (("--order", "high"), "-20 0 20 40 60", "--order is 'high', expected 0 to"),
        ],
    )
    def test_refuses(self, run, folder, tmp_path, more, celsius, words):
        out = tmp_path / "dynamic.npz"
        status, printed, err = run(*self.command(folder, out, *more, celsius=celsius))
        assert (status, printed) == (1, "")
        assert words in err
        assert not out.exists()

    @pytest.mark.parametrize(
        ("bodies", "celsius", "words"),
        [
            ((), "0 20", "--substrate-c has 2 entries, expected 3"),
            (("--cold", "c.npy", "--hot", "h.npy"), "0 20 40", "--cold names 1 files, expected 3"),
        ],
    )
    def test_counts_are_checked_before_files_are_read(
        self, run, tmp_path, monkeypatch, bodies, celsius, words
    ):
        monkeypatch.chdir(tmp_path)
        for name in ("s0.npy", "s1.npy", "s2.npy", "c.npy", "h.npy"):
            (tmp_path / name).write_bytes(b"no frames")
        given = ("--substrate-c", celsius, "--bias-v", "2", "-o", "dynamic.npz", *bodies)
        assert words in run("bolometer", "s0.npy", "s1.npy", "s2.npy", *given)[2]

    def test_a_file_of_two_states_is_refused(self, run, folder, tmp_path):
        one, out = folder / "shutter0.npy", tmp_path / "dynamic.npz"
        given = ("--substrate-c", "0 20", "--bias-v", "2", "-o", out)
        assert "is named twice" in run("bolometer", one, one, *given)[2]

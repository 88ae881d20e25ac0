"""Levels of a uniform source from files: levels.toml, the command line, corrected files."""

from __future__ import annotations

import json
import re
import warnings

import numpy as np
import pytest

import equipix
from equipix import Flag, LevelExperiment, errors, metrics, nuc
from equipix.correction.correct_files import correct_files, picture
from equipix.io import frames as images
from equipix.io import tiff
from equipix.io.frames import header, read_frames
from equipix.io.png import write_png
from equipix.io.tiff import write_frames
from equipix.simulate import StaringArray

SHAPE = (24, 32)
LIGHT = (3e6, 7e6, 11e6, 15e6)


def kinds_of(out):
    """Kinds of the findings in what a command has printed as JSON."""
    return [each["kind"] for each in json.loads(out)["findings"]]


@pytest.fixture(scope="module")
def array():
    return StaringArray.of("InSb", SHAPE, rng=1)


@pytest.fixture(scope="module")
def folder(array, tmp_path_factory):
    """Frames of four levels and of a dark, and their description."""
    folder = tmp_path_factory.mktemp("levels")
    for number, light in enumerate((0.0, *LIGHT)):
        frames = list(array.frames(light, 16, rng=number))
        name = f"level{number}.tif" if number else "dark.tif"
        write_frames(folder / name, iter(frames), nbytes=1)
    levels = "".join(
        f'[[level]]\nframes = "level{number}.tif"\nvalue = {10 * number}\nunit = " °C"\n'
        for number in range(1, 5)
    )
    head = '[sensor]\nname = "array 7"\nbit_depth = 14\n'
    (folder / "raw.toml").write_text(head + levels, encoding="utf-8")
    dark = '[dark]\nframes = "dark.tif"\n'
    (folder / "levels.toml").write_text(head + dark + levels, encoding="utf-8")
    return folder


class TestLevelExperiment:
    def test_gives_the_same_as_averages(self, folder):
        dark = equipix.average(folder / "dark.tif", saturation=16383)
        averages = [
            equipix.average(folder / f"level{number}.tif", dark=dark, saturation=16383)
            for number in range(1, 5)
        ]
        wanted = nuc.fit(averages, order=2)
        response = LevelExperiment.load(folder / "levels.toml").run(order=2)
        for name in ("deviation", "variances", "flags", "levels", "dark", "limits"):
            np.testing.assert_array_equal(getattr(response, name), getattr(wanted, name))
        assert response.saturation == 16383

    def test_says_where_the_response_comes_from(self, folder):
        metadata = LevelExperiment.load(folder / "levels.toml").run().metadata
        assert metadata["sensor"]["name"] == "array 7"
        assert [each["name"] for each in metadata["levels"]] == [
            f"{10 * k} °C" for k in range(1, 5)
        ]
        assert set(metadata["inputs"]) == {
            "levels.toml",
            "dark.tif",
            *(f"level{number}.tif" for number in range(1, 5)),
        }
        assert metadata["noise"]["gain"] > 0
        json.dumps(metadata)

    def test_says_the_gain_without_a_dark(self, tmp_path):
        """The level without light, here 1000 DN, has no photon noise."""
        rng, text = np.random.default_rng(1), "[sensor]\nbit_depth = 14\n"
        for light in (500, 1500, 2500):
            electrons = rng.poisson(np.full((16, *SHAPE), 4 * light))
            frames = np.rint(1000 + electrons / 4 + rng.normal(0, 2, electrons.shape))
            write_frames(tmp_path / f"{light}.tif", iter(frames.astype(np.uint16)), nbytes=1)
            text += f'[[level]]\nframes = "{light}.tif"\n'
        (tmp_path / "raw.toml").write_text(text, encoding="utf-8")
        metadata = LevelExperiment.load(tmp_path / "raw.toml").run().metadata
        assert metadata["noise"]["gain"] == pytest.approx(1 / 4, rel=0.05)

    def test_needs_no_dark(self, folder, array):
        response = LevelExperiment.load(folder / "raw.toml").run(order=2)
        assert response.raw
        assert response.dark is None
        frame = next(array.frames(9e6, 1, rng=77))
        good = (response.flags & Flag.DO_NOT_USE) == 0
        corrected = response.correct(frame)[good]
        noise = array.temporal_noise(9e6).mean()
        # One frame: temporal noise, and a quarter of it from each fit of 4·16 frames.
        assert corrected.std() == pytest.approx(noise, rel=0.15)

    def test_excludes_what_the_file_and_the_caller_mask(self, folder, tmp_path):
        text = (folder / "levels.toml").read_text(encoding="utf-8")
        for number in range(1, 5):
            text = text.replace(f"level{number}.tif", f"{folder}/level{number}.tif")
        text = text.replace('"dark.tif"', f'"{folder}/dark.tif"')
        text = text.replace("bit_depth = 14\n", "bit_depth = 14\nregion = [{rows = [0, 2]}]\n")
        (tmp_path / "levels.toml").write_text(text, encoding="utf-8")
        mask = np.zeros(SHAPE, bool)
        mask[:, :3] = True
        response = LevelExperiment.load(tmp_path / "levels.toml").run(mask=mask)
        wanted = mask.copy()
        wanted[:2] = True
        np.testing.assert_array_equal(np.isnan(response.deviation[0]), wanted)

    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("[[level]]", "[[levels]]", "unknown key 'levels'"),
            ("value = 10", "valeu = 10", "unknown key 'valeu' in [[level]] 1"),
            (
                'value = 10\nunit = " °C"',
                'unit = " °C"',
                "'unit' is given without 'value' in [[level]]",
            ),
            ('"level1.tif"', '"none.tif"', "none.tif: does not exist"),
            ('"level2.tif"', '"level1.tif"', "'level1.tif' stands in 'frames' of level '10 °C'"),
            (
                "value = 10",
                'value = "warm"',
                "'value' in [[level]] 1 holds 'warm', expected a number",
            ),
            (
                'value = 10\nunit = " °C"',
                'value = 283\nunit = "K"',
                "'unit' is 'K' and '°C' in different levels: give all values in one unit",
            ),
        ],
    )
    def test_refuses_a_wrong_file_by_its_place(self, folder, old, new, message):
        text = (folder / "levels.toml").read_text(encoding="utf-8")
        assert old in text
        path = folder / "wrong.toml"
        path.write_text(text.replace(old, new, 1), encoding="utf-8")
        with pytest.raises(errors.FileError) as error:
            LevelExperiment.load(path)
        assert message in str(error.value)

    def test_one_table_in_place_of_many_is_named(self, folder):
        path = folder / "wrong.toml"
        path.write_text('[level]\nframes = "level1.tif"\n')
        with pytest.raises(errors.FileError, match=r"write \[\[level\]\]"):
            LevelExperiment.load(path)

    @pytest.mark.parametrize(
        ("values", "words"),
        [
            ((40, 30, 20, 10), "level '10 °C' to .* in level '20 °C'"),
            ((10, 30, 20, 40), "level '20 °C' to .* in level '30 °C'"),
        ],
    )
    def test_values_that_run_against_the_means_are_told(self, folder, values, words):
        text = (folder / "levels.toml").read_text(encoding="utf-8")
        for number, value in enumerate(values, start=1):
            text = text.replace(f"value = {10 * number}\n", f"value = {value}.0\n")
        (folder / "exchanged.toml").write_text(text, encoding="utf-8")
        with pytest.warns(errors.EquipixWarning, match=f"falls from .* in {words}, whose 'value'"):
            LevelExperiment.load(folder / "exchanged.toml").run()

    def test_a_level_that_saturates_is_named(self, folder, array):
        frames = list(array.frames(3e7, 4, rng=9))
        write_frames(folder / "bright.tif", iter(frames), nbytes=1)
        text = (folder / "raw.toml").read_text(encoding="utf-8").replace("level4", "bright")
        level = min(int(frame.min()) for frame in frames)
        text = text.replace("bit_depth = 14", f"bit_depth = 14\nsaturation = {level}")
        (folder / "bright.toml").write_text(text, encoding="utf-8")
        message = rf"level '40 °C': 100.0% .* {level} DN .* 'saturation'"
        with pytest.raises(errors.FileError, match=message):
            LevelExperiment.load(folder / "bright.toml").run()

    def test_a_bit_depth_that_is_too_low_is_named(self, folder):
        text = (folder / "raw.toml").read_text(encoding="utf-8").replace("= 14", "= 12")
        (folder / "few.toml").write_text(text, encoding="utf-8")
        with pytest.raises(errors.EquipixError, match="'bit_depth'"):
            LevelExperiment.load(folder / "few.toml").run()

    def test_an_order_is_checked_before_the_work(self, folder):
        with pytest.raises(errors.InputError, match="'order' is 7"):
            LevelExperiment.load(folder / "levels.toml").run(order=7)


class TestCommands:
    def test_inspect_tells_the_sensor_and_what_the_levels_were(self, run, folder, tmp_path):
        output = tmp_path / "response.npz"
        assert run("nuc", "fit", folder / "levels.toml", "-o", output)[0] == 0
        told = json.loads(run("inspect", output, "--json")[1])
        assert told["sensor"] == "array 7"
        assert told["level_values"] == ["10 °C", "20 °C", "30 °C", "40 °C"]
        assert [each["value"] for each in told["metadata"]["levels"]] == [10, 20, 30, 40]
        shown = run("inspect", output)[1]
        assert "10 °C, 20 °C, 30 °C, 40 °C" in shown
        assert "array 7" in shown
        levels = ", ".join(f"{each:.6g}" for each in equipix.load(output).levels)
        assert levels in shown

    def test_inspect_tells_names_where_levels_have_no_value(self, run, folder, tmp_path):
        names = '[[level]]\nframes = "{0}/level1.tif"\n[[level]]\nframes = "{0}/level2.tif"\n'
        text = names.format(folder)
        for head, wanted in (("", None), ('name = "dim"\n', ["1", "dim"])):
            (tmp_path / "levels.toml").write_text(text + head, encoding="utf-8")
            response = LevelExperiment.load(tmp_path / "levels.toml").run()
            response.save(tmp_path / "response.npz", force=True)
            told = json.loads(run("inspect", tmp_path / "response.npz", "--json")[1])
            assert told.get("level_values") == wanted
            assert "sensor" not in told

    def test_fit_and_inspect(self, run, folder, tmp_path):
        output = tmp_path / "response.tif"
        status, out, _ = run(
            "nuc", "fit", folder / "levels.toml", "-o", output, "--order", "auto", "--json"
        )
        assert status == 0
        told = json.loads(out)
        wanted = LevelExperiment.load(folder / "levels.toml").run(order="auto")
        assert told["order"] == wanted.order
        assert len(told["prediction_errors"]) == 3
        good = (wanted.flags & Flag.DO_NOT_USE) == 0
        # Beside the median of χ²/f for f degrees of freedom, by its tables: 0.4549, 0.6931, 0.7887.
        freedom = int(np.median(wanted.freedom[good]))
        of_noise = {1: 0.4549, 2: 0.6931, 3: 0.7887}[freedom]
        wanted_chi2 = np.median(wanted.reduced_chi2[good]) / of_noise
        # Wilson and Hilferty's median is good to 4 % at one degree of freedom.
        assert told["reduced_chi2"] == pytest.approx(wanted_chi2, rel=0.04)
        np.testing.assert_array_equal(equipix.load(output).deviation, wanted.deviation)
        assert json.loads(run("inspect", output, "--json")[1])["order"] == wanted.order
        status, out, _ = run("nuc", "fit", folder / "levels.toml", "-o", output, "--force")
        assert status == 0
        assert "spread of the gain deviation K" in out

    def test_by_gain(self, run, folder, tmp_path):
        output = tmp_path / "response.npz"
        arguments = ("nuc", "fit", folder / "levels.toml", "-o", output, "--order", "0")
        status, out, _ = run(*arguments, "--by", "gain", "--json")
        assert status == 0
        assert json.loads(out)["order"] == 0
        response = equipix.load(output)
        assert (response.deviation[0] == 0).all()
        assert response.deviation[1].std() > 0.01

    def test_a_level_that_saturates_without_a_level_given_is_refused(self, run, folder, tmp_path):
        frames = np.full((4, *SHAPE), 16383, np.uint16)
        write_frames(tmp_path / "bright.tif", iter(frames), nbytes=1)
        levels = "".join(f'[[level]]\nframes = "{folder}/level{k}.tif"\n' for k in (1, 2))
        levels += '[[level]]\nframes = "bright.tif"\n'
        (tmp_path / "levels.toml").write_text(levels, encoding="utf-8")
        output = tmp_path / "response.tif"
        status, _, err = run("nuc", "fit", tmp_path / "levels.toml", "-o", output)
        assert (status, output.exists()) == (1, False)
        assert "100.0% of the values of level 2 are exactly 16383" in err

    def test_an_order_that_is_too_low_is_said(self, run, tmp_path):
        array = StaringArray.of("HgCdTe", SHAPE, rng=1)
        text = ""
        for k, light in enumerate((2e6, 5e6, 8e6, 11e6, 14e6)):
            write_frames(tmp_path / f"{k}.tif", array.frames(light, 8, rng=k), nbytes=1)
            text += f'[[level]]\nframes = "{k}.tif"\n'
        (tmp_path / "levels.toml").write_text(text, encoding="utf-8")
        given = ("nuc", "fit", tmp_path / "levels.toml", "-o", tmp_path / "response.tif", "--force")
        status, out, err = run(*given)
        assert status == 0
        assert "warning: curves of order 1" in err
        assert "fit with --order 2 or --order auto" in err
        assert "curves of order" not in run(*given, "--order", "2")[2]
        two = text.split("[[level]]")
        (tmp_path / "levels.toml").write_text("[[level]]".join(two[:3]), encoding="utf-8")
        status, out, _ = run(*given)
        assert re.search(r"reduced χ² +not determined\n", out)
        assert json.loads(run(*given, "--json")[1])["reduced_chi2"] is None

    def test_errors_are_one_line(self, run, folder, tmp_path):
        output = tmp_path / "response.tif"
        assert run("nuc", "fit", folder / "levels.toml", "-o", output, "--order", "5")[0] == 2
        status, out, err = run("nuc", "fit", folder / "none.toml", "-o", output)
        assert (status, out) == (1, "")
        assert err.count("\n") == 1
        assert not output.exists()
        assert run("nuc", "fit", "--help")[0] == 0
        status, out, err = run("nuc")
        # Typer shows the help of a group without a command, by releases as a success or a misuse.
        assert status in (0, 2)
        assert all(command in out + err for command in ("fit", "defects", "quality"))


class TestDefectsAndQuality:
    @pytest.fixture
    def saved(self, folder, tmp_path):
        response = LevelExperiment.load(folder / "levels.toml").run(order=2)
        response.save(tmp_path / "response.tif")
        return response, tmp_path / "response.tif"

    def test_a_dark_of_another_shape_is_blamed_itself(self, run, folder, tmp_path):
        write_frames(folder / "small.tif", iter(np.zeros((4, 8, 9), np.uint16)), nbytes=1)
        text = (folder / "levels.toml").read_text(encoding="utf-8")
        levels = folder / "other.toml"
        levels.write_text(text.replace('"dark.tif"', '"small.tif"'), encoding="utf-8")
        status, _, err = run("nuc", "fit", levels, "-o", tmp_path / "no.tif")
        assert status == 1
        assert re.search(r"small\.tif: holds uint16 frames of shape \(8, 9\), expected", err)

    def test_defects_are_those_of_the_function(self, run, saved, folder, tmp_path):
        response, path = saved
        output = tmp_path / "flagged.npz"
        limits = {
            "response": 0.985,
            "gain": 1.02,
            "noise": 1.05,
            "correlation": 0.1,
            "range": 1.5,
            "misfit": 0.5,
        }
        given = [text for name, each in limits.items() for text in (f"--{name}-limit", str(each))]
        options = ("-o", output, *given, "--json")
        raw = read_frames(folder / "level2.tif")
        raw[::2, 3, 4] += 300  # noise
        raw[:8, 5, 6] += 300  # flicker
        write_frames(folder / "noisy.tif", iter(raw), nbytes=1)
        status, out, _ = run("nuc", "defects", path, folder / "noisy.tif", *options)
        assert status == 0
        wanted = nuc.find_defects(response, raw, limits=nuc.DefectLimits(**limits))
        # Each limit has an effect, so each option is taken.
        assert min(wanted.counts.values()) > 0
        told = json.loads(out)
        assert {name: told[name] for name in wanted.counts} == wanted.counts
        assert told["percentiles_of_K"] == pytest.approx(wanted.gain_percentiles)
        np.testing.assert_array_equal(equipix.load(output).flags, response.flags | wanted.flags)

    def test_frames_are_not_replaced_by_the_flags_found_in_them(self, run, saved, folder):
        raw = folder / "level2.tif"
        content = raw.read_bytes()
        status, _, err = run("nuc", "defects", saved[1], raw, "-o", raw, "--force")
        assert status == 1
        assert "level2.tif: is one of the inputs: name another output" in err
        assert raw.read_bytes() == content

    def test_filters_are_a_key_of_the_file(self, run, tmp_path):
        """Of the three commands `defects` and `quality` alone have an option for them."""
        colour, text = np.tile([[1.0, 2.0], [2.0, 3.0]], (16, 20)), ""
        for light in (500, 1000, 1500):
            frames = light * colour + np.random.default_rng(light).normal(0, 3, (4, *colour.shape))
            write_frames(tmp_path / f"{light}.tif", np.rint(frames).astype(np.uint16), nbytes=1)
            text += f'[[level]]\nframes = "{light}.tif"\n'
        (tmp_path / "levels.toml").write_text("[sensor]\nbit_depth = 14\n" + text)
        out = tmp_path / "r.npz"
        err = run("nuc", "fit", tmp_path / "levels.toml", "-o", out)[2]
        assert "no 'cfa' is given" in err
        assert "(in [sensor] of a manifest)" in err
        assert "--cfa" not in err
        assert "write --cfa RGGB" in run("nuc", "defects", out)[2]

    def test_defects_of_curves_alone(self, run, saved):
        status, out, _ = run("nuc", "defects", saved[1])
        assert status == 0
        assert json.loads(run("nuc", "defects", saved[1], "--json")[1])["output"] is None
        assert "non responding" in out

    def test_quality_is_that_of_the_functions(self, run, saved, folder):
        response, path = saved
        status, out, _ = run("nuc", "quality", path, folder / "level2.tif", "--json")
        assert status == 0
        raw, told = read_frames(folder / "level2.tif"), json.loads(out)
        wanted = metrics.correctability(response.correct(raw))
        assert (told["C"], told["C_from"], told["C_to"]) == pytest.approx(
            (wanted.ratio, wanted.low, wanted.high)
        )
        replaced = response.correct(raw, flagged="replace")
        noise = metrics.three_d_noise(replaced)
        assert told["noise_variances"] == pytest.approx(vars(noise))
        assert told["roughness"] == pytest.approx(
            metrics.roughness(replaced.mean(axis=0, dtype=float))
        )

    def test_quality_has_a_verdict(self, run, array, saved, folder, tmp_path):
        _, path = saved
        fresh = tmp_path / "fresh.tif"
        write_frames(fresh, array.frames(LIGHT[1], 16, rng=50), nbytes=1)
        command = ("nuc", "quality", path)
        told = json.loads(run(*command, fresh, "--confidence", "0.999", "--json")[1])
        assert told["C_from"] < told["C_predicted"] < told["C_to"]
        assert told["verdict"] == "the pattern is that of noise"
        out = run(*command, fresh)[1]
        assert re.search(r"\nspatial variance +\S+ DN²\n", out)
        assert re.search(r"\nC predicted +0\.\d+\n", out)
        # Frames of the fit have noise in common with it.
        told = json.loads(run(*command, folder / "level2.tif", "--json")[1])
        assert told["verdict"].startswith("the pattern is below that of noise: give frames that")
        # Offsets that have drifted are in all pixels; pixels that jumped are few.
        steady = np.stack([*array.frames(LIGHT[1], 16, rng=50)]).astype(np.int64)
        drift = np.rint(40 * np.random.default_rng(1).standard_normal(SHAPE)).astype(np.int64)
        jumped = np.where(np.arange(drift.size).reshape(SHAPE) % 97, 0, 2000)
        for change, words in ((drift, "equipix combine with"), (jumped, "by equipix nuc defects")):
            write_frames(tmp_path / "now.tif", (steady + change).astype(np.uint16), nbytes=1)
            told = json.loads(run(*command, tmp_path / "now.tif", "--json")[1])
            assert words in told["verdict"]
            (tmp_path / "now.tif").unlink()
        plain = tmp_path / "plain.npz"
        coefficients = np.stack([np.zeros(SHAPE), np.ones(SHAPE)])
        equipix.Polynomial(coefficients, np.zeros(SHAPE, np.uint32)).save(plain)
        told = json.loads(run("nuc", "quality", plain, fresh, "--json")[1])
        assert (told["C_predicted"], told["verdict"][:10]) == (None, "not judged")

    @pytest.mark.parametrize("command", ["defects", "quality"])
    def test_another_sensor_is_refused(self, run, saved, folder, command):
        arguments = ("nuc", command, saved[1], folder / "level2.tif", "--sensor")
        assert run(*arguments, "array 7")[0] == 0
        status, out, err = run(*arguments, "array 8")
        assert (status, out) == (1, "")
        assert "'array 8', but the correction is of 'array 7'" in err

    @pytest.mark.parametrize("command", ["defects", "quality"])
    def test_corrected_frames_are_noticed(self, run, saved, folder, tmp_path, command):
        frames, once = folder / "level2.tif", tmp_path / "once.tif"
        assert run("correct", saved[1], frames, "-o", once)[0] == 0
        assert "corrected already" not in run("nuc", command, saved[1], frames)[2]
        status, out, err = run("nuc", command, saved[1], once, "--json")
        assert status == 0
        assert f"{once}: corrected already, by this correction; what both remove is" in err
        assert "corrected" in kinds_of(out)

    @pytest.fixture
    def unsteady(self, folder, tmp_path):
        """Frames whose level drifts by many times the noise of a pixel."""
        raw = read_frames(folder / "level2.tif").astype(np.int64)
        drift = np.arange(len(raw))[:, None, None] * 100
        write_frames(tmp_path / "unsteady.tif", iter((raw + drift).astype(np.uint16)), nbytes=1)
        return tmp_path / "unsteady.tif"

    def test_findings_of_defects_are_saved_and_shown(self, run, saved, unsteady, tmp_path):
        response, path = saved
        outputs = tmp_path / "flagged.npz", tmp_path / "again.npz"
        status, out, err = run("nuc", "defects", path, unsteady, "-o", outputs[0], "--json")
        assert status == 0
        assert "the means of 'frames' scatter by" in err
        loaded = equipix.load(outputs[0])
        assert loaded.findings[: len(response.findings)] == response.findings
        assert [vars(each) for each in loaded.findings] == json.loads(out)["findings"]
        assert kinds_of(out).count("light") == 1
        # Those that the response has already stand there once.
        arguments = ("nuc", "defects", outputs[0], unsteady, "-o", outputs[1])
        status, out, _ = run(*arguments)
        assert equipix.load(outputs[1]).findings == loaded.findings
        assert re.search(r"\nfindings +.*light", out)

    def test_findings_of_quality_are_shown(self, run, saved, unsteady, folder):
        arguments = ("nuc", "quality", saved[1], unsteady)
        assert kinds_of(run(*arguments, "--json")[1]) == ["light"]
        assert re.search(r"\nfindings +light\n", run(*arguments)[1])
        planes = json.loads(run(*arguments, "--cfa", "RGGB", "--json")[1])
        assert {each["kind"] for each in planes["findings"]} == {"light"}
        assert kinds_of(run(*arguments[:3], folder / "level2.tif", "--json")[1]) == []

    def test_files_of_another_kind_are_refused(self, run, saved, folder):
        status, _, err = run("nuc", "quality", saved[1], saved[1])
        assert (status, "expected raw frames" in err) == (1, True)
        mean = saved[1].with_name("mean.npz")
        equipix.average(folder / "level1.tif").save(mean)
        status, _, err = run("nuc", "defects", mean)
        assert (status, "holds frame statistics, expected response" in err) == (1, True)


@pytest.fixture
def corrected(run, folder, tmp_path):
    """A response on disk, and a call that corrects the frames of a level by it."""
    response = LevelExperiment.load(folder / "levels.toml").run()
    response.save(tmp_path / "response.tif")

    def call(output, *options, source="level2.tif"):
        path = tmp_path / output
        status, out, err = run(
            "correct", tmp_path / "response.tif", folder / source, "-o", path, "--json", *options
        )
        assert status == 0, err
        return path, json.loads(out)

    return response, call


class TestCorrectedFiles:
    def test_whole_numbers_are_rounded_and_limited_and_counted(self, corrected, folder):
        response, call = corrected
        values = response.correct(read_frames(folder / "level2.tif"), flagged="replace")
        options = ("--dtype", "uint16", "--bit-depth", "12", "--flagged", "replace")
        path, told = call("out.tif", *options)
        found = read_frames(path)
        assert found.dtype == np.uint16
        np.testing.assert_array_equal(found, np.clip(np.rint(values), 0, 4095))
        wanted = np.count_nonzero((np.rint(values) < 0) | (np.rint(values) > 4095))
        assert wanted > 0
        assert told["limited_values"] == wanted

    def test_large_files_are_read_frame_by_frame(self, corrected, monkeypatch):
        _, call = corrected
        whole, _ = call("whole.tif")
        read = []
        monkeypatch.setattr(images, "_AT_ONCE", 1)
        stream = tiff.stream_frames
        monkeypatch.setattr(
            tiff, "stream_frames", lambda path, *part: read.append(path) or stream(path, *part)
        )
        single, _ = call("single.tif")
        assert len(read) == 1
        np.testing.assert_array_equal(read_frames(single), read_frames(whole))

    def test_the_corrector_gives_the_same(self, corrected, folder):
        response, call = corrected
        path, _ = call("out.tif", "--dtype", "uint16", "--flagged", "replace")
        corrector = equipix.Corrector(response)
        raw = read_frames(folder / "level2.tif")
        np.testing.assert_array_equal(read_frames(path), corrector.apply(raw))

    @pytest.mark.parametrize(("dtype", "largest"), [("uint8", 255), ("uint16", 65535)])
    def test_a_png_of_one_frame(self, corrected, folder, dtype, largest):
        response, call = corrected
        frame = read_frames(folder / "level1.tif")[0]
        write_frames(folder / "one.tif", iter([frame]), nbytes=1)
        path, told = call("out.png", "--dtype", dtype, "--flagged", "replace", source="one.tif")
        found = read_frames(path)[0]
        assert found.dtype == dtype
        wanted = np.clip(np.rint(response.correct(frame, flagged="replace")), 0, largest)
        np.testing.assert_array_equal(found, wanted)
        assert told["dtype"] == dtype

    @pytest.mark.usefixtures("corrected")
    def test_a_png_of_several_frames_or_of_floats_is_refused(self, run, folder, tmp_path):
        arguments = ("correct", tmp_path / "response.tif", folder / "level1.tif")
        status, _, err = run(*arguments, "-o", tmp_path / "out.png")
        assert status == 1
        assert "holds one frame, but 16" in err
        frame = read_frames(folder / "level1.tif")[:1]
        write_frames(tmp_path / "one.tif", iter(frame), nbytes=1)
        arguments = ("correct", tmp_path / "response.tif", tmp_path / "one.tif")
        status, _, err = run(*arguments, "-o", tmp_path / "out.png", "--dtype", "float32")
        assert status == 1
        assert "expected --dtype uint8 or uint16" in err

    def test_files_name_the_correction_by_its_hash(self, corrected, run, tmp_path):
        import hashlib

        _, call = corrected
        path, _ = call("out.tif", "--dtype", "uint16")
        digest = hashlib.sha256((tmp_path / "response.tif").read_bytes()).hexdigest()
        assert header(path).description == f"corrected by equipix, correction sha256 {digest}"
        arguments = ("correct", tmp_path / "response.tif", path, "-o", tmp_path / "again.tif")
        assert "corrected already" in run(*arguments)[2]

    @pytest.mark.parametrize("display", ["linear", "histogram"])
    def test_pictures(self, corrected, folder, display):
        response, call = corrected
        path, _ = call("out.tif", "--display", display, "--flagged", "replace")
        found = read_frames(path)
        assert found.dtype == np.uint8
        values = response.correct(read_frames(folder / "level2.tif"), flagged="replace")
        np.testing.assert_array_equal(found[3], picture(values[3], display))

    def test_a_picture_has_no_other_type(self, corrected, folder, tmp_path):
        response, _ = corrected
        message = "'display' makes pictures of 8 bits, but 'dtype' .* is 'uint16': leave out one"
        with pytest.raises(errors.InputError, match=message):
            correct_files(
                response,
                [str(folder / "level2.tif")],
                tmp_path / "out.tif",
                dtype="uint16",
                display="linear",
            )
        with pytest.raises(errors.InputError, match="but 'bit_depth' .* is 12: leave out one"):
            correct_files(
                response,
                [str(folder / "level2.tif")],
                tmp_path / "out.tif",
                bit_depth=12,
                display="linear",
            )

    def test_values_beyond_the_levels_and_replaced_pixels_are_counted(self, corrected, folder):
        response, call = corrected
        raw = read_frames(folder / "level4.tif")
        good = (response.flags & Flag.DO_NOT_USE) == 0
        _, told = call("out.tif", "--flagged", "nan", source="level4.tif")
        wanted = np.count_nonzero(response.extrapolated(raw) & good)
        # Half of the values of the highest level are above its mean.
        assert wanted > 0.3 * raw.size
        # Values at a level count as within it: eight roundings, and as many of the formula.
        margin = 16 * np.finfo(np.float32).eps * response.limits.max()
        (low, high), values = response.limits, response.correct(raw.astype(np.float64))
        certain = np.count_nonzero((values < low - margin) | (values > high + margin))
        assert certain <= told["extrapolated_values"] <= wanted
        assert "replaced_pixels" not in told
        flags = np.zeros(SHAPE, np.uint32)
        flags[3, 4:6] = Flag.DO_NOT_USE
        response.with_flags(flags).save(folder / "flagged.tif", force=True)
        path = folder / "flagged.tif"
        done = correct_files(
            equipix.load(path), [str(folder / "level4.tif")], folder / "c.tif", flagged="replace"
        )
        assert done.replaced == np.count_nonzero(~good | (flags != 0))

    def test_flagged_pixels_are_counted_apart(self, corrected, run, folder, tmp_path):
        response, _ = corrected
        flags = np.zeros(SHAPE, np.uint32)
        flags[3, 4:6] = Flag.DO_NOT_USE
        two = response.with_flags(flags)
        bad = np.count_nonzero((two.flags & Flag.DO_NOT_USE) != 0)
        source, path = [str(folder / "level2.tif")], tmp_path / "out.tif"
        done = correct_files(two, source, path, dtype="float32", force=True)
        assert (done.limited, done.flagged, done.replaced) == (0, bad, 0)
        assert np.count_nonzero(np.isnan(read_frames(path))) == 16 * bad
        done = correct_files(two, source, path, dtype="uint16", force=True)
        assert (done.limited, done.flagged, done.replaced) == (0, 0, bad)
        with pytest.warns(errors.InputWarning, match="100% of the .* of uint8: .* uint16; or"):
            done = correct_files(two, source, path, dtype="uint8", force=True)
        assert done.limited == 16 * flags.size
        done = correct_files(two, source, path, dtype="float32", flagged="replace", force=True)
        assert (done.limited, done.flagged, done.replaced) == (0, 0, bad)
        two.save(tmp_path / "two.tif")
        arguments = ("correct", tmp_path / "two.tif", *source, "-o", path, "--force", "--json")
        told = json.loads(run(*arguments, "--dtype", "uint16")[1])
        assert (told["limited_values"], told["replaced_pixels"]) == (0, bad)
        status, _, err = run(*arguments, "--dtype", "uint16", "--flagged", "nan")
        assert (status, "which uint16 does not hold: take 'replace'" in err) == (1, True)
        values, black = read_frames(folder / "level2.tif"), 0
        for options in ((), ("--flagged", "nan")):
            assert run(*arguments, "--display", "linear", *options)[0] == 0
            shown = read_frames(path)[0, 3, 4:6]
            wanted = "nan" if options else "replace"
            whole = picture(two.correct(values[0], flagged=wanted), "linear")
            np.testing.assert_array_equal(shown, whole[3, 4:6])
            black += np.count_nonzero(shown == 0)
        assert black == 2

    def test_most_values_limited_is_a_warning_of_the_command(
        self, corrected, run, folder, tmp_path
    ):
        _, call = corrected
        arguments = ("correct", tmp_path / "response.tif", folder / "level2.tif", "-o")
        status, _, err = run(*arguments, tmp_path / "8.tif", "--dtype", "uint8")
        assert (status, "--display linear" in err, err.count("\n")) == (0, True, 1)
        assert run(*arguments, tmp_path / "d.tif", "--display", "linear")[2] == ""
        status, _, err = run(
            *arguments, tmp_path / "b.tif", "--dtype", "uint16", "--bit-depth", "8"
        )
        assert "more bits in --bit-depth" in err
        assert call("16.tif", "--dtype", "uint16")[1]["limited_values"] == 0
        found = [call(f"f{bits}.tif", "--dtype", f"uint{bits}")[1] for bits in (8, 16)]
        assert [[each["kind"] for each in one["findings"]] for one in found] == [["limited"], []]
        status, out, _ = run(*arguments, tmp_path / "8.tif", "--dtype", "uint8", "--force")
        assert re.search(r"\nfindings +limited\n", out)

    def test_one_corrector_corrects_all_files(self, corrected, folder, tmp_path, monkeypatch):
        from equipix.correction import apply as module

        response, _ = corrected
        made, real = [], module.Prepared
        monkeypatch.setattr(
            module, "Prepared", lambda *given, **more: made.append(1) or real(*given, **more)
        )
        source = [str(folder / "level?.tif")]
        done = correct_files(response, source, tmp_path / "all", dtype="uint16")
        assert (done.frames, len(made)) == (64, 1)

    def test_another_sensor_is_refused(self, corrected, run, folder, tmp_path):
        _, call = corrected
        call("out.tif", "--sensor", "array 7")
        arguments = ("correct", tmp_path / "response.tif", folder / "level2.tif", "-o")
        status, _, err = run(*arguments, tmp_path / "no.tif", "--sensor", "array 8")
        assert (status, "'array 8', but the correction is of 'array 7'" in err) == (1, True)

    @pytest.mark.parametrize("name", ["levels.toml", "raw.toml"])
    def test_frames_scaled_to_1_are_refused(self, run, folder, tmp_path, name):
        """They came out as -1503 DN, with status 0."""
        response = LevelExperiment.load(folder / name).run(order=2)
        response.save(tmp_path / "r.npz")
        scaled = read_frames([folder / "level2.tif"]) / 16383
        for dtype in (np.float32, np.float64):
            corrects = [response.correct]
            if dtype is np.float32:
                corrects.append(equipix.Corrector(response).apply)
            for correct in corrects:
                with pytest.raises(errors.InputError, match="scaled to 0 to 1, multiply by 16383"):
                    correct(scaled.astype(dtype))
        write_frames(tmp_path / "scaled.tif", iter(scaled.astype(np.float32)), nbytes=1)
        status, _, err = run(
            "correct", tmp_path / "r.npz", tmp_path / "scaled.tif", "-o", tmp_path / "out.tif"
        )
        assert status == 1
        assert "multiply by 16383" in err
        assert not (tmp_path / "out.tif").exists()

    def test_a_dark_subtracted_before_is_told(self, run, folder, tmp_path):
        LevelExperiment.load(folder / "levels.toml").run().save(tmp_path / "r.npz")
        dark = read_frames([folder / "dark.tif"]).mean(axis=0)
        once = (read_frames([folder / "dark.tif"])[:2] - dark).astype(np.float32)
        write_frames(tmp_path / "once.tif", iter(once), nbytes=1)
        for options, told in (((), True), (("--dark", "none"), False)):
            arguments = (tmp_path / "r.npz", tmp_path / "once.tif", *options, "--force")
            status, _, err = run("correct", *arguments, "-o", tmp_path / "out.tif")
            assert status == 0
            assert ("darker than the dark" in err) is told
        status, _, err = run(
            "correct", tmp_path / "r.npz", folder / "dark.tif", "-o", tmp_path / "raw.tif"
        )
        assert (status, "darker" in err) == (0, False)

    @pytest.mark.usefixtures("corrected")
    def test_frames_of_more_bits_are_refused(self, run, folder, tmp_path):
        frame = np.full((1, *SHAPE), 40000, np.uint16)
        write_frames(folder / "deep.tif", frame, nbytes=1)
        arguments = ("correct", tmp_path / "response.tif", folder / "deep.tif", "-o")
        status, _, err = run(*arguments, tmp_path / "no.tif")
        assert (status, "deep.tif: 'frames' holds 40000, above 16383" in err) == (1, True)
        status, _, err = run(*arguments, tmp_path / "no.tif", "--dtype=uint16", "--bit-depth=17")
        assert (status, "--bit-depth" in err) == (2, True)
        assert not (tmp_path / "no.tif").exists()

    def test_a_png_given_again_is_noticed(self, corrected, run, folder, tmp_path):
        _, call = corrected
        write_frames(folder / "single.tif", read_frames(folder / "level1.tif")[:1], nbytes=1)
        path, _ = call("out.png", source="single.tif")
        assert header(path).description.startswith("corrected by equipix, correction sha256")
        arguments = ("correct", tmp_path / "response.tif", path, "-o", tmp_path / "again.png")
        status, _, err = run(*arguments)
        assert status == 0
        assert "out.png: corrected already, by this correction" in err

    @pytest.mark.usefixtures("corrected")
    def test_pngs_of_others_have_no_mark(self, run, folder, tmp_path):
        frame = read_frames(folder / "level1.tif")[0]
        write_png(tmp_path / "raw.png", frame, description="of a camera")
        assert header(tmp_path / "raw.png").description == "of a camera"
        arguments = ("correct", tmp_path / "response.tif", tmp_path / "raw.png")
        status, _, err = run(*arguments, "-o", tmp_path / "out.png")
        assert (status, "corrected already" in err) == (0, False)


class TestToneLaws:
    @pytest.mark.parametrize("display", ["linear", "histogram"])
    def test_brighter_stays_brighter_and_the_range_is_used(self, display):
        frame = np.random.default_rng(1).gamma(2.0, 100.0, (60, 80))
        grey = picture(frame, display).ravel()[np.argsort(frame.ravel())]
        assert (np.diff(grey.astype(int)) >= 0).all()
        assert (grey[0], grey[-1]) == (0, 255)

    def test_linear_is_a_line_between_two_percentiles(self):
        frame = np.random.default_rng(2).random((50, 40))
        low, high = np.percentile(frame, [0.5, 99.5])
        wanted = np.rint(255 * np.clip((frame - low) / (high - low), 0, 1))
        np.testing.assert_array_equal(picture(frame, "linear"), wanted)

    def test_the_plateau_limits_what_an_even_area_takes(self):
        frame = np.full((100, 100), 500.0)
        frame[:10] = np.linspace(0, 1000, 1000).reshape(10, 100)
        grey = picture(frame, "histogram")
        # 1000 bins of 1 and one of 9000: without a plateau that one would take 90 % of the range;
        # with one at 4 times the mean of about 10 it takes 40 of 1040.
        below, above = grey[:10][frame[:10] < 500].max(), grey[:10][frame[:10] > 500].min()
        assert int(above) - int(below) == pytest.approx(255 * 40 / 1040, abs=2)

    @pytest.mark.parametrize("display", ["linear", "histogram"])
    def test_what_is_not_finite_is_black_and_even_frames_grey(self, display):
        frame = np.full((4, 5), 7.0)
        frame[1, 2], frame[2, 2] = np.nan, np.inf
        grey = picture(frame, display)
        assert (grey[1, 2], grey[2, 2], grey[0, 0]) == (0, 0, 128)
        assert (picture(np.full((2, 2), np.nan), display) == 0).all()


@pytest.mark.long
@pytest.mark.data
def test_a_real_camera_from_files(data_dir, tmp_path):
    """Six of the exposure levels of a 12-bit CCD."""
    folder = data_dir / "emva1288-set001-ccd-12bit/images"
    levels = "".join(
        f'[[level]]\nframes = "{folder}/b_{level:03}_snap_*.png"\n' for level in range(2, 32, 5)
    )
    (tmp_path / "levels.toml").write_text(f"[sensor]\nbit_depth = 12\n{levels}")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        response = LevelExperiment.load(tmp_path / "levels.toml").run()
    good = (response.flags & Flag.DO_NOT_USE) == 0
    assert good.mean() > 0.999
    assert response.reduced_chi2[good].mean() == pytest.approx(1, abs=0.02)

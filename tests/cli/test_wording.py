"""On the command line a message names options, as they are spelt there."""

from __future__ import annotations

import ast
import inspect
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import equipix
from equipix import cli, simulate
from equipix.cli.app import COMMANDS, command, in_options
from equipix.io import formats
from equipix.saved_results import READ
from equipix.scene.methods import METHODS

PACKAGE = Path(equipix.__file__).parent
NAMED = re.compile(r"'([a-z_]+)'|\b([a-z_]+)=(?=['A-Z0-9])")


def parameters(called):
    """Parameters of a command, or of the commands of a group."""
    leaves = getattr(called, "commands", {"": called}).values()
    return [each for leaf in leaves for each in leaf.params]


@cache
def literals():
    """Texts of the package, the parts of an f-string as one."""
    return frozenset(_literals())


def _literals():
    for file in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.JoinedStr):
                parts = (
                    part.value if isinstance(part, ast.Constant) else "?" for part in node.values
                )
                yield "".join(map(str, parts))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value


def keywords():
    """What messages name as a keyword."""
    return {a or b for text in literals() if " " in text for a, b in NAMED.findall(text)}


def test_options_that_messages_name_exist():
    """Of any command; messages of a library do not know which command calls it."""
    known = {"--help", "--version", "--install-completion", "--show-completion"}
    known |= {"--resources"}  # of 'dask worker'
    for name in COMMANDS:
        known |= {option for each in parameters(command(name)) for option in each.opts}
    named = {
        (option, text)
        for text in literals()
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*[a-z]", text)
    }
    assert len(named) > 30
    assert [each for each in sorted(named) if each[0] not in known] == []


@pytest.fixture(params=COMMANDS)
def called(request):
    return command(request.param)


def test_every_keyword_that_a_message_names_is_named_as_the_option_it_is(called):
    options = {
        each.name: each.opts for each in parameters(called) if each.param_type_name == "option"
    }
    named = keywords()
    assert len(named) > 50
    assert {"robust", "tolerance", "flux", "max_sweeps"} & named
    for name in named & {*options}:
        option = max(options[name], key=len)
        assert in_options(f"'{name}' is 3, expected 4: lower '{name}'", called) == (
            f"{option} is 3, expected 4: lower {option}"
        )
        assert (
            in_options(f"try {name}='some' or 'other'", called) == f"try {option} some or 'other'"
        )


def test_no_message_names_a_keyword_beside_its_option(called):
    options = [max(each.opts, key=len) for each in parameters(called)]
    for text in (text for text in literals() if "(--" in text):
        said = in_options(text, called)
        for option in options:
            assert not re.search(rf"(\w+=\S+|'\w+') \({option}\b", said)


@pytest.mark.parametrize(
    ("name", "message", "said"),
    [
        ("calibrate", "use a larger 'tolerance'", "use a larger --tolerance"),
        ("calibrate", "use method='multiscale', or", "use --method multiscale, or"),
        ("calibrate", "mask it or use robust=True.", "mask it or use --robust."),
        ("calibrate", "flux='linear' (--flux linear) needs", "--flux linear needs"),
        ("calibrate", "found (flux='fit', --flux fit): leave", "found (--flux fit): leave"),
        ("calibrate", "'flux' in e.toml is not used", "'flux' in e.toml is not used"),
        ("calibrate", "e.toml: key 'flux' is missing", "e.toml: key 'flux' is missing"),
        ("calibrate", "or give 'shift_std'", "or give 'shift_std'"),
        ("calibrate", "give 'variance' as", "give 'variance' (in Python) as"),
        ("average", "with 'saturation' (--saturation 9)", "with --saturation 9"),
        ("correct", "but 'bit_depth' (--bit-depth) is 3", "but --bit-depth is 3"),
        ("hardware", "'gain_bits' is 16: no gain_step", "--gain-bits is 16: no --gain-step"),
        ("nuc", "use order='auto', and see by='gain'", "use --order auto, and see --by gain"),
        ("simulate", "exists; force=True (--force) replaces", "exists; --force replaces"),
        ("inspect", "or use robust=True", "or use robust=True"),
        ("scene", "Give data_range=(0, 4095), on", "Give --data-range 0 4095, on"),
        ("average", "'workers' is 0, expected 1 to 9 or None", "--workers is 0, expected 1 to 9"),
        ("average", "is 0, expected a level in DN, or None", "is 0, expected a level in DN"),
        ("plan", "other shifts (equipix.plan.suggest)", "other shifts (equipix plan)"),
        ("calibrate", "see equipix.plan.identify", "see equipix plan"),
        ("calibrate", "shifts of equipix.plan.suggest(..., cfa=...)", "shifts of equipix plan"),
        ("nuc", "give 'dark' to equipix.average.", "give 'dark' to equipix average."),
        ("calibrate", "first (equipix.nuc.fit), or", "first (equipix nuc fit), or"),
        ("inspect", "equipix.average.tif: is empty", "equipix.average.tif: is empty"),
        ("calibrate", "'shifts' of exposure 2 is", "'shift' of exposure 2 is"),
        ("plan", "'shifts' has shape (2,)", "--shifts has shape (2,)"),
        ("nuc", "'response' (--response-limit) is 0", "--response-limit is 0"),
        ("calibrate", "/data/flux_std.csv: holds 3", "/data/flux_std.csv: holds 3"),
        ("calibrate", "/max_sweeps/a.tif: is empty", "/max_sweeps/a.tif: is empty"),
    ],
)
def test_forms_of_a_keyword(name, message, said):
    assert in_options(message, command(name)) == said


def test_limits_of_bad_pixels_are_options(tmp_path, capsys):
    names = ("response", "gain", "noise", "correlation", "range", "misfit")
    for name in names:
        with pytest.raises(SystemExit):
            cli.main(["nuc", "defects", str(tmp_path / "r.tif"), f"--{name}-limit", "-1"])
        assert capsys.readouterr().err.startswith(f"equipix: error: --{name}-limit is -1.0, ")


def test_the_command_line_says_options(tmp_path, capsys):
    virtual = simulate.experiment(
        np.ones((48, 64)),
        simulate.gaussian_beam((48, 64)),
        equipix.cross_pattern(5, 7),
        frames=2,
        rng=1,
    )
    path = virtual.write(tmp_path / "e")
    with pytest.raises(SystemExit):
        cli.main(["calibrate", str(path), "-o", str(tmp_path / "c.tif"), "--tolerance", "2"])
    said = capsys.readouterr().err
    assert "--tolerance is 2" in said
    assert "'tolerance'" not in said


def test_the_defaults_that_help_states_are_those_of_the_methods():
    defaults = {}
    for method in METHODS.values():
        for name, each in inspect.signature(method).parameters.items():
            defaults.setdefault(name, set()).add(each.default)
    options = {each.name: each.help for each in command("scene").params}
    for name in ("step", "width", "threshold", "motion", "least_motion", "block"):
        stated = {float(each) for each in re.findall(r"\d[.\d]*", options[name])}
        assert stated == defaults[name], name


def test_the_suffixes_that_help_names_are_one_of_each_format():
    named = re.findall(r"\.\w+", formats.SAVED)
    assert {*named} <= {*formats.SUFFIXES}
    assert {formats._FORMATS[each] for each in named} == {*formats._FORMATS.values()}
    assert formats.SAVED.replace(" or", ",") in READ

"""What it costs to begin: `import equipix`, `equipix --help`, and what they load."""

from __future__ import annotations

import pickle
import re
import resource
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command as typer_command

import equipix
from equipix.cli import main
from equipix.cli.app import COMMANDS, app
from equipix.cli.app import command as real_command

HELP = "from equipix.cli import main; main(['--help'])"
EAGER = """
import sys
before = set(sys.modules)
{}
print(*sorted(set(sys.modules) - before))
"""
USER = """
import numpy as np

import equipix
from equipix import Calibration, Correction, Flag, calibrate, cross_pattern, load
from equipix.errors import InputError


def gain(path: str) -> float:
    correction: Correction = load(path)
    reveal_type(correction)
    return float(np.nanmean(correction.coefficients[1]))


def save(correction: Correction, path: str) -> None:
    correction.save(path, force=True)


shifts = cross_pattern(11, 19)
cal = calibrate(np.ones((5, 40, 50)), shifts, workers=1)
reveal_type(cal)
reveal_type(equipix.average("a.tif"))
reveal_type(equipix.plan.suggest((40, 50), 5, 9))
reveal_type(equipix.plan.tilt_std((40, 50), shifts))
save(cal, "cal.tif")
bad = (cal.flags & Flag.DO_NOT_USE) != 0
if not isinstance(cal, Calibration):
    raise InputError("never")
"""
REVEALED = (
    "equipix.correction.protocol.Correction",
    ".Calibration",
    "equipix.measured.statistics.FrameStatistics",
    "list[equipix.plan.search.Suggestion]",
    "numpy.ndarray",
)


def loaded_by(statement):
    """Names of the modules outside the standard library that a statement loads."""
    command = [sys.executable, "-c", EAGER.format(statement)]
    names = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    names = names.splitlines()[-1].split()
    return {name for name in names if name.split(".")[0] not in sys.stdlib_module_names}


def cpu_seconds(*statements):
    """The least CPU time that a process takes with each of these statements, of 20.

    They take turns: the speed of a shared machine may change within seconds.
    """
    costs = [[] for _ in statements]
    for _ in range(20):
        for statement, times in zip(statements, costs, strict=True):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            command = [sys.executable, "-c", statement]
            subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            times.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return [min(times) for times in costs]


@pytest.mark.timing
def test_the_import_costs_little_more_than_numpy():
    both, numpy = cpu_seconds("import numpy, equipix", "import numpy")
    assert both <= numpy + 0.04


@pytest.mark.timing
def test_the_help_costs_little_more_than_numpy():
    help_, numpy = cpu_seconds(HELP, "import numpy")
    assert help_ <= 2.5 * numpy


def test_the_import_loads_nothing_else():
    assert loaded_by("import equipix") == {"equipix"}


INTERRUPTED = """
import signal, sys
from equipix.cli import main

class Finder:
    \"\"\"Presses Ctrl-C at the first import of a module.\"\"\"
    def find_spec(self, name, path=None, target=None):
        if name == {!r}:
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Finder())
main(["--help"])
"""


@pytest.mark.parametrize("module", ["equipix.cli.app", "typer", "equipix._native"])
def test_ctrl_c_while_the_command_starts_leaves_no_traceback(module):
    """At the first import inside `main`, and at later ones."""
    command = [sys.executable, "-c", INTERRUPTED.format(module)]
    done = subprocess.run(command, capture_output=True, timeout=60)
    line = b"equipix: error: stopped by Ctrl-C\n"
    assert (done.returncode, done.stdout, done.stderr) == (130, b"", line)


def test_the_help_loads_no_command():
    statement = "try: from equipix.cli import main; main(['--help'])\nexcept SystemExit: pass"
    found = loaded_by(f"exec({statement!r})")
    assert {"equipix.cli.app", "typer"} <= found
    assert not found & {"numpy", "pydantic", "tifffile", "matplotlib", "rich.progress"}
    own = {name for name in found if name.startswith("equipix.")}
    assert own == {
        "equipix._native",
        "equipix.cli",
        "equipix.cli.app",
        "equipix.errors",
    }


def test_the_help_says_of_each_command_what_the_command_says():
    listed = typer_command(app).commands
    for name, placeholder in listed.items():
        assert placeholder.help == real_command(name).help


def test_the_commands_listed_are_all_that_there_are():
    modules = {module for module, _ in COMMANDS.values()}
    registered = [import_module(f"equipix.cli.{module}").commands for module in modules]
    found = [
        info.name or info.callback.__name__
        for each in registered
        for info in each.registered_commands
    ]
    found += [info.name for each in registered for info in each.registered_groups]
    assert sorted(found) == sorted(COMMANDS)


def test_a_mistyped_command_is_corrected(capsys):
    with pytest.raises(SystemExit) as done:
        main(["calibrat"])
    assert done.value.code == 2
    assert "Did you mean 'calibrate'" in capsys.readouterr().err


class TestNames:
    def test_every_public_name_is_there_on_first_use(self):
        code = "import equipix; print(*(name for name in dir(equipix) if getattr(equipix, name)))"
        names = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout
        assert set(equipix.__all__) <= set(names.decode().split())

    def test_a_module_is_an_attribute_before_it_is_imported(self):
        code = "import equipix; assert issubclass(equipix.errors.InputError, ValueError)"
        subprocess.run([sys.executable, "-c", code], check=True)

    def test_a_star_imports_all_of_them(self):
        names: dict[str, object] = {}
        exec("from equipix import *", names)
        assert set(names) - {"__builtins__"} == set(equipix.__all__)
        assert set(equipix.__all__) <= set(dir(equipix))

    def test_an_unknown_name_is_an_attribute_error(self):
        with pytest.raises(AttributeError, match="module 'equipix' has no attribute 'calibrat'"):
            equipix.calibrat  # noqa: B018

    def test_the_names_for_type_checkers_are_those_at_run_time(self):
        stub = Path(equipix.__file__).with_suffix(".pyi").read_text()
        assert set(re.findall(r" as (\w+)", stub)) == set(equipix.__all__)
        assert all(hasattr(equipix, name) for name in equipix.__all__)

    def test_a_calibration_is_unpickled_in_a_fresh_process(self, tmp_path):
        frames = np.random.default_rng(1).uniform(1, 1.01, (5, 24, 26))
        cal = equipix.calibrate(frames, equipix.cross_pattern(2, 3))
        (tmp_path / "cal.pickle").write_bytes(pickle.dumps(cal))
        code = (
            "import pickle, sys; cal = pickle.load(open(sys.argv[1], 'rb')); "
            "sys.stdout.buffer.write(cal.sensitivity.tobytes())"
        )
        command = [sys.executable, "-c", code, str(tmp_path / "cal.pickle")]
        out = subprocess.run(command, capture_output=True, check=True).stdout
        assert out == cal.sensitivity.tobytes()


@pytest.mark.long
def test_user_code_is_checked_strictly(tmp_path):
    pytest.importorskip("mypy")
    (tmp_path / "user.py").write_text(USER)
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path), "user.py"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stdout
    revealed = [line for line in done.stdout.splitlines() if "Revealed type" in line]
    for line, wanted in zip(revealed, REVEALED, strict=True):
        assert wanted in line

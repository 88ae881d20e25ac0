"""The counters of `sizes.py` on small sources, and the way of a call that ARCHITECTURE.md lists."""

from __future__ import annotations

import re
import sys
from itertools import pairwise
from pathlib import Path
from traceback import walk_stack

import numpy as np
import pytest

import equipix
from equipix import _native
from import_graph import rust_code
from sizes import code_lines, import_lines, public_names, way_of_a_call

ROOT = Path(__file__).parents[1]
WAY = way_of_a_call((ROOT / "ARCHITECTURE.md").read_text())

SOURCE = '''"""A module.

Its docstring has no code.
"""

from __future__ import annotations

import os, sys  # 8
from a import (
    # a comment
    b,

    c,
)

if typing.TYPE_CHECKING:
    from d import e

LIMIT = 3
"""A docstring of a constant,
of two lines."""

TEXT = """
# no comment

import nothing
"""  # 23 to 27, of which 25 is blank


class Thing:
    """One line."""

    size: int = 1
    "In" " two" " parts"

    def f(self): "Beside code."

    def g(self):
        # a comment
        from h import i; return """
"""
'''
CODE = {6, 8, 9, 11, 13, 14, 16, 17, 19, 23, 24, 26, 27, 30, 33, 36, 38, 40, 41}
IMPORTS = {6, 8, 9, 11, 13, 14, 16, 17, 40}


def test_code_lines_are_without_docstrings_comments_and_blank_lines():
    assert code_lines(SOURCE) == CODE
    assert code_lines('"""A module."""\n') == code_lines("# none\n\n") == set()


def test_import_lines_are_those_of_whole_statements():
    assert import_lines(SOURCE) == IMPORTS


def test_public_names_are_those_of_all_modules_that_are_reached(tmp_path, monkeypatch):
    files = {
        "__init__.py": "from sized import a, b\nfrom sized.c import c\n__all__ = ['a', 'b', 'c']",
        "a.py": "import sized.d\n__all__ = ['X', 'd']\nX, Y, d = 1, 2, sized.d",
        "b.py": "from re import match\nX = 1\nclass Y: ...\nclass _Z: ...\ndef f(): ...",
        "c.py": "def c(): ...\ndef not_reached(): ...",
        "d.py": "from sized.b import f\n__all__ = ['f']",
    }
    (tmp_path / "sized").mkdir()
    for name, source in files.items():
        (tmp_path / "sized" / name).write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    assert public_names("sized") == {"sized": 3, "sized.a": 2, "sized.d": 1, "sized.b": 2}


def test_the_way_of_a_call_is_read_from_its_section_alone():
    way = "## The way of a call\n\nWords.\n\n    {}  f\n    {}  b::g"
    text = f"# A\n    {{}}  f\n\n{way}\n\n## B\n    {{}}  f\n"
    found = way_of_a_call(text.format("x.py", "a.py", "b.rs", "y.py"))
    assert found == [("a.py", "f"), ("b.rs", "b::g")]
    assert way_of_a_call("# A\n") == []


def name_of(call):
    """The name of the function that a call of the list names last."""
    return re.split(r"\W+", call)[-1]


def python_way():
    """Files of the package on the stack at the first compiled fit, each with its first function."""
    package, stacks = ROOT / "python/equipix", []

    def record(frame, event, called):
        is_compiled = isinstance(getattr(called, "__self__", None), _native.Exposures)
        if event == "c_call" and is_compiled and called.__name__ == "fit":
            stacks.append([each.f_code for each, _ in walk_stack(frame)][::-1])

    frames = np.random.default_rng(1).uniform(1, 1.01, (5, 24, 26))
    before = sys.getprofile()
    sys.setprofile(record)
    try:
        equipix.calibrate(frames, equipix.cross_pattern(2, 3))
    finally:
        sys.setprofile(before)
    entered = {}
    for code in stacks[0]:
        if package in Path(code.co_filename).parents:
            entered.setdefault(str(Path(code.co_filename).relative_to(ROOT)), code.co_name)
    return list(entered.items())


def test_the_python_files_on_the_way_are_those_on_the_stack():
    assert python_way() == [(path, name_of(call)) for path, call in WAY if path.endswith(".py")]


@pytest.mark.parametrize(("above", "below"), list(pairwise(WAY)))
def test_each_file_on_the_way_calls_the_next(above, below):
    (calling, _), (defining, call) = above, below
    code = {path: (ROOT / path).read_text() for path in (calling, defining)}
    code = {path: rust_code(text) if path[-3:] == ".rs" else text for path, text in code.items()}
    assert re.search(rf"(?<![\w:]){re.escape(call)}\(", code[calling])
    assert re.search(rf"\b(fn|def) {name_of(call)}\b", code[defining])

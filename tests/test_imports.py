"""Who may use whom in the core, and who alone may name a crate.

Every file is checked; `import_graph.py` says what counts as a use. The rules name modules or
folders: a folder's files all keep the folder's rule, and use each other where that closes no
circle.

A folder's own file, ``joint.rs``, uses the files in the folder. A file in there that uses an item
of the folder's own file therefore closes a circle. SHARED names the items that files of a folder
nevertheless take from the folder's own file; a use of any other item of it is a circle.

The rules of the Python package stand in pyproject.toml, for import-linter. Here stands what its
contracts cannot say: that no library is named that they do not name, and that no file of the
package imports the package itself, which hides the folder that is used.
"""

from __future__ import annotations

import sys
import tomllib
from itertools import chain
from pathlib import Path

import grimp
import pytest

from import_graph import circle, name_of, rust_crates, rust_graph, rust_items, rust_sources

ROOT = Path(__file__).parents[1]
CORE = ROOT / "rust/core/src"
BINDING = ROOT / "rust/python/src"

CHAIN = (
    {"solve", "uncertainty"},
    {"gauge"},
    {"fit"},
    {"joint", "reduced"},
    {"beam", "convergence", "ritz", "sweep"},
    {"weak_light"},
    {"coarse"},
    {"connectivity", "information"},
    {"exposures"},
    {"padded"},
    {"geometry"},
    {"linalg", "median", "memory", "parallel", "random"},
    {"control"},
    {"frames"},
    {"error"},
)
"""The core: a module uses those to its right; none of two in one place uses the other."""

BESIDE = {
    "apply": set[str](),
    "centroid": {"connectivity"},
    "curves": set[str](),
    "fixed_point": set[str](),
    "io": {"statistics"},
    "parts": {"convergence", "exposures", "reduced", "solve", "sweep"},
    "scene": {"geometry"},
    "statistics": set[str](),
}
"""Core modules beside the chain: they use these, and what is right of `geometry`."""

SHARED = {
    "io": {"Depth", "Format", "Outcome", "Picture", "Problem"},
}
"""What files of a core folder take from the folder's own file, though that uses them: circles that
are left. Do not add to it: give the item a file of its own."""

CRATES = {
    "faer": {"linalg"},
    "image": {"io"},
    "numpy": set[str](),
    "pyo3": set[str](),
    "rand_xoshiro": {"random"},
    "rayon": {"parallel"},
    "tiff": {"io"},
}
"""The core modules that alone may name a crate."""

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
CONTRACTS = PROJECT["tool"]["importlinter"]["contracts"]
LIBRARIES = {"numpy"}.union(*(each.get("protected_modules", ()) for each in CONTRACTS))
"""The libraries of the Python package: each but NumPy is named in one place, by a contract."""

RUST = rust_sources(CORE)
CORE_FILES = sorted(name_of(place) for place in RUST if place)


def place_of(name):
    return tuple(name.split("."))


def is_within(name, homes):
    """Whether a file is one of these files, or in one of these folders."""
    return any(f"{name}.".startswith(f"{home}.") for home in homes)


def core_allows(module):
    """The core modules that a core module may use."""
    if module in BESIDE:
        return BESIDE[module].union(*CHAIN[CHAIN.index({"geometry"}) + 1 :])
    place = [index for index, names in enumerate(CHAIN) if module in names]
    assert place, f"'{module}' stands nowhere: give it a place in CHAIN or BESIDE"
    return set().union(*CHAIN[place[0] + 1 :])


def rust_faults(name, source):
    """What is wrong with the paths in a file of the core."""
    place = place_of(name)
    allowed = core_allows(place[0]) | {place[0]}
    used = {name_of(each[:1]) for each in rust_items(place, source, RUST)}
    crates = rust_crates(place, source, RUST) & set(CRATES)
    return sorted(used - allowed | {each for each in crates if not is_within(name, CRATES[each])})


@pytest.mark.parametrize("name", CORE_FILES)
def test_core_files_use_only_what_stands_to_the_right(name):
    assert rust_faults(name, RUST[place_of(name)]) == []


@pytest.mark.parametrize("crate", [CORE, BINDING], ids=["core", "binding"])
def test_rust_files_do_not_use_each_other_in_a_circle(crate):
    assert circle(rust_graph(rust_sources(crate), SHARED)) == []


def test_the_core_does_not_know_python():
    manifest = tomllib.loads((ROOT / "rust/core/Cargo.toml").read_text())
    assert not {"pyo3", "numpy"} & {*manifest["dependencies"], *manifest["dev-dependencies"]}


def test_every_rule_is_about_something_that_exists():
    assert set.union(*CHAIN) | set(BESIDE) == {place[0] for place in RUST if place}
    homes = set().union(*CRATES.values())
    assert [home for home in homes if not any(is_within(name, {home}) for name in CORE_FILES)] == []


@pytest.mark.parametrize(
    ("folder", "item"), [(key, item) for key in SHARED for item in sorted(SHARED[key])]
)
def test_every_shared_item_is_still_needed(folder, item):
    fewer = SHARED | {folder: SHARED[folder] - {item}}
    assert circle(rust_graph(RUST, fewer)) != []


@pytest.mark.parametrize(
    ("name", "source", "fault"),
    [
        ("frames", "use crate::control::Control;", "control"),
        ("exposures", "fn f() -> crate::sweep::Estimate {}", "sweep"),
        ("centroid.patch", "use crate::{error::Result, exposures::Mask};", "exposures"),
        ("geometry", "use super::exposures::Mask;", "exposures"),
        ("io.tiff", "use super::super::sweep;", "sweep"),
        (
            "joint.pass",
            "use crate::{frames::{Real, Shape}, uncertainty::{self, Draw}};",
            "uncertainty",
        ),
        ("exposures", "mod inner { fn f() -> super::super::sweep::Estimate {} }", "sweep"),
        ("exposures", 'fn f() { let s = "// {"; crate::sweep::run() }', "sweep"),
        ("exposures", "#[cfg(test)]\nfn f(x: [u8; 2]) {}\nuse crate::sweep::Estimate;", "sweep"),
        ("parallel", "use crate::linalg;", "linalg"),
        ("exposures", "use crate::Fit;", ""),
        ("sweep", "use rayon::prelude::*;", "rayon"),
        ("statistics", "let x = ::image::open(path);", "image"),
        ("frames", "use pyo3::prelude::*;", "pyo3"),
    ],
)
def test_the_checker_finds_forbidden_paths(name, source, fault):
    assert rust_faults(name, source) == [fault]


def test_the_checker_passes_what_is_allowed():
    tests = "#[cfg(test)]\nmod tests { use crate::solve; }"
    assert rust_faults("frames", f"use crate::error::Error; // crate::fit\n{tests}") == []
    assert rust_faults("io.tiff", "use super::{Depth, Format};\nuse tiff::Tag;") == []
    assert rust_faults("geometry", "pub(in crate::fit) struct S; /* crate::fit::M */") == []


def test_the_checker_finds_modules_without_a_place():
    with pytest.raises(AssertionError, match="'extra' stands nowhere"):
        rust_faults("extra", "")


def python_faults(package):
    """Libraries without a contract, and imports of the package itself, in its files.

    The compiled part is no Python file, so that it counts as the package itself.
    """
    graph = grimp.build_graph(
        package,
        include_external_packages=True,
        exclude_type_checking_imports=False,
        cache_dir=None,
    )
    outside = {name for name in graph.modules if graph.is_module_squashed(name)}
    hidden = [
        details["line_contents"]
        for name in graph.find_modules_that_directly_import(package)
        for details in graph.get_import_details(importer=name, imported=package)
    ]
    compiled = (f"from {package} import _native", f"from {package}._native import ")
    faults = outside - sys.stdlib_module_names - LIBRARIES
    return faults | {line for line in hidden if not line.startswith(compiled)}


def test_python_files_name_known_libraries_and_the_modules_that_they_use():
    assert python_faults("equipix") == set()


def test_every_library_is_a_dependency():
    project = PROJECT["project"]
    wanted = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    declared = {each.split(">")[0] for each in wanted} - {"imagecodecs"}  # tifffile imports it
    # pydantic's own compiled part comes with it.
    assert LIBRARIES - sys.stdlib_module_names - {"pydantic_core"} == declared


@pytest.mark.parametrize(
    ("source", "faults"),
    [
        ("import scipy.ndimage", {"scipy"}),
        ("def f():\n    from PIL import Image", {"PIL"}),
        ("import typing\nif typing.TYPE_CHECKING:\n    import pandas", {"pandas"}),
        ("from sample import b", set()),
        ("from sample import X", {"from sample import X"}),
        ("import sample", {"import sample"}),
        ("from . import X", {"from . import X"}),
        ("from sample import _native\nfrom sample._native import Fit\nimport numpy", set()),
    ],
)
def test_the_checker_finds_hidden_imports(tmp_path, monkeypatch, source, faults):
    (tmp_path / "sample").mkdir()
    for name, text in {"__init__": "", "a": source, "b": "import json"}.items():
        (tmp_path / f"sample/{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    assert python_faults("sample") == faults

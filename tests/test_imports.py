"""Who may import whom, in both languages, and who alone may name a library.

Every file is checked, stubs and annotations included; `import_graph.py` says what counts as a use.
The rules name modules or folders: a folder's files all keep the folder's rule. Among the files of a
folder every use is allowed that closes no circle, unless INNER gives them an order.

A folder's own file, ``__init__.py`` or ``joint.rs``, uses the files in the folder. A file in there
that uses an item of the folder's own file therefore closes a circle, which is never allowed in
Python. In Rust SHARED names the items that files of a folder nevertheless take from the folder's
own file; a use of any other item of it is a circle.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest

from import_graph import (
    circle,
    name_of,
    python_graph,
    python_names,
    python_sources,
    python_uses,
    rust_crates,
    rust_graph,
    rust_items,
    rust_sources,
)

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "python/equipix"
CORE = ROOT / "rust/core/src"
BINDING = ROOT / "rust/python/src"

LAYERS = (
    {"__main__"},
    {"cli"},
    {"pictures"},
    {"demo"},
    {"comparison", "experiment", "loading"},
    {"calibration", "nuc", "scene"},
    {"bolometer", "detector"},
    {"exposures", "hardware", "plan", "simulate"},
    {"correction", "defects", "lens", "metrics", "uncertainty"},
    {"mosaic"},
    {"light", "noise"},
    {"frames", "shifts"},
    {"batches", "colour", "drift", "flags", "maps", "mending", "rejection", "rounding"},
    {"io"},
    {"_check", "_readonly"},
    {"_types"},
    {"errors"},
    {"_native"},
)
"""The Python package from the top down: a module imports from its own layer or from below."""

INNER = {
    "simulate": (
        {"rig"},
        {"accuracy", "camera", "moving", "staring", "store"},
        {"blackbody", "signal"},
    )
}
"""Folders whose files have an order of their own, from the top down like LAYERS."""

LIBRARIES = {
    "matplotlib": {"pictures"},
    "pydantic": {"experiment.manifest"},
    "pydantic_core": {"experiment.manifest"},
    "rich": {"cli.terminal"},
    "tifffile": {"io.tiff"},
    "typer": {"cli"},
}
"""The modules, folders or files that alone may import a library; NumPy is free to all."""

CHAIN = (
    {"solve", "uncertainty"},
    {"gauge"},
    {"fit"},
    {"joint", "reduced"},
    {"beam", "coarse", "convergence", "ritz", "sweep"},
    {"prior"},
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
    "fixed_point": set[str](),
    "io": {"statistics"},
    "parts": {"convergence", "exposures", "reduced", "solve", "sweep"},
    "response": set[str](),
    "scene": {"geometry"},
    "statistics": set[str](),
}
"""Core modules beside the chain: they use these, and what is right of `geometry`."""

SHARED = {
    "centroid": {"Image"},
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

PYTHON = python_sources(PACKAGE)
RUST = rust_sources(CORE)
FILES = sorted(name_of(place) for place in PYTHON if place)
CORE_FILES = sorted(name_of(place) for place in RUST if place)


def place_of(name):
    return tuple(name.split("."))


def is_within(name, homes):
    """Whether a file is one of these files, or in one of these folders."""
    return any(f"{name}.".startswith(f"{home}.") for home in homes)


def layer_of(module, layers=LAYERS):
    found = [index for index, layer in enumerate(layers) if module in layer]
    assert found, f"'{module}' stands in no layer: give it a place in LAYERS"
    return found[0]


def is_allowed(place, used):
    """Whether a file of the package may use another."""
    if used == ():
        return False
    if place[0] != used[0]:
        apart = "reference" in (place[0], used[0])
        return not apart and layer_of(place[0]) <= layer_of(used[0])
    layers = INNER.get(place[0], ())
    above, below = name_of(place[1:]), name_of(used[1:])
    if not (layers and above and below):
        return True
    return layer_of(above, layers) <= layer_of(below, layers)


def python_faults(name, source):
    """What is wrong with the imports of a file of the package."""
    place = place_of(name)
    layer_of(place[0], (*LAYERS, {"reference"}))
    used = python_uses(place, source, PYTHON)
    wrong = {name_of(each) for each in used if not is_allowed(place, each)}
    tops = {name.split(".")[0] for name in python_names(source)}
    outer = tops - sys.stdlib_module_names - {"equipix", "numpy"}
    return sorted(wrong | {top for top in outer if not is_within(name, LIBRARIES.get(top, ()))})


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


@pytest.mark.parametrize("name", FILES)
def test_python_files_import_only_what_stands_below(name):
    assert python_faults(name, PYTHON[place_of(name)]) == []


def test_neither_python_files_nor_their_folders_import_in_a_circle():
    graph = python_graph(PYTHON)
    for depth in range(1, max(map(len, PYTHON)) + 1):
        assert circle(graph, depth) == []


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
    assert set.union(*LAYERS) | {"reference"} == {place[0] for place in PYTHON if place}
    assert set.union(*CHAIN) | set(BESIDE) == {place[0] for place in RUST if place}
    for folder, layers in INNER.items():
        inner = {name_of(place[1:]) for place in PYTHON if place[:1] == (folder,)}
        assert set.union(*layers) == inner - {""}
    for rules, files in ((LIBRARIES, FILES), (CRATES, CORE_FILES)):
        homes = set().union(*rules.values())
        assert [home for home in homes if not any(is_within(name, {home}) for name in files)] == []


@pytest.mark.parametrize(
    ("folder", "item"), [(key, item) for key in SHARED for item in sorted(SHARED[key])]
)
def test_every_shared_item_is_still_needed(folder, item):
    fewer = SHARED | {folder: SHARED[folder] - {item}}
    assert circle(rust_graph(RUST, fewer)) != []


@pytest.mark.parametrize(
    ("name", "source", "fault"),
    [
        ("io", "from equipix.flags import Flag", "flags"),
        ("io.names", "from equipix.flags import Flag", "flags"),
        ("noise", "def f():\n    from equipix import calibration", "calibration"),
        ("noise", "if TYPE_CHECKING:\n    from equipix.cli import app", "cli.app"),
        ("noise", "def f(x: 'equipix.cli.app.App | None') -> None: ...", "cli.app"),
        ("noise", "x: list['dict[str, equipix.cli.App]']", "cli"),
        ("noise", "y = cast('equipix.simulate.camera.Camera', x)", "simulate.camera"),
        ("noise", "Alias: TypeAlias = 'Callable[[equipix.cli.App], None]'", "cli"),
        ("noise", "module = import_module('equipix.simulate.rig')", "simulate.rig"),
        ("calibration", "import equipix.reference.descent", "reference.descent"),
        ("demo", "from equipix import calibrate", ""),
        ("simulate.store", "from equipix.simulate.rig import Truth", "simulate.rig"),
        ("simulate.signal", "from equipix.simulate.store import Progress", "simulate.store"),
        ("_native", "from equipix.uncertainty import Measurements", "uncertainty"),
        ("_native", "from equipix.errors import InputError", "errors"),
        ("frames", "import tifffile", "tifffile"),
        ("io.names", "import tifffile", "tifffile"),
        ("experiment", "from scipy.ndimage import label", "scipy"),
        ("reference", "from equipix._check import as_array", "_check"),
        ("reference.model", "import scipy", "scipy"),
    ],
)
def test_the_checker_finds_forbidden_imports(name, source, fault):
    assert python_faults(name, source) == [fault]


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
    assert python_faults("frames", "import numpy, os\nfrom equipix import io, _native") == []
    assert (
        python_faults("io", '"""See equipix.cli."""\nraise Error("give equipix.cli a name")') == []
    )
    assert python_faults("io.tiff", "import tifffile\nfrom equipix.io.names import as_path") == []


def test_the_checker_finds_modules_without_a_place():
    with pytest.raises(AssertionError, match="'extra' stands in no layer"):
        python_faults("extra", "")
    with pytest.raises(AssertionError, match="'extra' stands in no layer"):
        python_faults("extra.part", "from equipix.extra import more")
    with pytest.raises(AssertionError, match="'extra' stands nowhere"):
        rust_faults("extra", "")

"""Who may import whom, in both languages, and who alone may name a library.

An import under ``TYPE_CHECKING`` counts like any other: an annotation is knowledge of the other
module too.
"""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "python/equipix"
CORE = ROOT / "rust/core/src"

LAYERS = (
    {"cli"},
    {"report"},
    {"demo"},
    {"experiment"},
    {"load"},
    {
        "calibration",
        "comparison",
        "correct_files",
        "frames",
        "plan",
        "shifts",
        "simulate",
    },
    {
        "_manifest",
        "_measurements",
        "_shift_sign",
        "_terminal",
        "_weights",
        "correction",
        "defects",
        "noise",
        "prediction",
        "robust",
        "uncertainty",
    },
    {"results"},
    {"io"},
    {"_arrays", "_native", "errors"},
)
"""The Python package from the top down: a module imports from its own layer or from below."""

LIBRARIES = {
    "matplotlib": {"report"},
    "pydantic": {"_manifest"},
    "pydantic_core": {"_manifest"},
    "rich": {"_terminal", "cli"},
    "tifffile": {"io"},
    "typer": {"cli"},
}
"""The modules that alone may import a library; NumPy is free to all."""

CHAIN = (
    {"calibrate"},
    {"uncertainty"},
    {"joint"},
    {"multiscale"},
    {"descent"},
    {"estimate"},
    {"conjugate"},
    {"precondition"},
    {"reduced"},
    {"connectivity"},
    {"model"},
    {"geometry"},
    {"linalg", "memory", "parallel", "random"},
    {"control"},
    {"frames"},
    {"error"},
)
"""The core: a module uses those to its right; none of two in one place uses the other."""

BESIDE = {
    "centroid": {"connectivity"},
    "io": {"statistics"},
    "parts": {"descent", "model", "precondition", "reduced"},
    "statistics": set[str](),
}
"""Core modules beside the chain: they use these, and what is right of `geometry`."""

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


def layer_of(module: str) -> int:
    found = [index for index, layer in enumerate(LAYERS) if module in layer]
    assert found, f"'{module}' stands in no layer: give it a place in LAYERS"
    return found[0]


def python_imports(source: str) -> set[str]:
    """Dotted names of what a Python source imports, at any depth."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def inner_imports(source: str) -> set[str]:
    """The modules of the package that a source imports; '' is the package itself."""
    modules = {path.stem for path in PACKAGE.iterdir()}
    parts = [name.split(".") for name in python_imports(source)]
    names = {"".join(rest[:1]) for top, *rest in parts if top == "equipix"}
    return {name if name in modules else "" for name in names}


def outer_imports(source: str) -> set[str]:
    """The packages outside the standard library that a source imports."""
    tops = {name.split(".")[0] for name in python_imports(source)}
    return tops - sys.stdlib_module_names - {"equipix"}


def python_faults(module: str, source: str) -> list[str]:
    """What is wrong with the imports of a module of the package."""
    inner = inner_imports(source) - {module}
    outer = outer_imports(source)
    if module == "reference":
        return sorted(inner | outer - {"numpy"})
    layer = layer_of(module)
    above = {name for name in inner if name in ("", "reference") or layer_of(name) < layer}
    foreign = {name for name in outer - {"numpy"} if module not in LIBRARIES.get(name, ())}
    return sorted(above | foreign)


def core_allows(module: str) -> set[str]:
    """The core modules that a core module may use."""
    if module in BESIDE:
        return BESIDE[module].union(*CHAIN[CHAIN.index({"geometry"}) + 1 :])
    place = [index for index, names in enumerate(CHAIN) if module in names]
    assert place, f"'{module}' stands nowhere: give it a place in CHAIN or BESIDE"
    return set[str]().union(*CHAIN[place[0] + 1 :])


def rust_code(source: str) -> str:
    """A Rust source without comments and without its unit tests."""
    return re.sub(r"//.*", "", source.split("#[cfg(test)]")[0])


def rust_faults(module: str, source: str, depth: int = 1) -> list[str]:
    """What is wrong with the paths in a core module, `depth` below the crate's root."""
    code = rust_code(source)
    root = r"(?<!\$)\b(?:crate::|" + "super::" * depth + ")"
    names = set(re.findall(root + r"([a-z]\w*)", code))
    for group in re.findall(root + r"\{([^;]*)\}", code):
        names |= set(re.findall(r"(?:^|,)\s*([a-z]\w*)", group))
    crates = {name for name in CRATES if re.search(rf"(?<!\w)(?<!\w::){name}::", code)}
    foreign = {name for name in crates if module not in CRATES[name]}
    return sorted(names - {module} - core_allows(module) | foreign)


def python_modules() -> dict[str, list[Path]]:
    """The sources of each module; a folder is one module."""
    modules: dict[str, list[Path]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        modules.setdefault(path.relative_to(PACKAGE).parts[0].removesuffix(".py"), []).append(path)
    del modules["__init__"]
    return modules


def rust_sources() -> list[Path]:
    return sorted(path for path in CORE.rglob("*.rs") if path.name != "lib.rs")


@pytest.mark.parametrize("module", python_modules())
def test_python_modules_import_only_what_stands_below(module):
    for path in python_modules()[module]:
        assert python_faults(module, path.read_text()) == [], path


def test_python_modules_do_not_import_in_a_circle():
    graph = {
        module: set().union(*(inner_imports(path.read_text()) for path in paths)) - {module}
        for module, paths in python_modules().items()
    }
    TopologicalSorter(graph).prepare()


@pytest.mark.parametrize("path", rust_sources(), ids=lambda path: str(path.relative_to(CORE)))
def test_core_modules_use_only_what_stands_to_the_right(path):
    place = path.relative_to(CORE).with_suffix("").parts
    assert rust_faults(place[0], path.read_text(), depth=len(place)) == []


def test_the_core_does_not_know_python():
    manifest = tomllib.loads((ROOT / "rust/core/Cargo.toml").read_text())
    assert not {"pyo3", "numpy"} & {*manifest["dependencies"], *manifest["dev-dependencies"]}


def test_every_rule_is_about_something_that_exists():
    modules = set(python_modules()) | {path.stem for path in PACKAGE.glob("*.pyi")}
    assert set.union(*LAYERS) | {"reference"} == modules
    core = {path.relative_to(CORE).parts[0].removesuffix(".rs") for path in rust_sources()}
    assert set.union(*CHAIN) | set(BESIDE) == core


@pytest.mark.parametrize(
    ("module", "source", "fault"),
    [
        ("io", "from equipix.results import Flag", "results"),
        ("noise", "def f():\n    from equipix import calibration", "calibration"),
        ("noise", "if TYPE_CHECKING:\n    from equipix.cli import app", "cli"),
        ("calibration", "import equipix.reference.descent", "reference"),
        ("demo", "from equipix import calibrate", ""),
        ("frames", "import tifffile", "tifffile"),
        ("experiment", "from scipy.ndimage import label", "scipy"),
        ("reference", "from equipix._arrays import as_array", "_arrays"),
        ("reference", "import scipy", "scipy"),
    ],
)
def test_the_checker_finds_forbidden_imports(module, source, fault):
    assert python_faults(module, source) == [fault]


@pytest.mark.parametrize(
    ("module", "source", "depth", "fault"),
    [
        ("frames", "use crate::control::Control;", 1, "control"),
        ("model", "fn f() -> crate::descent::Stop {}", 1, "descent"),
        ("centroid", "use crate::{error::Result, model::Model};", 2, "model"),
        ("geometry", "use super::model::Model;", 1, "model"),
        ("io", "use super::super::descent;", 2, "descent"),
        ("parallel", "use crate::linalg;", 1, "linalg"),
        ("descent", "use rayon::prelude::*;", 1, "rayon"),
        ("statistics", "let x = ::image::open(path);", 1, "image"),
        ("frames", "use pyo3::prelude::*;", 1, "pyo3"),
    ],
)
def test_the_checker_finds_forbidden_paths(module, source, depth, fault):
    assert rust_faults(module, source, depth) == [fault]


def test_the_checker_passes_what_is_allowed():
    tests = "#[cfg(test)]\nmod tests { use crate::calibrate; }"
    assert rust_faults("frames", f"use crate::error::Error; // crate::model\n{tests}") == []
    assert rust_faults("io", "use super::{Depth, Format};\nuse tiff::Tag;", depth=2) == []
    assert python_faults("frames", "import numpy, os\nfrom equipix import io, _native") == []


def test_the_checker_finds_modules_without_a_place():
    with pytest.raises(AssertionError, match="'extra' stands in no layer"):
        python_faults("extra", "")
    with pytest.raises(AssertionError, match="'extra' stands nowhere"):
        rust_faults("extra", "")

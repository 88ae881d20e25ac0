"""Uses and circles that `import_graph.py` must find, and those that it must not, on small trees."""

from __future__ import annotations

import pytest

from import_graph import circle, home_of, rust_graph, rust_sources


def tree(**sources):
    """Sources of a few files; '__' in a name stands for a folder."""
    return {tuple(name.split("__")): source for name, source in sources.items()}


@pytest.mark.parametrize(
    ("f", "a", "b"),
    [
        ("", "use super::b::X;", "use super::a::Y;"),
        ("", "use super::{b::X, c};", "fn g() -> crate::f::a::Y {}"),
        ("", "use super::b; fn h() -> b::X {}", "use crate::f; fn g() { f::a::y() }"),
        ("use a::Y;", "use super::Z;", ""),
        ("fn g() { a::y() }", "impl super::Z {}", ""),
        ("pub use self::a::Y;", "use crate::f::Z;", ""),
        ("pub use a::Y;", "use super::*;", ""),
    ],
)
def test_circles_of_rust_files_are_found(f, a, b):
    sources = tree(f=f, f__a=a, f__b=b, f__c="")
    assert set(circle(rust_graph(sources, {}))) & {"f.a"}
    assert circle(rust_graph(sources | {("f", "a"): ""}, {})) == []


def test_files_take_only_shared_items_from_the_file_of_their_folder():
    sources = tree(f="mod a; use a::Y;", f__a="use super::{Z, W};", g="use crate::f::Y;")
    assert circle(rust_graph(sources, {})) != []
    assert circle(rust_graph(sources, {"f": {"Z"}})) != []
    assert circle(rust_graph(sources, {"f": {"Z", "W"}})) == []
    # To declare a file is not to use it.
    assert circle(rust_graph(sources | {("f",): "mod a;"}, {})) == []


def test_unit_tests_are_no_use(tmp_path):
    (tmp_path / "f").mkdir()
    (tmp_path / "lib.rs").write_text("mod f; mod g;")
    (tmp_path / "f.rs").write_text("#[cfg(test)]\nmod tests;\nuse crate::g::X;")
    (tmp_path / "f/tests.rs").write_text("use super::*; use crate::g::X;")
    (tmp_path / "g.rs").write_text("#[cfg(test)]\nmod tests { use crate::f::Y; }")
    sources = rust_sources(tmp_path)
    assert rust_graph(sources, {}) == {(): set(), ("f",): {("g",)}, ("g",): set()}


@pytest.mark.parametrize(
    ("source", "used"),
    [
        ("use super::{b::{X, y::Z}, c as d};", "b c"),
        ("use super::b as d; fn g() { d::x() }", "b"),
        ("use super::b; use b::X;", "b"),
        ("use crate::f::{self}; fn g() { f::b::x() }", "f b"),
        ("const Q: [char; 2] = ['\\'', '\"']; fn g() { super::b::x() } // \"'", "b"),
        ("fn g<'a>(x: &'a super::b::X) -> &'a str { r#\"super::c::Y\"# }", "b"),
        ("use ::b::{X, Y}; use b::Z; use std::c; fn g() { c::x(); ::b::x() }", ""),
        ("macro_rules! m { () => { $crate::f::b::x() } } fn g() { Self::b::x() }", ""),
    ],
)
def test_rust_paths_are_followed(source, used):
    files = tree(f="", f__a=source, f__b="", f__c="")
    wanted = {("f",) if name == "f" else ("f", name) for name in used.split()}
    assert rust_graph(files, {})["f", "a"] == wanted


def test_a_file_that_uses_the_root_of_its_crate_closes_a_circle():
    assert circle(rust_graph({(): "mod f; use f::X;", ("f",): "use crate::Y;"}, {})) != []


def test_a_name_is_in_the_longest_path_that_is_a_file():
    places = [("f",), ("f", "a")]
    assert home_of(("f", "a", "X"), places) == ("f", "a")
    assert home_of(("f", "X"), places) == ("f",)
    assert home_of(("X",), places) == ()

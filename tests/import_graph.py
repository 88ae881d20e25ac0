"""Which file of a Rust crate uses which; what `test_imports.py` judges.

A file is named by its place below the crate: ``("solve", "start")``. A folder's own file
(``joint.rs`` beside ``joint/``) has the folder's name, ``("joint",)``; that of the crate has the
empty name.

A use is a path, in a ``use`` line or anywhere else, unit tests left out. ``mod x;`` is no use.
Calls of methods are not traced: where ``impl`` blocks of a type stand in several files, each counts
by the paths in it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

Place = tuple[str, ...]
Sources = Mapping[Place, str]
Graph = dict[Place, set[Place]]


def name_of(place: Place) -> str:
    """A place as one word; that of the package or the crate itself is ''."""
    return ".".join(place)


def home_of(path: Iterable[str], places: Iterable[Place]) -> Place:
    """The file that a path leads into: the longest beginning of it that names one."""
    place, known = tuple(path), set(places)
    while place and place not in known:
        place = place[:-1]
    return place


def circle(graph: Graph, depth: int | None = None) -> list[str]:
    """The files on one circle of uses, or none; cut to `depth` parts, folders instead of files."""
    cut: Graph = {}
    for place, used in graph.items():
        cut.setdefault(place[:depth], set()).update(other[:depth] for other in used)
    try:
        TopologicalSorter({place: used - {place} for place, used in cut.items()}).prepare()
    except CycleError as error:
        return [name_of(place) for place in error.args[1]]
    return []


def rust_sources(crate: Path) -> dict[Place, str]:
    """The sources of a crate, files of unit tests left out."""
    paths = {path.relative_to(crate).with_suffix("").parts: path for path in crate.rglob("*.rs")}
    sources = {
        () if place == ("lib",) else place: paths[place].read_text() for place in sorted(paths)
    }
    tests = {test for place, source in sources.items() for test in tests_beside(place, source)}
    return {place: source for place, source in sources.items() if place not in tests}


TOKEN = re.compile(
    r"""//[^\n]*|/\*.*?\*/|r(\#*)".*?"\1|"(?:\\.|[^"\\])*"|'(?:\\.[^']*|[^\\'])'""", re.DOTALL
)
"""What is no code in Rust: comments, strings, characters (a lifetime has no second quote)."""


def end_of_item(code: str, start: int) -> int:
    """Where an item ends that begins at `start`: at its semicolon, or the brace that closes it."""
    depth = 0
    for match in re.finditer(r"[][(){};]", code[start:]):
        sign = match.group()
        depth += (sign in "[({") - (sign in "])}")
        if depth == 0 and sign in "};":
            return start + match.end()
    return len(code)


def rust_code(source: str) -> str:
    """A Rust source without comments, strings and tests."""
    code = TOKEN.sub(" ", source)
    while match := re.search(r"#\[cfg\(test\)\]", code):
        code = code[: match.start()] + code[end_of_item(code, match.end()) :]
    return code


def tests_beside(place: Place, source: str) -> set[Place]:
    """The files that a Rust source declares as unit tests."""
    names = re.findall(r"#\[cfg\(test\)\]\s*mod\s+(\w+)\s*;", TOKEN.sub(" ", source))
    return {(*place, name) for name in names}


def use_paths(tree: str, before: Place = ()) -> Iterator[tuple[Place, str]]:
    """The paths of a ``use`` tree, each with the name that it goes by."""
    head, brace, group = tree.strip().partition("{")
    path, _, alias = head.strip().partition(" as ")
    outside = ("",) * path.startswith("::")
    parts = (part.strip() for part in path.split("::"))
    full = (*before, *outside, *(part for part in parts if part not in ("", "*")))
    if not brace:
        full = full[:-1] if full[-1:] == ("self",) and before else full
        yield full, alias.strip() or full[-1]
        return
    depth, start, group = 0, 0, group.strip().removesuffix("}") + ","
    for index, sign in enumerate(group):
        depth += (sign == "{") - (sign == "}")
        if sign == "," and depth == 0:
            if group[start:index].strip():
                yield from use_paths(group[start:index], full)
            start = index + 1


def scopes(code: str, scope: Place) -> Iterator[tuple[Place, str]]:
    """A Rust source and its inline modules, each as its path and its code alone."""
    while match := re.search(r"\bmod\s+(\w+)\s*\{", code):
        end = end_of_item(code, match.end() - 1)
        yield from scopes(code[match.end() : end - 1], (*scope, match.group(1)))
        code = code[: match.start()] + code[end:]
    yield scope, code


def rust_paths(place: Place, source: str) -> Iterator[tuple[Place, Place]]:
    """The paths that a Rust source names, each with the module that names it, aliases resolved."""
    for scope, code in scopes(rust_code(source), place):
        code = re.sub(r"\bpub\s*\([^)]*\)", "", code)
        trees = re.findall(r"\buse\s+([^;]+);", code)
        named = [pair for tree in trees for pair in use_paths(tree)]
        aliases = {alias: path for path, alias in named}
        rest = re.sub(r"\buse\s+[^;]+;", "", code)
        texts = re.findall(r"(?<![\w$:])(?:::)?\w+(?:::\w+)+", rest)
        for first, *others in [*(path for path, _ in named), *(text.split("::") for text in texts)]:
            yield scope, (*aliases.get(first, (first,)), *others)


def absolute(scope: Place, path: Place, places: Iterable[Place]) -> Place | None:
    """A path from the crate's root; None if it leads to another crate or to a name in scope."""
    first, *rest = path
    if first == "crate":
        return tuple(rest)
    if first == "self":
        return (*scope, *rest)
    if first == "super":
        inner = tuple(rest)
        return absolute(scope[:-1], inner if inner[:1] == ("super",) else ("self", *inner), places)
    return (*scope, *path) if (*scope, first) in places else None


def rust_items(place: Place, source: str, places: Iterable[Place]) -> dict[Place, set[str]]:
    """The other files of the crate that a source uses, with the items; () is the crate's root."""
    known = set(places)
    items: dict[Place, set[str]] = {}
    for scope, path in rust_paths(place, source):
        full = absolute(scope, path, known)
        if full is not None and (home := home_of(full, known)) != place:
            items.setdefault(home, set()).add("".join(full[len(home) : len(home) + 1]))
    return items


def rust_crates(place: Place, source: str, places: Iterable[Place]) -> set[str]:
    """The first names of paths that lead out of the crate."""
    known = set(places)
    paths = [path for scope, path in rust_paths(place, source) if not absolute(scope, path, known)]
    return {path[1] if path[0] == "" else path[0] for path in paths}


def rust_graph(sources: Sources, shared: Mapping[str, set[str]]) -> Graph:
    """Which file of a crate uses which, but for items that a folder's own file shares."""
    graph: Graph = {}
    for place, source in sources.items():
        free = {place[:-1]: shared.get(name_of(place[:-1]), set())}
        items = rust_items(place, source, sources).items()
        graph[place] = {home for home, names in items if names - free.get(home, set())}
    return graph

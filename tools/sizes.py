"""Sizes of the sources: lines, long files, functions, imports, public names. Prints tables.

Lines of a Python function are counted without its docstring, those of a Rust function from ``fn``
to its closing brace; Rust tests count as lines, not as functions. The second table is of the
Python package. Public names are those of the imported package, which must be built.
"""

from __future__ import annotations

import ast
import io
import re
import statistics
import sys
import tokenize
from importlib import import_module
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "python/equipix"
LONG_FILE, LONG_FUNCTION = 500, 25
SHORT_MODULE, LONG_MODULE = 40, 250
"""Limits on the code lines of a module."""

TESTS = {"tests.rs", "testing.rs"}
"""Rust files of tests alone."""

NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
"""Tokens that make no line a code line."""


def python_functions(source: str) -> dict[str, int]:
    """Lines of each function without its docstring."""
    lengths = {}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            doc = node.body[0] if ast.get_docstring(node) else None
            own = doc.end_lineno - doc.lineno + 1 if doc and doc.end_lineno else 0
            lengths[f"{node.name}:{node.lineno}"] = (node.end_lineno or 0) - node.lineno + 1 - own
    return lengths


def rust_functions(source: str) -> dict[str, int]:
    """Lines of each function before the tests inside the file."""
    lengths, start = {}, None
    code = re.split(r"^#\[cfg\(test\)\]\nmod \w+ \{", source, flags=re.MULTILINE)[0]
    for number, line in enumerate(code.splitlines(), 1):
        head = re.match(r"(\s*)(?:pub(?:\([\w:]+\))? )?(?:const )?fn (\w+)", line)
        if head and start is None:
            start = (head[1], f"{head[2]}:{number}", number)
        if start is None:
            continue
        indent, name, first = start
        if line == f"{indent}}}" or (number == first and line.endswith("}")):
            lengths[name], start = number - first + 1, None
        elif (line.startswith(f"{indent})") and line.endswith(";")) or (
            number == first and line.endswith(";")
        ):  # a declaration
            start = None
    return lengths


def code_lines(source: str) -> set[int]:
    """Numbers of the lines with code: not blank, not comment alone, not of a docstring.

    Any statement that is a string alone is a docstring, such as that of a constant.
    """
    docstrings = [
        ((node.lineno, node.col_offset), (node.end_lineno or 0, node.end_col_offset or 0))
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    ]
    numbers: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        is_doc = token.type == tokenize.STRING and any(
            start <= token.start < end for start, end in docstrings
        )
        if token.type not in NO_CODE and not is_doc:
            numbers.update(range(token.start[0], token.end[0] + 1))
    lines = source.splitlines()
    return {number for number in numbers if lines[number - 1].strip()}


def import_lines(source: str) -> set[int]:
    """Numbers of the code lines of imports, ``if TYPE_CHECKING:`` included."""
    numbers: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            numbers.update(range(node.lineno, (node.end_lineno or 0) + 1))
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            numbers.add(node.lineno)
    return numbers & code_lines(source)


def public_names(name: str) -> dict[str, int]:
    """Count the public names of a module, and of each module among them.

    Where a module has no ``__all__``, these are the classes and functions that it defines, without
    those that begin with an underscore.
    """
    module = import_module(name)
    defined = (
        each
        for each, value in vars(module).items()
        if callable(value) and getattr(value, "__module__", "") == name and each[0] != "_"
    )
    names = list(getattr(module, "__all__", defined))
    counts = {name: len(names)}
    for value in [getattr(module, each) for each in names]:
        if isinstance(value, ModuleType):
            counts |= public_names(value.__name__)
    return counts


def way_of_a_call(architecture: str) -> list[tuple[str, str]]:
    """The files on the call stack of `calibrate`, as ARCHITECTURE.md lists them.

    With each file stands the call that leads into it.
    """
    _, _, section = architecture.partition("\n## The way of a call\n")
    lines = re.findall(r"^ {4}(\S+) +(\S+)$", section.partition("\n## ")[0], re.MULTILINE)
    return [(path, call) for path, call in lines]


def print_functions() -> None:
    """Print lines and lengths of functions of the package and the crates."""
    rows = []
    for name, folder, pattern, functions in (
        ("Python package", "python/equipix", "*.py", python_functions),
        ("Rust core", "rust/core/src", "*.rs", rust_functions),
        ("Rust binding", "rust/python/src", "*.rs", rust_functions),
    ):
        files = {path: path.read_text() for path in sorted((ROOT / folder).rglob(pattern))}
        lengths = {
            f"{path.relative_to(ROOT)}:{function}": length
            for path, source in files.items()
            if path.name not in TESTS
            for function, length in functions(source).items()
        }
        lines = {path: source.count("\n") for path, source in files.items()}
        long_files = [str(path.relative_to(ROOT)) for path, n in lines.items() if n > LONG_FILE]
        long_functions = [each for each, length in lengths.items() if length > LONG_FUNCTION]
        share = len(long_functions) / len(lengths)
        median = statistics.median(lengths.values())
        rows.append((name, sum(lines.values()), len(files), len(lengths), median, share))
        for path in long_files:
            print(f"above {LONG_FILE} lines: {path}")
    print(f"{'':16} {'lines':>7} {'files':>6} {'functions':>10} {'median':>7} {'above 25':>9}")
    for name, lines_, count, number, median, share in rows:
        print(f"{name:16} {lines_:7} {count:6} {number:10} {median:7.0f} {share:9.1%}")


def print_modules(sources: dict[Path, str]) -> None:
    """Print code lines, modules and imports."""
    code = [len(code_lines(source)) for source in sources.values()]
    imports = sum(len(import_lines(source)) for source in sources.values())
    short = sum(lines < SHORT_MODULE for lines in code)
    long = sum(lines > LONG_MODULE for lines in code)
    print(f"{'':16} {'code':>7} {'modules':>8} {'under 40':>9} {'above 250':>10} {'imports':>8}")
    counts = f"{sum(code):7} {len(code):8} {short:9} {long:10} {imports:8}"
    print(f"{'Python package':16} {counts} {imports / sum(code):6.1%}")


def print_names(sources: dict[Path, str]) -> None:
    """Print the number of public names, those of modules that no ``__all__`` leads to apart."""
    counts = public_names("equipix")
    others = {}
    for path, source in sources.items():
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        name = ".".join(parts).removesuffix(".__init__")
        is_public = "._" not in name and re.search(r"^__all__\b", source, re.MULTILINE)
        if is_public and name not in counts:
            others[name] = len(import_module(name).__all__)
    for title, each in (("public names", counts), ("not reached", others)):
        names = ", ".join(f"{name.removeprefix('equipix.')} {n}" for name, n in each.items())
        print(f"{title:16} {sum(each.values()):7}  {names}")


def main() -> None:
    """Print the tables."""
    print_functions()
    sources = {path: path.read_text() for path in sorted(PACKAGE.rglob("*.py"))}
    print()
    print_modules(sources)
    sys.path.insert(0, str(PACKAGE.parent))
    print_names(sources)
    files = len(way_of_a_call((ROOT / "ARCHITECTURE.md").read_text()))
    print(f"{'calibrate stack':16} {files:7}  files")


if __name__ == "__main__":
    main()

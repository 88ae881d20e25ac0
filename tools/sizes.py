"""Sizes of the sources: lines, long files, lengths of functions. Prints a table.

Lines of a Python function are counted without its docstring, those of a Rust function from ``fn``
to its closing brace; Rust tests count as lines, not as functions.
"""

from __future__ import annotations

import ast
import re
import statistics
from pathlib import Path

ROOT = Path(__file__).parents[1]
LONG_FILE, LONG_FUNCTION = 500, 25
TESTS = {"tests.rs", "testing.rs"}
"""Rust files of tests alone."""


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


def main() -> None:
    """Print the table."""
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


if __name__ == "__main__":
    main()

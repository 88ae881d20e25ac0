"""Write the tables of keys in docs/, which the schema of the files has."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from equipix.experiment.manifest import (
    CameraManifest,
    LevelManifest,
    Manifest,
    Table,
    example_of,
    keys_of,
    table_of,
)
from equipix.report.limits import LimitsFile

ROOT = Path(__file__).parents[1]

TABLES: dict[str, tuple[str, type[Table]]] = {
    "experiment.toml": ("experiment.md", Manifest),
    "levels.toml": ("nuc.md", LevelManifest),
    "camera.toml": ("camera.md", CameraManifest),
    "limits.toml": ("reports.md", LimitsFile),
}
"""The page of each file's table, and its schema."""

_TABLE = r"(<!-- keys of {}: python tools/key_tables.py -->\n\n)(?:\|.*\n)*"


def reference(model: type[Table]) -> str:
    """Return the table of all keys of a file; of limits, which have no default, the usual ones.

    The keys of a sensor stand once: not among those of levels.
    """
    usual = model is LimitsFile
    lines = [
        f"| key | type, unit | {'usual' if usual else 'default'} | meaning |",
        "|---|---|---|---|",
    ]
    for path, field in keys_of(model):
        is_told = model is LevelManifest and path.startswith("sensor")
        if is_told or (table_of(field.annotation) and not field.description):
            continue
        value = json.dumps(example_of(field)) if usual else _default(field)
        lines.append(f"| `{path}` | {field.title} | {value} | {field.description} |")
    return "\n".join(lines) + "\n"


def _default(field: Any) -> str:
    """Write the default of a key."""
    if field.is_required():
        return "required"
    known = {None: "none", "": "empty"}
    return known[field.default] if field.default in known else json.dumps(field.default)


def with_table(text: str, name: str, model: type[Table]) -> str:
    """Return the text of a page with the table of a file."""
    found, count = re.subn(
        _TABLE.format(re.escape(name)), lambda match: match[1] + reference(model), text
    )
    if count != 1:
        raise SystemExit(f"{count} places for the keys of {name}, expected one")
    return found


def main() -> None:
    """Write all tables."""
    for name, (page, model) in TABLES.items():
        path = ROOT / "docs" / page
        path.write_text(with_table(path.read_text(), name, model))


if __name__ == "__main__":
    main()

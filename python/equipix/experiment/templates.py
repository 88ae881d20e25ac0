"""Commented templates of manifests and limits, made from their schema."""

import json
import re
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

from equipix.experiment.manifest import Table, example_of, keys_of, table_of

BLANK = "?"
"""What stands for a value that only the user knows; no key of another type than text takes it."""


def template(model: type[Table], title: str, values: Mapping[str, Any]) -> str:
    """Text of a file with some values; keys without one are explained, and commented out.

    Parameters
    ----------
    model : type of Table
        The schema of the file.
    title : str
        The first comment.
    values : mapping
        Values by their keys, those of tables as mappings, or lists of mappings, of their own. A key
        that a file must have and that is not given is `BLANK`.

    Returns
    -------
    str
        TOML.
    """
    return "\n".join([*_comment(title), *_table(model, values, ""), ""])


def _table(
    model: type[Table], values: Mapping[str, Any], within: str, unused: tuple[str, ...] = ()
) -> Iterator[str]:
    """Give the lines of a table: its own keys first, as TOML has it, but those that are unused."""
    fields = {name: field for name, field in model.model_fields.items() if name not in unused}
    tables = {name: table_of(field.annotation) for name, field in fields.items()}
    for name, field in fields.items():
        if tables[name] is None:
            yield from _comment(f"{field.description} ({field.title})")
            given = values.get(name, BLANK if field.is_required() else None)
            own = field.is_required() or field.default in (None, "")
            shown = (example_of(field) if own else field.default) if given is None else given
            yield f"{'#' if given is None else ''}{name} = {_toml(shown)}"
    for name, table in tables.items():
        if table is not None:
            yield from ("", *_comment(fields[name].description))
            unused = getattr(model, "unused", ())
            yield from _tables(*table, values.get(name), f"{within}{name}", unused)


def _tables(
    model: type[Table], many: bool, values: Any, name: str, unused: tuple[str, ...]
) -> Iterator[str]:
    """Give the lines of one or many tables: of the first all keys, of others those given."""
    head = f"[[{name}]]" if many else f"[{name}]"
    if values is None:
        needed = {key: example_of(each) for key, each in keys_of(model) if each.is_required()}
        lines = [head, *_table(model, needed, f"{name}.", unused)]
        yield from (line if line.startswith("#") else f"#{line}" for line in lines)
        return
    first, *others = values if many else [values]
    yield from (head, *_table(model, first, f"{name}.", unused))
    for each in others:
        yield from ("", head, *(f"{key} = {_toml(value)}" for key, value in each.items()))


def _comment(text: str | None) -> list[str]:
    """Write a meaning as comments: names of pages in the place of links."""
    plain = re.sub(r"\[([\w.]+)\]\([^)]*\)", r"docs/\1", text or "").replace("`", "'")
    return [f"# {line}" for line in textwrap.wrap(plain, 96)]


def _toml(value: Any) -> str:
    """Write a text, a number, a truth value or a list of these; TOML has them as JSON does.

    But for the character 127, which is a control character in TOML alone.
    """
    return json.dumps(value, ensure_ascii=False).replace("\x7f", r"\u007f")

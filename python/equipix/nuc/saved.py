"""The file of a response: from its fields to named arrays and JSON, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.colour import Colours
from equipix.io import check_format, check_pages, save_pages

if TYPE_CHECKING:
    from collections.abc import Mapping
    from os import PathLike

    from equipix._types import Array

KIND = "response"
"""The kind in the metadata of the file."""

FORMAT = 1
"""Number of the file format; a file with a higher one is refused."""

_MAPS: dict[str, type] = {
    "flags": np.uint32,
    "inverse_error": np.float64,
    "reduced_chi2": np.float64,
    "used": np.uint32,
}
_STACKS: dict[str, type] = dict.fromkeys(
    ("deviation", "variances", "inverse", "limits"), np.float64
)


def save_fields(path: str | PathLike[str], fields: Mapping[str, Any], *, force: bool) -> None:
    """Write the attributes of a `Response` to a file; see `Response.save`."""
    pages = {name: fields[name] for name in (*_STACKS, *_MAPS)}
    if fields["dark"] is not None:
        pages["dark"] = fields["dark"]
    content = {
        "format": FORMAT,
        "kind": KIND,
        "levels": fields["levels"].tolist(),
        "raw": fields["raw"],
        "saturation": fields["saturation"],
        "metadata": fields["metadata"],
    }
    if fields["cfa"] is not None:
        content["cfa"] = fields["cfa"].rows
        content["colour_response"] = fields["colour_response"]
    save_pages(path, pages, content, force=force)


def read_fields(
    path: str | PathLike[str], pages: Mapping[str, Array], content: dict[str, Any]
) -> dict[str, Any]:
    """Make the attributes of a `Response` of the arrays and metadata that `save_fields` wrote.

    Raises
    ------
    FileError
        If the format is newer than `FORMAT`, or a page is missing or does not fit.
    KeyError, TypeError, ValueError
        If a number is missing or is something else.
    """
    check_format(path, content, KIND, FORMAT)
    maps = _MAPS | dict.fromkeys({"dark"} & pages.keys(), np.floating)
    check_pages(path, pages, maps, _STACKS)
    sizes = {name: len(pages[name]) for name in _STACKS}
    orders = range(1, 5)
    if sizes["deviation"] not in orders or sizes["variances"] != sizes["deviation"]:
        raise ValueError(f"stacks of {sizes} images, expected a deviation of 1 to 4")
    if sizes["inverse"] != (2 if sizes["deviation"] < 3 else 4) or sizes["limits"] != 2:
        raise ValueError(f"stacks of {sizes} images, expected an inverse of 2 or 4 and 2 limits")
    level = content["saturation"]
    return {
        **{name: pages[name] for name in (*_MAPS, *_STACKS)},
        "dark": pages.get("dark"),
        "levels": np.array(content["levels"], dtype=np.float64),
        "raw": bool(content["raw"]),
        "saturation": None if level is None else float(level),
        "metadata": content["metadata"],
        "cfa": Colours.of(content.get("cfa")),
        "colour_response": content.get("colour_response"),
    }

"""The file of a dynamic correction: from its fields to named arrays and JSON, and back."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from equipix.bolometer.states import Axes, Regressor
from equipix.io import check_format, check_pages, save_pages

if TYPE_CHECKING:
    from collections.abc import Mapping
    from os import PathLike

    from equipix._types import Array

KIND = "dynamic correction"
"""The kind in the metadata of the file."""

FORMAT = 1
"""Number of the file format; a file with a higher one is refused."""


def save_fields(path: str | PathLike[str], fields: Mapping[str, Any], *, force: bool) -> None:
    """Write the attributes of a `DynamicCorrection`; see its `save`."""
    pages = {"offset": fields["offset"], "flags": fields["flags"]}
    if fields["gain"] is not None:
        pages["gain"] = fields["gain"]
    content = {
        "format": FORMAT,
        "kind": KIND,
        "level": fields["level"].tolist(),
        "axes": asdict(fields["axes"]),
        "gain_axes": asdict(fields["gain_axes"]),
        "metadata": fields["metadata"],
    }
    save_pages(path, pages, content, force=force)


def read_fields(
    path: str | PathLike[str], pages: Mapping[str, Array], content: dict[str, Any]
) -> dict[str, Any]:
    """Make the attributes of a `DynamicCorrection` of what `save_fields` wrote.

    Raises
    ------
    FileError
        If the format is newer than `FORMAT`, or a page is missing or does not fit.
    KeyError, TypeError, ValueError
        If a number is missing or is something else.
    """
    check_format(path, content, KIND, FORMAT)
    stacks = dict.fromkeys({"offset", "gain"} & {"offset", *pages}, np.float64)
    check_pages(path, pages, {"flags": np.uint32}, stacks)
    return {
        "offset": pages["offset"],
        "gain": pages.get("gain"),
        "level": np.array(content["level"], dtype=np.float64),
        "axes": _axes(content["axes"]),
        "gain_axes": _axes(content["gain_axes"]),
        "flags": pages["flags"],
        "metadata": content["metadata"],
    }


def _axes(content: dict[str, Any]) -> Axes:
    (low, high), (least, most) = content["substrate_c"], content["bias_v"]
    if content["regressor"] not in get_args(Regressor):
        raise ValueError(f"a regressor {content['regressor']!r}, expected {get_args(Regressor)}")
    return Axes(
        (float(low), float(high)),
        (float(least), float(most)),
        int(content["order"]),
        int(content["bias_order"]),
        content["regressor"],
    )

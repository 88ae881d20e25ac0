"""A response from the file that `Response.save` wrote."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from equipix.nuc.response import Response
from equipix.nuc.saved import read_fields

if TYPE_CHECKING:
    from collections.abc import Mapping
    from os import PathLike

    from equipix._types import Array


def read_response(
    path: str | PathLike[str], pages: Mapping[str, Array], content: dict[str, Any]
) -> Response:
    """Make a response of the arrays and metadata of the file that `Response.save` wrote."""
    return Response(**read_fields(path, pages, content))

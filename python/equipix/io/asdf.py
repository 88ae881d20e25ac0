"""ASDF files: results that programs of astronomers read. The only module that imports asdf."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from equipix.io.arrays import missing, native
from equipix.io.viewed import Viewed

SUFFIXES = (".asdf",)

_KEPT = "equipix"


def _asdf() -> Any:
    try:
        import asdf
    except ImportError as error:
        raise missing("ASDF", "asdf", "asdf") from error
    return asdf


def write_pages(
    path: Path, pages: Mapping[str, NDArray[Any]], text: str, viewed: Viewed | None
) -> None:
    """Write what other programs see at the top of the tree, and all arrays below ``equipix``."""
    tree: dict[str, Any] = {_KEPT: {"metadata": text, "arrays": dict(pages)}}
    if viewed is not None:
        shown = {viewed.name: viewed.image, "std": viewed.std, "unit": viewed.unit or "1"}
        tree = {**shown, "mask": viewed.mask, "flags": viewed.flags, **tree}
    _asdf().AsdfFile(tree).write_to(path)


def read_pages(path: Path) -> tuple[dict[str, NDArray[Any]], str]:
    """Read what `write_pages` wrote: arrays by name, and the text; of other files none."""
    with _kept(path, lazy_load=False, validate_checksums=True) as kept:
        pages = {name: native(each) for name, each in kept.get("arrays", {}).items()}
        return pages, kept.get("metadata", "")


def description(path: Path) -> str:
    """Text stored with a result; empty where there is none."""
    with _kept(path) as kept:
        return str(kept.get("metadata", ""))


@contextmanager
def _kept(path: Path, **options: bool) -> Iterator[Any]:
    with _asdf().open(path, memmap=False, **options) as file:
        yield file.tree.get(_KEPT, {})

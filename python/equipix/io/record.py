"""Results as records: dataclasses to named arrays and JSON values, and back.

A class of results is a frozen dataclass with the base `Record`. The annotations of its fields
state all that is stored. An array has its types and its axes beside it::

    Map = Annotated[Array, "float32|float64", "rows cols"]

    @dataclass(frozen=True, eq=False)
    class Gain(Record, kind="gain", version=1):
        gain: Map
        variance: Map | None
        source: dict[str, Any]

An axis is a number, or a name that stands for one size in the whole record; ``*`` has any size.
Other fields become JSON values: numbers, texts, literals, tuples, mappings, dataclasses and named
tuples of these or of arrays, each of them or None. There the place of an array holds its type,
shape and CRC-32.
"""

import dataclasses
import json
import math
import typing
import zlib
from collections.abc import Callable
from datetime import UTC, datetime
from functools import cache
from os import PathLike
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np

from equipix._check import LOG, Array, Floats, ReadOnly
from equipix._native import __version__
from equipix.errors import FileError, InputError
from equipix.io.formats import load_pages, refuse_copy, save_pages
from equipix.io.viewed import Use
from equipix.shown import Shown

Map = Annotated[Array, "float32|float64", "rows cols"]

Doubles = Annotated[Floats, "float64", "rows cols"]

Counts = Annotated[Array, "uint32", "rows cols"]
"""Counts or flags of the pixels."""

UNSAVED = {"saved": False}
"""Metadata of a field that no file holds: reading one gives its default."""

_MISFITS = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
"""What is raised where values do not fit their annotations, or the checks of a class."""

_NOT_FINITE = ("nan", "inf", "-inf")
"""Numbers that JSON lacks, as texts."""

_PLAIN: dict[Any, Any] = {bool: bool, int: int, float: (float, int), str: str}
"""Types of the JSON values of an annotation."""


def now() -> str:
    """Time for the metadata."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def made(**known: Any) -> dict[str, Any]:
    """Metadata of a result that is made now: versions, what else is known, and the time."""
    versions = {"equipix": __version__, "numpy": np.__version__}
    return {"versions": versions, **known, "finished": now()}


class Record(Shown, ReadOnly):
    """Base of results that are saved: frozen dataclasses with read-only arrays."""

    KIND: ClassVar[str]
    VERSION: ClassVar[int]

    def __init_subclass__(cls, *, kind: str, version: int) -> None:
        """Name the kind in the metadata of a file, and the version of its content."""
        cls.KIND, cls.VERSION = kind, version

    def save(
        self,
        path: str | PathLike[str],
        *,
        use: Use | None = None,
        mean_one: bool = False,
        force: bool = False,
    ) -> None:
        """Write to a file that `equipix.load` reads.

        Parameters
        ----------
        path : str or path
            The file; its suffix, .tif, .npz, .fits, .nxs or .asdf, names the format. It appears
            whole or not at all. Other programs show a copy of the sensitivity, the gain or the
            mean: the page of a TIFF, in single precision, the primary image of a FITS file, the
            flat field of a NeXus file.
        use : {"flat", "gain"}, optional
            Whether that copy is a flat to divide frames by, or a gain to multiply them by; what the
            result is unless given, and a flat in NeXus. `equipix.load` reads the same result.
        mean_one : bool
            Whether that copy is scaled to mean 1 over the usable pixels.
        force : bool
            Whether an existing file may be replaced.

        Raises
        ------
        FileError
            If the file exists and `force` is not set, or it cannot be written.
        InputError
            If the suffix is unknown, a value has not the type or shape that files hold, or there is
            no such copy.
        """
        viewed = self._exported(use, mean_one) if use or mean_one else self.viewed()
        if use or mean_one:
            refuse_copy(path, use)
        held = _Arrays({})
        try:
            fields = _encoded(self, type(self), "", held)
            json.dumps(fields)
        except _MISFITS as error:
            raise InputError(f"this {self.KIND} cannot be saved: {error}") from error
        content = {"kind": self.KIND, "version": self.VERSION, "equipix": __version__}
        metadata = content | {"fields": fields}
        save_pages(path, held.by_name, metadata, viewed, force=force)
        LOG.info("wrote %s: %s", path, self.KIND)


Kind = TypeVar("Kind", bound=Record)


def read_record(path: str | PathLike[str], *kinds: type[Kind]) -> Kind:
    """Read a record of one of some classes from the file that its `save` wrote.

    Parameters
    ----------
    path : path
        The file.
    *kinds : type
        The classes that are wanted.

    Returns
    -------
    Record
        As it was saved, bit by bit.

    Raises
    ------
    FileError
        If the file cannot be read, is damaged, or holds another kind or version.
    InputError
        If the suffix is unknown.
    """
    arrays, content = load_pages(path)
    wanted = {each.KIND: each for each in kinds}
    kind = str(content.get("kind"))
    LOG.info("read %s: %s", path, kind)
    if kind not in wanted:
        raise FileError(
            f"{path}: holds {kind}, expected {' or '.join(wanted)} that equipix has saved: name "
            "such a file"
        )
    version, known = content.get("version"), wanted[kind].VERSION
    if version != known:
        raise FileError(
            f"{path}: holds {kind} of version {version}, this version of equipix reads version "
            f"{known}: make the file again, or install the equipix that wrote it"
        )
    held = _Arrays(arrays)
    try:
        found: Kind = _decoded(content["fields"], wanted[kind], "", held)
        held.refuse_rest()
    except _MISFITS as error:
        raise FileError(
            f"{path}: is damaged: {error} (in {kind}): use a copy, or make it again"
        ) from error
    return found


class _Arrays:
    """Arrays of a record by name; types, sizes and checksums are checked on the way in and out."""

    def __init__(self, by_name: dict[str, Array]) -> None:
        self.by_name = by_name
        self._sizes: dict[str, int] = {}

    def put(self, name: str, array: Array, dtypes: str, axes: str) -> dict[str, Any]:
        """Take an array of a record, as an image or a stack; return what stands in its place."""
        self._check(name, array, dtypes, axes)
        stored = array.view(np.uint8) if array.dtype == np.bool_ else array
        self.by_name[name] = np.atleast_2d(stored)
        shape = [*array.shape]
        return {"dtype": array.dtype.name, "shape": shape, "crc32": _checksum(array)}

    def take(self, name: str, entry: dict[str, Any], dtypes: str, axes: str) -> Array:
        """Give back the array in whose place `entry` stands."""
        if name not in self.by_name:
            raise ValueError(f"array '{name}' is missing")
        array = self.by_name.pop(name).reshape(entry["shape"])
        if entry["dtype"] == "bool" and array.dtype == np.uint8:
            array = array.astype(np.bool_)
        self._check(name, array, dtypes, axes)
        if (array.dtype.name, _checksum(array)) != (entry["dtype"], entry["crc32"]):
            raise ValueError(f"array '{name}' differs from its checksum")
        return array

    def refuse_rest(self) -> None:
        """Refuse arrays that have no place in the record."""
        if self.by_name:
            raise ValueError(f"arrays {', '.join(self.by_name)} have no place in it")

    def _check(self, name: str, array: Array, dtypes: str, axes: str) -> None:
        """Refuse another type or number of axes, and axes of one name and several sizes."""
        wanted = axes.split()
        fits = array.dtype.name in dtypes.split("|") and array.ndim == len(wanted)
        for axis, size in zip(wanted, array.shape, strict=False):
            known = int(axis) if axis.isdecimal() else self._sizes.get(axis, size)
            fits = fits and size > 0 and size == known
            if axis != "*":
                self._sizes.setdefault(axis, size)
        if not fits:
            sizes = " ".join(str(self._sizes.get(axis, axis)) for axis in wanted)
            raise ValueError(
                f"array '{name}' is {array.dtype} of shape {array.shape}, expected {dtypes} with "
                f"the axes ({axes}), here ({sizes})"
            )


def _checksum(array: Array) -> int:
    """CRC-32 of the bytes in little-endian order, the same on every machine."""
    return zlib.crc32(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)


def _encoded(value: Any, hint: Any, name: str, held: _Arrays) -> Any:
    """Return the JSON value of a field; its arrays go to `held`."""
    inner = _without_none(hint)
    if value is None and inner is not hint:
        return None
    if typing.get_origin(inner) is Annotated:
        return held.put(name, value, *inner.__metadata__)
    if fields := _fields(inner):
        return _each(_encoded, {key: getattr(value, key) for key in fields}, fields, name, held)
    if typing.get_origin(inner) is dict:
        hints = dict.fromkeys(value, typing.get_args(inner)[1])
        return _each(_encoded, value, hints, name, held)
    if typing.get_origin(inner) is tuple:
        return [_encoded(it, each, key, held) for it, each, key in _items(value, inner, name)]
    plain = value.item() if isinstance(value, np.generic) else value
    _check_plain(plain, inner, name)
    return str(plain) if inner is float and not math.isfinite(plain) else plain


def _decoded(entry: Any, hint: Any, name: str, held: _Arrays) -> Any:
    """Return the value of a field from its JSON value and the arrays that `held` has."""
    inner = _without_none(hint)
    if entry is None and inner is not hint:
        return None
    if typing.get_origin(inner) is Annotated:
        return held.take(name, entry, *inner.__metadata__)
    if fields := _fields(inner):
        if entry.keys() != fields.keys():
            raise ValueError(f"'{name}' holds {', '.join(entry)}, expected {', '.join(fields)}")
        return inner(**_each(_decoded, entry, fields, name, held))
    if typing.get_origin(inner) is dict:
        hints = dict.fromkeys(entry, typing.get_args(inner)[1])
        return _each(_decoded, entry, hints, name, held)
    if typing.get_origin(inner) is tuple:
        return tuple(_decoded(it, each, key, held) for it, each, key in _items(entry, inner, name))
    if inner is float and entry in _NOT_FINITE:
        return float(entry)
    _check_plain(entry, inner, name)
    return entry


def _each(
    code: Callable[..., Any], entry: dict[str, Any], hints: dict[str, Any], name: str, held: _Arrays
) -> dict[str, Any]:
    """Encode or decode the named values of a field by their annotations."""
    names = {key: f"{name}.{key}" if name else key for key in hints}
    return {key: code(entry[key], hint, names[key], held) for key, hint in hints.items()}


@cache
def _fields(hint: Any) -> dict[str, Any]:
    """Annotations of the fields of a dataclass or a named tuple that are stored; else none."""
    if dataclasses.is_dataclass(hint):
        names = [each.name for each in dataclasses.fields(hint) if each.metadata != UNSAVED]
    else:
        names = [*getattr(hint, "_fields", ())]
    hints = typing.get_type_hints(hint, include_extras=True) if names else {}
    return {name: hints[name] for name in names}


def _without_none(hint: Any) -> Any:
    """Return what an annotation allows beside None; itself where None is not allowed."""
    if typing.get_origin(hint) not in (typing.Union, UnionType):
        return hint
    (inner,) = (each for each in typing.get_args(hint) if each is not NoneType)
    return inner


def _items(values: Any, hint: Any, name: str) -> list[tuple[Any, Any, str]]:
    """Entries of a tuple with the annotation and the name of each."""
    hints = typing.get_args(hint)
    if hints[-1] is Ellipsis:
        hints = hints[:1] * len(values)
    names = (f"{name}.{number}" for number in range(len(values)))
    return [*zip(values, hints, names, strict=True)]


def _check_plain(value: Any, hint: Any, name: str) -> None:
    """Refuse a JSON value of another type than its annotation."""
    if hint is Any:
        return
    if typing.get_origin(hint) is typing.Literal:
        fits, wanted = value in typing.get_args(hint), f"one of {typing.get_args(hint)}"
    else:
        fits, wanted = isinstance(value, _PLAIN[hint]), hint.__name__
        fits = fits and (hint is bool) == isinstance(value, bool)
    if not fits:
        raise ValueError(f"'{name}' is {value!r}, expected {wanted}")

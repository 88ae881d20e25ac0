"""Kills of work that writes, spread evenly over the time in which it writes.

The work runs in a child, up to where it begins to write. From there a copy of the child goes on for
each kill, so that only the writing is repeated. Every other kill comes after a share of the time,
wherever that is; the others after a share of the calls of functions, which no load of the machine
moves.
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import shutil
import signal
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from equipix.io import paths, record

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

Content = dict[str, bytes | None]
"""Bytes of each file by its name in a folder; None of a folder. Hidden files are left out, and
folders of finished pieces, with which the same command goes on."""


def content(folder: Path) -> Content:
    """What programs see of a folder."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        if not any(part.startswith(".") or part.endswith(".parts") for part in name.parts):
            found[str(name)] = None if path.is_dir() else path.read_bytes()
    return found


def restore(folder: Path, wanted: Content) -> None:
    shutil.rmtree(folder)
    folder.mkdir()
    for name, each in wanted.items():
        if each is None:
            (folder / name).mkdir()
        else:
            (folder / name).write_bytes(each)


def parts(found: Content, *, by_file: bool) -> dict[str, Content]:
    """Parts of a folder that appear whole: what stands at its top, or each file."""
    split: dict[str, Content] = {}
    for name, each in found.items():
        if not (by_file and each is None):
            split.setdefault(name if by_file else Path(name).parts[0], {})[name] = each
    return split


def torn(found: Content, old: Content, new: Content, *, by_file: bool) -> list[str]:
    """Parts that are neither the old nor the new ones."""
    now, before, after = (parts(each, by_file=by_file) for each in (found, old, new))
    names = sorted({*now, *before, *after})
    return [n for n in names if now.get(n) not in (before.get(n), after.get(n))]


def killed(work: Callable[[], object], folder: Path, count: int, *, by_file: bool) -> Any:
    """Kill work `count` times while it writes into a folder; say what it left.

    Returns how many were killed before their end, how many left all old and how many all new, and
    the parts that were neither, with the time of the kill.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        _quiet(lambda: _until_written(work, folder, count, by_file, writer))
    os.close(writer)
    with os.fdopen(reader) as pipe:
        told = pipe.read()
    os.waitpid(child, 0)
    assert told, "the work wrote nothing"
    return json.loads(told)


def _quiet(work: Callable[[], object]) -> None:
    """Do something without output, and end the process."""
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        if not os.environ.get("KILLS_SHOWN"):
            os.dup2(null, 1)
            os.dup2(null, 2)
        try:
            work()
        except SystemExit as end:
            os._exit(end.code if isinstance(end.code, int) else bool(end.code))
        os._exit(0)
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        os._exit(3)


def _until_written(
    work: Callable[[], object], folder: Path, count: int, by_file: bool, writer: int
) -> None:
    """Work, and at the first output repeat what follows."""
    original, begun = paths._temporary, []
    shared = (ctypes.c_int64 * 3).from_buffer(mmap.mmap(-1, 24))

    @contextmanager
    def temporary(target: Path) -> Iterator[Path]:
        if not begun:
            begun.append(True)
            _repeat(folder, count, by_file, writer, shared)
        with original(target) as path:
            yield path
        shared[1:] = shared[0], time.monotonic_ns()

    paths._temporary = temporary  # type: ignore[assignment]
    record.now = lambda: "2026-01-01T00:00:00+00:00"
    work()


def _repeat(folder: Path, count: int, by_file: bool, writer: int, shared: Any) -> None:
    """Return in copies of this process, each killed a little later; itself it ends.

    `shared` by all copies are the number of calls, and that and the time when all was written.
    """
    old, told = content(folder), {"killed": 0, "old": 0, "new": 0, "torn": []}
    began = time.monotonic_ns()
    child = os.fork()
    if not child:
        _count(shared, 0)
        return
    _, status = os.waitpid(child, 0)
    (_, every, end), new = shared, content(folder)
    if status or old == new:
        told["torn"].append(f"status {status}, {'nothing' if old == new else 'something'} written")
        count = 0
    for index in range(count):
        restore(folder, old)
        shared[0], share, by_calls = 0, (index + 0.5) / count, index % 2 == 0
        child = os.fork()
        if not child:
            _count(shared, int(every * share) if by_calls else 0)
            return
        if not by_calls:
            time.sleep((end - began) * share / 1e9)
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        found = content(folder)
        told["killed"] += status == signal.SIGKILL
        told["old"] += found == old
        told["new"] += found == new
        names = torn(found, old, new, by_file=by_file)
        told["torn"] += [f"{each} after {index + 0.5} of {count}" for each in names]
    os.write(writer, json.dumps(told).encode())
    os._exit(0)


def _count(shared: Any, most: int) -> None:
    """Count calls of functions and returns from them, and end after so many, unless that is 0."""

    def one(*_: object) -> None:
        shared[0] += 1
        if shared[0] == most:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.setprofile(one)

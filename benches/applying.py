"""Frames corrected by `Corrector` beside a copy, NumPy, numba and OpenCV, for `make bench`."""

from __future__ import annotations

import importlib.util
import os
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

import equipix

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Work = Callable[[], object]

LARGE, SMALL = (4096, 4096), (512, 640)
REPETITIONS = 25
TYPICAL = (-20.0, 1.0, 2e-6, -3e-11)
BYTES = {2: 12, 4: 20}
"""Bytes that a pixel moves: frame and result of 16 bits, and so many float32 coefficients."""


def polynomial(shape: tuple[int, int], planes: int) -> equipix.Polynomial:
    """A correction of so many coefficients without bad pixels."""
    rng = np.random.default_rng(1)
    spread = rng.uniform(0.9, 1.1, (planes, *shape)).astype(np.float32)
    coefficients = np.array(TYPICAL[:planes], np.float32)[:, None, None] * spread
    return equipix.Polynomial(coefficients, np.zeros(shape, np.uint32))


def rows(
    *, shapes: tuple[tuple[int, int], ...] = (LARGE, SMALL), repetitions: int = REPETITIONS
) -> list[tuple[str, str, str, str]]:
    """Measure, and give the table's rows: work, wanted, got, how."""
    large, small = shapes
    return [
        *_copy_row(large, repetitions),
        _rate_row(small, repetitions),
        *_order_rows(shapes, repetitions),
        *_rival_rows(shapes, repetitions),
    ]


def _copy_row(shape: tuple[int, int], repetitions: int) -> list[tuple[str, str, str, str]]:
    threads = len(os.sched_getaffinity(0))
    found = []
    for planes, wanted in ((2, ">= 80 %"), (4, "")):
        work = _equipix(shape, planes, threads)
        ours, copy = seconds(work, _copy(shape, BYTES[planes], threads), repetitions=repetitions)
        name = "gain and offset" if planes == 2 else "a cubic"
        found.append(
            (
                f"apply {name} to 16 bits, {_size(shape)}, share of the copy rate",
                wanted,
                f"{copy / ours:.0%}",
                f"{ours * 1e3:.2f} ms, copy {copy * 1e3:.2f} ms, {threads} threads",
            )
        )
    return found


def _rate_row(shape: tuple[int, int], repetitions: int) -> tuple[str, str, str, str]:
    (ours,) = seconds(_equipix(shape, 2, 1), repetitions=repetitions)
    return (
        f"apply gain and offset to 16 bits, {_size(shape)}, one thread",
        ">= 3 Gpixel/s",
        f"{shape[0] * shape[1] / ours / 1e9:.2f} Gpixel/s",
        f"{ours * 1e3:.3f} ms a frame",
    )


def _order_rows(
    shapes: tuple[tuple[int, int], ...], repetitions: int
) -> list[tuple[str, str, str, str]]:
    found = []
    for shape in shapes:
        works = [_equipix(shape, planes, 1) for planes in (2, 4)]
        linear, cubic = seconds(*works, repetitions=repetitions)
        how = f"{cubic * 1e3:.3f} ms, linear {linear * 1e3:.3f} ms, one thread"
        found.append(
            (
                f"apply a cubic, {_size(shape)}, against linear",
                "<= 2.2 x",
                f"{cubic / linear:.2f} x",
                how,
            )
        )
    return found


def _rival_rows(
    shapes: tuple[tuple[int, int], ...], repetitions: int
) -> list[tuple[str, str, str, str]]:
    found = []
    for shape in shapes:
        rivals = {"NumPy": _numpy(shape), "numba": _numba(shape), "OpenCV": _opencv(shape)}
        known = {name: work for name, work in rivals.items() if work is not None}
        ours, *theirs = seconds(_equipix(shape, 2, None), *known.values(), repetitions=repetitions)
        for name, other in zip(known, theirs, strict=True):
            how = f"{ours * 1e3:.3f} ms, {name} {other * 1e3:.3f} ms"
            work = f"apply gain and offset to 16 bits, {_size(shape)}, against {name}"
            found.append((work, "> 1 x", f"{other / ours:.1f} x", how))
    return found


def seconds(*works: Work, repetitions: int) -> list[float]:
    """Median time of each work, taken in turn, after a first round."""
    times: list[list[float]] = [[] for _ in works]
    for _ in range(repetitions + 1):
        for taken, work in zip(times, works, strict=True):
            start = time.perf_counter()
            work()
            taken.append(time.perf_counter() - start)
    return [float(np.median(taken[1:])) for taken in times]


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[1]}×{shape[0]}"


def _frame(shape: tuple[int, int]) -> NDArray[np.uint16]:
    return np.random.default_rng(2).integers(0, 60000, shape, dtype=np.uint16)


def _equipix(shape: tuple[int, int], planes: int, workers: int | None) -> Work:
    corrector = equipix.Corrector(polynomial(shape, planes), workers=workers)
    frame, out = _frame(shape), np.empty(shape, np.uint16)
    return lambda: corrector.apply(frame, out)


def _copy(shape: tuple[int, int], nbytes: int, threads: int) -> Work:
    """Copy half as many bytes as are moved in all: they are read and written."""
    source = np.ones(shape[0] * shape[1] * nbytes // 2, np.uint8)
    targets = np.array_split(np.empty_like(source), threads)
    sources, pool = np.array_split(source, threads), ThreadPoolExecutor(threads)
    return lambda: list(pool.map(np.copyto, targets, sources))


def _numpy(shape: tuple[int, int]) -> Work:
    offset, gain = polynomial(shape, 2).coefficients
    frame, out, values = _frame(shape), np.empty(shape, np.uint16), np.empty(shape, np.float32)

    def work() -> None:
        np.multiply(frame, gain, out=values)
        np.add(values, offset, out=values)
        np.rint(values, out=values)
        np.clip(values, 0, 65535, out=values)
        np.copyto(out, values, casting="unsafe")

    return work


def _numba(shape: tuple[int, int]) -> Work | None:
    if importlib.util.find_spec("numba") is None:
        return None
    import numba

    @numba.njit(parallel=True)  # type: ignore[untyped-decorator]
    def correct(frame: Any, offset: Any, gain: Any, out: Any) -> None:
        for row in numba.prange(frame.shape[0]):
            for col in range(frame.shape[1]):
                value = np.rint(frame[row, col] * gain[row, col] + offset[row, col])
                out[row, col] = np.uint16(min(max(value, 0.0), 65535.0))

    offset, gain = polynomial(shape, 2).coefficients
    frame, out = _frame(shape), np.empty(shape, np.uint16)
    return lambda: correct(frame, offset, gain, out)


def _opencv(shape: tuple[int, int]) -> Work | None:
    if importlib.util.find_spec("cv2") is None:
        return None
    import cv2

    offset, gain = polynomial(shape, 2).coefficients
    frame, out, values = _frame(shape), np.empty(shape, np.uint16), np.empty(shape, np.float32)

    def work() -> None:
        cv2.multiply(frame, gain, dst=values, dtype=cv2.CV_32F)
        cv2.add(values, offset, dst=out, dtype=cv2.CV_16U)

    return work

"""Frames corrected by `Corrector` beside a copy, NumPy, numba and OpenCV, for `make bench`."""

from __future__ import annotations

import importlib.util
import itertools
import os
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

import equipix

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    Work = Callable[[], object]

LARGE, SMALL = (4096, 4096), (512, 640)
REPETITIONS = 25
STREAM = 64
"""Frames of a stream, each an array: at 640×512 with results more than a cache of 32 MB holds."""
BURST = 0.04
"""Seconds of a burst of calls of one work.

The first half is not measured: threads of the work before may still wait without sleep."""
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
    """Compare with rivals on all threads, on one thread, and over a stream of frames."""
    found = []
    for shape, name in [*((shape, _size(shape)) for shape in shapes), (shapes[-1], "")]:
        count, title = (1, name) if name else (STREAM, f"a stream of {_size(shape)}")
        for threads in (None, 1):
            rivals = {
                "NumPy": _numpy(shape, count),
                "numba": _numba(shape, count, threads),
                "OpenCV": _opencv(shape, count, threads),
            }
            known = {rival: work for rival, work in rivals.items() if work is not None}
            ours, *theirs = bursts(
                _equipix(shape, 2, threads, count), *known.values(), repetitions=repetitions
            )
            for rival, other in zip(known, theirs, strict=True):
                how = f"{ours * 1e3:.3f} ms, {rival} {other * 1e3:.3f} ms"
                alone = ", one thread" if threads else ""
                work = f"apply gain and offset to 16 bits, {title}{alone}, against {rival}"
                found.append((work, "> 1 x", f"{other / ours:.1f} x", how))
    return found


def bursts(*works: Work, repetitions: int) -> list[float]:
    """Median time of each work over bursts of calls, taken in turn."""
    times: list[list[float]] = [[] for _ in works]
    for _ in range(repetitions + 1):
        for taken, work in zip(times, works, strict=True):
            calls = [_elapsed(work)]
            while sum(calls) < BURST:
                calls.append(_elapsed(work))
            taken.append(float(np.mean(calls[len(calls) // 2 :])))
    return [float(np.median(taken[1:])) for taken in times]


def _elapsed(work: Work) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def seconds(*works: Work, repetitions: int) -> list[float]:
    """Median time of each work, taken in turn, after a first round."""
    times: list[list[float]] = [[] for _ in works]
    for _ in range(repetitions + 1):
        for taken, work in zip(times, works, strict=True):
            taken.append(_elapsed(work))
    return [float(np.median(taken[1:])) for taken in times]


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[1]}×{shape[0]}"


def _frames(
    shape: tuple[int, int], count: int
) -> Iterator[tuple[NDArray[np.uint16], NDArray[np.uint16]]]:
    """Frames and arrays for their results, over and over."""
    rng = np.random.default_rng(2)
    frames = [rng.integers(0, 60000, shape, dtype=np.uint16) for _ in range(count)]
    return itertools.cycle([(frame, np.zeros_like(frame)) for frame in frames])


def _equipix(shape: tuple[int, int], planes: int, workers: int | None, count: int = 1) -> Work:
    corrector = equipix.Corrector(polynomial(shape, planes), workers=workers)
    frames = _frames(shape, count)
    return lambda: corrector.apply(*next(frames))


def _copy(shape: tuple[int, int], nbytes: int, threads: int) -> Work:
    """Copy half as many bytes as are moved in all: they are read and written."""
    source = np.ones(shape[0] * shape[1] * nbytes // 2, np.uint8)
    targets = np.array_split(np.empty_like(source), threads)
    sources, pool = np.array_split(source, threads), ThreadPoolExecutor(threads)
    return lambda: list(pool.map(np.copyto, targets, sources))


def _numpy(shape: tuple[int, int], count: int) -> Work:
    offset, gain = polynomial(shape, 2).coefficients
    frames, values = _frames(shape, count), np.empty(shape, np.float32)

    def work() -> None:
        frame, out = next(frames)
        np.multiply(frame, gain, out=values)
        np.add(values, offset, out=values)
        np.rint(values, out=values)
        np.clip(values, 0, 65535, out=values)
        np.copyto(out, values, casting="unsafe")

    return work


def _numba(shape: tuple[int, int], count: int, threads: int | None) -> Work | None:
    if importlib.util.find_spec("numba") is None:
        return None
    import numba

    @numba.njit(parallel=threads is None)  # type: ignore[untyped-decorator]
    def correct(frame: Any, offset: Any, gain: Any, out: Any) -> None:
        for row in numba.prange(frame.shape[0]):
            for col in range(frame.shape[1]):
                value = np.rint(frame[row, col] * gain[row, col] + offset[row, col])
                out[row, col] = np.uint16(min(max(value, 0.0), 65535.0))

    offset, gain = polynomial(shape, 2).coefficients
    frames = _frames(shape, count)

    def work() -> None:
        frame, out = next(frames)
        correct(frame, offset, gain, out)

    return work


def _opencv(shape: tuple[int, int], count: int, threads: int | None) -> Work | None:
    if importlib.util.find_spec("cv2") is None:
        return None
    import cv2

    offset, gain = polynomial(shape, 2).coefficients
    frames, values = _frames(shape, count), np.empty(shape, np.float32)

    def work() -> None:
        frame, out = next(frames)
        cv2.setNumThreads(-1 if threads is None else threads)
        cv2.multiply(frame, gain, dst=values, dtype=cv2.CV_32F)
        cv2.add(values, offset, dst=out, dtype=cv2.CV_16U)

    return work

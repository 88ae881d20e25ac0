"""Frames of arrays and iterables, checked, a few at a time."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix._check import as_array
from equipix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

_BATCH = 16  # frames handed over at once
_BATCH_BYTES = 2**26
_SUMMABLE = ("uint8", "uint16", "float32", "float64")


def batches(frames: NDArray[Any] | Iterator[Any]) -> Iterator[NDArray[Any]]:
    """Give the frames a few at a time: views of an array, copies of what an iterator gives."""
    if isinstance(frames, np.ndarray):
        if frames.ndim != 3 or 0 in frames.shape:
            raise InputError(
                f"'source' has shape {frames.shape}, expected (frames, rows, cols), none of them 0"
            )
        size = _batch_size(frames[0])
        yield from (frames[start : start + size] for start in range(0, len(frames), size))
        return
    first = _frame(0, next(frames))
    empty = np.ma.empty if isinstance(first, np.ma.MaskedArray) else np.empty
    batch = empty((_batch_size(first), *first.shape), first.dtype)
    filled = 0
    for index, item in enumerate(itertools.chain([first], frames)):
        frame = _frame(index, item)
        if type(frame) is not type(first):
            raise InputError(
                f"'source[{index}]' is a {type(frame).__name__}, expected a {type(first).__name__}"
                " like the first: give all frames as masked arrays, or none"
            )
        if frame.shape != first.shape or frame.dtype != first.dtype:
            raise InputError(
                f"'source[{index}]' is {frame.dtype} of shape {frame.shape}, expected"
                f" {first.dtype} of shape {first.shape} like the first"
            )
        batch[filled] = frame
        filled += 1
        if filled == len(batch):
            yield batch
            filled = 0
    if filled:
        yield batch[:filled]


def _frame(index: int, item: Any) -> NDArray[Any]:
    """Check one frame of an iterable; a masked array stays one."""
    name, masked = f"source[{index}]", isinstance(item, np.ma.MaskedArray)
    frame = as_array(name, np.ma.getdata(item) if masked else item, ndim=2)
    return np.ma.array(frame, mask=np.ma.getmaskarray(item)) if masked else frame


def _batch_size(frame: NDArray[Any]) -> int:
    return max(1, min(_BATCH, _BATCH_BYTES // max(1, frame.nbytes)))


def sum_dtype(frames: NDArray[Any]) -> np.dtype[Any]:
    """Choose the dtype that frames are summed in: their own, or float64.

    Masked samples are summed as NaN, which does not count, so whole numbers need float64.
    """
    dtype = frames.dtype
    if dtype.kind not in "buif":
        raise InputError(f"'source' has dtype {dtype}, expected real numbers")
    masked = isinstance(frames, np.ma.MaskedArray) and dtype.kind != "f"
    return np.dtype(dtype.name if dtype.name in _SUMMABLE and not masked else "float64")


def unmasked(batch: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return a batch with NaN in the place of masked samples."""
    if not isinstance(batch, np.ma.MaskedArray):
        return batch
    return np.where(np.ma.getmaskarray(batch), dtype.type(np.nan), np.ma.getdata(batch))

"""Averaging: against the NumPy reference, simulated truth, laws, and real frames."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import textwrap
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import equipix
from equipix.errors import FileError, InputError
from equipix.io.tiff import write_frames
from reference.average import average as reference

if TYPE_CHECKING:
    from pathlib import Path

    from equipix import FrameStatistics

EPS = np.finfo(np.float64).eps
DTYPES = [np.uint8, np.uint16, np.float32, np.float64]


def stacks(dtypes: list[type] = DTYPES) -> st.SearchStrategy[np.ndarray]:
    """Frame stacks from 1x1 pixel and one frame on, past the sizes of batch and block."""
    shapes = st.tuples(st.integers(1, 40), st.integers(1, 50), st.integers(1, 50))
    seeds = st.integers(0, 2**32 - 1)
    return st.builds(_stack, st.sampled_from(dtypes), shapes, seeds)


def _stack(dtype: type, shape: tuple[int, int, int], seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    if np.issubdtype(dtype, np.integer):
        return rng.integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)
    frames = rng.normal(1000, 30, shape).astype(dtype)
    frames[rng.random(shape) < 0.05] = np.nan
    frames[0, 0, 0] = 1000  # without any number they are refused
    return frames


def assert_agrees(result: FrameStatistics, frames: np.ndarray) -> None:
    """Agreement with the two-pass reference, bounded by the rounding of both.

    Integer sums are exact in both, so the means differ by one division at most. A sum of n terms
    errs by n eps max|x| each way. An error e of the mean moves a deviation d by e, so the scatter
    by 2 e Σ|d| + n e² with Σ|d| <= sqrt(n scatter), beside its own n roundings.
    """
    wanted = reference(frames)
    np.testing.assert_array_equal(result.count, wanted.count)
    np.testing.assert_array_equal(result.saturated, wanted.saturated)
    n = len(frames)
    top = np.nanmax(np.abs(frames.astype(np.float64)), initial=0)
    slack = 2 * (n + 8) * EPS * top
    exact = frames.dtype.kind == "u"
    np.testing.assert_allclose(result.mean, wanted.mean, rtol=EPS, atol=0 if exact else slack)
    scatter = wanted.variance * (wanted.count - 1)
    bound = 2 * slack * np.sqrt(n * scatter) + n * slack**2 + 2 * (n + 8) * EPS * scatter
    bound = bound / np.maximum(wanted.count - 1, 1)
    both_nan = np.isnan(result.variance) & np.isnan(wanted.variance)
    assert np.all(both_nan | (np.abs(result.variance - wanted.variance) <= bound))
    np.testing.assert_array_equal(np.isnan(wanted.variance), wanted.count < 2)
    np.testing.assert_array_equal(
        result.variance_of_mean, result.variance / np.maximum(wanted.count, 1)
    )


@given(stacks())
@settings(max_examples=60, deadline=None)
def test_agrees_with_reference(frames: np.ndarray) -> None:
    assert_agrees(equipix.average(frames), frames)
    assert_agrees(equipix.average(iter(frames)), frames)


steps = st.tuples(*[st.sampled_from([-3, -2, -1, 1, 2, 3])] * 3)


@given(stacks(), st.permutations([0, 1, 2]), steps)
@settings(max_examples=40, deadline=None)
def test_takes_any_strides_and_read_only_arrays(
    frames: np.ndarray, axes: list[int], step: tuple[int, int, int]
) -> None:
    strided = frames.transpose(axes)[:: step[0], :: step[1], :: step[2]]
    strided.flags.writeable = False
    assert_agrees(equipix.average(strided), np.ascontiguousarray(strided))


@pytest.mark.parametrize("dtype", ["int16", "int32", "uint32", "int64", "bool", "float16", ">u2"])
def test_other_dtypes_become_float64(dtype: str) -> None:
    frames = np.random.default_rng(3).integers(0, 2, (20, 5, 7)).astype(dtype)
    result = equipix.average(frames)
    wanted = equipix.average(frames.astype(np.float64))
    np.testing.assert_allclose(result.mean, wanted.mean, rtol=4 * EPS)
    np.testing.assert_allclose(result.variance, wanted.variance, rtol=40 * EPS)


def test_saturation_defaults_to_the_dtypes_maximum() -> None:
    for dtype in (np.uint8, np.uint16, np.int16):
        frames = np.array([[[0, 5]], [[np.iinfo(dtype).max, 6]]], dtype=dtype)
        np.testing.assert_array_equal(equipix.average(frames).saturated, [[1, 0]])
        np.testing.assert_array_equal(equipix.average(frames, saturation=5.5).saturated, [[1, 1]])
        np.testing.assert_array_equal(equipix.average(frames, saturation=1e9).saturated, [[0, 0]])
    frames = np.array([[[1e30, 4095.0]]])
    np.testing.assert_array_equal(equipix.average(frames).saturated, [[0, 0]])
    np.testing.assert_array_equal(equipix.average(frames, saturation=4095).saturated, [[1, 1]])


def test_variance_is_exact_where_naive_sums_cancel() -> None:
    frames = np.full((1001, 1, 1), 65534, np.uint16)
    frames[0] = 65535
    # Σ(x − x̄)² of one sample that is 1 above n − 1 others is 1 − 1/n.
    assert equipix.average(frames).variance[0, 0] == (1 - 1 / 1001) / 1000
    far = 1e8 + np.random.default_rng(2).normal(0, 1e-3, (500, 1, 1))
    assert_agrees(equipix.average(far), far)


def test_samples_that_are_not_finite_do_not_count() -> None:
    frames = np.array([np.nan, 1, np.inf, 3, -np.inf, np.nan]).reshape(6, 1, 1)
    result = equipix.average(frames)
    assert (result.mean, result.variance, result.count) == (2, 2, 2)
    pixels = np.ones((20, 1, 2)) * [np.nan, 3]
    empty = equipix.average(pixels)
    assert np.isnan(empty.mean[0, 0])
    assert np.isnan(empty.variance_of_mean[0, 0])
    assert empty.count.tolist() == [[0, 20]]


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_frames_without_a_number_are_refused(value, dtype, tmp_path) -> None:
    frames = np.full((3, 4, 5), value, dtype)
    write_frames(tmp_path / "raw.tif", iter(frames), nbytes=frames.nbytes)
    for source in (frames, list(frames), tmp_path / "raw.tif", np.ma.masked_all((3, 4, 5))):
        with pytest.raises(InputError, match="'frames' holds no finite number: give frames with"):
            equipix.average(source)


def same_bytes(a: FrameStatistics, b: FrameStatistics) -> bool:
    return all(
        x.tobytes() == y.tobytes() for x, y in zip(a.maps.values(), b.maps.values(), strict=True)
    )


@given(stacks())
@settings(max_examples=30, deadline=None)
def test_same_bytes_for_any_number_of_workers(frames: np.ndarray) -> None:
    one = equipix.average(frames, workers=1)
    assert same_bytes(one, equipix.average(frames, workers=2))
    assert same_bytes(one, equipix.average(frames, workers=5))
    assert same_bytes(one, equipix.average(list(frames)))


@given(stacks(), st.randoms(use_true_random=False))
@settings(max_examples=30, deadline=None)
def test_order_of_frames_does_not_matter(frames: np.ndarray, random: object) -> None:
    order = list(range(len(frames)))
    random.shuffle(order)  # type: ignore[attr-defined]
    result = equipix.average(frames[order])
    if frames.dtype.kind == "u":
        assert same_bytes(result, equipix.average(frames))
    assert_agrees(result, frames)


@given(stacks([np.float64]))
@settings(max_examples=30, deadline=None)
def test_scaling_by_a_power_of_two_is_exact(frames: np.ndarray) -> None:
    plain, scaled = equipix.average(frames), equipix.average(frames * 8)
    np.testing.assert_array_equal(scaled.mean, plain.mean * 8)
    np.testing.assert_array_equal(scaled.variance, plain.variance * 64)


def test_simulated_truth_within_standard_errors() -> None:
    mean, std, n = 200.0, 9.0, 400
    frames = np.random.default_rng(11).normal(mean, std, (n, 40, 50))
    result = equipix.average(frames)
    z_mean = (result.mean - mean) / (std / np.sqrt(n))
    # The sample variance of a normal variable has the variance 2 σ⁴ / (n − 1).
    z_variance = (result.variance - std**2) / (std**2 * np.sqrt(2 / (n - 1)))
    for z in (z_mean, z_variance):
        # Mean of 2000 z-scores within 4 standard errors; their spread within 4 of its own, where
        # the skewness of χ² widens it by a few per cent at most.
        assert abs(z.mean()) < 4 / np.sqrt(z.size)
        assert abs(z.std() - 1) < 4 * 1.1 / np.sqrt(2 * z.size)


def test_dark_is_subtracted_with_its_variance() -> None:
    rng = np.random.default_rng(4)
    frames = rng.integers(90, 200, (9, 4, 5), dtype=np.uint16)
    darks = rng.integers(0, 30, (5, 4, 5), dtype=np.uint16)
    plain, dark = equipix.average(frames), equipix.average(darks)
    result = equipix.average(frames, dark=dark)
    np.testing.assert_array_equal(result.mean, plain.mean - dark.mean)
    np.testing.assert_array_equal(result.variance, plain.variance)
    np.testing.assert_array_equal(
        result.variance_of_mean, plain.variance_of_mean + dark.variance_of_mean
    )
    known = equipix.average(frames, dark=dark.mean)
    np.testing.assert_array_equal(known.mean, result.mean)
    np.testing.assert_array_equal(known.variance_of_mean, plain.variance_of_mean)


FRAMES = np.zeros((3, 4, 5), np.uint8)


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        (np.zeros((4, 5)), {}, r"'frames' has shape \(4, 5\), expected \(frames, rows, cols\)"),
        (np.zeros((0, 4, 5)), {}, "'frames' has shape"),
        (np.zeros((2, 0, 5)), {}, "'frames' has shape"),
        (np.zeros((2, 4, 5), complex), {}, "'frames' has dtype complex128"),
        ([], {}, "'frames' holds no frames"),
        (7, {}, "'frames' is a int"),
        ([FRAMES[0], FRAMES[0, 1:]], {}, r"'frames\[1\]' is uint8 of shape \(3, 5\)"),
        ([FRAMES[0], FRAMES[0].astype(float)], {}, r"'frames\[1\]' is float64"),
        ([FRAMES], {}, r"'frames\[0\]' has shape \(3, 4, 5\)"),
        ([None], {}, r"'frames\[0\]' is of type NoneType, expected an array"),
        (FRAMES, {"dark": np.zeros((5, 4))}, r"'dark' has shape \(5, 4\), expected \(4, 5\)"),
        (FRAMES, {"dark": np.zeros(4)}, "'dark' has shape"),
        (FRAMES, {"dark": np.full((4, 5), np.nan)}, "'dark' holds no finite number"),
        (FRAMES, {"saturation": np.nan}, "'saturation' is nan"),
        (FRAMES, {"saturation": "full"}, "'saturation' is 'full'"),
        (FRAMES, {"workers": 0}, "'workers' is 0"),
    ],
)
def test_bad_input_is_named(source: object, options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        equipix.average(source, **options)  # type: ignore[arg-type]


def test_iterable_is_never_collected() -> None:
    alive = 0

    class Frame(np.ndarray):
        def __del__(self) -> None:
            nonlocal alive
            alive -= 1

    def frames() -> object:
        nonlocal alive
        for level in range(100):
            alive += 1
            assert alive <= 3
            yield np.full((4, 5), level, np.uint16).view(Frame)

    assert np.all(equipix.average(frames()).mean == 49.5)


def test_progress_is_reported_and_may_stop_the_work() -> None:
    calls: list[tuple[int, int, str]] = []
    equipix.average(np.zeros((40, 2, 2)), progress=lambda *state: calls.append(state))
    assert calls[-1] == (40, 40, "average")

    def stop(*_: object) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        equipix.average(np.zeros((40, 2, 2)), progress=stop)


@pytest.mark.data
def test_photon_transfer_gain_of_a_real_camera(data_dir: Path) -> None:
    """K of EMVA 1288 set 001, 0.280 DN per electron by the public reference package."""
    images = data_dir / "emva1288-set001-ccd-12bit" / "images"
    dark = equipix.average(images / "d_s_000_snap_*.png", saturation=4095)
    bright = equipix.average(images / "b_s_000_snap_*.png", dark=dark, saturation=4095)
    assert np.all(dark.count == 50)
    assert bright.mean.shape == (480, 640)
    gain = (bright.variance.mean() - dark.variance.mean()) / bright.mean.mean()
    assert gain == pytest.approx(0.280, rel=0.02)


def run(script: str, *arguments: object) -> str:
    """Run a script in a fresh interpreter."""
    command = [sys.executable, "-W", "error", "-c", textwrap.dedent(script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_works_in_a_forked_child() -> None:
    run(
        """
        import os
        import numpy as np, equipix
        frames = np.arange(40, dtype=np.uint16).reshape(10, 2, 2)
        before = equipix.average(frames, workers=2).mean
        child = os.fork() if os.name == "posix" else 0
        if child == 0:
            os._exit(0 if np.array_equal(equipix.average(frames, workers=2).mean, before) else 1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        """
    )


@pytest.mark.parametrize("kind", ["files", "generator"])
def test_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path, kind: str) -> None:
    import tifffile

    tifffile.imwrite(tmp_path / "0.tif", np.full((582, 782), 7, np.uint16))
    for index in range(1, 1000):
        (tmp_path / f"{index}.tif").hardlink_to(tmp_path / "0.tif")
    script = """
        import resource, sys
        import numpy as np, equipix
        folder, kind, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
        files = [f"{folder}/{index}.tif" for index in range(count)]
        frames = (np.full((582, 782), index, np.uint16) for index in range(count))
        result = equipix.average(files if kind == "files" else frames)
        assert np.all(result.count == count)
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        """
    few, many = (int(run(script, tmp_path, kind, count)) for count in (20, 1000))
    assert many < 1.05 * few


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"none\.tif: does not exist"):
        equipix.average(tmp_path / "none.tif")
    with pytest.raises(FileError, match=r"x\*\.tif: no file matches"):
        equipix.average(f"{tmp_path}/x*.tif")
    with pytest.raises(FileError, match=r"is a folder.*\*\.tif"):
        equipix.average(tmp_path)


@pytest.mark.parametrize("dtype", ["uint16", "float32", "float64"])
@pytest.mark.parametrize("as_list", [False, True], ids=["array", "list"])
def test_masked_samples_do_not_count(dtype: str, as_list: bool) -> None:
    """A frame with samples of 60 000 over a scene of 100, masked by numpy.ma."""
    values = np.random.default_rng(1).integers(98, 104, (7, 5, 6)).astype(dtype)
    spoilt = np.zeros(values.shape, bool)
    spoilt[3, 1:3, 2:5] = True
    frames = np.ma.array(np.where(spoilt, dtype_of(dtype)(60_000), values), mask=spoilt)
    found = equipix.average(list(frames) if as_list else frames)
    wanted = equipix.average(np.where(spoilt, np.nan, values.astype("float64")))
    np.testing.assert_array_equal(found.count, wanted.count)
    # Sums of seven whole numbers are exact.
    np.testing.assert_array_equal(found.mean, wanted.mean)
    np.testing.assert_allclose(found.variance, wanted.variance, rtol=8 * np.finfo(float).eps)


def dtype_of(name: str) -> type:
    return np.dtype(name).type


def test_masked_whole_numbers_keep_their_saturation_level() -> None:
    values = np.full((2, 3, 4), 255, np.uint8)
    frames = np.ma.array(values, mask=np.zeros(values.shape, bool))
    frames[0, 0, 0] = np.ma.masked
    assert equipix.average(frames).saturated.sum() == 2 * 3 * 4 - 1


def test_frames_with_a_mask_and_without_are_not_mixed() -> None:
    frame = np.ones((3, 4))
    with pytest.raises(InputError, match=r"'frames\[1\]' is masked float64 .*, expected float64"):
        equipix.average([frame, np.ma.masked_equal(frame, 2)])


def test_masked_pixels_have_no_mean() -> None:
    frames = np.arange(24, dtype=np.uint16).reshape(2, 3, 4)
    mask = np.zeros((3, 4), bool)
    mask[1, 2] = True
    found, whole = equipix.average(frames, mask=mask), equipix.average(frames)
    assert found.count[1, 2] == found.saturated[1, 2] == 0
    for name, values in found.maps.items():
        assert np.isnan(values[mask]).all() or not values[mask].any()
        np.testing.assert_array_equal(values[~mask], whole.maps[name][~mask])


@pytest.mark.parametrize(
    "mask", [np.zeros((3, 4)), np.zeros((4, 3), bool), np.ones((3, 4), bool), "mask"]
)
def test_a_mask_that_is_none_is_refused(mask: object) -> None:
    with pytest.raises(InputError, match="'mask'"):
        equipix.average(np.ones((2, 3, 4)), mask=mask)  # type: ignore[arg-type]


@pytest.mark.parametrize("level", [0, -1, float("nan")])
def test_a_saturation_level_is_above_0(level: float) -> None:
    with pytest.raises(InputError, match=r"'saturation' is .*above 0"):
        equipix.average(np.ones((2, 3, 4)), saturation=level)


@pytest.mark.parametrize("name", ["variance", "variance_of_mean", "count", "saturated", "dark"])
def test_statistics_of_different_shapes_are_refused_by_name(name: str) -> None:
    good, other = equipix.average(np.ones((3, 4, 5))), equipix.average(np.ones((3, 4, 6)))
    wrong = other if name == "dark" else getattr(other, name)
    with pytest.raises(InputError, match=rf"'{name}' of FrameStatistics has shape \(4, 6\)"):
        dataclasses.replace(good, **{name: wrong})


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_a_variance_that_is_none_is_refused(value: float) -> None:
    rng = np.random.default_rng(1)
    shifts = [(0, 0), (0, 3), (3, 0)]
    frames = [equipix.average(rng.normal(1000, 5, (4, 20, 30))) for _ in shifts]
    variance = frames[1].variance.copy()
    variance[2, 3] = value
    frames[1] = dataclasses.replace(frames[1], variance=variance)
    with pytest.raises(InputError, match=f"exposure 1: 'variance' holds {value:g}, expected"):
        equipix.calibrate(frames, shifts)

"""The NumPy reference against dense algebra, known truths and hand-made cases."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import numpy as np
import pytest

import reference
from equipix import metrics, simulate

CROSS = [(0, 0), (0, 2), (0, 3), (2, 0), (3, 0)]


def measured(shape, shifts, *, noise=1e-3, seed=1, **options):
    """A sensor and exposures of it with Gaussian noise."""
    rng = np.random.default_rng(seed)
    sensitivity = simulate.paper_sensitivity(shape, rng=rng)
    beam = simulate.gaussian_beam(shape, width=20)
    frames = simulate.exposures(sensitivity, beam, shifts, **options)
    return sensitivity, frames + noise * rng.standard_normal(frames.shape)


def imported(source):
    """First names of the modules that a source imports."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield (node.module or "reference").split(".")[0]


@pytest.mark.parametrize(
    "path", sorted(Path(reference.__file__).parent.glob("*.py")), ids=lambda path: path.stem
)
def test_the_reference_imports_numpy_alone(path):
    allowed = {"numpy", "reference"} | sys.stdlib_module_names
    assert set(imported(path.read_text())) <= allowed


def test_imports_are_found_wherever_they_stand():
    source = "import a.b as c, d\ndef f():\n    from e.f import g\n    from . import h"
    assert list(imported(source)) == ["a", "d", "e", "reference"]


class TestGrid:
    def test_covers_what_is_seen_and_always_shift_zero(self):
        cells, grid_shape, origin = reference.grid_cells((3, 4), [(2, -1), (5, 2)])
        assert grid_shape == (8, 7)
        assert origin == (0, 1)
        assert cells[0, 0, 0] == 2 * 7
        assert cells[1, 2, 3] == 8 * 7 - 1

    @pytest.mark.parametrize("rotation", [0, 90, 180, 270])
    def test_rotations_agree_with_the_beam_evaluated_in_place(self, rotation):
        shape, shift = (3, 5), [(-2, 4)]
        beam = simulate.gaussian_beam(shape, width=7, centre=(0, 1))
        cells, (rows, cols), (row, col) = reference.grid_cells(shape, shift, [rotation])
        grid = beam(np.arange(rows)[:, None] - row, np.arange(cols) - col)
        frame = reference.exposures(np.ones(shape), grid, np.ones(1), cells)[0]
        expected = simulate.exposures(np.ones(shape), beam, shift, rotation=[rotation])[0]
        np.testing.assert_allclose(frame, expected, rtol=1e-15)


class TestCoordinateDescent:
    @pytest.mark.parametrize("shape", [(7, 9), (9, 6)])
    @pytest.mark.parametrize("rotation", [None, [0, 0, 90, 180, 270]])
    def test_reaches_the_dense_minimum(self, shape, rotation):
        rng = np.random.default_rng(4)
        flux = rng.uniform(0.9, 1.1, 5)
        _, frames = measured(shape, CROSS, flux=flux, rotation=rotation)
        options = {
            "flux": flux,
            "rotation": rotation,
            "variance": rng.uniform(1, 2, frames.shape),
            "mask": rng.random(frames.shape) < 0.1,
        }
        dense = reference.solve_dense(frames, CROSS, **options)
        swept = reference.coordinate_descent(frames, CROSS, sweeps=3000, **options)
        # Both solve equations of condition below 1e3 in double precision.
        assert swept.objective[-1] == pytest.approx(dense.objective[-1], rel=1e-11)
        np.testing.assert_allclose(swept.sensitivity, dense.sensitivity, atol=1e-11)
        np.testing.assert_allclose(swept.beam, dense.beam, atol=1e-11)

    def test_finds_the_truth_without_noise(self):
        sensitivity, frames = measured((8, 11), CROSS, noise=0)
        solution = reference.coordinate_descent(frames, CROSS, sweeps=1000)
        assert abs(metrics.relative_error(solution.sensitivity, sensitivity)).max() < 1e-12
        assert np.mean(solution.sensitivity) == pytest.approx(1, rel=1e-14)

    def test_the_objective_never_rises(self):
        _, frames = measured((8, 11), CROSS, noise=0.1)
        objective = np.array(reference.coordinate_descent(frames, CROSS, sweeps=200).objective)
        assert (np.diff(objective) <= 1e-14 * objective[0]).all()

    def test_nan_counts_as_masked(self):
        _, frames = measured((6, 7), CROSS)
        mask = np.random.default_rng(2).random(frames.shape) < 0.1
        masked = reference.coordinate_descent(frames, CROSS, mask=mask)
        missing = reference.coordinate_descent(np.where(mask, np.nan, frames), CROSS)
        np.testing.assert_array_equal(masked.sensitivity, missing.sensitivity)

    def test_variance_may_be_given_by_exposure(self):
        _, frames = measured((6, 7), CROSS)
        variance = np.array([1.0, 2, 3, 4, 5])
        by_exposure = reference.coordinate_descent(frames, CROSS, variance=variance)
        everywhere = np.broadcast_to(variance[:, None, None], frames.shape)
        by_value = reference.coordinate_descent(frames, CROSS, variance=everywhere)
        np.testing.assert_array_equal(by_exposure.sensitivity, by_value.sensitivity)

    def test_what_nobody_measured_is_nan(self):
        _, frames = measured((6, 7), CROSS)
        mask = np.zeros((6, 7), bool)
        mask[2, 3] = True
        solution = reference.coordinate_descent(frames, CROSS, mask=mask)
        assert np.argwhere(np.isnan(solution.sensitivity)).tolist() == [[2, 3]]
        assert solution.component_labels[2, 3] == -1
        # The corner between the arms of the cross; cell (2, 3) is seen by other exposures.
        np.testing.assert_array_equal(np.isnan(solution.beam[6:, 7:]), True)
        assert np.isfinite(solution.beam[:6, :7]).all()

    def test_each_component_has_a_gauge_of_its_own(self):
        sensitivity, frames = measured((4, 6), [(0, 0), (0, 2)], noise=0)
        solution = reference.coordinate_descent(frames, [(0, 0), (0, 2)], sweeps=500)
        # Rows do not meet, and in a row odd and even columns do not: 8 components of 3 pixels.
        assert solution.component_labels.tolist() == [[2 * r, 2 * r + 1] * 3 for r in range(4)]
        first = np.s_[0, ::2]
        expected = sensitivity[first] / sensitivity[first].mean()
        np.testing.assert_allclose(solution.sensitivity[first], expected, rtol=1e-12)
        assert np.isnan(solution.sensitivity[1:]).all()
        assert np.isnan(solution.sensitivity[0, 1::2]).all()
        model = solution.beam[0, 0:6:2] * solution.sensitivity[first]
        np.testing.assert_allclose(model, frames[0, 0, ::2], rtol=1e-12)


class TestComponents:
    @pytest.mark.parametrize(
        ("shape", "shifts", "count"),
        [
            ((40, 50), [(0, 0), (0, 5), (0, 7), (5, 0), (7, 0)], 1),
            ((40, 50), [(0, 0), (0, 4), (0, 6), (4, 0), (6, 0)], 4),
            ((60, 70), [(0, 0), (5, 0), (0, 7)], 35),
            ((80, 90), [(0, 0), (11, 13), (19, 17), (30, 41)], 89),
        ],
    )
    def test_counts_of_known_patterns(self, shape, shifts, count):
        labels = self.labels(shape, shifts)
        assert labels.max() + 1 == count

    def test_larger_components_come_first_then_the_lower_index(self):
        labels = self.labels((1, 5), [(0, 0), (0, 2)])
        assert labels.tolist() == [[0, 1, 0, 1, 0]]
        labels = self.labels((1, 6), [(0, 0), (0, 4)])
        assert labels.tolist() == [[0, 1, 2, 3, 0, 1]]

    def test_masked_measurements_do_not_connect(self):
        shifts = [(0, 0), (0, 1)]
        mask = np.zeros((2, 1, 5), bool)
        mask[0, 0, 2] = True
        # The chain of pixels is cut where pixel 2 no longer meets pixel 1.
        assert self.labels((1, 5), shifts, mask).tolist() == [[1, 1, 0, 0, 0]]
        mask[1, 0, 2] = True
        assert self.labels((1, 5), shifts, mask).tolist() == [[0, 0, -1, 1, 1]]

    @staticmethod
    def labels(shape, shifts, mask=None):
        cells, grid_shape, _ = reference.grid_cells(shape, shifts)
        used = np.ones(cells.shape, bool) if mask is None else ~mask
        return reference.components(cells, used, grid_shape)[0]

//! What a state of the joint problem says besides its unknowns: components, values of the beam at its
//! cells, and how many numbers the measurements determine.

use std::ops::Range;

use super::freedom::determined_share;
use super::layout::Grid;
use super::penalty::SMOOTHING;
use super::system::System;
use crate::connectivity::{Components, Edges, Stretches};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::{Real, Shape};
use crate::geometry::{Rotation, View, whole_number};

/// Measurements less unknowns.
pub(crate) fn freedom<T: Real>(system: &System<'_, '_, T>) -> f64 {
    let pixels =
        (system.measured() - system.pass.few.pixels) * (1 + usize::from(system.pass.with_offset));
    system.used().saturating_sub(pixels + unknowns(system)).max(1) as f64
}

pub(crate) fn unknowns<T: Real>(system: &System<'_, '_, T>) -> usize {
    let seen = system.weights.iter().filter(|&&weight| weight > 0.0).count();
    let params = system.size() - system.state.beam.len();
    if !system.pass.grid.is_spline() {
        return seen + params;
    }
    let shares = system.pass.exposures.shares();
    let windows = system.pass.grid.windows(&system.state.shifts);
    (determined_share(&windows, &shares, SMOOTHING) * seen as f64).round() as usize + params
}

/// The components of pixels and cells at the shifts found.
pub(crate) fn components<T: Real>(
    system: &System<'_, '_, T>,
    control: &Control,
) -> Result<Components> {
    connected(system.pass.exposures, &system.pass.grid, &system.state.shifts, &[], control)
}

/// The components of pixels and cells, without pixels that are left out, if any are. Along an axis where all
/// shifts differ by whole numbers of pixels, a pixel hangs on one value of the beam; else on the two beside it,
/// which is a necessary condition alone: then a Ritz value near 0 shows patterns that are not determined.
pub(super) fn connected<T: Real>(
    exposures: &Exposures<'_, T>,
    grid: &Grid,
    shifts: &[[f64; 2]],
    left_out: &[bool],
    control: &Control,
) -> Result<Components> {
    let Grid { geometry, sensor, .. } = grid;
    let whole = [0, 1].map(|axis| {
        let apart = |d: &[f64; 2]| d[axis] - shifts[0][axis];
        shifts.iter().all(|d| whole_number(apart(d)).is_some())
    });
    let windows = grid.windows(shifts);
    let mut edges = Edges::new(sensor.len(), geometry.beam.len());
    let mut stretches = Stretches::new(*sensor, geometry.beam);
    let mut join = |exposure: usize, row: usize, cols: Range<usize>| {
        let window = &windows[exposure];
        let View { cells, rotation, .. } = geometry.views[window.view];
        let [down, along] = if window.swaps_axes { [whole[1], whole[0]] } else { whole };
        let (down, along) = (window.along_rows.around(down), window.along_cols.around(along));
        if rotation == Rotation::None && along.len() > 1 {
            // Pixels side by side see a cell in common.
            let seen = cols.start + window.col + along.start..cols.end + window.col + along.end - 1;
            let rows = row + window.row + down.start..row + window.row + down.end;
            return stretches.join(&mut edges, row, cols, rows, seen);
        }
        for col in cols {
            for i in down.clone() {
                for j in along.clone() {
                    let cell = cells.at(row + window.row + i, col + window.col + j);
                    edges.add(row * sensor.cols + col, cell);
                }
            }
        }
    };
    exposures.for_each_stretch(control, |exposure, row, cols| {
        let Some(left_out) = left_out.get(row * sensor.cols..(row + 1) * sensor.cols) else {
            return join(exposure, row, cols);
        };
        let mut first = cols.start;
        for alike in left_out[cols].chunk_by(|a, b| a == b) {
            if !alike[0] {
                join(exposure, row, first..first + alike.len());
            }
            first += alike.len();
        }
    })?;
    edges.components(control)
}

/// L at the cells: Σ_j a_j B(u − j) with B = 1/6, 4/6, 1/6 at whole numbers; NaN where a coefficient
/// that it takes is not seen.
pub(crate) fn values_at_cells<T: Real>(system: &System<'_, '_, T>) -> Vec<f64> {
    let beam = &system.state.beam;
    let seen = |cell: usize| system.weights[cell] > 0.0;
    if !system.pass.grid.is_spline() {
        return (0..beam.len())
            .map(|cell| if seen(cell) { beam[cell] } else { f64::NAN })
            .collect();
    }
    const FACTORS: [f64; 3] = [1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0];
    let Shape { rows, cols } = system.pass.grid.geometry.beam;
    let mut values = vec![f64::NAN; beam.len()];
    system.pass.workers.map_blocks(&mut values, cols, |row, values| {
        if row == 0 || row + 1 == rows {
            return;
        }
        for (col, value) in values.iter_mut().enumerate().take(cols - 1).skip(1) {
            let around = (0..9).map(|i| ((row + i / 3 - 1) * cols + col + i % 3 - 1, i));
            if around.clone().all(|(cell, _)| seen(cell)) {
                *value = around.map(|(cell, i)| FACTORS[i / 3] * FACTORS[i % 3] * beam[cell]).sum();
            }
        }
    });
    values
}

/// The coefficients of the beam, if it is a spline; NaN where no measurement sees them.
pub(crate) fn coefficients<T: Real>(system: &System<'_, '_, T>) -> Option<Vec<f64>> {
    let cells = system.state.beam.iter().zip(&system.weights);
    let seen = |(&value, &weight): (&f64, &f64)| if weight > 0.0 { value } else { f64::NAN };
    system.pass.grid.is_spline().then(|| cells.map(seen).collect())
}

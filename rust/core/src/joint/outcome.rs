//! What a state of the joint problem says besides its unknowns: components, values of the beam at its
//! cells, and how many numbers the measurements determine.

use super::connected::connected;
use super::freedom::determined_share;
use super::penalty::SMOOTHING;
use super::system::System;
use crate::connectivity::Components;
use crate::control::Control;
use crate::error::Result;
use crate::frames::{Real, Shape};

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
    let shares = system.pass.exposures.shares(&system.pass.flux);
    let windows = system.pass.grid.windows(&system.state.shifts);
    (determined_share(&windows, &shares, SMOOTHING) * seen as f64).round() as usize + params
}

/// The components of pixels and cells at the shifts found.
pub(crate) fn components<T: Real>(
    system: &System<'_, '_, T>,
    control: &Control,
) -> Result<Components> {
    let (exposures, grid) = (system.pass.exposures, &system.pass.grid);
    connected(exposures, grid, &system.state.shifts, &system.pass.few.lost, &[], control)
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
    let seen = |(&value, &weight): (&f64, &f32)| if weight > 0.0 { value } else { f64::NAN };
    system.pass.grid.is_spline().then(|| cells.map(seen).collect())
}

//! The rim of the beam: cells near others that are hardly seen.
//!
//! Inside, the normal matrix of a spline is nearly a convolution, whose inverse is a filter. At the rim,
//! behind the edges of exposures and around holes, it is none: what factors of a few thousandths tell, and
//! the penalty, decides there. So there N + τ GᵀG, with N the sum of w c² M² over the pixels that see two
//! cells, by their factors, is factorised as it is. The rim is a few cells wide, so its factor is small.

use super::grid::{TAPS, Window};
use super::system::System;
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::linalg::Cholesky;

/// A cell is of the rim if one so near has less than this share of its weight: the outermost factor of a
/// spline is at most a sixth.
const NEAR: usize = 2;
const SHARE: f64 = 1.0 / 6.0;
/// A rim of more cells than this many times the side of the grid fills the image: then its diagonal has
/// to do.
const WIDEST: usize = 50;
/// What is added to the diagonal, as a share of it, for cells that rounding alone tells.
const RIDGE: f64 = 1e-10;
/// Cells that lie within a spline's reach of each other, along one axis.
const REACH: usize = 2 * TAPS - 1;
/// Cells of the rim that a thread takes at a time.
const BLOCK: usize = 64;

pub(super) struct Rim {
    cells: Vec<u32>,
    factor: Option<Cholesky>,
    /// 1/(N + τ GᵀG), of the diagonal, where there is no factor.
    inverse: Vec<f64>,
}

impl Rim {
    pub(super) fn new<T: Real>(system: &System<'_, '_, T>, control: &Control) -> Result<Self> {
        let cells = if system.grid.is_spline() { cells(system) } else { Vec::new() };
        let side = system.state.beam.len().isqrt();
        let fits = cells.len() <= WIDEST * side;
        let length = if fits { system.state.beam.len() } else { 0 };
        let mut numbers = system.workers.filled(length, u32::MAX, control);
        if fits {
            for (number, &cell) in cells.iter().enumerate() {
                numbers[cell as usize] = number as u32;
            }
        }
        let blocks = system.workers.map(cells.len().div_ceil(BLOCK), |block| {
            control.check()?;
            let first = block * BLOCK;
            let mut entries = Vec::new();
            let mut diagonal = Vec::new();
            let own = cells[first..].iter().take(BLOCK).enumerate();
            for (index, &cell) in own {
                let (cell, number) = (cell as usize, (first + index) as u32);
                let mut row: Vec<(u32, f64)> = Vec::new();
                let mut sum = 0.0;
                system.for_neighbours(cell, |other, value| {
                    sum += if other == cell { value } else { 0.0 };
                    if let Some(&other) = numbers.get(other)
                        && other <= number
                    {
                        row.push((other, value));
                    }
                });
                row.sort_by_key(|&(other, _)| other);
                let places = row.chunk_by(|a, b| a.0 == b.0);
                entries.extend(places.map(|place| {
                    (number, place[0].0, place.iter().map(|(_, value)| value).sum::<f64>())
                }));
                diagonal.push(sum);
            }
            Ok((entries, diagonal))
        });
        let blocks: Result<Vec<_>> = blocks.into_iter().collect();
        let (entries, diagonals): (Vec<_>, Vec<_>) = blocks?.into_iter().unzip();
        let (mut entries, diagonal) = (entries.concat(), diagonals.concat());
        if fits {
            let ridge =
                |(number, value): (usize, &f64)| (number as u32, number as u32, RIDGE * value);
            entries.extend(diagonal.iter().enumerate().map(ridge));
        }
        control.check()?;
        let factor = fits.then(|| Cholesky::new(cells.len(), &entries)).flatten();
        let inverse = diagonal.iter().map(|&d| if d > 0.0 { 1.0 / d } else { 0.0 }).collect();
        Ok(Self { cells, factor, inverse })
    }

    pub(super) fn cells(&self) -> impl Iterator<Item = usize> {
        self.cells.iter().map(|&cell| cell as usize)
    }

    /// Adds (N + τ GᵀG)⁻¹ r on the rim.
    pub(super) fn add(&self, r: &[f64], z: &mut [f64]) {
        let mut values: Vec<f64> = self.cells().map(|cell| r[cell]).collect();
        match &self.factor {
            Some(factor) => factor.solve(&mut values),
            None => values.iter_mut().zip(&self.inverse).for_each(|(value, i)| *value *= i),
        }
        self.cells().zip(values).for_each(|(cell, value)| z[cell] += value);
    }
}

/// The cells of the rim.
fn cells<T: Real>(system: &System<'_, '_, T>) -> Vec<u32> {
    let (weights, shape) = (&system.weights, system.grid.geometry.beam);
    let rows = system.workers.map(shape.rows, |row| {
        let mut found = Vec::new();
        for col in 0..shape.cols {
            let cell = row * shape.cols + col;
            let least = SHARE * weights[cell];
            let inside = row >= NEAR
                && col >= NEAR
                && row + NEAR < shape.rows
                && col + NEAR < shape.cols
                && (row - NEAR..=row + NEAR).all(|row| {
                    let around = &weights[row * shape.cols + col - NEAR..][..=2 * NEAR];
                    around.iter().all(|&weight| weight >= least)
                });
            if weights[cell] > 0.0 && !inside {
                found.push(cell as u32);
            }
        }
        found
    });
    rows.concat()
}

impl<T: Real> System<'_, '_, T> {
    /// Calls `visit(other, value)` for the elements of N + τ GᵀG in the row of a cell; the values of one
    /// place add up.
    fn for_neighbours(&self, cell: usize, mut visit: impl FnMut(usize, f64)) {
        let geometry = &self.grid.geometry;
        let (row, col) = (cell / geometry.beam.cols, cell % geometry.beam.cols);
        for (index, view) in geometry.views.iter().enumerate() {
            let place = view.places.at(row, col);
            let (row, col) = (place / view.shape.cols, place % view.shape.cols);
            let mut sums = [[0.0; REACH]; REACH];
            let windows = self.windows.iter().enumerate();
            for (k, window) in windows.filter(|(_, window)| window.view == index) {
                self.add_exposure(k, window, [row, col], &mut sums);
            }
            for (i, sums) in sums.iter().enumerate() {
                for (j, &value) in sums.iter().enumerate().filter(|(_, value)| **value > 0.0) {
                    visit(view.cells.at(row + i - (TAPS - 1), col + j - (TAPS - 1)), value);
                }
            }
        }
        if let Some(penalty) = &self.penalty {
            penalty.for_row(cell, visit);
        }
    }

    /// Adds what one exposure makes of the elements of N in the row of a cell at its place in the view.
    fn add_exposure(
        &self,
        exposure: usize,
        window: &Window,
        [row, col]: [usize; 2],
        sums: &mut [[f64; REACH]; REACH],
    ) {
        let sensor = self.model.sensor();
        let (down, along) = (&window.along_rows.values, &window.along_cols.values);
        // The cell is the i-th that a pixel sees, down and along.
        let first = (col + 1).saturating_sub(window.col + TAPS);
        let last = (col + 1).saturating_sub(window.col).min(sensor.cols);
        if first >= last {
            return;
        }
        for (i, own) in down.iter().enumerate() {
            let pixel_row = row.checked_sub(window.row + i).filter(|&row| row < sensor.rows);
            let Some(pixel_row) = pixel_row else { continue };
            let weights = self.pixel_weights(exposure, pixel_row, first..last);
            let mut line = [0.0; REACH];
            for (pixel, weight) in (first..last).zip(weights) {
                let j = col - window.col - pixel;
                for (other, factor) in along.iter().enumerate() {
                    line[TAPS - 1 + other - j] += weight * along[j] * factor;
                }
            }
            for (other, factor) in down.iter().enumerate() {
                let sums = &mut sums[TAPS - 1 + other - i];
                sums.iter_mut().zip(line).for_each(|(sum, value)| *sum += own * factor * value);
            }
        }
    }
}

//! The rim of the beam: cells near others of small weight.
//!
//! Inside, the normal matrix of a spline is nearly a convolution, whose inverse is a filter. At the rim,
//! behind the edges of exposures and around holes, it is none: what factors of a few thousandths tell, and
//! the penalty, decides there. So there N + τ GᵀG, with N the sum of w c² M² over the pixels that see two
//! cells, by their factors, is factorised as it is. The rim is a few cells wide, so its factor is small.
//!
//! Where cells have little weight, as those have that a weak exposure alone sees, the penalty outweighs the
//! measurements, and only all these cells together constrain the patterns that the penalty allows: passes would
//! grow as one over the root of the weight. The faintest of them are of the rim too, as many as there is room for.

use super::layout::Window;
use super::system::System;
use super::tiles::{Tile, Tiles};
use crate::control::Control;
use crate::error::Result;
use crate::frames::{Real, Shape};
use crate::geometry::TAPS;
use crate::linalg::Cholesky;
use crate::parallel::{Value, Workers};

/// A cell is of the rim if one so near has less than this share of its weight: the outermost factor of a
/// spline is at most a sixth. Where exposures are turned against each other a third cell saves next to nothing,
/// and on a grid of which the rim is the larger part it costs iterations.
const NEAR: usize = 3;
pub(super) const NEAR_OF_TURNED: usize = 2;
const SHARE: f32 = 1.0 / 6.0;
/// Cells of each row and column that there is room for. A rim of more fills the image: then its diagonal has to do.
const WIDEST: usize = 16;
/// A cell is faint that has less than this share of an ordinary weight.
const FAINT: f32 = 0.1;
/// Rows and columns together of a grid whose rim costs little: a smaller grid has as much room.
const FEW: usize = 1024;
/// Bytes that a cell of the rim takes with its factor. Where cells fill an area each takes up to twice as many:
/// 2200, 3200 and 4000 were measured in squares of 64, 148 and 256 cells.
const BYTES: u64 = 2000;
/// What is added to the diagonal, as a share of it, for cells that rounding alone determines.
const RIDGE: f64 = 1e-10;
/// Cells that lie within a spline's reach of each other, along one axis.
const REACH: usize = 2 * TAPS - 1;

pub(crate) struct Rim {
    parts: Vec<Part>,
}

/// The rim in one tile.
struct Part {
    /// Its cells, each with its share.
    cells: Vec<(u32, f64)>,
    factor: Option<Cholesky>,
    /// 1/(N + τ GᵀG), of the diagonal, where there is no factor.
    inverse: Vec<f64>,
}

impl Rim {
    pub(crate) fn new<T: Real>(system: &System<'_, '_, T>, control: &Control) -> Result<Self> {
        let beam = system.pass.grid.geometry.beam;
        let is_spline = system.pass.grid.is_spline();
        let mut cells = if is_spline { outline(system) } else { Vec::new() };
        let fits = cells.len() <= room(beam);
        if is_spline && fits {
            add_faint(&mut cells, room(beam), &system.weights, |cell| system.is_constrained(cell));
        }
        let tiles = Tiles::new(beam, &cells);
        let parts = system.pass.workers.map(tiles.parts.len(), |index| {
            control.check()?;
            Ok(Part::new(system, &tiles.parts[index], fits))
        });
        Ok(Self { parts: parts.into_iter().collect::<Result<_>>()? })
    }

    /// The cells of the rim, those in several tiles several times.
    pub(crate) fn cells(&self) -> impl Iterator<Item = usize> {
        self.parts.iter().flat_map(|part| &part.cells).map(|&(cell, _)| cell as usize)
    }

    /// Adds (N + τ GᵀG)⁻¹ r on the rim, of z and r in such units.
    pub(crate) fn add<N: Value>(&self, r: &[N], z: &mut [N], units: [f64; 2], workers: &Workers) {
        let [of_z, of_r] = units;
        let found = workers.map(self.parts.len(), |index| self.parts[index].apply(r, of_r / of_z));
        let found = self.cells().zip(found.into_iter().flatten());
        found.for_each(|(cell, value)| z[cell] += N::of(value));
    }
}

impl Part {
    fn new<T: Real>(system: &System<'_, '_, T>, tile: &Tile, fits: bool) -> Self {
        let (mut entries, mut inverse) = (Vec::new(), Vec::new());
        let numbers = tile.numbers();
        for (&(cell, _), number) in tile.cells.iter().zip(0..) {
            let mut row: Vec<(u32, f64)> = Vec::new();
            system.for_neighbours(cell as usize, |other, value| {
                let other = tile.place(other).map_or(u32::MAX, |place| numbers[place]);
                if other <= number {
                    row.push((other, value));
                }
            });
            row.sort_by_key(|&(other, _)| other);
            let places = row.chunk_by(|a, b| a.0 == b.0);
            let sums = places.map(|place| (place[0].0, place.iter().map(|at| at.1).sum::<f64>()));
            entries.extend(sums.map(|(other, sum)| (number, other, sum)));
            let diagonal = entries.last().map_or(0.0, |&(_, _, value)| value);
            entries.push((number, number, RIDGE * diagonal));
            inverse.push(if diagonal > 0.0 { 1.0 / diagonal } else { 0.0 });
            if !fits {
                entries.clear();
            }
        }
        let factor = fits.then(|| Cholesky::new(tile.cells.len(), &entries)).flatten();
        Self { cells: tile.cells.clone(), factor, inverse }
    }

    /// `factor` (N + τ GᵀG)⁻¹ r, times the shares on either side.
    fn apply<N: Value>(&self, r: &[N], factor: f64) -> Vec<f64> {
        let of_cell = |cell: u32| Into::<f64>::into(r[cell as usize]);
        let own = self.cells.iter().map(|&(cell, share)| factor * share * of_cell(cell));
        let mut values: Vec<f64> = own.collect();
        match &self.factor {
            Some(factor) => factor.substitute(&mut values),
            None => values.iter_mut().zip(&self.inverse).for_each(|(value, i)| *value *= i),
        }
        values.iter_mut().zip(&self.cells).for_each(|(value, (_, share))| *value *= share);
        values
    }
}

/// Most bytes that the rim of such a grid takes with its factor.
pub(crate) fn bytes_needed(beam: Shape) -> u64 {
    BYTES * room(beam) as u64
}

/// Cells that the rim has room for.
fn room(beam: Shape) -> usize {
    WIDEST * (beam.rows + beam.cols).max(FEW)
}

/// Adds the faintest cells to those of the rim, each of which takes the room of two.
fn add_faint(
    rim: &mut Vec<u32>,
    room: usize,
    weights: &[f32],
    is_constrained: impl Fn(usize) -> bool,
) {
    let is_faint = |&(cell, &weight): &(u32, &f32)| {
        weight < FAINT && is_constrained(cell as usize) && rim.binary_search(&cell).is_err()
    };
    let mut faint: Vec<u32> = (0..).zip(weights).filter(is_faint).map(|(cell, _)| cell).collect();
    let left = room.saturating_sub(rim.len()) / 2;
    if faint.len() > left {
        // Weights are not negative, so their bits stand in their order. Their first ones make steps of a quarter: what M
        // alone tells apart stays together.
        let step = |cell: u32| weights[cell as usize].to_bits() >> 21;
        faint.select_nth_unstable_by_key(left, |&cell| (step(cell), cell));
        faint.truncate(left);
    }
    rim.append(&mut faint);
    rim.sort_unstable();
}

/// The cells near the edge, and those near a cell of a small share of their weight.
fn outline<T: Real>(system: &System<'_, '_, T>) -> Vec<u32> {
    let is_turned = system.pass.grid.geometry.views.len() > 1;
    let near = if is_turned { NEAR_OF_TURNED } else { NEAR };
    let (weights, shape) = (&system.weights, system.pass.grid.geometry.beam);
    let rows = system.pass.workers.map(shape.rows, |row| {
        let mut found = Vec::new();
        for col in 0..shape.cols {
            let cell = row * shape.cols + col;
            let least = SHARE * weights[cell];
            let inside = row >= near
                && col >= near
                && row + near < shape.rows
                && col + near < shape.cols
                && (row - near..=row + near).all(|row| {
                    let around = &weights[row * shape.cols + col - near..][..=2 * near];
                    around.iter().all(|&weight| weight >= least)
                });
            if !inside && system.is_constrained(cell) {
                found.push(cell as u32);
            }
        }
        found
    });
    rows.concat()
}

impl<T: Real> System<'_, '_, T> {
    /// Whether a pixel or the penalty constrains a cell.
    fn is_constrained(&self, cell: usize) -> bool {
        self.weights[cell] > 0.0 || self.penalty.as_ref().is_some_and(|p| p.concerns(cell))
    }

    /// Calls `visit(other, value)` for the elements of N + τ GᵀG in the row of a cell; the values of one
    /// place add up.
    fn for_neighbours(&self, cell: usize, mut visit: impl FnMut(usize, f64)) {
        let geometry = &self.pass.grid.geometry;
        let (row, col) = (cell / geometry.beam.cols, cell % geometry.beam.cols);
        for (index, view) in geometry.views.iter().enumerate() {
            let place = view.places.at(row, col);
            let (row, col) = (place / view.shape.cols, place % view.shape.cols);
            let mut sums = [[0.0; REACH]; REACH];
            let windows = self.pass.windows.iter().enumerate();
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
        let sensor = self.pass.exposures.sensor();
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_faintest_cells_that_are_constrained_are_of_the_rim_while_there_is_room() {
        // The first two are of the rim, whatever their weights; that without a weight is not constrained.
        let weights = [0.05, 1.0, 0.02, 0.0, 1.0, 0.1, 0.03, 0.02, 0.099];
        let rim = |room| {
            let mut rim = vec![0, 1];
            add_faint(&mut rim, room, &weights, |cell| cell != 3);
            rim
        };
        assert_eq!(rim(10), [0, 1, 2, 6, 7, 8]);
        assert_eq!(rim(8), [0, 1, 2, 6, 7]);
        // Of equal ones, the first in the grid.
        assert_eq!(rim(5), [0, 1, 2]);
        assert_eq!(rim(3), [0, 1]);
        assert_eq!(rim(1), [0, 1]);
    }
}

//! The aggregates of cells of a beam that is no spline, with their matrix: in place of waves, where these are many.
//!
//! With the pixels eliminated, the cells that a pixel sees are compared with each other as the pixels that see a
//! cell are with the cells eliminated (`reduced/aggregated.rs`): with the weight Ω_k Ω_l / Σ Ω, Ω = w c² L² M².

use super::layout::Grid;
use super::system::System;
use super::wide::Wide;
use crate::coarse::{Cycle, Edges, NONE, Partition};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::{Real, Shape};
use crate::geometry::Rotation;
use crate::parallel::{Value, Workers};
use crate::reduced::{Places, ShortWaves, least_strong};

/// Rows of pixels that a thread weighs at a time.
const BAND: usize = 32;

/// Aggregates of cells.
pub(super) struct Aggregated {
    cells: Partition,
    cycle: Cycle,
    cols: usize,
}

impl Aggregated {
    /// Those at the state of a system.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(super) fn new<T: Real>(system: &mut System<'_, '_, T>, control: &Control) -> Result<Self> {
        let workers = system.pass.workers;
        let seen = Seen::new(system, control)?;
        let cells = seen.partition(system.weights.len(), workers, control)?;
        let graph = cells.graph(&seen, workers, control)?;
        drop(seen);
        let cols = system.pass.grid.geometry.beam.cols;
        Ok(Self { cells, cycle: Cycle::new(graph, workers, control)?, cols })
    }

    /// The heights that Φᵀ r has; `inward` brings r into the units of the matrix.
    pub(super) fn correct<N: Value>(
        &self,
        wide: &Wide,
        r: &[N],
        inward: f64,
        workers: &Workers,
    ) -> Vec<f32> {
        let of = |cell: usize| inward * r[cell].into() * f64::from(wide.beam[cell]);
        let heights = self.cycle.correct(&self.cells.sums(of, workers), workers);
        heights.into_iter().map(|height| height as f32).collect()
    }

    /// Adds Φ y to rows of cells from `first` on.
    pub(super) fn spread<N: Value>(
        &self,
        wide: &Wide,
        heights: &[f32],
        first: usize,
        outward: f64,
        z: &mut [N],
    ) {
        let first = first * self.cols;
        let cells = self.cells.of[first..].iter().zip(&wide.beam[first..]);
        for (z, (&aggregate, a)) in z.iter_mut().zip(cells) {
            if aggregate != NONE {
                *z += N::of(outward * f64::from(heights[aggregate as usize] * a));
            }
        }
    }
}

/// What aggregates take in bytes where they stand for the waves of these exposures, with the weights that their
/// matrix is summed from: `None` where waves are fewer, or the beam is a spline.
pub(super) fn bytes_needed<T: Real>(exposures: &Exposures<'_, T>, grid: &Grid) -> Option<u64> {
    let is_turned = grid.geometry.views.iter().any(|view| view.rotation != Rotation::None);
    match ShortWaves::of(exposures) {
        ShortWaves::Aggregates { bytes } if !(is_turned || grid.is_spline()) => {
            let of_weights = size_of::<f32>() * exposures.count() * grid.sensor.len();
            Some((bytes * grid.geometry.beam.len() + of_weights) as u64)
        }
        _ => None,
    }
}

/// What pixels see of the cells.
struct Seen {
    sensor: Shape,
    cols: usize,
    /// The cell that the first pixel sees from each place.
    places: Vec<[usize; 2]>,
    /// Pairs of places, in either order, with the weight of what they compare: strong ones alone make aggregates, as
    /// in `reduced/aggregated.rs`.
    strong: Vec<([usize; 2], f32)>,
    /// Ω in units of an ordinary one: of each place the pixels of a row, row by row.
    weights: Vec<f32>,
}

impl Seen {
    fn new<T: Real>(system: &mut System<'_, '_, T>, control: &Control) -> Result<Self> {
        system.pass.count += 1;
        let pass = &system.pass;
        let Places { exposures, shares, .. } = Places::of(pass.exposures);
        let sensor = pass.exposures.sensor();
        let [light, weight] = system.ordinary;
        let unit = weight * light * light;
        let beams = pass.views_of(&system.state.beam);
        let width = exposures.len() * sensor.cols;
        let mut weights = pass.workers.filled(sensor.rows * width, 0.0_f32, control);
        pass.workers.map_blocks(&mut weights, BAND * width, |band, rows| {
            let mut workspace = pass.workspace();
            for (index, found) in rows.chunks_exact_mut(width).enumerate() {
                if control.is_cancelled() {
                    return;
                }
                let row = band * BAND + index;
                pass.weigh_row(row, &mut workspace.weights);
                pass.see_beam(&beams, row, &mut workspace);
                for (found, alike) in found.chunks_exact_mut(sensor.cols).zip(&exposures) {
                    for (col, (found, m)) in found.iter_mut().zip(pass.row(row)).enumerate() {
                        let of = |&k: &usize| {
                            let at = k * sensor.cols + col;
                            workspace.weights[at] * (workspace.light[at] * m).powi(2)
                        };
                        *found = (alike.iter().map(of).sum::<f64>() / unit) as f32;
                    }
                    pass.few.in_row(row).iter().for_each(|&col| found[col] = 0.0);
                }
            }
        });
        control.check()?;
        let least = least_strong(&shares);
        let each = 0..shares.len();
        let pairs = each.clone().flat_map(|one| each.clone().map(move |other| [one, other]));
        let strong = pairs
            .filter(|[one, other]| one != other)
            .map(|[one, other]| ([one, other], shares[one] * shares[other]))
            .filter(|&(_, weight)| weight >= least)
            .map(|(pair, weight)| (pair, weight as f32));
        // The exposures of a place see the same cells.
        let at = |alike: &Vec<usize>| [pass.windows[alike[0]].row, pass.windows[alike[0]].col];
        Ok(Self {
            sensor,
            cols: pass.grid.geometry.beam.cols,
            places: exposures.iter().map(at).collect(),
            strong: strong.collect(),
            weights,
        })
    }

    fn partition(&self, cells: usize, workers: &Workers, control: &Control) -> Result<Partition> {
        let beside = |cell: usize| {
            let seen = self.strong.iter().filter_map(move |&([one, other], weight)| {
                let pixel = self.pixel(cell, one)?;
                let is_seen = self.weight(pixel, one) > 0.0 && self.weight(pixel, other) > 0.0;
                is_seen.then(|| (self.cell(pixel, other), weight))
            });
            seen
        };
        // The diagonal does those that are compared with nothing.
        let is_used = |cell: usize| {
            let mut is_compared = false;
            self.of(cell, |_, _| is_compared = true);
            is_compared
        };
        Partition::neighbourhoods(cells, is_used, beside, workers, control)
    }

    /// The pixel that sees a cell from a place.
    fn pixel(&self, cell: usize, place: usize) -> Option<[usize; 2]> {
        let [row, col] = self.places[place];
        let pixel = [(cell / self.cols).checked_sub(row)?, (cell % self.cols).checked_sub(col)?];
        (pixel[0] < self.sensor.rows && pixel[1] < self.sensor.cols).then_some(pixel)
    }

    /// The cell that a pixel sees from a place.
    fn cell(&self, [row, col]: [usize; 2], place: usize) -> usize {
        let at = self.places[place];
        (row + at[0]) * self.cols + col + at[1]
    }

    fn weight(&self, [row, col]: [usize; 2], place: usize) -> f64 {
        let line = row * self.places.len() + place;
        f64::from(self.weights[line * self.sensor.cols + col])
    }
}

impl Edges for Seen {
    fn of(&self, cell: usize, mut add: impl FnMut(usize, f64)) {
        for place in 0..self.places.len() {
            let Some(pixel) = self.pixel(cell, place) else { continue };
            let own = self.weight(pixel, place);
            if own == 0.0 {
                continue;
            }
            let total: f64 = (0..self.places.len()).map(|place| self.weight(pixel, place)).sum();
            for other in (0..self.places.len()).filter(|&other| other != place) {
                // The same number from either end.
                let weight = own * self.weight(pixel, other) / total;
                if weight > 0.0 {
                    add(self.cell(pixel, other), weight);
                }
            }
        }
    }

    fn own(&self, _: usize) -> f64 {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exposures::{Flux, FluxKind, Mask, Measurements, Positions, Variance};
    use crate::frames::Stack;
    use crate::joint::{Fluxes, State};
    use crate::testing::random_number;

    const SENSOR: Shape = Shape::new(23, 31);
    /// Far apart, so that cells are seen by one pixel alone, or by two; two exposures are at one place.
    const SHIFTS: [[f64; 2]; 5] =
        [[0.0, 0.0], [7.0, -12.0], [-9.0, 5.0], [3.0, 16.0], [7.0, -12.0]];

    fn positive(seed: usize) -> f64 {
        1.0 + 0.4 * random_number(seed)
    }

    #[test]
    fn the_matrix_is_that_of_the_columns() {
        let (workers, control) = (Workers::new(None).unwrap(), Control::new());
        let count = SHIFTS.len() * SENSOR.len();
        let frames: Vec<f64> = (0..count).map(positive).collect();
        let variance: Vec<f64> = (0..count).map(|at| 1e-3 * positive(at + 99_000)).collect();
        let masked: Vec<bool> = (0..count).map(|at| random_number(at + 5) > 0.8).collect();
        let stack = |values| Stack::new("frames", values, SHIFTS.len(), SENSOR).unwrap();
        let whole = Variance::Exposures(&[4e-6, 9e-5, 5e-7, 1e-6, 2e-4]);
        for (variance, mask) in [
            (Variance::Unknown, Mask::None),
            (whole, Mask::Measurements(&masked)),
            (Variance::Measurements(stack(&variance)), Mask::Measurements(&masked)),
        ] {
            let measurements = Measurements { frames: stack(&frames), variance, mask };
            let flux = vec![1.0, 0.7, 1.6, 0.4, 1.2];
            let lamp = Flux { values: flux.clone(), kind: FluxKind::Known };
            let positions = Positions::of_shifts(&SHIFTS);
            let fluxes = Fluxes::new(&flux, &FluxKind::Known, &SHIFTS, &positions.rotations);
            let exposures =
                Exposures::new(measurements, positions, lamp, false, &workers, &control).unwrap();
            let grid = Grid::of(&exposures).unwrap();
            let beam = (0..grid.geometry.beam.len()).map(|cell| positive(cell + 4321)).collect();
            let state = State { beam, theta: Vec::new(), shifts: SHIFTS.to_vec() };
            let mut system =
                System::new(&exposures, grid, fluxes, state, &workers, &control).unwrap();
            system.linearise(&control).unwrap();
            let seen = Seen::new(&mut system, &control).unwrap();
            let cells = seen.partition(system.weights.len(), &workers, &control).unwrap();
            let matrix = cells.graph(&seen, &workers, &control).unwrap();
            assert!(cells.count() > 50 && cells.count() < system.weights.len() / 2);
            let heights: Vec<f64> = (0..cells.count()).map(|at| random_number(at + 11)).collect();
            let of = |(&aggregate, a): (&u32, &f64)| {
                if aggregate == NONE { 0.0 } else { a * heights[aggregate as usize] }
            };
            let x: Vec<f64> = cells.of.iter().zip(&system.state.beam).map(of).collect();
            let mut product = Vec::new();
            system.multiply(&x, &mut product, 0.0, &control).unwrap();
            let [light, weight] = system.ordinary;
            let wanted = workers.dot(&x, &product) / (weight * light * light);
            let left = matrix.residual(&vec![0.0; heights.len()], &heights, &workers);
            let found: f64 = left.iter().zip(&heights).map(|(left, y)| -left * y).sum();
            // Ω in single precision.
            assert!((found / wanted - 1.0).abs() < 1e-6, "{found} {wanted}");
        }
    }
}

//! The aggregates of cells of a beam that is no spline, with their matrix: in place of waves, where these are many.
//!
//! With the pixels eliminated, the cells that a pixel sees are compared with each other as the pixels that see a
//! cell are with the cells eliminated (`reduced/aggregated.rs`):
//!
//! ```text
//! yᵀΦᵀSΦy = Σ_p [ Σ_{k<l} Ω_k Ω_l (y_k − y_l)² + Λ Σ_k Ω_k y_k² ] / (Λ + Σ Ω),   Ω = w c² L² M²,  Λ = λ M²
//! ```
//!
//! with the weight λ of a prior of M. An offset that is sought takes some more out of S; as the hats, aggregates do
//! not count that.

use super::layout::Grid;
use super::pass::Pass;
use super::system::System;
use super::wide::Wide;
use crate::coarse::{Cycle, Edges, NONE, Partition, Places, ShortWaves, pairs};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::{Real, Shape};
use crate::geometry::Rotation;
use crate::parallel::{Value, Workers};

/// Rows of pixels that a thread weighs at a time.
const BAND: usize = 32;

/// Aggregates of cells.
pub(super) struct Aggregated {
    cells: Partition,
    cycle: Cycle,
    cols: usize,
}

impl Aggregated {
    /// Those at the state of a system, where they stand for its waves.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(super) fn where_waves_are_many<T: Real>(
        system: &mut System<'_, '_, T>,
        control: &Control,
    ) -> Result<Option<Self>> {
        let Pass { exposures, grid, .. } = &system.pass;
        // As memory was asked for.
        if in_place_of_waves(exposures, &system.fluxes.values, grid).is_none() {
            return Ok(None);
        }
        let workers = system.pass.workers;
        let seen = Seen::new(system, control)?;
        let cells = seen.partition(system.weights.len(), workers, control)?;
        let graph = cells.graph(&seen, workers, control)?;
        drop(seen);
        let cols = system.pass.grid.geometry.beam.cols;
        Ok(Some(Self { cells, cycle: Cycle::new(graph, workers, control)?, cols }))
    }

    /// A share of A⁻¹ Φᵀ r, nearly; `inward` brings r into the units of A.
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

/// Bytes for each cell of the aggregates that stand for the waves of these exposures, and their places: `None` where
/// waves are fewer at these fluxes, where the beam is a spline, or its views are turned.
pub(super) fn in_place_of_waves<T: Real>(
    exposures: &Exposures<'_, T>,
    flux: &[f64],
    grid: &Grid,
) -> Option<[usize; 2]> {
    let is_turned = grid.geometry.views.iter().any(|view| view.rotation != Rotation::None);
    if is_turned || grid.is_spline() {
        return None;
    }
    match ShortWaves::of(exposures, flux) {
        ShortWaves::Aggregates { bytes, places } => Some([bytes, places]),
        ShortWaves::Waves(_) => None,
    }
}

/// What aggregates take in bytes, with what their matrix is summed from; 0 where there are none.
pub(super) fn bytes_needed<T: Real>(
    exposures: &Exposures<'_, T>,
    flux: &[f64],
    grid: &Grid,
) -> u64 {
    in_place_of_waves(exposures, flux, grid).map_or(0, |[bytes, places]| {
        let of_pixel = size_of::<f32>() * (places + 1);
        (bytes * grid.geometry.beam.len() + of_pixel * grid.sensor.len()) as u64
    })
}

/// Cells, compared by the pixels that see them.
struct Seen {
    sensor: Shape,
    cols: usize,
    /// The cell that the first pixel sees from each place.
    places: Vec<[usize; 2]>,
    strong: Vec<([usize; 2], f32)>,
    /// Ω in units of an ordinary one: of each place the pixels of a row, then their Λ, row by row.
    weights: Vec<f32>,
}

impl Seen {
    fn new<T: Real>(system: &mut System<'_, '_, T>, control: &Control) -> Result<Self> {
        system.pass.count += 1;
        let pass = &system.pass;
        let Places { exposures, .. } = Places::of(pass.exposures, &pass.flux);
        let sensor = pass.exposures.sensor();
        let [light, weight] = system.ordinary;
        let unit = weight * light * light;
        let beams = pass.views_of(&system.state.beam);
        let width = (exposures.len() + 1) * sensor.cols;
        let mut weights = pass.workers.filled(sensor.rows * width, 0.0_f32, control);
        let sums = pass.workers.map_blocks(&mut weights, BAND * width, |band, rows| {
            let mut workspace = pass.workspace();
            let mut sums = vec![0.0; exposures.len()];
            for (index, found) in rows.chunks_exact_mut(width).enumerate() {
                if control.is_cancelled() {
                    break;
                }
                let row = band * BAND + index;
                pass.weigh_row(row, &mut workspace.weights);
                pass.see_beam(&beams, row, &mut workspace);
                let (found, of_prior) = found.split_at_mut(width - sensor.cols);
                let alike = found.chunks_exact_mut(sensor.cols).zip(&exposures).zip(&mut sums);
                for ((found, alike), sum) in alike {
                    for (col, (found, m)) in found.iter_mut().zip(pass.row(row)).enumerate() {
                        let of = |&k: &usize| {
                            let at = k * sensor.cols + col;
                            workspace.weights[at] * (workspace.light[at] * m).powi(2)
                        };
                        *found = (alike.iter().map(of).sum::<f64>() / unit) as f32;
                    }
                    pass.few.clear(row, found);
                    *sum += found.iter().map(|&weight| f64::from(weight)).sum::<f64>();
                }
                if let Some(prior) = &system.prior {
                    let own = prior.weights[row * sensor.cols..].iter().zip(pass.row(row));
                    for (found, (weight, m)) in of_prior.iter_mut().zip(own) {
                        *found = (weight * m * m / unit) as f32;
                    }
                }
            }
            sums
        });
        control.check()?;
        // Fluxes that are sought may be far from those that were given.
        let share = |place: usize| sums.iter().map(|sums| sums[place]).sum();
        let shares: Vec<f64> = (0..exposures.len()).map(share).collect();
        let strong = pairs(&shares).into_iter().filter(|pair| pair.is_strong);
        let strong = strong.map(|pair| (pair.places, pair.weight as f32));
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
            self.strong.iter().filter_map(move |&([one, other], weight)| {
                let pixel = self.pixel(cell, one)?;
                self.compares(pixel, one, other).then(|| (self.cell(pixel, other), weight))
            })
        };
        // The diagonal does those that are compared with nothing.
        let is_used = |cell: usize| {
            (0..self.places.len()).any(|place| {
                let pixel = self.pixel(cell, place);
                let mut others = (0..self.places.len()).filter(|&other| other != place);
                pixel.is_some_and(|pixel| others.any(|other| self.compares(pixel, place, other)))
            })
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

    /// Ω of a place, or Λ behind the last.
    fn weight(&self, [row, col]: [usize; 2], place: usize) -> f64 {
        let line = row * (self.places.len() + 1) + place;
        f64::from(self.weights[line * self.sensor.cols + col])
    }

    /// Λ + Σ Ω.
    fn total(&self, pixel: [usize; 2]) -> f64 {
        (0..=self.places.len()).map(|place| self.weight(pixel, place)).sum()
    }

    /// Whether a pixel measured from both places.
    fn compares(&self, pixel: [usize; 2], one: usize, other: usize) -> bool {
        self.weight(pixel, one) > 0.0 && self.weight(pixel, other) > 0.0
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
            let total = self.total(pixel);
            for other in (0..self.places.len()).filter(|&other| other != place) {
                // The same number from either end.
                let weight = own * self.weight(pixel, other) / total;
                if weight > 0.0 {
                    add(self.cell(pixel, other), weight);
                }
            }
        }
    }

    fn own(&self, cell: usize) -> f64 {
        let of_place = |place: usize| {
            let pixel = self.pixel(cell, place)?;
            let of_prior = self.weight(pixel, self.places.len());
            (of_prior > 0.0).then(|| self.weight(pixel, place) * of_prior / self.total(pixel))
        };
        (0..self.places.len()).filter_map(of_place).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exposures::{Flux, FluxKind, Mask, Measurements, Positions, Variance};
    use crate::frames::Stack;
    use crate::joint::{Fluxes, Prior, State};
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
        let held = (0..SENSOR.len()).map(|pixel| if pixel % 5 == 0 { 300.0 } else { 0.0 });
        let prior = Prior { weights: held.collect(), mean: 1.0 };
        let uneven = Variance::Measurements(stack(&variance));
        for (variance, mask, prior) in [
            (Variance::Unknown, Mask::None, None),
            (whole, Mask::Measurements(&masked), None),
            (uneven, Mask::Measurements(&masked), None),
            (uneven, Mask::Measurements(&masked), Some(prior)),
        ] {
            let measurements = Measurements { frames: stack(&frames), variance, mask };
            let flux = vec![1.0, 0.7, 1.6, 0.4, 1.2];
            let lamp = Flux { values: flux.clone(), kind: FluxKind::Known };
            let positions = Positions::of_shifts(&SHIFTS);
            let exposures =
                Exposures::new(measurements, positions, lamp, false, &workers, &control).unwrap();
            let grid = Grid::of(&exposures).unwrap();
            let fluxes = Fluxes::of(&exposures, &flux, &SHIFTS, &grid);
            let beam = (0..grid.geometry.beam.len()).map(|cell| positive(cell + 4321)).collect();
            let state = State { beam, theta: Vec::new(), shifts: SHIFTS.to_vec() };
            let mut system =
                System::new(&exposures, grid, fluxes, state, &workers, &control).unwrap();
            assert_eq!(system.pass.few.pixels > 0, matches!(mask, Mask::Measurements(_)));
            system.prior = prior;
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
            let of = |cell: usize| product[cell] * system.state.beam[cell];
            let left = matrix.residual(&vec![0.0; heights.len()], &heights, &workers);
            let scale = left.iter().fold(0.0, |most: f64, left| most.max(left.abs()));
            // Where a prior holds M, products leave out what pulls at the multiple of the beam.
            let multiple = -left.iter().sum::<f64>() / light;
            let beam_of = |cell: usize| system.state.beam[cell] * f64::from(system.scale[cell]);
            let beams = cells.sums(beam_of, &workers);
            for ((left, wanted), beam) in left.iter().zip(cells.sums(of, &workers)).zip(beams) {
                let (found, wanted) = (-left - multiple * beam, wanted / (weight * light * light));
                // Ω in single precision.
                assert!((found - wanted).abs() < 1e-6 * scale, "{found} {wanted}");
            }
        }
    }

    /// Two heavy places compare along one line, and a light one makes no aggregates with them.
    #[test]
    fn an_aggregate_reaches_over_strong_comparisons_alone() {
        let (workers, control) = (Workers::new(None).unwrap(), Control::new());
        let places = vec![[0, 0], [0, 2], [0, 1]];
        let sensor = Shape::new(1, 9);
        let weights = [[1.0; 9], [1.0; 9], [1e-3; 9], [0.0; 9]].concat();
        let strong = pairs(&[1.0, 1.0, 1e-3]).into_iter().filter(|pair| pair.is_strong);
        let strong = strong.map(|pair| (pair.places, pair.weight as f32)).collect();
        let seen = Seen { sensor, cols: 11, places, strong, weights };
        let cells = seen.partition(11, &workers, &control).unwrap();
        for (cell, aggregate) in cells.of.iter().enumerate() {
            assert!(*aggregate != NONE);
            let alike = cells.of.iter().enumerate().filter(|(_, other)| *other == aggregate);
            assert!(alike.into_iter().all(|(other, _)| other % 2 == cell % 2), "{:?}", cells.of);
        }
    }
}

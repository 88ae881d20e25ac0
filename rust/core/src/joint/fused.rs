//! A product with S in one pass in single precision.
//!
//! With the light l = c B a/l₀ of the coefficients a, in units of an ordinary light l₀, and weights b = w/w₀, a change
//! x of the coefficients, and one of fluxes and shifts, pull back
//!
//! ```text
//! S x = w₀ Bᵀ c b M² (v − l α),   v = c B x + l δ ln c + ∂l/∂d δd,   α = i Σ b l v,   i = w₀ l₀²/Σ w e²,   δM = −M α
//! ```
//!
//! at the coefficients, and Σ l and Σ ∂l/∂d times what stands behind Bᵀ c at fluxes and shifts, with sums over the
//! exposures of a pixel. Weights that are the same in each exposure are kept in its taps, as √b c.
//! Taps along rows and along columns are applied one after the other. A band of pixels keeps the last rows of cells as
//! seen along a row, of x and of a, and the last rows of pulls. M, Σ w e² and the right-hand side are found in double
//! precision at each step, which makes good what the one before left by rounding (iterative refinement).

use super::bands::Bands;
use super::fused_kernel::{Along, Back, Block, Eliminate, Place, Ring, Subtract, Sum};
use super::kernel::{AROUND, Row};
use super::layout::Window;
use super::pass::Pass;
use super::penalty::Penalty;
use super::workspace::Sums;
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::geometry::{Rotation, TAPS};

/// Rows of cells that a thread folds at a time.
const FOLDED: usize = 32;
/// Rows of cells that a thread converts at a time.
const CONVERTED: usize = 16;

/// Cells, the taps along columns that look at them, and rows of what they see.
type Looked<'s> = (&'s [f32], &'s [[f32; TAPS]], Ring);

/// What a fused product needs of one linearisation.
pub(super) struct Fused {
    bands: Bands,
    /// a/l₀.
    beam: Vec<f32>,
    /// Whether weights differ within an exposure.
    is_uneven: bool,
    /// Taps along rows and columns of each exposure, those along rows times c, or √b c; and their slopes.
    taps: [Vec<[f32; TAPS]>; 2],
    slopes: [Vec<[f32; TAPS]>; 2],
    /// An ordinary light, and w₀.
    light: f64,
    weight: f64,
    /// The sums of all bands.
    sums: Vec<f32>,
}

impl Fused {
    /// Whether no offset is sought, and exposures are not turned.
    pub(super) fn serves<T: Real>(pass: &Pass<'_, '_, T>) -> bool {
        let views = &pass.grid.geometry.views;
        let is_turned = views.iter().any(|view| view.rotation != Rotation::None);
        pass.grid.is_spline() && !is_turned && !pass.with_offset
    }

    /// For exposures at the places where the pass has them, and these coefficients.
    pub(super) fn new<T: Real>(
        pass: &Pass<'_, '_, T>,
        coefficients: &[f64],
        [light, weight]: [f64; 2],
        control: &Control,
    ) -> Self {
        let (sensor, count) = (pass.exposures.sensor(), pass.exposures.count());
        let bands = Bands::new(&pass.grid, &pass.windows);
        let is_uneven = (0..count).any(|k| pass.exposures.uniform_weight(k).is_none());
        let gain = |k: usize| {
            let even = pass.exposures.uniform_weight(k).filter(|_| !is_uneven);
            pass.flux[k] * even.map_or(1.0, |w| (w / weight).sqrt())
        };
        let each = |taps: &dyn Fn(&Window) -> [f64; TAPS], gain: &dyn Fn(usize) -> f64| {
            let scaled = |(k, window)| taps(window).map(|tap| (gain(k) * tap) as f32);
            pass.windows.iter().enumerate().map(scaled).collect()
        };
        let mut beam = pass.workers.filled(coefficients.len(), 0.0, control);
        let converted = CONVERTED * pass.grid.geometry.beam.cols;
        pass.workers.map_blocks(&mut beam, converted, |block, cells| {
            let coefficients = coefficients[block * converted..].iter();
            cells.iter_mut().zip(coefficients).for_each(|(cell, a)| *cell = (a / light) as f32);
        });
        Self {
            beam,
            is_uneven,
            taps: [each(&|w| w.along_rows.values, &gain), each(&|w| w.along_cols.values, &|_| 1.0)],
            slopes: [
                each(&|w| w.along_rows.slopes, &gain),
                each(&|w| w.along_cols.slopes, &|_| 1.0),
            ],
            light,
            weight,
            sums: pass.workers.filled(bands.size(sensor.rows), 0.0, control),
            bands,
        }
    }

    /// What x and changes of ln c and of shifts pull at the cells, in units of w₀ times an ordinary light, for x in units
    /// of that light, and the change of M in each [`Row`]; the sums hold the largest size of that less `share` of the
    /// change before.
    pub(super) fn pull<T: Real>(
        &mut self,
        pass: &mut Pass<'_, '_, T>,
        penalty: (&Penalty, &[f32]),
        (x, logs, moves): (&[f32], &[f64], &[[f64; 2]]),
        share: f64,
        product: &mut [f32],
        control: &Control,
    ) -> Result<Sums> {
        let place = |k: usize| {
            let [row, col] = moves.get(k).copied().unwrap_or_default();
            Place { changes: [logs[k], row, col].map(|x| x as f32), ..Place::default() }
        };
        let sought = pass.with_flux || pass.with_shifts;
        let places: Vec<Place> = (0..logs.len()).filter(|_| sought).map(place).collect();
        let of_row = Row::length(pass.exposures.sensor().cols, pass.with_offset);
        let mut rows = std::mem::take(&mut pass.rows);
        let mut sums = std::mem::take(&mut self.sums);
        let (fused, seen) = (&*self, &*pass);
        let sizes = [fused.bands.height * of_row, fused.bands.length];
        let bands = pass.workers.map_pairs(&mut rows, &mut sums, sizes, |band, rows, strips| {
            let rows = rows.chunks_exact_mut(of_row);
            fused.band(seen, (x, places.clone(), share), band, rows, strips, control)
        });
        (pass.rows, self.sums) = (rows, sums);
        pass.count += 1;
        control.check()?;
        self.fold(pass, penalty, x, product);
        control.check()?;
        let mut total = pass.no_sums();
        let unit = self.weight * self.light * self.light;
        for (largest, places) in bands {
            total.largest = total.largest.max(largest);
            for (k, Place { pulls: [log, row, col], .. }) in places.into_iter().enumerate() {
                total.flux[k] += unit * log;
                let shifts = total.shifts.get_mut(k).into_iter().flatten();
                shifts.zip([row, col]).for_each(|(total, sum)| *total += unit * sum);
            }
        }
        Ok(total)
    }

    /// What the pixels of one band pull at the cells, at fluxes and at shifts; and the largest change.
    fn band<'r, T: Real>(
        &self,
        pass: &Pass<'_, '_, T>,
        (x, mut places, share): (&[f32], Vec<Place>, f64),
        band: usize,
        rows: impl ExactSizeIterator<Item = &'r mut [f64]>,
        strips: &mut [f32],
        control: &Control,
    ) -> (f64, Vec<Place>) {
        let (cols, count) = (pass.exposures.sensor().cols, pass.exposures.count());
        let stride = pass.grid.geometry.beam.cols;
        let slopes = if pass.with_shifts { &self.slopes[0][..] } else { &[] };
        let mut seen = [
            (&self.beam[..], &self.taps[1][..]),
            (x, &self.taps[1]),
            (&self.beam, &self.slopes[1]),
        ]
        .map(|(cells, taps)| (cells, taps, Ring::new(count, cols)));
        let looked = if pass.with_shifts { 3 } else { 2 };
        let mut pulls = Ring::new(count, cols + 2 * AROUND);
        let mut weights = if self.is_uneven { pass.row_of_weights() } else { Vec::new() };
        let mut block = Block::new(count);
        let mut line = vec![0.0; cols + 2 * AROUND];
        let (first, mut largest) = (band * self.bands.height, 0.0_f64);
        let height = rows.len();
        strips.fill(0.0);
        let look = |seen: &mut [Looked<'_>; 3], row: usize| {
            for (cells, taps, seen) in &mut seen[..looked] {
                for (k, window) in pass.windows.iter().enumerate() {
                    let at = (first + row + window.row) * stride + window.col;
                    let (values, taps) = (&cells[at..][..cols + AROUND], taps[k]);
                    let seen = &mut seen.row_mut(k, row)[..cols];
                    pulp::Arch::new().dispatch(Along { values, taps, seen });
                }
            }
        };
        (0..AROUND).for_each(|row| look(&mut seen, row));
        for (index, row) in rows.enumerate() {
            if control.is_cancelled() {
                return (largest, places);
            }
            look(&mut seen, index + AROUND);
            if self.is_uneven {
                pass.weigh_row(first + index, &mut weights);
            }
            largest = largest.max(pulp::Arch::new().dispatch(Eliminate {
                seen: [&seen[0].2, &seen[1].2, &seen[2].2],
                index,
                taps: &self.taps[0],
                slopes,
                places: &mut places,
                few: pass.few.in_row(first + index),
                weights: &weights,
                per_weight: 1.0 / self.weight,
                row: Row::of(row, cols),
                unit: self.weight * self.light * self.light,
                share,
                block: &mut block,
                pulls: &mut pulls,
            }));
            self.back(pass, index, &pulls, &mut line, strips);
        }
        for index in height..height + AROUND {
            (0..count).for_each(|k| pulls.row_mut(k, index).fill(0.0));
            self.back(pass, index, &pulls, &mut line, strips);
        }
        (largest, places)
    }

    /// Adds what the last rows of pulls make of the row of cells that the first taps lead to.
    fn back<T: Real>(
        &self,
        pass: &Pass<'_, '_, T>,
        index: usize,
        pulls: &Ring,
        line: &mut [f32],
        strips: &mut [f32],
    ) {
        let wide = pass.exposures.sensor().cols + AROUND;
        let strip = &self.bands.strips[0];
        for (k, window) in pass.windows.iter().enumerate() {
            let at = (index + window.row - strip.first) * strip.cols + window.col;
            // The first tap goes with the last row.
            let rows = [TAPS, TAPS - 1, TAPS - 2, TAPS - 3].map(|i| pulls.row(k, index + i));
            let (along_rows, along_cols) = (self.taps[0][k], self.taps[1][k]);
            let (line, sums) = (&mut line[..], &mut strips[at..][..wide]);
            pulp::Arch::new().dispatch(Back { rows, along_rows, along_cols, line, sums });
        }
    }

    /// The sums of all bands and the penalty.
    fn fold<T: Real>(
        &self,
        pass: &Pass<'_, '_, T>,
        (penalty, scale): (&Penalty, &[f32]),
        x: &[f32],
        product: &mut [f32],
    ) {
        let (cols, workers) = (pass.grid.geometry.beam.cols, pass.workers);
        let multiples = penalty.multiples(x, scale, workers).map(|multiple| multiple / self.weight);
        let bends = (penalty.tau / self.weight) as f32;
        workers.map_blocks(product, FOLDED * cols, |block, product| {
            let first = block * FOLDED;
            product.fill(0.0);
            for (row, sums) in product.chunks_exact_mut(cols).enumerate() {
                for values in self.bands.seeing(&self.sums, 0, first + row) {
                    pulp::Arch::new().dispatch(Sum(values, sums));
                }
            }
            penalty.bend_rows(x, bends, first, product);
            let others = [&penalty.bent[first * cols..], &scale[first * cols..]];
            pulp::Arch::new().dispatch(Subtract { others, multiples, product });
        });
    }
}

//! A product with S in one pass in single precision, where only the beam is sought.
//!
//! With b = √(w/w₀) c and the unit vectors ê = √w e/√(Σ w e²) over the exposures of a pixel, a change x of the
//! coefficients pulls back
//!
//! ```text
//! S x = w₀ Bᵀ b M² (v − ê Σ ê v),   v = b B x,   δM = −M √(w₀/Σ w e²) Σ ê v
//! ```
//!
//! Taps along rows and along columns are applied one after the other. A band of pixels keeps the last rows
//! of cells as seen along a row, and the last rows of pulls. Whatever of the size of the data is read or
//! written is in single precision: M, the light and the right-hand side are found in double precision at
//! each step, which makes good what the one before left by rounding (iterative refinement).

use super::bands::Bands;
use super::fused_kernel::{Along, Back, Eliminate, LANES, Pixels, Ring, Subtract, Sum};
use super::kernel::{AROUND, Row};
use super::pass::Pass;
use super::penalty::Penalty;
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::geometry::{Rotation, TAPS};

/// Rows of pixels in a band, at least.
const BAND: usize = 64;
/// Rows of cells that a thread folds at a time.
const FOLDED: usize = 32;
/// Rows of pixels that a thread converts at a time.
const CONVERTED: usize = 16;

/// What a fused product needs of one linearisation.
pub(super) struct Fused {
    bands: Bands,
    /// Values of a row of one quantity.
    width: usize,
    /// Whether weights differ within an exposure.
    is_uneven: bool,
    /// By row of pixels what [`Pixels`] holds.
    rows: Vec<f32>,
    /// Taps along rows and columns of each exposure, those along rows times b where it is the same.
    taps: [Vec<[f32; TAPS]>; 2],
    /// An ordinary light, and w₀.
    light: f64,
    weight: f64,
    /// The sums of all bands.
    sums: Vec<f32>,
}

impl Fused {
    /// Whether there is nothing but the beam to seek, on one grid that is not turned.
    pub(super) fn serves<T: Real>(pass: &Pass<'_, '_, T>) -> bool {
        let views = &pass.grid.geometry.views;
        let is_turned = views.iter().any(|view| view.rotation != Rotation::None);
        let seeks_more = pass.with_flux || pass.with_shifts || pass.with_offset;
        pass.grid.is_spline() && !is_turned && !seeks_more
    }

    /// For exposures at the places where the pass has them.
    pub(super) fn new<T: Real>(
        pass: &Pass<'_, '_, T>,
        [light, weight]: [f64; 2],
        control: &Control,
    ) -> Self {
        let (sensor, count) = (pass.exposures.sensor(), pass.exposures.count());
        let bands = Bands::new(&pass.windows, &pass.grid.geometry.views, pass.grid.width, BAND);
        let width = sensor.cols.next_multiple_of(LANES);
        let is_uneven = (0..count).any(|k| pass.exposures.uniform_weight(k).is_none());
        let length = (if is_uneven { 2 * count } else { count } + 2) * width;
        let sums = pass.workers.filled(bands.size(sensor.rows), 0.0, control);
        Self {
            bands,
            width,
            is_uneven,
            rows: pass.workers.filled(sensor.rows * length, 0.0, control),
            taps: [Vec::new(), Vec::new()],
            light,
            weight,
            sums,
        }
    }

    /// Takes M, the light and the taps of the pass, unless `control` asks to stop.
    pub(super) fn renew<T: Real>(&mut self, pass: &Pass<'_, '_, T>, control: &Control) {
        let (count, cols) = (pass.exposures.count(), pass.exposures.sensor().cols);
        let (width, weight, light, is_uneven) =
            (self.width, self.weight, self.light, self.is_uneven);
        let along = |k: usize| {
            let uniform = pass.exposures.uniform_weight(k).filter(|_| !is_uneven);
            let gain = uniform.map_or(1.0, |w| (w / weight).sqrt() * pass.flux[k]);
            pass.windows[k].along_rows.values.map(|tap| (gain * tap) as f32)
        };
        let across = |k: usize| pass.windows[k].along_cols.values.map(|tap| tap as f32);
        self.taps = [(0..count).map(along).collect(), (0..count).map(across).collect()];
        let length = self.length(count);
        pass.workers.map_blocks(&mut self.rows, CONVERTED * length, |block, rows| {
            let mut workspace = pass.workspace();
            for (index, row) in rows.chunks_exact_mut(length).enumerate() {
                if control.is_cancelled() {
                    return;
                }
                let index = block * CONVERTED + index;
                pass.weigh_row(index, &mut workspace);
                let (lights, rest) = pass.row(index).split_at(count * cols);
                let (m, inverse) = rest.split_at(cols);
                let pixels =
                    Found { lights, m, inverse: &inverse[..cols], weights: &workspace.weights };
                let flux = is_uneven.then_some(&pass.flux[..]);
                pixels.shorten([weight, light], flux, row.chunks_exact_mut(width));
                let square = length - 2 * width;
                pass.few.clear(index, &mut row[square..]);
            }
        });
    }

    /// Values of a row of pixels.
    const fn length(&self, count: usize) -> usize {
        (if self.is_uneven { 2 * count } else { count } + 2) * self.width
    }

    /// S x in units of w₀ times an ordinary light, for x in units of that light, and the change of M in each
    /// [`Row`]; returns the largest size of that less `share` of the change before.
    pub(super) fn multiply<T: Real>(
        &mut self,
        pass: &mut Pass<'_, '_, T>,
        penalty: &Penalty,
        x: &[f32],
        share: f64,
        product: &mut [f32],
        control: &Control,
    ) -> Result<f64> {
        let count = pass.exposures.count();
        let of_row = Row::length(count, pass.exposures.sensor().cols, pass.with_offset);
        let mut rows = std::mem::take(&mut pass.rows);
        let mut sums = std::mem::take(&mut self.sums);
        let (fused, seen) = (&*self, &*pass);
        let sizes = [fused.bands.height * of_row, fused.bands.length];
        let bands = pass.workers.map_pairs(&mut rows, &mut sums, sizes, |band, rows, strips| {
            let rows = rows.chunks_exact_mut(of_row);
            fused.band(seen, (x, share), band, rows, strips, control)
        });
        (pass.rows, self.sums) = (rows, sums);
        pass.count += 1;
        control.check()?;
        self.fold(pass, penalty, x, product);
        control.check()?;
        Ok(bands.into_iter().fold(0.0, f64::max))
    }

    /// What the pixels of one band pull at the cells.
    fn band<'r, T: Real>(
        &self,
        pass: &Pass<'_, '_, T>,
        (x, share): (&[f32], f64),
        band: usize,
        rows: impl ExactSizeIterator<Item = &'r mut [f64]>,
        strips: &mut [f32],
        control: &Control,
    ) -> f64 {
        let (cols, count) = (pass.exposures.sensor().cols, pass.exposures.count());
        let stride = pass.grid.geometry.beam.cols;
        let mut seen = Ring::new(count, self.width);
        let mut pulls = Ring::new(count, self.width + 2 * AROUND);
        let mut values = vec![[0.0; LANES]; count];
        let mut line = vec![0.0; self.width + 2 * AROUND];
        let (first, mut largest) = (band * self.bands.height, 0.0_f64);
        let height = rows.len();
        strips.fill(0.0);
        let look = |seen: &mut Ring, row: usize| {
            for (k, window) in pass.windows.iter().enumerate() {
                let at = (first + row + window.row) * stride + window.col;
                let (values, taps) = (&x[at..][..cols + AROUND], self.taps[1][k]);
                let seen = &mut seen.row_mut(k, row)[..cols];
                pulp::Arch::new().dispatch(Along { values, taps, seen });
            }
        };
        (0..AROUND).for_each(|row| look(&mut seen, row));
        for (index, row) in rows.enumerate() {
            if control.is_cancelled() {
                return largest;
            }
            look(&mut seen, index + AROUND);
            let last = &mut *Row::of(row, count, cols).change;
            largest = largest.max(pulp::Arch::new().dispatch(Eliminate {
                seen: &seen,
                index,
                taps: &self.taps[0],
                pixels: self.pixels(first + index, count),
                last,
                share,
                values: &mut values,
                pulls: &mut pulls,
            }));
            self.back(pass, index, &pulls, &mut line, strips);
        }
        for index in height..height + AROUND {
            (0..count).for_each(|k| pulls.row_mut(k, index).fill(0.0));
            self.back(pass, index, &pulls, &mut line, strips);
        }
        largest
    }

    fn pixels(&self, row: usize, count: usize) -> Pixels<'_> {
        let length = self.length(count);
        let (units, rest) = self.rows[row * length..][..length].split_at(count * self.width);
        let (gains, rest) = rest.split_at(rest.len() - 2 * self.width);
        let (square, change) = rest.split_at(self.width);
        Pixels { units, gains: self.is_uneven.then_some(gains), square, change }
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
        penalty: &Penalty,
        x: &[f32],
        product: &mut [f32],
    ) {
        let (cols, workers) = (pass.grid.geometry.beam.cols, pass.workers);
        let (pulled, bent) = (workers.dot(&penalty.pull, x), workers.dot(&penalty.bent, x));
        let multiples = penalty.multiples(pulled, bent).map(|multiple| multiple / self.weight);
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
            let others = [&penalty.bent[first * cols..], &penalty.pull[first * cols..]];
            pulp::Arch::new().dispatch(Subtract { others, multiples, product });
        });
    }
}

/// What a linearisation found along a row of pixels: c L of each exposure, M, and 1/Σ w e².
struct Found<'s> {
    lights: &'s [f64],
    m: &'s [f64],
    inverse: &'s [f64],
    weights: &'s [f64],
}

impl Found<'_> {
    /// Writes what [`Pixels`] holds, with √(w/w₀) c where the fluxes c are given.
    fn shorten<'r>(
        &self,
        [weight, light]: [f64; 2],
        flux: Option<&[f64]>,
        mut parts: impl Iterator<Item = &'r mut [f32]>,
    ) {
        let cols = self.m.len();
        let exposures = self.lights.chunks_exact(cols).zip(self.weights.chunks_exact(cols));
        for ((lights, weights), unit) in exposures.zip(&mut parts) {
            let pixels = lights.iter().zip(weights).zip(self.inverse);
            for (unit, ((e, w), inverse)) in unit.iter_mut().zip(pixels) {
                *unit = ((w * inverse).sqrt() * e) as f32;
            }
        }
        let gains = flux.into_iter().flatten().zip(self.weights.chunks_exact(cols));
        for ((flux, weights), gain) in gains.zip(&mut parts) {
            let pixels = gain.iter_mut().zip(weights);
            pixels.for_each(|(gain, w)| *gain = ((w / weight).sqrt() * flux) as f32);
        }
        let (Some(square), Some(change)) = (parts.next(), parts.next()) else { return };
        let pixels = square.iter_mut().zip(change).zip(self.m.iter().zip(self.inverse));
        for ((square, change), (m, inverse)) in pixels {
            *square = (m * m) as f32;
            *change = (m * (inverse * weight).sqrt() * light) as f32;
        }
    }
}

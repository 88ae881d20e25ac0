//! The arithmetic of a fused product along one row of pixels, in single precision.

use super::kernel::{AROUND, Row};
use crate::geometry::TAPS;

/// Values side by side, which vector registers hold.
pub(super) const LANES: usize = 16;

/// Σ_j u_j a(col + j): what the pixels of a row see of a row of cells along it.
pub(super) struct Along<'s> {
    pub(super) values: &'s [f32],
    pub(super) taps: [f32; TAPS],
    pub(super) seen: &'s mut [f32],
}

impl pulp::NullaryFnOnce for Along<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [s, t, u, v] = self.taps;
        let cols = self.seen.len();
        let [a, b, c, d] = [0, 1, 2, 3].map(|from| &self.values[from..from + cols]);
        for ((((seen, a), b), c), d) in self.seen.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *seen = s * a + t * b + u * c + v * d;
        }
    }
}

/// A ring of as many rows as there are taps, for each exposure.
pub(super) struct Ring {
    values: Vec<f32>,
    width: usize,
}

impl Ring {
    pub(super) fn new(exposures: usize, width: usize) -> Self {
        Self { values: vec![0.0; exposures * TAPS * width], width }
    }

    /// Row number `index` of an exposure, which takes the place of one [`TAPS`] before.
    #[inline(always)]
    pub(super) fn row(&self, exposure: usize, index: usize) -> &[f32] {
        &self.values[(exposure * TAPS + index % TAPS) * self.width..][..self.width]
    }

    #[inline(always)]
    pub(super) fn row_mut(&mut self, exposure: usize, index: usize) -> &mut [f32] {
        &mut self.values[(exposure * TAPS + index % TAPS) * self.width..][..self.width]
    }
}

/// The values of a row from one place on. A closure would stay a call within the dispatched code.
#[inline(always)]
fn lanes(row: &[f32], start: usize) -> [f32; LANES] {
    let mut values = [0.0; LANES];
    values.copy_from_slice(&row[start..start + LANES]);
    values
}

/// What pixels of a row see of a ring of rows of cells, of which the first tap takes number `index`.
#[inline(always)]
fn across(
    ring: &Ring,
    exposure: usize,
    index: usize,
    taps: [f32; TAPS],
    start: usize,
) -> [f32; LANES] {
    let [s, t, u, v] = taps;
    let a = lanes(ring.row(exposure, index), start);
    let b = lanes(ring.row(exposure, index + 1), start);
    let c = lanes(ring.row(exposure, index + 2), start);
    let d = lanes(ring.row(exposure, index + 3), start);
    let mut seen = [0.0; LANES];
    for i in 0..LANES {
        seen[i] = s * a[i] + t * b[i] + u * c[i] + v * d[i];
    }
    seen
}

/// What pixels see of the beam and of a change of it, l and v, and what they pull back once M has followed by
/// −M α: v → M² (v − l α) with α = i Σ l v over the exposures of a pixel. Returns the largest size of the change of M
/// less a share of the change before.
pub(super) struct Eliminate<'s> {
    /// Rows of cells as seen along the row of pixels, of the beam and of its change, of which the first tap takes
    /// number `index`.
    pub(super) seen: [&'s Ring; 2],
    pub(super) index: usize,
    /// Taps along rows of each exposure.
    pub(super) taps: &'s [[f32; TAPS]],
    /// √(w/w₀) c of each measurement, unless that is the same for an exposure and in its taps.
    pub(super) gains: Option<&'s [f32]>,
    /// M, its normal matrix and its last change.
    pub(super) row: Row<'s>,
    /// i times Σ w e².
    pub(super) unit: f64,
    pub(super) share: f64,
    /// Buffers for l and v of each exposure.
    pub(super) values: &'s mut [[[f32; LANES]; 2]],
    /// The pulls of the row, of the same number.
    pub(super) pulls: &'s mut Ring,
}

impl pulp::NullaryFnOnce for Eliminate<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let Self { seen, index, taps, gains, row, unit, share, values, pulls } = self;
        let width = seen[0].width;
        let mut largest = [0.0_f64; LANES];
        let pixels = row.change.chunks_mut(LANES).zip(row.sensitivity.chunks(LANES));
        for (chunk, ((last, m), inverse)) in pixels.zip(row.inverse.chunks(LANES)).enumerate() {
            let start = chunk * LANES;
            let mut along = [0.0; LANES];
            for (k, ([level, value], &taps)) in values.iter_mut().zip(taps).enumerate() {
                *level = across(seen[0], k, index, taps, start);
                *value = across(seen[1], k, index, taps, start);
                if let Some(gains) = gains {
                    let gain = lanes(gains, k * width + start);
                    for i in 0..LANES {
                        level[i] *= gain[i];
                        value[i] *= gain[i];
                    }
                }
                for i in 0..LANES {
                    along[i] += level[i] * value[i];
                }
            }
            // Behind the last pixel M is 0.
            let [mut sensitivity, mut square] = [[0.0; LANES]; 2];
            for (i, (m, inverse)) in m.iter().zip(inverse).enumerate() {
                along[i] *= (unit * inverse) as f32;
                sensitivity[i] = *m as f32;
                square[i] = sensitivity[i] * sensitivity[i];
            }
            for (k, [level, value]) in values.iter().enumerate() {
                let mut pull = [0.0; LANES];
                for i in 0..LANES {
                    pull[i] = square[i] * (value[i] - level[i] * along[i]);
                }
                if let Some(gains) = gains {
                    let gain = lanes(gains, k * width + start);
                    for i in 0..LANES {
                        pull[i] *= gain[i];
                    }
                }
                pulls.row_mut(k, index)[AROUND + start..][..LANES].copy_from_slice(&pull);
            }
            for (i, (last, largest)) in last.iter_mut().zip(&mut largest).enumerate() {
                let change = f64::from(sensitivity[i] * along[i]);
                // A maximum would lose what is no number, a minimum does not.
                let size = (change + share * *last).abs().min(f64::INFINITY);
                *largest = largest.max(size);
                *last = -change;
            }
        }
        largest.into_iter().fold(0.0, f64::max)
    }
}

/// Adds to a row of cells what the pulls of four rows of pixels make of it.
pub(super) struct Back<'s> {
    /// With [`AROUND`] zeros on either side.
    pub(super) rows: [&'s [f32]; TAPS],
    pub(super) along_rows: [f32; TAPS],
    pub(super) along_cols: [f32; TAPS],
    /// A buffer for a row.
    pub(super) line: &'s mut [f32],
    pub(super) sums: &'s mut [f32],
}

impl pulp::NullaryFnOnce for Back<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let cols = self.sums.len();
        let line = &mut self.line[..cols + AROUND];
        let [s, t, u, v] = self.along_rows;
        let [a, b, c, d] = self.rows.map(|row| &row[..cols + AROUND]);
        for ((((line, a), b), c), d) in line.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *line = s * a + t * b + u * c + v * d;
        }
        let [s, t, u, v] = self.along_cols;
        let [a, b, c, d] = [0, 1, 2, 3].map(|from| &line[from..from + cols]);
        for ((((sum, a), b), c), d) in self.sums.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *sum += v * a + u * b + t * c + s * d;
        }
    }
}

/// Takes multiples of two others off.
pub(super) struct Subtract<'s> {
    pub(super) others: [&'s [f64]; 2],
    pub(super) multiples: [f64; 2],
    pub(super) product: &'s mut [f32],
}

impl pulp::NullaryFnOnce for Subtract<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [s, t] = self.multiples;
        let [a, b] = self.others;
        for (product, (a, b)) in self.product.iter_mut().zip(a.iter().zip(b)) {
            *product = (f64::from(*product) - s * a - t * b) as f32;
        }
    }
}

/// Adds one row to another.
pub(super) struct Sum<'s>(pub(super) &'s [f32], pub(super) &'s mut [f32]);

impl pulp::NullaryFnOnce for Sum<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.1.iter_mut().zip(self.0).for_each(|(sum, value)| *sum += value);
    }
}

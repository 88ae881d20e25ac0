//! The arithmetic of a fused product along one row of pixels, in single precision.

use super::kernel::AROUND;
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

/// What is kept of a row of pixels: ê of each exposure, √(w/w₀) c of each measurement unless that is the
/// same for an exposure, M², and what the change of M is of Σ ê v.
pub(super) struct Pixels<'s> {
    pub(super) units: &'s [f32],
    pub(super) gains: Option<&'s [f32]>,
    pub(super) square: &'s [f32],
    pub(super) change: &'s [f32],
}

/// The values of a row from one place on. A closure would stay a call within the dispatched code.
#[inline(always)]
fn lanes(row: &[f32], start: usize) -> [f32; LANES] {
    let mut values = [0.0; LANES];
    values.copy_from_slice(&row[start..start + LANES]);
    values
}

/// What pixels see, v, and what they pull back once M has followed: with unit vectors ê along √w e over the
/// exposures of a pixel, v → M² (v − ê Σ ê v). Returns the largest size of the change of M less a share of
/// the change before.
pub(super) struct Eliminate<'s> {
    /// Rows of cells as seen along the row of pixels, of which the first tap takes number `index`.
    pub(super) seen: &'s Ring,
    pub(super) index: usize,
    /// Taps along rows of each exposure.
    pub(super) taps: &'s [[f32; TAPS]],
    pub(super) pixels: Pixels<'s>,
    pub(super) last: &'s mut [f64],
    pub(super) share: f64,
    /// Buffers for v of each exposure.
    pub(super) values: &'s mut [[f32; LANES]],
    /// The pulls of the row, of the same number.
    pub(super) pulls: &'s mut Ring,
}

impl pulp::NullaryFnOnce for Eliminate<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let Self { seen, index, taps, pixels, last, share, values, pulls } = self;
        let width = pixels.square.len();
        let mut largest = [0.0_f64; LANES];
        for (chunk, last) in last.chunks_mut(LANES).enumerate() {
            let start = chunk * LANES;
            let mut along = [0.0; LANES];
            for (k, (value, &[s, t, u, v])) in values.iter_mut().zip(taps).enumerate() {
                let a = lanes(seen.row(k, index), start);
                let b = lanes(seen.row(k, index + 1), start);
                let c = lanes(seen.row(k, index + 2), start);
                let d = lanes(seen.row(k, index + 3), start);
                let unit = lanes(pixels.units, k * width + start);
                for i in 0..LANES {
                    value[i] = s * a[i] + t * b[i] + u * c[i] + v * d[i];
                }
                if let Some(gains) = pixels.gains {
                    let gain = lanes(gains, k * width + start);
                    for i in 0..LANES {
                        value[i] *= gain[i];
                    }
                }
                for i in 0..LANES {
                    along[i] += unit[i] * value[i];
                }
            }
            let square = lanes(pixels.square, start);
            for (k, value) in values.iter().enumerate() {
                let unit = lanes(pixels.units, k * width + start);
                let mut pull = [0.0; LANES];
                for i in 0..LANES {
                    pull[i] = square[i] * (value[i] - unit[i] * along[i]);
                }
                if let Some(gains) = pixels.gains {
                    let gain = lanes(gains, k * width + start);
                    for i in 0..LANES {
                        pull[i] *= gain[i];
                    }
                }
                pulls.row_mut(k, index)[AROUND + start..][..LANES].copy_from_slice(&pull);
            }
            let factor = lanes(pixels.change, start);
            for (i, (last, largest)) in last.iter_mut().zip(&mut largest).enumerate() {
                let change = f64::from(factor[i] * along[i]);
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

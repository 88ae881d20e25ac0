//! The arithmetic of a fused product along one row of pixels, in single precision.

use super::kernel::{AROUND, Row};
use crate::geometry::TAPS;

/// Values side by side, which vector registers hold.
const LANES: usize = 16;
/// Pixels that a row is taken by: what is found of them on the way stays in the nearest cache.
const BLOCK: usize = 256;

/// Σ_i t_i a_i of four rows of values.
#[inline(always)]
fn combine([s, t, u, v]: [f32; TAPS], rows: [&[f32]; TAPS], sums: &mut [f32]) {
    let [a, b, c, d] = rows;
    for ((((sum, a), b), c), d) in sums.iter_mut().zip(a).zip(b).zip(c).zip(d) {
        *sum = s * a + t * b + u * c + v * d;
    }
}

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
        let cols = self.seen.len();
        let shifted = [0, 1, 2, 3].map(|from| &self.values[from..from + cols]);
        combine(self.taps, shifted, self.seen);
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

    /// The rows that the taps lead to, of which the first has number `index`, from one place on.
    #[inline(always)]
    fn block(&self, exposure: usize, index: usize, first: usize, cols: usize) -> [&[f32]; TAPS] {
        let row = |tap: usize| self.row(exposure, index + tap);
        let (a, b, c, d) = (row(0), row(1), row(2), row(3));
        let place = first..first + cols;
        [&a[place.clone()], &b[place.clone()], &c[place.clone()], &d[place]]
    }

    #[inline(always)]
    pub(super) fn row_mut(&mut self, exposure: usize, index: usize) -> &mut [f32] {
        &mut self.values[(exposure * TAPS + index % TAPS) * self.width..][..self.width]
    }
}

/// Buffers for a block of pixels.
pub(super) struct Block {
    /// l, v, b and ∂l/∂d of each exposure.
    seen: Vec<[[f32; BLOCK]; 5]>,
    /// α, M and M².
    pixels: [[f32; BLOCK]; 3],
}

impl Block {
    pub(super) fn new(exposures: usize) -> Self {
        Self { seen: vec![[[0.0; BLOCK]; 5]; exposures], pixels: [[0.0; BLOCK]; 3] }
    }
}

/// Changes of ln c and d of an exposure, and what its pixels pull at them.
#[derive(Clone, Copy, Default)]
pub(super) struct Place {
    pub(super) changes: [f32; 3],
    pub(super) pulls: [f64; 3],
}

/// What pixels see of the beam and of a change of beam, fluxes and shifts, l and v, and what they pull back once M has
/// followed by −M α: v → b M² (v − l α) with α = i Σ b l v over the exposures of a pixel. Returns the largest size of the
/// change of M less a share of the change before.
pub(super) struct Eliminate<'s> {
    /// Rows of cells as seen along the row of pixels, of the beam, of its change and of the beam's slope, of which the
    /// first tap takes number `index`.
    pub(super) seen: [&'s Ring; 3],
    pub(super) index: usize,
    /// Taps along rows of each exposure, and their slopes, if shifts are sought.
    pub(super) taps: &'s [[f32; TAPS]],
    pub(super) slopes: &'s [[f32; TAPS]],
    /// Fluxes and shifts of each exposure, if any are sought.
    pub(super) places: &'s mut [Place],
    /// Columns that pull at nothing.
    pub(super) few: &'s [usize],
    /// w of each measurement, empty where b is in the taps of an exposure; 1/w₀.
    pub(super) weights: &'s [f64],
    pub(super) per_weight: f64,
    /// M, its normal matrix and its last change.
    pub(super) row: Row<'s>,
    /// i times Σ w e².
    pub(super) unit: f64,
    pub(super) share: f64,
    pub(super) block: &'s mut Block,
    /// The pulls of the row, of the same number.
    pub(super) pulls: &'s mut Ring,
}

impl pulp::NullaryFnOnce for Eliminate<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let Self { seen, index, taps, slopes, places, few, weights, per_weight, .. } = self;
        let Self { row, unit, share, block, pulls, .. } = self;
        let width = seen[0].width;
        let is_uneven = !weights.is_empty();
        let Block { seen: found, pixels: [along, m, square] } = block;
        let mut largest = 0.0_f64;
        let rows = row.change.chunks_mut(BLOCK).zip(row.sensitivity.chunks(BLOCK));
        for (number, ((last, sensitivity), inverse)) in
            rows.zip(row.inverse.chunks(BLOCK)).enumerate()
        {
            let (first, cols) = (number * BLOCK, last.len());
            let (along, m, square) = (&mut along[..cols], &mut m[..cols], &mut square[..cols]);
            along.fill(0.0);
            for (k, ([level, value, even, down, right], &taps)) in
                found.iter_mut().zip(taps).enumerate()
            {
                let (level, value) = (&mut level[..cols], &mut value[..cols]);
                combine(taps, seen[0].block(k, index, first, cols), level);
                combine(taps, seen[1].block(k, index, first, cols), value);
                if let Some(Place { changes: [log, row, col], .. }) = places.get(k) {
                    value.iter_mut().zip(&*level).for_each(|(v, l)| *v += log * l);
                    if let Some(&slopes) = slopes.get(k) {
                        let (down, right) = (&mut down[..cols], &mut right[..cols]);
                        combine(slopes, seen[0].block(k, index, first, cols), down);
                        combine(taps, seen[2].block(k, index, first, cols), right);
                        let slopes = down.iter().zip(&*right);
                        for (value, (down, right)) in value.iter_mut().zip(slopes) {
                            *value += row * down + col * right;
                        }
                    }
                }
                let both = along.iter_mut().zip(level.iter().zip(&*value));
                if is_uneven {
                    let weights = &weights[k * width + first..][..cols];
                    for ((b, w), (sum, (level, value))) in even.iter_mut().zip(weights).zip(both) {
                        *b = (per_weight * w) as f32;
                        *sum += *b * level * value;
                    }
                } else {
                    both.for_each(|(sum, (level, value))| *sum += level * value);
                }
            }
            let pixels = along.iter_mut().zip(&mut *m).zip(&mut *square);
            for (((along, m), square), (of_row, inverse)) in
                pixels.zip(sensitivity.iter().zip(inverse))
            {
                *along *= (unit * inverse) as f32;
                *m = *of_row as f32;
                *square = *m * *m;
            }
            few.iter().filter_map(|col| col.checked_sub(first)).for_each(|col| {
                square.get_mut(col).into_iter().for_each(|square| *square = 0.0);
            });
            for (k, [level, value, even, down, right]) in found.iter().enumerate() {
                let pull = &mut pulls.row_mut(k, index)[AROUND + first..][..cols];
                let pixels = square.iter().zip(&*along);
                for ((pull, (square, along)), (level, value)) in
                    pull.iter_mut().zip(pixels).zip(level.iter().zip(value))
                {
                    *pull = square * (value - level * along);
                }
                if is_uneven {
                    pull.iter_mut().zip(even).for_each(|(pull, b)| *pull *= b);
                }
                if let Some(place) = places.get_mut(k) {
                    let sought = if slopes.is_empty() { 1 } else { 3 };
                    for (sum, along) in place.pulls[..sought].iter_mut().zip([level, down, right]) {
                        *sum += dot(&along[..cols], pull);
                    }
                }
            }
            largest = largest.max(follow(last, [m, along], share));
        }
        largest
    }
}

/// Σ a b.
#[inline(always)]
fn dot(a: &[f32], b: &[f32]) -> f64 {
    let ((a, rest_a), (b, rest_b)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut sums = [0.0_f32; LANES];
    for (a, b) in a.iter().zip(b) {
        for lane in 0..LANES {
            sums[lane] += a[lane] * b[lane];
        }
    }
    let rest = rest_a.iter().zip(rest_b).map(|(a, b)| f64::from(a * b));
    sums.into_iter().map(f64::from).chain(rest).sum()
}

/// Takes the changes −M α of pixels in place of the last; returns the largest size less a share of those before.
#[inline(always)]
fn follow(last: &mut [f64], [m, along]: [&[f32]; 2], share: f64) -> f64 {
    let mut largest = [0.0_f64; LANES];
    let pixels = m.chunks(LANES).zip(along.chunks(LANES));
    for (last, (m, along)) in last.chunks_mut(LANES).zip(pixels) {
        for ((last, largest), (m, along)) in
            last.iter_mut().zip(&mut largest).zip(m.iter().zip(along))
        {
            let change = f64::from(m * along);
            // A maximum would lose what is no number, a minimum does not.
            let size = (change + share * *last).abs().min(f64::INFINITY);
            *largest = largest.max(size);
            *last = -change;
        }
    }
    largest.into_iter().fold(0.0, f64::max)
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
        combine(self.along_rows, self.rows.map(|row| &row[..cols + AROUND]), line);
        let [s, t, u, v] = self.along_cols;
        let [a, b, c, d] = [0, 1, 2, 3].map(|from| &line[from..from + cols]);
        for ((((sum, a), b), c), d) in self.sums.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *sum += v * a + u * b + t * c + s * d;
        }
    }
}

/// Takes multiples of two others off.
pub(super) struct Subtract<'s> {
    pub(super) others: [&'s [f32]; 2],
    pub(super) multiples: [f64; 2],
    pub(super) product: &'s mut [f32],
}

impl pulp::NullaryFnOnce for Subtract<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [s, t] = self.multiples.map(|multiple| multiple as f32);
        let [a, b] = self.others;
        for (product, (a, b)) in self.product.iter_mut().zip(a.iter().zip(b)) {
            *product -= s * a + t * b;
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

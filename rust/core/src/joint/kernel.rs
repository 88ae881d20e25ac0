//! The arithmetic along one row of pixels, inlined into code for the CPU at hand.

use crate::geometry::TAPS;

/// Zeros beside a row, which factors reach.
pub(crate) const AROUND: usize = TAPS - 1;
/// Values side by side, which vector registers hold.
const LANES: usize = 16;

/// One exposure's place in a row: a stretch of `cols` values after those of the exposures before.
#[inline(always)]
fn of(values: &[f64], exposure: usize, cols: usize) -> &[f64] {
    &values[exposure * cols..][..cols]
}

/// Adds Σ_ij t_i u_j a(i, col + j) of rows of values to a row of sums: what pixels see of coefficients, and,
/// with the factors reversed, what cells get of the pixels' pulls.
pub(crate) struct Combine<'s> {
    pub(crate) rows: [&'s [f64]; TAPS],
    pub(crate) along_rows: [f64; TAPS],
    pub(crate) along_cols: [f64; TAPS],
    /// The row of values between.
    pub(crate) line: &'s mut [f64],
    pub(crate) sums: &'s mut [f64],
}

impl Combine<'_> {
    pub(crate) fn dispatch(self) {
        pulp::Arch::new().dispatch(self);
    }
}

impl pulp::NullaryFnOnce for Combine<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [s, t, u, v] = self.along_rows;
        let [a, b, c, d] = self.rows;
        for ((((value, a), b), c), d) in self.line.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *value = s * a + t * b + u * c + v * d;
        }
        let [s, t, u, v] = self.along_cols;
        let cols = self.sums.len();
        let [a, b, c, d] = [0, 1, 2, 3].map(|from| &self.line[from..from + cols]);
        for ((((sum, a), b), c), d) in self.sums.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *sum += s * a + t * b + u * c + v * d;
        }
    }
}

/// A row of values for each exposure, with [`AROUND`] zeros on either side of each.
pub(crate) struct Lines {
    values: Vec<f64>,
    cols: usize,
}

impl Lines {
    pub(crate) fn new(exposures: usize, cols: usize) -> Self {
        Self { values: vec![0.0; exposures * (cols + 2 * AROUND)], cols }
    }

    pub(crate) fn clear(&mut self) {
        self.values.fill(0.0);
    }

    /// Makes the values of some columns 0, of so many exposures.
    pub(crate) fn silence(&mut self, columns: &[usize], exposures: usize) {
        for k in 0..if columns.is_empty() { 0 } else { exposures } {
            columns.iter().for_each(|&col| self.of_mut(k)[col] = 0.0);
        }
    }

    /// The row of one exposure.
    #[inline(always)]
    pub(crate) fn of(&self, exposure: usize) -> &[f64] {
        &self.values[exposure * (self.cols + 2 * AROUND) + AROUND..][..self.cols]
    }

    #[inline(always)]
    pub(crate) fn of_mut(&mut self, exposure: usize) -> &mut [f64] {
        &mut self.values[exposure * (self.cols + 2 * AROUND) + AROUND..][..self.cols]
    }

    /// That row with the zeros around.
    pub(crate) fn padded(&self, exposure: usize) -> &[f64] {
        let width = self.cols + 2 * AROUND;
        &self.values[exposure * width..][..width]
    }
}

/// What is kept of a row of pixels from one linearisation on: M, the first element of the inverse of the normal
/// matrix, the last change of M, and, where it is sought, the offset O with the other two elements. The light of
/// each exposure follows from the beam.
pub(crate) struct Row<'s> {
    pub(crate) sensitivity: &'s mut [f64],
    pub(crate) inverse: &'s mut [f64],
    pub(crate) change: &'s mut [f64],
    /// O, the element beside and the last one; empty unless O is sought.
    pub(crate) offset: [&'s mut [f64]; 3],
}

impl<'s> Row<'s> {
    /// Values that a row of `cols` pixels takes.
    pub(crate) const fn length(cols: usize, with_offset: bool) -> usize {
        if with_offset { 6 * cols } else { 3 * cols }
    }

    /// The same row for a shorter time.
    pub(crate) fn again(&mut self) -> Row<'_> {
        let [offset, i12, i22] = &mut self.offset;
        Row {
            sensitivity: self.sensitivity,
            inverse: self.inverse,
            change: self.change,
            offset: [offset, i12, i22],
        }
    }

    pub(crate) fn of(values: &'s mut [f64], cols: usize) -> Self {
        let mut parts = values.chunks_exact_mut(cols);
        let mut next = || parts.next().unwrap_or_default();
        Self {
            sensitivity: next(),
            inverse: next(),
            change: next(),
            offset: [next(), next(), next()],
        }
    }
}

/// M and O at their closed forms, and what the pixels pull at the beam: c M w (y − c L M − O) in
/// place of y; returns Σ w (y − c L M − O)² over all columns but some.
///
/// ```text
/// [Σ w e²  Σ w e] [M]   [Σ w e y]
/// [Σ w e   Σ w  ] [O] = [Σ w y  ],   e = c L
/// ```
///
/// Without an offset O = 0 and M = Σ w e y / Σ w e². A prior of M is one more measurement of it.
pub(crate) struct Eliminate<'s> {
    pub(crate) row: Row<'s>,
    pub(crate) fluxes: &'s [f64],
    /// c L of each exposure.
    pub(crate) light: &'s [f64],
    pub(crate) weights: &'s [f64],
    /// y, then the pull.
    pub(crate) values: &'s mut Lines,
    /// Σ w e y, Σ w e, Σ w and Σ w y: buffers for four rows.
    pub(crate) sums: &'s mut [Vec<f64>; 4],
    /// What rounding leaves of a determinant.
    pub(crate) singular: f64,
    /// The weights of the prior of M, and its mean; empty without one.
    pub(crate) prior: &'s [f64],
    pub(crate) mean: f64,
    /// Columns that F leaves out.
    pub(crate) few: &'s [usize],
}

impl pulp::NullaryFnOnce for Eliminate<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let Row { sensitivity, inverse, offset: [offset, i12, i22], .. } = self.row;
        let cols = sensitivity.len();
        let with_offset = !offset.is_empty();
        let [along, e, one, alone] = self.sums.each_mut().map(|sums| &mut sums[..cols]);
        for sums in [&mut *inverse, &mut *along, &mut *e, &mut *one, &mut *alone] {
            sums.fill(0.0);
        }
        for k in 0..self.fluxes.len() {
            let (light, weights) = (of(self.light, k, cols), of(self.weights, k, cols));
            let values = self.values.of(k);
            for col in 0..cols {
                let we = weights[col] * light[col];
                inverse[col] += we * light[col];
                along[col] += we * values[col];
            }
            if with_offset {
                for col in 0..cols {
                    e[col] += weights[col] * light[col];
                    one[col] += weights[col];
                    alone[col] += weights[col] * values[col];
                }
            }
        }
        for (col, &weight) in self.prior.iter().enumerate() {
            inverse[col] += weight;
            along[col] += weight * self.mean;
        }
        for col in 0..cols {
            let (ee, ey) = (inverse[col], along[col]);
            inverse[col] = if ee > 0.0 { 1.0 / ee } else { 0.0 };
            sensitivity[col] = if ee > 0.0 { ey / ee } else { 1.0 };
            if with_offset {
                let determinant = ee * one[col] - e[col] * e[col];
                [i12[col], i22[col], offset[col]] = [0.0; 3];
                if determinant > self.singular * ee * one[col] {
                    inverse[col] = one[col] / determinant;
                    i12[col] = -e[col] / determinant;
                    i22[col] = ee / determinant;
                    sensitivity[col] = inverse[col] * ey + i12[col] * alone[col];
                    offset[col] = i12[col] * ey + i22[col] * alone[col];
                }
            }
        }
        let mut objective = 0.0;
        for (k, flux) in self.fluxes.iter().enumerate() {
            let (light, weights) = (of(self.light, k, cols), of(self.weights, k, cols));
            let values = self.values.of_mut(k);
            for col in 0..cols {
                values[col] -= light[col] * sensitivity[col];
            }
            values.iter_mut().zip(&*offset).for_each(|(value, offset)| *value -= offset);
            let squares = &mut along[..];
            for col in 0..cols {
                let pull = weights[col] * values[col];
                squares[col] = pull * values[col];
                values[col] = flux * sensitivity[col] * pull;
            }
            self.few.iter().for_each(|&col| squares[col] = 0.0);
            objective += sum(squares);
        }
        objective
    }
}

#[inline(always)]
fn sum(values: &[f64]) -> f64 {
    let (lanes, rest) = values.as_chunks::<LANES>();
    let mut sums = [0.0; LANES];
    for values in lanes {
        for i in 0..LANES {
            sums[i] += values[i];
        }
    }
    sums.iter().chain(rest).sum()
}

/// What a change of the light pulls at the beam once M and O have followed it: v → c M w (u − α e − β)
/// with u = c M v, and the change −α of M; returns the largest size of that less a share of the change
/// before.
pub(crate) struct Propagate<'s> {
    pub(crate) row: Row<'s>,
    pub(crate) fluxes: &'s [f64],
    /// c L of each exposure.
    pub(crate) light: &'s [f64],
    pub(crate) weights: &'s [f64],
    /// v, then the pull.
    pub(crate) values: &'s mut Lines,
    /// Buffers for rows.
    pub(crate) sums: &'s mut [Vec<f64>; 4],
    /// The share of the change before.
    pub(crate) share: f64,
}

impl pulp::NullaryFnOnce for Propagate<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let Row { sensitivity, inverse, change, offset: [offset, i12, i22] } = self.row;
        let cols = sensitivity.len();
        let with_offset = !offset.is_empty();
        let [along, alone, ..] = self.sums.each_mut().map(|sums| &mut sums[..cols]);
        along.fill(0.0);
        alone.fill(0.0);
        for (k, flux) in self.fluxes.iter().enumerate() {
            let (light, weights) = (of(self.light, k, cols), of(self.weights, k, cols));
            let values = self.values.of_mut(k);
            for col in 0..cols {
                values[col] *= flux * sensitivity[col];
                along[col] += weights[col] * values[col] * light[col];
            }
            if with_offset {
                for col in 0..cols {
                    alone[col] += weights[col] * values[col];
                }
            }
        }
        for col in 0..cols {
            let s = along[col];
            along[col] = inverse[col] * s;
            if with_offset {
                along[col] += i12[col] * alone[col];
                alone[col] = i12[col] * s + i22[col] * alone[col];
            }
        }
        for (k, flux) in self.fluxes.iter().enumerate() {
            let (light, weights) = (of(self.light, k, cols), of(self.weights, k, cols));
            let values = self.values.of_mut(k);
            for col in 0..cols {
                let left = values[col] - along[col] * light[col] - alone[col];
                values[col] = flux * sensitivity[col] * weights[col] * left;
            }
        }
        let mut largest = [0.0_f64; LANES];
        for (change, along) in change.chunks_mut(LANES).zip(along.chunks(LANES)) {
            for ((change, along), largest) in change.iter_mut().zip(along).zip(&mut largest) {
                // A maximum would lose what is no number, a minimum does not.
                let size = (along + self.share * *change).abs().min(f64::INFINITY);
                *largest = largest.max(size);
                *change = -along;
            }
        }
        largest.into_iter().fold(0.0, f64::max)
    }
}

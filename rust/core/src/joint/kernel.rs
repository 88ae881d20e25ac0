//! The arithmetic along one row of pixels, inlined into code for the CPU at hand.

use super::grid::TAPS;

/// One exposure's place in a row: a stretch of `cols` values after those of the exposures before.
#[inline(always)]
fn of(values: &[f64], exposure: usize, cols: usize) -> &[f64] {
    &values[exposure * cols..][..cols]
}

/// A row of pixels as they see the beam: Σ_ij t_i u_j a(i, col + j), from rows of coefficients.
pub(super) struct Interpolate<'s> {
    pub(super) rows: &'s [&'s [f64]],
    pub(super) along_rows: &'s [f64; TAPS],
    pub(super) along_cols: &'s [f64; TAPS],
    /// Room for a row of coefficients.
    pub(super) room: &'s mut [f64],
    pub(super) seen: &'s mut [f64],
}

impl pulp::NullaryFnOnce for Interpolate<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [a, b, c, d] = self.rows else {
            self.seen.copy_from_slice(self.rows[0]);
            return;
        };
        let [s, t, u, v] = *self.along_rows;
        for ((((sum, a), b), c), d) in self.room.iter_mut().zip(*a).zip(*b).zip(*c).zip(*d) {
            *sum = s * a + t * b + u * c + v * d;
        }
        let [s, t, u, v] = *self.along_cols;
        let cols = self.seen.len();
        let [a, b, c, d] = [0, 1, 2, 3].map(|from| &self.room[from..from + cols]);
        for ((((seen, a), b), c), d) in self.seen.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *seen = s * a + t * b + u * c + v * d;
        }
    }
}

/// The adjoint along columns: sums(x) = Σ_j u_j values(x − j), where `values` has zeros around.
pub(super) struct Spread<'s> {
    pub(super) values: &'s [f64],
    pub(super) along_cols: &'s [f64; TAPS],
    pub(super) sums: &'s mut [f64],
}

impl pulp::NullaryFnOnce for Spread<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [s, t, u, v] = *self.along_cols;
        let wide = self.sums.len();
        let [d, c, b, a] = [0, 1, 2, 3].map(|from| &self.values[from..from + wide]);
        for ((((sum, a), b), c), d) in self.sums.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *sum = s * a + t * b + u * c + v * d;
        }
    }
}

/// The adjoint along rows: sums += t · values.
pub(super) struct Add<'s> {
    pub(super) factor: f64,
    pub(super) values: &'s [f64],
    pub(super) sums: &'s mut [f64],
}

impl pulp::NullaryFnOnce for Add<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (sum, value) in self.sums.iter_mut().zip(self.values) {
            *sum += self.factor * value;
        }
    }
}

/// What is kept of a row of pixels from one linearisation on: the light c L that each exposure
/// shows, M, the offset O, the inverse of their normal matrix, and the last change of M.
pub(super) struct Row<'s> {
    pub(super) light: &'s mut [f64],
    pub(super) sensitivity: &'s mut [f64],
    pub(super) offset: &'s mut [f64],
    pub(super) inverse: [&'s mut [f64]; 3],
    pub(super) change: &'s mut [f64],
}

impl<'s> Row<'s> {
    /// Values that a row of `cols` pixels takes.
    pub(super) fn length(exposures: usize, cols: usize) -> usize {
        (exposures + 6) * cols
    }

    pub(super) fn of(values: &'s mut [f64], exposures: usize, cols: usize) -> Self {
        let (light, rest) = values.split_at_mut(exposures * cols);
        let mut parts = rest.chunks_exact_mut(cols);
        let mut next = || parts.next().unwrap_or_default();
        Self {
            light,
            sensitivity: next(),
            offset: next(),
            inverse: [next(), next(), next()],
            change: next(),
        }
    }
}

/// M and O at their closed forms, and what the pixels pull at the beam: c M w (y − c L M − O) in
/// place of y; returns Σ w (y − c L M − O)².
///
/// ```text
/// [Σ w e²  Σ w e] [M]   [Σ w e y]
/// [Σ w e   Σ w  ] [O] = [Σ w y  ],   e = c L
/// ```
///
/// Without an offset O = 0 and M = Σ w e y / Σ w e².
pub(super) struct Solve<'s> {
    pub(super) row: Row<'s>,
    pub(super) fluxes: &'s [f64],
    pub(super) weights: &'s [f64],
    /// y, then the pull.
    pub(super) values: &'s mut [f64],
    pub(super) with_offset: bool,
    /// What rounding leaves of a determinant.
    pub(super) singular: f64,
}

impl pulp::NullaryFnOnce for Solve<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let Row { light, sensitivity, offset, inverse: [i11, i12, i22], .. } = self.row;
        let cols = sensitivity.len();
        for col in 0..cols {
            let [mut ee, mut e, mut one, mut ey, mut y] = [0.0; 5];
            for k in 0..self.fluxes.len() {
                let at = k * cols + col;
                let we = self.weights[at] * light[at];
                ee += we * light[at];
                e += we;
                one += self.weights[at];
                ey += we * self.values[at];
                y += self.weights[at] * self.values[at];
            }
            let determinant = ee * one - e * e;
            let inverse = if self.with_offset && determinant > self.singular * ee * one {
                [one / determinant, -e / determinant, ee / determinant]
            } else if ee > 0.0 {
                [1.0 / ee, 0.0, 0.0]
            } else {
                [0.0; 3]
            };
            [i11[col], i12[col], i22[col]] = inverse;
            sensitivity[col] = if ee > 0.0 { inverse[0] * ey + inverse[1] * y } else { 1.0 };
            offset[col] = inverse[1] * ey + inverse[2] * y;
        }
        let mut objective = 0.0;
        for (k, flux) in self.fluxes.iter().enumerate() {
            let (light, weights) = (of(light, k, cols), of(self.weights, k, cols));
            let values = &mut self.values[k * cols..][..cols];
            for col in 0..cols {
                let residual = values[col] - light[col] * sensitivity[col] - offset[col];
                let pull = weights[col] * residual;
                objective += pull * residual;
                values[col] = flux * sensitivity[col] * pull;
            }
        }
        objective
    }
}

/// What a change of the light pulls at the beam once M and O have followed it: v → c M w (u − α e − β)
/// with u = c M v, and the change −α of M.
pub(super) struct Follow<'s> {
    pub(super) row: Row<'s>,
    pub(super) fluxes: &'s [f64],
    pub(super) weights: &'s [f64],
    /// v, then the pull.
    pub(super) values: &'s mut [f64],
    /// Room for two rows.
    pub(super) sums: [&'s mut [f64]; 2],
}

impl pulp::NullaryFnOnce for Follow<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Row { light, sensitivity, inverse: [i11, i12, i22], change, .. } = self.row;
        let [along_light, alone] = self.sums;
        let cols = sensitivity.len();
        along_light.fill(0.0);
        alone.fill(0.0);
        for (k, flux) in self.fluxes.iter().enumerate() {
            let (light, weights) = (of(light, k, cols), of(self.weights, k, cols));
            let values = &mut self.values[k * cols..][..cols];
            for col in 0..cols {
                values[col] *= flux * sensitivity[col];
                let pull = weights[col] * values[col];
                along_light[col] += pull * light[col];
                alone[col] += pull;
            }
        }
        for col in 0..cols {
            let (s, t) = (along_light[col], alone[col]);
            along_light[col] = i11[col] * s + i12[col] * t;
            alone[col] = i12[col] * s + i22[col] * t;
            change[col] = -along_light[col];
        }
        for (k, flux) in self.fluxes.iter().enumerate() {
            let (light, weights) = (of(light, k, cols), of(self.weights, k, cols));
            let values = &mut self.values[k * cols..][..cols];
            for col in 0..cols {
                let left = values[col] - along_light[col] * light[col] - alone[col];
                values[col] = flux * sensitivity[col] * weights[col] * left;
            }
        }
    }
}

//! The curvature of F along shifts that noise adds to the linear problem alone.
//!
//! The linear problem takes the slopes of the fitted beam for structure, those of its noise included. But
//! with M and the beam at their best, F of noise is on average the same at all shifts. So the linear problem
//! is too stiff along shifts by the mean N of what the slopes of noise contribute, and its steps are too
//! short. S less N is the mean of the second derivative of F. With the symbols s, g and h_k of
//! `freedom.rs`, h = Σ_k ω_k h_k, and the symbol b_k of the slope along an axis that exposure k shows,
//!
//! ```text
//! N_kl = P Σ_q s/(s + τ g)² Re[δ_kl ω_k |b_k|² − ω_k ω_l b̄_k b_l (1 + (h_k − h)(h_l − h)*/(s + τ g))]
//! ```
//!
//! for P pixels: the square of b_k d_k times the noise of a coefficient, less what M and the beam can follow.
//! The noise of the slope of F has the covariance S, N included, so that of shifts is
//! (S − N)⁻¹ S (S − N)⁻¹.

use super::freedom::{Complex, Seen, for_waves, means, product, symbol_of};
use super::layout::Window;
use super::pass::slopes_along;

/// N for noise of variance 1, exposure by exposure along rows and columns.
pub(crate) struct NoiseCurvature {
    matrix: Vec<f64>,
    size: usize,
}

impl NoiseCurvature {
    /// N of exposures with `pixels` measurements each, on average, that weigh `shares` of all.
    pub(crate) fn new(windows: &[Window], shares: &[f64], tau: f64, pixels: f64) -> Self {
        let size = 2 * windows.len();
        let mut matrix = vec![0.0; size * size];
        let mut slopes = vec![[0.0; 2]; size];
        let mut followed = slopes.clone();
        for_waves(windows, shares, tau, |seen| {
            seen.add_slopes(windows, shares, &mut slopes, &mut followed);
            let whole = seen.determined + seen.penalty;
            let noise = seen.determined / (whole * whole);
            for (i, row) in matrix.chunks_exact_mut(size).enumerate() {
                let (share, own, [a, b]) = (shares[i / 2], slopes[i], followed[i]);
                for (j, sum) in row.iter_mut().enumerate() {
                    let both = own[0] * slopes[j][0] + own[1] * slopes[j][1];
                    let alone = if i / 2 == j / 2 { share * both } else { 0.0 };
                    let by_beam = (a * followed[j][0] + b * followed[j][1]) / whole;
                    *sum += noise * (alone - share * shares[j / 2] * both - by_beam);
                }
            }
        });
        matrix.iter_mut().for_each(|value| *value *= pixels * means());
        Self { matrix, size }
    }

    /// N d.
    pub(crate) fn product(&self, moves: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let moves = moves.as_flattened();
        let rows = self.matrix.chunks_exact(self.size);
        let found: Vec<f64> =
            rows.map(|row| row.iter().zip(moves).map(|(n, d)| n * d).sum()).collect();
        found.as_chunks().0.to_vec()
    }

    /// The diagonal, exposure by exposure.
    pub(crate) fn diagonal(&self) -> impl Iterator<Item = f64> {
        self.matrix.iter().step_by(self.size + 1).copied()
    }
}

impl Seen<'_> {
    /// b_k along both axes, and ω_k (h_k − h)* b_k.
    fn add_slopes(
        &self,
        windows: &[Window],
        shares: &[f64],
        slopes: &mut [Complex],
        followed: &mut [Complex],
    ) {
        for (k, (window, share)) in windows.iter().zip(shares).enumerate() {
            let left = [self.factors[k][0] - self.mean[0], self.factors[k][1] - self.mean[1]];
            for axis in 0..2 {
                let [down, along] = slopes_along(window, axis);
                let own = product(
                    symbol_of(&down, window.row, self.q[0]),
                    symbol_of(&along, window.col, self.q[1]),
                );
                slopes[2 * k + axis] = own;
                followed[2 * k + axis] = product([share * left[0], -share * left[1]], own);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Shape;
    use crate::geometry::Rotation;
    use crate::joint::layout::Grid;
    use crate::joint::penalty::SMOOTHING;

    #[test]
    fn it_is_symmetric_and_not_negative_and_a_common_shift_has_none() {
        let shifts = [[0.0, 0.0], [0.3, 5.2], [7.4, 0.5], [2.1, 3.3]];
        let grid = Grid::new(Shape::new(20, 20), &shifts, &[Rotation::None; 4], true).unwrap();
        let noise = NoiseCurvature::new(&grid.windows(&shifts), &[0.25; 4], SMOOTHING, 400.0);
        let scale: f64 = noise.diagonal().sum();
        assert!(scale > 0.0);
        for (i, row) in noise.matrix.chunks_exact(noise.size).enumerate() {
            for (j, value) in row.iter().enumerate() {
                // Sums of 4096 waves.
                assert!((value - noise.matrix[j * noise.size + i]).abs() < 1e-12 * scale);
            }
        }
        for seed in 1..9 {
            let moves: Vec<[f64; 2]> =
                (0..4).map(|k| [0, 1].map(|a| f64::from(seed * (3 * k + a)).sin())).collect();
            let pulls = noise.product(&moves);
            let energy: f64 =
                pulls.as_flattened().iter().zip(moves.as_flattened()).map(|(n, d)| n * d).sum();
            assert!(energy > 0.0);
        }
        // The beam follows a common shift, but for what the penalty holds it back by.
        let pulls = noise.product(&[[1.0, 0.0]; 4]);
        let energy: f64 = pulls.iter().map(|pull| pull[0]).sum();
        assert!(energy >= 0.0 && energy < 0.05 * scale, "{energy} of {scale}");
    }
}

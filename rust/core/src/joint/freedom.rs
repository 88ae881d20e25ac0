//! How many unknowns the measurements determine, where a penalty determines the rest.
//!
//! With the penalty the coefficients of the beam are no whole unknowns each: a pattern of wave vector
//! q counts s/(s + τ g), where S has the symbol s and the fourth differences g (Hastie, Tibshirani,
//! Friedman, The Elements of Statistical Learning, section 5.4.1):
//!
//! ```text
//! s(q) = Σ_k ω_k |h_k|² − |Σ_k ω_k h_k e^{iq·d_k}|²,   Σ_k ω_k = 1
//! g(q) = (2 sin q_r/2)⁸ + (2 sin q_c/2)⁸
//! ```
//!
//! h_k being what the factors of exposure k leave of it.

use std::f64::consts::TAU;

use super::layout::Window;
use super::penalty::bent;
use crate::coarse::{Complex, times};
use crate::geometry::TAPS;

/// Wave vectors along each axis.
const WAVES: usize = 64;

/// The mean of s/(s + τ g) over wave vectors, for exposures that weigh `shares` of all.
pub(crate) fn determined_share(windows: &[Window], shares: &[f64], tau: f64) -> f64 {
    wave_means(windows, shares, tau, 1, |wave, sums| {
        sums[0] += wave.measured / (wave.measured + wave.penalty);
    })[0]
}

/// A wave of the beam.
pub(super) struct Wave {
    /// q.
    pub(super) vector: [f64; 2],
    /// h_k e^{iq·d_k}, and their mean by ω.
    pub(super) factors: Vec<Complex>,
    pub(super) mean: Complex,
    /// s.
    pub(super) measured: f64,
    /// τ g.
    pub(super) penalty: f64,
}

/// The means over waves of so many quantities that `add` adds to sums.
pub(super) fn wave_means(
    windows: &[Window],
    shares: &[f64],
    tau: f64,
    count: usize,
    mut add: impl FnMut(&Wave, &mut [f64]),
) -> Vec<f64> {
    // Not at q = 0 itself, where both symbols are 0.
    let vector = |i: usize| TAU * (i as f64 + 0.5) / WAVES as f64;
    let along = |symbol: fn(&Window, f64) -> Complex| -> Vec<Vec<Complex>> {
        (0..WAVES).map(|i| windows.iter().map(|w| symbol(w, vector(i))).collect()).collect()
    };
    let down = along(|window, q| symbol(&window.along_rows.values, window.row, q));
    let right = along(|window, q| symbol(&window.along_cols.values, window.col, q));
    let mut sums = vec![0.0; count];
    for wave in 0..WAVES * WAVES {
        let [row, col] = [wave / WAVES, wave % WAVES];
        let q = [row, col].map(vector);
        let factors: Vec<Complex> =
            down[row].iter().zip(&right[col]).map(|(down, right)| times(*down, *right)).collect();
        let mut seen = 0.0;
        let mut mean = [0.0; 2];
        for (h, share) in factors.iter().zip(shares) {
            seen += share * (h[0] * h[0] + h[1] * h[1]);
            mean = [mean[0] + share * h[0], mean[1] + share * h[1]];
        }
        let measured = (seen - mean[0] * mean[0] - mean[1] * mean[1]).max(0.0);
        let penalty = tau * (bent(q[0]) + bent(q[1]));
        add(&Wave { vector: q, factors, mean, measured, penalty }, &mut sums);
    }
    sums.iter_mut().for_each(|sum| *sum /= (WAVES * WAVES) as f64);
    sums
}

/// What an exposure with these taps along rows and columns makes of a wave.
pub(super) fn factor(window: &Window, [rows, cols]: [[f64; TAPS]; 2], q: [f64; 2]) -> Complex {
    times(symbol(&rows, window.row, q[0]), symbol(&cols, window.col, q[1]))
}

/// Σ_j t_j e^{iq(first + j)}, real and imaginary part.
pub(super) fn symbol(taps: &[f64; TAPS], first: usize, q: f64) -> Complex {
    let terms = taps.iter().enumerate().map(|(j, t)| {
        let (sin, cos) = (q * (first + j) as f64).sin_cos();
        [t * cos, t * sin]
    });
    terms.fold([0.0; 2], |sum, term| [sum[0] + term[0], sum[1] + term[1]])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Shape;
    use crate::geometry::Rotation;
    use crate::joint::layout::Grid;

    #[test]
    fn without_a_penalty_all_is_determined_and_with_a_stiff_one_nothing() {
        let shifts = [[0.0, 0.0], [0.3, 5.2], [7.4, 0.5]];
        let grid = Grid::new(Shape::new(20, 20), &shifts, &[Rotation::None; 3], false).unwrap();
        let windows = grid.windows(&shifts);
        let shares = [1.0 / 3.0; 3];
        assert!((determined_share(&windows, &shares, 0.0) - 1.0).abs() < 1e-12);
        assert!(determined_share(&windows, &shares, 1e12) < 1e-3);
        assert!(determined_share(&windows, &shares, 1e-5) > 0.9);
    }
}

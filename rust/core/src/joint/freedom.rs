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
use crate::geometry::Taps;

/// Wave vectors along each axis.
const WAVES: usize = 64;

/// The mean of s/(s + τ g) over wave vectors, for exposures that weigh `shares` of all.
pub(crate) fn determined_share(windows: &[Window], shares: &[f64], tau: f64) -> f64 {
    let share = |_, measured: f64, penalty: f64| [measured / (measured + penalty)];
    wave_means(windows, shares, tau, share)[0]
}

/// The means of quantities (q, s, τ g) over wave vectors q.
pub(crate) fn wave_means<const N: usize>(
    windows: &[Window],
    shares: &[f64],
    tau: f64,
    quantities: impl Fn([f64; 2], f64, f64) -> [f64; N],
) -> [f64; N] {
    let mut sums = [0.0; N];
    for wave in 0..WAVES * WAVES {
        // Not at q = 0 itself, where both symbols are 0.
        let q = [wave / WAVES, wave % WAVES].map(|i| TAU * (i as f64 + 0.5) / WAVES as f64);
        let mut seen = 0.0;
        let mut along = [0.0; 2];
        for (window, share) in windows.iter().zip(shares) {
            let ([a, b], [c, d]) = (
                symbol(&window.along_rows, window.row, q[0]),
                symbol(&window.along_cols, window.col, q[1]),
            );
            let h = [a * c - b * d, a * d + b * c];
            seen += share * (h[0] * h[0] + h[1] * h[1]);
            along = [along[0] + share * h[0], along[1] + share * h[1]];
        }
        let measured = (seen - along[0] * along[0] - along[1] * along[1]).max(0.0);
        let found = quantities(q, measured, tau * (bent(q[0]) + bent(q[1])));
        sums.iter_mut().zip(found).for_each(|(sum, value)| *sum += value);
    }
    sums.map(|sum| sum / (WAVES * WAVES) as f64)
}

/// Σ_j t_j e^{iq(first + j)}, real and imaginary part.
pub(super) fn symbol(taps: &Taps, first: usize, q: f64) -> [f64; 2] {
    let terms = taps.values.iter().enumerate().map(|(j, t)| {
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

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
    for_waves(windows, shares, tau, |seen| {
        let found = quantities(seen.q, seen.determined, seen.penalty);
        sums.iter_mut().zip(found).for_each(|(sum, value)| *sum += value);
    });
    sums.map(|sum| sum * means())
}

/// Real and imaginary part.
pub(super) type Complex = [f64; 2];

/// A wave as the exposures see it.
pub(super) struct Seen<'w> {
    pub(super) q: [f64; 2],
    /// h_k, and Σ_k ω_k h_k.
    pub(super) factors: &'w [Complex],
    pub(super) mean: Complex,
    /// s and τ g.
    pub(super) determined: f64,
    pub(super) penalty: f64,
}

/// Calls `visit` for each of some wave vectors; [`means`] times a sum over them is the mean.
pub(super) fn for_waves(
    windows: &[Window],
    shares: &[f64],
    tau: f64,
    mut visit: impl FnMut(&Seen<'_>),
) {
    let mut factors = vec![[0.0; 2]; windows.len()];
    for wave in 0..WAVES * WAVES {
        // Not at q = 0 itself, where both symbols are 0.
        let q = [wave / WAVES, wave % WAVES].map(|i| TAU * (i as f64 + 0.5) / WAVES as f64);
        let (mut seen, mut mean) = (0.0, [0.0; 2]);
        for ((h, window), share) in factors.iter_mut().zip(windows).zip(shares) {
            *h = product(
                symbol(&window.along_rows, window.row, q[0]),
                symbol(&window.along_cols, window.col, q[1]),
            );
            seen += share * (h[0] * h[0] + h[1] * h[1]);
            mean = [mean[0] + share * h[0], mean[1] + share * h[1]];
        }
        let determined = (seen - mean[0] * mean[0] - mean[1] * mean[1]).max(0.0);
        let penalty = tau * (bent(q[0]) + bent(q[1]));
        visit(&Seen { q, factors: &factors, mean, determined, penalty });
    }
}

/// One by how many waves there are.
pub(super) const fn means() -> f64 {
    1.0 / (WAVES * WAVES) as f64
}

pub(super) fn product([a, b]: Complex, [c, d]: Complex) -> Complex {
    [a * c - b * d, a * d + b * c]
}

/// Σ_j t_j e^{iq(first + j)}, real and imaginary part.
pub(super) fn symbol(taps: &Taps, first: usize, q: f64) -> Complex {
    symbol_of(&taps.values, first, q)
}

/// The symbol of factors that need not be values of a spline.
pub(super) fn symbol_of(factors: &[f64], first: usize, q: f64) -> Complex {
    let terms = factors.iter().enumerate().map(|(j, t)| {
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

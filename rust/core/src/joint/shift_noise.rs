//! What the noise of the fitted beam adds to S along shifts.
//!
//! Measurements y = A(d) a + ε are fitted with the beam a + n. With the derivative A′ along a shift and the
//! projection P on what the beam and M can follow, F is
//!
//! ```text
//! F(d) = yᵀ w (1 − P) y,   mean F(d) = (A a)ᵀ w (1 − P) A a + constant
//! ```
//!
//! since P has one rank at all d. So F bends by the information I of the true beam. S has more,
//!
//! ```text
//! S = I + N,   N = mean (A′ n)ᵀ w (1 − P) A′ n
//! ```
//!
//! That is the variance of the slope of F, −F′/2 = (A′(a + n))ᵀ w (1 − P) ε, since n = A⁺ε and (1 − P) ε are
//! independent. So errors have the covariance
//!
//! ```text
//! (S − N)⁻¹ S (S − N)⁻¹
//! ```
//!
//! With the symbols of S (`freedom.rs`), and h′ those of slopes, N between exposures k and l is the mean over
//! waves of
//!
//! ```text
//! s/(s + τ g)² [δ_kl ω_k h′_k* h′_l − ω_k ω_l h′_k* h′_l (1 + (h_k − h̄)(h_l − h̄)*/(s + τ g))]
//! ```
//!
//! The last two terms are what M and the beam follow. It is as if all exposures saw each cell, no pixel had an
//! offset and no exposure were turned.

use super::freedom::{factor, wave_means};
use super::layout::Window;
use super::pass::slopes_along;
use super::penalty::SMOOTHING;
use super::system::System;
use crate::coarse::{Complex, times};
use crate::frames::Real;
use crate::parallel::dot;

impl<T: Real> System<'_, '_, T> {
    /// Leaves N out of products from now on, if shifts are sought.
    pub(crate) fn leave_noise_out(&mut self) {
        if !self.seeks_shifts() {
            return;
        }
        let windows = self.pass.grid.windows(&self.state.shifts);
        let exposures = self.pass.exposures;
        let pixels = self.used() as f64 / exposures.count() as f64;
        let shares = exposures.shares(&self.pass.flux);
        self.shift_noise = curvature(&windows, &shares, SMOOTHING);
        self.shift_noise.iter_mut().for_each(|noise| *noise *= self.unit * pixels);
    }

    /// N d.
    pub(super) fn feigned_pulls(&self, moves: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let moves = moves.as_flattened();
        let rows = self.shift_noise.chunks_exact(moves.len());
        let pulls: Vec<f64> = rows.map(|row| dot(row, moves)).collect();
        pulls.as_chunks().0.to_vec()
    }

    /// xᵀ N x: what xᵀ S x is above what products give.
    pub(crate) fn left_out(&self, x: &[f64]) -> f64 {
        if self.shift_noise.is_empty() {
            return 0.0;
        }
        let shifts = &x[self.state.beam.len() + self.fluxes.columns.len()..];
        let moves = self.centred(shifts);
        dot(moves.as_flattened(), self.feigned_pulls(&moves).as_flattened())
    }
}

/// N of noise of variance 1, by rows, for one pixel.
fn curvature(windows: &[Window], shares: &[f64], tau: f64) -> Vec<f64> {
    let size = 2 * windows.len();
    wave_means(windows, shares, tau, size * size, |wave, sums| {
        let determined = wave.measured + wave.penalty;
        let noise = wave.measured / determined.powi(2);
        let slope = |i: usize| {
            let window = &windows[i / 2];
            factor(window, slopes_along(window, i % 2), wave.vector)
        };
        let slopes: Vec<Complex> = (0..size).map(slope).collect();
        let of_m = |i: usize| slopes[i].map(|part| shares[i / 2] * part);
        let of_beam = |i: usize| {
            let ([re, im], h) = (of_m(i), wave.factors[i / 2]);
            times([re, -im], [h[0] - wave.mean[0], h[1] - wave.mean[1]])
        };
        let followed: Vec<[Complex; 2]> = (0..size).map(|i| [of_m(i), of_beam(i)]).collect();
        for (i, sums) in sums.chunks_exact_mut(size).enumerate() {
            for (j, sum) in sums.iter_mut().enumerate() {
                let own = if i / 2 == j / 2 { real(followed[i][0], slopes[j]) } else { 0.0 };
                let [by_m, by_beam] = [0, 1].map(|part| real(followed[i][part], followed[j][part]));
                *sum += noise * (own - by_m - by_beam / determined);
            }
        }
    })
}

/// The real part of x* y.
fn real([a, b]: Complex, [c, d]: Complex) -> f64 {
    a * c + b * d
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;
    use crate::frames::Shape;
    use crate::geometry::Rotation;
    use crate::joint::layout::Grid;

    fn of(shifts: &[[f64; 2]]) -> Vec<f64> {
        let rotations = vec![Rotation::None; shifts.len()];
        let grid = Grid::new(Shape::new(20, 20), shifts, &rotations, true).unwrap();
        let shares = vec![1.0 / shifts.len() as f64; shifts.len()];
        curvature(&grid.windows(shifts), &shares, 0.0)
    }

    #[test]
    fn two_exposures_are_followed_and_so_is_a_shift_common_to_all() {
        // With an odd r + c of one shift no wave of the grid has s = 0: s/|h|² is at least sin²(π/128). Rounding
        // leaves ε/s² of it, times squares of slopes over values below 100.
        let rounding = 100.0 * f64::EPSILON / (PI / 128.0).sin().powi(4);
        assert!(of(&[[0.0, 0.0], [3.0, 4.0]]).iter().all(|noise| noise.abs() < rounding));
        let noise = of(&[[0.0, 0.0], [0.0, 5.0], [7.0, 1.0], [3.0, 2.0]]);
        for (row, noise) in noise.chunks_exact(8).enumerate() {
            assert!(noise[row] > 0.1);
            for axis in 0..2 {
                let common: f64 = noise.iter().skip(axis).step_by(2).sum();
                assert!(common.abs() < rounding, "{common:e}");
            }
        }
    }
}

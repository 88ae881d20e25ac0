//! Along which directions the measurements determine the shifts.
//!
//! A shift that is wrong by δ changes what an exposure shows by w c M δ·∇L. The slopes of L consist of
//! those of the beam and of noise. The linear problem takes both for structure. But shifts that follow
//! the slopes of noise lead nowhere: at the true F they gain nothing, and steps, which expect a gain,
//! are too short by the ratio of both. So the information of the beam is estimated without that of noise:
//!
//! ```text
//! I = Σ_u W (Δr L)(Δr L)ᵀ/6 − (its mean for noise alone),   r = ∇a/a,   Δr = r(u) − 2 r(u + s) + r(u + 2s)
//! ```
//!
//! W is the weight of a cell. Second differences of r over a distance s leave out what is linear in u:
//! where ln L is quadratic, as in a Gaussian beam, shifts are degenerate with a bend of M. The largest I of
//! some distances counts. The mean for noise follows from the symbols of S (`freedom.rs`).

use super::freedom::wave_means;
use super::penalty::SMOOTHING;
use super::system::System;
use super::unknowns::ShiftPrior;
use crate::frames::{Real, Shape};

/// Distances of second differences, in cells.
const DISTANCES: [usize; 5] = [8, 16, 32, 64, 128];
/// Binomial factors of standard deviation 1, along a slope: their symbol is cos⁴(q/2).
const SMOOTH: [f64; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];
/// Cells beside one that its smoothed slope takes.
const REACH: usize = 3;
/// The structure is at least so many times what noise adds to the curvature along shifts, or steps are too
/// short. What error bars subtract of S (`shift_noise.rs`) is less than that, so the rest is positive.
const OVER_NOISE: f64 = 20.0;

/// The directions in the beam along which shifts are refined.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Directions {
    None,
    /// One, of length 1.
    One([f64; 2]),
    Both,
}

impl<T: Real> System<'_, '_, T> {
    /// The directions along which the measurements determine shifts better than their prior does.
    pub(crate) fn determined_directions(&self, prior: &ShiftPrior) -> Directions {
        if !self.pass.grid.is_spline() {
            return Directions::None;
        }
        let count = self.pass.exposures.count() as f64;
        let [noise, smoothed] = self.slope_noise();
        let information = self.information_of_shifts(smoothed);
        let known = [0, 1].map(|axis| {
            // Of the shift known least: that of a reference is often exact.
            let least = prior.precisions.iter().map(|p| p[axis]).fold(f64::INFINITY, f64::min);
            (self.unit * count * least).max(OVER_NOISE * self.unit * noise[axis])
        });
        // In units of what is to be exceeded.
        let scale = known.map(f64::sqrt);
        let [rr, rc, cc] = information;
        let matrix = [rr / scale[0].powi(2), rc / scale[0] / scale[1], cc / scale[1].powi(2)];
        directions(matrix, scale)
    }

    /// The information that noise of variance 1 feigns along rows and columns, all exposures together, by
    /// raw slopes and by smoothed ones.
    fn slope_noise(&self) -> [[f64; 2]; 2] {
        let shares = self.pass.exposures.shares(&self.pass.flux);
        let windows = self.pass.grid.windows(&self.state.shifts);
        let seen = self.weights.iter().filter(|&&weight| weight > 0.0).count() as f64;
        let slope = |q: f64| q.sin().powi(2);
        let smooth = |q: f64| (0.5 * q).cos().powi(8);
        let means = wave_means(&windows, &shares, SMOOTHING, 4, |wave, sums| {
            let noise = wave.measured / (wave.measured + wave.penalty).powi(2);
            for (axis, &q) in wave.vector.iter().enumerate() {
                sums[axis] += slope(q) * noise;
                sums[2 + axis] += slope(q) * smooth(q) * noise;
            }
        });
        [[seen * means[0], seen * means[1]], [seen * means[2], seen * means[3]]]
    }

    /// I, its elements by rows, mixed and by columns.
    fn information_of_shifts(&self, noise: [f64; 2]) -> [f64; 3] {
        let Shape { rows, cols } = self.pass.grid.geometry.beam;
        let slopes = self.relative_slopes();
        let seen = self.weights.iter().filter(|&&weight| weight > 0.0).count() as f64;
        let mut largest = [0.0; 3];
        for distance in DISTANCES {
            let mut found = [0.0; 3];
            // Along a row that is shorter nothing lies so far apart.
            let along_row = (distance < cols).then_some(distance);
            for step in along_row.into_iter().chain([distance * cols]) {
                let [sums, cells] = self.second_differences(&slopes, step, [rows, cols]);
                if cells[0] == 0.0 {
                    continue;
                }
                // As if all cells had been compared, without the part of noise.
                let share = seen / cells[0];
                let own = [sums[0] * share - self.unit * noise[0], sums[1] * share];
                let last = sums[2] * share - self.unit * noise[1];
                found = [found[0] + own[0].max(0.0), found[1] + own[1], found[2] + last.max(0.0)];
            }
            if found[0] + found[2] > largest[0] + largest[2] {
                largest = found;
            }
        }
        largest
    }

    /// Σ W (Δr a)(Δr a)ᵀ/6 over places `step` apart, and how many cells that took.
    fn second_differences(
        &self,
        slopes: &[Vec<f32>; 2],
        step: usize,
        [rows, cols]: [usize; 2],
    ) -> [[f64; 3]; 2] {
        let beam = &self.state.beam;
        let parts = self.pass.workers.map(rows, |row| {
            let (mut sums, mut cells) = ([0.0; 3], 0.0);
            let along_cols = step < cols;
            let last = if along_cols { cols.saturating_sub(2 * step) } else { cols };
            if !along_cols && row * cols + 2 * step >= beam.len() {
                return [sums, [0.0; 3]];
            }
            for cell in row * cols..row * cols + last {
                let places = [cell, cell + step, cell + 2 * step];
                let [r, c] = slopes.each_ref().map(|slopes| {
                    let [first, middle, last] = places.map(|place| f64::from(slopes[place]));
                    first - 2.0 * middle + last
                });
                if r.is_finite() && c.is_finite() {
                    let middle = cell + step;
                    let weight = self.ordinary[1] * f64::from(self.weights[middle]);
                    let weight = weight * beam[middle].powi(2) / 6.0;
                    sums = [
                        sums[0] + weight * r * r,
                        sums[1] + weight * r * c,
                        sums[2] + weight * c * c,
                    ];
                    cells += 1.0;
                }
            }
            [sums, [cells, 0.0, 0.0]]
        });
        parts.into_iter().fold([[0.0; 3]; 2], |total, part| {
            [0, 1].map(|i| [0, 1, 2].map(|j| total[i][j] + part[i][j]))
        })
    }

    /// The smoothed slopes of ln a along rows and columns, NaN where they are not known.
    fn relative_slopes(&self) -> [Vec<f32>; 2] {
        let Shape { rows, cols } = self.pass.grid.geometry.beam;
        let beam = &self.state.beam;
        let seen = |cell: usize| self.weights[cell] > 0.0 && beam[cell] > 0.0;
        [(cols, rows), (1, cols)].map(|(step, length)| {
            let mut found = vec![f32::NAN; beam.len()];
            self.pass.workers.map_blocks(&mut found, cols, |row, found| {
                for (col, found) in found.iter_mut().enumerate() {
                    let place = if step == 1 { col } else { row };
                    let cell = row * cols + col;
                    let inside = place >= REACH && place + REACH < length;
                    if inside
                        && seen(cell - REACH * step)
                        && seen(cell)
                        && seen(cell + REACH * step)
                    {
                        let terms = SMOOTH.iter().enumerate().map(|(i, factor)| {
                            let at = cell + i * step - 2 * step;
                            factor * 0.5 * (beam[at + step] - beam[at - step])
                        });
                        *found = (terms.sum::<f64>() / beam[cell]) as f32;
                    }
                }
            });
            found
        })
    }
}

/// The directions of a symmetric matrix, in units by axis, whose values exceed 1.
fn directions([rr, rc, cc]: [f64; 3], scale: [f64; 2]) -> Directions {
    let (middle, half) = (0.5 * (rr + cc), 0.5 * (rr - cc));
    let spread = half.hypot(rc);
    if middle - spread > 1.0 {
        return Directions::Both;
    }
    // A number that is none determines nothing.
    let is_one = middle + spread > 1.0;
    if !is_one {
        return Directions::None;
    }
    let angle = 0.5 * rc.atan2(half);
    let direction = [scale[0] * angle.cos(), scale[1] * angle.sin()];
    let length = direction[0].hypot(direction[1]);
    Directions::One(direction.map(|part| part / length))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_axis_counts_for_itself_and_fringes_across_their_direction() {
        assert!(directions([2.0, 0.0, 3.0], [1.0; 2]) == Directions::Both);
        assert!(directions([0.5, 0.1, 0.9], [1.0; 2]) == Directions::None);
        assert!(directions([f64::NAN, 0.0, 3.0], [1.0; 2]) == Directions::None);
        // Fringes of equal slope down and along: only their sum is determined.
        let Directions::One([r, c]) = directions([50.0, 50.0, 50.0], [1.0; 2]) else { panic!() };
        // Roots of sums of a few products.
        assert!((r - 0.5_f64.sqrt()).abs() < 1e-14 && (c - r).abs() < 1e-14);
        let Directions::One([r, c]) = directions([0.1, 0.0, 9.0], [5.0, 0.2]) else { panic!() };
        assert!(r.abs() < 1e-14 && (c - 1.0).abs() < 1e-14);
    }
}

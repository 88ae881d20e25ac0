//! The columns Φ of the second level: hats on a coarse grid, times the beam.
//!
//! A spline of coefficients h a is not h times the spline of coefficients a: with the factors 1/6, 4/6,
//! 1/6 of B it has ∇h·∇a/3 more, to first order. The columns have that much less, so that a tilt of
//! the beam is one.

use super::system::System;
use crate::coarse::Hats;
use crate::control::Control;
use crate::frames::Real;
use crate::parallel::{Value, Workers};

/// Rows of cells whose sums over hats a thread makes at a time.
const SUMMED: usize = 32;

pub(crate) struct Wide {
    pub(crate) hats: Hats,
    cols: usize,
    /// a in units of an ordinary light and single precision; 0 for cells that are not seen.
    pub(super) beam: Vec<f32>,
    is_spline: bool,
}

impl Wide {
    pub(crate) fn new<T: Real>(hats: Hats, system: &System<'_, '_, T>, control: &Control) -> Self {
        let (beam, cols) = (&system.state.beam, system.pass.grid.geometry.beam.cols);
        let seen = |cell: usize| system.weights.get(cell).is_some_and(|&weight| weight > 0.0);
        let [light, _] = system.ordinary;
        let mut levels = system.pass.workers.filled(beam.len(), 0.0, control);
        system.pass.workers.map_blocks(&mut levels, cols, |row, levels| {
            for (level, cell) in levels.iter_mut().zip(row * cols..) {
                *level = if seen(cell) { (beam[cell] / light) as f32 } else { 0.0 };
            }
        });
        Self { hats, cols, beam: levels, is_spline: system.pass.grid.is_spline() }
    }

    /// a of a row of cells.
    fn row(&self, row: usize) -> &[f32] {
        &self.beam[row * self.cols..][..self.cols]
    }

    /// Finds ∂a/3 down and along a row of cells of a spline, 0 beside cells that are not seen.
    fn find_slopes(&self, row: usize, slopes: &mut [Vec<f32>; 2]) {
        let last = self.beam.len() / self.cols - 1;
        if !self.is_spline {
            return;
        }
        // Beyond the first row and the last one nothing is seen.
        let rows = [row.checked_sub(1), Some(row), (row < last).then_some(row + 1)];
        let none = &vec![0.0; if row == 0 || row == last { self.cols } else { 0 }];
        let rows = rows.map(|row| row.map_or(&none[..], |row| self.row(row)));
        pulp::Arch::new().dispatch(Slopes { rows, slopes });
    }

    /// Φᵀ r.
    pub(crate) fn gather<N: Value>(&self, r: &[N], workers: &Workers) -> Vec<f64> {
        let (hats, cols) = (&self.hats, self.cols);
        let rows = self.beam.len() / cols;
        let bands = workers.map(rows.div_ceil(SUMMED), |band| {
            let mut found: Vec<(usize, Vec<f64>)> = Vec::new();
            let mut sums = [(); 5].map(|()| vec![N::default(); cols]);
            let mut slopes = [(); 2].map(|()| vec![0.0; cols]);
            let band = band * SUMMED..rows.min((band + 1) * SUMMED);
            for row in band.clone() {
                let (node, height) = hats.rows.at(row as f64);
                self.find_slopes(row, &mut slopes);
                pulp::Arch::new().dispatch(Level {
                    values: &r[row * cols..][..cols],
                    beam: self.row(row),
                    slopes: slopes.each_ref().map(|slopes| &slopes[..]),
                    height: N::of(height),
                    sums: sums.each_mut().map(|sums| &mut sums[..]),
                });
                let is_last = row + 1 == band.end;
                if is_last || hats.rows.at((row + 1) as f64).0 != node {
                    found.extend(self.close(node, &sums));
                    sums.iter_mut().for_each(|sums| sums.fill(N::default()));
                }
            }
            found
        });
        let mut heights = vec![0.0; hats.count()];
        for (first, sums) in bands.into_iter().flatten() {
            heights[first..].iter_mut().zip(sums).for_each(|(height, sum)| *height += sum);
        }
        heights
    }

    /// Sums along the coarse rows above and below, each with its first hat.
    fn close<N: Value>(&self, node: usize, sums: &[Vec<N>; 5]) -> [(usize, Vec<f64>); 2] {
        let (nodes, spacing) = (self.hats.cols.nodes, self.hats.cols.spacing);
        let [levels, turns, fall] = [&sums[..2], &sums[2..4], &sums[4..]];
        [0, 1].map(|below| {
            let mut found = vec![0.0; nodes];
            let sign = [1.0, -1.0][below] / self.hats.rows.spacing;
            for (col, &(node, share)) in self.hats.columns.iter().enumerate() {
                let (node, share) = (node as usize, f64::from(share));
                let value = levels[below][col].into() + sign * fall[0][col].into();
                let moved = share * value - turns[below][col].into() / spacing;
                found[node] += value - moved;
                found[node + 1] += moved;
            }
            ((node + below) * nodes, found)
        })
    }

    /// Adds Φ y to rows of cells from `first` on.
    pub(crate) fn spread<N: Value>(&self, heights: &[f64], first: usize, z: &mut [N]) {
        let cols = self.cols;
        let mut last = usize::MAX;
        let mut lines = [(); 4].map(|()| vec![N::default(); cols]);
        let mut slopes = [(); 2].map(|()| vec![0.0; cols]);
        for (row, z) in z.chunks_exact_mut(cols).enumerate() {
            let row = first + row;
            let (node, height) = self.hats.rows.at(row as f64);
            if node != last {
                self.open(node, heights, &mut lines);
                last = node;
            }
            self.find_slopes(row, &mut slopes);
            pulp::Arch::new().dispatch(Smooth {
                z,
                beam: self.row(row),
                slopes: slopes.each_ref().map(|slopes| &slopes[..]),
                height: N::of(height),
                slope: N::of(1.0 / self.hats.rows.spacing),
                lines: lines.each_ref().map(|line| &line[..]),
            });
        }
    }

    /// The heights along the coarse rows above and below at every column, and their slopes.
    fn open<N: Value>(&self, node: usize, heights: &[f64], lines: &mut [Vec<N>; 4]) {
        let (nodes, spacing) = (self.hats.cols.nodes, self.hats.cols.spacing);
        for below in 0..2 {
            let heights = &heights[(node + below) * nodes..][..nodes];
            for (col, &(node, share)) in self.hats.columns.iter().enumerate() {
                let (left, right) = (heights[node as usize], heights[node as usize + 1]);
                lines[below][col] = N::of(left + f64::from(share) * (right - left));
                lines[2 + below][col] = N::of((right - left) / spacing);
            }
        }
    }
}

/// A third of the slopes down and along the row in the middle of three, 0 beside a 0.
struct Slopes<'s> {
    rows: [&'s [f32]; 3],
    slopes: &'s mut [Vec<f32>; 2],
}

impl pulp::NullaryFnOnce for Slopes<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [down, along] = self.slopes;
        let [above, own, below] = self.rows;
        let third = |before: f32, own: f32, after: f32| {
            let is_seen = (before != 0.0) & (own != 0.0) & (after != 0.0);
            if is_seen { (after - before) * (1.0 / 6.0) } else { 0.0 }
        };
        for (down, ((above, own), below)) in down.iter_mut().zip(above.iter().zip(own).zip(below)) {
            *down = third(*above, *own, *below);
        }
        let [Some(before), Some(middle), Some(after)] = [0, 1, 2].map(|from| own.get(from..))
        else {
            return;
        };
        let inner = along.iter_mut().skip(1).zip(before.iter().zip(middle).zip(after));
        for (along, ((before, own), after)) in inner {
            *along = third(*before, *own, *after);
        }
    }
}

/// Sums of r a down a coarse cell, by the heights of the hats above and below, of r ∂a/3 along rows
/// likewise, and of r ∂a/3 down, which a falling hat has less.
struct Level<'s, N> {
    values: &'s [N],
    beam: &'s [f32],
    slopes: [&'s [f32]; 2],
    height: N,
    sums: [&'s mut [N]; 5],
}

impl<N: Value> pulp::NullaryFnOnce for Level<'_, N> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [above, below, above_turn, below_turn, fall] = self.sums;
        let [down, along] = self.slopes;
        let rest = N::of(1.0) - self.height;
        for col in 0..self.values.len() {
            let r = self.values[col];
            let of = |values: &[f32]| N::of(f64::from(values[col]));
            let (level, turn) = (r * of(self.beam), r * of(along));
            above[col] += rest * level;
            below[col] += self.height * level;
            above_turn[col] += rest * turn;
            below_turn[col] += self.height * turn;
            fall[col] += r * of(down);
        }
    }
}

/// Adds smooth heights h times the spline: h a − ∇h·∇a/3.
struct Smooth<'s, N> {
    z: &'s mut [N],
    beam: &'s [f32],
    slopes: [&'s [f32]; 2],
    /// The height of the hat below, and its slope.
    height: N,
    slope: N,
    /// h above and below, and its slopes along.
    lines: [&'s [N]; 4],
}

impl<N: Value> pulp::NullaryFnOnce for Smooth<'_, N> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [above, below, above_slope, below_slope] = self.lines;
        let [down, along] = self.slopes;
        for col in 0..self.z.len() {
            let fall = below[col] - above[col];
            let height = above[col] + self.height * fall;
            let slope = above_slope[col] + self.height * (below_slope[col] - above_slope[col]);
            let [a, along, down] =
                [self.beam[col], along[col], down[col]].map(|value| N::of(f64::from(value)));
            self.z[col] += a * height - along * slope - down * (fall * self.slope);
        }
    }
}

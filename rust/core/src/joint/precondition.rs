//! The preconditioner of the joint problem: its diagonal, and hats on a coarse grid over the beam.
//!
//! As in [`precondition`](crate::precondition), with the columns of Φ hats times the beam. Fluxes
//! and shifts stand beside the hats in the coarse problem: a tilt or a bend of M that they could explain
//! is told from theirs by large scales alone.
//!
//! A spline of coefficients h a is not h times the spline of coefficients a: with the factors 1/6, 4/6,
//! 1/6 of B it has ∇h·∇a/3 more, to first order. The columns of Φ have that much less, so that a tilt
//! of the beam is one.

use super::system::{Block, System};
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::parallel::Workers;
use crate::precondition::coarse::{Arm, Coarse};
use crate::precondition::hats::Hats;
use crate::precondition::{DAMPING, spacing};

/// Blocks of pixels along the distance of two hats.
const BLOCKS: usize = 3;
/// Rows of cells whose sums over hats a thread makes at a time.
const SUMMED: usize = 32;
/// Cells with less than this share of the mean diagonal are as good as unseen.
const FAINTEST: f64 = 1e-12;
pub(super) struct Preconditioner {
    hats: Hats,
    /// 1/D of cells, θ and shifts; 0 for what no measurement tells.
    inverse: Vec<f64>,
    coarse: Coarse,
    /// a, and ∂a/3 along rows and columns where the beam is a spline.
    beam: Vec<f64>,
    slopes: [Vec<f64>; 2],
}

impl Preconditioner {
    pub(super) fn new<T: Real>(system: &mut System<'_, '_, T>, control: &Control) -> Result<Self> {
        let geometry = &system.model.geometry;
        let spacing = spacing(geometry);
        let (beam, origin) = (system.grid.geometry.beam, system.grid.geometry.origin);
        let hats = Hats::new(beam, spacing);
        let size = spacing.map(|spacing| (spacing / BLOCKS).max(1));
        let blocks = system.blocks(size, control)?;
        let (sensor, count) = (system.model.sensor(), system.model.count());
        let params = system.fluxes.columns.len();
        let across = sensor.cols.div_ceil(size[1]);
        let arm = |index: usize, k: usize, block: &Block| {
            let corner = [index / across * size[0], index % across * size[1]];
            let centre = |axis: usize, side: usize| {
                let end = (corner[axis] + size[axis]).min(side) - 1;
                (corner[axis] + end) as f64 / 2.0
            };
            let place = system.grid.place(k, [centre(0, sensor.rows), centre(1, sensor.cols)]);
            let [row, col] =
                [0, 1].map(|axis| place[axis] + system.state.shifts[k][axis] + origin[axis] as f64);
            let columns = system.fluxes.columns.iter().enumerate();
            let mut others: Vec<_> =
                columns.map(|(index, column)| (hats.count() + index, column[k])).collect();
            if system.shift_prior.is_some() {
                let first = hats.count() + params + 2 * k;
                others.extend([0, 1].map(|axis| (first + axis, block.slope[axis] / block.weight)));
            }
            Arm { weight: block.weight, hats: hats.over(row, col), others }
        };
        let stars = blocks.chunks_exact(count).enumerate().map(|(index, blocks)| {
            let lit = blocks.iter().enumerate().filter(|(_, block)| block.weight > 0.0);
            lit.map(|(k, block)| arm(index, k, block)).collect()
        });
        // What a block's mean slope leaves of its mean square is the parameter's own.
        let mut own = system.precisions();
        let mut whole = own.clone();
        for (index, block) in blocks.iter().enumerate().filter(|(_, block)| block.weight > 0.0) {
            let k = index % count;
            for (whole, column) in whole.iter_mut().zip(&system.fluxes.columns) {
                *whole += block.weight * column[k] * column[k];
            }
            if system.shift_prior.is_some() {
                for axis in 0..2 {
                    let place = params + 2 * k + axis;
                    whole[place] += block.square[axis];
                    own[place] += block.square[axis] - block.slope[axis].powi(2) / block.weight;
                }
            }
        }
        let coarse = Coarse::of_stars(&hats, &own, stars, control)?;
        let mut diagonal = system.diagonal(true, control)?;
        let least = FAINTEST * diagonal.iter().sum::<f64>() / diagonal.len() as f64;
        diagonal.iter_mut().filter(|d| **d <= least).for_each(|d| *d = 0.0);
        diagonal.extend(whole);
        let inverse = diagonal.iter().map(|&d| if d > 0.0 { 1.0 / d } else { 0.0 }).collect();
        let beam = system.state.beam.clone();
        let slopes = slopes(system);
        Ok(Self { hats, inverse, coarse, beam, slopes })
    }

    /// Whether the coarse matrix has a factor.
    pub(super) const fn sees_large_scales(&self) -> bool {
        self.coarse.is_factorised()
    }

    /// P⁻¹ r.
    pub(super) fn apply<T: Real>(&self, system: &System<'_, '_, T>, r: &[f64]) -> Vec<f64> {
        let (beam, workers, hats) = (&self.beam, system.workers, &self.hats);
        let cols = system.grid.geometry.beam.cols;
        let nodes = hats.cols.nodes;
        let rows = beam.len() / cols;
        let mut heights = self.gather(r, cols, system.workers);
        heights.extend_from_slice(&r[beam.len()..]);
        self.coarse.solve(&mut heights, DAMPING);
        let mut z = vec![0.0; r.len()];
        workers.map_blocks(&mut z, cols, |row, part| {
            let first = row * cols;
            let own = r[first..].iter().zip(&self.inverse[first..]);
            part.iter_mut().zip(own).for_each(|(z, (r, inverse))| *z = r * inverse);
            if row >= rows {
                return;
            }
            let (node, height) = hats.rows.at(row as f64);
            let [above, below] = [node, node + 1].map(|node| &heights[node * nodes..][..nodes]);
            let [down, along] = &self.slopes;
            for (col, z) in part.iter_mut().enumerate() {
                let (cell, (node, share)) = (first + col, hats.columns[col]);
                let (node, share) = (node as usize, f64::from(share));
                let at = |node: usize| above[node] + height * (below[node] - above[node]);
                let fall = |node: usize| (below[node] - above[node]) / hats.rows.spacing;
                let (left, right) = (at(node), at(node + 1));
                let smooth = left + share * (right - left);
                let sloping = (right - left) / hats.cols.spacing;
                let falling = fall(node) + share * (fall(node + 1) - fall(node));
                if self.inverse[cell] > 0.0 {
                    *z += beam[cell] * smooth - down[cell] * falling - along[cell] * sloping;
                }
            }
        });
        let coarse = &heights[self.hats.count()..];
        z[beam.len()..].iter_mut().zip(coarse).for_each(|(z, height)| *z += height);
        // A multiple of the beam is no error, nor is what moves all exposures alike; what rounding
        // leaves of them must not grow.
        system.take_scale_out(&mut z[..beam.len()]);
        let shifts = &mut z[beam.len() + system.fluxes.columns.len()..];
        let moves = system.centred(shifts);
        shifts.copy_from_slice(moves.as_flattened());
        z
    }

    /// Φᵀ r.
    fn gather(&self, r: &[f64], cols: usize, workers: &Workers) -> Vec<f64> {
        let (beam, [down, along], hats) = (&self.beam, &self.slopes, &self.hats);
        let (rows, nodes) = (beam.len() / cols, hats.cols.nodes);
        let bands = workers.map(rows.div_ceil(SUMMED), |band| {
            let mut sums: Vec<(usize, Vec<f64>)> = Vec::new();
            for row in band * SUMMED..rows.min((band + 1) * SUMMED) {
                let [mut level, mut falling] = [vec![0.0; nodes], vec![0.0; nodes]];
                for (col, &(node, share)) in hats.columns.iter().enumerate() {
                    let (cell, node, share) = (row * cols + col, node as usize, f64::from(share));
                    let (value, sloping) = (r[cell] * beam[cell], r[cell] * along[cell]);
                    let (part, turn) = (share * value, sloping / hats.cols.spacing);
                    level[node] += value - part + turn;
                    level[node + 1] += part - turn;
                    let (fall, part) = (r[cell] * down[cell], share * r[cell] * down[cell]);
                    falling[node] += fall - part;
                    falling[node + 1] += part;
                }
                let (node, height) = hats.rows.at(row as f64);
                let fall = 1.0 / hats.rows.spacing;
                for (node, share, turn) in [(node, 1.0 - height, fall), (node + 1, height, -fall)] {
                    if sums.iter().all(|(known, _)| *known != node) {
                        sums.push((node, vec![0.0; nodes]));
                    }
                    for (_, sums) in sums.iter_mut().filter(|(known, _)| *known == node) {
                        let both = level.iter().zip(&falling);
                        sums.iter_mut()
                            .zip(both)
                            .for_each(|(s, (a, b))| *s += share * a + turn * b);
                    }
                }
            }
            sums
        });
        let mut heights = vec![0.0; hats.count()];
        for (node, sums) in bands.into_iter().flatten() {
            heights[node * nodes..].iter_mut().zip(sums).for_each(|(height, sum)| *height += sum);
        }
        heights
    }
}

/// A third of the slopes of a, a cell, down and along; 0 beside cells that are not seen.
fn slopes<T: Real>(system: &System<'_, '_, T>) -> [Vec<f64>; 2] {
    let (beam, cols) = (&system.state.beam, system.grid.geometry.beam.cols);
    let seen = |cell: usize| system.weights.get(cell).is_some_and(|&weight| weight > 0.0);
    [cols, 1].map(|step| {
        let mut slopes = vec![0.0; beam.len()];
        if system.grid.is_spline() {
            for cell in step..beam.len() - step {
                if seen(cell - step) && seen(cell + step) {
                    slopes[cell] = (beam[cell + step] - beam[cell - step]) / 6.0;
                }
            }
        }
        slopes
    })
}

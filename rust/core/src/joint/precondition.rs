//! The preconditioner of the joint problem: its diagonal, and hats on a coarse grid over the beam.
//!
//! As in [`precondition`](crate::precondition), with the columns of Φ hats times the beam. The fluxes
//! stand beside the hats in the coarse problem, since what looks like a tilt of M they tell from one
//! only through large scales.

use super::system::System;
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::precondition::coarse::{Arm, Coarse};
use crate::precondition::hats::Hats;
use crate::precondition::{DAMPING, spacing};

/// Blocks of pixels along the distance of two hats.
const BLOCKS: usize = 3;
/// Rows of cells whose sums over hats a thread makes at a time.
const SUMMED: usize = 32;
/// Cells with less than this share of the mean diagonal are as good as unseen.
const FAINTEST: f64 = 1e-12;
/// The share of its curvature that a flux has left where hats make up for it: hats times the
/// coefficients are only nearly hats times the beam, so that a tilt of it is no exact one.
const BLUR: f64 = 1e-3;

pub(super) struct Preconditioner {
    hats: Hats,
    /// 1/D of cells, θ and shifts; 0 for what no measurement tells.
    inverse: Vec<f64>,
    coarse: Coarse,
    params: usize,
}

impl Preconditioner {
    pub(super) fn new<T: Real>(system: &mut System<'_, '_, T>, control: &Control) -> Result<Self> {
        let geometry = &system.model.geometry;
        let spacing = spacing(geometry);
        let (beam, origin) = (system.grid.geometry.beam, system.grid.geometry.origin);
        let hats = Hats::new(beam, spacing);
        let size = spacing.map(|spacing| (spacing / BLOCKS).max(1));
        let weights = system.block_weights(size, control)?;
        let (sensor, count) = (system.model.sensor(), system.model.count());
        let params = system.fluxes.columns.len();
        let across = sensor.cols.div_ceil(size[1]);
        let arm = |block: usize, k: usize, weight: f64| {
            let corner = [block / across * size[0], block % across * size[1]];
            let centre = |axis: usize, side: usize| {
                let end = (corner[axis] + size[axis]).min(side) - 1;
                (corner[axis] + end) as f64 / 2.0
            };
            let place = system.grid.place(k, [centre(0, sensor.rows), centre(1, sensor.cols)]);
            let [row, col] =
                [0, 1].map(|axis| place[axis] + system.state.shifts[k][axis] + origin[axis] as f64);
            let others = system.fluxes.columns.iter().enumerate();
            let others = others.map(|(index, column)| (hats.count() + index, column[k])).collect();
            Arm { weight, hats: hats.over(row, col), others }
        };
        let stars = weights.chunks_exact(count).enumerate().map(|(block, weights)| {
            let weights = weights.iter().enumerate().filter(|(_, weight)| **weight > 0.0);
            weights.map(|(k, &weight)| arm(block, k, weight)).collect()
        });
        let precisions = system.precisions();
        let mut totals = vec![0.0; count];
        for (index, weight) in weights.iter().enumerate() {
            totals[index % count] += weight;
        }
        let of_theta = system.fluxes.columns.iter().zip(&precisions).map(|(column, precision)| {
            precision + column.iter().zip(&totals).map(|(t, total)| t * t * total).sum::<f64>()
        });
        let of_theta: Vec<f64> = of_theta.collect();
        let blur = if system.grid.is_spline() { BLUR } else { 0.0 };
        let held = precisions.iter().zip(&of_theta).map(|(precision, all)| precision + blur * all);
        let held: Vec<f64> = held.collect();
        let coarse = Coarse::of_stars(&hats, &held, stars, control)?;
        let mut diagonal = system.diagonal(true, control)?;
        let least = FAINTEST * diagonal.iter().sum::<f64>() / diagonal.len() as f64;
        diagonal.extend(of_theta);
        if system.shift_prior.is_some() {
            let told = system.shift_diagonal(control)?;
            let told = told.as_flattened().iter().zip(&precisions[params..]);
            diagonal.extend(told.map(|(told, precision)| told + precision));
        }
        let inverse = diagonal.iter().map(|&d| if d > least { 1.0 / d } else { 0.0 }).collect();
        Ok(Self { hats, inverse, coarse, params })
    }

    /// P⁻¹ r.
    pub(super) fn apply<T: Real>(&self, system: &System<'_, '_, T>, r: &[f64]) -> Vec<f64> {
        let (beam, workers) = (&system.state.beam, system.workers);
        let cols = system.grid.geometry.beam.cols;
        let nodes = self.hats.cols.nodes;
        let rows = beam.len() / cols;
        let bands = workers.map(rows.div_ceil(SUMMED), |band| {
            let mut sums: Vec<(usize, Vec<f64>)> = Vec::new();
            for row in band * SUMMED..rows.min((band + 1) * SUMMED) {
                let mut along = vec![0.0; nodes];
                let cells = row * cols..(row + 1) * cols;
                let values = beam[cells.clone()].iter().zip(&r[cells]);
                for ((a, r), &(node, height)) in values.zip(&self.hats.columns) {
                    let (node, part) = (node as usize, f64::from(height) * a * r);
                    along[node] += a * r - part;
                    along[node + 1] += part;
                }
                let (node, height) = self.hats.rows.at(row as f64);
                for (node, share) in [(node, 1.0 - height), (node + 1, height)] {
                    if sums.iter().all(|(known, _)| *known != node) {
                        sums.push((node, vec![0.0; nodes]));
                    }
                    for (known, sums) in &mut sums {
                        if *known == node {
                            sums.iter_mut().zip(&along).for_each(|(sum, a)| *sum += share * a);
                        }
                    }
                }
            }
            sums
        });
        let mut heights = vec![0.0; self.hats.count()];
        for (node, sums) in bands.into_iter().flatten() {
            heights[node * nodes..].iter_mut().zip(sums).for_each(|(height, sum)| *height += sum);
        }
        heights.extend_from_slice(&r[beam.len()..beam.len() + self.params]);
        self.coarse.solve(&mut heights, DAMPING);
        let mut z = vec![0.0; r.len()];
        workers.map_blocks(&mut z, cols, |row, part| {
            let first = row * cols;
            let own = r[first..].iter().zip(&self.inverse[first..]);
            part.iter_mut().zip(own).for_each(|(z, (r, inverse))| *z = r * inverse);
            if row >= rows {
                return;
            }
            let (node, height) = self.hats.rows.at(row as f64);
            let [above, below] = [node, node + 1].map(|node| &heights[node * nodes..][..nodes]);
            let smooth = |node: usize| above[node] + height * (below[node] - above[node]);
            let cells = part.iter_mut().zip(&beam[first..]).zip(&self.inverse[first..]);
            for (((z, a), inverse), &(node, share)) in cells.zip(&self.hats.columns) {
                let (left, right) = (smooth(node as usize), smooth(node as usize + 1));
                if *inverse > 0.0 {
                    *z += a * (left + f64::from(share) * (right - left));
                }
            }
        });
        let coarse = &heights[self.hats.count()..];
        z[beam.len()..].iter_mut().zip(coarse).for_each(|(z, height)| *z += height);
        // What moves all exposures alike no product tells: rounding would let it grow.
        let moves = beam.len() + self.params;
        let centred = system.centred(&z[moves..]);
        z[moves..].copy_from_slice(centred.as_flattened());
        z
    }
}

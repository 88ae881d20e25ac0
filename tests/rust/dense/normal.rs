//! The normal equations N x = b of a Gauss-Newton step, in all unknowns at once.

use super::linear::{Cholesky, Symmetric, dot};
use super::{Dense, Layout, Measurement};
use crate::common::SMOOTHING;
use crate::simulation::place;

/// The equations, and what they were made of.
pub(crate) struct Normal {
    pub(crate) matrix: Symmetric,
    /// b: half the slope of −F.
    pub(crate) slope: Vec<f64>,
    /// The sum of the sizes of the terms of each b.
    pub(crate) terms: Vec<f64>,
    /// The parts of b that the penalty and the priors make.
    pub(crate) of_penalty: Vec<f64>,
    pub(crate) of_priors: Vec<f64>,
    /// F, and that of the measurements alone.
    pub(crate) objective: f64,
    pub(crate) misfit: f64,
}

impl Normal {
    fn zeros(order: usize) -> Self {
        let [slope, terms, of_penalty, of_priors] = [(); 4].map(|()| vec![0.0; order]);
        let matrix = Symmetric::zeros(order);
        Self { matrix, slope, terms, of_penalty, of_priors, objective: 0.0, misfit: 0.0 }
    }

    /// Adds an equation row·x = residual; `size` is that of the numbers that the residual is a
    /// difference of.
    fn add(&mut self, weight: f64, row: &[(usize, f64)], residual: f64, size: f64) {
        self.matrix.add_square(weight, row);
        for &(unknown, slope) in row {
            self.slope[unknown] += weight * slope * residual;
            self.terms[unknown] += (weight * slope * size).abs();
        }
        self.objective += weight * residual * residual;
    }
}

impl Dense<'_> {
    /// N and b at x.
    pub(crate) fn normal(&self, x: &[f64]) -> Normal {
        let Layout { offsets, cells, fluxes, .. } = self.layout;
        let (mut normal, mut weights) = (Normal::zeros(x.len()), vec![0.0; x.len()]);
        let flux = self.flux(x);
        let shifts: Vec<_> = (0..flux.len()).map(|k| self.shift(k, x)).collect();
        for at in &self.measurements {
            let (c, m) = (flux[at.exposure], x[at.pixel]);
            let row = self.row(at, x, c, shifts[at.exposure]);
            let offset = if cells > offsets { x[offsets + at.pixel] } else { 0.0 };
            let model = m * row[0].1 + offset;
            normal.add(at.weight, &row, at.value - model, at.value.abs());
            // The slope along a coefficient is c M B, and D = Σ w c² M² B.
            let of_cells = row.iter().filter(|(unknown, _)| (cells..fluxes).contains(unknown));
            of_cells.for_each(|&(cell, slope)| weights[cell] += at.weight * c * m * slope);
        }
        normal.misfit = normal.objective;
        self.add_priors(&mut normal, x);
        self.add_prior_of_gain(&mut normal, x);
        if self.is_spline {
            self.add_penalty(&mut normal, x, &weights);
        }
        normal
    }

    /// What a change of all measurements of a pixel alike pulls at the unknowns, by pixel, and their
    /// weights.
    pub(crate) fn pulls_in_common(&self, x: &[f64]) -> (Vec<Vec<f64>>, Vec<f64>) {
        let (mut pulls, mut weights) =
            (vec![vec![0.0; x.len()]; self.pixels()], vec![0.0; self.pixels()]);
        let flux = self.flux(x);
        for at in &self.measurements {
            weights[at.pixel] += at.weight;
            for (unknown, slope) in self.row(at, x, flux[at.exposure], self.shift(at.exposure, x)) {
                pulls[at.pixel][unknown] += at.weight * slope;
            }
        }
        (pulls, weights)
    }

    /// The slopes of c·L·M + O along the unknowns; that along M, which is the light c·L, stands first.
    fn row(&self, at: &Measurement, x: &[f64], c: f64, shift: [f64; 2]) -> Vec<(usize, f64)> {
        let (k, m) = (at.exposure, x[at.pixel]);
        let p = place(self.experiment.shape, self.experiment.degrees[k], at.pixel);
        let taps = self.taps([p[0] + shift[0], p[1] + shift[1]]);
        let light = |of: usize| c * taps.iter().map(|(cell, b)| b[of] * x[*cell]).sum::<f64>();
        let mut row = vec![(at.pixel, light(0))];
        if self.experiment.offset {
            row.push((self.layout.offsets + at.pixel, 1.0));
        }
        row.extend(taps.iter().map(|(cell, b)| (*cell, c * m * b[0])));
        let columns = self.columns.of(k).enumerate();
        row.extend(columns.map(|(index, t)| (self.layout.fluxes + index, light(0) * m * t)));
        if !self.shift_std.is_empty() {
            for axis in 0..2 {
                let slope = light(1 + axis) * m;
                row.extend(self.moves(k, axis).into_iter().map(|(at, z)| (at, slope * z)));
            }
        }
        row
    }

    /// The priors as measurements: (ln c − ln c₀)/s_c = 0 and (d − d₀)/s_d = 0.
    fn add_priors(&self, normal: &mut Normal, x: &[f64]) {
        let mut add = |row: &[(usize, f64)]| {
            let value: f64 = row.iter().map(|&(at, slope)| slope * x[at]).sum();
            normal.add(self.unit, row, -value, value.abs());
            for &(at, slope) in row {
                normal.of_priors[at] -= self.unit * slope * value;
            }
        };
        if self.columns.have_prior {
            (self.layout.fluxes..self.layout.shifts).for_each(|at| add(&[(at, 1.0)]));
        }
        for (k, std) in self.shift_std.iter().enumerate() {
            for (axis, std) in std.iter().enumerate() {
                let moves = self.moves(k, axis).into_iter();
                add(&moves.map(|(at, z)| (at, z / std)).collect::<Vec<_>>());
            }
        }
    }

    /// Σ λ (M/μ − 1)², the mean μ being that of the pixels with measurements: row of λ of M_p/μ.
    fn add_prior_of_gain(&self, normal: &mut Normal, x: &[f64]) {
        let m = &x[..self.pixels()];
        let seen: Vec<usize> = (0..m.len()).filter(|&p| normal.matrix.at(p, p) > 0.0).collect();
        let mean = seen.iter().map(|&p| m[p]).sum::<f64>() / seen.len() as f64;
        for (pixel, &weight) in self.prior.iter().enumerate().filter(|(_, weight)| **weight > 0.0) {
            let of_mean = m[pixel] / (mean * mean * seen.len() as f64);
            let own = |p: usize| if p == pixel { 1.0 / mean } else { 0.0 };
            let row: Vec<_> = seen.iter().map(|&p| (p, own(p) - of_mean)).collect();
            normal.add(weight, &row, 1.0 - m[pixel] / mean, 1.0);
        }
    }

    /// τ‖G P x‖², with τ by the mean D of a cell, weighted by D: with u = D a/(aᵀD a), PᵀGᵀG P =
    /// GᵀG − u (GᵀG a)ᵀ − (GᵀG a) uᵀ + ‖G a‖² u uᵀ.
    fn add_penalty(&self, normal: &mut Normal, x: &[f64], weights: &[f64]) {
        let tau = SMOOTHING * dot(weights, weights) / weights.iter().sum::<f64>();
        let (mut bent, mut energy) = (vec![0.0; x.len()], 0.0);
        for line in self.lines().filter(|line| line.iter().all(|&(cell, _)| weights[cell] > 0.0)) {
            let difference: f64 = line.iter().map(|&(cell, g)| g * x[cell]).sum();
            for (cell, g) in line {
                bent[cell] += g * difference;
                normal.terms[cell] += (tau * g * difference).abs();
            }
            energy += difference * difference;
            normal.matrix.add_square(tau, &line);
        }
        let mut share = vec![0.0; x.len()];
        for cell in self.layout.cells..self.layout.fluxes {
            share[cell] = weights[cell] * x[cell];
        }
        let norm = dot(&share, x);
        share.iter_mut().for_each(|share| *share /= norm);
        normal.matrix.add_pair(-2.0 * tau, &share, &bent);
        normal.matrix.add_pair(tau * energy, &share, &share);
        normal.objective += tau * energy;
        for (cell, (share, bent)) in share.iter().zip(&bent).enumerate() {
            normal.of_penalty[cell] = tau * (energy * share - bent);
            normal.slope[cell] += normal.of_penalty[cell];
        }
    }

    /// Five cells down or along, with the factors of a fourth difference.
    fn lines(&self) -> impl Iterator<Item = [(usize, f64); 5]> {
        const FOURTH: [f64; 5] = [1.0, -4.0, 6.0, -4.0, 1.0];
        let ([rows, cols], first) = (self.sizes, self.layout.cells);
        let line = move |row: usize, col: usize, step: usize| {
            [0, 1, 2, 3, 4].map(|i| (first + row * cols + col + i * step, FOURTH[i]))
        };
        let down =
            (0..rows - 4).flat_map(move |row| (0..cols).map(move |col| line(row, col, cols)));
        let along = (0..rows).flat_map(move |row| (0..cols - 4).map(move |col| line(row, col, 1)));
        down.chain(along)
    }

    /// Directions along which F does not change: of a factor between M and L, and of one shift for all.
    fn gauges(&self, x: &[f64]) -> Vec<Vec<f64>> {
        let Layout { offsets, cells, fluxes, shifts, .. } = self.layout;
        let mut scale = vec![0.0; x.len()];
        scale[..offsets].copy_from_slice(&x[..offsets]);
        (cells..fluxes).for_each(|cell| scale[cell] = -x[cell]);
        let mut gauges = vec![scale];
        for axis in 0..if self.shift_std.is_empty() { 0 } else { 2 } {
            let mut all = vec![0.0; x.len()];
            for (k, std) in self.shift_std.iter().enumerate() {
                all[shifts + 2 * k + axis] = 1.0 / std[axis];
            }
            gauges.push(all);
        }
        gauges
    }

    /// The factor of N, held along the directions that F does not change along; `None` if it changes along
    /// no other direction either.
    pub(crate) fn factorised(&self, normal: &Normal, x: &[f64]) -> Option<Factorised> {
        let told: Vec<usize> = (0..x.len()).filter(|&i| normal.matrix.at(i, i) > 0.0).collect();
        let mut matrix = normal.matrix.clone();
        for gauge in self.gauges(x) {
            let held: Vec<f64> =
                gauge.iter().enumerate().map(|(i, z)| normal.matrix.at(i, i) * z).collect();
            matrix.add_pair(1.0 / dot(&held, &gauge), &held, &held);
        }
        Some(Factorised { factor: matrix.part(&told).factorised()?, told, order: x.len() })
    }
}

/// The factor of a normal matrix, of the unknowns that F depends on.
pub(crate) struct Factorised {
    factor: Cholesky,
    told: Vec<usize>,
    pub(crate) order: usize,
}

impl Factorised {
    /// N⁻¹ b; 0 for unknowns that F does not depend on.
    pub(crate) fn solve(&self, right: &[f64]) -> Vec<f64> {
        let found = self.factor.solve(&self.told.iter().map(|&i| right[i]).collect::<Vec<_>>());
        let mut x = vec![0.0; self.order];
        self.told.iter().zip(found).for_each(|(&i, value)| x[i] = value);
        x
    }
}

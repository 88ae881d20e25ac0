//! The linear problem of one step, with the pixels eliminated.
//!
//! The unknowns are the beam's coefficients a, the fluxes and the shifts; M, and the offset O where
//! one is sought, follow at their closed forms. With the light e = c L that an exposure shows at
//! a pixel, its change u = c M (B·a′ + L·ln c′ + ∇L·d′) and Q = 1 − e(eᵀwe)⁻¹eᵀw, which takes out
//! what M can follow (and O likewise),
//!
//! ```text
//! S x = Jᵀ w Q J x + priors,   J x = u
//! ```
//!
//! (Golub and Pereyra 1973, with the simplification of Kaufman 1975.) A product is one pass over the pixels
//! (`joint/pass.rs`).

use std::ops::Range;

use super::bands::Bands;
use super::flux::Fluxes;
use super::grid::{Grid, TAPS};
use super::kernel::{Follow, Row, Solve};
use super::pass::Sums;
use super::penalty::Penalty;
pub(super) use super::problem::{ShiftPrior, State, System};
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::model::Model;
use crate::parallel::Workers;

/// A determinant that is rounding alone, of two columns that a pixel cannot tell from each other.
const SINGULAR: f64 = 1e-12;

impl<'m, 'a, T: Real> System<'m, 'a, T> {
    pub(super) fn new(
        model: &'m Model<'a, T>,
        grid: Grid,
        fluxes: Fluxes,
        with_offset: bool,
        state: State,
        workers: &'m Workers,
        control: &Control,
    ) -> Self {
        let sensor = model.sensor();
        let length = Row::length(model.count(), sensor.cols, with_offset);
        Self {
            model,
            workers,
            fluxes,
            shift_prior: None,
            with_offset,
            misfit: 0.0,
            unit: 1.0,
            flux: model.flux.clone(),
            pull: Vec::new(),
            mean: 1.0,
            windows: Vec::new(),
            bands: Bands::default(),
            rows: workers.filled(sensor.rows * length, 0.0, control),
            sums: Vec::new(),
            passes: 0,
            weights: Vec::new(),
            scale: Vec::new(),
            penalty: None,
            state,
            grid,
        }
    }

    /// Values of a vector of unknowns: cells, θ, shifts.
    pub(super) fn size(&self) -> usize {
        let shifts = if self.shift_prior.is_some() { 2 * self.model.count() } else { 0 };
        self.state.beam.len() + self.fluxes.columns.len() + shifts
    }

    /// Finds M at the state, F there, and half the slope of −F along the unknowns.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled), here and below.
    pub(super) fn linearise(&mut self, tau: f64, control: &Control) -> Result<(f64, Vec<f64>)> {
        self.place(control);
        let logs = self.fluxes.spread(&self.state.theta, self.model.count());
        self.flux = self.model.flux.iter().zip(&logs).map(|(c, log)| c * log.exp()).collect();
        let beam = std::mem::take(&mut self.state.beam);
        let mut pull = self.workers.filled(beam.len(), 0.0, control);
        let found = self.solve_pixels(&beam, &mut pull, control);
        self.state.beam = beam;
        let found = found?;
        self.append(&found, &mut pull);
        (self.misfit, self.pull) = (found.objective, pull);
        self.mean = self.mean_sensitivity();
        // Cells come into sight where shifts move.
        if self.weights.is_empty() || self.shift_prior.is_some() {
            self.weigh(tau, control)?;
        }
        self.whole(control)
    }

    /// What [`linearise`](Self::linearise) gives, at weights D and a weight of the penalty of the state
    /// there.
    pub(super) fn renew(&mut self, tau: f64, control: &Control) -> Result<(f64, Vec<f64>)> {
        self.penalty = None;
        self.weigh(tau, control)?;
        self.whole(control)
    }

    /// Where the exposures lie, and the sums that this takes.
    fn place(&mut self, control: &Control) {
        let Grid { geometry, width, sensor, .. } = &self.grid;
        self.windows = self.grid.windows(&self.state.shifts);
        self.bands = Bands::new(&self.windows, &geometry.views, *width);
        let size = self.bands.size(sensor.rows);
        if self.sums.len() != size {
            self.sums = Vec::new();
            self.sums = self.workers.filled(size, 0.0, control);
        }
    }

    /// M and O at their closed forms, and what they leave pulls at the cells.
    fn solve_pixels(&mut self, beam: &[f64], pull: &mut [f64], control: &Control) -> Result<Sums> {
        let views = self.views_of(beam);
        self.pass(pull, control, |system, row_index, row, room, found| {
            room.values().clear();
            system.see(&views, row_index, room);
            let lights = row.light.chunks_exact_mut(system.model.sensor().cols);
            for (k, (light, flux)) in lights.zip(&system.flux).enumerate() {
                light.iter_mut().zip(room.values().of(k)).for_each(|(e, seen)| *e = flux * seen);
            }
            system.measure(row_index, room);
            system.see_slopes(&views, row_index, room);
            let (weights, values, sums) = room.parts();
            let (fluxes, singular) = (&system.flux[..], SINGULAR);
            let solve = Solve { row, fluxes, weights, values, sums, singular };
            found.objective += pulp::Arch::new().dispatch(solve);
        })
    }

    /// F and half the slope of −F, with the penalty and the priors.
    fn whole(&mut self, control: &Control) -> Result<(f64, Vec<f64>)> {
        let mut scale = std::mem::take(&mut self.scale);
        scale.resize(self.weights.len(), 0.0);
        let cols = self.grid.geometry.beam.cols;
        self.workers.map_blocks(&mut scale, cols, |row, scale| {
            let cells = self.weights[row * cols..].iter().zip(&self.state.beam[row * cols..]);
            scale.iter_mut().zip(cells).for_each(|(scale, (d, a))| *scale = d * a);
        });
        let norm = self.workers.dot(&scale, &self.state.beam);
        self.workers.map_blocks(&mut scale, cols, |_, scale| {
            scale.iter_mut().for_each(|scale| *scale /= norm);
        });
        self.scale = scale;
        if let Some(penalty) = &mut self.penalty {
            penalty.turn_to(&self.state.beam, &self.weights, self.workers);
            control.check()?;
        }
        let mut slope = self.workers.filled(self.pull.len(), 0.0, control);
        slope.copy_from_slice(&self.pull);
        let mut objective = self.misfit + self.pull_by_priors(&mut slope);
        if let Some(penalty) = &self.penalty {
            objective += penalty.pull(&mut slope[..self.state.beam.len()], self.workers);
        }
        control.check()?;
        Ok((objective, slope))
    }

    /// x − a (aᵀD x)/(aᵀD a), without the multiple of the beam that no measurement tells.
    pub(super) fn take_scale_out(&self, x: &mut [f64]) {
        let multiple = self.workers.dot(&self.scale, x);
        self.workers.add_multiple(x, -multiple, &self.state.beam);
    }

    /// What was gathered of fluxes and shifts, behind what cells got.
    pub(super) fn append(&self, sums: &Sums, vector: &mut Vec<f64>) {
        vector.extend(self.fluxes.gather(&sums.flux));
        vector.extend_from_slice(self.centred_pulls(sums.shifts.clone()).as_flattened());
    }

    /// The pull of the priors, added to a slope; returns their share of F.
    fn pull_by_priors(&self, slope: &mut [f64]) -> f64 {
        let cells = self.state.beam.len();
        let mut objective = 0.0;
        let params = self.fluxes.columns.len();
        let of_flux = slope[cells..].iter_mut().zip(&self.state.theta).zip(&self.fluxes.precisions);
        for ((slope, theta), precision) in of_flux {
            *slope -= self.unit * precision * theta;
            objective += self.unit * precision * theta * theta;
        }
        if let Some(prior) = &self.shift_prior {
            let known = prior.measured.as_flattened().iter().zip(prior.precisions.as_flattened());
            let found = self.state.shifts.as_flattened();
            let of_shifts = slope[cells + params..].iter_mut().zip(found).zip(known);
            for ((slope, found), (measured, precision)) in of_shifts {
                let deviation = found - measured;
                *slope -= self.unit * precision * deviation;
                objective += self.unit * precision * deviation * deviation;
            }
        }
        objective
    }

    /// How many pixels have a measurement.
    pub(super) fn measured(&self) -> usize {
        let mut count = 0;
        self.for_rows(|[_, inverse, ..]| count += inverse.iter().filter(|i| **i > 0.0).count());
        count
    }

    /// The pixels whose measurements do not tell an offset from a gain, where one is sought.
    pub(super) fn untold(&self) -> Vec<usize> {
        let (mut untold, mut first) = (Vec::new(), 0);
        if self.with_offset {
            self.for_rows(|[_, gain, _, _, beside, _]| {
                let pixels = gain.iter().zip(beside).enumerate();
                let told = pixels.filter(|(_, (gain, offset))| **gain > 0.0 && **offset == 0.0);
                untold.extend(told.map(|(col, _)| first + col));
                first += gain.len();
            });
        }
        untold
    }

    /// S x, and the change of M that goes with x in each [`Row`]; returns the largest size of that less
    /// `share` of the change before.
    pub(super) fn multiply(
        &mut self,
        x: &[f64],
        product: &mut Vec<f64>,
        share: f64,
        control: &Control,
    ) -> Result<f64> {
        let cells = self.state.beam.len();
        let params = self.fluxes.columns.len();
        let moves = self.centred(&x[cells + params..]);
        let beam = std::mem::take(&mut self.state.beam);
        product.resize(cells, 0.0);
        let sums = self.follow(&beam, x, &moves, product, share, control);
        self.state.beam = beam;
        let sums = sums?;
        self.append(&sums, product);
        if let Some(penalty) = &self.penalty {
            penalty.add_product(&x[..cells], &mut product[..cells], self.workers);
        }
        let found = x[cells..cells + params].iter().chain(moves.as_flattened());
        let priors = product[cells..].iter_mut().zip(found).zip(self.precisions());
        priors.for_each(|((product, x), precision)| *product += precision * x);
        Ok(sums.largest)
    }

    /// What a step pulls at the cells once M and O have followed it.
    fn follow(
        &mut self,
        beam: &[f64],
        x: &[f64],
        moves: &[[f64; 2]],
        pull: &mut [f64],
        share: f64,
        control: &Control,
    ) -> Result<Sums> {
        let (cells, params) = (beam.len(), self.fluxes.columns.len());
        let logs = self.fluxes.spread(&x[cells..cells + params], self.model.count());
        let shares: Vec<f64> = logs.iter().zip(&self.flux).map(|(log, flux)| log / flux).collect();
        let (views, beams) = (self.views_of(&x[..cells]), self.views_of(beam));
        self.pass(pull, control, |system, row_index, row, room, found| {
            system.weigh_row(row_index, room);
            system.see_slopes(&beams, row_index, room);
            room.begin(row.light, &shares, moves);
            system.see(&views, row_index, room);
            let (weights, values, sums) = room.parts();
            let fluxes = &system.flux[..];
            let follow = Follow { row, fluxes, weights, values, sums, share };
            found.largest = found.largest.max(pulp::Arch::new().dispatch(follow));
        })
    }

    /// Changes of shifts less their mean, by the weights of the prior: to move all exposures moves
    /// but the beam, which no measurement tells.
    ///
    /// As Σ_j π_j (d_k − d_j)/Σ π: where one shift is all but exact, it is all but the mean, and what
    /// rounding leaves of their difference would pull at it with all its weight.
    pub(super) fn centred(&self, shifts: &[f64]) -> Vec<[f64; 2]> {
        let shifts = shifts.as_chunks().0;
        let Some(shares) = self.shares() else { return shifts.to_vec() };
        let from_mean = |shift: &[f64; 2], axis: usize| -> f64 {
            let others = shares.iter().zip(shifts);
            others
                .map(|(share, other): (_, &[f64; 2])| share[axis] * (shift[axis] - other[axis]))
                .sum()
        };
        shifts.iter().map(|shift| [0, 1].map(|axis| from_mean(shift, axis))).collect()
    }

    /// What pulls at shifts pulls at them less their mean: the transpose of [`centred`](Self::centred).
    pub(super) fn centred_pulls(&self, pulls: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
        let Some(shares) = self.shares() else { return pulls };
        let left = |k: usize, axis: usize| -> f64 {
            let others = (0..pulls.len()).filter(|&j| j != k);
            others
                .map(|j| shares[j][axis] * pulls[k][axis] - shares[k][axis] * pulls[j][axis])
                .sum()
        };
        (0..pulls.len()).map(|k| [0, 1].map(|axis| left(k, axis))).collect()
    }

    /// The share of each shift in their mean, if they are sought.
    fn shares(&self) -> Option<Vec<[f64; 2]>> {
        let precisions = &self.shift_prior.as_ref()?.precisions;
        let sum = [0, 1].map(|axis| precisions.iter().map(|p| p[axis]).sum::<f64>());
        Some(precisions.iter().map(|p| [p[0] / sum[0], p[1] / sum[1]]).collect())
    }

    /// The priors' weights of the parameters.
    pub(super) fn precisions(&self) -> Vec<f64> {
        let shifts = self.shift_prior.iter().flat_map(|prior| prior.precisions.as_flattened());
        self.fluxes.precisions.iter().chain(shifts).map(|precision| self.unit * precision).collect()
    }

    /// D, Σ w c² M² over the pixels that see a cell, by their factors, and the penalty that goes with it.
    fn weigh(&mut self, tau: f64, control: &Control) -> Result<()> {
        let mut weights = self.workers.filled(self.state.beam.len(), 0.0, control);
        self.pass(&mut weights, control, |system, row_index, row, room, _| {
            let cols = system.model.sensor().cols;
            system.weigh_row(row_index, room);
            let (weights, values, _) = room.parts();
            for (k, (weights, flux)) in weights.chunks_exact(cols).zip(&system.flux).enumerate() {
                let pixels = weights.iter().zip(&*row.sensitivity);
                for (value, (weight, m)) in values.of_mut(k).iter_mut().zip(pixels) {
                    *value = weight * (flux * m) * (flux * m);
                }
            }
        })?;
        self.weights = weights;
        if self.grid.is_spline() {
            let total: f64 = self.weights.iter().sum();
            let typical = self.workers.dot(&self.weights, &self.weights) / total;
            // τ stays until it is asked for anew, or F would not be one function.
            let tau = self.penalty.as_ref().map_or(tau * typical, |penalty| penalty.tau);
            let shape = self.grid.geometry.beam;
            self.penalty = Some(Penalty::new(shape, &self.weights, tau, self.workers, control));
        }
        control.check()
    }

    /// w (c M)² of up to four pixels of a row of an exposure.
    pub(super) fn pixel_weights(
        &self,
        exposure: usize,
        row: usize,
        cols: Range<usize>,
    ) -> [f64; TAPS] {
        let mut weights = [self.model.uniform_weight(exposure).unwrap_or(0.0); TAPS];
        if self.model.uniform_weight(exposure).is_none() {
            let _ = self.model.stretch(exposure, row, cols.clone(), &mut weights);
        }
        let (sensor, count) = (self.model.sensor(), self.model.count());
        let length = Row::length(count, sensor.cols, self.with_offset);
        let sensitivity = &self.rows[row * length + count * sensor.cols..][..sensor.cols];
        for (weight, m) in weights.iter_mut().zip(&sensitivity[cols]) {
            *weight *= (self.flux[exposure] * m).powi(2);
        }
        weights
    }

    /// M and O at the state, row by row.
    pub(super) fn pixels(&self) -> [Vec<f64>; 2] {
        let mut found = [Vec::new(), Vec::new()];
        self.for_rows(|[sensitivity, _, _, offset, ..]| {
            found[0].extend_from_slice(sensitivity);
            found[1].extend_from_slice(offset);
        });
        found
    }

    /// The mean M of the pixels with measurements.
    fn mean_sensitivity(&self) -> f64 {
        let (mut sum, mut count) = (0.0, 0);
        self.for_rows(|[sensitivity, inverse, ..]| {
            for (m, inverse) in sensitivity.iter().zip(inverse) {
                if *inverse > 0.0 {
                    sum += m;
                    count += 1;
                }
            }
        });
        sum / f64::from(count.max(1))
    }

    /// Calls `visit([M, i₁₁, the last change of M, O, i₁₂, i₂₂])` for each row of pixels, i being the
    /// inverse of their normal matrices; the last three are empty where no offset is sought.
    pub(super) fn for_rows(&self, mut visit: impl FnMut([&[f64]; 6])) {
        let (cols, count) = (self.model.sensor().cols, self.model.count());
        for row in self.rows.chunks_exact(Row::length(count, cols, self.with_offset)) {
            let part = |index: usize| row.chunks_exact(cols).nth(count + index).unwrap_or_default();
            visit([0, 1, 2, 3, 4, 5].map(part));
        }
    }
}

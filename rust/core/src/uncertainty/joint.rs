//! How far noise, and what priors leave open, may have moved what a joint fit found.
//!
//! With x the error of the unknowns other than M and O, and C x the change of M that follows it,
//!
//! ```text
//! δM = D⁻¹ eᵀw ε + C x,   Cov M = D⁻¹ + C S⁻¹ Cᵀ
//! ```
//!
//! since the noise that moves a pixel alone and that which is left for x are independent (see
//! `joint/system.rs`; with an offset, D is the pixel's matrix of 2 by 2). The first term is known; the
//! second is the mean square of C x over draws S x = b of b with the covariance S. Priors and the
//! penalty count as measurements of their own there: S⁻¹ is what they leave open too. Where shifts were
//! refined S⁻¹ is (S − N)⁻¹ S (S − N)⁻¹ without the noise N of slopes (`joint/shift_noise.rs`): products are
//! those of S − N, and draws have the covariance S.
//!
//! Three things stand beside S. A prior on fluxes leaves a tilt of M open that S does not see
//! (`joint/flux.rs`): its covariance is added. Shifts that have a prior but were not refined are wrong by
//! its full width: what that does to M is drawn too, and likewise along the direction in which they were
//! not refined; the two directions are taken as independent. And of all this the gauge of the result takes
//! out the mean of M, and the tilt where free fluxes leave it undetermined.
//!
//! On larger sensors the squares of C x are smoothed (`smoothed.rs`).
//!
//! The noise of a dark that was subtracted from all exposures is a fourth (`joint_dark.rs`).

use std::cell::OnceCell;
use std::sync::Arc;

use super::joint_dark::Dark;
use super::joint_gauge::{Hidden, Tilts, count, form, valid};
use super::joint_pulls::{add_change, product, pull_of};
use super::sampling::{ErrorMap, LACK_OF_DRAW, LACK_OF_FUNCTIONAL, LACK_WITH_DARK};
use super::sampling::{NOTHING, Sampled, mean_misfit};
use super::smoothed::{is_smoothed, smoothed};
use crate::control::Control;
use crate::convergence::FEWEST_ITERATIONS;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::fit::{Refinement, Solution};
use crate::frames::{Real, flag};
use crate::joint::{
    self, ConjugateGradients, Fluxes, Grid, Known, Precision, Preconditioner, ShiftPrior, State,
    System,
};
use crate::memory;
use crate::parallel::Workers;

mod draws;
#[cfg(test)]
mod tests;

/// Upper limit on iterations for one right-hand side.
const MOST_ITERATIONS: u64 = 500;

/// A linear functional of what was found.
enum Functional {
    /// Σ g M.
    Gain(Vec<f64>),
    /// Σ q d, of the shifts (row, column) of all exposures less their mean by the weights of the prior,
    /// which no measurement determines.
    Shifts(Vec<[f64; 2]>),
    /// b of the least-squares part b M of the offsets' errors: what they have in common.
    Offset,
}

/// The covariance at a joint fit, in units of the variance of a measurement of weight 1.
pub(super) struct JointCovariance<'m, 'a, T> {
    system: System<'m, 'a, T>,
    preconditioner: Preconditioner,
    /// What searches of one question have told.
    known: Known,
    /// S⁻¹ b of the last right-hand side b, and b · S⁻¹ b.
    x: Vec<f64>,
    energy: f64,
    /// What the gauge makes of changes, once it is asked for: five values for each pixel.
    tilts: OnceCell<Arc<Tilts>>,
    solution: Solution<'m>,
    /// The shifts that are uncertain though they were not refined.
    considered: Option<ShiftPrior>,
    /// Where M is determined.
    determined: Vec<bool>,
    /// 1 in the pixels whose mean M is 1, else 0.
    valid: Vec<f32>,
    /// The mean of D⁻¹: in these units squares have no extreme values.
    scale: f64,
    /// The noise of a dark that was subtracted from all exposures.
    dark: Option<Dark>,
    incomplete: u64,
}

impl<'m, 'a, T: Real> JointCovariance<'m, 'a, T> {
    /// # Errors
    /// [`Error::Memory`](crate::Error::Memory) if the memory for it cannot be had,
    /// [`Error::Cancelled`](crate::Error::Cancelled), here and below.
    pub(super) fn new(
        exposures: &'m Exposures<'a, T>,
        solution: &Solution<'m>,
        workers: &'m Workers,
        control: &Control,
    ) -> Result<Self> {
        memory::check(joint::bytes_needed_by_covariance(exposures, solution.flux)?, || {
            format!("the uncertainty of {} exposures of {}", exposures.count(), exposures.sensor())
        })?;
        let mut system = problem(exposures, solution, workers, control)?;
        let prior = ShiftPrior::of(exposures.positions());
        let (refined, considered) = parted(solution.refinement, prior);
        system.seek_shifts(refined);
        system.prior = solution.prior.as_ref().map(|weights| {
            let (weights, mean) = (weights.to_vec(), 1.0);
            joint::Prior { weights, mean }
        });
        system.linearise(control)?;
        system.leave_noise_out();
        let preconditioner = Preconditioner::new(&mut system, control)?;
        let determined: Vec<bool> = solution.sensitivity.iter().map(|m| m.is_finite()).collect();
        let pixels = determined.iter().zip(solution.flags);
        let counted: Vec<bool> = pixels
            .map(|(determined, flags)| *determined && flags & flag::UNRELIABLE_FLAT == 0)
            .collect();
        let (valid, scale) = valid(&system, &counted);
        Ok(Self {
            tilts: OnceCell::new(),
            solution: solution.clone(),
            system,
            preconditioner,
            known: Known::with(exposures.least_eigenvalue(solution.flux)),
            x: Vec::new(),
            energy: 0.0,
            considered,
            determined,
            valid,
            scale,
            dark: None,
            incomplete: 0,
        })
    }

    fn tilts(&self) -> Arc<Tilts> {
        let found = || Arc::new(Tilts::of(&self.system, &self.solution, &self.valid));
        Arc::clone(self.tilts.get_or_init(found))
    }

    /// Takes the noise of the dark into account, of these variances. A sought offset takes all of it.
    pub(super) fn set_dark(&mut self, variance: &[f64], control: &Control) -> Result<()> {
        if self.system.pass.with_offset {
            return Ok(());
        }
        self.dark = Some(Dark::of(&mut self.system, variance, control)?);
        Ok(())
    }

    /// What the noise of the dark adds to F, on average; 0 without a dark.
    pub(super) fn misfit_by_dark(&mut self, control: &Control) -> Result<f64> {
        let Some(left) = self.dark.as_ref().map(|dark| dark.left) else { return Ok(0.0) };
        self.known.lowest.forget();
        let propagated = mean_misfit(count(&self.valid), |draw| {
            let slope = self.pulls_of_noise(draw, false, control)?;
            self.apply_inverse(slope, LACK_OF_FUNCTIONAL, control)?;
            Ok(self.energy)
        })?;
        Ok(left - propagated)
    }

    /// The standard deviation of M by pixel, in units of that of a value of weight 1.
    pub(super) fn error_map(&mut self, control: &Control) -> Result<ErrorMap> {
        self.known.lowest.forget();
        let tilts = self.tilts();
        if let Some(dark) = &mut self.dark {
            let propagated: Vec<f64> = dark.propagated().collect();
            let in_gauge = tilts.gauge.diagonal(&propagated);
            dark.in_gauge = in_gauge.map(|variance| (variance / self.scale) as f32).collect();
        }
        let sensor = self.system.pass.exposures.sensor();
        let sampled = if is_smoothed(sensor) {
            smoothed(self, sensor, control)?
        } else {
            Sampled::of(self, control)?
        };
        let std = self.determined.iter().enumerate().map(|(pixel, &determined)| match determined {
            true => (self.scale * sampled.variance(pixel)).sqrt(),
            false => f64::NAN,
        });
        let std = std.collect();
        Ok(sampled.map(std))
    }

    /// The variance of Σ g M of each image g of a stack, in units of that of a value of weight 1.
    pub(super) fn variances(&mut self, functionals: &[f64], control: &Control) -> Result<Vec<f64>> {
        let stack = functionals.chunks_exact(self.valid.len());
        self.variances_of(stack.map(|gain| Functional::Gain(gain.to_vec())), control)
    }

    /// The variances (row, column) of the shifts, if they were refined.
    pub(super) fn shift_variances(&mut self, control: &Control) -> Result<Option<Vec<[f64; 2]>>> {
        if !self.system.seeks_shifts() {
            return Ok(None);
        }
        let count = self.system.pass.exposures.count();
        let functionals = (0..2 * count).map(|index| {
            let mut shifts = vec![[0.0; 2]; count];
            shifts.as_flattened_mut()[index] = 1.0;
            Functional::Shifts(shifts)
        });
        let found = self.variances_of(functionals, control)?;
        Ok(Some(found.as_chunks().0.to_vec()))
    }

    /// The variance of b, the least-squares part b M of the errors of offsets, and the mean variance of
    /// an offset by the noise of its pixel alone, if offsets were sought.
    pub(super) fn offset_variances(&mut self, control: &Control) -> Result<Option<[f64; 2]>> {
        if !self.system.pass.with_offset {
            return Ok(None);
        }
        self.known.lowest.forget();
        let along = self.variance_of(Functional::Offset, LACK_OF_FUNCTIONAL, control)?;
        Ok(Some([along, self.mean_variance_of_offset_alone()]))
    }

    fn variances_of(
        &mut self,
        functionals: impl ExactSizeIterator<Item = Functional>,
        control: &Control,
    ) -> Result<Vec<f64>> {
        self.known.lowest.forget();
        let total = functionals.len() as u64;
        let lack = if self.dark.is_some() { LACK_WITH_DARK } else { LACK_OF_FUNCTIONAL };
        let found = (0..).zip(functionals).map(|(index, functional)| {
            control.report("uncertainty", index, total);
            self.variance_of(functional, lack, control)
        });
        found.collect()
    }

    /// The part of the variance that is known: the diagonal of P D⁻¹ Pᵀ, and what S does not see.
    fn known_part(&self) -> Vec<f32> {
        let mut own = self.own();
        if let Some(dark) = &self.dark {
            own.iter_mut().zip(dark.propagated()).for_each(|(own, propagated)| *own += propagated);
        }
        let tilts = self.tilts();
        let in_gauge = tilts.gauge.diagonal(&own).enumerate();
        let variance = in_gauge.map(|(pixel, mut variance)| {
            if let Some(Hidden { tilts, covariance }) = &tilts.hidden {
                variance += form(covariance, [tilts[0][pixel], tilts[1][pixel]]);
            }
            (variance / self.scale) as f32
        });
        variance.collect()
    }

    /// The change of M, in the gauge, with S x = b − S_d δ where considered shifts are wrong by δ, solved
    /// until it lacks at most this share of x · b.
    fn change(
        &mut self,
        mut slope: Vec<f64>,
        wrong: &[f64],
        lack: f64,
        control: &Control,
    ) -> Result<Vec<f64>> {
        let mut change = vec![0.0; self.valid.len()];
        if self.considered.is_some() {
            let others = self.others();
            let mut moved = vec![0.0; others];
            moved.extend(wrong);
            let pulled = self.considering(|system| {
                let pulled = product(system, &moved, control);
                add_change(system, &mut change);
                pulled
            })?;
            let pulled = slope[..others].iter_mut().zip(pulled);
            pulled.for_each(|(slope, pulled)| *slope -= pulled);
        }
        self.apply_inverse(slope, lack, control)?;
        let x = std::mem::take(&mut self.x);
        if self.system.has_single() {
            let short: Vec<f32> = self.system.step_in(x.clone());
            product(&mut self.system, &short, control)?;
        } else {
            product(&mut self.system, &x, control)?;
        }
        add_change(&self.system, &mut change);
        let (workers, tilts) = (self.system.pass.workers, self.tilts());
        if let Some(drift) = &tilts.drift {
            workers.add_multiple(&mut change, x[self.system.state.beam.len()], drift);
        }
        tilts.gauge.apply(&mut change, workers);
        Ok(change)
    }

    /// What the noise of the dark adds to the variance of a functional, Σ g M or with g = 0 another one,
    /// once S x = its pull is solved.
    fn variance_by_dark(&mut self, gain: &[f64], control: &Control) -> Result<f64> {
        let Some(dark) = &self.dark else { return Ok(0.0) };
        let influence = self.system.propagate_common(&self.x, control)?;
        Ok(dark.variance_of(gain, &influence))
    }

    /// The variance of a functional, in the gauge of the result, solved until it lacks at most this
    /// share of what S has in it. A g must be 0 where M is undetermined.
    fn variance_of(&mut self, functional: Functional, lack: f64, control: &Control) -> Result<f64> {
        match functional {
            Functional::Gain(gain) => self.variance_of_gain(gain, lack, control),
            Functional::Shifts(shifts) => {
                let mut pull = vec![0.0; self.system.size()];
                let own = self.system.centred_pulls(shifts.clone());
                let others = self.others();
                pull[others..].copy_from_slice(own.as_flattened());
                self.apply_inverse(pull, lack, control)?;
                // What was not refined has its prior's variance.
                let kept = self.considered.iter().flat_map(|prior| prior.centred_pulls(&shifts));
                let kept = kept.flatten().zip(self.considered_variances());
                let kept: f64 = kept.map(|(q, v)| q * q * v).sum();
                let no_gain = vec![0.0; self.valid.len()];
                Ok(self.found_variance() + kept + self.variance_by_dark(&no_gain, control)?)
            }
            Functional::Offset => self.variance_of_offset(lack, control),
        }
    }

    fn variance_of_gain(
        &mut self,
        mut gain: Vec<f64>,
        lack: f64,
        control: &Control,
    ) -> Result<f64> {
        let (workers, tilts) = (self.system.pass.workers, self.tilts());
        tilts.gauge.transpose(&mut gain, workers);
        let none = vec![0.0; gain.len()];
        let mut variance = self.own_of(&gain, &none);
        if let Some(Hidden { tilts, covariance }) = &tilts.hidden {
            let heights = [0, 1].map(|axis| workers.dot(&tilts[axis], &gain));
            variance += form(covariance, heights);
        }
        let (pull, seen) = self.pull_of_gain(&gain, control)?;
        let others = self.others();
        self.apply_inverse(pull, lack, control)?;
        variance += self.found_variance() + self.variance_by_dark(&gain, control)?;
        if self.considered.is_some() {
            let mut x = std::mem::take(&mut self.x);
            x.truncate(others);
            x.resize(others + seen.len(), 0.0);
            let pulled = self.considering(|system| product(system, &x, control))?;
            let left = seen.iter().zip(&pulled[others..]).map(|(seen, pulled)| seen - pulled);
            variance += left.zip(self.considered_variances()).map(|(h, v)| h * h * v).sum::<f64>();
        }
        Ok(variance)
    }

    /// Cᵀ g, and what of it considered shifts get, of a functional in the gauge.
    fn pull_of_gain(&mut self, gain: &[f64], control: &Control) -> Result<(Vec<f64>, Vec<f64>)> {
        let cells = self.system.state.beam.len();
        let (others, none) = (self.others(), vec![0.0; gain.len()]);
        let mut pull = pull_of(&mut self.system, gain, &none, control)?;
        if let Some(drift) = &self.tilts().drift {
            pull[cells] += self.system.pass.workers.dot(drift, gain);
        }
        let seen = if self.considered.is_some() {
            let all = self.considering(|system| pull_of(system, gain, &none, control))?;
            all[others..].to_vec()
        } else {
            Vec::new()
        };
        Ok((pull, seen))
    }

    /// With h = M/Σ M² the variance of Σ h O.
    ///
    /// Where L is almost the same at the positions of a pixel, and fluxes c are fitted, O → O + b M
    /// is met by L → L − b/c with other c, and no iteration finds that direction. So the search
    /// starts from the best multiple of it: x = (rᵀv/vᵀSv) v for v of
    ///
    /// ```text
    /// δL = −mean(1/c),   δ ln c = (−1/c − δL)/L
    /// ```
    fn variance_of_offset(&mut self, lack: f64, control: &Control) -> Result<f64> {
        let [mut offset, _] = self.system.pixels();
        offset.iter_mut().zip(&self.valid).for_each(|(m, valid)| *m *= f64::from(*valid));
        let square: f64 = offset.iter().map(|m| m * m).sum();
        offset.iter_mut().for_each(|m| *m /= square);
        let none = vec![0.0; offset.len()];
        let variance = self.own_of(&none, &offset);
        let mut pull = pull_of(&mut self.system, &none, &offset, control)?;
        let system = &mut self.system;
        let (flux, workers) = (&system.pass.flux, system.pass.workers);
        let light = workers.dot(&system.weights, &system.state.beam) / system.total_weight();
        let of_beam = -flux.iter().map(|c| 1.0 / c).sum::<f64>() / flux.len() as f64;
        let logs: Vec<f64> = flux.iter().map(|c| (-1.0 / c - of_beam) / light).collect();
        let mut along: Vec<f64> =
            system.weights.iter().map(|w| if *w > 0.0 { of_beam } else { 0.0 }).collect();
        along.extend(system.fluxes.sought(&logs));
        along.resize(pull.len(), 0.0);
        let pulled = product(system, &along, control)?;
        let (size, height) = (workers.dot(&along, &pulled), workers.dot(&along, &pull));
        let mut found = 0.0;
        if size > 0.0 {
            found = height * height / size;
            workers.add_multiple(&mut pull, -height / size, &pulled);
        }
        self.apply_inverse(pull, lack, control)?;
        Ok(variance + found + self.found_variance())
    }

    /// How many unknowns come before the shifts.
    fn others(&self) -> usize {
        self.system.state.beam.len() + self.system.fluxes.columns.len()
    }

    fn considered_variances(&self) -> Vec<f64> {
        let prior = self.considered.iter().flat_map(|prior| prior.precisions.as_flattened());
        prior.map(|precision| 1.0 / (self.system.unit * precision)).collect()
    }

    /// Does something with the system as if the considered shifts were sought too.
    fn considering<R>(&mut self, work: impl FnOnce(&mut System<'m, 'a, T>) -> R) -> R {
        let own = self.system.seek_shifts(self.considered.take());
        let result = work(&mut self.system);
        self.considered = self.system.seek_shifts(own);
        result
    }

    /// xᵀ S x at the x that the search found.
    fn found_variance(&self) -> f64 {
        self.energy + self.system.left_out(&self.x)
    }

    /// Finds x = (S − N)⁻¹ b and x · b.
    fn apply_inverse(&mut self, b: Vec<f64>, lack: f64, control: &Control) -> Result<()> {
        // Rounding leaves a lack of some 1e-7 in single precision.
        if self.system.has_single() && lack >= LACK_OF_DRAW {
            self.search::<f32>(b, lack, control)
        } else {
            self.search::<f64>(b, lack, control)
        }
    }

    /// [`apply_inverse`](Self::apply_inverse) in numbers of this precision.
    fn search<N: Precision>(&mut self, b: Vec<f64>, lack: f64, control: &Control) -> Result<()> {
        let mut search = ConjugateGradients::<N>::after(self.known.clone());
        let done = self.iterate(&mut search, b, lack, control);
        self.energy = self.system.unit_of_other_slopes::<N>() * search.energy;
        let (x, known) = search.found();
        self.x = self.system.step_of(x);
        self.known = known;
        done
    }

    fn iterate<N: Precision>(
        &mut self,
        search: &mut ConjugateGradients<N>,
        b: Vec<f64>,
        lack: f64,
        control: &Control,
    ) -> Result<()> {
        let Self { system, preconditioner, .. } = self;
        search.begin(system, preconditioner, b, control)?;
        let (first, mut earlier) = (search.square, 0.0);
        let is_complete = |search: &ConjugateGradients<N>| {
            search.known.lowest.is_complete(search.square, lack * search.energy)
        };
        for iteration in 1..=MOST_ITERATIONS {
            search.product(system, control)?;
            let goes_on = search.step(system, preconditioner, control)?;
            let left = search.square / search.known.lowest.found();
            if iteration >= FEWEST_ITERATIONS && left <= lack * search.energy {
                return Ok(());
            }
            if !goes_on {
                // A b that is rounding has no solution at all.
                self.incomplete += u64::from(iteration > 1 && !is_complete(search));
                return Ok(());
            }
            if iteration % FEWEST_ITERATIONS == 0 {
                if is_complete(search) && search.energy - earlier <= NOTHING * lack * search.energy
                {
                    break;
                }
                earlier = search.energy;
            }
        }
        // Rounding may leave a Ritz value next to 0, but then the residual is rounding too.
        self.incomplete +=
            u64::from(search.square > NOTHING * lack * first || !is_complete(search));
        Ok(())
    }

    /// Searches that ended before their answer was as exact as it should be.
    pub(super) const fn incomplete(&self) -> u64 {
        self.incomplete
    }

    /// D⁻¹ of each pixel's M.
    fn own(&self) -> Vec<f64> {
        let mut own = Vec::with_capacity(self.valid.len());
        self.system.pass.for_rows(|[_, inverse, ..]| own.extend_from_slice(inverse));
        own
    }

    /// The mean variance of an offset, by what noise does to its pixel alone.
    fn mean_variance_of_offset_alone(&self) -> f64 {
        let mut variances = Vec::with_capacity(self.valid.len());
        self.system.pass.for_rows(|[.., inverse]| variances.extend_from_slice(inverse));
        let count = count(&self.valid);
        variances.iter().zip(&self.valid).map(|(v, valid)| v * f64::from(*valid)).sum::<f64>()
            / count
    }

    /// The variance of Σ g M + Σ h O of what noise does to each pixel alone.
    fn own_of(&self, gain: &[f64], offset: &[f64]) -> f64 {
        let (mut variance, mut first) = (0.0, 0);
        self.system.pass.for_rows(|[_, gains, _, _, mixed, offsets]| {
            for (a, g) in gains.iter().zip(&gain[first..]) {
                variance += a * g * g;
            }
            for (col, (b, c)) in mixed.iter().zip(offsets).enumerate() {
                let (g, h) = (gain[first + col], offset[first + col]);
                variance += 2.0 * b * g * h + c * h * h;
            }
            first += gains.len();
        });
        variance
    }
}

/// The part of the prior on shifts that were refined, and the part along which they were not.
fn parted(
    refinement: Refinement,
    prior: Option<ShiftPrior>,
) -> (Option<ShiftPrior>, Option<ShiftPrior>) {
    let along = |[row, col]: [f64; 2]| {
        prior.clone().map(|prior| ShiftPrior { along: Some([row, col]), ..prior })
    };
    match refinement {
        Refinement::Done => (prior, None),
        Refinement::Along([row, col]) => (along([row, col]), along([-col, row])),
        _ => (None, prior),
    }
}

/// The problem at a solution.
fn problem<'m, 'a, T: Real>(
    exposures: &'m Exposures<'a, T>,
    solution: &Solution<'_>,
    workers: &'m Workers,
    control: &Control,
) -> Result<System<'m, 'a, T>> {
    let (grid, positions) = (Grid::of(exposures)?, exposures.positions());
    let shifts = positions.on_grid(solution.shifts);
    let fluxes = Fluxes::of(exposures, solution.flux, &shifts, &grid);
    let beam = solution.beam.coefficients.unwrap_or(solution.beam.values);
    let known = |value: &f64| if value.is_finite() { *value } else { 0.0 };
    let state = State {
        beam: beam.iter().map(known).collect(),
        theta: vec![0.0; fluxes.columns.len()],
        shifts,
    };
    let mut system = System::new(exposures, grid, fluxes, state, workers, control)?;
    system.unit = solution.unit;
    Ok(system)
}

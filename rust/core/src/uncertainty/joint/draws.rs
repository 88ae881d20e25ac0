//! Draws of what noise, and what priors leave open, do to a joint fit.

use super::JointCovariance;
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::joint::Propagate;
use crate::random::{self, Streams};
use crate::uncertainty::joint_pulls::{pull_by, pull_of, variance_by_cells};
use crate::uncertainty::sampling::{Drawn, LACK_OF_DRAW};
use crate::uncertainty::smoothed::{Change, Smooth};

/// What is drawn besides the noise of exposures.
pub(super) enum Other {
    Penalty,
    Priors,
    Shifts,
}
/// How many of them there are.
const OTHERS: usize = 3;

impl<T: Real> JointCovariance<'_, '_, T> {
    /// The change of M in one draw, in the units of the map.
    fn drawn_change(&mut self, draw: u64, control: &Control) -> Result<Change> {
        let slope = self.draw(draw, control)?;
        let mut sign = self.other_signs(draw, Other::Shifts);
        let variances = self.considered_variances().into_iter();
        let wrong: Vec<f64> = variances.map(|variance| sign() * variance.sqrt()).collect();
        let mut sampled = self.change(slope, &wrong, LACK_OF_DRAW, control)?;
        let mut propagated = Vec::new();
        if let Some(dark) = &self.dark {
            propagated = dark.propagate(draw, self.system.pass.exposures.sensor());
            self.tilts().gauge.apply(&mut propagated, self.system.pass.workers);
        }
        let unit = self.scale.sqrt();
        sampled.iter_mut().chain(&mut propagated).for_each(|change| *change /= unit);
        Ok(Change { sampled, propagated })
    }

    /// A b of covariance S: Jᵀ w Q ε + √τ Pᵀ Gᵀ s + √π s for noise ε of variance 1/w and signs s.
    pub(super) fn draw(&mut self, draw: u64, control: &Control) -> Result<Vec<f64>> {
        let mut slope = self.pulls_of_noise(draw, true, control)?;
        self.add_draw_of_prior(draw, &mut slope, control)?;
        let mut of_penalty = self.other_signs(draw, Other::Penalty);
        let mut of_priors = self.other_signs(draw, Other::Priors);
        let system = &mut self.system;
        let cells = system.state.beam.len();
        if let Some(penalty) = &system.penalty {
            let beam = &system.state.beam;
            let (scale, slope) = (&system.scale, &mut slope[..cells]);
            penalty.add_draw(beam, scale, &mut of_penalty, slope, system.pass.workers);
        }
        let params = system.fluxes.columns.len();
        let mut pulls = system.precisions();
        pulls.iter_mut().for_each(|precision| *precision = precision.sqrt() * of_priors());
        let of_shifts = system.centred_pulls(pulls.split_off(params).as_chunks().0.to_vec());
        let priors = pulls.iter().chain(of_shifts.as_flattened());
        slope[cells..].iter_mut().zip(priors).for_each(|(slope, pull)| *slope += pull);
        Ok(slope)
    }

    /// Adds what a draw of the prior of M pulls at the other unknowns.
    fn add_draw_of_prior(&mut self, draw: u64, slope: &mut [f64], control: &Control) -> Result<()> {
        let Some(prior) = &self.system.prior else { return Ok(()) };
        let sensor = self.system.pass.exposures.sensor();
        let rows = prior.weights.chunks_exact(sensor.cols).enumerate();
        let gain = rows.flat_map(|(row, weights)| {
            let mut sign = random::signs_of_prior(draw, row, sensor.rows);
            weights.iter().map(move |weight| weight.sqrt() * sign())
        });
        let gain: Vec<f64> = gain.collect();
        let none = vec![0.0; gain.len()];
        let pulls = pull_of(&mut self.system, &gain, &none, control)?;
        slope.iter_mut().zip(pulls).for_each(|(slope, pull)| *slope += pull);
        Ok(())
    }

    /// Jᵀ w Q of noise ε of variance 1/w, if that is drawn, and of the dark's noise.
    pub(super) fn pulls_of_noise(
        &mut self,
        draw: u64,
        of_each: bool,
        control: &Control,
    ) -> Result<Vec<f64>> {
        let streams: Vec<u64> =
            (0..self.system.pass.exposures.count()).map(|k| self.stream(draw, k, 0)).collect();
        let Self { system, dark, .. } = self;
        let sensor = system.pass.exposures.sensor();
        pull_by(system, control, |pass, row_index, row, workspace| {
            let cols = pass.exposures.sensor().cols;
            let errors = dark.iter().flat_map(|dark| dark.errors(draw, row_index, sensor));
            let errors: Vec<f64> = errors.collect();
            let (light, weights, values, sums) = workspace.parts();
            for (k, (weights, flux)) in weights.chunks_exact(cols).zip(&pass.flux).enumerate() {
                let mut sign = random::signs(streams[k] + row_index as u64);
                let pixels = weights.iter().zip(&*row.sensitivity);
                let values = values.of_mut(k);
                for (value, (weight, m)) in values.iter_mut().zip(pixels) {
                    // As a change of the light, which a pixel without response does not show.
                    let response = weight.sqrt() * flux * m;
                    *value = if response == 0.0 || !of_each { 0.0 } else { sign() / response };
                }
                for ((value, error), m) in values.iter_mut().zip(&errors).zip(&*row.sensitivity) {
                    let response = flux * m;
                    *value += if response == 0.0 { 0.0 } else { error / response };
                }
            }
            let fluxes = &pass.flux[..];
            let propagate = Propagate { row, fluxes, light, weights, values, sums, share: 0.0 };
            pulp::Arch::new().dispatch(propagate);
        })
    }

    /// The number of a stream of signs: of a row of an exposure, or behind those of what else is drawn.
    pub(super) fn stream(&self, draw: u64, exposure: usize, row: usize) -> u64 {
        let exposures = self.system.pass.exposures;
        let streams = Streams::new(exposures.count() + OTHERS, exposures.sensor().rows);
        streams.number(draw, exposure, row)
    }

    /// The stream of signs for what else is drawn.
    pub(super) fn other_signs(&self, draw: u64, which: Other) -> impl FnMut() -> f64 + use<T> {
        random::signs(self.stream(draw, self.system.pass.exposures.count() + which as usize, 0))
    }
}

impl<T: Real> Drawn for JointCovariance<'_, '_, T> {
    fn valid(&self) -> &[f32] {
        &self.valid
    }

    fn known(&mut self, _: &Control) -> Result<Vec<f32>> {
        Ok(self.known_part())
    }

    fn propagated(&self) -> &[f32] {
        self.dark.as_ref().map_or(&[], |dark| &dark.in_gauge)
    }

    fn add_draw(&mut self, draw: u64, squares: &mut [f32], control: &Control) -> Result<()> {
        let Change { sampled, propagated } = self.drawn_change(draw, control)?;
        for (square, change) in squares.iter_mut().zip(&sampled) {
            *square += (change * change) as f32;
        }
        for ((square, change), propagated) in squares.iter_mut().zip(&sampled).zip(&propagated) {
            *square += (2.0 * change * propagated) as f32;
        }
        Ok(())
    }
}

impl<T: Real> Smooth for JointCovariance<'_, '_, T> {
    fn known(&mut self, _: &Control) -> Result<Vec<f32>> {
        Ok(self.known_part())
    }

    /// Σ_k (D⁻¹ w e c M)² V with the variance V of the beam's cells by themselves: what they do to M.
    fn local(&mut self, control: &Control) -> Result<Vec<f64>> {
        let mut local = variance_by_cells(&mut self.system, control)?;
        for (local, valid) in local.iter_mut().zip(&self.valid) {
            *local *= f64::from(*valid) / self.scale;
        }
        Ok(local)
    }

    fn propagated(&self) -> &[f32] {
        Drawn::propagated(self)
    }

    fn change(&mut self, draw: u64, control: &Control) -> Result<Change> {
        self.drawn_change(draw, control)
    }
}

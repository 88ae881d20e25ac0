//! Weak light in a joint fit: R, the information that decides on the prior of M, and the noise.

use std::sync::Arc;

use super::outcome::freedom;
use super::system::System;
use super::unknowns;
use crate::connectivity::NONE;
use crate::control::Control;
use crate::error::Result;
use crate::exposures::{Exposures, Stretch};
use crate::frames::{Real, Shape};
use crate::parallel::Value;
use crate::sweep::Estimate;
use crate::weak_light::{self, Prior, Problem};

/// Rows and columns whose residuals are sampled.
const SAMPLED: usize = 64;

impl<T: Real> Problem<T> for System<'_, '_, T> {
    fn exposures(&self) -> &Exposures<'_, T> {
        self.pass.exposures
    }

    fn variance(&self, _: &mut Option<usize>, freed: f64, _: &Control) -> Result<Option<f64>> {
        Ok(self.noise(freedom(self), freed))
    }

    fn range(&mut self, _: &Control) -> Result<[f64; 2]> {
        let square = self.mean * self.mean;
        Ok(weak_light::range(&self.information()).map(|d| d * square))
    }

    fn first_information(&self, control: &Control) -> Result<Vec<f64>> {
        Estimate::first_information(self.pass.exposures, self.pass.workers, control)
    }

    fn pieces(&self, information: &[f64], _: &Control) -> Result<Arc<[i32]>> {
        let piece = |d: &f64| if *d > 0.0 { 0 } else { NONE };
        Ok(information.iter().map(piece).collect())
    }

    fn take(&mut self, prior: Option<Prior>) -> bool {
        let mean = self.mean;
        self.prior = prior.map(|prior| {
            let mut weights: Vec<f64> = prior.weights.iter().map(|w| w / (mean * mean)).collect();
            self.pass.few.lost_pixels.iter().for_each(|&pixel| weights[pixel] = 0.0);
            unknowns::Prior { weights, mean }
        });
        true
    }
}

impl<T: Real> System<'_, '_, T> {
    /// R = Σ λ (M − μ)².
    pub(super) fn misfit_of_prior(&self) -> f64 {
        let Some(prior) = &self.prior else { return 0.0 };
        let (mut weights, mut total) = (prior.weights.iter(), 0.0);
        self.pass.for_rows(|[sensitivity, ..]| {
            for (m, weight) in sensitivity.iter().zip(weights.by_ref()) {
                total += weight * (m - prior.mean).powi(2);
            }
        });
        total
    }

    /// D of each pixel without the prior; 0 without a measurement that the search uses.
    pub(crate) fn information(&self) -> Vec<f64> {
        let mut information = Vec::with_capacity(self.pass.exposures.sensor().len());
        self.pass.for_rows(|[_, inverse, ..]| {
            information.extend(inverse.iter().map(|&i| if i > 0.0 { 1.0 / i } else { 0.0 }));
        });
        for (d, own) in information.iter_mut().zip(self.prior.iter().flat_map(|p| &p.weights)) {
            *d = (*d - own).max(0.0);
        }
        for (row, information) in
            information.chunks_exact_mut(self.pass.exposures.sensor().cols).enumerate()
        {
            self.pass.few.clear(row, information);
        }
        information
    }

    /// The variance of a measurement of weight 1 from a sample of residuals, with so many degrees of
    /// freedom and `freed` unknowns left to a prior; `None` with nearly none.
    pub(crate) fn noise(&self, freedom: f64, freed: f64) -> Option<f64> {
        let Shape { rows, cols } = self.pass.exposures.sensor();
        let count = self.pass.exposures.count();
        let (mut squares, mut scratch) = (Vec::new(), vec![0.0; cols]);
        let (beams, mut workspace) = (self.pass.views_of(&self.state.beam), self.pass.workspace());
        for row in (0..rows).step_by(rows.div_ceil(SAMPLED)) {
            let known = self.pass.row(row);
            let part = |index: usize| known.get(index * cols..(index + 1) * cols);
            let (sensitivity, offset) = (part(0), part(3));
            self.pass.see_beam(&beams, row, &mut workspace);
            for k in 0..count {
                let measured = self.pass.exposures.stretch(k, row, 0..cols, &mut scratch);
                for col in (0..cols).step_by(cols.div_ceil(SAMPLED)) {
                    let (value, weight) = match &measured {
                        Stretch::Uniform(values, weight) => (values[col], *weight),
                        Stretch::Weighted(values, weights) => (values[col], weights[col]),
                    };
                    let at = |part: Option<&[f64]>| part.map_or(0.0, |part| part[col]);
                    let light = workspace.light[k * cols + col];
                    let left = value.to_f64() - light * at(sensitivity) - at(offset);
                    let is_used = weight > 0.0 && self.pass.few.uses(k, row, col);
                    if is_used && at(part(1)) > 0.0 {
                        squares.push(weight * left * left);
                    }
                }
            }
        }
        weak_light::variance(squares, self.used(), freedom, freed)
    }

    /// Takes the mean of M over lit pixels as that of the prior, which in a joint fit is held between steps;
    /// in weak light M may be noise before it has a prior.
    pub(crate) fn renew_mean(&mut self) {
        let Some(mut prior) = self.prior.take() else { return };
        let (mut sum, mut count, mut weights) = (0.0, 0_usize, prior.weights.iter());
        self.pass.for_rows(|[sensitivity, inverse, ..]| {
            for ((m, inverse), weight) in sensitivity.iter().zip(inverse).zip(weights.by_ref()) {
                if *inverse > 0.0 && *weight == 0.0 {
                    (sum, count) = (sum + m, count + 1);
                }
            }
        });
        let mean = if count > 0 { sum / count as f64 } else { self.mean };
        let change = (prior.mean / mean).powi(2);
        prior.weights.iter_mut().for_each(|weight| *weight *= change);
        prior.mean = mean;
        self.prior = Some(prior);
    }

    /// A prior of M pulls at the multiple of the beam, which is held: what pulls at cells is without that.
    pub(super) fn balance<N: Value>(&self, pull: &mut [N]) {
        if self.prior.is_some() {
            let [light, _] = self.ordinary;
            let multiple = self.pass.workers.dot(&self.state.beam, pull) / light;
            self.pass.workers.add_multiple(pull, -multiple, &self.scale);
        }
    }
}

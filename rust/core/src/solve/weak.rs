//! Where light is weak: the noise that decides it, and the prior of M there.
//!
//! λ follows from D at the first beam, that of equal pixels, and from the variance σ² of a measurement of unit
//! weight, so all methods have the same. σ² is that of residuals, rounded up to a power of 2. It only falls as the
//! fit goes on, and λ with it, so that F + R never rises.

use std::sync::Arc;

use crate::connectivity::{Components, NONE, Tie};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::joint::{self, System};
use crate::memory;
use crate::parallel::Workers;
use crate::prior::{self, LIT, Prior};
use crate::reduced::ConjugateGradients;
use crate::sweep::Estimate;

/// D of the faintest pixel that single precision serves, as a share of a bright pixel's: fainter ones have a
/// prior even without noise.
const FAINTEST: f64 = 1e-24;
/// A variance of this share of the stated one, or less, contradicts it: there is no noise.
const CONTRADICTED: f64 = 0.1;
/// How much D changes at most from the first beam on.
const CHANGE: f64 = 4.0;
/// Bytes for each pixel and each cell that the prior takes at its fullest: D, λ, pieces, λ in the linear problem,
/// and the first M and L with the light of one exposure.
const BYTES: [u64; 2] = [40, 8];

/// D at the first beam and the piece of connected pixels of each pixel.
struct First {
    information: Vec<f64>,
    pieces: Arc<[i32]>,
}

/// The prior while it is sought.
pub(crate) struct WeakLight {
    /// The variance of a measurement of weight 1, as the last residuals show it.
    noise: f64,
    /// σ² of the prior.
    variance: f64,
    first: Option<First>,
    /// How many unknowns the data leave to the prior.
    pub(super) freed: f64,
}

impl WeakLight {
    pub(super) const fn new() -> Self {
        Self { noise: 0.0, variance: f64::INFINITY, first: None, freed: 0.0 }
    }

    /// Takes this noise; whether σ² falls.
    fn hears<T: Real>(&mut self, exposures: &Exposures<'_, T>, noise: f64) -> bool {
        let as_stated = exposures.variance_is_known() && noise >= CONTRADICTED;
        self.noise = if as_stated { 1.0 } else { noise };
        self.noise.log2().ceil().exp2() < self.variance
    }

    /// The prior, if it is another one; `range` is the least D and that of a bright pixel.
    fn decide<T: Real>(
        &mut self,
        exposures: &Exposures<'_, T>,
        [least, bright]: [f64; 2],
        pieces: impl FnOnce(&[f64]) -> Result<Arc<[i32]>>,
        workers: &Workers,
        control: &Control,
    ) -> Result<Option<Option<Prior>>> {
        let variance = self.noise.max(FAINTEST * bright / LIT).log2().ceil().exp2();
        // Neither holds where there is no light at all, and no number.
        let falls = variance < self.variance;
        if falls {
            self.variance = variance;
        }
        let is_weak = self.first.is_some() || least < CHANGE * LIT * variance;
        if !falls || !is_weak {
            return Ok(None);
        }
        let first = match self.first.take() {
            Some(first) => first,
            None => First::of(exposures, pieces, workers, control)?,
        };
        let pixels = first.information.iter().zip(&*first.pieces);
        let weight =
            |(&d, &piece): (&f64, &i32)| if piece < 0 { 0.0 } else { prior::weight(d, variance) };
        let weights: Arc<[f64]> = pixels.map(weight).collect();
        self.freed = prior::freed(&weights, &first.information, variance, 0.0);
        let pieces = Arc::clone(&first.pieces);
        self.first = Some(first);
        let some = weights.iter().any(|&weight| weight > 0.0);
        Ok(Some(some.then(|| Prior::new(weights, pieces))))
    }

    /// Gives an estimate, whose beam is up to date, the prior that follows from it; whether it has changed.
    pub(super) fn update<T: Real>(
        &mut self,
        estimate: &mut Estimate<'_, '_, T>,
        search: &mut ConjugateGradients<'_, '_, T>,
        control: &Control,
    ) -> Result<bool> {
        let exposures = search.reduced.exposures;
        if !self.hears(exposures, estimate.variance(self.freed)) {
            return Ok(false);
        }
        if search.reduced.range == [0.0; 2] {
            search.reduced.linearise(&estimate.sensitivity, estimate.beams(), None, control)?;
        }
        let connected = |_: &[f64]| {
            let ties = vec![Tie::Firm; exposures.sensor().len()];
            Ok(Components::of(exposures, &ties, control)?.pixels.into())
        };
        let (range, workers) = (search.reduced.range, search.workers());
        let found = self.decide(exposures, range, connected, workers, control)?;
        let Some(prior) = found else { return Ok(false) };
        estimate.prior = prior;
        search.renew();
        Ok(true)
    }

    /// Gives a joint problem the prior that follows from its state; whether it has changed.
    pub(super) fn update_joint<T: Real>(
        &mut self,
        system: &mut System<'_, '_, T>,
        control: &Control,
    ) -> Result<bool> {
        let exposures = system.pass.exposures;
        let noise = system.variance(joint::freedom(system) + self.freed);
        if !self.hears(exposures, noise) {
            return Ok(false);
        }
        let connected = |information: &[f64]| {
            let piece = |d: &f64| if *d > 0.0 { 0 } else { NONE };
            Ok(information.iter().map(piece).collect())
        };
        let (range, workers) = (prior::range(&system.information()), system.pass.workers);
        let found = self.decide(exposures, range, connected, workers, control)?;
        let Some(prior) = found else { return Ok(false) };
        let mean = system.mean;
        system.prior = prior.map(|prior| joint::Prior {
            weights: prior.weights.iter().map(|weight| weight / (mean * mean)).collect(),
            mean,
        });
        Ok(true)
    }

    /// The pixels of a result that the prior holds, and how many unknowns the data leave to it.
    pub(super) fn held(
        &self,
        weights: &[f64],
        information: &[f64],
        sensitivity: &[f64],
        mean: f64,
    ) -> (Vec<usize>, f64) {
        let scatter = prior::scatter(weights, sensitivity, mean);
        let freed = prior::freed(weights, information, self.noise, scatter);
        (prior::held(weights, information, self.noise), freed)
    }
}

impl First {
    fn of<T: Real>(
        exposures: &Exposures<'_, T>,
        pieces: impl FnOnce(&[f64]) -> Result<Arc<[i32]>>,
        workers: &Workers,
        control: &Control,
    ) -> Result<Self> {
        let sizes = [exposures.sensor().len() as u64, exposures.geometry().beam.len() as u64];
        memory::check(BYTES[0] * sizes[0] + BYTES[1] * sizes[1], || {
            format!("weak light in {} exposures of {}", exposures.count(), exposures.sensor())
        })?;
        let information = Estimate::first_information(exposures, workers, control)?;
        let pieces = pieces(&information)?;
        Ok(Self { information, pieces })
    }
}

/// A sweep of coordinate descent; returns F + R before it where there is a prior, else F after it.
pub(super) fn sweep<T: Real>(
    estimate: &mut Estimate<'_, '_, T>,
    search: &mut ConjugateGradients<'_, '_, T>,
    control: &Control,
) -> Result<f64> {
    if estimate.prior.is_none() {
        return estimate.sweep(control);
    }
    let slope = search.reduced.scale.slope();
    let objective = estimate.slopes(slope, &mut search.residual, control)?;
    let (m, prior) = (&estimate.sensitivity, estimate.prior.as_ref());
    search.reduced.linearise(m, estimate.beams(), prior, control)?;
    search.sweep_step();
    estimate.advance(&search.x, 1.0);
    Ok(objective)
}

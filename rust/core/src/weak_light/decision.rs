//! Where light is weak: the noise that decides it, and the prior of M there.
//!
//! λ follows from D at the first beam, that of equal pixels but for bright ones, and from the variance σ² of a
//! measurement of unit weight. σ² is that of residuals, rounded up to a power of 2: methods that see nearly the
//! same residuals have the same λ, unless σ² is next to such a power. It only falls as the fit goes on, and λ
//! with it, so that F + R never rises.

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
use crate::sweep::{Estimate, Plain};

/// D of the faintest pixel that single precision serves, as a share of a bright pixel's: fainter ones have a
/// prior even without noise.
const FAINTEST: f64 = 1e-24;
/// How much D changes at most from the first beam on.
const CHANGE: f64 = 4.0;
/// Bytes for each pixel and each cell of each view that the first D takes: D, M and L.
const BYTES: [u64; 2] = [16, 8];
/// Bytes that a prior takes likewise: λ, λ in the units of the search and pieces; and the components that these
/// are (`connectivity.rs`).
const BYTES_OF_PRIOR: [u64; 2] = [16 + 22, 13];

/// The prior while it is sought.
pub(crate) struct WeakLight {
    /// The variance of a measurement of weight 1, as the last residuals show it.
    noise: f64,
    /// σ² of the prior.
    variance: f64,
    /// D at the first beam, once light may be weak.
    first: Option<Vec<f64>>,
    /// How many pixels have a measurement, once they are counted.
    pixels: Option<usize>,
    /// The piece of connected pixels of each pixel, once one has a prior.
    pieces: Option<Arc<[i32]>>,
    /// How many unknowns the data leave to the prior.
    pub(super) freed: f64,
}

impl WeakLight {
    pub(super) const fn new() -> Self {
        Self {
            noise: 0.0,
            variance: f64::INFINITY,
            first: None,
            pixels: None,
            pieces: None,
            freed: 0.0,
        }
    }

    /// Takes this noise, if residuals show any; whether σ² falls.
    fn hears<T: Real>(&mut self, exposures: &Exposures<'_, T>, noise: Option<f64>) -> bool {
        let most = if exposures.variance_is_known() { 1.0 } else { f64::INFINITY };
        self.noise = noise.unwrap_or(0.0).min(most);
        rounded_up(self.noise) < self.variance
    }

    /// σ² that this noise makes, D of a bright pixel being given.
    fn sought(&self, bright: f64) -> f64 {
        rounded_up(self.noise.max(FAINTEST * bright / LIT))
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
        let variance = self.sought(bright);
        // Neither holds where there is no light at all, and no number.
        let falls = variance < self.variance;
        if falls {
            self.variance = variance;
        }
        let is_weak = self.first.is_some() || may_be_weak(least, variance);
        if !falls || !is_weak {
            return Ok(None);
        }
        let information = match self.first.take() {
            Some(information) => information,
            None => first_information(exposures, workers, control)?,
        };
        control.check()?;
        let weights = prior::weights(&information, variance);
        control.check()?;
        self.freed = prior::freed(&weights, &information, variance, 0.0);
        let prior = if weights.iter().any(|&weight| weight > 0.0) {
            check_memory(exposures, BYTES_OF_PRIOR)?;
            let found = self.pieces.take().map_or_else(|| pieces(&information), Ok)?;
            self.pieces = Some(Arc::clone(&found));
            Some(Prior::new(weights, found))
        } else {
            None
        };
        self.first = Some(information);
        Ok(Some(prior))
    }

    /// Whether residuals are so large, or light so weak, that some pixels may need a prior.
    pub(super) fn may_be<T: Real>(
        &mut self,
        estimate: &Estimate<'_, '_, T>,
        search: &ConjugateGradients<'_, '_, T>,
        control: &Control,
    ) -> Result<bool> {
        let exposures = search.reduced.exposures;
        let pixels = self.count(exposures, control)?;
        self.hears(exposures, estimate.variance(pixels, self.freed));
        let [least, bright] = search.reduced.information_range();
        Ok(may_be_weak(least, self.sought(bright)))
    }

    /// How many pixels have a measurement.
    fn count<T: Real>(&mut self, exposures: &Exposures<'_, T>, control: &Control) -> Result<usize> {
        let pixels = match self.pixels {
            Some(pixels) => pixels,
            None => exposures.measured_pixels(control)?,
        };
        self.pixels = Some(pixels);
        Ok(pixels)
    }

    /// Gives an estimate, whose beam is up to date, the prior that follows from it; whether it has changed.
    pub(super) fn update<T: Real>(
        &mut self,
        estimate: &mut Estimate<'_, '_, T>,
        search: &mut ConjugateGradients<'_, '_, T>,
        control: &Control,
    ) -> Result<bool> {
        let exposures = search.reduced.exposures;
        let pixels = self.count(exposures, control)?;
        if !self.hears(exposures, estimate.variance(pixels, self.freed)) {
            return Ok(false);
        }
        if search.reduced.range == [0.0; 2] {
            search.reduced.linearise(&estimate.sensitivity, estimate.beams(), None, control)?;
        }
        let connected = |_: &[f64]| {
            let ties = vec![Tie::Firm; exposures.sensor().len()];
            Ok(Components::of(exposures, &ties, control)?.pixels.into())
        };
        let (range, workers) = (search.reduced.information_range(), search.workers());
        let found = self.decide(exposures, range, connected, workers, control)?;
        let Some(prior) = found else { return Ok(false) };
        if prior.is_none() && estimate.prior.is_none() {
            return Ok(false);
        }
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
        let noise = system.variance(joint::freedom(system), self.freed);
        if !self.hears(exposures, noise) {
            return Ok(false);
        }
        let connected = |information: &[f64]| {
            let piece = |d: &f64| if *d > 0.0 { 0 } else { NONE };
            Ok(information.iter().map(piece).collect())
        };
        let square = system.mean * system.mean;
        let (range, workers) = (prior::range(&system.information()), system.pass.workers);
        let range = range.map(|d| d * square);
        let found = self.decide(exposures, range, connected, workers, control)?;
        let Some(prior) = found else { return Ok(false) };
        let mean = system.mean;
        system.prior = prior.map(|prior| {
            let mut weights: Vec<f64> = prior.weights.iter().map(|w| w / (mean * mean)).collect();
            system.pass.few.lost_pixels.iter().for_each(|&pixel| weights[pixel] = 0.0);
            joint::Prior { weights, mean }
        });
        Ok(true)
    }

    /// The pixels of a result of this mean that the prior holds, and how many unknowns the data leave to it.
    pub(super) fn held(
        &self,
        weights: &[f64],
        mut information: Vec<f64>,
        sensitivity: &[f64],
        mean: f64,
    ) -> (Vec<usize>, f64) {
        information.iter_mut().for_each(|d| *d *= mean * mean);
        let scatter = prior::scatter(weights, sensitivity, mean);
        let freed = prior::freed(weights, &information, self.noise, scatter);
        (prior::held(weights, &information, self.noise), freed)
    }
}

/// The next power of 2.
fn rounded_up(variance: f64) -> f64 {
    variance.log2().ceil().exp2()
}

/// Whether the least D may need a prior, or may have needed one at the first beam.
fn may_be_weak(least: f64, variance: f64) -> bool {
    least < CHANGE * LIT * variance
}

/// D at the first beam.
fn first_information<T: Real>(
    exposures: &Exposures<'_, T>,
    workers: &Workers,
    control: &Control,
) -> Result<Vec<f64>> {
    check_memory(exposures, BYTES)?;
    Estimate::first_information(exposures, workers, control)
}

/// Whether there are so many bytes for each pixel and each cell of each view.
fn check_memory<T: Real>(exposures: &Exposures<'_, T>, bytes: [u64; 2]) -> Result<()> {
    let cells: usize = exposures.geometry().views.iter().map(|view| view.shape.len()).sum();
    let needed = bytes[0] * exposures.sensor().len() as u64 + bytes[1] * cells as u64;
    memory::check(needed, || {
        format!("weak light in {} exposures of {}", exposures.count(), exposures.sensor())
    })
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
    let objective = estimate.slopes::<Plain>(slope, &mut search.residual, control)?;
    let (m, prior) = (&estimate.sensitivity, estimate.prior.as_ref());
    search.reduced.linearise(m, estimate.beams(), prior, control)?;
    search.sweep_step();
    estimate.advance::<Plain>(&search.x, 1.0);
    Ok(objective)
}

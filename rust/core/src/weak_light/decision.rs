//! Where light is weak: the noise that decides it, and the prior that follows.
//!
//! λ follows from D at the first beam, that of equal pixels but for bright ones, and from the variance σ² of a
//! measurement of unit weight. σ² is that of residuals, rounded up to a power of 2: methods that see nearly the
//! same residuals have the same λ, unless σ² is next to such a power. It only falls as the fit goes on, and λ
//! with it, so that F + R never rises.

use std::sync::Arc;

use super::prior::{self, LIT, Prior};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::memory;

/// D of the faintest pixel that single precision serves, as a share of a bright pixel's: fainter ones have a
/// prior even without noise.
const FAINTEST: f64 = 1e-24;
/// How much D changes at most from the first beam on.
const CHANGE: f64 = 4.0;
/// Bytes for each pixel and each cell of each view that the first D takes: D, M and L.
const BYTES: [u64; 2] = [16, 8];
/// Bytes that a prior takes likewise: λ, λ in the units of the search and pieces; those of a prior that leaves
/// pieces out, of this one and the one before; and the components that pieces are (`connectivity.rs`).
const BYTES_OF_PRIOR: [u64; 2] = [16 + 8 + 22, 13];

/// A linear problem in which light may be weak.
pub(crate) trait Problem<T: Real> {
    /// What is measured.
    fn exposures(&self) -> &Exposures<'_, T>;

    /// The variance of a measurement of weight 1 as residuals show it, where `pixels` have a measurement and
    /// `freed` unknowns are left to a prior; `None` where there are too few degrees of freedom.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled), here and below.
    fn variance(
        &self,
        pixels: &mut Option<usize>,
        freed: f64,
        control: &Control,
    ) -> Result<Option<f64>>;

    /// The least D above 0 and that of a bright pixel, where the mean of M is 1.
    fn range(&mut self, control: &Control) -> Result<[f64; 2]>;

    /// D at the first beam.
    fn first_information(&self, control: &Control) -> Result<Vec<f64>>;

    /// The piece of connected pixels of each pixel, for D at the first beam.
    fn pieces(&self, information: &[f64], control: &Control) -> Result<Arc<[i32]>>;

    /// Takes this prior, or none; whether that is another one than before.
    fn take(&mut self, prior: Option<Prior>) -> bool;
}

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
    pub(crate) freed: f64,
}

impl WeakLight {
    pub(crate) const fn new() -> Self {
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

    /// Whether residuals are so large, or light so weak, that some pixels may need a prior.
    pub(crate) fn may_be<T: Real>(
        &mut self,
        problem: &mut impl Problem<T>,
        control: &Control,
    ) -> Result<bool> {
        let noise = problem.variance(&mut self.pixels, self.freed, control)?;
        self.hears(problem.exposures(), noise);
        let [least, bright] = problem.range(control)?;
        Ok(may_be_weak(least, self.sought(bright)))
    }

    /// Gives a problem, whose beam is up to date, the prior that follows from it; whether it has changed.
    pub(crate) fn update<T: Real>(
        &mut self,
        problem: &mut impl Problem<T>,
        control: &Control,
    ) -> Result<bool> {
        let noise = problem.variance(&mut self.pixels, self.freed, control)?;
        if !self.hears(problem.exposures(), noise) {
            return Ok(false);
        }
        let range = problem.range(control)?;
        let found = self.decide(problem, range, control)?;
        Ok(found.is_some_and(|prior| problem.take(prior)))
    }

    /// The prior, if it is another one; `range` is the least D and that of a bright pixel.
    fn decide<T: Real>(
        &mut self,
        problem: &impl Problem<T>,
        [least, bright]: [f64; 2],
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
        let information = if let Some(information) = self.first.take() {
            information
        } else {
            check_memory(problem.exposures(), BYTES)?;
            problem.first_information(control)?
        };
        control.check()?;
        let weights = prior::weights(&information, variance);
        control.check()?;
        self.freed = prior::freed(&weights, &information, variance, 0.0);
        let prior = if weights.iter().any(|&weight| weight > 0.0) {
            check_memory(problem.exposures(), BYTES_OF_PRIOR)?;
            let pieces = match self.pieces.take() {
                Some(pieces) => pieces,
                None => problem.pieces(&information, control)?,
            };
            self.pieces = Some(Arc::clone(&pieces));
            Some(Prior::new(weights, pieces))
        } else {
            None
        };
        self.first = Some(information);
        Ok(Some(prior))
    }

    /// The pixels of a result of this mean that the prior holds, and how many unknowns the data leave to it.
    pub(crate) fn held(
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

/// Whether there are so many bytes for each pixel and each cell of each view.
fn check_memory<T: Real>(exposures: &Exposures<'_, T>, bytes: [u64; 2]) -> Result<()> {
    let cells: usize = exposures.geometry().views.iter().map(|view| view.shape.len()).sum();
    let needed = bytes[0] * exposures.sensor().len() as u64 + bytes[1] * cells as u64;
    memory::check(needed, || {
        format!("weak light in {} exposures of {}", exposures.count(), exposures.sensor())
    })
}

//! Where light is weak: the noise that decides it, and the prior of M there, found as the fit goes on.

use std::sync::Arc;

use crate::connectivity::{Components, NONE, Tie};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::joint::{self, System};
use crate::prior::{self, LIT, Prior};
use crate::reduced::ConjugateGradients;
use crate::sweep::Estimate;

/// D of the faintest pixel that single precision serves, as a share of a bright pixel's: fainter ones have a
/// prior even without noise.
const FAINTEST: f64 = 1e-6;
/// A relative change of the variance that no longer counts.
const SETTLED: f64 = 1e-3;
/// Looks at which the prior may change.
const MOST_CHANGES: u32 = 12;

/// The prior while it is sought. Once the variance of a measurement has settled it stays, so that F + R is one
/// function.
pub(super) struct WeakLight {
    variance: f64,
    changes: u32,
    settled: bool,
    /// The pieces of connected pixels, once they are needed.
    pieces: Option<Arc<[i32]>>,
    /// Pixels in which the prior holds more than the data.
    pub(super) held: Vec<usize>,
}

impl WeakLight {
    pub(super) fn new() -> Self {
        let (variance, changes, settled) = (f64::INFINITY, 0, false);
        Self { variance, changes, settled, pieces: None, held: Vec::new() }
    }

    /// The prior that follows from the noise and from D, if it is to change; `range` is the least D and that
    /// of a bright pixel, `misfit` the variance of a measurement of weight 1 as the residuals show it.
    pub(super) fn decide<T: Real>(
        &mut self,
        exposures: &Exposures<'_, T>,
        range: [f64; 2],
        noise: f64,
        information: impl FnOnce() -> Vec<f64>,
        connected: impl FnOnce(&[f64]) -> Result<Arc<[i32]>>,
    ) -> Result<Option<Option<Prior>>> {
        if self.settled {
            return Ok(None);
        }
        let [least, bright] = range;
        let floor = FAINTEST * bright / LIT;
        let known = if exposures.variance_is_known() { noise.min(1.0) } else { noise };
        let variance = known.max(floor);
        self.changes += 1;
        self.settled =
            (variance / self.variance - 1.0).abs() < SETTLED || self.changes == MOST_CHANGES;
        let had = self.pieces.is_some();
        self.variance = variance;
        // Not a number where there is no light at all.
        let is_weak = least < LIT * variance;
        if !is_weak && !had {
            return Ok(None);
        }
        let information = information();
        let pieces = self.pieces.take().map_or_else(|| connected(&information), Ok)?;
        let weights: Arc<[f64]> = information
            .iter()
            .zip(&*pieces)
            .map(|(&d, &piece)| if piece < 0 { 0.0 } else { prior::weight(d, variance) })
            .collect();
        // Without noise the prior would bias what the data determine.
        let share = if known > floor { 1.0 } else { 0.0 };
        let pairs = weights.iter().zip(&information).enumerate();
        let held = pairs.filter(|(_, (weight, d))| **weight > share * **d);
        self.held = held.map(|(pixel, _)| pixel).collect();
        self.pieces = Some(Arc::clone(&pieces));
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
        if self.settled {
            return Ok(false);
        }
        let noise = estimate.variance(self.held.len());
        let former = estimate.prior.as_ref();
        search.reduced.linearise(&estimate.sensitivity, estimate.beams(), former, control)?;
        let (exposures, reduced) = (search.reduced.exposures, &search.reduced);
        let information = || reduced.information();
        let connected = |_: &[f64]| {
            let ties = vec![Tie::Firm; exposures.sensor().len()];
            Ok(Components::of(exposures, &ties, control)?.pixels.into())
        };
        let found = self.decide(exposures, reduced.range, noise, information, connected)?;
        let Some(prior) = found else { return Ok(false) };
        estimate.prior = prior;
        search.renew();
        Ok(true)
    }
}

impl WeakLight {
    /// Gives a joint problem the prior that follows from its state; whether it has changed.
    pub(super) fn update_joint<T: Real>(&mut self, system: &mut System<'_, '_, T>) -> Result<bool> {
        if self.settled {
            return Ok(false);
        }
        let information = system.information();
        let freedom = joint::freedom(system) + self.held.len() as f64;
        let range = joint::range(&information);
        let connected = |information: &[f64]| {
            let piece = |d: &f64| if *d > 0.0 { 0 } else { NONE };
            Ok(information.iter().map(piece).collect())
        };
        let (exposures, noise) = (system.pass.exposures, system.variance(freedom));
        let found = self.decide(exposures, range, noise, || information, connected)?;
        let Some(prior) = found else { return Ok(false) };
        let mean = system.mean;
        system.prior = prior.map(|prior| joint::Prior {
            weights: prior.weights.iter().map(|weight| weight / (mean * mean)).collect(),
            mean,
        });
        Ok(true)
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

//! The parts of a step of `multiscale`, one by one: for the bench that tells
//! what assembling and factorising cost in products. No interface to rely on.

use crate::control::Control;
use crate::convergence::History;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::parallel::Workers;
use crate::reduced::{Reduced, TwoLevel};
use crate::solve::{self, Options};
use crate::sweep::Estimate;

/// The linear problem of a step.
pub struct Parts<'m, 'a, T> {
    exposures: &'m Exposures<'a, T>,
    workers: &'m Workers,
    reduced: Reduced<'m, 'a, T>,
    x: Vec<f32>,
    product: Vec<f32>,
}

impl<'m, 'a, T: Real> Parts<'m, 'a, T> {
    /// Its buffers.
    pub fn new(exposures: &'m Exposures<'a, T>, workers: &'m Workers) -> Self {
        let control = Control::new();
        let reduced = Reduced::new(exposures, workers, &control);
        let [mut x, product] =
            [(); 2].map(|()| reduced.padding.zeros(exposures.sensor().rows, workers, &control));
        workers.fill(reduced.padding.body_mut(&mut x), 1.0, &control);
        Self { exposures, workers, reduced, x, product }
    }

    /// Assembles S at an estimate of M and L.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled), here and below.
    pub fn assemble(&mut self, estimate: &Estimate<'_, '_, T>, control: &Control) -> Result<()> {
        self.reduced.linearise(&estimate.sensitivity, estimate.beams(), None, control)
    }

    /// Assembles and factorises the coarse matrix.
    ///
    /// # Errors
    /// As [`assemble`](Self::assemble).
    pub fn factorise(&mut self, control: &Control) -> Result<()> {
        let mut two_level = TwoLevel::new(self.exposures, self.reduced.padding, self.workers);
        two_level.prepare(&mut self.reduced, control)
    }

    /// Multiplies S by an x.
    ///
    /// # Errors
    /// As [`assemble`](Self::assemble).
    pub fn multiply(&mut self, control: &Control) -> Result<f64> {
        self.reduced.multiply(&self.x, &mut self.product, control)
    }
}

/// Runs the loop of the fast solver alone, without what follows it.
///
/// # Errors
/// As [`calibrate`](crate::solve::calibrate).
pub fn multiscale<T: Real>(
    exposures: &Exposures<'_, T>,
    options: &Options,
    workers: &Workers,
    control: &Control,
) -> Result<History> {
    workers.enter(|| {
        let (_, history, _) = solve::multiscale(exposures, options, None, workers, control)?;
        Ok(history)
    })
}

//! The parts of a step of [`multiscale`](crate::multiscale), one by one: for the bench that tells
//! what assembling and factorising cost in products. No interface to rely on.

use crate::control::Control;
use crate::descent::Descent;
use crate::error::Result;
use crate::frames::Real;
use crate::model::Model;
use crate::parallel::Workers;
use crate::precondition::TwoLevel;
use crate::reduced::Reduced;

/// The linear problem of a step.
pub struct Parts<'m, 'a, T> {
    model: &'m Model<'a, T>,
    workers: &'m Workers,
    reduced: Reduced<'m, 'a, T>,
}

impl<'m, 'a, T: Real> Parts<'m, 'a, T> {
    /// Assembles S at an estimate of M and L.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled), here and below.
    pub fn assemble(
        model: &'m Model<'a, T>,
        descent: &Descent<'_, '_, T>,
        workers: &'m Workers,
        control: &Control,
    ) -> Result<Self> {
        let reduced = Reduced::new(model, &descent.sensitivity, descent.beams(), workers, control)?;
        Ok(Self { model, workers, reduced })
    }

    /// Assembles and factorises the coarse matrix.
    ///
    /// # Errors
    /// As [`assemble`](Self::assemble).
    pub fn factorise(&self, control: &Control) -> Result<()> {
        TwoLevel::new(self.model, &self.reduced, self.workers, control).map(drop)
    }

    /// What multiplies S by M.
    pub fn product(&mut self, control: &Control) -> impl FnMut() -> Result<()> {
        let x = self.reduced.sensitivity.clone();
        let mut product = vec![0.0; x.len()];
        move || self.reduced.multiply(&x, &mut product, control).map(drop)
    }
}

//! Conjugate gradients for the joint problem S x = b, its vectors in single or double precision.
//!
//! x is in single precision in either case. Its rounding is a share 6e-8 of it: another step makes that good, and
//! error bars need a share 1e-4.

use super::preconditioner::Preconditioner;
use super::system::{Precision, System};
use crate::coarse::DAMPING;
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::ritz::{Lowest, Ritz};

/// What searches so far have told of P⁻¹S.
#[derive(Clone)]
pub(crate) struct Known {
    /// The smallest Ritz value of all; at first the eigenvalue of smooth errors.
    pub(crate) lowest: Lowest,
    pub(crate) iterations: u64,
}

impl Default for Known {
    fn default() -> Self {
        Self::with(1.0)
    }
}

impl Known {
    /// With the smallest eigenvalue that there may be, in units of that of smooth errors.
    pub(crate) fn with(least: f64) -> Self {
        Self { lowest: Lowest::new(DAMPING * least), iterations: 0 }
    }
}

/// A solution in the making, in the units of its numbers ([`Precision::units`]), x in those of single precision.
#[derive(Default)]
pub(crate) struct ConjugateGradients<N> {
    pub(crate) x: Vec<f32>,
    residual: Vec<N>,
    direction: Vec<N>,
    /// S times the direction, then P⁻¹ r.
    product: Vec<N>,
    pub(crate) square: f64,
    keep: f64,
    /// x · b, of which b − S x lacks some.
    pub(crate) energy: f64,
    ritz: Ritz,
    pub(crate) known: Known,
    /// Whether the preconditioner does.
    sees_large_scales: bool,
}

impl<N: Precision> ConjugateGradients<N> {
    /// After searches that have told so much.
    pub(crate) fn after(known: Known) -> Self {
        Self { known, ..Self::default() }
    }

    pub(crate) fn begin<T: Real>(
        &mut self,
        system: &System<'_, '_, T>,
        preconditioner: &Preconditioner,
        slope: Vec<f64>,
        control: &Control,
    ) -> Result<()> {
        self.sees_large_scales = preconditioner.sees_large_scales();
        // First, since it takes the slope's place.
        self.residual = system.slope_in(slope);
        control.check()?;
        let (workers, length) = (system.pass.workers, self.residual.len());
        if self.direction.len() != length {
            let zeros = || workers.filled(length, N::default(), control);
            (self.direction, self.product) = (zeros(), zeros());
        }
        self.x = workers.filled(length, 0.0, control);
        control.check()?;
        preconditioner.apply(system, &self.residual, &mut self.direction, control)?;
        self.square = system.pass.workers.dot(&self.residual, &self.direction);
        self.keep = 0.0;
        self.energy = 0.0;
        self.ritz = Ritz::default();
        Ok(())
    }

    /// The solution, and what is known then.
    pub(crate) fn found(self) -> (Vec<f32>, Known) {
        (self.x, self.known)
    }

    /// Multiplies S by the direction; returns the largest relative change of M that goes with P⁻¹ r.
    pub(crate) fn product<T: Real>(
        &mut self,
        system: &mut System<'_, '_, T>,
        control: &Control,
    ) -> Result<f64> {
        let Self { direction, product, keep, .. } = self;
        let size = system.multiply(direction, product, *keep, control)? / system.mean;
        let known = size.is_finite() && self.square.is_finite() && self.sees_large_scales;
        Ok(if known { size } else { f64::INFINITY })
    }

    /// A step along the direction, and a new direction; `false` if there was none to go.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled): on a large sensor each of these sums takes long.
    pub(crate) fn step<T: Real>(
        &mut self,
        system: &System<'_, '_, T>,
        preconditioner: &Preconditioner,
        control: &Control,
    ) -> Result<bool> {
        let workers = system.pass.workers;
        let step = self.square / workers.dot(&self.direction, &self.product);
        // r · P⁻¹ r and the curvature are both above 0, or one of them is rounding.
        if !(self.square > 0.0 && step > 0.0 && step.is_finite()) {
            return Ok(false);
        }
        self.energy += step * self.square;
        let cells = system.state.beam.len();
        let ([of_own, _], [of_x, _]) = (system.units::<N>(), system.units::<f32>());
        let (of_cells, of_others) = self.direction.split_at(cells);
        workers.add_multiple(&mut self.x[..cells], step * (of_own / of_x), of_cells);
        workers.add_multiple(&mut self.x[cells..], step, of_others);
        control.check()?;
        workers.add_multiple(&mut self.residual, -step, &self.product);
        control.check()?;
        preconditioner.apply(system, &self.residual, &mut self.product, control)?;
        let square = workers.dot(&self.residual, &self.product);
        control.check()?;
        self.keep = square / self.square;
        workers.add_multiple(&mut self.product, self.keep, &self.direction);
        std::mem::swap(&mut self.direction, &mut self.product);
        self.ritz.push(step, self.keep);
        self.square = square;
        self.known.lowest.push(self.ritz.smallest());
        self.known.iterations += 1;
        Ok(square > 0.0)
    }
}

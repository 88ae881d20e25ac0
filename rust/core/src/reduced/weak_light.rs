//! Weak light at whole shifts and known fluxes.

use std::sync::Arc;

use super::conjugate_gradients::ConjugateGradients;
use super::operator::Reduced;
use crate::coarse::Hats;
use crate::connectivity::{Components, Tie};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::sweep::Estimate;
use crate::weak_light::{Prior, Problem, Site};

/// An estimate, whose beam is up to date, and the search for its next step.
pub(crate) struct Whole<'s, 'm, 'a, T> {
    pub(crate) estimate: &'s mut Estimate<'m, 'a, T>,
    pub(crate) search: &'s mut ConjugateGradients<'m, 'a, T>,
}

impl<T: Real> Problem<T> for Whole<'_, '_, '_, T> {
    fn exposures(&self) -> &Exposures<'_, T> {
        self.search.reduced.exposures
    }

    fn variance(
        &self,
        pixels: &mut Option<usize>,
        freed: f64,
        control: &Control,
    ) -> Result<Option<f64>> {
        let count = match *pixels {
            Some(count) => count,
            None => self.exposures().measured_pixels(control)?,
        };
        *pixels = Some(count);
        Ok(self.estimate.variance(count, freed))
    }

    fn range(&mut self, control: &Control) -> Result<[f64; 2]> {
        let (estimate, reduced) = (&*self.estimate, &mut self.search.reduced);
        if reduced.range == [0.0; 2] {
            reduced.linearise(&estimate.sensitivity, estimate.beams(), None, control)?;
        }
        Ok(reduced.information_range())
    }

    fn first_information(&self, control: &Control) -> Result<Vec<f64>> {
        Estimate::first_information(self.search.reduced.exposures, self.search.workers(), control)
    }

    fn pieces(&self, _: &[f64], control: &Control) -> Result<Arc<[i32]>> {
        let ties = vec![Tie::Firm; self.exposures().sensor().len()];
        Ok(Components::of(self.exposures(), &ties, control)?.pixels.into())
    }

    fn take(&mut self, prior: Option<Prior>) -> bool {
        if prior.is_none() && self.estimate.prior.is_none() {
            return false;
        }
        self.estimate.prior = prior;
        self.search.renew();
        true
    }
}

impl<T: Real> Reduced<'_, '_, T> {
    /// What the prior's part of S needs of the rest.
    pub(super) fn site(&self) -> Site<'_> {
        Site {
            sensor: self.exposures.sensor(),
            padding: self.padding,
            workers: self.workers,
            sensitivity: &self.sensitivity,
        }
    }

    /// What the prior adds to the hats' own elements of the coarse matrix; empty without one.
    pub(super) fn prior_of_hats(&self, hats: &Hats) -> Vec<f64> {
        self.weak.as_ref().map_or_else(Vec::new, |term| term.of_hats(&self.site(), hats))
    }

    /// Adds a draw of the prior's noise, of the covariance of its part of S, to a right-hand side.
    pub(crate) fn draw_prior(&self, draw: u64, slope: &mut [f32]) {
        if let Some(term) = &self.weak {
            term.draw(&self.site(), draw, slope);
        }
    }
}

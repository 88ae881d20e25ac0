//! The smallest Ritz value of all searches so far, and the error of M that it implies.

use super::conjugate_gradients::ConjugateGradients;
use crate::coarse::DAMPING;
use crate::control::Control;
use crate::convergence::FEWEST_ITERATIONS;
use crate::error::Result;
use crate::frames::Real;
use crate::ritz::Lowest;

/// The smallest Ritz value found so far, and in how many iterations.
#[derive(Clone, Debug)]
pub(crate) struct Smallest {
    lowest: Lowest,
    pub(crate) iterations: u64,
    /// Whether the last search found no direction to go at once: nothing is left but rounding, or
    /// else rounding has spoilt the problem.
    pub(crate) settled: bool,
    pub(crate) stuck: bool,
}

impl Default for Smallest {
    /// The eigenvalue of smooth errors, known beforehand.
    fn default() -> Self {
        Self { lowest: Lowest::new(DAMPING), iterations: 0, settled: false, stuck: false }
    }
}

impl Smallest {
    /// One more iteration of `search`; `false` if there was none to make.
    pub(crate) fn iterate<T: Real>(
        &mut self,
        search: &mut ConjugateGradients<'_, '_, T>,
        control: &Control,
    ) -> Result<bool> {
        if search.is_exhausted() && !search.ritz.is_empty() {
            // All eigenvalues were found: tiny problems have few.
            self.iterations = self.iterations.max(FEWEST_ITERATIONS);
            return Ok(false);
        }
        let went = search.iterate(control)?;
        if went {
            self.iterations += 1;
            self.lowest.push(search.ritz.smallest());
        } else {
            self.settled = search.is_settled();
            self.stuck = search.ritz.is_empty() && !self.settled;
        }
        Ok(went)
    }

    /// The largest error, before the step that `search` has found is made.
    pub(crate) fn error<T: Real>(&self, search: &ConjugateGradients<'_, '_, T>) -> f64 {
        search.found() + self.left(search)
    }

    /// The share of b · S⁻¹ b that x · b lacks, at most: what is left is e · S e with e = S⁻¹ r, no more
    /// than r · P⁻¹ r over the smallest eigenvalue of P⁻¹S.
    pub(crate) fn lack<T: Real>(&self, search: &ConjugateGradients<'_, '_, T>) -> f64 {
        let left = self.lowest.over(search.square());
        if left.is_finite() { left / (search.energy + left) } else { 1.0 }
    }

    /// What is left of the error once the step that `search` has found is made.
    pub(crate) fn left<T: Real>(&self, search: &ConjugateGradients<'_, '_, T>) -> f64 {
        self.lowest.over(search.largest())
    }
}

//! How far M still is from the minimum of F, large scales included; when to stop.
//!
//! With b the slope of −F at M and x the part of the step that a search has found so far, with the
//! residual r = b − S x, the largest relative error of M is estimated as
//!
//! ```text
//! max |x| + max |P⁻¹ r| / θ
//! ```
//!
//! θ being the smallest Ritz value of P⁻¹S. The error is e = x + S⁻¹r, and S⁻¹r = (P⁻¹S)⁻¹ P⁻¹r is at
//! most about 1/θ times as large as P⁻¹ r: P⁻¹ has already brought errors of the sensor's own size
//! back to their full height, which no rule on F or on the step of a sweep does, since one sweep
//! removes but (shift/size)² of them. θ comes from the coefficients of conjugate gradients, for
//! nothing. It approaches the smallest eigenvalue from above, so nothing is claimed before some
//! iterations have been made.
//!
//! After few iterations θ is still too large. So where it has fallen over the last half of the iterations
//! it is taken as far below as it has fallen there (`ritz.rs`).
//!
//! It is an estimate, not a bound: F is no parabola, and θ is not the last eigenvalue. At 319 stops
//! of small random problems the true error was at most 1.4 times it, and half of the time it was more
//! than 2.7 times too large (docs/estimate.py); the worst seen, on a tiny sensor, was 5.8 times.

use crate::exposures::Exposures;
use crate::frames::Real;

/// Iterations before the smallest Ritz value is worth its name.
pub(crate) const FEWEST_ITERATIONS: u64 = 10;

/// A relative error that is rounding alone.
pub(crate) const ROUNDING: f64 = 4.0 * f64::EPSILON;

/// How often a step that raises F is halved; the last time, what is left of it is taken back.
pub(crate) const MOST_HALVINGS: i32 = 10;
/// Looks that may fail to lower the estimate before it counts as stalled.
const PATIENCE: usize = 3;

/// What one look at the state of a calibration found.
#[derive(Clone, Copy, Debug)]
pub struct Look {
    /// Sweeps, or products with the data or its weights, made before it.
    pub sweep: u64,
    /// The objective F.
    pub objective: f64,
    /// The estimated largest relative error of M.
    pub error: f64,
}

impl Look {
    /// An error below rounding is rounding, and one that is no number, or below 0, is unknown.
    pub(crate) const fn new(sweep: u64, objective: f64, error: f64) -> Self {
        let error = if error >= 0.0 { error.max(ROUNDING) } else { f64::INFINITY };
        Self { sweep, objective, error }
    }
}

/// Why a solver ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// The estimated error is within the tolerance.
    Converged,
    /// The sweeps allowed are used up.
    SweepsUsed,
    /// The estimate falls no longer: what is left is rounding.
    Stalled,
}

/// How a calibration went.
#[derive(Clone, Debug)]
pub struct History {
    /// The looks taken, the last one at the result; at least one.
    pub looks: Vec<Look>,
    /// Why it ended.
    pub ended: Ended,
}

impl History {
    /// The last look.
    #[must_use]
    pub fn last(&self) -> Look {
        self.looks.last().copied().unwrap_or(Look { sweep: 0, objective: 0.0, error: 0.0 })
    }
}

/// What F may rise by through rounding: that of a sum, and of residuals that are rounding alone.
pub(crate) fn rounding<T: Real>(exposures: &Exposures<'_, T>, objective: f64) -> f64 {
    let residual = 4.0 * f64::EPSILON * exposures.brightest();
    let weights: f64 = exposures.exposure_weights(exposures.flux()).iter().sum();
    1e-12 * objective + weights * residual * residual
}

/// The look since which the estimate has not fallen by half, once that is long ago.
pub(crate) fn stalled_since(looks: &[Look]) -> Option<usize> {
    let earlier = looks.len().checked_sub(PATIENCE + 1)?;
    let best = |looks: &[Look]| looks.iter().map(|look| look.error).fold(f64::INFINITY, f64::min);
    (2.0 * best(&looks[earlier + 1..]) > best(&looks[..=earlier])).then_some(earlier)
}

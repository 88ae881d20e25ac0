//! Coordinate descent: the method of the paper, sweep by sweep.
//!
//! With M fixed each cell of the beam has a closed form, and with L fixed each pixel has:
//!
//! ```text
//! L(u) = Σ w c M y / Σ w c² M²     over the measurements that see cell u
//! M(p) = Σ w c L y / Σ w c² L²     over the exposures of pixel p
//! ```
//!
//! One sweep updates all L, then all M (Stukachev and Kozhevatov 2011, section 2, who take the
//! method from Vasil'ev 1988). The objective F never rises. Pixel-scale errors of M fade in some
//! twenty sweeps, an error of the sensor's own size in (size/shift)² sweeps: see
//! [`estimate`](crate::estimate) for how to tell.
//!
//! Both are updated in the form M += Σ w c L r / Σ w c² L² with the residuals r = y − c L M, which
//! gives F in the same pass and keeps its accuracy when the residuals become small.

mod kernel;
mod sweep;

pub use sweep::Descent;

use crate::control::Control;
use crate::error::{Error, Result};
use crate::estimate::{Estimate, Estimator, ROUNDING};
use crate::frames::Real;
use crate::model::Model;
use crate::parallel::Workers;

/// Fewest sweeps between two estimates of the error, each of which costs about as much.
const CHECK_EVERY: u64 = 16;
/// Before so many sweeps slow errors may hide under those that fade at once.
const FEWEST_SWEEPS: u64 = 64;
/// Sweeps that nobody waits for: what makes so many is no experiment that this method can solve.
const MOST_SWEEPS: u64 = 1_000_000;
/// A step that may be rounding alone, where some pixels are much brighter than others.
const TINY_STEP: f64 = 1e-11;

/// When to stop.
#[derive(Clone, Copy, Debug)]
pub struct Stop {
    /// The largest relative error of M that is wanted.
    pub tolerance: f64,
    /// The most sweeps to make; `None` means as many as it takes, at most a million.
    pub max_sweeps: Option<u64>,
}

/// How a calibration went, sweep by sweep.
#[derive(Clone, Debug, Default)]
pub struct History {
    /// F after each sweep.
    pub objective: Vec<f64>,
    /// The estimated largest error of M at those sweeps where it was estimated.
    pub error_estimate: Vec<Estimate>,
}

impl History {
    /// Number of sweeps made.
    #[must_use]
    pub const fn sweeps(&self) -> u64 {
        self.objective.len() as u64
    }

    /// The last estimate of the largest relative error of M.
    #[must_use]
    pub fn last_estimate(&self) -> f64 {
        self.error_estimate.last().map_or(f64::INFINITY, |estimate| estimate.error)
    }

    /// Whether only rounding is left to see: no step can be told from it, or the steps are tiny and
    /// the estimate is no smaller than it was at half the sweeps.
    fn stalled(&self) -> bool {
        let [earlier @ .., last] = &self.error_estimate[..] else { return false };
        let half = earlier.iter().find(|estimate| 2 * estimate.sweep >= last.sweep);
        let falling = half.is_none_or(|half| last.error < half.error);
        last.step < ROUNDING || (last.step < TINY_STEP && !falling)
    }

    /// Whether the estimate is within `tolerance`, and late enough to be believed.
    #[must_use]
    pub fn converged(&self, tolerance: f64) -> bool {
        self.sweeps() >= FEWEST_SWEEPS && self.last_estimate() <= tolerance
    }

    /// How many sweeps it will be until `tolerance` is met, if errors go on to fade as they did
    /// between the last two estimates, or by `rate` a sweep where there are no two.
    fn forecast(&self, tolerance: f64, rate: f64) -> u64 {
        let rate = match self.error_estimate[..] {
            [.., from, to] if to.error < from.error => {
                (from.error / to.error).ln() / (to.sweep - from.sweep) as f64
            }
            _ => rate,
        };
        let missing = (self.last_estimate() / tolerance).ln() / rate;
        self.sweeps().saturating_add(missing.max(0.0) as u64)
    }
}

/// Sweeps until the estimated error of M is at most the tolerance, the sweeps are used up, or the
/// estimate no longer falls.
///
/// `components` is the number of connected components of the measurements.
///
/// # Errors
/// [`Error::Value`] for a tolerance that is not a positive number or a limit of 0 sweeps,
/// [`Error::Cancelled`] if `control` asks to stop.
pub fn solve<'m, 'a, T: Real>(
    model: &'m Model<'a, T>,
    components: usize,
    stop: Stop,
    workers: &'m Workers,
    control: &Control,
) -> Result<(Descent<'m, 'a, T>, History)> {
    let Stop { tolerance, max_sweeps } = stop;
    if !(tolerance > 0.0 && tolerance.is_finite()) {
        let problem = format!("is {tolerance}: expected a positive number");
        return Err(Error::value("tolerance", problem));
    }
    if max_sweeps == Some(0) {
        return Err(Error::value("max_sweeps", "is 0: at least one sweep is needed"));
    }
    let mut estimator = Estimator::new(model, components, workers, control)?;
    let limit = max_sweeps.unwrap_or(MOST_SWEEPS);
    let mut descent = Descent::new(model, workers);
    let mut history = History::default();
    let mut next_check = limit.min(CHECK_EVERY / 2);
    for sweep in 1..=limit {
        if sweep < next_check {
            history.objective.push(descent.sweep(control)?);
            continue;
        }
        let before = descent.sensitivity.clone();
        control.check()?;
        history.objective.push(descent.sweep(control)?);
        let estimate = estimator.largest_error(descent.step_since(before), sweep, control)?;
        history.error_estimate.push(estimate);
        if history.converged(tolerance) || history.stalled() {
            break;
        }
        let total = history.forecast(tolerance, estimator.longest()).min(limit);
        control.report("calibrate", sweep, total);
        // Rarer as the run grows longer, but not far beyond the sweep that may be the last.
        let wait = (total - sweep).min(sweep / 4).max(CHECK_EVERY);
        next_check = limit.min(sweep + wait);
    }
    Ok((descent, history))
}

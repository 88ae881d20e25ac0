//! The fast solver: Gauss-Newton steps on all scales at once.
//!
//! Each step solves the linear problem of [`reduced`](crate::reduced) by conjugate gradients with
//! the preconditioner of [`precondition`](crate::precondition), in single precision, and then takes
//! M → M + x in double precision, with L at its closed form. The number of products does not depend
//! on the size of the sensor, where coordinate descent takes (size/shift)² sweeps.
//!
//! The steps are linear in M. With M → M·eᵍ a dead pixel whose best M is below 0 would never get
//! there.

use crate::conjugate::Search;
use crate::control::Control;
use crate::descent::Descent;
use crate::error::Result;
use crate::estimate::{Ended, FEWEST_ITERATIONS, History, Look, Smallest, Stop};
use crate::frames::Real;
use crate::model::Model;
use crate::parallel::Workers;
use crate::precondition::TwoLevel;
use crate::reduced::{Reduced, Scale};

/// Products that nobody waits for: what takes so many is no experiment that this method can solve.
const MOST_PRODUCTS: u64 = 100_000;
/// How much of the tolerance a step aims at; the rest is for what linearising adds.
const AIM: f64 = 0.8;
/// The most that one step reduces the error by: single precision holds no more.
const PRECISION: f64 = 1e-5;
/// Steps that may fail to lower the estimate before it counts as stalled.
const PATIENCE: usize = 3;
/// How often a step is halved before it is taken as it is.
const MOST_HALVINGS: u32 = 10;
/// Products that an ordinary calibration takes: what progress is measured against at first.
const TYPICAL: u64 = 60;

/// Minimises F until the estimated error of M is at most the tolerance, the products are used up,
/// or the estimate no longer falls. Returns the pixels too that their measurements leave almost no
/// weight.
///
/// # Errors
/// [`Error::Value`](crate::Error::Value) for a tolerance that is not a positive number or a limit of
/// 0 sweeps, [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
pub fn solve<'m, 'a, T: Real>(
    model: &'m Model<'a, T>,
    stop: Stop,
    workers: &'m Workers,
    control: &Control,
) -> Result<(Descent<'m, 'a, T>, History, Vec<usize>)> {
    let limit = stop.limit(MOST_PRODUCTS)?;
    let scale = Scale::of(model);
    let mut descent = Descent::new(model, workers);
    let mut two_level = None;
    let mut smallest = Smallest::default();
    let mut looks: Vec<Look> = Vec::new();
    let mut step = Step::default();
    let mut products = 0;
    loop {
        let (residual, objective) = descent.slopes(scale.slope(), control)?;
        products += 1;
        // F is no parabola in M far from its minimum: a step may be too long.
        let rise =
            looks.last().is_some_and(|last| objective > last.objective + rounding(model, last));
        if rise && products < limit && step.halve(&mut descent) {
            continue;
        }
        step = Step::default();
        let mut reduced =
            Reduced::new(model, &descent.sensitivity, descent.beams(), workers, control)?;
        let two_level = match &mut two_level {
            Some(two_level) => two_level,
            none => none.insert(TwoLevel::new(model, &reduced, workers, control)?),
        };
        let mut search = Search::new(&mut reduced, two_level, residual);
        let mean = descent.mean_sensitivity();
        let error = smallest.error(&search) / mean;
        looks.push(Look { sweep: products, objective, error });
        control.report("calibrate", products, forecast(&looks, stop.tolerance).min(limit));
        let certain = smallest.iterations >= FEWEST_ITERATIONS;
        let ended = if certain && error <= stop.tolerance {
            Some(Ended::Converged)
        } else if products >= limit {
            Some(Ended::SweepsUsed)
        } else if stalled(&looks) {
            Some(Ended::Stalled)
        } else {
            let aim = AIM * stop.tolerance * mean;
            let made = go(&mut search, &mut smallest, aim, limit - products - 1, control)?;
            products += made;
            // Without a direction to go there is nothing left to find.
            let exhausted = if error <= stop.tolerance { Ended::Converged } else { Ended::Stalled };
            (made == 0 && products + 1 < limit).then_some(exhausted)
        };
        step.x = std::mem::take(&mut search.x);
        if let Some(ended) = ended {
            let left_out = std::mem::take(&mut reduced.left_out);
            return Ok((descent, History { looks, ended }, left_out));
        }
        drop(reduced);
        descent.advance(&step.x, 1.0);
    }
}

/// Iterates until what is left of the error is `aim`, or no more than what linearising adds, or
/// what single precision holds; returns the number of iterations.
fn go<T: Real>(
    search: &mut Search<'_, '_, '_, T>,
    smallest: &mut Smallest,
    aim: f64,
    most: u64,
    control: &Control,
) -> Result<u64> {
    let first = search.largest;
    // The term of second order is a product of relative steps in M and in L.
    let reachable = (first * search.size()).max(PRECISION * first);
    for made in 0..most {
        let near = search.largest <= reachable || smallest.left(search) <= aim;
        if (near && smallest.iterations >= FEWEST_ITERATIONS)
            || !smallest.iterate(search, control)?
        {
            return Ok(made);
        }
    }
    Ok(most)
}

/// The last step taken, which may turn out to be too long.
#[derive(Default)]
struct Step {
    x: Vec<f32>,
    halvings: u32,
}

impl Step {
    /// Takes half of what is left of the step back, if there is something left.
    fn halve<T: Real>(&mut self, descent: &mut Descent<'_, '_, T>) -> bool {
        if self.x.is_empty() || self.halvings == MOST_HALVINGS {
            return false;
        }
        self.halvings += 1;
        descent.advance(&self.x, -(0.5_f64.powi(self.halvings as i32)));
        true
    }
}

/// What F may rise by through rounding: that of a sum, and of residuals that are rounding alone.
fn rounding<T: Real>(model: &Model<'_, T>, last: &Look) -> f64 {
    let residual = 4.0 * f64::EPSILON * model.brightest();
    let weights: f64 = model.exposure_weights().iter().sum();
    1e-12 * last.objective + weights * residual * residual
}

/// Whether the estimate has not fallen by half for some steps.
fn stalled(looks: &[Look]) -> bool {
    let Some(earlier) = looks.len().checked_sub(PATIENCE + 1) else { return false };
    let best = |looks: &[Look]| looks.iter().map(|look| look.error).fold(f64::INFINITY, f64::min);
    2.0 * best(&looks[earlier + 1..]) > best(&looks[..=earlier])
}

/// The number of products in all, if the error goes on to fall as it did from the first look on.
fn forecast(looks: &[Look], tolerance: f64) -> u64 {
    let [first, .., last] = looks else { return TYPICAL };
    let rate = (first.error / last.error).ln() / (last.sweep - first.sweep) as f64;
    let missing = (last.error / tolerance).ln() / rate;
    if missing.is_finite() && rate > 0.0 { last.sweep + missing.max(0.0) as u64 } else { TYPICAL }
}

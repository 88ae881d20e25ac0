//! Coordinate descent: sweeps until M has converged.

use super::options::Options;
use crate::control::Control;
use crate::convergence::{Ended, FEWEST_ITERATIONS, History, Look};
use crate::error::Result;
use crate::exposures::Exposures;
use crate::fit::Start;
use crate::frames::Real;
use crate::parallel::Workers;
use crate::reduced::{ConjugateGradients, Scale, Smallest, Whole};
use crate::sweep::{Estimate, Plain};
use crate::weak_light::WeakLight;

/// Fewest sweeps between two estimates of the error, each of which costs about as much.
const CHECK_EVERY: u64 = 16;
/// Upper limit on sweeps: an experiment that needs more cannot be solved by this method.
const MOST_SWEEPS: u64 = 1_000_000;
/// An estimate that may be rounding alone, where some pixels are much brighter than others.
const TINY_ERROR: f64 = 1e-9;

/// Sweeps until the estimated error of M is at most the tolerance, the sweeps are used up, or the
/// estimate no longer falls. Returns what is known of weak light too, and F + R at the result.
///
/// # Errors
/// [`Error::Value`](crate::Error::Value) for a tolerance that is not a positive number or a limit of
/// 0 sweeps, [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
pub(super) fn minimise<'m, 'a, T: Real>(
    exposures: &'m Exposures<'a, T>,
    options: &Options,
    start: Option<Start>,
    workers: &'m Workers,
    control: &Control,
) -> Result<(Estimate<'m, 'a, T>, History, WeakLight, f64)> {
    let limit = options.limit(MOST_SWEEPS)?;
    let mut estimate = Estimate::new(exposures, workers, control);
    if let Some(start) = start {
        estimate = estimate.at(&start.sensitivity);
    }
    let (scale, mut search) =
        (Scale::of(exposures), ConjugateGradients::new(exposures, workers, control));
    let mut weak = WeakLight::new();
    let mut looks: Vec<Look> = Vec::new();
    // Sweeps without a prior would fit noise.
    estimate.slopes::<Plain>(scale.slope(), &mut search.residual, control)?;
    weak.update(&mut Whole { estimate: &mut estimate, search: &mut search }, control)?;
    let mut next_look = limit.min(CHECK_EVERY / 2);
    let mut sweep = 0;
    loop {
        let mut objective = one_sweep(&mut estimate, &mut search, control)?;
        sweep += 1;
        if sweep < next_look {
            continue;
        }
        let (found, error) = look(&mut estimate, scale, &mut weak, &mut search, control)?;
        if estimate.prior.is_some() {
            objective = found;
        }
        looks.push(Look::new(sweep, objective, error));
        let ended = if error <= options.tolerance {
            Ended::Converged
        } else if stalled(&looks) {
            Ended::Stalled
        } else if sweep >= limit {
            Ended::SweepsUsed
        } else {
            let total = forecast(&looks, options.tolerance).min(limit);
            control.report("calibrate", sweep, total);
            // Rarer as the run grows longer, but not far beyond the sweep that may be the last.
            let wait = (total - sweep).min(sweep / 4).max(CHECK_EVERY);
            next_look = limit.min(sweep + wait);
            continue;
        };
        return Ok((estimate, History { looks, ended }, weak, found));
    }
}

/// A sweep of coordinate descent; returns F + R before it where there is a prior, else F after it.
pub(super) fn one_sweep<T: Real>(
    estimate: &mut Estimate<'_, '_, T>,
    search: &mut ConjugateGradients<'_, '_, T>,
    control: &Control,
) -> Result<f64> {
    if estimate.prior.is_none() {
        return estimate.sweep(control);
    }
    let slope = search.reduced.scale.slope();
    let objective = estimate.slopes::<Plain>(slope, &mut search.residual, control)?;
    let (m, prior) = (&estimate.sensitivity, estimate.prior.as_ref());
    search.reduced.linearise(m, estimate.beams(), prior, control)?;
    search.sweep_step();
    estimate.advance::<Plain>(&search.x, 1.0);
    Ok(objective)
}

/// F + R with L at its closed form for the M of a sweep, which is that of the result, and the estimated
/// error.
fn look<'m, 'a, T: Real>(
    estimate: &mut Estimate<'m, 'a, T>,
    scale: Scale,
    weak: &mut WeakLight,
    search: &mut ConjugateGradients<'m, 'a, T>,
    control: &Control,
) -> Result<(f64, f64)> {
    let mut misfit = estimate.slopes::<Plain>(scale.slope(), &mut search.residual, control)?;
    if weak.update(&mut Whole { estimate, search }, control)? {
        misfit = estimate.slopes::<Plain>(scale.slope(), &mut search.residual, control)?;
    }
    search.start(&estimate.sensitivity, estimate.beams(), estimate.prior.as_ref(), control)?;
    let mut smallest = Smallest::default();
    while smallest.iterations < FEWEST_ITERATIONS && smallest.iterate(search, control)? {}
    Ok((misfit, smallest.error(search)))
}

/// Whether the estimate is tiny and no smaller than it was at half the sweeps.
fn stalled(looks: &[Look]) -> bool {
    let [earlier @ .., last] = looks else { return false };
    let half = earlier.iter().find(|look| 2 * look.sweep >= last.sweep);
    last.error < TINY_ERROR && half.is_some_and(|half| last.error >= half.error)
}

/// How many sweeps it will be until `tolerance` is met, if errors go on to fade as they did between
/// the last two looks.
fn forecast(looks: &[Look], tolerance: f64) -> u64 {
    let rate = match looks {
        [.., from, to] if to.error < from.error => {
            (from.error / to.error).ln() / (to.sweep - from.sweep) as f64
        }
        [.., last] => 1.0 / last.sweep as f64,
        [] => return MOST_SWEEPS,
    };
    let last = looks.last().map_or((0, 1.0), |look| (look.sweep, look.error));
    last.0.saturating_add(((last.1 / tolerance).ln() / rate).max(0.0) as u64)
}

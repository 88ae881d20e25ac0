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

use crate::conjugate::Search;
use crate::control::Control;
use crate::error::Result;
use crate::estimate::{Ended, FEWEST_ITERATIONS, History, Look, Smallest, Stop};
use crate::frames::Real;
use crate::model::Model;
use crate::parallel::Workers;
use crate::reduced::Scale;

/// Fewest sweeps between two estimates of the error, each of which costs about as much.
const CHECK_EVERY: u64 = 16;
/// Sweeps that nobody waits for: what makes so many is no experiment that this method can solve.
const MOST_SWEEPS: u64 = 1_000_000;
/// An estimate that may be rounding alone, where some pixels are much brighter than others.
const TINY_ERROR: f64 = 1e-9;

/// Sweeps until the estimated error of M is at most the tolerance, the sweeps are used up, or the
/// estimate no longer falls. Returns the pixels too that their measurements leave almost no weight.
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
    let limit = stop.limit(MOST_SWEEPS)?;
    let mut descent = Descent::new(model, workers, control);
    let (scale, mut search) = (Scale::of(model), Search::new(model, workers, control));
    let mut looks: Vec<Look> = Vec::new();
    let mut next_look = limit.min(CHECK_EVERY / 2);
    let mut sweep = 0;
    loop {
        let objective = descent.sweep(control)?;
        sweep += 1;
        if sweep < next_look {
            continue;
        }
        let error = look(&mut descent, scale, &mut search, control)?;
        looks.push(Look { sweep, objective, error });
        let ended = if error <= stop.tolerance {
            Ended::Converged
        } else if stalled(&looks) {
            Ended::Stalled
        } else if sweep >= limit {
            Ended::SweepsUsed
        } else {
            let total = forecast(&looks, stop.tolerance).min(limit);
            control.report("calibrate", sweep, total);
            // Rarer as the run grows longer, but not far beyond the sweep that may be the last.
            let wait = (total - sweep).min(sweep / 4).max(CHECK_EVERY);
            next_look = limit.min(sweep + wait);
            continue;
        };
        let left_out = search.left_out().map(|(pixel, _)| pixel).collect();
        return Ok((descent, History { looks, ended }, left_out));
    }
}

/// The estimated error after a sweep.
fn look<T: Real>(
    descent: &mut Descent<'_, '_, T>,
    scale: Scale,
    search: &mut Search<'_, '_, T>,
    control: &Control,
) -> Result<f64> {
    descent.slopes(scale.slope(), &mut search.residual, control)?;
    search.start(&descent.sensitivity, descent.beams(), control)?;
    let mut smallest = Smallest::default();
    while smallest.iterations < FEWEST_ITERATIONS && smallest.iterate(search, control)? {}
    Ok(smallest.error(search))
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

//! The fast solver: Gauss-Newton steps on all scales at once.
//!
//! Each step solves a linear problem (`reduced.rs`) by conjugate gradients with a preconditioner of
//! two levels (`reduced/two_level.rs`), in single precision, and then takes M → M + x in double precision,
//! with L at its closed form. The number of products does not depend
//! on the size of the sensor, where coordinate descent takes (size/shift)² sweeps.
//!
//! The steps are linear in M. With M → M·eᵍ a dead pixel whose best M is below 0 would never get
//! there.

use super::options::Options;
use super::start;
use crate::control::Control;
use crate::convergence::{
    Ended, FEWEST_ITERATIONS, History, Look, MOST_HALVINGS, rounding, stalled_since,
};
use crate::error::Result;
use crate::exposures::Exposures;
use crate::fit::Solution;
use crate::frames::Real;
use crate::parallel::Workers;
use crate::reduced::{ConjugateGradients, Scale, Smallest};
use crate::sweep::Estimate;

/// Upper limit on products: an experiment that needs more cannot be solved by this method.
const MOST_PRODUCTS: u64 = 100_000;
/// How much of the tolerance a step aims at; the rest is for what linearising adds.
const AIM: f64 = 0.8;
/// The most that one step reduces the error by: single precision holds no more.
const PRECISION: f64 = 1e-5;
/// Where steps lead nowhere, so many plain sweeps go on, which always do, and so many times.
const RESCUE_SWEEPS: u64 = 32;
const MOST_RESCUES: u32 = 8;
/// What linearising adds at most counts as this share of a step, far from the minimum.
const MOST_CURVED: f64 = 0.1;
/// Products that an ordinary calibration takes: what progress is measured against at first.
const TYPICAL: u64 = 60;

/// Minimises F until the estimated error of M is at most the tolerance, the products are used up,
/// or the estimate no longer falls. Returns the pixels too that their measurements leave almost no
/// weight.
///
/// # Errors
/// [`Error::Value`](crate::Error::Value) for a tolerance that is not a positive number or a limit of
/// 0 sweeps, [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
pub(crate) fn minimise<'m, 'a, T: Real>(
    exposures: &'m Exposures<'a, T>,
    options: &Options,
    start: Option<&Solution<'_>>,
    workers: &'m Workers,
    control: &Control,
) -> Result<(Estimate<'m, 'a, T>, History, Vec<usize>)> {
    let limit = options.limit(MOST_PRODUCTS)?;
    let scale = Scale::of(exposures);
    let mut estimate = start::estimate(exposures, start, workers, control)?;
    let mut search = ConjugateGradients::new(exposures, workers, control);
    let mut smallest = Smallest::default();
    let mut looks: Vec<Look> = Vec::new();
    let (mut halvings, mut rescues) = (0, 0);
    let mut products = 0;
    loop {
        let objective = estimate.slopes(scale.slope(), &mut search.residual, control)?;
        products += 1;
        // F is no parabola in M far from its minimum: a step may be too long. It is shortened even
        // where that takes more products than allowed.
        let noise = looks.last().map_or(f64::INFINITY, |last| rounding(exposures, last.objective));
        let highest = looks.last().map_or(f64::INFINITY, |last| last.objective + noise);
        // A number that is none is no fall either.
        let fell = objective <= highest;
        if !fell && halvings <= MOST_HALVINGS {
            halvings += 1;
            // The last time, what is left of the step is taken back.
            let share = 0.5_f64.powi(halvings.min(MOST_HALVINGS));
            estimate.advance(&search.x, -share);
            continue;
        }
        let stuck = halvings > MOST_HALVINGS;
        halvings = 0;
        search.start(&estimate.sensitivity, estimate.beams(), control)?;
        looks.push(Look { sweep: products, objective, error: smallest.error(&search) });
        smallest.stuck |= stuck;
        let ended = ended(&looks, &smallest, options, limit, noise);
        if ended == Some(Ended::Stalled) && !smallest.settled && rescues < MOST_RESCUES {
            rescues += 1;
            smallest.stuck = false;
            for _ in 0..RESCUE_SWEEPS.min(limit.saturating_sub(products)) {
                estimate.sweep(control)?;
                products += 1;
            }
            search.forget(control);
            continue;
        }
        if let Some(ended) = ended {
            for (pixel, step) in search.left_out() {
                estimate.sensitivity[pixel] += step;
            }
            let left_out = search.left_out().map(|(pixel, _)| pixel).collect();
            return Ok((estimate, History { looks, ended }, left_out));
        }
        estimate.forget_beams();
        let total = forecast(&looks, options.tolerance).min(limit);
        let aim = AIM * options.tolerance;
        let reachable = reachable(&search);
        while products + 1 < limit {
            control.report("calibrate", products, total.max(products));
            let near = search.largest() <= reachable || smallest.left(&search) <= aim;
            let enough = near && smallest.iterations >= FEWEST_ITERATIONS;
            if enough || !smallest.iterate(&mut search, control)? {
                break;
            }
            products += 1;
        }
        estimate.advance(&search.x, 1.0);
    }
}

/// Why it has ended, if it has.
fn ended(
    looks: &[Look],
    smallest: &Smallest,
    options: &Options,
    limit: u64,
    rounding: f64,
) -> Option<Ended> {
    let last = looks.last()?;
    let certain = smallest.iterations >= FEWEST_ITERATIONS || smallest.settled;
    if certain && last.error <= options.tolerance {
        Some(Ended::Converged)
    } else if last.sweep >= limit {
        Some(Ended::SweepsUsed)
    } else if smallest.settled || smallest.stuck || stalled(looks, rounding) {
        Some(Ended::Stalled)
    } else {
        None
    }
}

/// The size of P⁻¹ r that a step can reach: what linearising adds, which is a product of relative
/// steps in M and in L, or what single precision holds.
fn reachable<T: Real>(search: &ConjugateGradients<'_, '_, T>) -> f64 {
    search.largest() * search.size().clamp(PRECISION, MOST_CURVED)
}

/// Whether neither the estimate has fallen by half for some steps, nor F by more than rounding.
fn stalled(looks: &[Look], rounding: f64) -> bool {
    stalled_since(looks).is_some_and(|earlier| {
        looks[earlier].objective - looks[looks.len() - 1].objective <= rounding
    })
}

/// The number of products in all, if the error goes on to fall as it did from the first look on.
fn forecast(looks: &[Look], tolerance: f64) -> u64 {
    let [first, .., last] = looks else { return TYPICAL };
    let rate = (first.error / last.error).ln() / (last.sweep - first.sweep) as f64;
    let missing = (last.error / tolerance).ln() / rate;
    if missing.is_finite() && rate > 0.0 {
        last.sweep.saturating_add(missing.max(0.0) as u64)
    } else {
        TYPICAL
    }
}

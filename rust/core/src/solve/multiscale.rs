//! The fast solver: Gauss-Newton steps on all scales at once.
//!
//! Each step solves a linear problem (`reduced.rs`) by conjugate gradients with a preconditioner of
//! two levels (`reduced/two_level.rs`), in single precision, and then takes M → M + x in double precision,
//! with L at its closed form. The number of products does not depend
//! on the size of the sensor, where coordinate descent takes (size/shift)² sweeps.
//!
//! The first step from equal pixels is that of the problem of ln L and ln M, which is linear but for noise:
//! it comes to M at once where others take steps that are short at first. All others are linear in M. With
//! M → M·eᵍ a dead pixel whose best M is below 0 would never get there.

use super::descent::one_sweep;
use super::options::Options;
use super::start;
use crate::control::Control;
use crate::convergence::{
    Ended, FEWEST_ITERATIONS, History, Look, MOST_HALVINGS, rounding, stalled_since,
};
use crate::error::Result;
use crate::exposures::Exposures;
use crate::fit::Start;
use crate::frames::Real;
use crate::parallel::Workers;
use crate::reduced::{ConjugateGradients, Scale, Smallest, Whole};
use crate::sweep::{Difference, Estimate, Logarithmic, Plain};
use crate::weak_light::WeakLight;

/// Upper limit on products: an experiment that needs more cannot be solved by this method.
const MOST_PRODUCTS: u64 = 100_000;
/// How much of the tolerance a step aims at; the rest is for what linearising adds.
const AIM: f64 = 0.8;
/// The most that one step reduces P⁻¹ r by: single precision holds no more.
const PRECISION: f64 = 1e-5;
/// The most that the first step reduces the error by: what noise makes of a logarithm is left.
const BY_LOGARITHMS: f64 = 1e-4;
/// The largest change of an M by one step, relative to the mean.
const LONGEST: f64 = 4.0;
/// Where steps lead nowhere, so many plain sweeps go on, which always do, and so many times.
const RESCUE_SWEEPS: u64 = 32;
const MOST_RESCUES: u32 = 8;
/// Products after which the estimate must be below 1. Where it is not, the light is so weak that F falls for ever
/// by fitting noise: all experiments known to converge are below 1 after half as many.
const LOST: u64 = 2000;
/// What linearising adds, a product of relative steps in M and in L, counts as this share of a step at most.
const MOST_CURVED: f64 = 0.1;
/// Products that an ordinary calibration takes: what progress is measured against at first.
const TYPICAL: u64 = 60;

/// Minimises F until the estimated error of M is at most the tolerance, the products are used up,
/// or the estimate no longer falls. Returns what is known of weak light too.
///
/// # Errors
/// [`Error::Value`](crate::Error::Value) for a tolerance that is not a positive number or a limit of
/// 0 sweeps, [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
pub(crate) fn minimise<'m, 'a, T: Real>(
    exposures: &'m Exposures<'a, T>,
    options: &Options,
    start: Option<Start>,
    workers: &'m Workers,
    control: &Control,
) -> Result<(Estimate<'m, 'a, T>, History, WeakLight)> {
    let mut steps = Steps::new(exposures, options, start, workers, control)?;
    loop {
        if let Some(ended) = steps.next(control)? {
            let Steps { estimate, looks, weak, .. } = steps;
            return Ok((estimate, History { looks, ended }, weak));
        }
    }
}

/// Steps towards the minimum.
struct Steps<'m, 'a, T: Real> {
    estimate: Estimate<'m, 'a, T>,
    search: ConjugateGradients<'m, 'a, T>,
    smallest: Smallest,
    /// The prior of M in weak light.
    weak: WeakLight,
    tolerance: f64,
    /// The factor of slopes.
    scale: f64,
    /// The most products.
    limit: u64,
    products: u64,
    looks: Vec<Look>,
    /// Whether the first step is that of logarithms.
    by_logarithms: bool,
    /// How much of the direction found the last step went.
    length: f64,
    halvings: i32,
    rescues: u32,
}

impl<'m, 'a, T: Real> Steps<'m, 'a, T> {
    fn new(
        exposures: &'m Exposures<'a, T>,
        options: &Options,
        start: Option<Start>,
        workers: &'m Workers,
        control: &Control,
    ) -> Result<Self> {
        let limit = options.limit(MOST_PRODUCTS)?;
        let by_logarithms = start.is_none() && limit >= TYPICAL;
        Ok(Self {
            limit,
            estimate: start::estimate(exposures, start, workers, control)?,
            search: ConjugateGradients::new(exposures, workers, control),
            smallest: Smallest::default(),
            weak: WeakLight::new(),
            tolerance: options.tolerance,
            scale: Scale::of(exposures).slope(),
            products: 0,
            looks: Vec::new(),
            // Its products are lost where the light turns out weak: with few there must be none.
            by_logarithms,
            length: 1.0,
            halvings: 0,
            rescues: 0,
        })
    }

    /// One step, or a shorter last one; says why the search has ended, if it has.
    fn next(&mut self, control: &Control) -> Result<Option<Ended>> {
        let first = self.by_logarithms && self.looks.is_empty();
        let mut objective = if first {
            self.slopes::<Logarithmic>(control)?
        } else {
            self.slopes::<Plain>(control)?
        };
        let noise = self
            .looks
            .last()
            .map_or(f64::INFINITY, |last| rounding(self.search.reduced.exposures, last.objective));
        let highest = self.looks.last().map_or(f64::INFINITY, |last| last.objective + noise);
        // A number that is none is no fall either.
        let fell = objective <= highest;
        if self.gives_up_logarithms(fell, control)? || self.takes_back(fell) {
            return Ok(None);
        }
        let stuck = self.halvings > MOST_HALVINGS;
        self.halvings = 0;
        if !first && self.weighs_anew(control)? {
            objective = self.slopes::<Plain>(control)?;
            // That of another S.
            self.smallest = Smallest::default();
        }
        self.look(objective, first, control)?;
        self.smallest.stuck |= stuck;
        let ended = self.ended(noise);
        if ended == Some(Ended::Stalled) && self.rescues(control)? {
            return Ok(None);
        }
        if ended.is_none() {
            self.step(first, control)?;
        }
        Ok(ended)
    }

    /// Brings L to its closed form and the slopes into the search; returns F + R.
    fn slopes<D: Difference>(&mut self, control: &Control) -> Result<f64> {
        self.products += 1;
        self.estimate.slopes::<D>(self.scale, &mut self.search.residual, control)
    }

    /// Takes the prior that follows from the residuals; whether it is another one.
    fn weighs_anew(&mut self, control: &Control) -> Result<bool> {
        let mut problem = Whole { estimate: &mut self.estimate, search: &mut self.search };
        self.weak.update(&mut problem, control)
    }

    /// Starts again without logarithms if their step raised F or the light is weak: those of noise say
    /// nothing.
    fn gives_up_logarithms(&mut self, fell: bool, control: &Control) -> Result<bool> {
        let may_stay = !self.by_logarithms || self.looks.len() != 1;
        let mut problem = Whole { estimate: &mut self.estimate, search: &mut self.search };
        if may_stay || (fell && !self.weak.may_be(&mut problem, control)?) {
            return Ok(false);
        }
        self.by_logarithms = false;
        self.smallest = Smallest::default();
        self.search.renew();
        self.looks.clear();
        self.estimate.start(control)?;
        Ok(true)
    }

    /// Takes a part of the last step back if F rose. F is no parabola in M far from its minimum: a step may
    /// be too long. It is shortened even where that takes more products than allowed.
    fn takes_back(&mut self, fell: bool) -> bool {
        if fell || self.halvings > MOST_HALVINGS {
            return false;
        }
        self.halvings += 1;
        // The last time, what is left of the step is taken back.
        let share = 0.5_f64.powi(self.halvings.min(MOST_HALVINGS));
        self.estimate.advance::<Plain>(&self.search.x, -share * self.length);
        true
    }

    /// Prepares the linear problem at this M, and estimates the error.
    fn look(&mut self, objective: f64, first: bool, control: &Control) -> Result<()> {
        let Estimate { sensitivity, prior, .. } = &self.estimate;
        self.search.linearise(sensitivity, self.estimate.beams(), prior.as_ref(), control)?;
        if first {
            self.search.take_gauge_out();
        }
        self.search.begin(control)?;
        let error = self.smallest.error(&self.search);
        self.looks.push(Look::new(self.products, objective, error));
        Ok(())
    }

    /// Why it has ended, if it has.
    fn ended(&self, rounding: f64) -> Option<Ended> {
        let last = self.looks.last()?;
        let Smallest { iterations, settled, stuck, .. } = self.smallest;
        let certain = iterations >= FEWEST_ITERATIONS || settled;
        if certain && last.error <= self.tolerance {
            Some(Ended::Converged)
        } else if last.sweep >= self.limit {
            Some(Ended::SweepsUsed)
        } else if settled || stuck || self.is_lost() || stalled(&self.looks, rounding) {
            Some(Ended::Stalled)
        } else {
            None
        }
    }

    /// Whether many products have not brought M within its own size.
    fn is_lost(&self) -> bool {
        let is_far = |last: &Look| last.sweep >= LOST && (last.error >= 1.0 || last.error.is_nan());
        self.looks.last().is_some_and(is_far)
    }

    /// Where steps lead nowhere, some sweeps, which always do; whether it may go on.
    fn rescues(&mut self, control: &Control) -> Result<bool> {
        if self.smallest.settled || self.is_lost() || self.rescues >= MOST_RESCUES {
            return Ok(false);
        }
        self.rescues += 1;
        self.smallest.stuck = false;
        for _ in 0..RESCUE_SWEEPS.min(self.limit.saturating_sub(self.products)) {
            one_sweep(&mut self.estimate, &mut self.search, control)?;
            self.products += 1;
        }
        self.search.forget(control);
        Ok(true)
    }

    /// Solves the linear problem as far as a step can reach, and takes the step.
    fn step(&mut self, first: bool, control: &Control) -> Result<()> {
        self.estimate.forget_beams();
        self.iterate(first, control)?;
        if first {
            self.length = 1.0;
            self.estimate.advance::<Logarithmic>(&self.search.x, 1.0);
        } else {
            let found = self.search.found();
            self.length = if found > LONGEST { LONGEST / found } else { 1.0 };
            self.estimate.advance::<Plain>(&self.search.x, self.length);
        }
        Ok(())
    }

    /// Iterates until what is left is what a step can reach, or below what is aimed at.
    fn iterate(&mut self, first: bool, control: &Control) -> Result<()> {
        let total = forecast(&self.looks, self.tolerance).min(self.limit);
        let aim = AIM * self.tolerance;
        let share =
            if first { BY_LOGARITHMS } else { self.search.size().clamp(PRECISION, MOST_CURVED) };
        let reachable = self.search.largest() * share;
        while self.products + 1 < self.limit {
            control.report("calibrate", self.products, total.max(self.products));
            let near =
                self.search.largest() <= reachable || self.smallest.left(&self.search) <= aim;
            let enough = near && self.smallest.iterations >= FEWEST_ITERATIONS;
            if enough || !self.smallest.iterate(&mut self.search, control)? {
                break;
            }
            self.products += 1;
        }
        Ok(())
    }
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

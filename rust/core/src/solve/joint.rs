//! The joint fit: Gauss-Newton steps in beam, fluxes and shifts, with the pixels eliminated.

use super::course::Course;
use super::found::Found;
use super::options::Options;
use super::start;
use crate::beam::Beam;
use crate::connectivity::NONE;
use crate::control::Control;
use crate::convergence::{
    Ended, FEWEST_ITERATIONS, History, Look, MOST_HALVINGS, ROUNDING, rounding, stalled_since,
};
use crate::error::Result;
use crate::exposures::{Exposures, FluxKind};
use crate::fit::{Fit, Refinement, Start};
use crate::frames::Real;
use crate::gauge::FluxGauge;
use crate::joint::{self, ConjugateGradients, Directions, Known, Precision, Preconditioner};
use crate::joint::{ShiftPrior, System};
use crate::memory;
use crate::parallel::Workers;
use crate::weak_light::WeakLight;

/// Upper limit on products.
const MOST_PRODUCTS: u64 = 5000;
/// The estimated error of M at which shifts begin to be refined.
const BEFORE_SHIFTS: f64 = 1e-3;
/// How much of the tolerance a search aims at; the rest is for what linearising adds.
const AIM: f64 = 0.5;
/// What linearising adds counts as this share of a step at most, and at least: a step is in single precision.
const CURVED: [f64; 2] = [f32::EPSILON as f64, 0.03];
/// What a step leaves of the error where shifts are sought, whose second derivatives the linear problem does
/// not know.
const BY_SHIFTS: f64 = 0.1;
/// Passes without progress after which a fit has stalled where shifts are sought: the steps are short.
const PATIENCE_BY_SHIFTS: u64 = 150;
/// Products of a search without one that halves P⁻¹ r, after which it ends: what is left is rounding, or lies along
/// patterns that rounding does not resolve.
const PATIENCE_OF_A_SEARCH: u64 = 200;
/// The most that one step reduces the error by where products are made in single precision.
const PRECISION: f64 = 1e-5;
/// Steps after which the weight of the penalty, which M has a part in, and the variance of a
/// measurement, where it is not known, count as found.
const SETTLING: usize = 3;
/// Passes over the measurements that a look takes at most: M, the weights, a product.
const A_LOOK: u64 = 3;
/// Passes that an ordinary fit takes: what progress is measured against at first.
const TYPICAL: u64 = 120;

/// Minimises F until the estimated error of M is at most the tolerance, the products are used up, or
/// the estimate no longer falls.
///
/// # Errors
/// [`Error::Memory`](crate::Error::Memory) before the first step if the memory for it cannot be had;
/// [`Error::Value`](crate::Error::Value) for a tolerance that is not a positive number or a limit of
/// 0, [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
pub(super) fn minimise<T: Real>(
    exposures: &Exposures<'_, T>,
    options: &Options,
    start: Option<Start>,
    workers: &Workers,
    control: &Control,
) -> Result<Found> {
    let given = exposures.flux();
    let exposures = &start::at_first_fluxes(exposures, start.as_ref(), control)?;
    let needed = joint::bytes_needed(exposures, exposures.flux())?;
    memory::check(Start::bytes_beside(start.as_ref(), needed), || {
        format!("fitting {} exposures of {} jointly", exposures.count(), exposures.sensor())
    })?;
    let mut steps = Steps::new(exposures, options, start, workers, control)?;
    loop {
        if let Some(ended) = steps.next(control)? {
            return steps.finish(ended, given, control);
        }
    }
}

/// Steps towards the minimum.
struct Steps<'m, 'a, T> {
    system: System<'m, 'a, T>,
    known: Known,
    /// Looks after which products are made in double precision alone, since single precision no longer sufficed.
    doubled: Option<usize>,
    options: &'m Options,
    /// The most passes.
    limit: u64,
    /// Sweeps that made the first beam.
    swept: u64,
    looks: Vec<Look>,
    /// The last step, in the units of single precision.
    taken: Option<Vec<f32>>,
    halvings: i32,
    /// Whether a step raised F at any length.
    stuck: bool,
    preconditioner: Option<Preconditioner>,
    /// The prior of M in weak light.
    weak: WeakLight,
    /// What is known of shifts that are refined later.
    shift_prior: Option<ShiftPrior>,
    refinement: Refinement,
    /// The last step, where shifts are sought.
    course: Option<Course>,
}

impl<'m, 'a, T: Real> Steps<'m, 'a, T> {
    fn new(
        exposures: &'m Exposures<'a, T>,
        options: &'m Options,
        start: Option<Start>,
        workers: &'m Workers,
        control: &Control,
    ) -> Result<Self> {
        let limit = options.limit(MOST_PRODUCTS)?;
        let (mut system, swept) = start::system(exposures, start.as_ref(), workers, control)?;
        let weak = WeakLight::new();
        let mut shift_prior = ShiftPrior::of(exposures.positions());
        let mut refinement =
            shift_prior.as_ref().map_or(Refinement::None, |_| Refinement::NotTried);
        // Shifts are refined from a beam that is nearly found: that of a start that has refined them.
        if let Some(start) = start.as_ref().filter(|start| start.refinement.is_done())
            && let Some(mut prior) = shift_prior.take()
        {
            refinement = start.refinement;
            prior.along = refinement.along();
            system.seek_shifts(Some(prior));
        }
        Ok(Self {
            system,
            known: Known::default(),
            doubled: None,
            options,
            limit,
            swept,
            looks: Vec::new(),
            taken: None,
            halvings: 0,
            stuck: false,
            preconditioner: None,
            weak,
            shift_prior,
            refinement,
            course: None,
        })
    }

    /// One step, or a shorter last one; says why the search has ended, if it has.
    fn next(&mut self, control: &Control) -> Result<Option<Ended>> {
        let mut linear = self.system.linearise(control)?;
        // Where shifts still move, cells come into the penalty, and F is not one function.
        let moving =
            self.system.seeks_shifts() && (self.looks.len() <= SETTLING || self.system.sees_more);
        if self.takes_back(linear.0, moving) {
            return Ok(None);
        }
        if self.system.sees_more {
            self.course = None;
        }
        if self.corrects_length(&linear.1) {
            return Ok(None);
        }
        let is_weighed_anew = self.weak.update(&mut self.system, control)?;
        if is_weighed_anew || (self.looks.len() < SETTLING && self.system.prior.is_some()) {
            self.system.renew_mean();
            linear = self.system.linearise(control)?;
            self.preconditioner = None;
        }
        let (objective, slope) = self.settled(linear, control)?;
        let preconditioner = match self.preconditioner.take() {
            Some(preconditioner) => preconditioner,
            None => Preconditioner::new(&mut self.system, control)?,
        };
        let is_single = self.doubled.is_none() && self.system.has_single();
        let look = if is_single { Self::look::<f32> } else { Self::look::<f64> };
        let sought = self.system.seeks_shifts();
        let ended = look(self, objective, slope, &preconditioner, control)?;
        // It has a place for shifts only if it was made where they are sought.
        let stays = !moving && sought == self.system.seeks_shifts();
        self.preconditioner = stays.then_some(preconditioner);
        Ok(ended)
    }

    /// A look at F with this slope, and a step, by a search in numbers of this precision; says why the search has
    /// ended, if it has.
    fn look<N: Precision>(
        &mut self,
        objective: f64,
        slope: Vec<f64>,
        preconditioner: &Preconditioner,
        control: &Control,
    ) -> Result<Option<Ended>> {
        self.system.settle();
        // It stays from here on.
        self.taken = None;
        let kept = self.system.seeks_shifts().then(|| self.system.slope_in(slope.clone()));
        let mut search = ConjugateGradients::<N>::after(self.known.clone());
        search.begin(&self.system, preconditioner, slope, control)?;
        let first = search.product(&mut self.system, control)?;
        let error = search.known.lowest.over(first);
        self.looks.push(Look::new(self.products(), objective, error));
        if self.begins_to_refine(error) {
            return Ok(None);
        }
        let ended = self.ended();
        if ended.is_none() {
            self.step(search, first, kept, preconditioner, control)?;
        }
        Ok(ended)
    }

    /// Takes a part of the last step back if F rose.
    fn takes_back(&mut self, objective: f64, moving: bool) -> bool {
        let exposures = self.system.pass.exposures;
        let last = self.looks.last().filter(|_| !moving);
        let highest =
            last.map_or(f64::INFINITY, |last| last.objective + rounding(exposures, last.objective));
        // A number that is none is no fall either.
        let fell = objective <= highest;
        if let Some(x) = &self.taken
            && !fell
            && self.halvings <= MOST_HALVINGS
        {
            // The last time, what is left of the step is taken back.
            self.halvings += 1;
            self.stuck = self.halvings > MOST_HALVINGS;
            let share = 0.5_f64.powi(self.halvings.min(MOST_HALVINGS));
            self.system.advance(x, -share);
            self.course = None;
            return true;
        }
        self.halvings = 0;
        false
    }

    /// F and its slope, at the first looks with the variance and the penalty's weight found anew.
    fn settled(&mut self, linear: (f64, Vec<f64>), control: &Control) -> Result<(f64, Vec<f64>)> {
        if self.looks.len() >= SETTLING {
            return Ok(linear);
        }
        if !self.system.pass.exposures.variance_is_known() {
            let freedom = joint::freedom(&self.system) + self.weak.freed;
            self.system.unit = self.system.misfit / freedom;
        }
        drop(linear);
        self.system.renew(control)
    }

    /// Seeks the shifts too, once the beam is nearly found, if it has structure.
    fn begins_to_refine(&mut self, error: f64) -> bool {
        let near = error <= BEFORE_SHIFTS.max(self.options.tolerance)
            && self.known.iterations >= FEWEST_ITERATIONS;
        let Some(mut prior) = self.shift_prior.take_if(|_| near) else { return false };
        self.refinement = match self.system.determined_directions(&prior) {
            Directions::None => Refinement::Undetermined,
            Directions::One(along) => Refinement::Along(along),
            Directions::Both => Refinement::Done,
        };
        if !self.refinement.is_done() {
            return false;
        }
        prior.along = self.refinement.along();
        self.system.seek_shifts(Some(prior));
        (self.known, self.taken, self.looks) = (Known::default(), None, Vec::new());
        true
    }

    /// Searches for a step and takes it, with the slope where it begins if shifts are sought.
    fn step<N: Precision>(
        &mut self,
        mut search: ConjugateGradients<N>,
        first: f64,
        slope: Option<Vec<f32>>,
        preconditioner: &Preconditioner,
        control: &Control,
    ) -> Result<()> {
        let least = if N::IS_SINGLE { PRECISION } else { CURVED[0] };
        let share = if slope.is_some() { BY_SHIFTS } else { first.clamp(least, CURVED[1]) };
        let reachable = first * share;
        let (mut least, mut waited) = (first, 0);
        while self.products() + A_LOOK < self.limit && waited < PATIENCE_OF_A_SEARCH {
            let done = self.products();
            control.report("calibrate", done, TYPICAL.max(done).min(self.limit));
            if !search.step(&self.system, preconditioner, control)? {
                break;
            }
            control.check()?;
            let size = search.product(&mut self.system, control)?;
            (least, waited) = if size < 0.5 * least { (size, 0) } else { (least, waited + 1) };
            let aim = AIM * self.options.tolerance;
            let near = size <= reachable || search.known.lowest.over(size) <= aim;
            if near && search.known.iterations >= FEWEST_ITERATIONS {
                break;
            }
        }
        let (mut step, known) = search.found();
        self.known = known;
        // A multiple of the beam is no step, but the penalty would see one.
        let cells = self.system.state.beam.len();
        self.system.take_scale_out(&mut step[..cells]);
        let turn =
            |slope| Course::turn(&mut step, slope, self.course.as_ref(), self.system.pass.workers);
        self.course = slope.map(turn);
        self.system.advance(&step, 1.0);
        self.taken = Some(step);
        if waited == PATIENCE_OF_A_SEARCH && N::IS_SINGLE {
            // Its smallest Ritz value is that of rounding too.
            (self.doubled, self.known) = (Some(self.looks.len()), Known::default());
        }
        Ok(())
    }

    /// Brings the last step to the length at which F falls no further along it.
    fn corrects_length(&mut self, slope: &[f64]) -> bool {
        let workers = self.system.pass.workers;
        let (Some(course), system) = (&mut self.course, &self.system) else { return false };
        let fall = |direction: &[f32]| system.fall(direction, slope);
        let Some(missing) = course.missing(fall, workers) else { return false };
        self.system.advance(course.direction(), missing);
        if let Some(taken) = &mut self.taken {
            workers.add_multiple(taken, missing, course.direction());
        }
        true
    }

    /// Passes over the measurements so far.
    const fn products(&self) -> u64 {
        self.swept + self.system.pass.count
    }

    /// Why it has ended, if it has.
    fn ended(&self) -> Option<Ended> {
        let last = self.looks.last()?;
        let settled = last.error <= ROUNDING;
        let certain = self.known.iterations >= FEWEST_ITERATIONS || settled;
        let patience = if self.system.seeks_shifts() { PATIENCE_BY_SHIFTS } else { 0 };
        // What was estimated by a smallest Ritz value that has been forgotten is no progress to compare with.
        let since = self.doubled.unwrap_or_default();
        let looks = self.looks.get(since..).unwrap_or_default();
        let stalled = stalled_since(looks).is_some_and(|earlier| {
            since + earlier >= SETTLING && looks[earlier].sweep + patience <= last.sweep
        });
        if certain && last.error <= self.options.tolerance {
            Some(Ended::Converged)
        } else if last.sweep + A_LOOK >= self.limit {
            Some(Ended::SweepsUsed)
        } else if self.stuck || stalled {
            Some(Ended::Stalled)
        } else {
            None
        }
    }

    /// What was found, and what the fluxes leave to the gauge, with those given.
    fn finish(mut self, ended: Ended, given: &[f64], control: &Control) -> Result<Found> {
        (self.taken, self.course, self.preconditioner) = (None, None, None);
        self.system.free_products();
        let system = &self.system;
        let exposures = system.pass.exposures;
        let without_offset = system.without_offset();
        let history = History { looks: self.looks, ended };
        let smallest = self.known.lowest.found();
        let mut fit = fit(system, history, self.refinement, smallest, control)?;
        let priors = fit.prior.as_ref().zip(system.prior.as_ref());
        let (held, freed) = priors.map_or((Vec::new(), 0.0), |(weights, prior)| {
            self.weak.held(weights, system.information(), &fit.sensitivity, prior.mean)
        });
        fit.degrees_of_freedom =
            degrees_of_freedom(system, &fit, without_offset.len()) + freed.round() as i64;
        let fitted = matches!(exposures.flux_kind(), FluxKind::Free | FluxKind::Linear(_));
        let theta = system.state.theta.first().copied().unwrap_or_default();
        // Where exposures are turned against each other the slope of ln c is determined.
        let begun = if system.fluxes.open.is_empty() {
            [0.0; 2]
        } else {
            system.fluxes.split(given, &system.state.shifts).2
        };
        let fluxes = fitted.then(|| FluxGauge {
            slope: [0, 1].map(|axis| theta * system.fluxes.slope[axis] - begun[axis]),
            open: system.fluxes.open.clone(),
            rotation: exposures.positions().rotations[0],
            sensor: exposures.sensor(),
        });
        let mut held = [held, without_offset.clone()].concat();
        held.sort_unstable();
        held.dedup();
        Ok(Found { fit, held, dead: Vec::new(), without_offset, fluxes })
    }
}

/// The fit at the state of a problem.
fn fit<T: Real>(
    system: &System<'_, '_, T>,
    history: History,
    refinement: Refinement,
    smallest_ritz: f64,
    control: &Control,
) -> Result<Fit> {
    let (exposures, grid) = (system.pass.exposures, &system.pass.grid.geometry);
    let [sensitivity, offset] = system.pixels();
    let positions = exposures.positions();
    let shifts = if refinement.is_done() { &system.state.shifts } else { &positions.shifts };
    Ok(Fit {
        components: joint::components(system, control)?,
        sensitivity,
        offset: exposures.offset().then_some(offset),
        beam: Beam {
            values: joint::values_at_cells(system),
            coefficients: joint::coefficients(system),
            tilt: [0.0; 2],
            shape: grid.beam,
            origin: positions.origin(grid.origin),
        },
        flux: system.pass.flux.clone(),
        shifts: shifts.clone(),
        flags: Vec::new(),
        refinement,
        leaves_tilt: !system.fluxes.open.is_empty(),
        smallest_ritz: Some(smallest_ritz),
        misfit: system.misfit,
        degrees_of_freedom: 0,
        variance_is_known: exposures.variance_is_known(),
        history,
        few: system.pass.few.image(exposures.sensor().cols),
        lost: system.pass.few.lost.pixels(exposures.sensor().cols),
        prior: system.prior.as_ref().map(|prior| {
            prior.weights.iter().map(|weight| weight * prior.mean * prior.mean).collect()
        }),
    })
}

/// Measurements less unknowns of the search; each component has one unknown less than values, by its gauge.
fn degrees_of_freedom<T: Real>(
    system: &System<'_, '_, T>,
    fit: &Fit,
    without_offset: usize,
) -> i64 {
    let labels = fit.components.pixels.iter().filter(|&&label| label != NONE);
    let pixels = labels.count() - system.pass.few.pixels;
    let offsets = if fit.offset.is_some() { pixels - without_offset } else { 0 };
    let unknowns = joint::unknowns(system) + pixels + offsets - fit.components.sizes.len();
    system.used() as i64 - unknowns as i64
}

//! The joint fit of beam, fluxes and shifts: what whole shifts and a steady lamp do not need.
//!
//! ```text
//! F = Σ_k Σ_p w [ y − c_k L(A p + t + d_k) M(p) − O(p) ]² + τ ‖G a‖² + priors on ln c and d
//! ```
//!
//! L is a spline of coefficients a where shifts are no whole numbers (`joint/grid.rs`), so its part of
//! the normal matrix is banded while that of M stays diagonal. Hence M is eliminated, not L as in
//! [`multiscale`](crate::multiscale), and Gauss-Newton steps are taken in (a, ln c, d)
//! (`joint/system.rs`), by conjugate gradients in double precision with a preconditioner on two scales
//! (`joint/precondition.rs`). The penalty (`joint/penalty.rs`) is slight: τ is 1e-5 of the mean
//! weight of a cell.

mod covariance;
mod flux;
mod freedom;
mod gauge;
mod grid;
mod kernel;
mod pass;
mod penalty;
mod precondition;
mod rim;
mod survey;
mod system;
#[cfg(test)]
mod tests;
mod wide;

pub use covariance::Solved;
pub(crate) use covariance::{Covariance, Functional};
pub use flux::Flux;

use crate::conjugate::Ritz;
use crate::connectivity::{Components, Edges};
use crate::control::Control;
use crate::descent::Descent;
use crate::error::Result;
use crate::estimate::{
    Ended, FEWEST_ITERATIONS, History, Look, MOST_HALVINGS, Stop, rounding, stalled_since,
};
use crate::frames::{Real, Shape};
use crate::geometry::Rotation;
use crate::model::Model;
use crate::parallel::Workers;
use flux::Fluxes;
use grid::Grid;
use precondition::Preconditioner;
use system::{ShiftPrior, State, System};

/// The weight τ of the penalty, as a share of the mean weight of a cell.
pub const SMOOTHING: f64 = 1e-5;
/// Products that nobody waits for.
const MOST_PRODUCTS: u64 = 5000;
/// Sweeps that make the first beam.
const FIRST_SWEEPS: usize = 4;
/// A shift that is known is one with this standard deviation, in pixels.
const EXACT_SHIFT: f64 = 1e-6;
/// The estimated error of M at which shifts begin to be refined.
const BEFORE_SHIFTS: f64 = 1e-3;
/// A beam whose structure is so much larger than noise tells shifts; by the slopes of noise steps
/// would lead nowhere.
const TOLD: f64 = 10.0;
/// How far a shift may come from where it was measured, in pixels: the grid reaches no further.
const FURTHEST: f64 = 0.99;
/// How much of the tolerance a search aims at; the rest is for what linearising adds.
const AIM: f64 = 0.5;
/// What linearising adds counts as this share of a step at most, and at least.
const CURVED: [f64; 2] = [1e-8, 0.03];
/// Steps after which the weight of the penalty, which M has a part in, and the variance of a
/// measurement, where it is not known, count as found.
const SETTLING: usize = 3;
/// Passes over the measurements that a look takes at most: M, the weights, a product.
const A_LOOK: u64 = 3;
/// Passes that an ordinary fit takes: what progress is measured against at first.
const TYPICAL: u64 = 120;

/// What is unknown besides sensitivity and beam.
#[derive(Clone, Debug)]
pub struct Unknowns {
    /// The shift (row, column) of each exposure, in pixels.
    pub shifts: Vec<[f64; 2]>,
    /// Their standard deviations, if they are to be refined.
    pub shift_std: Option<Vec<[f64; 2]>>,
    /// What is known of the fluxes.
    pub flux: Flux,
    /// Whether frames hold an offset, to be found with M.
    pub offset: bool,
}

impl Unknowns {
    /// Whether there are none: whole shifts, known fluxes, no offset.
    #[must_use]
    pub fn is_none(&self) -> bool {
        let whole = self.shifts.iter().flatten().all(|shift| shift.fract() == 0.0);
        whole && self.shift_std.is_none() && self.flux == Flux::Known && !self.offset
    }
}

/// What became of shifts that were to be refined.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refinement {
    /// They were not to be.
    None,
    /// The fit ended before: they are as given.
    NotTried,
    /// The beam has no structure that tells them: they are as given.
    Untold,
    /// They are refined.
    Done,
}

/// What was found.
#[derive(Clone, Debug)]
pub struct Fit {
    /// M, row by row; 1 where no measurement tells.
    pub sensitivity: Vec<f64>,
    /// O, row by row, if it was sought.
    pub offset: Option<Vec<f64>>,
    /// L at the cells of its grid, row by row; NaN where no measurement tells.
    pub beam: Vec<f64>,
    /// The coefficients of the spline that L is, or L itself; of any value where no measurement tells.
    pub coefficients: Vec<f64>,
    /// Sizes of the grid.
    pub beam_shape: Shape,
    /// The cell that the sensor's first pixel sees at shift 0, unturned.
    pub origin: [usize; 2],
    /// c of each exposure.
    pub flux: Vec<f64>,
    /// The shift of each exposure.
    pub shifts: Vec<[f64; 2]>,
    /// What became of shifts that were to be refined.
    pub refinement: Refinement,
    /// Pixels whose measurements do not tell their offset, where one is sought, from their gain.
    pub untold: Vec<usize>,
    /// Whether the fluxes leave a tilt of ln M undetermined.
    pub leaves_tilt: bool,
    /// What the measurements can compare.
    pub components: Components,
    /// The smallest Ritz value: near 0 where the measurements do not tell some pattern.
    pub smallest_ritz: f64,
    /// F of the measurements alone.
    pub misfit: f64,
    /// How many numbers were found besides M and O; of a spline, those that measurements tell.
    pub unknowns: usize,
    /// The way here.
    pub history: History,
}

/// Minimises F until the estimated error of M is at most the tolerance, the products are used up, or
/// the estimate no longer falls.
///
/// # Errors
/// [`Error::Value`](crate::Error::Value) for a tolerance that is not a positive number or a limit of
/// 0, [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
pub fn solve<T: Real>(
    model: &Model<'_, T>,
    rotations: &[Rotation],
    unknowns: &Unknowns,
    stop: Stop,
    workers: &Workers,
    control: &Control,
) -> Result<Fit> {
    let limit = stop.limit(MOST_PRODUCTS)?;
    let mut system = start(model, rotations, unknowns, workers, control)?;
    let mut search = Search::default();
    let mut looks: Vec<Look> = Vec::new();
    let mut taken: Option<Vec<f64>> = None;
    let mut halvings = 0;
    let mut stuck = false;
    let mut preconditioner = None;
    // Shifts are refined from a beam that is nearly found.
    let mut shift_prior = shift_prior(unknowns);
    let mut shifts = shift_prior.as_ref().map_or(Refinement::None, |_| Refinement::NotTried);
    loop {
        let (objective, slope) = system.linearise(SMOOTHING, control)?;
        // Where shifts still move, cells come into the penalty, and F is not one function.
        let moving = system.shift_prior.is_some() && looks.len() <= SETTLING;
        let highest = looks
            .last()
            .filter(|_| !moving)
            .map_or(f64::INFINITY, |last| last.objective + rounding(model, last.objective));
        // A number that is none is no fall either.
        let fell = objective <= highest;
        if let Some(x) = &taken
            && !fell
            && halvings <= MOST_HALVINGS
        {
            // The last time, what is left of the step is taken back.
            halvings += 1;
            stuck = halvings > MOST_HALVINGS;
            let share = 0.5_f64.powi(halvings.min(MOST_HALVINGS));
            advance(&mut system, x, -share);
            continue;
        }
        halvings = 0;
        let (objective, slope) = if looks.len() < SETTLING {
            if !model.variance_is_known() {
                system.unit = system.misfit / freedom(&system);
            }
            system.renew(SMOOTHING, control)?
        } else {
            (objective, slope)
        };
        let two_level = match preconditioner.take() {
            Some(two_level) => two_level,
            None => Preconditioner::new(&mut system, control)?,
        };
        search.begin(&system, &two_level, slope, control)?;
        let first = search.product(&mut system, control)?;
        looks.push(Look { sweep: products(&system), objective, error: first / search.smallest });
        let near = first / search.smallest <= BEFORE_SHIFTS.max(stop.tolerance)
            && search.iterations >= FEWEST_ITERATIONS;
        if let Some(prior) = shift_prior.take_if(|_| near) {
            if system.structure() >= TOLD {
                shifts = Refinement::Done;
                system.shift_prior = Some(prior);
                (search, taken, looks) = (Search::default(), None, Vec::new());
                continue;
            }
            shifts = Refinement::Untold;
        }
        if let Some(ended) = ended(&looks, &search, &stop, limit, stuck) {
            let history = History { looks, ended };
            let mut fit = finish(&system, &search, history, shifts, control)?;
            if matches!(unknowns.flux, Flux::Free | Flux::Linear(_)) {
                let theta = system.state.theta.first().copied().unwrap_or_default();
                let drift = system.fluxes.slope.map(|slope| theta * slope);
                gauge::fix(&mut fit, drift, &system.fluxes.open, rotations[0], model.sensor());
            }
            return Ok(fit);
        }
        let reachable = first * first.clamp(CURVED[0], CURVED[1]);
        while products(&system) + A_LOOK < limit {
            let done = products(&system);
            control.report("calibrate", done, TYPICAL.max(done).min(limit));
            if !search.step(&system, &two_level) {
                break;
            }
            control.check()?;
            let size = search.product(&mut system, control)?;
            let near = size <= reachable || size / search.smallest <= AIM * stop.tolerance;
            if near && search.iterations >= FEWEST_ITERATIONS {
                break;
            }
        }
        let mut step = std::mem::take(&mut search.x);
        // A multiple of the beam is no step, but the penalty would see one.
        system.take_scale_out(&mut step[..system.grid.geometry.beam.len()]);
        advance(&mut system, &step, 1.0);
        taken = Some(step);
        preconditioner = (!moving).then_some(two_level);
    }
}

/// What the joint fit holds beside the measurements at its fullest, in bytes:
///
/// | array | in bytes |
/// |---|---|
/// | the light of each measurement | 8 |
/// | M, its normal matrix, its change; O and two more elements | 24 or 48 for each pixel |
/// | the sums of all bands ([`pass`]) | 8 · 2.2 at most for each cell of each view |
/// | the beam, seven vectors of a search, weights, the penalty, the preconditioner | 8 · 16 for each cell |
/// | with turned exposures, the beam and a vector in each view, and what was found there | 24 for each cell of each view |
/// | the rim and its factor | some 2000 for each of its cells, [`rim::WIDEST`] of each row and column at most |
/// | the result and its components | 30 for each pixel, 21 for each cell |
pub(crate) fn bytes_needed<T: Real>(model: &Model<'_, T>, unknowns: &Unknowns) -> u64 {
    let geometry = &model.geometry;
    let (pixels, cells) = (geometry.sensor.len() as u64, geometry.beam.len() as u64);
    let (count, views) = (model.count() as u64, geometry.views.len() as u64);
    let of_pixel = 8 * count + if unknowns.offset { 48 } else { 24 } + 30;
    let turned = if views > 1 { 24 * views } else { 0 };
    let rim = 2000 * rim::WIDEST as u64 * (geometry.beam.rows + geometry.beam.cols) as u64;
    of_pixel * pixels
        + (18 * views + turned + 149) * cells
        + rim
        + crate::precondition::bytes_needed(geometry)
}

/// What the covariance of a joint fit holds beside the measurements, in bytes: the fit's, and for each
/// pixel the gauge, a change, and the map.
pub(crate) fn bytes_needed_by_covariance<T: Real>(
    model: &Model<'_, T>,
    unknowns: &Unknowns,
) -> u64 {
    bytes_needed(model, unknowns) + 112 * model.geometry.sensor.len() as u64
}

/// Passes over the measurements so far.
fn products<T: Real>(system: &System<'_, '_, T>) -> u64 {
    FIRST_SWEEPS as u64 + system.passes
}

/// Why it has ended, if it has.
fn ended(looks: &[Look], search: &Search, stop: &Stop, limit: u64, stuck: bool) -> Option<Ended> {
    let last = looks.last()?;
    let settled = last.error == 0.0;
    let stalled = stalled_since(looks).is_some_and(|earlier| earlier >= SETTLING);
    if (search.iterations >= FEWEST_ITERATIONS || settled) && last.error <= stop.tolerance {
        Some(Ended::Converged)
    } else if last.sweep + A_LOOK >= limit {
        Some(Ended::SweepsUsed)
    } else if stuck || stalled {
        Some(Ended::Stalled)
    } else {
        None
    }
}

/// The problem at a first beam, from some sweeps at the nearest whole shifts.
fn start<'m, 'a, T: Real>(
    model: &'m Model<'a, T>,
    rotations: &[Rotation],
    unknowns: &Unknowns,
    workers: &'m Workers,
    control: &Control,
) -> Result<System<'m, 'a, T>> {
    let grid =
        Grid::new(model.sensor(), &unknowns.shifts, rotations, unknowns.shift_std.is_some())?;
    let fluxes = Fluxes::new(&unknowns.flux, &unknowns.shifts, rotations);
    let mut descent = Descent::new(model, workers, control);
    descent.start_bright(control)?;
    for _ in 0..FIRST_SWEEPS {
        descent.sweep(control)?;
    }
    let state = State {
        beam: first_beam(&grid, &descent, model, workers, control)?,
        theta: vec![0.0; fluxes.columns.len()],
        shifts: unknowns.shifts.clone(),
    };
    Ok(System::new(model, grid, fluxes, unknowns.offset, state, workers, control))
}

/// What is known of shifts that are to be refined.
fn shift_prior(unknowns: &Unknowns) -> Option<ShiftPrior> {
    unknowns.shift_std.as_ref().map(|std| ShiftPrior {
        measured: unknowns.shifts.clone(),
        precisions: std.iter().map(|std| std.map(|std| std.max(EXACT_SHIFT).powi(-2))).collect(),
    })
}

/// The beam that sweeps at whole shifts have found, on the grid: cells around take what is beside them.
fn first_beam<T: Real>(
    grid: &Grid,
    descent: &Descent<'_, '_, T>,
    model: &Model<'_, T>,
    workers: &Workers,
    control: &Control,
) -> Result<Vec<f64>> {
    let (shape, origin) = (grid.geometry.beam, grid.geometry.origin);
    let (from, start) = (model.geometry.beam, model.geometry.origin);
    let (known, places) = (&descent.beams()[0], model.geometry.views[0].places);
    let mut beam = workers.filled(shape.len(), 0.0, control);
    workers.map_blocks(&mut beam, shape.cols, |row, cells| {
        let row = (row + start[0]).checked_sub(origin[0]).filter(|&row| row < from.rows);
        let Some(row) = row else { return };
        for (col, value) in cells.iter_mut().enumerate() {
            let col = (col + start[1]).checked_sub(origin[1]).filter(|&col| col < from.cols);
            *value = col.map_or(0.0, |col| known[places.at(row, col)]);
        }
    });
    if !grid.is_spline() {
        return Ok(beam);
    }
    // As far as factors and margins reach beyond the nearest whole shift.
    let mut before = workers.filled(shape.len(), 0.0, control);
    for _ in 0..grid.width {
        control.check()?;
        before.copy_from_slice(&beam);
        workers.map_blocks(&mut beam, shape.cols, |row, cells| {
            let dark = cells.iter_mut().enumerate().filter(|(_, value)| **value == 0.0);
            for (col, value) in dark {
                let cell = row * shape.cols + col;
                let beside = [
                    (row > 0).then(|| cell - shape.cols),
                    (row + 1 < shape.rows).then(|| cell + shape.cols),
                    (col > 0).then(|| cell - 1),
                    (col + 1 < shape.cols).then(|| cell + 1),
                ];
                let lit = beside.into_iter().flatten().map(|cell| before[cell]);
                let lit = lit.filter(|&a| a != 0.0);
                let (sum, count) = lit.fold((0.0, 0.0), |(sum, count), a| (sum + a, count + 1.0));
                if count > 0.0 {
                    *value = sum / count;
                }
            }
        });
    }
    Ok(beam)
}

/// Takes a share of a step.
fn advance<T: Real>(system: &mut System<'_, '_, T>, x: &[f64], share: f64) {
    let cells = system.state.beam.len();
    system.workers.add_multiple(&mut system.state.beam, share, &x[..cells]);
    let params = system.state.theta.len();
    for (theta, step) in system.state.theta.iter_mut().zip(&x[cells..]) {
        *theta += share * step;
    }
    let moves = system.centred(&x[cells + params..]);
    let shifts = system.state.shifts.as_flattened_mut().iter_mut();
    shifts.zip(moves.as_flattened()).for_each(|(shift, step)| *shift += share * step);
    if let Some(prior) = &system.shift_prior {
        let measured = prior.measured.as_flattened();
        for (shift, measured) in system.state.shifts.as_flattened_mut().iter_mut().zip(measured) {
            *shift = shift.clamp(measured - FURTHEST, measured + FURTHEST);
        }
    }
}

/// Measurements less unknowns.
fn freedom<T: Real>(system: &System<'_, '_, T>) -> f64 {
    let pixels = system.measured() * (1 + usize::from(system.with_offset));
    system.model.used().saturating_sub(pixels + unknowns(system)).max(1) as f64
}

fn unknowns<T: Real>(system: &System<'_, '_, T>) -> usize {
    let seen = system.weights.iter().filter(|&&weight| weight > 0.0).count();
    let params = system.size() - system.state.beam.len();
    if !system.grid.is_spline() {
        return seen + params;
    }
    let weights = system.model.exposure_weights();
    let total: f64 = weights.iter().sum();
    let shares: Vec<f64> = weights.iter().map(|weight| weight / total).collect();
    let windows = system.grid.windows(&system.state.shifts);
    (freedom::told(&windows, &shares, SMOOTHING) * seen as f64).round() as usize + params
}

fn finish<T: Real>(
    system: &System<'_, '_, T>,
    search: &Search,
    history: History,
    refinement: Refinement,
    control: &Control,
) -> Result<Fit> {
    let [sensitivity, offset] = system.pixels();
    Ok(Fit {
        components: components(system, control)?,
        sensitivity,
        offset: system.with_offset.then_some(offset),
        beam: values_at_cells(system),
        coefficients: system.state.beam.clone(),
        beam_shape: system.grid.geometry.beam,
        origin: system.grid.geometry.origin,
        flux: system.flux.clone(),
        shifts: system.state.shifts.clone(),
        refinement,
        untold: system.untold(),
        leaves_tilt: !system.fluxes.open.is_empty(),
        smallest_ritz: search.smallest,
        misfit: system.misfit,
        unknowns: unknowns(system),
        history,
    })
}

/// The components of pixels and cells. Along an axis where all shifts differ by whole numbers of pixels,
/// a pixel hangs on one value of the beam; else on the two beside it, which is a necessary condition
/// alone: then a Ritz value near 0 tells of patterns that nothing compares.
fn components<T: Real>(system: &System<'_, '_, T>, control: &Control) -> Result<Components> {
    let Grid { geometry, sensor, .. } = &system.grid;
    let shifts = &system.state.shifts;
    let whole = [0, 1].map(|axis| {
        let apart = |d: &[f64; 2]| d[axis] - shifts[0][axis];
        shifts.iter().all(|d| apart(d).fract() == 0.0)
    });
    let windows = system.grid.windows(shifts);
    let mut edges = Edges::new(sensor.len(), geometry.beam.len());
    system.model.for_each_measurement(control, |exposure, row, col| {
        let window = &windows[exposure];
        let cells = geometry.views[window.view].cells;
        let [down, along] = if window.swaps_axes { [whole[1], whole[0]] } else { whole };
        for i in window.along_rows.around(down) {
            for j in window.along_cols.around(along) {
                let cell = cells.at(row + window.row + i, col + window.col + j);
                edges.add(row * sensor.cols + col, cell);
            }
        }
    })?;
    edges.components(control)
}

/// L at the cells: Σ_j a_j B(u − j) with B = 1/6, 4/6, 1/6 at whole numbers; NaN where a coefficient
/// that it takes is not seen.
fn values_at_cells<T: Real>(system: &System<'_, '_, T>) -> Vec<f64> {
    let beam = &system.state.beam;
    let seen = |cell: usize| system.weights[cell] > 0.0;
    if !system.grid.is_spline() {
        return (0..beam.len())
            .map(|cell| if seen(cell) { beam[cell] } else { f64::NAN })
            .collect();
    }
    const FACTORS: [f64; 3] = [1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0];
    let Shape { rows, cols } = system.grid.geometry.beam;
    let mut values = vec![f64::NAN; beam.len()];
    system.workers.map_blocks(&mut values, cols, |row, values| {
        if row == 0 || row + 1 == rows {
            return;
        }
        for (col, value) in values.iter_mut().enumerate().take(cols - 1).skip(1) {
            let around = (0..9).map(|i| ((row + i / 3 - 1) * cols + col + i % 3 - 1, i));
            if around.clone().all(|(cell, _)| seen(cell)) {
                *value = around.map(|(cell, i)| FACTORS[i / 3] * FACTORS[i % 3] * beam[cell]).sum();
            }
        }
    });
    values
}

/// Conjugate gradients for S x = b, in double precision.
#[derive(Default)]
struct Search {
    x: Vec<f64>,
    residual: Vec<f64>,
    direction: Vec<f64>,
    /// S times the direction, then P⁻¹ r.
    product: Vec<f64>,
    square: f64,
    keep: f64,
    /// x · b, of which b − S x lacks some.
    energy: f64,
    ritz: Ritz,
    /// The smallest Ritz value of all searches; at first the eigenvalue of smooth errors.
    smallest: f64,
    iterations: u64,
    /// Whether the preconditioner does.
    sees_large_scales: bool,
}

impl Search {
    fn begin<T: Real>(
        &mut self,
        system: &System<'_, '_, T>,
        preconditioner: &Preconditioner,
        slope: Vec<f64>,
        control: &Control,
    ) -> Result<()> {
        if self.iterations == 0 {
            self.smallest = crate::precondition::DAMPING;
        }
        self.sees_large_scales = preconditioner.sees_large_scales();
        let zeros = || system.workers.filled(slope.len(), 0.0, control);
        self.x = zeros();
        if self.direction.len() != slope.len() {
            (self.direction, self.product) = (zeros(), zeros());
        }
        control.check()?;
        preconditioner.apply(system, &slope, &mut self.direction);
        self.square = system.workers.dot(&slope, &self.direction);
        self.residual = slope;
        self.keep = 0.0;
        self.energy = 0.0;
        self.ritz = Ritz::default();
        Ok(())
    }

    /// Multiplies S by the direction; returns the largest relative change of M that goes with P⁻¹ r.
    fn product<T: Real>(
        &mut self,
        system: &mut System<'_, '_, T>,
        control: &Control,
    ) -> Result<f64> {
        let Self { direction, product, keep, .. } = self;
        let size = system.multiply(direction, product, *keep, control)? / system.mean;
        let known = size.is_finite() && self.square.is_finite() && self.sees_large_scales;
        Ok(if known { size } else { f64::INFINITY })
    }

    /// A step along the direction, and a new direction; `false` if there was none to go.
    fn step<T: Real>(
        &mut self,
        system: &System<'_, '_, T>,
        preconditioner: &Preconditioner,
    ) -> bool {
        let workers = system.workers;
        let step = self.square / workers.dot(&self.direction, &self.product);
        if !(step > 0.0 && step.is_finite()) {
            return false;
        }
        self.energy += step * self.square;
        workers.add_multiple(&mut self.x, step, &self.direction);
        workers.add_multiple(&mut self.residual, -step, &self.product);
        preconditioner.apply(system, &self.residual, &mut self.product);
        let square = workers.dot(&self.residual, &self.product);
        self.keep = square / self.square;
        workers.add_multiple(&mut self.product, self.keep, &self.direction);
        std::mem::swap(&mut self.direction, &mut self.product);
        self.ritz.push(step, self.keep);
        self.square = square;
        self.smallest = self.smallest.min(self.ritz.smallest());
        self.iterations += 1;
        square > 0.0
    }
}

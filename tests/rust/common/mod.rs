//! The one place where these tests meet the crate: an experiment goes in, a plain answer comes out.
//!
//! The tests know no other name of the crate, so that a change of its interface changes this file alone.

#![allow(
    clippy::redundant_closure_for_method_calls,
    reason = "the methods are not general enough in their lifetimes"
)]

use std::num::NonZeroUsize;

use equipix_core::{
    Beam, Control, Ended, Error, Exposures, Fit, Flux, FluxKind, Mask, Measurements, Positions,
    Refinement, Result, Rotation, Shape, Solution, Stack, Uncertainty, Variance, Workers,
    calibrate,
};

/// The weight τ of the penalty, as a share of the mean weight of a cell.
pub(crate) const SMOOTHING: f64 = equipix_core::SMOOTHING;

/// What is known of the fluxes.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Lamp {
    Known,
    Free,
    /// ln c is linear in these times.
    Linear(Vec<f64>),
    /// The given fluxes have these relative standard deviations.
    Prior(Vec<f64>),
}

/// What is known of the variance of the values.
#[derive(Clone, Debug)]
pub(crate) enum Noise {
    Unknown,
    Exposures(Vec<f64>),
    Measurements(Vec<f64>),
    /// Of exposures, in an unknown unit.
    Relative(Vec<f64>),
}

/// The exposures of one sensor, and what is to be found from them.
#[derive(Clone, Debug)]
pub(crate) struct Experiment {
    /// Rows and columns.
    pub(crate) shape: [usize; 2],
    /// Exposure by exposure, row by row.
    pub(crate) frames: Vec<f64>,
    pub(crate) shifts: Vec<[f64; 2]>,
    /// Given, the shifts are refined with this prior.
    pub(crate) shift_std: Option<Vec<[f64; 2]>>,
    /// The rotation of each exposure.
    pub(crate) degrees: Vec<i64>,
    pub(crate) flux: Vec<f64>,
    pub(crate) lamp: Lamp,
    pub(crate) noise: Noise,
    /// Measurements not to use; empty if all are used.
    pub(crate) mask: Vec<bool>,
    /// Whether an offset of each pixel is sought.
    pub(crate) offset: bool,
    /// The variance, by pixel, of a dark that was subtracted from all exposures; empty if there is none.
    pub(crate) dark: Vec<f64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Method {
    Multiscale,
    CoordinateDescent,
}

/// How to fit.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Options {
    pub(crate) method: Method,
    pub(crate) tolerance: f64,
    pub(crate) most_passes: Option<u64>,
    pub(crate) workers: usize,
}

impl Options {
    pub(crate) const fn to(tolerance: f64) -> Self {
        Self { method: Method::Multiscale, tolerance, most_passes: None, workers: 2 }
    }
}

/// One entry of the history of a fit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Look {
    pub(crate) passes: u64,
    pub(crate) objective: f64,
    pub(crate) error: f64,
}

/// What was found.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Answer {
    /// M; NaN where undetermined.
    pub(crate) sensitivity: Vec<f64>,
    /// Bits that say what is wrong with a pixel.
    pub(crate) flags: Vec<u32>,
    /// O, if it was sought.
    pub(crate) offset: Option<Vec<f64>>,
    /// L at the cells of its grid; NaN where unobserved.
    pub(crate) beam: Vec<f64>,
    /// The coefficients of the spline that L is, of a joint fit.
    pub(crate) coefficients: Option<Vec<f64>>,
    pub(crate) beam_shape: [usize; 2],
    /// Where pixel (0, 0) is at shift 0, unrotated, in cells of the grid.
    pub(crate) origin: [f64; 2],
    pub(crate) flux: Vec<f64>,
    pub(crate) shifts: Vec<[f64; 2]>,
    /// Whether shifts were refined.
    pub(crate) refined: bool,
    pub(crate) refinement: Refinement,
    pub(crate) leaves_tilt: bool,
    /// The component of each pixel and of each cell, the largest one being 0; −1 for none.
    pub(crate) labels: [Vec<i32>; 2],
    /// F of the measurements alone.
    pub(crate) misfit: f64,
    pub(crate) degrees_of_freedom: i64,
    /// The pixels that left the search, since their measurements are few; empty if there are none.
    pub(crate) few: Vec<bool>,
    /// By exposure, the pixels whose measurements were left out; empty if there are none.
    pub(crate) lost: Vec<Vec<usize>>,
    /// The weights of the prior of M; empty without one.
    pub(crate) prior: Vec<f64>,
    pub(crate) history: Vec<Look>,
    pub(crate) converged: bool,
}

impl Answer {
    /// Whether beam, fluxes and shifts were fitted jointly.
    pub(crate) fn is_joint(&self) -> bool {
        self.coefficients.is_some()
    }
}

/// The standard deviation of M in each pixel.
#[derive(Clone, Debug)]
pub(crate) struct ErrorMap {
    pub(crate) std: Vec<f64>,
    pub(crate) draws: u64,
    /// The relative standard error of `std`, root mean square over the pixels.
    pub(crate) exactness: f64,
}

/// Minimises F.
pub(crate) fn fit(experiment: &Experiment, options: Options) -> Result<Answer> {
    let (workers, control) = (pool(options.workers)?, Control::new());
    let method = match options.method {
        Method::Multiscale => equipix_core::Method::Multiscale,
        Method::CoordinateDescent => equipix_core::Method::CoordinateDescent,
    };
    let Options { tolerance, most_passes: max_sweeps, .. } = options;
    let options = equipix_core::Options { method, tolerance, max_sweeps };
    with_exposures(experiment, &workers, |exposures| {
        Ok(answer(calibrate(exposures, &options, None, &workers, &control)?))
    })
}

/// The standard deviation of M in each pixel.
pub(crate) fn error_map(
    experiment: &Experiment,
    answer: &Answer,
    workers: usize,
) -> Result<ErrorMap> {
    let unit = variance_of_weight_1(experiment, answer);
    let map = ask(experiment, answer, workers, |bars| bars.error_map())?;
    let std = map.std.iter().map(|std| std * unit.sqrt()).collect();
    Ok(ErrorMap { std, draws: map.draws, exactness: map.exactness })
}

/// The variance of Σ g M for each image g.
pub(crate) fn variances(
    experiment: &Experiment,
    answer: &Answer,
    functionals: &[Vec<f64>],
    workers: usize,
) -> Result<Vec<f64>> {
    let unit = variance_of_weight_1(experiment, answer);
    let functionals = functionals.concat();
    let found = ask(experiment, answer, workers, |bars| bars.variances(&functionals))?;
    Ok(found.into_iter().map(|variance| variance * unit).collect())
}

/// The variances (row, column) of the shifts of a joint fit that refined them.
pub(crate) fn shift_variances(
    experiment: &Experiment,
    answer: &Answer,
    workers: usize,
) -> Result<Vec<[f64; 2]>> {
    let unit = variance_of_weight_1(experiment, answer);
    let found = ask(experiment, answer, workers, |bars| bars.shift_variances())?;
    let found = found.unwrap_or_default().into_iter();
    Ok(found.map(|pair| pair.map(|variance| variance * unit)).collect())
}

/// The variance of b, the part b M that the offsets' errors have in common, and the mean variance of an
/// offset by the noise of its own pixel.
pub(crate) fn offset_variances(
    experiment: &Experiment,
    answer: &Answer,
    workers: usize,
) -> Result<[f64; 2]> {
    let unit = variance_of_weight_1(experiment, answer);
    let found = ask(experiment, answer, workers, |bars| bars.offset_variances())?;
    Ok(found.unwrap_or_default().map(|variance| variance * unit))
}

/// What the noise of the dark adds to F on average.
pub(crate) fn misfit_by_dark(
    experiment: &Experiment,
    answer: &Answer,
    workers: usize,
) -> Result<f64> {
    let Some(dark) = relative_dark(experiment, answer) else { return Ok(0.0) };
    with_solution(experiment, answer, workers, |exposures, solution, workers, control| {
        equipix_core::misfit_by_dark(exposures, solution, &dark, workers, control)
    })
}

/// The variance of a measurement of weight 1: 1 where variances are given, else reduced χ².
fn variance_of_weight_1(experiment: &Experiment, answer: &Answer) -> f64 {
    match experiment.noise {
        Noise::Unknown | Noise::Relative(_) => answer.misfit / answer.degrees_of_freedom as f64,
        _ => 1.0,
    }
}

fn pool(workers: usize) -> Result<Workers> {
    Workers::new(NonZeroUsize::new(workers))
}

fn rotations(experiment: &Experiment) -> Result<Vec<Rotation>> {
    let rotation = |degrees: &i64| {
        let problem = || format!("holds {degrees}");
        let refused = || Error::Value { argument: "rotation", problem: problem() };
        Rotation::from_degrees(*degrees).ok_or_else(refused)
    };
    experiment.degrees.iter().map(rotation).collect()
}

/// Calls `visit` with the exposures of an experiment.
fn with_exposures<R>(
    experiment: &Experiment,
    workers: &Workers,
    visit: impl FnOnce(&Exposures<'_, f64>) -> Result<R>,
) -> Result<R> {
    let Experiment { frames, shifts, noise, mask, lamp, .. } = experiment;
    let (count, [rows, cols]) = (shifts.len(), experiment.shape);
    let shape = Shape::new(rows, cols);
    let variance = match noise {
        Noise::Unknown => Variance::Unknown,
        Noise::Exposures(variance) | Noise::Relative(variance) => Variance::Exposures(variance),
        Noise::Measurements(variance) => {
            Variance::Measurements(Stack::new("variance", variance, count, shape)?)
        }
    };
    let mask = if mask.is_empty() { Mask::None } else { Mask::Measurements(mask) };
    let frames = Stack::new("frames", frames, count, shape)?;
    let kind = match lamp {
        Lamp::Known => FluxKind::Known,
        Lamp::Free => FluxKind::Free,
        Lamp::Linear(times) => FluxKind::Linear(times.clone()),
        Lamp::Prior(std) => FluxKind::Prior(std.clone()),
    };
    let (rotations, std) = (rotations(experiment)?, experiment.shift_std.clone());
    let exposures = Exposures::new(
        Measurements { frames, variance, mask },
        Positions { shifts: shifts.clone(), rotations, std },
        Flux { values: experiment.flux.clone(), kind },
        experiment.offset,
        workers,
        &Control::new(),
    )?;
    visit(&match noise {
        Noise::Relative(_) => exposures.with_relative_variance(),
        _ => exposures,
    })
}

/// Asks something of an answer.
fn ask<R>(
    experiment: &Experiment,
    answer: &Answer,
    workers: usize,
    question: impl FnOnce(&mut Uncertainty<'_, '_, f64>) -> Result<R>,
) -> Result<R> {
    with_solution(experiment, answer, workers, |exposures, solution, workers, control| {
        let bars = Uncertainty::new(exposures, solution, workers, control)?;
        match relative_dark(experiment, answer) {
            None => question(&mut { bars }),
            Some(dark) => question(&mut bars.with_dark(&dark)?),
        }
    })
}

/// The variance of the dark in units of that of a measurement of weight 1, if there is one.
fn relative_dark(experiment: &Experiment, answer: &Answer) -> Option<Vec<f64>> {
    let unit = variance_of_weight_1(experiment, answer);
    let relative = || experiment.dark.iter().map(|variance| variance / unit).collect();
    (!experiment.dark.is_empty()).then(relative)
}

/// Does something with the exposures of an experiment and the solution that an answer is.
fn with_solution<R>(
    experiment: &Experiment,
    answer: &Answer,
    workers: usize,
    work: impl FnOnce(&Exposures<'_, f64>, &Solution<'_>, &Workers, &Control) -> Result<R>,
) -> Result<R> {
    let (workers, control) = (pool(workers)?, Control::new());
    let [rows, cols] = answer.beam_shape;
    let solution = Solution {
        sensitivity: &answer.sensitivity,
        flags: &answer.flags,
        beam: Beam {
            values: &answer.beam,
            coefficients: answer.coefficients.as_deref(),
            tilt: [0.0; 2],
            shape: Shape::new(rows, cols),
            origin: answer.origin,
        },
        flux: &answer.flux,
        shifts: &answer.shifts,
        refinement: answer.refinement,
        joint: answer.is_joint(),
        unit: variance_of_weight_1(experiment, answer),
        prior: (!answer.prior.is_empty()).then(|| answer.prior.clone().into()),
        lost: answer.lost.iter().map(Vec::as_slice).collect(),
    };
    with_exposures(experiment, &workers, |exposures| work(exposures, &solution, &workers, &control))
}

fn answer(fit: Fit) -> Answer {
    let looks = fit.history.looks.iter();
    let look = |look: &equipix_core::Look| Look {
        passes: look.sweep,
        objective: look.objective,
        error: look.error,
    };
    let known = |cells: &Vec<f64>| -> Vec<f64> {
        cells.iter().map(|value| if value.is_finite() { *value } else { 0.0 }).collect()
    };
    let coefficients = fit.beam.coefficients.as_ref().unwrap_or(&fit.beam.values);
    Answer {
        coefficients: fit.is_joint().then(|| known(coefficients)),
        beam_shape: [fit.beam.shape.rows, fit.beam.shape.cols],
        origin: fit.beam.origin,
        beam: fit.beam.values,
        refined: fit.refinement.is_done(),
        refinement: fit.refinement,
        leaves_tilt: fit.leaves_tilt,
        labels: [fit.components.pixels, fit.components.cells],
        misfit: fit.misfit,
        degrees_of_freedom: fit.degrees_of_freedom,
        few: fit.few.unwrap_or_default(),
        lost: fit.lost,
        prior: fit.prior.map(|prior| prior.to_vec()).unwrap_or_default(),
        converged: fit.history.ended == Ended::Converged,
        history: looks.map(look).collect(),
        sensitivity: fit.sensitivity,
        flags: fit.flags,
        offset: fit.offset,
        flux: fit.flux,
        shifts: fit.shifts,
    }
}

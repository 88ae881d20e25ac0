//! From the measurements of one experiment to the sensitivity of its sensor.

use crate::conjugate;
use crate::connectivity::{Components, NONE, Tie};
use crate::control::Control;
use crate::descent;
use crate::error::Result;
use crate::estimate::{History, Stop};
use crate::frames::{Real, Shape, flag};
use crate::geometry::{Geometry, Rotation};
use crate::joint::{self, Refinement, Unknowns};
use crate::memory;
use crate::model::{Model, Stretch};
use crate::multiscale;
use crate::parallel::Workers;

/// A response below this share of the typical one may be nil; above it none is.
const WEAK_RESPONSE: f64 = 0.05;
/// It is nil where its edges in the Laplacian, w c² L² M², weigh so little beside an ordinary one.
const NIL_RESPONSE: f64 = 1e-6;
/// Standard errors that a response must exceed 0 by.
const SIGMAS: f64 = 6.0;
/// Pixels, at most, that a median is taken over.
const SAMPLE: usize = 4096;

/// How to minimise F.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// Gauss-Newton on all scales at once: see [`multiscale`].
    Multiscale,
    /// The method of the paper: see [`descent`].
    CoordinateDescent,
}

/// A calibrated sensor.
#[derive(Clone, Debug)]
pub struct Solution {
    /// Relative sensitivity M, row by row, of mean 1; NaN outside the largest component.
    pub sensitivity: Vec<f64>,
    /// The beam L on its padded grid, row by row, in the units of the frames; NaN where unobserved.
    pub beam: Vec<f64>,
    /// The coefficients of the spline that L is, of a joint fit.
    pub coefficients: Option<Vec<f64>>,
    /// Sizes of that grid.
    pub beam_shape: Shape,
    /// The cell that the sensor's first pixel sees at shift 0, unturned.
    pub beam_origin: [usize; 2],
    /// The flux c of each exposure.
    pub flux: Vec<f64>,
    /// The shift (row, column) of each exposure as fitted, or as it was given to a joint fit.
    pub shifts: Option<Vec<[f64; 2]>>,
    /// The offset O of each pixel, if it was sought; NaN outside the largest component.
    pub offset: Option<Vec<f64>>,
    /// F of the measurements at the end, without penalty and priors.
    pub objective: f64,
    /// What became of shifts that were to be refined.
    pub refinement: Refinement,
    /// Whether free fluxes leave a tilt of ln M undetermined: then its slope is 0.
    pub leaves_tilt: bool,
    /// The smallest Ritz value of a joint fit.
    pub smallest_ritz: Option<f64>,
    /// Bits of [`flag`] for each pixel.
    pub flags: Vec<u32>,
    /// What the measurements can compare.
    pub components: Components,
    /// F at the end, and along the way.
    pub history: History,
    /// Measurements used less unknowns determined.
    pub degrees_of_freedom: i64,
}

/// Minimises F, with whole shifts and known fluxes.
///
/// M is given in the gauge mean(M) = 1 over the pixels of a component, each component for itself;
/// pixels that their measurements leave almost no weight are flagged and not in the mean. They and
/// pixels that do not respond tie no parts together.
///
/// # Errors
/// [`Error::Memory`](crate::Error::Memory) before anything else if the memory for it cannot be had;
/// then as [`multiscale::solve`] and [`descent::solve`].
pub fn calibrate<T: Real>(
    model: &Model<'_, T>,
    method: Method,
    stop: Stop,
    workers: &Workers,
    control: &Control,
) -> Result<Solution> {
    memory::check(bytes_needed(&model.geometry), || {
        format!("calibrating {} exposures of {}", model.count(), model.sensor())
    })?;
    let (descent, history, left_out) = match method {
        Method::Multiscale => multiscale::solve(model, stop, workers, control)?,
        Method::CoordinateDescent => descent::solve(model, stop, workers, control)?,
    };
    // After the solver, whose vectors then make room for the sets.
    let (beam, sensitivity) = (descent.beam(), descent.sensitivity);
    let dead = without_response(model, &sensitivity, &beam, &history);
    let mut ties = vec![Tie::Firm; sensitivity.len()];
    left_out.iter().for_each(|&pixel| ties[pixel] = Tie::Loose);
    dead.iter().for_each(|&pixel| ties[pixel] = Tie::None);
    let components = Components::of(model, &ties, control)?;
    let means = component_means(&sensitivity, &components, &left_out);
    let (sensitivity, beam, mut flags) =
        gauged(sensitivity, beam, &means, &components, &left_out, workers);
    for &pixel in &dead {
        flags[pixel] |= flag::DEAD | flag::DO_NOT_USE;
    }
    Ok(Solution {
        sensitivity,
        beam,
        coefficients: None,
        beam_shape: model.geometry.beam,
        beam_origin: model.geometry.origin,
        flux: model.flux.clone(),
        shifts: None,
        offset: None,
        refinement: Refinement::None,
        leaves_tilt: false,
        smallest_ritz: None,
        objective: history.last().objective,
        flags,
        degrees_of_freedom: degrees_of_freedom(model.used(), &components),
        components,
        history,
    })
}

/// Minimises F over `unknowns` too: see [`joint`].
///
/// # Errors
/// [`Error::Memory`](crate::Error::Memory) before anything else if the memory for it cannot be had;
/// then as [`joint::solve`].
pub fn calibrate_jointly<T: Real>(
    model: &Model<'_, T>,
    rotations: &[Rotation],
    unknowns: &Unknowns,
    stop: Stop,
    workers: &Workers,
    control: &Control,
) -> Result<Solution> {
    memory::check(joint::bytes_needed(model, unknowns), || {
        format!("fitting {} exposures of {} jointly", model.count(), model.sensor())
    })?;
    let fit = joint::solve(model, rotations, unknowns, stop, workers, control)?;
    let components = fit.components;
    let means = component_means(&fit.sensitivity, &components, &fit.untold);
    let (mut sensitivity, beam, mut flags) =
        gauged(fit.sensitivity, fit.beam, &means, &components, &fit.untold, workers);
    let mut coefficients = fit.coefficients;
    coefficients.iter_mut().for_each(|coefficient| *coefficient *= means[0]);
    for &pixel in &fit.untold {
        sensitivity[pixel] = f64::NAN;
        flags[pixel] |= flag::NO_FLAT_FIELD | flag::DO_NOT_USE;
    }
    let offset = fit.offset.map(|mut offset| {
        fit.untold.iter().for_each(|&pixel| offset[pixel] = f64::NAN);
        rescale(&mut offset, &components.pixels, workers, |value, label| {
            if label == 0 { value } else { f64::NAN }
        });
        offset
    });
    let pixels = components.pixels.iter().filter(|&&label| label != NONE).count();
    let offsets = if offset.is_some() { pixels - fit.untold.len() } else { 0 };
    let unknowns = fit.unknowns + pixels + offsets - components.sizes.len();
    Ok(Solution {
        sensitivity,
        beam,
        coefficients: Some(coefficients),
        beam_shape: fit.beam_shape,
        beam_origin: fit.origin,
        flux: fit.flux,
        shifts: Some(fit.shifts),
        offset,
        refinement: fit.refinement,
        leaves_tilt: fit.leaves_tilt,
        smallest_ritz: Some(fit.smallest_ritz),
        objective: fit.misfit,
        flags,
        degrees_of_freedom: model.used() as i64 - unknowns as i64,
        components,
        history: fit.history,
    })
}

/// M and L in the gauge mean(M) = 1, each component for itself, and the pixels' flags.
fn gauged(
    mut sensitivity: Vec<f64>,
    mut beam: Vec<f64>,
    means: &[f64],
    components: &Components,
    left_out: &[usize],
    workers: &Workers,
) -> (Vec<f64>, Vec<f64>, Vec<u32>) {
    rescale(&mut sensitivity, &components.pixels, workers, |value, label| {
        if label == 0 { value / means[0] } else { f64::NAN }
    });
    rescale(&mut beam, &components.cells, workers, |value, label| {
        usize::try_from(label).map_or(f64::NAN, |label| value * means[label])
    });
    let undetermined = flag::NO_FLAT_FIELD | flag::DO_NOT_USE;
    let mut flags: Vec<u32> =
        components.pixels.iter().map(|&l| if l == 0 { 0 } else { undetermined }).collect();
    for &pixel in left_out {
        flags[pixel] |= flag::UNRELIABLE_FLAT | flag::DO_NOT_USE;
    }
    (sensitivity, beam, flags)
}

/// What a solver holds beside the measurements at its fullest, in bytes: a search
/// ([`conjugate`]), and
///
/// | array | in bytes |
/// |---|---|
/// | M | 8 for each pixel |
/// | L | 8 for each cell of each view |
/// | with turned exposures, each view's sums and their total | 16 for each cell of each view, 8 for each cell |
///
/// The components come after the solver, with less: M, L, 22 for each pixel and 13 for each cell.
fn bytes_needed(geometry: &Geometry) -> u64 {
    let (pixels, cells) = (geometry.sensor.len() as u64, geometry.beam.len() as u64);
    let views = geometry.views.len() as u64;
    let turned = if views > 1 { (16 * views + 8) * cells } else { 0 };
    8 * pixels + 8 * views * cells + turned + conjugate::bytes_needed(geometry)
}

/// The pixels that do not respond to light, as far as their measurements can tell: M is small,
/// and so is M²D with D = Σ w c² L², whose square root is M over its standard error.
fn without_response<T: Real>(
    model: &Model<'_, T>,
    sensitivity: &[f64],
    beam: &[f64],
    history: &History,
) -> Vec<usize> {
    let typical = typical(sensitivity);
    let objective = history.looks.last().map_or(0.0, |look| look.objective);
    // F for each measurement is no more than the variance of one; for five exposures about half.
    let noise = SIGMAS * SIGMAS * objective / model.used() as f64;
    let ordinary = model.typical_weight() * model.typical_light().powi(2);
    let weak = |&pixel: &usize| sensitivity[pixel].abs() <= WEAK_RESPONSE * typical;
    // M²D is what a pixel shows of light: unlike M, the same in any gauge.
    let nil = |&pixel: &usize| {
        let shown = sensitivity[pixel].powi(2) * weight(model, beam, pixel);
        shown <= noise.max(NIL_RESPONSE * ordinary)
    };
    (0..sensitivity.len()).filter(weak).filter(nil).collect()
}

/// The median |M| of a sample, which a pixel stuck far above the others does not move.
fn typical(sensitivity: &[f64]) -> f64 {
    let every = sensitivity.len().div_ceil(SAMPLE);
    let mut sample: Vec<f64> = sensitivity.iter().step_by(every).map(|m| m.abs()).collect();
    let middle = sample.len() / 2;
    *sample.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The weight Σ w c² L² of a pixel's sensitivity.
fn weight<T: Real>(model: &Model<'_, T>, beam: &[f64], pixel: usize) -> f64 {
    let cols = model.sensor().cols;
    let (row, col) = (pixel / cols, pixel % cols);
    let mut scratch = [0.0];
    let exposures = model.geometry.exposures.iter().zip(&model.flux).enumerate();
    let weights = exposures.map(|(exposure, (place, flux))| {
        let weight = match model.stretch(exposure, row, col..col + 1, &mut scratch) {
            Stretch::Uniform(_, weight) => weight,
            Stretch::Weighted(_, weights) => weights[0],
        };
        let cells = model.geometry.views[place.view].cells;
        let light = flux * beam[cells.at(row + place.row, col + place.col)];
        // A cell that nothing lights has no number, and a measurement that is not used no weight.
        if weight > 0.0 { weight * light * light } else { 0.0 }
    });
    weights.sum()
}

/// Replaces each value by `scaled(value, label)`.
fn rescale(
    values: &mut [f64],
    labels: &[i32],
    workers: &Workers,
    scaled: impl Fn(f64, i32) -> f64 + Send + Sync,
) {
    const PART: usize = 1 << 16;
    workers.map_blocks(values, PART, |index, part| {
        for (value, &label) in part.iter_mut().zip(&labels[index * PART..]) {
            *value = scaled(*value, label);
        }
    });
}

/// The mean sensitivity of each component, without the pixels `left_out` unless nothing else is
/// there.
fn component_means(sensitivity: &[f64], components: &Components, left_out: &[usize]) -> Vec<f64> {
    let mut kept = vec![(0.0, 0_usize); components.sizes.len()];
    let mut all = kept.clone();
    let mut left_out = left_out.iter().peekable();
    for (pixel, (&value, &label)) in sensitivity.iter().zip(&components.pixels).enumerate() {
        let is_out = left_out.next_if_eq(&&pixel).is_some();
        let Ok(label) = usize::try_from(label) else { continue };
        all[label] = (all[label].0 + value, all[label].1 + 1);
        if !is_out {
            kept[label] = (kept[label].0 + value, kept[label].1 + 1);
        }
    }
    let chosen = kept.iter().zip(&all).map(|(kept, all)| if kept.1 > 0 { kept } else { all });
    chosen.map(|(sum, count)| sum / *count as f64).collect()
}

/// Measurements less unknowns; each component has one unknown less than values, by its gauge. Every
/// pixel seen has its unknown; a cell that only pixels without response see has none that F depends on.
fn degrees_of_freedom(used: usize, components: &Components) -> i64 {
    let cells = components.cells.iter().filter(|&&label| label != NONE).count();
    let unknowns = components.seen + cells - components.sizes.len();
    used as i64 - unknowns as i64
}

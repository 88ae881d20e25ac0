//! From exposures to the sensitivity of their sensor: which solver minimises F, and the result at whole shifts.

use super::dead_pixels::without_response;
use super::found::Found;
use super::options::{Method, Options};
use super::{descent, joint, multiscale, refuse};
use crate::beam::Beam;
use crate::connectivity::{Components, NONE, Tie};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::fit::{Fit, Refinement, Start};
use crate::frames::Real;
use crate::geometry::Geometry;
use crate::memory;
use crate::parallel::Workers;
use crate::reduced;
use crate::weak_light::Prior;

/// Minimises F, and gives M in the gauge mean(M) = 1 over the pixels of each component.
///
/// Shifts that differ by whole pixels and known fluxes leave M and L alone to be found, by the method
/// asked for; everything else is fitted jointly. Pixels that their measurements leave almost no weight, or
/// whose measurements contradict each other, are flagged and not in the mean. A `start` saves passes over
/// the data; it must be of the same sensor, with as many exposures.
///
/// # Errors
/// [`Error::Value`](crate::Error::Value) for options that make no sense, and for what does not go
/// together: coordinate descent with anything fitted besides or with shifts that differ by parts of pixels,
/// fitted fluxes, shifts or offsets where all shifts are alike, and offsets where all fluxes are;
/// [`Error::Memory`](crate::Error::Memory) if the memory for it cannot be had;
/// [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
pub fn calibrate<T: Real>(
    exposures: &Exposures<'_, T>,
    options: &Options,
    start: Option<Start>,
    workers: &Workers,
    control: &Control,
) -> Result<Fit> {
    refuse::check(exposures, options)?;
    start.as_ref().map_or(Ok(()), |start| start.check(exposures))?;
    workers.enter(|| {
        let found = if exposures.are_whole() {
            at_whole_shifts(exposures, options, start, workers, control)?
        } else {
            joint::minimise(exposures, options, start, workers, control)?
        };
        Ok(found.into_fit(exposures.unreliable(), workers))
    })
}

/// Minimises F, with shifts that differ by whole pixels and known fluxes.
///
/// Pixels that their measurements leave almost no weight, and pixels that do not respond, tie no parts
/// together.
///
/// # Errors
/// [`Error::Memory`](crate::Error::Memory) before anything else if the memory for it cannot be had;
/// then as the loops.
fn at_whole_shifts<T: Real>(
    exposures: &Exposures<'_, T>,
    options: &Options,
    start: Option<Start>,
    workers: &Workers,
    control: &Control,
) -> Result<Found> {
    memory::check(Start::bytes_beside(start.as_ref(), bytes_needed(exposures)), || {
        format!("calibrating {} exposures of {}", exposures.count(), exposures.sensor())
    })?;
    let (mut estimate, history, weak, objective) = match options.method {
        Method::Multiscale => {
            let found = multiscale::minimise(exposures, options, start, workers, control)?;
            let objective = found.1.last().objective;
            (found.0, found.1, found.2, objective)
        }
        Method::CoordinateDescent => {
            descent::minimise(exposures, options, start, workers, control)?
        }
    };
    let prior = estimate.prior.take();
    let misfit = objective - prior.clone().map_or(0.0, |mut p| p.at(&estimate.sensitivity));
    let (mut held, mut freed) = (Vec::new(), 0.0);
    if let Some(prior) = &prior {
        let (information, m) = (estimate.information(control)?, &estimate.sensitivity);
        let mean = m.iter().sum::<f64>() / m.len() as f64;
        (held, freed) = weak.held(&prior.weights, information, m, mean);
    }
    // After the solver, whose vectors then free memory for the sets.
    let (sensitivity, values) = estimate.into_maps();
    let dead = without_response(exposures, &sensitivity, &values, &history);
    let components = match &prior {
        Some(prior) => weakly_tied(exposures, prior, &mut held, &dead, control)?,
        None => Components::of(exposures, &ties(sensitivity.len(), &[], &dead), control)?,
    };
    let Geometry { beam: shape, origin, .. } = *exposures.geometry();
    let origin = exposures.positions().origin(origin);
    let fit = Fit {
        sensitivity,
        beam: Beam { values, coefficients: None, tilt: [0.0; 2], shape, origin },
        flux: exposures.flux().to_vec(),
        shifts: exposures.positions().shifts.clone(),
        offset: None,
        flags: Vec::new(),
        degrees_of_freedom: degrees_of_freedom(exposures.used(), freed, &components),
        few: None,
        lost: Vec::new(),
        prior: prior.map(|prior| prior.weights),
        components,
        misfit,
        history,
        variance_is_known: exposures.variance_is_known(),
        refinement: Refinement::None,
        leaves_tilt: false,
        smallest_ritz: None,
    };
    Ok(Found { fit, held, dead, without_offset: Vec::new(), fluxes: None })
}

/// How each pixel is tied, of which `loose` ones are in weak light and `dead` ones do not respond.
fn ties(pixels: usize, loose: &[usize], dead: &[usize]) -> Vec<Tie> {
    let mut ties = vec![Tie::Firm; pixels];
    loose.iter().for_each(|&pixel| ties[pixel] = Tie::Loose);
    dead.iter().for_each(|&pixel| ties[pixel] = Tie::None);
    ties
}

/// The components where some pixels have a prior: those of them that are `held` tie nothing together, and
/// belong to the part whose mean holds them. Adds others with a prior that the rest leaves apart from the
/// largest part, since they stand out by noise.
fn weakly_tied<T: Real>(
    exposures: &Exposures<'_, T>,
    prior: &Prior,
    held: &mut Vec<usize>,
    dead: &[usize],
    control: &Control,
) -> Result<Components> {
    let pixels = prior.weights.len();
    let has_prior = |pixel: &usize| prior.weights[*pixel] > 0.0;
    let mut loose: Vec<usize> = held.iter().copied().filter(has_prior).collect();
    let mut tied = ties(pixels, &loose, dead);
    let mut components = Components::of(exposures, &tied, control)?;
    if components.sizes.is_empty() {
        // All are held: with no better one to belong to, they belong to each other.
        return Components::of(exposures, &ties(pixels, &[], dead), control);
    }
    let is_apart = |pixel: &usize| components.pixels[*pixel] > 0 && tied[*pixel] == Tie::Firm;
    let apart: Vec<usize> = (0..pixels).filter(has_prior).filter(is_apart).collect();
    if !apart.is_empty() {
        loose.extend(&apart);
        held.extend(apart);
        held.sort_unstable();
        tied = ties(pixels, &loose, dead);
        components = Components::of(exposures, &tied, control)?;
    }
    components.adopt(exposures, &prior.pieces, &tied, control)?;
    Ok(components)
}

/// What a solver holds beside the measurements at its fullest, in bytes: a search
/// ([`reduced`]), and
///
/// | array | in bytes |
/// |---|---|
/// | M, and one more map | 16 for each pixel |
/// | L | 8 for each cell of each view |
/// | with turned exposures, each view's sums and their total | 16 for each cell of each view, 8 for each cell |
///
/// The components come after the solver, with less: M, L, 22 for each pixel and 13 for each cell. What weak
/// light takes besides is asked for where it is found (`weak_light/decision.rs`).
fn bytes_needed<T: Real>(exposures: &Exposures<'_, T>) -> u64 {
    let geometry = exposures.geometry();
    let (pixels, cells) = (geometry.sensor.len() as u64, geometry.beam.len() as u64);
    let views = geometry.views.len() as u64;
    let turned = if views > 1 { (16 * views + 8) * cells } else { 0 };
    16 * pixels + 8 * views * cells + turned + reduced::bytes_needed(exposures)
}

/// Measurements less unknowns; each component has one unknown less than values, by its gauge. Every
/// pixel seen has its unknown, but for what is left to the prior; a cell that only pixels without response see has
/// none that F depends on.
fn degrees_of_freedom(used: usize, freed: f64, components: &Components) -> i64 {
    let cells = components.cells.iter().filter(|&&label| label != NONE).count();
    let unknowns = components.seen + cells - components.sizes.len();
    used as i64 + freed.round() as i64 - unknowns as i64
}

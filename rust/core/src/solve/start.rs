//! Where the loops start: at equal pixels, or at another fit.

use super::descent::one_sweep;
use crate::control::Control;
use crate::error::Result;
use crate::exposures::{Exposures, FluxKind};
use crate::fit::Start;
use crate::frames::{Real, Shape};
use crate::geometry::nearest_whole;
use crate::joint::{Fluxes, Grid, ShiftPrior, Source, State, System, first_beam, first_fluxes};
use crate::parallel::Workers;
use crate::reduced::{ConjugateGradients, Whole};
use crate::sweep::{Estimate, Plain};
use crate::weak_light::WeakLight;

/// A tilt of ln M from one corner of the sensor to the opposite one that is steep: a factor e, beyond which steps that
/// are linear in M lead astray.
const STEEP: f64 = 1.0;
/// Sweeps that make the first beam.
const FIRST_SWEEPS: u64 = 4;

/// M of another fit, or equal pixels but for those that stand out.
pub(super) fn estimate<'m, 'a, T: Real>(
    exposures: &'m Exposures<'a, T>,
    start: Option<Start>,
    workers: &'m Workers,
    control: &Control,
) -> Result<Estimate<'m, 'a, T>> {
    let mut estimate = Estimate::new(exposures, workers, control);
    match start {
        Some(start) => estimate = estimate.at(&start.sensitivity),
        None => estimate.start(control)?,
    }
    Ok(estimate)
}

/// The joint problem at another fit, or at a first beam from some sweeps at the nearest whole shifts;
/// and how many sweeps that took.
pub(super) fn system<'m, 'a, T: Real>(
    exposures: &'m Exposures<'a, T>,
    start: Option<&Start>,
    workers: &'m Workers,
    control: &Control,
) -> Result<(System<'m, 'a, T>, u64)> {
    let grid = Grid::of(exposures)?;
    let positions = exposures.positions();
    let shifts = positions.on_grid(&positions.shifts);
    let fluxes = Fluxes::of(exposures, exposures.flux(), &shifts, &grid);
    let (state, swept) = match start {
        Some(start) => (moved(start, exposures, &grid, &fluxes, workers, control)?, 0),
        None => {
            let beam = swept(exposures, &grid, workers, control)?;
            (State { beam, theta: vec![0.0; fluxes.columns.len()], shifts }, FIRST_SWEEPS)
        }
    };
    Ok((System::new(exposures, grid, fluxes, state, workers, control)?, swept))
}

/// The exposures at the fluxes where the search begins: those given, or free ones of the other fit or of equal pixels.
///
/// With the part that is affine in the shifts the search is spared a tilt of M, which the result gets back before the
/// gauge is fixed. A spline has a penalty, which a tilt of the beam changes: there that part stays as given unless it is
/// steep.
pub(super) fn at_first_fluxes<'a, T: Real>(
    exposures: &Exposures<'a, T>,
    start: Option<&Start>,
    control: &Control,
) -> Result<Exposures<'a, T>> {
    let positions = exposures.positions();
    let first = match (exposures.flux_kind(), start) {
        (FluxKind::Free, Some(start)) => start.flux.clone(),
        // Unknown offsets of pixels would make fluxes seem alike.
        (FluxKind::Free, None) if !exposures.offset() => first_fluxes(exposures, control)?,
        _ => return Ok(exposures.clone()),
    };
    let (grid, shifts) = (Grid::of(exposures)?, positions.on_grid(&positions.shifts));
    if !grid.is_spline() {
        return Ok(exposures.at_flux(first));
    }
    let given = Fluxes::of(exposures, exposures.flux(), &shifts, &grid);
    let (theta, _, slope) = given.split(&first, &shifts);
    let Shape { rows, cols } = positions.rotations[0].turned(exposures.sensor());
    let tilt = slope[0].abs() * rows as f64 + slope[1].abs() * cols as f64;
    Ok(exposures.at_flux(if tilt > STEEP { first } else { given.at(&theta) }))
}

/// The beam after some sweeps.
fn swept<T: Real>(
    exposures: &Exposures<'_, T>,
    grid: &Grid,
    workers: &Workers,
    control: &Control,
) -> Result<Vec<f64>> {
    let mut estimate = estimate(exposures, None, workers, control)?;
    let mut search = ConjugateGradients::new(exposures, workers, control);
    estimate.slopes::<Plain>(1.0, &mut search.residual, control)?;
    let mut problem = Whole { estimate: &mut estimate, search: &mut search };
    WeakLight::new().update(&mut problem, control)?;
    for _ in 0..FIRST_SWEEPS {
        one_sweep(&mut estimate, &mut search, control)?;
    }
    drop(search);
    let geometry = exposures.geometry();
    let (known, places) = (&estimate.beams()[0], geometry.views[0].places);
    let value = |row, col| known[places.at(row, col)];
    let origin = geometry.origin.map(|cell| cell as i64);
    let source = Source { shape: geometry.beam, origin, value };
    first_beam(grid, &source, workers, control)
}

/// The state of another fit on this grid: its coefficients, or values at cells; its fluxes and, if they
/// were refined, its shifts.
///
/// In its gauge the fluxes may have a part a + γ·d that the problem here does not seek. It goes to
/// the beam: c L(u) is the same with ln c less by a + γ·d and ln L more by a + γ·u, but for a tilt of
/// M.
fn moved<T: Real>(
    start: &Start,
    exposures: &Exposures<'_, T>,
    grid: &Grid,
    fluxes: &Fluxes,
    workers: &Workers,
    control: &Control,
) -> Result<State> {
    let positions = exposures.positions();
    let (theta, level, slope) = fluxes.split(&start.flux, &start.shifts);
    let beam = &start.beam;
    let coefficients = beam.coefficients.as_ref().filter(|_| grid.is_spline());
    let cells = coefficients.unwrap_or(&beam.values);
    let value = |row: usize, col: usize| {
        let [down, right] = [row as f64 - beam.origin[0], col as f64 - beam.origin[1]];
        let value = cells[row * beam.shape.cols + col];
        let factor = (level + slope[0] * down + slope[1] * right).exp();
        if value.is_finite() { value * factor } else { 0.0 }
    };
    // To the nearest cell, where the start has another fraction of a pixel.
    let fraction = positions.fraction().unwrap_or_default();
    let origin = [0, 1].map(|axis| nearest_whole(beam.origin[axis] + fraction[axis]) as i64);
    let source = Source { shape: beam.shape, origin, value };
    let mut shifts = positions.on_grid(&positions.shifts);
    if let Some(prior) = ShiftPrior::of(positions).filter(|_| start.refinement.is_done()) {
        shifts.copy_from_slice(&start.shifts);
        prior.keep_near(&mut shifts);
    }
    Ok(State { beam: first_beam(grid, &source, workers, control)?, theta, shifts })
}

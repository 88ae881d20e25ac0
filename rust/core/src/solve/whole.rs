//! The fit of M and L alone, at whole shifts and known fluxes.

use super::found::Found;
use super::options::{Method, Options};
use super::response::without_response;
use super::{descent, multiscale};
use crate::beam::Beam;
use crate::connectivity::{Components, NONE, Tie};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::fit::{Fit, Refinement, Solution};
use crate::frames::Real;
use crate::geometry::Geometry;
use crate::memory;
use crate::parallel::Workers;
use crate::reduced;

/// Minimises F, with whole shifts and known fluxes.
///
/// Pixels that their measurements leave almost no weight, and pixels that do not respond, tie no parts
/// together.
///
/// # Errors
/// [`Error::Memory`](crate::Error::Memory) before anything else if the memory for it cannot be had;
/// then as the loops.
pub(super) fn minimise<T: Real>(
    exposures: &Exposures<'_, T>,
    options: &Options,
    start: Option<&Solution<'_>>,
    workers: &Workers,
    control: &Control,
) -> Result<Found> {
    memory::check(bytes_needed(exposures), || {
        format!("calibrating {} exposures of {}", exposures.count(), exposures.sensor())
    })?;
    let (estimate, history, left_out, misfit) = match options.method {
        Method::Multiscale => {
            let found = multiscale::minimise(exposures, options, start, workers, control)?;
            let misfit = found.1.last().objective;
            (found.0, found.1, found.2, misfit)
        }
        Method::CoordinateDescent => {
            descent::minimise(exposures, options, start, workers, control)?
        }
    };
    // After the solver, whose vectors then free memory for the sets.
    let (sensitivity, values) = estimate.into_maps();
    let dead = without_response(exposures, &sensitivity, &values, &history);
    let mut ties = vec![Tie::Firm; sensitivity.len()];
    left_out.iter().for_each(|&pixel| ties[pixel] = Tie::Loose);
    dead.iter().for_each(|&pixel| ties[pixel] = Tie::None);
    let components = Components::of(exposures, &ties, control)?;
    let Geometry { beam: shape, origin, .. } = *exposures.geometry();
    let fit = Fit {
        sensitivity,
        beam: Beam { values, coefficients: None, tilt: [0.0; 2], shape, origin },
        flux: exposures.flux().to_vec(),
        shifts: exposures.positions().shifts.clone(),
        offset: None,
        flags: Vec::new(),
        degrees_of_freedom: degrees_of_freedom(exposures.used(), &components),
        components,
        misfit,
        history,
        variance_is_known: exposures.variance_is_known(),
        refinement: Refinement::None,
        leaves_tilt: false,
        smallest_ritz: None,
    };
    Ok(Found { fit, left_out, dead, without_offset: Vec::new(), fluxes: None })
}

/// What a solver holds beside the measurements at its fullest, in bytes: a search
/// ([`reduced`]), and
///
/// | array | in bytes |
/// |---|---|
/// | M | 8 for each pixel |
/// | L | 8 for each cell of each view |
/// | with turned exposures, each view's sums and their total | 16 for each cell of each view, 8 for each cell |
///
/// The components come after the solver, with less: M, L, 22 for each pixel and 13 for each cell.
fn bytes_needed<T: Real>(exposures: &Exposures<'_, T>) -> u64 {
    let geometry = exposures.geometry();
    let (pixels, cells) = (geometry.sensor.len() as u64, geometry.beam.len() as u64);
    let views = geometry.views.len() as u64;
    let turned = if views > 1 { (16 * views + 8) * cells } else { 0 };
    8 * pixels + 8 * views * cells + turned + reduced::bytes_needed(exposures)
}

/// Measurements less unknowns; each component has one unknown less than values, by its gauge. Every
/// pixel seen has its unknown; a cell that only pixels without response see has none that F depends on.
fn degrees_of_freedom(used: usize, components: &Components) -> i64 {
    let cells = components.cells.iter().filter(|&&label| label != NONE).count();
    let unknowns = components.seen + cells - components.sizes.len();
    used as i64 - unknowns as i64
}

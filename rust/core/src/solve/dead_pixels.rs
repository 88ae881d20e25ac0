//! Pixels that do not respond to light.

use crate::convergence::History;
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::information;
use crate::median::median;

/// A response below this share of the typical one may be nil; above it none is.
const WEAK_RESPONSE: f64 = 0.05;
/// It is nil where its edges in the Laplacian, w c² L² M², weigh so little beside an ordinary one.
const NIL_RESPONSE: f64 = 1e-6;
/// Standard errors that a response must exceed 0 by.
const SIGMAS: f64 = 6.0;
/// Pixels, at most, that a median is taken over.
const SAMPLE: usize = 4096;

/// The pixels that do not respond to light, within the noise of their measurements: M is small,
/// and so is M²D with D = Σ w c² L², whose square root is M over its standard error.
pub(super) fn without_response<T: Real>(
    exposures: &Exposures<'_, T>,
    sensitivity: &[f64],
    beam: &[f64],
    history: &History,
) -> Vec<usize> {
    let typical = typical(sensitivity);
    let objective = history.looks.last().map_or(0.0, |look| look.objective);
    // F for each measurement is no more than the variance of one; for five exposures about half.
    let noise = SIGMAS * SIGMAS * objective / exposures.used() as f64;
    let ordinary = exposures.typical_weight() * exposures.typical_light().powi(2);
    let weak = |&pixel: &usize| sensitivity[pixel].abs() <= WEAK_RESPONSE * typical;
    // M²D is what a pixel shows of light: unlike M, the same in any gauge.
    let nil = |&pixel: &usize| {
        let strength = sensitivity[pixel].powi(2) * information_at(exposures, beam, pixel);
        strength <= noise.max(NIL_RESPONSE * ordinary)
    };
    (0..sensitivity.len()).filter(weak).filter(nil).collect()
}

/// The median |M| of a sample, which a pixel stuck far above the others does not move.
fn typical(sensitivity: &[f64]) -> f64 {
    let every = sensitivity.len().div_ceil(SAMPLE);
    let mut sample: Vec<f64> = sensitivity.iter().step_by(every).map(|m| m.abs()).collect();
    median(&mut sample, f64::total_cmp).unwrap_or(f64::NAN)
}

/// D of a pixel, at whole shifts.
fn information_at<T: Real>(exposures: &Exposures<'_, T>, beam: &[f64], pixel: usize) -> f64 {
    let (geometry, cols) = (exposures.geometry(), exposures.sensor().cols);
    let (row, col) = (pixel / cols, pixel % cols);
    information::of_pixel(exposures, [row, col], |k| {
        let place = &geometry.placements[k];
        beam[geometry.views[place.view].cells.at(row + place.row, col + place.col)]
    })
}

//! What the joint fit and its covariance hold in memory.

use super::rim::WIDEST;
use crate::coarse::{self, MOST_WAVES};
use crate::exposures::Exposures;
use crate::frames::Real;

/// What the joint fit holds beside the measurements at its fullest, in bytes:
///
/// | array | in bytes |
/// |---|---|
/// | the light of each measurement, and for products in single precision a unit and a gain | 8 + 4 + 4 |
/// | M, its normal matrix, its change; O and two more elements; M² and a factor in single precision | 32 or 48 for each pixel |
/// | the sums of all bands (`pass.rs`, `fused.rs`) | 12 · 2.2 at most for each cell of each view |
/// | the beam, four vectors of a search, weights, the penalty, the preconditioner, slopes, the last step and its slope | 8 · 17 for each cell |
/// | with turned exposures, the beam and a vector in each view, and what was found there | 24 for each cell of each view |
/// | the rim and its factor | some 2000 for each of its cells, [`WIDEST`] of each row and column at most |
/// | the result and its components | 30 for each pixel, 21 for each cell |
pub(crate) fn bytes_needed<T: Real>(exposures: &Exposures<'_, T>) -> u64 {
    let geometry = exposures.geometry();
    let (pixels, cells) = (geometry.sensor.len() as u64, geometry.beam.len() as u64);
    let (count, views) = (exposures.count() as u64, geometry.views.len() as u64);
    let of_pixel = if exposures.offset() { 8 * count + 48 } else { 16 * count + 32 } + 30;
    let turned = if views > 1 { 24 * views } else { 0 };
    let rim = 2000 * WIDEST as u64 * (geometry.beam.rows + geometry.beam.cols) as u64;
    of_pixel * pixels
        + (27 * views + turned + 161) * cells
        + rim
        + coarse::bytes_needed(geometry, MOST_WAVES)
}

/// What the covariance of a joint fit holds beside the measurements, in bytes: the fit's, and for each
/// pixel the gauge, a change, and the map.
pub(crate) fn bytes_needed_by_covariance<T: Real>(exposures: &Exposures<'_, T>) -> u64 {
    bytes_needed(exposures) + 112 * exposures.geometry().sensor.len() as u64
}

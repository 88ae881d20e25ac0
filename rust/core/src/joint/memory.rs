//! What the joint fit and its covariance hold in memory.

use super::rim::WIDEST;
use crate::coarse::{self, MOST_WAVES};
use crate::exposures::Exposures;
use crate::frames::Real;

/// What the joint fit holds beside the measurements at its fullest, in bytes:
///
/// | array | in bytes |
/// |---|---|
/// | M, its normal matrix, its change; O and two more elements | 24 or 48 for each pixel |
/// | the beam, weights, their multiple of it, the penalty, the preconditioner | 30 for each cell |
/// | while products are in single precision: the sums of all bands of a pass (`pass.rs`), slopes, the last step | 8 · 2.2 at most + 16 for each cell |
/// | … or those of a product (`fused.rs`), the beam, four vectors of a search | 4 · 2.2 at most + 20 for each cell |
/// | while they are in double precision: four vectors of a search, slopes, the last step and its slope | 64 for each cell |
/// | … the sums of all bands | 8 · 2.2 at most for each cell of each view |
/// | … with turned exposures, the beam and a vector in each view, and what was found there | 24 for each cell of each view |
/// | the rim and its factor | some 2000 for each of its cells, [`WIDEST`] of each row and column at most |
///
/// The result takes less than what is freed before it is made.
pub(crate) fn bytes_needed<T: Real>(exposures: &Exposures<'_, T>) -> u64 {
    let geometry = exposures.geometry();
    let (pixels, cells) = (geometry.sensor.len() as u64, geometry.beam.len() as u64);
    let views = geometry.views.len() as u64;
    let of_pixel = if exposures.offset() { 48 } else { 24 };
    let turned = if views > 1 { 24 * views } else { 0 };
    let single = 34 * cells;
    let double = (64 + 18 * views + turned) * cells;
    let rim = 2000 * WIDEST as u64 * (geometry.beam.rows + geometry.beam.cols) as u64;
    of_pixel * pixels
        + 30 * cells
        + single.max(double)
        + rim
        + coarse::bytes_needed(geometry, MOST_WAVES)
}

/// What the covariance of a joint fit holds beside the measurements, in bytes: the fit's, and for each
/// pixel the gauge, a change, and the map.
pub(crate) fn bytes_needed_by_covariance<T: Real>(exposures: &Exposures<'_, T>) -> u64 {
    bytes_needed(exposures) + 112 * exposures.geometry().sensor.len() as u64
}

//! What the joint fit and its covariance hold in memory.

use super::aggregated;
use super::bands::Bands;
use super::layout::{Grid, MARGIN};
use super::rim;
use crate::coarse::{self, MOST_WAVES};
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::geometry::Rotation;

/// What the joint fit at these fluxes holds beside the measurements at its fullest, in bytes:
///
/// | array | in bytes |
/// |---|---|
/// | M, its normal matrix, its change; O and two more elements | 24 or 48 for each pixel |
/// | the beam, weights, their multiple of it, the penalty, the preconditioner | 30 for each cell |
/// | where shifts are fitted, the last step, its slope, and that of the next one | 12 for each cell |
/// | a search in double precision: three vectors, and x in single | 28 for each cell |
/// | … the sums of all bands | 8 for each of their values |
/// | … the beam and a vector in each view that is turned | 16 for each of its cells |
/// | … aggregates of cells, where there are any | what `aggregated.rs` says |
/// | the rim and its factor | some 2000 for each of its cells, as many as `rim.rs` has room for |
///
/// A search in single precision takes less: four vectors and the beam, 20 for each cell, and half of the sums. So
/// does a pass between two searches: the pull, the slope and the last step, 20 for each cell, and the sums. So does
/// the result, for which the search makes room.
///
/// # Errors
/// [`Error::Value`](crate::Error::Value) for shifts that no grid can have.
pub(crate) fn bytes_needed<T: Real>(exposures: &Exposures<'_, T>, flux: &[f64]) -> Result<u64> {
    let positions = exposures.positions();
    let shifts = positions.on_grid(&positions.shifts);
    let fitted = positions.std.is_some();
    let grid = Grid::of(exposures)?;
    let of_aggregates = aggregated::bytes_needed(exposures, flux, &grid);
    Ok(bytes_of(&grid, &shifts, fitted, exposures.offset()) + of_aggregates)
}

fn bytes_of(grid: &Grid, shifts: &[[f64; 2]], fitted: bool, offset: bool) -> u64 {
    let (geometry, sensor) = (&grid.geometry, grid.sensor);
    let (pixels, cells) = (sensor.len() as u64, geometry.beam.len() as u64);
    let (of_pixel, of_steps) = (if offset { 48 } else { 24 }, if fitted { 12 } else { 0 });
    let bands = Bands::new(grid, &grid.windows(shifts));
    // Shifts that are fitted may reach further.
    let reached = geometry.views.iter().map(|view| 2 * MARGIN * view.shape.cols).sum::<usize>();
    let sums = bands.size(sensor.rows) + sensor.rows.div_ceil(bands.height) * reached;
    let turned = geometry.views.iter().filter(|view| view.rotation != Rotation::None).count();
    of_pixel * pixels
        + (30 + of_steps + 28 + 16 * turned as u64) * cells
        + 8 * sums as u64
        + rim::bytes_needed(geometry.beam)
        + coarse::bytes_needed(geometry, MOST_WAVES)
}

/// What the covariance of a joint fit holds beside the measurements, in bytes: the fit's, and for each
/// pixel the gauge, a change, and the map.
///
/// # Errors
/// As [`bytes_needed`].
pub(crate) fn bytes_needed_by_covariance<T: Real>(
    exposures: &Exposures<'_, T>,
    flux: &[f64],
) -> Result<u64> {
    Ok(bytes_needed(exposures, flux)? + 112 * exposures.geometry().sensor.len() as u64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Shape;

    #[test]
    fn large_sensors_are_asked_for_110_bytes_a_pixel() {
        let sensor = Shape::new(10240, 14648);
        let shifts = [[0.0; 2], [0.0, 11.3], [0.0, 19.3], [11.3, 0.0], [19.3, 0.0]];
        let grid = Grid::new(sensor, &shifts, &[Rotation::None; 5], true).unwrap();
        let of_pixel = bytes_of(&grid, &shifts, true, false) as f64 / sensor.len() as f64;
        assert!((105.0..110.5).contains(&of_pixel), "{of_pixel}");
    }
}

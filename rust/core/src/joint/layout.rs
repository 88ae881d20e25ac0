//! Where the pixels of each exposure lie on the beam's grid, between its cells too.
//!
//! Between cells the beam is a cubic B-spline, and a pixel sees 4×4 cells. Where all shifts are whole on
//! the grid of the beam and stay so, a cell is its own value: one factor, 1. A fraction of a pixel that all
//! shifts have in common is not part of them here
//! ([`Positions::on_grid`](crate::exposures::Positions::on_grid)).

use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::{Real, Shape};
use crate::geometry::{Geometry, Rotation, TAPS, Taps};

/// How far a fitted shift may come from where it was measured, in pixels.
pub(crate) const MARGIN: usize = 1;

/// Where an exposure lies in its view: pixel p sees the cells from p + (`row`, `col`) on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Window {
    pub(crate) view: usize,
    pub(crate) row: usize,
    pub(crate) col: usize,
    pub(crate) along_rows: Taps,
    pub(crate) along_cols: Taps,
    /// Whether rows of the view are columns of the beam.
    pub(crate) swaps_axes: bool,
}

/// The beam's grid, wide enough for all that the pixels see.
pub(crate) struct Grid {
    /// Of exposures as large as the sensor and all cells that a pixel of theirs sees, or may come to
    /// see.
    pub(crate) geometry: Geometry,
    pub(crate) sensor: Shape,
    /// Cells that a pixel sees along an axis.
    pub(crate) width: usize,
    margin: usize,
    rotations: Vec<Rotation>,
    /// The smallest corner of each exposure.
    corners: Vec<[i64; 2]>,
}

impl Grid {
    /// A grid for these exposures.
    pub(crate) fn of<T: Real>(exposures: &Exposures<'_, T>) -> Result<Self> {
        let positions = exposures.positions();
        let shifts = positions.on_grid(&positions.shifts);
        Self::new(exposures.sensor(), &shifts, &positions.rotations, positions.std.is_some())
    }

    /// A grid for exposures at `shifts`, which may be `fitted`.
    pub(crate) fn new(
        sensor: Shape,
        shifts: &[[f64; 2]],
        rotations: &[Rotation],
        fitted: bool,
    ) -> Result<Self> {
        let whole = !fitted && shifts.iter().flatten().all(|shift| shift.fract() == 0.0);
        let margin = if fitted { MARGIN } else { 0 };
        let (width, before) = if whole { (1, 0) } else { (TAPS, 1 + margin as i64) };
        let corners: Vec<_> = shifts.iter().map(|d| d.map(|d| d.floor() as i64 - before)).collect();
        let around = width - 1 + 2 * margin;
        let seen = Shape::new(sensor.rows + around, sensor.cols + around);
        let geometry = Geometry::new(seen, &corners, rotations)?;
        Ok(Self { geometry, sensor, width, margin, rotations: rotations.to_vec(), corners })
    }

    /// Whether the beam is a spline.
    pub(crate) const fn is_spline(&self) -> bool {
        self.width > 1
    }

    /// The exposures at `shifts`, no further than [`MARGIN`] from those that the grid was made for.
    pub(crate) fn windows(&self, shifts: &[[f64; 2]]) -> Vec<Window> {
        let exposures = self.geometry.placements.iter().zip(shifts);
        let known = self.corners.iter().zip(&self.rotations);
        exposures
            .zip(known)
            .map(|((place, shift), (corner, rotation))| {
                let [(row, rows), (col, cols)] =
                    [0, 1].map(|axis| self.along(shift[axis], corner[axis]));
                let back = |(offset, taps): (usize, Taps)| {
                    let taps = if self.is_spline() { taps.reversed() } else { taps };
                    (2 * self.margin - offset, taps)
                };
                let [(row, along_rows), (col, along_cols)] = rotation.axes().map(|axis| {
                    let along = [(row, rows), (col, cols)][axis.beam];
                    if axis.reversed { back(along) } else { along }
                });
                Window {
                    view: place.view,
                    row: place.row + row,
                    col: place.col + col,
                    along_rows,
                    along_cols,
                    swaps_axes: rotation.swaps_axes(),
                }
            })
            .collect()
    }

    /// A p + t: where a point of the sensor lies in the beam at shift 0, in exposure k.
    pub(crate) fn place(&self, exposure: usize, pixel: [f64; 2]) -> [f64; 2] {
        self.rotations[exposure].to_beam(pixel, self.sensor)
    }

    /// How many cells from the corner on the first one lies, and the factors, along one axis.
    fn along(&self, shift: f64, corner: i64) -> (usize, Taps) {
        if !self.is_spline() {
            return (0, Taps::WHOLE);
        }
        let offset = shift.floor() as i64 - 1 - corner;
        let offset = offset.clamp(0, 2 * self.margin as i64);
        let fraction = shift - (corner + 1 + offset) as f64;
        (offset as usize, Taps::at(fraction))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_linear_beam_is_seen_where_the_model_says() {
        // Coefficients a_j = j make L(u) = u, along either axis.
        let sensor = Shape::new(5, 7);
        let rotations =
            [Rotation::None, Rotation::Quarter, Rotation::Half, Rotation::ThreeQuarters];
        let shifts = [[0.25, -1.5], [1.0, 0.125], [-2.75, 0.5], [0.5, 3.0]];
        // Fitted shifts may come as far from those that the grid was made for.
        for (fitted, moved) in [(false, 0.0), (true, 0.0), (true, 0.99), (true, -0.99)] {
            let grid = Grid::new(sensor, &shifts, &rotations, fitted).unwrap();
            let origin = grid.geometry.origin.map(|o| o as f64);
            let beam = grid.geometry.beam;
            let shifts = shifts.map(|d| d.map(|d| d + moved));
            for (k, window) in grid.windows(&shifts).iter().enumerate() {
                let view = grid.geometry.views[window.view];
                for (row, col) in (0..5).flat_map(|r| (0..7).map(move |c| (r, c))) {
                    let mut seen = [0.0; 2];
                    for (i, t) in window.along_rows.values.iter().enumerate() {
                        for (j, u) in window.along_cols.values.iter().enumerate() {
                            let cell = view.cells.at(row + window.row + i, col + window.col + j);
                            seen[0] += t * u * ((cell / beam.cols) as f64 - origin[0]);
                            seen[1] += t * u * ((cell % beam.cols) as f64 - origin[1]);
                        }
                    }
                    let (r, c) = (row as f64, col as f64);
                    let turned = match rotations[k] {
                        Rotation::None => [r, c],
                        Rotation::Quarter => [c, 4.0 - r],
                        Rotation::Half => [4.0 - r, 6.0 - c],
                        Rotation::ThreeQuarters => [6.0 - c, r],
                    };
                    for axis in 0..2 {
                        let wanted = turned[axis] + shifts[k][axis];
                        assert!((seen[axis] - wanted).abs() < 1e-13, "{k} {seen:?} {wanted}");
                    }
                }
            }
        }
    }
}

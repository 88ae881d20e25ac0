//! Where the pixels of each exposure lie on the beam's grid, between its cells too.
//!
//! The beam is L(u) = Σ_j a_j B(u − j) with a coefficient a for each cell and the cubic B-spline B,
//! along rows and columns alike. All pixels of an exposure stand at the same fraction f of a cell, so
//! each is a sum over 4×4 cells with the same factors (de Boor, A Practical Guide to Splines, 1978):
//!
//! ```text
//! B: (1−f)³/6, (4 − 6f² + 3f³)/6, (1 + 3f + 3f² − 3f³)/6, f³/6
//! ```
//!
//! Where all shifts are whole and stay so, a cell is its own value: one factor, 1.

use crate::error::Result;
use crate::frames::Shape;
use crate::geometry::{Geometry, Rotation};

/// Factors along one axis that a spline needs.
pub(super) const TAPS: usize = 4;
/// How far a fitted shift may come from where it was measured, in pixels.
pub(super) const MARGIN: usize = 1;

/// The factors of the cells that a pixel sees along one axis of its view, and their slopes with
/// respect to the shift.
#[derive(Clone, Copy, Debug)]
pub(super) struct Taps {
    pub(super) values: [f64; TAPS],
    pub(super) slopes: [f64; TAPS],
}

impl Taps {
    /// A pixel that sees one cell.
    const WHOLE: Self = Self { values: [1.0, 0.0, 0.0, 0.0], slopes: [0.0; TAPS] };

    fn at(f: f64) -> Self {
        let g = 1.0 - f;
        Self {
            values: [
                g * g * g / 6.0,
                (4.0 + f * f * (3.0 * f - 6.0)) / 6.0,
                (4.0 + g * g * (3.0 * g - 6.0)) / 6.0,
                f * f * f / 6.0,
            ],
            slopes: [-g * g / 2.0, f * (1.5 * f - 2.0), g * (2.0 - 1.5 * g), f * f / 2.0],
        }
    }

    /// The cells that count for what hangs together: the nearest one alone where exposures stand
    /// `whole` numbers of cells apart, else those on either side.
    pub(super) fn around(&self, whole: bool) -> std::ops::Range<usize> {
        let largest = |a: &usize, b: &usize| self.values[*a].total_cmp(&self.values[*b]);
        let nearest = (0..TAPS).max_by(largest).unwrap_or_default();
        if whole || self.values[nearest] == 1.0 { nearest..nearest + 1 } else { 1..TAPS - 1 }
    }

    fn reversed(mut self) -> Self {
        self.values.reverse();
        self.slopes.reverse();
        self
    }
}

/// Where an exposure lies in its view: pixel p sees the cells from p + (`row`, `col`) on.
#[derive(Clone, Copy, Debug)]
pub(super) struct Window {
    pub(super) view: usize,
    pub(super) row: usize,
    pub(super) col: usize,
    pub(super) along_rows: Taps,
    pub(super) along_cols: Taps,
    /// Whether rows of the view are columns of the beam.
    pub(super) swaps_axes: bool,
}

/// The beam's grid, wide enough for all that the pixels see.
pub(super) struct Grid {
    /// Of exposures as large as the sensor and all cells that a pixel of theirs sees, or may come to
    /// see.
    pub(super) geometry: Geometry,
    pub(super) sensor: Shape,
    /// Cells that a pixel sees along an axis.
    pub(super) width: usize,
    margin: usize,
    rotations: Vec<Rotation>,
    /// The smallest corner of each exposure.
    corners: Vec<[i64; 2]>,
}

impl Grid {
    /// A grid for exposures at `shifts`, which may be `fitted`.
    pub(super) fn new(
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
    pub(super) const fn is_spline(&self) -> bool {
        self.width > 1
    }

    /// The exposures at `shifts`, no further than [`MARGIN`] from those that the grid was made for.
    pub(super) fn windows(&self, shifts: &[[f64; 2]]) -> Vec<Window> {
        let exposures = self.geometry.exposures.iter().zip(shifts);
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
                let [(row, along_rows), (col, along_cols)] = match rotation {
                    Rotation::None => [(row, rows), (col, cols)],
                    Rotation::Quarter => [back((col, cols)), (row, rows)],
                    Rotation::Half => [back((row, rows)), back((col, cols))],
                    Rotation::ThreeQuarters => [(col, cols), back((row, rows))],
                };
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
    pub(super) fn place(&self, exposure: usize, pixel: [f64; 2]) -> [f64; 2] {
        // The sensor sees a window of the beam turned by its rotation: back from there.
        self.rotations[exposure].inverse().turned_point(pixel, self.sensor)
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
    fn factors_sum_to_one_and_their_slopes_are_derivatives() {
        for f in [0.0, 0.1, 0.5, 0.77, 1.0] {
            let taps = Taps::at(f);
            assert!((taps.values.iter().sum::<f64>() - 1.0).abs() < 4.0 * f64::EPSILON);
            // Cubics have no error but the third derivative's in a central difference: h²/6.
            let h = 1e-4;
            let (after, before) = (Taps::at(f + h), Taps::at(f - h));
            for i in 0..TAPS {
                let slope = (after.values[i] - before.values[i]) / (2.0 * h);
                assert!((slope - taps.slopes[i]).abs() < h * h);
            }
        }
    }

    #[test]
    fn a_linear_beam_is_seen_where_the_model_says() {
        // Coefficients a_j = j make L(u) = u, along either axis.
        let sensor = Shape::new(5, 7);
        let rotations =
            [Rotation::None, Rotation::Quarter, Rotation::Half, Rotation::ThreeQuarters];
        let shifts = [[0.25, -1.5], [1.0, 0.125], [-2.75, 0.5], [0.5, 3.0]];
        for fitted in [false, true] {
            let grid = Grid::new(sensor, &shifts, &rotations, fitted).unwrap();
            let origin = grid.geometry.origin.map(|o| o as f64);
            let beam = grid.geometry.beam;
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

//! The beam on its grid, and the light that a sensor sees of it from any position.

use std::ops::Range;

use crate::frames::Shape;
use crate::geometry::{Rotation, Taps, Walk, nearest_whole, whole_number};
use crate::parallel::{Add, Workers};

/// The beam L on its padded grid, row by row, in the units of the frames.
///
/// It is the model that was fitted: a cubic B-spline where there are coefficients, else values at the
/// cells alone.
#[derive(Clone, Debug, PartialEq)]
pub struct Beam<V = Vec<f64>> {
    /// L at the cells; NaN where unobserved.
    pub values: V,
    /// The coefficients of the spline, one for each cell; NaN where no measurement sees them.
    pub coefficients: Option<V>,
    /// The slope β of ln L (row, column) per cell that the gauge has put into the coefficients. A spline
    /// times exp(β·u) is no spline: L(u) = Σ_j a_j exp(β·(u − j)) B(u − j).
    pub tilt: [f64; 2],
    /// Sizes of the grid.
    pub shape: Shape,
    /// Where on the grid (row, column), in cells, the sensor's first pixel is at shift 0, not turned. It is
    /// between cells where all shifts have a fraction of a pixel in common
    /// ([`Positions::fraction`](crate::Positions::fraction)): then cells are where their pixels are.
    pub origin: [f64; 2],
}

impl Beam<&[f64]> {
    /// The same beam, copied.
    pub(crate) fn copied(&self) -> Beam {
        let Self { tilt, shape, origin, .. } = *self;
        let coefficients = self.coefficients.map(<[f64]>::to_vec);
        Beam { values: self.values.to_vec(), coefficients, tilt, shape, origin }
    }
}

impl<V: AsRef<[f64]> + Sync> Beam<V> {
    /// The same beam, borrowed.
    pub fn view(&self) -> Beam<&[f64]> {
        Beam {
            values: self.values.as_ref(),
            coefficients: self.coefficients.as_ref().map(AsRef::as_ref),
            tilt: self.tilt,
            shape: self.shape,
            origin: self.origin,
        }
    }

    /// The light L(u) on each pixel of a `sensor`, row by row; NaN where it was not observed and
    /// beyond the grid.
    ///
    /// A beam known at cells alone says nothing of what lies between them. There it is interpolated by
    /// polynomials of degree 5, or where one of their six cells is not known by straight lines.
    pub fn light(
        &self,
        shift: [f64; 2],
        rotation: Rotation,
        sensor: Shape,
        workers: &Workers,
    ) -> Vec<f64> {
        let window = rotation.turned(sensor);
        let beam = self.view();
        let tilt = beam.coefficients.map(|_| beam.tilt);
        let [(top, above), (left, beside)] = [0, 1].map(|axis| beam.place(shift[axis], axis));
        let rows = Factors::at(above, tilt.map(|tilt| tilt[0]));
        let cols = Factors::at(beside, tilt.map(|tilt| tilt[1]));
        let mut light = vec![0.0; window.len()];
        workers.map_blocks(&mut light, window.cols, |row, light| {
            let first = [top + row as i64 - rows.before, left - cols.before];
            let width = window.cols + cols.count() - 1;
            let mut between = vec![0.0; width];
            rows.combine(|i| beam.row(first[0] + i as i64, first[1], width), &mut between);
            cols.combine(|j| between[j..j + window.cols].to_vec(), light);
        });
        match rotation {
            Rotation::None => light,
            _ => turned(&light, rotation, window, workers),
        }
    }
}

impl Beam<&[f64]> {
    /// The cell that the first pixel sees at a shift along one axis, and the fraction of a cell behind it.
    fn place(&self, shift: f64, axis: usize) -> (i64, f64) {
        let cell = nearest_whole(self.origin[axis]);
        let place = shift + (self.origin[axis] - cell);
        // Rounding must not make a cell's own value depend on the cells beside it.
        let at_cell = whole_number(place).filter(|_| self.coefficients.is_none());
        let place = at_cell.unwrap_or(place);
        (place.floor() as i64 + cell as i64, place - place.floor())
    }

    /// So many values or coefficients of a row, from a column on; NaN beyond the grid.
    fn row(&self, row: i64, first: i64, width: usize) -> Vec<f64> {
        let mut found = vec![f64::NAN; width];
        let Some(row) = usize::try_from(row).ok().filter(|&row| row < self.shape.rows) else {
            return found;
        };
        let cells = &self.coefficients.unwrap_or(self.values)[row * self.shape.cols..];
        let inside = self.inside(first, width);
        if !inside.is_empty() {
            let place = (inside.start as i64 - first) as usize;
            found[place..place + inside.len()].copy_from_slice(&cells[inside]);
        }
        found
    }

    /// The columns of the grid among so many from `first` on.
    fn inside(&self, first: i64, width: usize) -> Range<usize> {
        let clamp = |col: i64| col.clamp(0, self.shape.cols as i64) as usize;
        clamp(first)..clamp(first.saturating_add(width as i64))
    }
}

/// The factors of the cells along one axis.
struct Factors {
    /// Cells before the one behind which the place lies.
    before: i64,
    factors: Vec<f64>,
    /// The fraction of a cell, where straight lines take over from a polynomial.
    line: Option<f64>,
}

impl Factors {
    /// Those behind a fraction of a cell: of a spline of that tilt, or of values at cells.
    fn at(fraction: f64, tilt: Option<f64>) -> Self {
        if let Some(tilt) = tilt {
            let behind = [fraction + 1.0, fraction, fraction - 1.0, fraction - 2.0];
            let taps = Taps::at(fraction).values.into_iter().zip(behind);
            let factors = taps.map(|(tap, behind)| tap * (tilt * behind).exp()).collect();
            Self { before: 1, factors, line: None }
        } else if fraction == 0.0 {
            Self { before: 0, factors: vec![1.0], line: None }
        } else {
            Self { before: 2, factors: polynomial(fraction), line: Some(fraction) }
        }
    }

    const fn count(&self) -> usize {
        self.factors.len()
    }

    /// Writes the sum of `values(i)`, each times its factor, to `sums`. What has the factor 0 does not
    /// count, even if it is not known.
    fn combine(&self, values: impl Fn(usize) -> Vec<f64>, sums: &mut [f64]) {
        sums.fill(0.0);
        for (i, &factor) in self.factors.iter().enumerate().filter(|(_, factor)| **factor != 0.0) {
            Add { factor, values: &values(i), sums: &mut *sums }.dispatch();
        }
        let Some(fraction) = self.line else { return };
        if sums.iter().all(|sum| sum.is_finite()) {
            return;
        }
        let [near, far] = [0, 1].map(|i| values(self.before as usize + i));
        for (sum, (near, far)) in sums.iter_mut().zip(near.iter().zip(&far)) {
            if !sum.is_finite() {
                *sum = (1.0 - fraction) * near + fraction * far;
            }
        }
    }
}

/// Lagrange's factors of six cells, from two before to three behind.
fn polynomial(fraction: f64) -> Vec<f64> {
    let nodes = [-2.0, -1.0, 0.0, 1.0, 2.0, 3.0];
    let factor = |node: &f64| {
        let others = nodes.iter().filter(|other| *other != node);
        others.map(|other| (fraction - other) / (node - other)).product()
    };
    nodes.iter().map(factor).collect()
}

/// A window of the beam as the sensor sees it.
fn turned(light: &[f64], rotation: Rotation, window: Shape, workers: &Workers) -> Vec<f64> {
    let (walk, cols) = (Walk::new(rotation, window), rotation.turned(window).cols);
    let mut seen = vec![0.0; light.len()];
    workers.map_blocks(&mut seen, cols, |row, pixels| {
        for (col, pixel) in pixels.iter_mut().enumerate() {
            *pixel = light[walk.at(row, col)];
        }
    });
    seen
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROTATIONS: [Rotation; 4] =
        [Rotation::None, Rotation::Quarter, Rotation::Half, Rotation::ThreeQuarters];

    /// A beam on a grid of 12×14 cells with shift 0 at cell (3, 2).
    fn beam(at: impl Fn(f64, f64) -> f64, is_spline: bool) -> Beam {
        let (shape, origin) = (Shape::new(12, 14), [3.0, 2.0]);
        let cells = (0..shape.len()).map(|cell| (cell / shape.cols, cell % shape.cols));
        let values: Vec<f64> = cells.map(|(r, c)| at(r as f64 - 3.0, c as f64 - 2.0)).collect();
        let coefficients = is_spline.then(|| values.clone());
        Beam { values, coefficients, tilt: [0.0; 2], shape, origin }
    }

    #[test]
    fn light_lies_where_the_model_says_for_every_rotation() {
        // u = A p + t + d, straight from the table of the model.
        let workers = Workers::new(None).unwrap();
        let (sensor, shift) = (Shape::new(4, 5), [0.25, 1.5]);
        for is_spline in [false, true] {
            // Coefficients a_j = j make L(u) = u; a polynomial of degree 5 has it exactly too.
            let beam = beam(|r, c| r + 100.0 * c, is_spline);
            for rotation in ROTATIONS {
                let light = beam.light(shift, rotation, sensor, &workers);
                for (pixel, light) in light.iter().enumerate() {
                    let (r, c) = ((pixel / 5) as f64, (pixel % 5) as f64);
                    let [u, v] = match rotation {
                        Rotation::None => [r, c],
                        Rotation::Quarter => [c, 3.0 - r],
                        Rotation::Half => [3.0 - r, 4.0 - c],
                        Rotation::ThreeQuarters => [4.0 - c, r],
                    };
                    let wanted = u + shift[0] + 100.0 * (v + shift[1]);
                    // Sums of 36 products of up to 1000 with factors of up to 2.
                    assert!((light - wanted).abs() < 36.0 * 2000.0 * f64::EPSILON);
                }
            }
        }
    }

    #[test]
    fn cells_beside_whole_places_are_seen_without_interpolation() {
        let workers = Workers::new(None).unwrap();
        // No polynomial, and the cells that no exposure sees are not known.
        let wild = |r: f64, c: f64| if r < 0.0 { f64::NAN } else { (7.0 * r + 3.0 * c).sin() };
        let beam = Beam { origin: [3.0 - 0.1, 2.0 + 0.3], ..beam(wild, false) };
        let seen = beam.light([2.1, 0.7], Rotation::None, Shape::new(1, 3), &workers);
        assert_eq!(seen, [wild(2.0, 1.0), wild(2.0, 2.0), wild(2.0, 3.0)]);
        let half = beam.light([0.1, 0.7], Rotation::Half, Shape::new(1, 3), &workers);
        assert_eq!(half, [wild(0.0, 3.0), wild(0.0, 2.0), wild(0.0, 1.0)]);
    }

    #[test]
    fn what_was_not_observed_is_not_a_number() {
        let workers = Workers::new(None).unwrap();
        let sensor = Shape::new(3, 3);
        let at = |beam: &Beam, shift| beam.light(shift, Rotation::None, sensor, &workers);
        let mut cells = beam(|r, c| 1.0 + r + c, false);
        cells.values[5 * 14 + 5] = f64::NAN;
        let light = at(&cells, [1.0, 2.0]);
        assert!(light[4].is_nan() && light.iter().filter(|l| l.is_nan()).count() == 1);
        // Straight lines where one of six cells is unknown, and nothing beside it.
        let light = at(&cells, [1.5, 0.0]);
        assert!((light[0] - 2.5).abs() < 1e-14 && light[2].is_finite());
        assert!(at(&cells, [1.5, 2.0])[4].is_nan());
        assert!(at(&cells, [8.0, 0.0])[8].is_nan() && at(&cells, [-9.0, 0.0])[0].is_nan());
        let mut spline = beam(|r, c| 1.0 + r + c, true);
        spline.coefficients.as_mut().unwrap()[5 * 14 + 5] = f64::NAN;
        let known: Vec<bool> = at(&spline, [1.0, 2.0]).iter().map(|l| l.is_finite()).collect();
        assert_eq!(known, [false; 9]);
        assert!(at(&spline, [5.0, 6.0]).iter().all(|l| l.is_finite()));
    }

    #[test]
    fn a_tilted_spline_is_the_spline_times_an_exponential() {
        let workers = Workers::new(None).unwrap();
        let (sensor, shift, tilt) = (Shape::new(4, 5), [0.25, 1.5], [0.02, -0.03]);
        let spline = beam(|r, c| 1.0 + 0.3 * (r + 2.0 * c).sin(), true);
        let factor = |r: f64, c: f64| (tilt[0] * r + tilt[1] * c).exp();
        let mut tilted = beam(|r, c| (1.0 + 0.3 * (r + 2.0 * c).sin()) * factor(r, c), true);
        tilted.tilt = tilt;
        let light = |beam: &Beam| beam.light(shift, Rotation::None, sensor, &workers);
        for (pixel, (a, b)) in light(&tilted).iter().zip(light(&spline)).enumerate() {
            let u = [(pixel / 5) as f64 + shift[0], (pixel % 5) as f64 + shift[1]];
            // Sums of 16 products of size 1, each of some ten roundings.
            assert!((a - b * factor(u[0], u[1])).abs() < 160.0 * f64::EPSILON);
        }
    }
}

//! Where exposures were made.

use crate::error::{Error, Result};
use crate::frames::Shape;
use crate::geometry::{Geometry, Rotation, nearest_whole, whole_number};

/// The position of each exposure in the beam.
#[derive(Clone, Debug, PartialEq)]
pub struct Positions {
    /// Shifts (row, column) in pixels.
    pub shifts: Vec<[f64; 2]>,
    /// How far the sensor was turned.
    pub rotations: Vec<Rotation>,
    /// Prior standard deviations of the shifts (row, column) in pixels; given, they are refined.
    pub std: Option<Vec<[f64; 2]>>,
}

impl Positions {
    /// Exact shifts of a sensor that was not turned.
    #[must_use]
    pub fn of_shifts(shifts: &[[f64; 2]]) -> Self {
        let rotations = vec![Rotation::None; shifts.len()];
        Self { shifts: shifts.to_vec(), rotations, std: None }
    }

    /// The part of a pixel (row, column), above −1/2 and up to 1/2, that all shifts have in common: then they
    /// differ by whole pixels, but for rounding. `None` if they do not, or are to be refined.
    ///
    /// The beam is then sampled at this part of a pixel beside whole numbers, and each pixel measures one
    /// sample.
    #[must_use]
    pub fn fraction(&self) -> Option<[f64; 2]> {
        let exact = self.std.is_none() && !self.shifts.is_empty();
        let fraction = [0, 1].map(|axis| {
            // The smallest shift has the most digits behind the point.
            let along = self.shifts.iter().map(|shift| shift[axis]);
            let smallest = along.min_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap_or_default();
            let part = smallest - nearest_whole(smallest);
            whole_number(smallest).map_or(part, |_| 0.0)
        });
        let is_common = |shift: &[f64; 2]| {
            let mut axes = shift.iter().zip(fraction);
            axes.all(|(shift, fraction)| whole_number(shift - fraction).is_some())
        };
        (exact && self.shifts.iter().all(is_common)).then_some(fraction)
    }

    /// Shifts of these exposures as they count on the grid of the beam: less the common fraction, if there is
    /// one, and then whole numbers.
    pub(crate) fn on_grid(&self, shifts: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let Some(fraction) = self.fraction() else { return shifts.to_vec() };
        let on_grid =
            |shift: &[f64; 2]| [0, 1].map(|axis| nearest_whole(shift[axis] - fraction[axis]));
        shifts.iter().map(on_grid).collect()
    }

    /// Where the sensor's first pixel is at shift 0, on a grid on which it is in this `cell` at the common
    /// fraction.
    pub(crate) fn origin(&self, cell: [usize; 2]) -> [f64; 2] {
        let fraction = self.fraction().unwrap_or_default();
        [0, 1].map(|axis| cell[axis] as f64 - fraction[axis])
    }

    /// The places at the nearest whole shifts on the grid of the beam.
    pub(crate) fn whole(&self, sensor: Shape) -> Result<Geometry> {
        let nearest = |shift: &[f64; 2]| shift.map(|d| nearest_whole(d) as i64);
        let shifts: Vec<_> = self.on_grid(&self.shifts).iter().map(nearest).collect();
        Geometry::new(sensor, &shifts, &self.rotations)
    }

    /// Whether exposures differ by more than turns that exchange four pixels.
    pub(crate) fn differ(&self, sensor: Shape) -> bool {
        let shifts = self.on_grid(&self.shifts);
        let swaps = |rotation: &Rotation| rotation.swaps_axes();
        let turned =
            self.rotations.iter().map(swaps).any(|swaps| swaps != self.rotations[0].swaps_axes());
        shifts.iter().any(|shift| *shift != shifts[0]) || (sensor.rows != sensor.cols && turned)
    }

    /// Checks shifts and their standard deviations, for so many exposures.
    pub(crate) fn check(&self, count: usize) -> Result<()> {
        let places = self.shifts.len();
        if places != count {
            let (got, wanted) = (format!("({places}, 2)"), format!("({count}, 2)"));
            return Err(Error::Shape { argument: "shifts", got, wanted });
        }
        let bad = |shift: &[f64; 2]| shift.iter().any(|d| !d.is_finite());
        if let Some(k) = self.shifts.iter().position(bad) {
            let [row, col] = self.shifts[k];
            let problem = format!("of exposure {k} is ({row}, {col}): expected finite numbers");
            return Err(Error::value("shifts", problem));
        }
        self.std.as_ref().map_or(Ok(()), |std| check_std(std, count))
    }
}

fn check_std(std: &[[f64; 2]], count: usize) -> Result<()> {
    if std.len() != count {
        let (got, wanted) = (format!("({}, 2)", std.len()), format!("({count}, 2)"));
        return Err(Error::Shape { argument: "shift_std", got, wanted });
    }
    match std.as_flattened().iter().find(|std| !(**std >= 0.0 && std.is_finite())) {
        None => Ok(()),
        Some(std) => {
            Err(Error::value("shift_std", format!("holds {std}: expected pixels, not negative")))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fraction(shifts: &[[f64; 2]]) -> Option<[f64; 2]> {
        Positions::of_shifts(shifts).fraction()
    }

    #[test]
    fn a_common_fraction_is_one_but_for_rounding() {
        assert_eq!(fraction(&[[3.0, -2.0], [1e9, 0.0]]), Some([0.0, 0.0]));
        // 11.1 and 19.1 less 0.1 are no whole numbers in binary.
        assert_eq!(fraction(&[[19.1, 0.0], [0.1, 11.0], [11.1, -4.0]]), Some([0.1, 0.0]));
        assert_eq!(fraction(&[[11.5, -4.5], [-0.5, 0.5]]), Some([0.5, 0.5]));
        assert_eq!(fraction(&[[0.7, 0.0], [-5.3, 0.0]]), Some([0.7 - 1.0, 0.0]));
        assert_eq!(fraction(&[[1e-7, 0.0], [5.0, 3.0 - 1e-7]]), Some([0.0, 0.0]));
    }

    #[test]
    fn shifts_that_differ_by_parts_of_pixels_have_none() {
        for shifts in [[[0.5, 0.0], [11.5, 0.25]], [[0.1, 0.0], [11.1 + 2e-6, 0.0]]] {
            assert_eq!(fraction(&shifts), None);
            let positions = Positions::of_shifts(&shifts);
            assert_eq!(positions.on_grid(&positions.shifts), shifts);
            assert_eq!(positions.origin([3, 4]), [3.0, 4.0]);
        }
        let std = Some(vec![[0.01; 2]; 2]);
        let refined = Positions { std, ..Positions::of_shifts(&[[0.0, 0.0], [5.0, 0.0]]) };
        assert_eq!(refined.fraction(), None);
        assert_eq!(fraction(&[[f64::NAN, 0.0], [1.0, 0.0]]), None);
        assert_eq!(fraction(&[[f64::INFINITY, 0.0], [1.0, 0.0]]), None);
        assert_eq!(fraction(&[]), None);
    }

    #[test]
    fn on_the_grid_shifts_are_whole() {
        let positions = Positions::of_shifts(&[[0.1, -0.5], [11.1, 6.5], [19.1, -3.5]]);
        let whole = [[0.0, -1.0], [11.0, 6.0], [19.0, -4.0]];
        assert_eq!(positions.on_grid(&positions.shifts), whole);
        assert_eq!(positions.origin([2, 4]), [2.0 - 0.1, 3.5]);
    }
}

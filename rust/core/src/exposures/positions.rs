//! Where exposures were made.

use crate::error::{Error, Result};
use crate::frames::Shape;
use crate::geometry::{Geometry, Rotation};

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

    /// The places at the nearest whole shifts.
    pub(crate) fn whole(&self, sensor: Shape) -> Result<Geometry> {
        let nearest = |shift: &[f64; 2]| shift.map(|d| d.round_ties_even() as i64);
        let shifts: Vec<_> = self.shifts.iter().map(nearest).collect();
        Geometry::new(sensor, &shifts, &self.rotations)
    }

    /// Whether all shifts are whole numbers of pixels, and exact.
    pub(crate) fn are_whole(&self) -> bool {
        self.std.is_none() && self.shifts.iter().flatten().all(|shift| shift.fract() == 0.0)
    }

    /// Whether exposures differ by more than turns that exchange four pixels.
    pub(crate) fn differ(&self, sensor: Shape) -> bool {
        let swaps = |rotation: &Rotation| rotation.swaps_axes();
        let turned =
            self.rotations.iter().map(swaps).any(|swaps| swaps != self.rotations[0].swaps_axes());
        self.shifts.iter().any(|shift| *shift != self.shifts[0])
            || (sensor.rows != sensor.cols && turned)
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

//! What a calibration found.

use std::sync::Arc;

use crate::beam::Beam;
use crate::connectivity::Components;
use crate::control::Control;
use crate::convergence::History;
use crate::error::{Error, Result};
use crate::exposures::Exposures;
use crate::frames::{Real, Shape};
use crate::geometry::Rotation;
use crate::information;
use crate::memory;
use crate::parallel::Workers;

/// What became of shifts that were to be refined.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Refinement {
    /// They were not to be.
    None,
    /// The fit ended before: they are as given.
    NotTried,
    /// The beam has too little structure to determine them: they are as given.
    Undetermined,
    /// They are refined along this direction (row, column) of length 1 alone.
    Along([f64; 2]),
    /// They are refined.
    Done,
}

impl Refinement {
    /// Whether they are refined, if along one direction alone.
    #[must_use]
    pub const fn is_done(self) -> bool {
        matches!(self, Self::Along(_) | Self::Done)
    }

    /// The direction along which alone they are refined.
    #[must_use]
    pub const fn along(self) -> Option<[f64; 2]> {
        match self {
            Self::Along(direction) => Some(direction),
            _ => None,
        }
    }
}

/// A calibrated sensor.
#[derive(Clone, Debug)]
pub struct Fit {
    /// Relative sensitivity M, row by row, of mean 1; NaN outside the largest component.
    pub sensitivity: Vec<f64>,
    /// The beam L.
    pub beam: Beam,
    /// The flux c of each exposure.
    pub flux: Vec<f64>,
    /// The shift (row, column) of each exposure, as refined or as given.
    pub shifts: Vec<[f64; 2]>,
    /// The offset O of each pixel, if it was sought; NaN where undetermined.
    pub offset: Option<Vec<f64>>,
    /// Bits of [`flag`](crate::frames::flag) for each pixel.
    pub flags: Vec<u32>,
    /// What the measurements can compare.
    pub components: Components,
    /// F at the end, and along the way.
    pub history: History,
    /// F of the measurements at the end, without penalty and priors.
    pub misfit: f64,
    /// Measurements used less unknowns determined.
    pub degrees_of_freedom: i64,
    /// Whether the variance of the values was known.
    pub variance_is_known: bool,
    /// What became of shifts that were to be refined.
    pub refinement: Refinement,
    /// Whether free fluxes leave a tilt of ln M undetermined: then its slope is 0.
    pub leaves_tilt: bool,
    /// The smallest Ritz value of a joint fit: near 0 where the measurements barely constrain some
    /// pattern.
    pub smallest_ritz: Option<f64>,
    /// Pixels that were left out of the search, since few measurements are theirs, if there are such: F does not
    /// contain their residuals.
    pub few: Option<Vec<bool>>,
    /// By exposure, the pixels whose measurements there were left out, because they see a cell that no others determine;
    /// empty if there are none. F does not contain them, and M does not follow them.
    pub lost: Vec<Vec<usize>>,
    /// The weights of the prior M = mean(M) on pixels in weak light, row by row, if there are such.
    pub prior: Option<Arc<[f64]>>,
}

impl Fit {
    /// The initial state of another fit: this one.
    ///
    /// # Errors
    /// As [`Solution::start`].
    pub fn start(&self) -> Result<Start> {
        self.solution().start()
    }

    /// The part of it that questions need.
    #[must_use]
    pub fn solution(&self) -> Solution<'_> {
        Solution {
            sensitivity: &self.sensitivity,
            flags: &self.flags,
            beam: self.beam.view(),
            flux: &self.flux,
            shifts: &self.shifts,
            refinement: self.refinement,
            joint: self.is_joint(),
            unit: self.unit(),
            prior: self.prior.clone(),
            lost: self.lost.iter().map(Vec::as_slice).collect(),
        }
    }

    /// Whether the pixels were eliminated, as for shifts that differ by parts of pixels or where more than
    /// M and L was sought.
    #[must_use]
    pub const fn is_joint(&self) -> bool {
        self.smallest_ritz.is_some()
    }

    /// F of the measurements for each degree of freedom; NaN if there is none.
    #[must_use]
    pub fn reduced_chi2(&self) -> f64 {
        if self.degrees_of_freedom > 0 {
            self.misfit / self.degrees_of_freedom as f64
        } else {
            f64::NAN
        }
    }

    /// The variance of a value of weight 1: 1 where variances were given, else reduced χ², or 1 where
    /// the residuals do not determine it.
    #[must_use]
    pub fn unit(&self) -> f64 {
        let chi2 = self.reduced_chi2();
        if self.variance_is_known || !chi2.is_finite() { 1.0 } else { chi2 }
    }

    /// The noise-free signal c L M of each pixel from a position; NaN where L or M is unknown.
    #[must_use]
    pub fn predict(
        &self,
        shift: [f64; 2],
        rotation: Rotation,
        flux: f64,
        sensor: Shape,
        workers: &Workers,
    ) -> Vec<f64> {
        let mut signal = self.beam.light(shift, rotation, sensor, workers);
        signal.iter_mut().zip(&self.sensitivity).for_each(|(light, m)| *light = flux * *light * m);
        signal
    }

    /// D = Σ w c² L² of each pixel, the weight of its M.
    ///
    /// # Errors
    /// As [`Solution::information`].
    pub fn information<T: Real>(
        &self,
        exposures: &Exposures<'_, T>,
        workers: &Workers,
        control: &Control,
    ) -> Result<Vec<f64>> {
        self.solution().information(exposures, workers, control)
    }
}

/// The initial state of a fit, which consumes it.
#[derive(Clone, Debug)]
pub struct Start {
    pub(crate) sensitivity: Vec<f64>,
    pub(crate) beam: Beam,
    pub(crate) flux: Vec<f64>,
    pub(crate) shifts: Vec<[f64; 2]>,
    pub(crate) refinement: Refinement,
}

impl Start {
    /// Checks that it is of as many exposures of the same sensor.
    pub(crate) fn check<T: Real>(&self, exposures: &Exposures<'_, T>) -> Result<()> {
        let counts = [self.flux.len(), self.shifts.len()];
        check_sizes("start", counts, &[self.sensitivity.len()], exposures)
    }

    /// Bytes that a fit needs beside its start, which gives way to what takes most.
    pub(crate) fn bytes_beside(start: Option<&Self>, needed: u64) -> u64 {
        needed.saturating_sub(start.map_or(0, Self::bytes))
    }

    /// The bytes that it holds.
    fn bytes(&self) -> u64 {
        let cells = self.beam.values.len() + self.beam.coefficients.as_ref().map_or(0, Vec::len);
        8 * (self.sensitivity.len() + cells) as u64
    }
}

/// A fit, borrowed: what error bars are asked of.
#[derive(Clone, Debug)]
pub struct Solution<'s> {
    /// M in the gauge mean(M) = 1, row by row; NaN where undetermined.
    pub sensitivity: &'s [f64],
    /// Bits of [`flag`](crate::frames::flag) for each pixel.
    pub flags: &'s [u32],
    /// The beam L.
    pub beam: Beam<&'s [f64]>,
    /// The flux c of each exposure.
    pub flux: &'s [f64],
    /// The shifts as found.
    pub shifts: &'s [[f64; 2]],
    /// What became of those that were to be refined.
    pub refinement: Refinement,
    /// Whether it is that of a joint fit.
    pub joint: bool,
    /// The variance of a measurement of weight 1.
    pub unit: f64,
    /// The weights of the prior of M.
    pub prior: Option<Arc<[f64]>>,
    /// [`Fit::lost`].
    pub lost: Vec<&'s [usize]>,
}

impl Solution<'_> {
    /// The initial state of another fit: this one.
    ///
    /// # Errors
    /// [`Error::Memory`] if the memory for it cannot be had.
    pub fn start(&self) -> Result<Start> {
        // M, and values and coefficients of a beam that is hardly larger.
        memory::check(24 * self.sensitivity.len() as u64, || "the start of another fit".into())?;
        Ok(Start {
            sensitivity: self.sensitivity.to_vec(),
            beam: self.beam.copied(),
            flux: self.flux.to_vec(),
            shifts: self.shifts.to_vec(),
            refinement: self.refinement,
        })
    }

    /// Checks that it is one of as many exposures of the same sensor, and what it lost too.
    pub(crate) fn check<T: Real>(&self, exposures: &Exposures<'_, T>) -> Result<()> {
        let counts = [self.flux.len(), self.shifts.len()];
        check_sizes("solution", counts, &[self.sensitivity.len(), self.flags.len()], exposures)?;
        self.check_lost(exposures.count(), exposures.sensor().len())
    }

    fn check_lost(&self, count: usize, pixels: usize) -> Result<()> {
        let of = self.lost.len();
        if of != 0 && of != count {
            let problem = format!("has lost measurements of {of} exposures, expected {count}");
            return Err(Error::value("solution", problem));
        }
        match self.lost.iter().copied().flatten().find(|&&pixel| pixel >= pixels) {
            None => Ok(()),
            Some(pixel) => {
                let problem = format!("has lost pixel {pixel}, expected 0 to {}", pixels - 1);
                Err(Error::value("solution", problem))
            }
        }
    }

    /// D = Σ w c² L² of each pixel, over the measurements used; light that is not known counts for
    /// nothing.
    ///
    /// # Errors
    /// [`Error::Shape`] if it belongs to other exposures, [`Error::Value`] if it lost measurements of others,
    /// [`Error::Cancelled`] if `control` asks to stop.
    pub fn information<T: Real>(
        &self,
        exposures: &Exposures<'_, T>,
        workers: &Workers,
        control: &Control,
    ) -> Result<Vec<f64>> {
        self.check(exposures)?;
        let light = |k| self.light(exposures, k, workers);
        information::of_sensor(exposures, self.flux, light, workers, control)
    }

    /// Upper limit of what errors of such variances that all exposures share, as those of a dark, add to F
    /// on average: M follows them here, but not the beam.
    ///
    /// # Errors
    /// As [`information`](Self::information), and [`Error::Memory`] if the memory for it cannot be had.
    pub(crate) fn left_of_common<T: Real>(
        &self,
        exposures: &Exposures<'_, T>,
        variance: &[f64],
        workers: &Workers,
        control: &Control,
    ) -> Result<f64> {
        self.check(exposures)?;
        let given = [self.flux, self.prior.as_deref().unwrap_or_default(), variance];
        let light = |k| self.light(exposures, k, workers);
        information::left_of_common(exposures, given, light, workers, control)
    }

    /// The light of an exposure, NaN where it or the measurement was lost.
    fn light<T: Real>(
        &self,
        exposures: &Exposures<'_, T>,
        k: usize,
        workers: &Workers,
    ) -> Vec<f64> {
        let (sensor, rotations) = (exposures.sensor(), &exposures.positions().rotations);
        let mut light = self.beam.light(self.shifts[k], rotations[k], sensor, workers);
        let lost = self.lost.get(k).copied().unwrap_or_default();
        lost.iter().for_each(|&pixel| light[pixel] = f64::NAN);
        light
    }
}

/// Checks that an argument has arrays of as many exposures, and of as many pixels, as there are.
fn check_sizes<T: Real>(
    argument: &'static str,
    counts: [usize; 2],
    pixels: &[usize],
    exposures: &Exposures<'_, T>,
) -> Result<()> {
    let (count, wanted) = (exposures.count(), exposures.sensor().len());
    if counts.iter().all(|&own| own == count) && pixels.iter().all(|&own| own == wanted) {
        return Ok(());
    }
    Err(Error::Shape {
        argument,
        got: format!("{} exposures of {} pixels", counts[0], pixels[0]),
        wanted: format!("{count} exposures of {wanted} pixels"),
    })
}

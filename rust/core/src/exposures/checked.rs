//! Exposures: checked once, then only read.

use std::ops::Range;

use super::flux::{Flux, FluxKind};
use super::measurements::{Measurements, Variance};
use super::positions::Positions;
use super::stretch::{Stretch, weigh, weigh_roughly};
use super::tally::{Tally, check_light, tally};
use crate::control::Control;
use crate::error::{Error, Result};
use crate::frames::{Real, Shape, Stack};
use crate::geometry::Geometry;
use crate::parallel::Workers;

/// Mean frames of one beam, and all that is known of them.
///
/// F = Σ w (y − c L M − O)² is made of the measurements whose mask is not set and whose values are
/// finite; any other has weight 0. The values are looked at once, in [`new`](Self::new).
#[derive(Clone, Debug)]
pub struct Exposures<'a, T> {
    measurements: Measurements<'a, T>,
    checked: Checked,
}

/// Exposures without their values: positions, fluxes, and what the check of the values counted.
///
/// Whoever cannot keep a borrow of the values keeps this, and looks at them again with
/// [`Exposures::again`].
#[derive(Clone, Debug)]
pub struct Checked {
    positions: Positions,
    flux: Flux,
    offset: bool,
    geometry: Geometry,
    tallies: Vec<Tally>,
    unreliable: Vec<usize>,
    is_relative: bool,
}

impl Checked {
    /// Sizes of the sensor.
    #[must_use]
    pub const fn sensor(&self) -> Shape {
        self.geometry.sensor
    }
}

impl<'a, T: Real> Exposures<'a, T> {
    /// Checks the exposures of an experiment and views them; `offset` says whether each pixel has an
    /// offset too, to be found with M.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) if the arguments do not fit each other;
    /// [`Error::Value`](crate::Error::Value) if a shift reaches beyond the sensor, a flux, the
    /// variance of a used measurement or the largest value of an exposure is not a positive number
    /// far from the ends of what a double holds, no measurement of an exposure is used, or the median
    /// of an exposure is not above 0; [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks
    /// to stop.
    pub fn new(
        measurements: Measurements<'a, T>,
        positions: Positions,
        flux: Flux,
        offset: bool,
        workers: &Workers,
        control: &Control,
    ) -> Result<Self> {
        let count = measurements.frames.count();
        let geometry = positions.whole(measurements.frames.shape())?;
        positions.check(count)?;
        flux.check(count)?;
        measurements.check_shapes()?;
        let tallies = (0..count).map(|exposure| tally(&measurements, exposure, workers, control));
        let tallies = tallies.collect::<Result<Vec<_>>>()?;
        check_light(&tallies)?;
        let unreliable = Vec::new();
        let checked =
            Checked { positions, flux, offset, geometry, tallies, unreliable, is_relative: false };
        Ok(Self { measurements, checked })
    }

    /// The same exposures, with variances in an unknown unit: only their ratios are known.
    #[must_use]
    pub const fn with_relative_variance(mut self) -> Self {
        self.checked.is_relative = true;
        self
    }

    /// The same exposures, with pixels whose measurements contradict each other: M is fitted there, flagged,
    /// and counts neither for the mean of M nor for its slope.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) if `unreliable` has not a value for each pixel.
    pub fn with_unreliable(mut self, unreliable: &[bool]) -> Result<Self> {
        let pixels = self.sensor().len();
        if unreliable.len() != pixels {
            let (got, wanted) = (unreliable.len().to_string(), pixels.to_string());
            return Err(Error::Shape { argument: "unreliable", got, wanted });
        }
        self.checked.unreliable = (0..pixels).filter(|&pixel| unreliable[pixel]).collect();
        Ok(self)
    }

    /// Views exposures again that were checked before: the same values, unchanged.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) if they are not of the same sizes.
    pub fn again(measurements: Measurements<'a, T>, checked: &Checked) -> Result<Self> {
        let frames = measurements.frames;
        checked.positions.check(frames.count())?;
        measurements.check_shapes()?;
        let geometry = &checked.geometry;
        if frames.shape() != geometry.sensor {
            let got = frames.shape().to_string();
            let wanted = geometry.sensor.to_string();
            return Err(Error::Shape { argument: "frames", got, wanted });
        }
        Ok(Self { measurements, checked: checked.clone() })
    }

    /// The same exposures at other fluxes.
    pub(crate) fn at_flux(&self, values: Vec<f64>) -> Self {
        let mut moved = self.clone();
        moved.checked.flux.values = values;
        moved
    }

    /// What remains without the values.
    #[must_use]
    pub const fn checked(&self) -> &Checked {
        &self.checked
    }

    /// Number of exposures.
    #[must_use]
    pub const fn count(&self) -> usize {
        self.measurements.frames.count()
    }

    /// Sizes of the sensor.
    #[must_use]
    pub const fn sensor(&self) -> Shape {
        self.measurements.frames.shape()
    }

    /// The frames.
    #[must_use]
    pub const fn frames(&self) -> &Stack<'a, T> {
        &self.measurements.frames
    }

    /// Where they were made.
    #[must_use]
    pub const fn positions(&self) -> &Positions {
        &self.checked.positions
    }

    /// The places at the nearest whole shifts on the grid of the beam.
    #[must_use]
    pub const fn geometry(&self) -> &Geometry {
        &self.checked.geometry
    }

    /// The flux c of each, as given.
    #[must_use]
    pub fn flux(&self) -> &[f64] {
        &self.checked.flux.values
    }

    /// What is known of the fluxes.
    #[must_use]
    pub const fn flux_kind(&self) -> &FluxKind {
        &self.checked.flux.kind
    }

    /// Whether each pixel has an offset, to be found with M.
    #[must_use]
    pub const fn offset(&self) -> bool {
        self.checked.offset
    }

    /// The pixels whose measurements contradict each other, by rising index.
    pub(crate) fn unreliable(&self) -> &[usize] {
        &self.checked.unreliable
    }

    /// Whether all shifts differ by whole pixels and are exact, and nothing is sought besides M and L.
    pub(crate) fn are_whole(&self) -> bool {
        self.checked.positions.fraction().is_some() && !self.seek_more()
    }

    /// Whether fluxes or offsets are sought.
    pub(crate) fn seek_more(&self) -> bool {
        self.checked.flux.kind != FluxKind::Known || self.checked.offset
    }

    /// Whether all were made at one level, as far as it was given.
    pub(crate) fn are_one_level(&self) -> bool {
        self.checked.flux.is_one_level()
    }

    /// Number of measurements used.
    #[must_use]
    pub fn used(&self) -> usize {
        self.checked.tallies.iter().map(|tally| tally.used).sum()
    }

    /// Number of pixels with a measurement.
    ///
    /// # Errors
    /// [`Error::Cancelled`] if `control` asks to stop.
    pub(crate) fn measured_pixels(&self, control: &Control) -> Result<usize> {
        let Shape { rows, cols } = self.sensor();
        if self.used() == self.count() * rows * cols {
            return Ok(rows * cols);
        }
        let mut is_measured = vec![false; rows * cols];
        self.for_each_stretch(control, |_, row, columns| {
            is_measured[row * cols..][columns].fill(true);
        })?;
        Ok(is_measured.into_iter().filter(|is_measured| *is_measured).count())
    }

    /// Whether the variance of the values is known, and not only its ratios.
    #[must_use]
    pub const fn variance_is_known(&self) -> bool {
        !matches!(self.measurements.variance, Variance::Unknown) && !self.checked.is_relative
    }

    /// The light of the brightest measurement: the largest y/c.
    pub(crate) fn brightest(&self) -> f64 {
        let tallies = self.checked.tallies.iter().zip(self.flux());
        tallies.map(|(tally, c)| tally.largest / c).fold(0.0, f64::max)
    }

    /// The weight that each exposure has in all at these fluxes: Σ_p w c².
    pub(crate) fn exposure_weights(&self, flux: &[f64]) -> Vec<f64> {
        let tallies = self.checked.tallies.iter().zip(flux);
        tallies.map(|(tally, c)| tally.weight * c * c).collect()
    }

    /// The share of each exposure in all weights.
    pub(crate) fn shares(&self, flux: &[f64]) -> Vec<f64> {
        let weights = self.exposure_weights(flux);
        let total: f64 = weights.iter().sum();
        weights.iter().map(|weight| weight / total).collect()
    }

    /// The eigenvalue of a pattern that the exposure of least weight alone determines, in units of what it would be
    /// with equal weights.
    pub(crate) fn least_eigenvalue(&self, flux: &[f64]) -> f64 {
        let least = self.shares(flux).into_iter().fold(1.0, f64::min);
        self.count() as f64 * least
    }

    /// Calls `visit(pixel, cell)` for each used measurement.
    ///
    /// # Errors
    /// [`Error::Cancelled`] if `control` asks to stop.
    pub fn for_each_used(
        &self,
        control: &Control,
        mut visit: impl FnMut(usize, usize),
    ) -> Result<()> {
        let cols = self.sensor().cols;
        self.for_each_measurement(control, |exposure, row, col| {
            let place = &self.geometry().placements[exposure];
            let cells = self.geometry().views[place.view].cells;
            visit(row * cols + col, cells.at(row + place.row, col + place.col));
        })
    }

    /// Calls `visit(exposure, row, column)` for each used measurement.
    ///
    /// # Errors
    /// [`Error::Cancelled`] if `control` asks to stop.
    pub(crate) fn for_each_measurement(
        &self,
        control: &Control,
        mut visit: impl FnMut(usize, usize, usize),
    ) -> Result<()> {
        self.for_each_stretch(control, |exposure, row, cols| {
            cols.for_each(|col| visit(exposure, row, col));
        })
    }

    /// Calls `visit(exposure, row, columns)` for the used measurements that stand side by side.
    ///
    /// # Errors
    /// [`Error::Cancelled`] if `control` asks to stop.
    pub(crate) fn for_each_stretch(
        &self,
        control: &Control,
        mut visit: impl FnMut(usize, usize, Range<usize>),
    ) -> Result<()> {
        let Shape { rows, cols } = self.sensor();
        let mut scratch = vec![0.0; cols];
        for exposure in 0..self.count() {
            for row in 0..rows {
                control.check()?;
                match self.stretch(exposure, row, 0..cols, &mut scratch) {
                    Stretch::Uniform(..) => visit(exposure, row, 0..cols),
                    Stretch::Weighted(_, weights) => {
                        let mut first = 0;
                        for alike in weights.chunk_by(|a, b| (*a > 0.0) == (*b > 0.0)) {
                            let end = first + alike.len();
                            if alike[0] > 0.0 {
                                visit(exposure, row, first..end);
                            }
                            first = end;
                        }
                    }
                }
            }
        }
        Ok(())
    }

    /// The measurements of `exposure` in columns `cols` of `row`; `scratch` is a buffer for them.
    pub(crate) fn stretch<'s>(
        &self,
        exposure: usize,
        row: usize,
        cols: Range<usize>,
        scratch: &'s mut [f64],
    ) -> Stretch<'s, T>
    where
        'a: 's,
    {
        if let Some(weight) = self.uniform_weight(exposure) {
            return Stretch::Uniform(&self.measurements.frames.row(exposure, row)[cols], weight);
        }
        let (values, weights) = weigh(&self.measurements, exposure, row, cols, scratch);
        Stretch::Weighted(values, weights)
    }

    /// The weights of columns of a row of `exposure` times a factor, at most a largest, to single precision.
    pub(crate) fn rough_weights(
        &self,
        exposure: usize,
        row: usize,
        cols: Range<usize>,
        scale: [f64; 2],
        weights: &mut [f32],
    ) {
        weigh_roughly(&self.measurements, exposure, row, cols, scale, weights);
    }

    /// The weight of an exposure's measurements if it is the same for all and all are used.
    pub(crate) fn uniform_weight(&self, exposure: usize) -> Option<f64> {
        let tally = self.checked.tallies.get(exposure);
        let whole = tally.is_some_and(|tally| tally.used == self.sensor().len());
        let same = !matches!(self.measurements.variance, Variance::Measurements(_));
        (whole && same).then(|| 1.0 / self.measurements.exposure_variance(exposure))
    }
}

//! The measurements of one experiment and the objective that a calibration minimises.
//!
//! ```text
//! F = Σ_k Σ_p w_k(p) [ y_k(p) − c_k L(u_k(p)) M(p) ]²
//! ```
//!
//! (Stukachev and Kozhevatov 2011, where all weights are 1; here w = 1/variance.) A measurement is
//! *used* if its mask is not set and its value is finite; any other has weight 0.

use std::ops::Range;

use crate::control::Control;
use crate::error::{Error, Result};
use crate::frames::{Real, Shape, Stack};
use crate::geometry::Geometry;
use crate::parallel::Workers;

/// The variance of the values of a stack of frames.
#[derive(Clone, Copy, Debug)]
pub enum Variance<'a, T> {
    /// Unknown: every weight is 1.
    Unknown,
    /// One value for each exposure.
    Exposures(&'a [f64]),
    /// One value for each measurement.
    Measurements(Stack<'a, T>),
}

/// Which measurements not to use (`true`).
#[derive(Clone, Copy, Debug)]
pub enum Mask<'a> {
    /// All are used.
    None,
    /// The same pixels in every exposure, row by row.
    Pixels(&'a [bool]),
    /// Each measurement, in the order of the frames.
    Measurements(&'a [bool]),
}

impl<'a> Mask<'a> {
    /// Checks that it fits so many exposures of that shape.
    pub(crate) fn check(&self, count: usize, shape: Shape) -> Result<()> {
        let (length, size) = match self {
            Self::None => return Ok(()),
            Self::Pixels(mask) => (mask.len(), shape.len()),
            Self::Measurements(mask) => (mask.len(), shape.len() * count),
        };
        if length == size {
            return Ok(());
        }
        let wanted = format!("{shape} or ({count}, {}, {})", shape.rows, shape.cols);
        Err(Error::Shape { argument: "mask", got: format!("({length},)"), wanted })
    }

    /// The part for a row of an exposure of that shape; `None` if nothing is masked.
    pub(crate) fn row(&self, exposure: usize, row: usize, shape: Shape) -> Option<&'a [bool]> {
        let Shape { rows, cols } = shape;
        match self {
            Self::None => None,
            Self::Pixels(mask) => Some(&mask[row * cols..][..cols]),
            Self::Measurements(mask) => Some(&mask[(exposure * rows + row) * cols..][..cols]),
        }
    }
}

/// The model of an experiment: its measurements, their weights and places.
#[derive(Clone, Debug)]
pub struct Model<'a, T> {
    /// The places of the exposures.
    pub geometry: Geometry,
    /// Flux c of each exposure.
    pub flux: Vec<f64>,
    frames: Stack<'a, T>,
    variance: Variance<'a, T>,
    mask: Mask<'a>,
    tallies: Vec<Tally>,
}

/// What one exposure contributes.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    used: usize,
    positive: usize,
    weight: f64,
    largest: f64,
}

/// Values whose squares and weights stay far from the ends of what a double holds.
const VALUES: Range<f64> = 1e-50..1e50;
/// Variances likewise.
const VARIANCES: Range<f64> = 1e-100..1e100;

/// Rows and columns of an exposure that medians are taken from.
const SAMPLED_ROWS: usize = 12;
const SAMPLED_COLS: usize = 16;

/// A stretch of one row of one exposure, as the kernels take it.
pub(crate) enum Stretch<'a, T> {
    /// All measurements are used, with one weight.
    Uniform(&'a [T], f64),
    /// The weights stand in the scratch space; where one is 0, the value counts for nothing.
    Weighted(&'a [T], &'a [f64]),
}

/// Fills in the weights of a stretch, in a form that the compiler inlines into code for the CPU at
/// hand.
struct Weigh<'s, T> {
    values: &'s [T],
    variance: Option<&'s [T]>,
    mask: Option<&'s [bool]>,
    same: f64,
    weights: &'s mut [f64],
}

impl<T: Real> pulp::NullaryFnOnce for Weigh<'_, T> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let weights = self.weights;
        if let Some(variance) = self.variance {
            for (weight, variance) in weights.iter_mut().zip(variance) {
                *weight = 1.0 / variance.to_f64();
            }
        } else {
            weights.fill(self.same);
        }
        for (weight, value) in weights.iter_mut().zip(self.values) {
            *weight = if value.to_f64().is_finite() { *weight } else { 0.0 };
        }
        if let Some(mask) = self.mask {
            for (weight, &masked) in weights.iter_mut().zip(mask) {
                *weight = if masked { 0.0 } else { *weight };
            }
        }
    }
}

impl<'a, T: Real> Model<'a, T> {
    /// Checks the measurements of an experiment and views them.
    ///
    /// # Errors
    /// [`Error::Shape`] if the arguments do not fit each other; [`Error::Value`] if a flux, the
    /// variance of a used measurement or the largest value of an exposure is not a positive number
    /// far from the ends of what a double holds, no measurement of an exposure is used, or the median of an exposure is not above 0; [`Error::Cancelled`] if
    /// `control` asks to stop.
    pub fn new(
        frames: Stack<'a, T>,
        geometry: Geometry,
        flux: &[f64],
        variance: Variance<'a, T>,
        mask: Mask<'a>,
        workers: &Workers,
        control: &Control,
    ) -> Result<Self> {
        let flux = flux.to_vec();
        let mut model = Self { geometry, flux, frames, variance, mask, tallies: Vec::new() };
        model.check_shapes()?;
        model.check_flux()?;
        model.tallies = (0..frames.count())
            .map(|exposure| model.tally(exposure, workers, control))
            .collect::<Result<_>>()?;
        model.check_light()?;
        Ok(model)
    }

    /// Number of exposures.
    #[must_use]
    pub const fn count(&self) -> usize {
        self.frames.count()
    }

    /// Sizes of the sensor.
    #[must_use]
    pub const fn sensor(&self) -> Shape {
        self.frames.shape()
    }

    /// Number of measurements used.
    #[must_use]
    pub fn used(&self) -> usize {
        self.tallies.iter().map(|tally| tally.used).sum()
    }

    /// Whether the variance of the values is known.
    #[must_use]
    pub const fn variance_is_known(&self) -> bool {
        !matches!(self.variance, Variance::Unknown)
    }

    /// The light of an ordinary measurement: the median |y|/c of a sample.
    pub(crate) fn typical_light(&self) -> f64 {
        self.sampled(|value, _, flux| value.abs() / flux)
    }

    /// The weight w c² of an ordinary measurement, likewise.
    pub(crate) fn typical_weight(&self) -> f64 {
        self.sampled(|_, weight, flux| weight * flux * flux)
    }

    /// The median over a sample of the measurements used of `quantity(y, w, c)`, where above 0.
    fn sampled(&self, quantity: impl Fn(f64, f64, f64) -> f64) -> f64 {
        let Shape { rows, cols } = self.sensor();
        let mut scratch = vec![0.0; cols];
        let mut sample = Vec::new();
        for (exposure, &flux) in self.flux.iter().enumerate() {
            for row in (0..rows).step_by(rows.div_ceil(SAMPLED_ROWS)) {
                let stretch = self.stretch(exposure, row, 0..cols, &mut scratch);
                for col in (0..cols).step_by(cols.div_ceil(SAMPLED_COLS)) {
                    let (value, weight) = match &stretch {
                        Stretch::Uniform(values, weight) => (values[col], *weight),
                        Stretch::Weighted(values, weights) => (values[col], weights[col]),
                    };
                    if weight > 0.0 {
                        sample.push(quantity(value.to_f64(), weight, flux));
                    }
                }
            }
        }
        sample.retain(|&value| value > 0.0);
        if sample.is_empty() {
            return 1.0;
        }
        let middle = sample.len() / 2;
        *sample.select_nth_unstable_by(middle, f64::total_cmp).1
    }

    /// The light of the brightest measurement: the largest y/c.
    pub(crate) fn brightest(&self) -> f64 {
        self.tallies.iter().zip(&self.flux).map(|(tally, c)| tally.largest / c).fold(0.0, f64::max)
    }

    /// The weight that each exposure has in all: Σ_p w c².
    #[must_use]
    pub fn exposure_weights(&self) -> Vec<f64> {
        self.tallies.iter().zip(&self.flux).map(|(tally, c)| tally.weight * c * c).collect()
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
            let place = &self.geometry.exposures[exposure];
            let cells = self.geometry.views[place.view].cells;
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
        let Shape { rows, cols } = self.sensor();
        let mut scratch = vec![0.0; cols];
        for exposure in 0..self.count() {
            for row in 0..rows {
                control.check()?;
                let stretch = self.stretch(exposure, row, 0..cols, &mut scratch);
                for col in 0..cols {
                    let used = match &stretch {
                        Stretch::Uniform(..) => true,
                        Stretch::Weighted(_, weights) => weights[col] > 0.0,
                    };
                    if used {
                        visit(exposure, row, col);
                    }
                }
            }
        }
        Ok(())
    }

    /// The measurements of `exposure` in columns `cols` of `row`; `scratch` has room for them.
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
        let values = &self.frames.row(exposure, row)[cols.clone()];
        if let Some(weight) = self.uniform_weight(exposure) {
            return Stretch::Uniform(values, weight);
        }
        let weights = &mut scratch[..values.len()];
        let variance = match self.variance {
            Variance::Measurements(variance) => Some(&variance.row(exposure, row)[cols.clone()]),
            _ => None,
        };
        let mask = self.mask_row(exposure, row).map(|mask| &mask[cols]);
        let same = self.exposure_weight(exposure);
        pulp::Arch::new().dispatch(Weigh { values, variance, mask, same, weights: &mut *weights });
        Stretch::Weighted(values, weights)
    }

    /// The weight of an exposure's measurements if it is the same for all and all are used.
    pub(crate) fn uniform_weight(&self, exposure: usize) -> Option<f64> {
        let whole = self.tallies.get(exposure).is_some_and(|t| t.used == self.sensor().len());
        let same = !matches!(self.variance, Variance::Measurements(_));
        (whole && same).then(|| self.exposure_weight(exposure))
    }

    /// The weight of an exposure's measurements where it is the same for all.
    fn exposure_weight(&self, exposure: usize) -> f64 {
        match self.variance {
            Variance::Exposures(variance) => 1.0 / variance[exposure],
            _ => 1.0,
        }
    }

    fn mask_row(&self, exposure: usize, row: usize) -> Option<&'a [bool]> {
        self.mask.row(exposure, row, self.sensor())
    }

    fn check_shapes(&self) -> Result<()> {
        let (count, shape) = (self.count(), self.sensor());
        let wanted = format!("({count}, {}, {})", shape.rows, shape.cols);
        let check = |argument, good, got: String, wanted: &str| {
            let wanted = wanted.to_owned();
            if good { Ok(()) } else { Err(Error::Shape { argument, got, wanted }) }
        };
        let each = format!("({count},), one an exposure");
        let places = self.geometry.exposures.len();
        check("shifts", places == count, format!("({places}, 2)"), &format!("({count}, 2)"))?;
        check("flux", self.flux.len() == count, format!("({},)", self.flux.len()), &each)?;
        match self.variance {
            Variance::Unknown => {}
            Variance::Exposures(v) => {
                check("variance", v.len() == count, format!("({},)", v.len()), &each)?;
            }
            Variance::Measurements(v) => {
                let good = v.count() == count && v.shape() == shape;
                let Shape { rows, cols } = v.shape();
                check("variance", good, format!("({}, {rows}, {cols})", v.count()), &wanted)?;
            }
        }
        self.mask.check(count, shape)
    }

    fn check_flux(&self) -> Result<()> {
        match self.flux.iter().position(|c| !VALUES.contains(c)) {
            None => Ok(()),
            Some(k) => {
                let c = self.flux[k];
                let problem = format!(
                    "of exposure {k} is {c}: expected a positive number from 1e-50 to 1e50"
                );
                Err(Error::value("flux", problem))
            }
        }
    }

    /// Counts one exposure's measurements and checks their variances.
    fn tally(&self, exposure: usize, workers: &Workers, control: &Control) -> Result<Tally> {
        let Shape { rows, cols } = self.sensor();
        let by_row = workers.map(rows, |row| {
            control.check()?;
            let mut scratch = vec![0.0; cols];
            let mask = self.mask_row(exposure, row);
            let mut tally = Tally::default();
            if let Stretch::Weighted(values, weights) =
                self.stretch(exposure, row, 0..cols, &mut scratch)
            {
                for (col, (&value, &weight)) in values.iter().zip(weights).enumerate() {
                    // A weight of 0 also comes from an infinite variance, which is an error.
                    let masked = || mask.is_some_and(|mask| mask[col]);
                    if weight == 0.0 && (masked() || !value.to_f64().is_finite()) {
                        continue;
                    }
                    if !VARIANCES.contains(&(1.0 / weight)) {
                        return Err(self.bad_variance(exposure, row, col, 1.0 / weight));
                    }
                    tally.used += 1;
                    tally.positive += usize::from(value.to_f64() > 0.0);
                    tally.weight += weight;
                    tally.largest = tally.largest.max(value.to_f64().abs());
                }
            }
            Ok(tally)
        });
        by_row.into_iter().try_fold(Tally::default(), |sum, row| {
            let row = row?;
            Ok(Tally {
                used: sum.used + row.used,
                positive: sum.positive + row.positive,
                weight: sum.weight + row.weight,
                largest: sum.largest.max(row.largest),
            })
        })
    }

    fn bad_variance(&self, exposure: usize, row: usize, col: usize, variance: f64) -> Error {
        let place = match self.variance {
            Variance::Measurements(_) => format!(" at row {row}, column {col}"),
            _ => String::new(),
        };
        let problem = format!(
            "of exposure {exposure}{place} is {variance}: expected a positive number from 1e-100 \
             to 1e100"
        );
        Error::value("variance", problem)
    }

    fn check_light(&self) -> Result<()> {
        if self.used() == 0 {
            let problem = "leaves no measurement: every pixel is masked or not a number";
            return Err(Error::value("mask", problem));
        }
        for (exposure, tally) in self.tallies.iter().enumerate() {
            if tally.used == 0 {
                let problem = format!("leaves nothing of exposure {exposure}: leave it out");
                return Err(Error::value("mask", problem));
            }
            if tally.largest >= VALUES.end || (tally.largest < VALUES.start && tally.positive > 0) {
                let problem = format!(
                    "of exposure {exposure} have a largest value of {:e}: expected 1e-50 to 1e50, \
                     choose another unit",
                    tally.largest
                );
                return Err(Error::value("frames", problem));
            }
            if 2 * tally.positive <= tally.used {
                let problem = format!(
                    "of exposure {exposure} have a median that is not above 0 ({} of {} values \
                     are positive): is there light, and is the right dark subtracted?",
                    tally.positive, tally.used
                );
                return Err(Error::value("frames", problem));
            }
        }
        Ok(())
    }
}

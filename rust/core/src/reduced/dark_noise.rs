//! What the noise of a dark does that was subtracted from all exposures.
//!
//! Its error e(p) stands in every y_k(p), with one variance v(p), so it is no noise of a measurement by
//! itself: the covariance of a pixel's measurements is diag(σ_k²) + v 11ᵀ. The weights stay 1/σ_k², and e
//! moves the minimum by
//!
//! ```text
//! x = a e + r,   a = D⁻¹ Σ_k w c L,   S r = b of the noise (1 − c L a) e
//! ```
//!
//! M follows at once by a e, and what is left of e in exposure k is (1 − c L a) e: nothing where a pixel
//! sees the same light in all exposures.

use super::dark::Dark;
use super::kernel::Common;
use super::operator::{Input, Reduced};
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::random;

impl<T: Real> Reduced<'_, '_, T> {
    /// Takes the dark's noise into account, of these variances by pixel. The system must be
    /// linearised.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled), here and below.
    pub(crate) fn set_dark(&mut self, variance: &[f64], control: &Control) -> Result<()> {
        let (padding, sensor) = (self.padding, self.exposures.sensor());
        let [mut std, mut sums, no_response] =
            [(); 3].map(|()| padding.zeros(sensor.rows, self.workers, control));
        let scale = self.scale.noise();
        let scaled = |v: f64| (v.sqrt() * scale) as f32;
        padding.copy(variance, sensor.cols, self.workers, &mut std, scaled);
        let factors: Vec<f32> = self.exposures.flux().iter().map(|c| (1.0 / c) as f32).collect();
        let one = vec![1.0; padding.width];
        self.common(&factors, &no_response, |_| &one, &mut sums, control)?;
        let pairs = sums.iter().zip(&self.inverse_diagonal);
        let propagation = pairs.map(|(sum, inverse)| sum * inverse).collect();
        self.dark = Some(Dark { std, propagation, factors });
        Ok(())
    }

    /// Whether a dark's noise is taken into account.
    pub(crate) const fn has_dark(&self) -> bool {
        self.dark.is_some()
    }

    /// Σ_k w c L (x − M h) of each pixel, with `sensitivity` as M and these rows of x.
    fn common<'x>(
        &self,
        factors: &[f32],
        sensitivity: &[f32],
        x: impl Fn(usize) -> &'x [f32] + Sync + Send,
        sums: &mut [f32],
        control: &Control,
    ) -> Result<f64> {
        self.for_each_row(sums, control, |row, sums| {
            let mut scratch = self.scratch();
            let lines = self.pixel_lines(row, &mut scratch);
            let (sensitivity, x) = (self.padding.row(sensitivity, row), x(row));
            pulp::Arch::new().dispatch(Common { lines: &lines, factors, sensitivity, x, sums });
            0.0
        })
    }

    /// The variance that the dark adds to x · b, b being what noise makes of it; 0 without a dark.
    pub(crate) fn variance_by_dark(&mut self, x: &[f32], control: &Control) -> Result<f64> {
        let Some(dark) = self.dark.take() else { return Ok(0.0) };
        self.eliminate(Input::Step(x), control);
        let mut sums = self.padding.zeros(self.exposures.sensor().rows, self.workers, control);
        let row = |row: usize| self.padding.row(x, row);
        let done = self.common(&dark.factors, &self.sensitivity, row, &mut sums, control);
        let squares = sums.iter().zip(&dark.std).map(|(sum, std)| f64::from(sum * std).powi(2));
        let variance = squares.sum();
        self.dark = Some(dark);
        done.map(|_| variance)
    }

    /// The variance of what M follows at once, a² v; empty without a dark.
    pub(crate) fn propagated(&self) -> Vec<f32> {
        let of = |dark: &Dark| {
            let pairs = dark.propagation.iter().zip(&dark.std);
            pairs.map(|(a, std)| (a * std).powi(2)).collect()
        };
        self.dark.as_ref().map(of).unwrap_or_default()
    }

    /// What M follows at once in one draw, a e.
    pub(crate) fn propagate(&self, draw: u64, image: &mut [f32], control: &Control) -> Result<()> {
        let Some(dark) = &self.dark else { return Ok(()) };
        self.for_each_row(image, control, |row, values| {
            self.errors(dark, draw, row, values);
            let propagation = self.padding.row(&dark.propagation, row);
            values.iter_mut().zip(propagation).for_each(|(value, a)| *value *= a);
            0.0
        })?;
        Ok(())
    }

    /// Writes what is left of e in a row of pixels of one exposure, (1/c − L a) e, as noise of the light.
    pub(super) fn dark_left(&self, draw: u64, exposure: usize, row: usize, noise: &mut [f32]) {
        noise.fill(0.0);
        let Some(dark) = &self.dark else { return };
        let place = &self.exposures.geometry().placements[exposure];
        let light = &self.light[place.view];
        let light = self.padding.row_from(light, row + place.row, place.col);
        let propagation = self.padding.row(&dark.propagation, row);
        self.errors(dark, draw, row, &mut noise[..self.padding.width]);
        for ((noise, square), a) in noise.iter_mut().zip(light).zip(propagation) {
            *noise *= dark.factors[exposure] - square.sqrt() * a;
        }
    }

    /// e of a row of pixels.
    fn errors(&self, dark: &Dark, draw: u64, row: usize, values: &mut [f32]) {
        let sensor = self.exposures.sensor();
        let mut sign = random::signs_in_common(draw, row, sensor.rows);
        let std = self.padding.row(&dark.std, row);
        for (value, std) in values.iter_mut().zip(std).take(sensor.cols) {
            *value = sign() as f32 * std;
        }
    }
}

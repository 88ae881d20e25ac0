//! What noise does in the linear problem.
//!
//! Noise e of the measurements, of variance 1/(w c²), moves the minimum by the x that solves S x = b
//! with
//!
//! ```text
//! b(p) = Σ_k w c² L (e − M h),   h(u) = Σ_k w c² M e / Σ_k w c² M²
//! ```
//!
//! and b has the covariance S. No more than that is asked of a draw, so that e is as large as its
//! standard deviation everywhere and only its signs are drawn: a bit for each measurement.

use super::kernel::{NoiseSlope, Sign, TwoTerms};
use super::operator::{ExposureScratch, Reduced, RowWeight, Shown};
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::padded::{BAND, LANES};
use crate::random;

impl<T: Real> Reduced<'_, '_, T> {
    /// Writes the b of draw number `draw` to `slope`.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn draw(&mut self, draw: u64, slope: &mut [f32], control: &Control) -> Result<()> {
        self.hide(Shown::Noise(draw), control);
        self.for_each_row(slope, control, |row, slope| {
            let [mut scratch, mut of_noise] = [self.scratch(), self.scratch()];
            let lines = self.pixel_lines(row, &mut scratch);
            let drawn = of_noise.of_exposures.iter_mut().enumerate();
            let noise: Vec<&[f32]> = drawn
                .map(|(exposure, ExposureScratch { weight, noise })| {
                    let weight = self.weight(exposure, row, weight);
                    let noise = self.noise([draw, exposure as u64], row, weight, noise);
                    &noise[self.padding.lead..][..self.padding.width]
                })
                .collect();
            let sensitivity = self.padding.row(&self.sensitivity, row);
            pulp::Arch::new().dispatch(NoiseSlope {
                lines: &lines,
                noise: &noise,
                sensitivity,
                slope,
            });
        })
    }

    /// Writes the first two terms of the variance of x to `variance`: that of M at the L that there
    /// is, 1/D, and that by the variance which L has at the M that there is.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn two_terms(&mut self, variance: &mut [f32], control: &Control) -> Result<()> {
        self.hide(Shown::Weight, control);
        self.for_each_row(variance, control, |row, variance| {
            let mut scratch = self.scratch();
            let lines = self.pixel_lines(row, &mut scratch);
            pulp::Arch::new().dispatch(TwoTerms {
                lines: &lines,
                sensitivity: self.padding.row(&self.sensitivity, row),
                inverse_diagonal: self.padding.row(&self.inverse_diagonal, row),
                variance,
            });
        })
    }

    /// Calls `work(row, values)` for each row of an image.
    fn for_each_row(
        &self,
        image: &mut [f32],
        control: &Control,
        work: impl Fn(usize, &mut [f32]) + Send + Sync,
    ) -> Result<()> {
        let width = self.padding.width;
        self.workers.map_blocks(self.padding.body_mut(image), BAND * width, |band, rows| {
            for (index, values) in rows.chunks_exact_mut(width).enumerate() {
                if control.is_cancelled() {
                    return;
                }
                work(band * BAND + index, values);
            }
        });
        control.check()
    }

    /// The noise of a row of pixels in one draw and exposure, with zeros before and after.
    ///
    /// Each row has random numbers of its own, so that any thread may ask for any row.
    pub(super) fn noise<'s>(
        &self,
        [draw, exposure]: [u64; 2],
        row: usize,
        weight: RowWeight<'_>,
        noise: &'s mut Vec<f32>,
    ) -> &'s [f32] {
        let (sensor, count) = (self.exposures.sensor(), self.exposures.count() as u64);
        let number = (draw * count + exposure) * sensor.rows as u64 + row as u64;
        let mut bits = random::bits(number);
        let signs: Vec<u32> = (0..sensor.cols.div_ceil(LANES)).map(|_| bits()).collect();
        noise.resize(2 * self.padding.lead + self.padding.width, 0.0);
        let padded = &mut noise[self.padding.lead..];
        pulp::Arch::new().dispatch(Sign {
            weight: weight.at(&self.padding),
            signs: &signs,
            noise: &mut padded[..self.padding.width],
        });
        padded[sensor.cols..].fill(0.0);
        noise
    }
}

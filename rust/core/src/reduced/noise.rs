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
use super::operator::{Draw, ExposureScratch, Input, Reduced, RowWeight};
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::padded::{BAND, LANES};
use crate::random::{self, Streams};

impl<T: Real> Reduced<'_, '_, T> {
    /// Writes the b of a draw to `slope`; returns Σ w c² e (e − M h), what F is once L has followed it.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn draw(&mut self, draw: Draw, slope: &mut [f32], control: &Control) -> Result<f64> {
        self.eliminate(Input::Noise(draw), control);
        self.for_each_row(slope, control, |row, slope| {
            let [mut scratch, mut of_noise] = [self.scratch(), self.scratch()];
            let lines = self.pixel_lines(row, &mut scratch);
            let drawn = of_noise.of_exposures.iter_mut().enumerate();
            let noise: Vec<&[f32]> = drawn
                .map(|(exposure, ExposureScratch { weight, noise })| {
                    let weight = self.weight(exposure, row, weight);
                    let noise = self.noise(draw, exposure, row, weight, noise);
                    &noise[self.padding.lead..][..self.padding.width]
                })
                .collect();
            let sensitivity = self.padding.row(&self.sensitivity, row);
            pulp::Arch::new().dispatch(NoiseSlope {
                lines: &lines,
                noise: &noise,
                sensitivity,
                slope,
            })
        })
    }

    /// Writes the first two terms of the variance of x to `variance`: that of M at the L that there
    /// is, 1/D, and that by the variance which L has at the M that there is.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn two_terms(&mut self, variance: &mut [f32], control: &Control) -> Result<()> {
        self.eliminate(Input::Weight, control);
        self.for_each_row(variance, control, |row, variance| {
            let mut scratch = self.scratch();
            let lines = self.pixel_lines(row, &mut scratch);
            pulp::Arch::new().dispatch(TwoTerms {
                lines: &lines,
                sensitivity: self.padding.row(&self.sensitivity, row),
                inverse_diagonal: self.padding.row(&self.inverse_diagonal, row),
                variance,
            });
            0.0
        })?;
        Ok(())
    }

    /// Calls `work(row, values)` for each row of an image; returns the sum of its results.
    pub(super) fn for_each_row(
        &self,
        image: &mut [f32],
        control: &Control,
        work: impl Fn(usize, &mut [f32]) -> f64 + Send + Sync,
    ) -> Result<f64> {
        let width = self.padding.width;
        let body = self.padding.body_mut(image);
        let sums = self.workers.map_blocks(body, BAND * width, |band, rows| {
            let mut sum = 0.0;
            for (index, values) in rows.chunks_exact_mut(width).enumerate() {
                if control.is_cancelled() {
                    return sum;
                }
                sum += work(band * BAND + index, values);
            }
            sum
        });
        control.check()?;
        Ok(sums.into_iter().sum())
    }

    /// The noise of a row of pixels in one draw and exposure, with zeros before and after. Behind its last
    /// pixel it means nothing: M and 1/D are 0 there.
    ///
    /// Each row has random numbers of its own, so that any thread may ask for any row.
    pub(super) fn noise<'s>(
        &self,
        draw: Draw,
        exposure: usize,
        row: usize,
        weight: RowWeight<'_>,
        noise: &'s mut Vec<f32>,
    ) -> &'s [f32] {
        noise.resize(2 * self.padding.lead + self.padding.width, 0.0);
        let padded = &mut noise[self.padding.lead..];
        match draw {
            Draw::Measurements(draw) => self.sign_each(draw, exposure, row, weight, padded),
            Draw::Dark(draw) => self.dark_left(draw, exposure, row, padded),
        }
        noise
    }

    /// ±1/√w, with a sign for each measurement.
    fn sign_each(
        &self,
        draw: u64,
        exposure: usize,
        row: usize,
        weight: RowWeight<'_>,
        noise: &mut [f32],
    ) {
        let (sensor, count) = (self.exposures.sensor(), self.exposures.count());
        let mut bits = random::bits(Streams::new(count, sensor.rows).number(draw, exposure, row));
        let signs: Vec<u32> = (0..sensor.cols.div_ceil(LANES)).map(|_| bits()).collect();
        pulp::Arch::new().dispatch(Sign {
            weight: weight.at(&self.padding),
            signs: &signs,
            noise: &mut noise[..self.padding.width],
        });
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::exposures::{Exposures, Flux, Mask, Measurements, Positions, Variance};
    use crate::frames::Stack;
    use crate::geometry::{Rotation, View};
    use crate::parallel::Workers;
    use crate::reduced::ConjugateGradients;
    use crate::testing::{SENSOR, assert_unit_and_independent};
    use crate::weak_light::Prior;

    const SHIFTS: [[f64; 2]; 3] = [[0.0, 0.0], [2.0, 3.0], [-1.0, 1.0]];
    /// So that no weight, and no root of one, is 1.
    const VARIANCES: [f64; 3] = [4e-6, 9e-5, 5e-7];
    const DRAWS: u64 = 2000;

    fn dot(a: &[f32], b: &[f32]) -> f64 {
        a.iter().zip(b).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum()
    }

    #[test]
    fn draws_have_the_covariance_of_the_problem_and_are_independent() {
        let turns = [Rotation::None, Rotation::Quarter].into_iter();
        for (turned, held) in turns.flat_map(|turned| [(turned, false), (turned, true)]) {
            let (workers, control) = (Workers::new(None).unwrap(), Control::new());
            let frames = vec![1.0; SHIFTS.len() * SENSOR.len()];
            let measurements = Measurements {
                frames: Stack::new("frames", &frames, SHIFTS.len(), SENSOR).unwrap(),
                variance: Variance::Exposures(&VARIANCES),
                mask: Mask::None,
            };
            let mut positions = Positions::of_shifts(&SHIFTS);
            positions.rotations[2] = turned;
            let flux = Flux::steady(SHIFTS.len());
            let exposures =
                Exposures::new(measurements, positions, flux, false, &workers, &control).unwrap();
            let mut solver = ConjugateGradients::new(&exposures, &workers, &control);
            let wave = |i: usize| 1.0 + 0.3 * (i as f64 * 1.7).sin();
            let sensitivity: Vec<f64> = (0..SENSOR.len()).map(wave).collect();
            let seen = |view: &View| -> Vec<f64> {
                let cols = view.shape.cols;
                let cells = (0..view.shape.len()).map(|i| view.cells.at(i / cols, i % cols));
                cells.map(wave).collect()
            };
            let beams: Vec<Vec<f64>> = exposures.geometry().views.iter().map(seen).collect();
            // As large as D, some 2e6, in every third pixel.
            let weight = |i: usize| if i.is_multiple_of(3) { 1e6 * (1.0 + wave(i)) } else { 0.0 };
            let weights: Arc<[f64]> = (0..SENSOR.len()).map(weight).collect();
            let mut prior = Prior::new(weights, vec![0; SENSOR.len()].into());
            prior.at(&sensitivity);
            let prior = held.then_some(&prior);
            solver.linearise(&sensitivity, &beams, prior, &control).unwrap();
            let (reduced, padding) = (&mut solver.reduced, solver.residual.len());
            let (mut b, mut product) = (vec![0.0; padding], vec![0.0; padding]);
            for frequency in [0.3, 1.1, 2.9] {
                let in_system = reduced.inverse_diagonal.iter().enumerate();
                let x: Vec<f32> = in_system
                    .map(|(i, &d)| if d > 0.0 { (i as f32 * frequency).sin() } else { 0.0 })
                    .collect();
                let energy = reduced.multiply(&x, &mut product, &control).unwrap();
                let heights: Vec<f64> = (0..DRAWS)
                    .map(|draw| {
                        reduced.draw(Draw::Measurements(draw), &mut b, &control).unwrap();
                        reduced.draw_prior(draw, &mut b);
                        dot(&x, &b) / energy.sqrt()
                    })
                    .collect();
                assert_unit_and_independent(&heights);
            }
        }
    }
}

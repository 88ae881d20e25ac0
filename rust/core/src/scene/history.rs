//! Mean and variance of each pixel over time: they tell pixels that do not respond.

use super::bands::{BAND, bands, wide};
use super::coefficients::sum;
use crate::frames::Shape;
use crate::parallel::Workers;

/// Frames that are remembered: all have the same weight up to it, later older ones fade.
const WINDOW: u64 = 4000;

#[derive(Debug)]
pub(super) struct History {
    cols: usize,
    pub(super) mean: Vec<f32>,
    pub(super) variance: Vec<f32>,
}

impl History {
    pub(super) fn new(shape: Shape) -> Self {
        let zeros = || vec![0.0; shape.len()];
        Self { cols: shape.cols, mean: zeros(), variance: zeros() }
    }

    /// Adds a frame, the `number`th, from 1.
    pub(super) fn add(&mut self, raw: &[f32], number: u64, workers: &Workers) {
        let share = 1.0 / number.clamp(1, WINDOW) as f32;
        let size = BAND * self.cols;
        let bands = bands!(size; &mut self.mean, &mut self.variance);
        workers.each(bands, |index, (means, variances)| {
            follow(means, variances, &raw[index * size..], share);
        });
    }

    /// Mean over all pixels.
    pub(super) fn level(&self) -> f64 {
        sum(&self.mean) / self.mean.len() as f64
    }

    pub(super) fn deviation(&self) -> Vec<f32> {
        self.variance.iter().map(|variance| variance.sqrt()).collect()
    }
}

wide! {
/// Mean and variance with one more value, which has a share of all.
fn follow<'s>(means: &'s mut [f32], variances: &'s mut [f32], raw: &'s [f32], share: f32) -> () {
    for ((mean, variance), y) in means.iter_mut().zip(variances).zip(raw) {
        let change = y - *mean;
        *mean += share * change;
        *variance = (1.0 - share) * (*variance + share * change * change);
    }
}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_deviation_is_that_over_the_frames() {
        let shape = Shape::new(20, 3);
        let workers = Workers::new(std::num::NonZeroUsize::new(2)).unwrap();
        let mut history = History::new(shape);
        let value =
            |frame: u64, pixel: usize| ((frame * 613 + 7919) % 1009 * pixel as u64) as f32 / 6e4;
        for frame in 0..40 {
            let raw: Vec<f32> = (0..shape.len()).map(|pixel| value(frame, pixel)).collect();
            history.add(&raw, frame + 1, &workers);
        }
        for (pixel, deviation) in history.deviation().into_iter().enumerate() {
            let values: Vec<_> = (0..40).map(|frame| f64::from(value(frame, pixel))).collect();
            let mean = values.iter().sum::<f64>() / 40.0;
            let square = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / 40.0;
            // Some ten roundings of values below 1 in each of 40 steps, of squares near 0.1.
            let allowed = 400.0 * f64::from(f32::EPSILON);
            assert!((f64::from(deviation).powi(2) - square).abs() < allowed, "{pixel}");
        }
        assert_eq!(history.deviation()[0], 0.0);
    }
}

//! The field in blocks over time: frames that show no scene, and parts of the field that do not move.
//!
//! Means of blocks of 8×8 pixels hold little of the pattern and of the noise.

use super::motion::{blocks, blocks_of};
use super::state::State;
use crate::frames::Shape;
use crate::parallel::Workers;

/// A frame that differs by more than this factor, in its mean square, from the frames around it shows no scene.
/// Of a scene whose speed runs from 0 to twice its mean it is 2.
const FOREIGN: f64 = 5.0;

/// Rms change below which a frame is never foreign, on the scale [0, 1].
const LEAST: f64 = 0.004;

/// Frames over which the usual change is averaged. Changes of less than a quarter of it, as of a scene that
/// stops, leave it as it is.
const REMEMBERED: f64 = 64.0;

/// Least ratio of the variance of a block over time to half of the mean square change from frame to frame. Of
/// white noise it is 1, of a scene that moves by less than a block in each frame 3 or more.
const MOVED: f32 = 1.5;

/// Frames from which the ratio counts: that of noise errs by √(3/51), a quarter.
const LEAST_FRAMES: u64 = 51;

/// Means of blocks, and how they change over time.
#[derive(Debug)]
pub(super) struct Field {
    sizes: [usize; 2],
    /// Blocks of the last frame given, and of the last one that was no foreign one.
    given: Vec<f32>,
    last: Vec<f32>,
    mean: Vec<f32>,
    variance: Vec<f32>,
    /// Half of the mean square change.
    noise: Vec<f32>,
    usual: f32,
    frames: u64,
    pub(super) foreign: u64,
}

impl Field {
    pub(super) fn new(shape: Shape) -> Self {
        let sizes = blocks_of(shape);
        let zeros = || vec![0.0; sizes[0] * sizes[1]];
        let [given, last, mean, variance, noise] = std::array::from_fn(|_| zeros());
        Self { sizes, given, last, mean, variance, noise, usual: 0.0, frames: 0, foreign: 0 }
    }

    /// Takes a frame, unless it is a foreign one: far from the frame before and from the last one that was none.
    /// A new scene is foreign for one frame.
    pub(super) fn takes(
        &mut self,
        shape: Shape,
        raw: &[f32],
        refuse: bool,
        workers: &Workers,
    ) -> bool {
        let blocks = blocks(shape, raw, workers);
        let change = mean_square(&blocks, &self.last);
        let nearest = change.min(mean_square(&blocks, &self.given));
        let usual = f64::from(self.usual);
        self.given.copy_from_slice(&blocks);
        if refuse && self.frames > 1 && nearest > FOREIGN * usual.max(LEAST * LEAST) {
            self.foreign += 1;
            // After many such frames they are usual.
            self.usual += ((FOREIGN - 1.0) * usual.max(LEAST * LEAST) / REMEMBERED) as f32;
            return false;
        }
        if self.frames > 0 && 4.0 * change > usual {
            let share = 1.0 / (self.frames as f64).min(REMEMBERED);
            self.usual += (share * (change - usual)) as f32;
        }
        self.add(&blocks);
        true
    }

    fn add(&mut self, blocks: &[f32]) {
        self.frames += 1;
        let share = 1.0 / self.frames as f32;
        for (i, block) in blocks.iter().enumerate() {
            let (change, step) = (block - self.mean[i], block - self.last[i]);
            self.mean[i] += share * change;
            self.variance[i] = (1.0 - share) * (self.variance[i] + share * change * change);
            if self.frames > 1 {
                let share = 1.0 / (self.frames - 1) as f32;
                self.noise[i] += share * (0.5 * step * step - self.noise[i]);
            }
        }
        self.last.copy_from_slice(blocks);
    }

    /// Share of the field that does not move: what changes there does not follow from frame to frame.
    pub(super) fn still(&self) -> Option<f64> {
        let pairs = self.variance.iter().zip(&self.noise);
        let still = pairs.filter(|(variance, noise)| **variance <= MOVED * **noise).count();
        (self.frames >= LEAST_FRAMES).then(|| still as f64 / self.noise.len() as f64)
    }

    pub(super) fn state(&mut self) -> State<'_> {
        let sizes = self.sizes;
        State::default()
            .map("field_given", sizes, &mut self.given)
            .map("field_last", sizes, &mut self.last)
            .map("field_mean", sizes, &mut self.mean)
            .squares("field_variance", sizes, &mut self.variance)
            .squares("field_noise", sizes, &mut self.noise)
            .squares("field_usual", [1, 1], std::slice::from_mut(&mut self.usual))
            .count("field_frames", &mut self.frames)
            .count("foreign", &mut self.foreign)
    }
}

/// Mean square of the differences.
fn mean_square(blocks: &[f32], others: &[f32]) -> f64 {
    let squares = blocks.iter().zip(others).map(|(a, b)| f64::from(a - b).powi(2));
    squares.sum::<f64>() / blocks.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f32::consts::TAU;

    const SHAPE: Shape = Shape { rows: 64, cols: 64 };

    /// Two waves that move by two pixels in a frame, or stand still left of a column, as a scene of a level.
    fn frame(index: usize, still: usize, level: f32) -> Vec<f32> {
        let value = |pixel: usize| {
            let (row, col) = (pixel / SHAPE.cols, pixel % SHAPE.cols);
            let moved = if col < still { 0.0 } else { 2.0 * index as f32 };
            let angles = [(row as f32 + moved) / 40.0, (col as f32 + moved) / 56.0];
            // Noise of half a percent, other in each frame and pixel.
            let noise = ((pixel * 7919 + index * 6007) % 1009) as f32 / 1009.0 - 0.5;
            level + 0.1 * (TAU * angles[0]).sin() + 0.1 * (TAU * angles[1]).sin() + 0.02 * noise
        };
        (0..SHAPE.len()).map(value).collect()
    }

    fn take(field: &mut Field, frame: &[f32]) -> bool {
        field.takes(SHAPE, frame, true, &Workers::new(std::num::NonZeroUsize::new(1)).unwrap())
    }

    #[test]
    fn the_share_of_the_field_that_stands_still_is_found() {
        for (still, share) in [(0, 0.0), (32, 0.5), (64, 1.0)] {
            let mut field = Field::new(SHAPE);
            for index in 0..200 {
                assert_eq!(field.still().is_some(), index as u64 >= LEAST_FRAMES);
                assert!(take(&mut field, &frame(index, still, 0.5)));
            }
            // Of 64 blocks of noise one in twenty may exceed the ratio by chance.
            assert!((field.still().unwrap() - share).abs() <= 3.0 / 64.0, "{still}");
        }
    }

    #[test]
    fn a_foreign_frame_changes_nothing_and_a_new_scene_costs_one() {
        let mut field = Field::new(SHAPE);
        for index in 0..40 {
            assert!(take(&mut field, &frame(index, 0, 0.5)));
        }
        let (mean, variance, frames) = (field.mean.clone(), field.variance.clone(), field.frames);
        assert!(!take(&mut field, &vec![0.0; SHAPE.len()]));
        assert_eq!((&field.mean, &field.variance, field.frames), (&mean, &variance, frames));
        assert!(take(&mut field, &frame(41, 0, 0.5)));
        assert!(!take(&mut field, &frame(42, 0, 0.9)));
        assert!(take(&mut field, &frame(43, 0, 0.9)));
        assert_eq!(field.foreign, 2);
    }
}

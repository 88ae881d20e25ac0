//! The descent of gain and offset along the gradient of the squared error, in noise.
//!
//! With the mean m of the raw values so far as the centre, X = g (y − m) + o' and an error E of X pull
//!
//! ```text
//! g ← g + η E (y − m),   o' ← o' + η E,   o = o' − m g
//! ```
//!
//! About m an error of the offset does not leak into the gain while the level of the scene runs from one end
//! to the other. Three things follow from noise of the variance σ²:
//!
//! 1. E y contains −g σ², errors in variables: every pixel that takes part loses a share η σ² of its gain. The
//!    mean gain shows how much, so the gauge gives it back in proportion to the part that each pixel took. A
//!    gauge common to all would raise the gains of pixels that take part less often, as those of edges.
//! 2. A step η leaves errors of the variance η σ²/2 or so. The step is therefore η / (1 + s²/h²), with the
//!    noise s that the errors show and the noise h that halves it.
//! 3. s² is half of the mean square by which errors differ from those two updates before, less a share of the mean
//!    of their products. What persists is the pattern, which is to be learned by long steps, and the share is what
//!    moves of it for each part that persists. Updates that follow one another have a frame in common.

use super::bands::{BAND, bands, fold, wide};
use super::coefficients::{Coefficients, sum_of_squares, sums};
use super::method::step_at;
use super::state::State;
use crate::frames::Shape;
use crate::parallel::Workers;

/// Frames over which the centre is the mean of the raw values.
const CENTRE: u64 = 1000;

/// Updates over which the variance of the noise is averaged.
const REMEMBERED: u64 = 32;

/// Step, noise and part of each pixel.
#[derive(Debug)]
pub(super) struct Descent {
    shape: Shape,
    step: f64,
    /// Noise in the errors at which the step is halved.
    half: f64,
    /// Mean square of what moves of the pattern in the errors, over that of what persists.
    moving: f64,
    centre: f32,
    frames: u64,
    /// Errors of the two updates before.
    before: [Vec<f32>; 2],
    variance: f32,
    updates: u64,
    /// Part that each pixel took in an update.
    part: Vec<f32>,
}

/// The errors of a frame, `sign` times `errors`.
#[derive(Clone, Copy)]
pub(super) struct Pull<'a> {
    pub(super) raw: &'a [f32],
    pub(super) errors: &'a [f32],
    pub(super) sign: f32,
    /// Writes the part that each pixel of a row took in them.
    pub(super) part: &'a (dyn Fn(usize, &mut [f32]) + Sync),
}

impl Descent {
    pub(super) fn new(shape: Shape, step: f64, half: f64, moving: f64) -> Self {
        let zeros = || vec![0.0; shape.len()];
        let before = [zeros(), zeros()];
        let (centre, variance, part) = (0.0, 0.0, zeros());
        Self { shape, step, half, moving, centre, frames: 0, before, variance, updates: 0, part }
    }

    /// Takes the raw values of a frame for the centre.
    pub(super) fn follow(&mut self, mean: f64) {
        self.frames += 1;
        let share = 1.0 / self.frames.min(CENTRE) as f64;
        self.centre += (share * (mean - f64::from(self.centre))) as f32;
    }

    /// Takes the errors of an update, the sum of its pulls, which set the step.
    fn take(&mut self, pulls: &[Pull<'_>], workers: &Workers) {
        let size = BAND * self.shape.cols;
        let squares = workers.map_blocks(&mut self.before[0], size, |index, before| {
            let mut errors = vec![0.0; before.len()];
            for pull in pulls {
                add(&mut errors, pull.sign, &pull.errors[index * size..]);
            }
            let total = sum_of_squares(before) + sum_of_squares(&errors);
            add(before, -1.0, &errors);
            let apart = sum_of_squares(before);
            before.copy_from_slice(&errors);
            [apart, (total - apart) / 2.0]
        });
        if self.updates >= 2 {
            let [apart, products] = fold(squares).map(|sum| sum / self.shape.len() as f64);
            let variance = apart / 2.0 - self.moving * products;
            let share = 1.0 / (self.updates - 1).min(REMEMBERED) as f64;
            self.variance += (share * (variance - f64::from(self.variance))) as f32;
        }
        self.updates += 1;
        self.before.swap(0, 1);
    }

    /// Changes the coefficients by the pulls of one frame or two, and holds the gauge.
    pub(super) fn learn(&mut self, pulls: &[Pull<'_>], to: &mut Coefficients, workers: &Workers) {
        self.take(pulls, workers);
        let (cols, centre) = (self.shape.cols, self.centre);
        let noise = f64::from(self.variance.max(0.0)) / (self.half * self.half);
        let step = (self.step / (1.0 + noise)) as f32;
        let bands = bands!(BAND * cols; &mut to.gain, &mut to.offset, &mut self.part);
        let lost = workers.each(bands, |index, (gain, offset, part)| {
            let mut taken = vec![0.0; cols];
            part.fill(0.0);
            for pull in pulls {
                let rows = gain.chunks_mut(cols).zip(offset.chunks_mut(cols));
                for (line, ((gain, offset), part)) in rows.zip(part.chunks_mut(cols)).enumerate() {
                    let row = index * BAND + line;
                    (pull.part)(row, &mut taken);
                    let [raw, errors] = [pull.raw, pull.errors].map(|each| &each[row * cols..]);
                    descend([raw, errors, &taken], [pull.sign, step, centre], gain, offset, part);
                }
            }
            sums(gain, offset, part)
        });
        to.hold_gauge_by(&self.part, fold(lost), workers);
    }

    pub(super) fn state(&mut self) -> State<'_> {
        let sizes = [self.shape.rows, self.shape.cols];
        let [first, second] = &mut self.before;
        State::default()
            .map("errors_first", sizes, first)
            .map("errors_second", sizes, second)
            .map("centre", [1, 1], std::slice::from_mut(&mut self.centre))
            .map("noise", [1, 1], std::slice::from_mut(&mut self.variance))
            .count("frames_of_centre", &mut self.frames)
            .count("updates", &mut self.updates)
    }
}

wide! {
fn add<'s>(values: &'s mut [f32], sign: f32, others: &'s [f32]) -> () {
    for (value, other) in values.iter_mut().zip(others) {
        *value += sign * other;
    }
}
}

wide! {
/// Changes coefficients by the raw values, errors and parts of a pull, and adds the step to the part of each pixel.
fn descend<'s>(
    pull: [&'s [f32]; 3], by: [f32; 3], gain: &'s mut [f32], offset: &'s mut [f32], part: &'s mut [f32],
) -> () {
    let ([raw, errors, taken], [sign, step, centre]) = (pull, by);
    let values = raw.iter().zip(errors).zip(taken);
    let pixels = gain.iter_mut().zip(offset).zip(part);
    for (((gain, offset), part), ((y, error), taken)) in pixels.zip(values) {
        let depth = y - centre;
        let step = step_at(step, depth);
        let change = step * sign * error;
        *gain += change * depth;
        *offset += change - centre * change * depth;
        *part += step * taken;
    }
}
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPE: Shape = Shape { rows: 64, cols: 64 };
    const DEVIATION: f32 = 0.01;

    fn one() -> Workers {
        Workers::new(std::num::NonZeroUsize::new(1)).unwrap()
    }

    /// The pull of a frame in which all pixels take part.
    fn pull<'a>(raw: &'a [f32], errors: &'a [f32]) -> Pull<'a> {
        Pull { raw, errors, sign: 1.0, part: &|_, part| part.fill(1.0) }
    }

    /// Independent values of variance 1, other for each seed.
    fn noise(seed: u64) -> Vec<f32> {
        let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            ((state >> 40) as f32 / (1 << 24) as f32 - 0.5) * 12.0_f32.sqrt()
        };
        (0..SHAPE.len()).map(|_| next()).collect()
    }

    /// The variance that 40 errors show: what persists, what changes with each move, and noise.
    fn variance(moving: f64, persists: f32, moves: f32) -> f64 {
        let (mut descent, pattern) = (Descent::new(SHAPE, 0.1, DEVIATION.into(), moving), noise(1));
        for index in 0..40 {
            let (moved, own) = (noise(100 + index), noise(200 + index));
            let parts = pattern.iter().zip(&moved).zip(&own);
            let errors = parts.map(|((p, m), n)| persists * p + moves * m + DEVIATION * n);
            descent.take(&[pull(&[], &errors.collect::<Vec<_>>())], &one());
        }
        f64::from(descent.variance) / f64::from(DEVIATION).powi(2)
    }

    #[test]
    fn a_pattern_is_no_noise() {
        // 32 means over 4096 pixels, whose products of noise and pattern err by 10/√(32 · 4096) each at most.
        let error = 5.0 * 0.03;
        assert!((variance(0.0, 0.0, 0.0) - 1.0).abs() < error);
        assert!((variance(0.0, 0.1, 0.0) - 1.0).abs() < error);
        assert!((variance(0.5, 0.02, 0.02 / 2.0_f32.sqrt()) - 1.0).abs() < error);
        assert!(variance(0.0, 0.02, 0.02 / 2.0_f32.sqrt()) > 2.5);
        // A pattern that only persists is more than the share. The mean is not clamped, or scatter would raise it: it is
        // 1 − 0.5 · 0.1²/0.01², to thrice what the square of 4096 even values errs by, 0.9/√4096.
        assert!((variance(0.5, 0.1, 0.0) + 49.0).abs() < 3.0 * 50.0 * 0.9 / 64.0);
    }

    #[test]
    fn errors_pull_about_the_centre_by_a_step_that_noise_halves() {
        let raw = vec![0.75; SHAPE.len()];
        let signs = (0..SHAPE.len()).map(|pixel| if pixel % 2 == 0 { 0.01 } else { -0.01 });
        let errors: Vec<f32> = signs.collect();
        let square = DEVIATION * DEVIATION;
        for (variance, step) in [(-square, 0.1), (0.0, 0.1), (square, 0.05)] {
            let mut descent = Descent::new(SHAPE, 0.1, DEVIATION.into(), 0.0);
            descent.follow(0.25);
            descent.variance = variance;
            let mut learned = Coefficients::new(SHAPE);
            descent.learn(&[pull(&raw, &errors)], &mut learned, &one());
            // X changes by η E ((y − m)² + 1) at the raw value, and by η E at the centre; of such errors the
            // gauge takes nothing.
            for (pixel, error) in errors.iter().enumerate() {
                let at = |y: f32| learned.gain[pixel] * y + learned.offset[pixel] - y;
                assert!((at(0.75) - step * error * 1.25).abs() < 4.0 * f32::EPSILON);
                assert!((at(0.25) - step * error).abs() < 4.0 * f32::EPSILON);
            }
        }
    }
}

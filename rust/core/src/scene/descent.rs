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
//! 3. s² is half of the mean square by which errors differ from those two updates before. What persists is the
//!    pattern, which is to be learned by long steps; updates that follow one another share a frame.

use super::bands::{BAND, bands, fold};
use super::coefficients::{Coefficients, sum_of_squares};
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
    centre: f32,
    frames: u64,
    /// Errors of the two updates before.
    before: [Vec<f32>; 2],
    variance: f32,
    updates: u64,
    /// Part that each pixel took in an update.
    part: Vec<f32>,
}

/// The errors of a frame, and the part that each of its pixels took in them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pull<'a> {
    pub(super) raw: &'a [f32],
    pub(super) errors: &'a [f32],
    pub(super) part: &'a [f32],
}

impl Descent {
    pub(super) fn new(shape: Shape, step: f64, half: f64) -> Self {
        let zeros = || vec![0.0; shape.len()];
        let before = [zeros(), zeros()];
        let (centre, variance, part) = (0.0, 0.0, zeros());
        Self { shape, step, half, centre, frames: 0, before, variance, updates: 0, part }
    }

    /// Takes the raw values of a frame for the centre.
    pub(super) fn follow(&mut self, mean: f64) {
        self.frames += 1;
        let share = 1.0 / self.frames.min(CENTRE) as f64;
        self.centre += (share * (mean - f64::from(self.centre))) as f32;
    }

    /// Takes the errors of an update, which set the step.
    pub(super) fn take(&mut self, errors: &[f32], workers: &Workers) {
        let size = BAND * self.shape.cols;
        let squares = workers.map_blocks(&mut self.before[0], size, |index, before| {
            let errors = &errors[index * size..][..before.len()];
            for (before, error) in before.iter_mut().zip(errors) {
                *before -= error;
            }
            let squares = sum_of_squares(before);
            before.copy_from_slice(errors);
            [squares]
        });
        if self.updates >= 2 {
            let variance = fold(squares)[0] / (2.0 * self.shape.len() as f64);
            let share = 1.0 / (self.updates - 1).min(REMEMBERED) as f64;
            self.variance += (share * (variance - f64::from(self.variance))) as f32;
        }
        self.updates += 1;
        self.before.swap(0, 1);
    }

    /// Changes the coefficients by the pulls of one frame or two, and holds the gauge.
    pub(super) fn learn(&mut self, pulls: &[Pull<'_>], to: &mut Coefficients, workers: &Workers) {
        let (cols, centre) = (self.shape.cols, self.centre);
        let noise = f64::from(self.variance) / (self.half * self.half);
        let step = (self.step / (1.0 + noise)) as f32;
        let bands = bands!(BAND * cols; &mut to.gain, &mut to.offset, &mut self.part);
        workers.each(bands, |index, (gain, offset, part)| {
            part.fill(0.0);
            for pull in pulls {
                let start = index * BAND * cols;
                let values = pull.raw[start..].iter().zip(&pull.errors[start..]);
                let values = values.zip(&pull.part[start..]);
                let pixels = gain.iter_mut().zip(offset.iter_mut()).zip(part.iter_mut());
                for (((gain, offset), part), ((y, error), taken)) in pixels.zip(values) {
                    let depth = y - centre;
                    let step = step_at(step, depth);
                    let change = step * error;
                    *gain += change * depth;
                    *offset += change - centre * change * depth;
                    *part += step * taken;
                }
            }
        });
        to.hold_gauge_by(&self.part, workers);
    }

    pub(super) fn state(&mut self) -> State<'_> {
        let sizes = [self.shape.rows, self.shape.cols];
        let [first, second] = &mut self.before;
        State::default()
            .map("errors_first", sizes, first)
            .map("errors_second", sizes, second)
            .map("centre", [1, 1], std::slice::from_mut(&mut self.centre))
            .squares("noise", [1, 1], std::slice::from_mut(&mut self.variance))
            .count("frames_of_centre", &mut self.frames)
            .count("updates", &mut self.updates)
    }
}

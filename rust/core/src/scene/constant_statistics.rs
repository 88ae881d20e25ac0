//! Mean and deviation of each pixel over time made equal to those of its neighbourhood.
//!
//! J. G. Harris, Y.-M. Chiang, "Nonuniformity correction of infrared image sequences using the
//! constant-statistics constraint", IEEE Transactions on Image Processing 8 (1999) 1148–1151; here with
//! the neighbourhood in the place of the array, whose scene differs from place to place.

use super::bands::{BAND, bands, fold};
use super::coefficients::{Coefficients, sum};
use super::method::{Frame, Method};
use super::motion::Motion;
use super::neighbourhood::Squares;
use super::options::{check_range, check_width};
use super::state::State;
use crate::error::{Error, Result};
use crate::frames::Shape;
use crate::parallel::Workers;

/// Least deviation over time that a gain is divided by, in that of the neighbourhood: a dead pixel has 0.
const LEAST_DEVIATION: f32 = 0.1;

/// Standard deviation of usual gains.
const GAIN_SPREAD: f64 = 0.05;

/// Largest share of noise that counts.
const MOST_NOISE: f64 = 0.9;

/// Least deviation of a neighbourhood: below it nothing has changed.
const NOTHING: f32 = 1e-9;

/// g = 1 + w (s̄/s − 1), o = m̄ − g m with the mean m and the deviation s of a pixel over time, and
/// their means m̄ and s̄ over a square. w grows to 1 with the frames.
#[derive(Debug)]
pub(super) struct ConstantStatistics {
    shape: Shape,
    width: usize,
    window: u64,
    prior: u64,
    motion: Motion,
    /// Frames of each pixel.
    counts: Vec<f32>,
    mean: Vec<f32>,
    variance: Vec<f32>,
    /// √variance: made of it in every update.
    deviation: Vec<f32>,
}

impl ConstantStatistics {
    pub(super) fn new(
        shape: Shape,
        width: usize,
        [window, prior]: [u64; 2],
        motion: f64,
    ) -> Result<Self> {
        check_width(shape, width)?;
        check_range("window", window as f64, [2.0, 1e12])?;
        check_range("prior", prior as f64, [0.0, 1e12])?;
        check_range("motion", motion, [0.0, 1.0])?;
        let zeros = || vec![0.0; shape.len()];
        let motion = Motion::new(shape, motion);
        let (mean, variance, deviation) = (zeros(), zeros(), zeros());
        let counts = zeros();
        Ok(Self { shape, width, window, prior, motion, counts, mean, variance, deviation })
    }

    /// Adds a frame to the statistics of the pixels.
    fn add(&mut self, frame: &Frame<'_>, workers: &Workers) {
        let window = self.window as f32;
        let size = BAND * self.shape.cols;
        let bands =
            bands!(size; &mut self.mean, &mut self.variance, &mut self.deviation, &mut self.counts);
        workers.each(bands, |index, (means, variances, deviations, counts)| {
            let pixels = means.iter_mut().zip(variances).zip(deviations.iter_mut().zip(counts));
            let frames = pixels.zip(&frame.raw[index * size..]).enumerate();
            for (pixel, (((mean, variance), (deviation, count)), y)) in frames {
                if frame.left_out.is_some_and(|out| out[index * size + pixel]) {
                    continue;
                }
                *count = (*count + 1.0).min(window);
                let share = 1.0 / *count;
                let change = y - *mean;
                *mean += share * change;
                *variance = (1.0 - share) * (*variance + share * change * change);
                *deviation = variance.sqrt();
            }
        });
    }

    /// Frames after which the noise leaves as much of a gain's estimate as gains spread.
    ///
    /// With a share q of noise in the variance over time, the deviation over n frames errs by the share
    /// √((q² + 2 q (1 − q)) / 2n), and a gain changes it by 1 − q of itself.
    fn frames_of_noise(&self, workers: &Workers) -> f32 {
        let size = BAND * self.shape.cols;
        let lines = workers.map(self.shape.len().div_ceil(size), |index| {
            let end = self.shape.len().min((index + 1) * size);
            [sum(&self.variance[index * size..end])]
        });
        let variance = fold(lines)[0] / self.shape.len() as f64;
        let share =
            (f64::from(self.motion.noise) / variance.max(f64::MIN_POSITIVE)).min(MOST_NOISE);
        let kept = (1.0 - share) * GAIN_SPREAD;
        (share * (2.0 - share) / (2.0 * kept * kept)) as f32
    }

    /// Finds the coefficients that give each pixel the statistics of its neighbourhood.
    fn equalise(&self, coefficients: &mut Coefficients, workers: &Workers) {
        let (shape, cols) = (self.shape, self.shape.cols);
        let prior = self.prior as f32 + self.frames_of_noise(workers);
        let row_of = |values: &'_ [f32], row: usize, line: &mut [f32]| {
            line.copy_from_slice(&values[row * cols..(row + 1) * cols]);
        };
        let bands = bands!(BAND * cols; &mut coefficients.gain, &mut coefficients.offset);
        workers.each(bands, |index, (gain, offset)| {
            let first = index * BAND;
            let mut means = Squares::new(shape, self.width, first, |row, line: &mut [f32]| {
                row_of(&self.mean, row, line);
            });
            let mut deviations = Squares::new(shape, self.width, first, |row, line: &mut [f32]| {
                row_of(&self.deviation, row, line);
            });
            let (mut mean, mut deviation) = (vec![0.0; cols], vec![0.0; cols]);
            let rows = gain.chunks_mut(cols).zip(offset.chunks_mut(cols));
            for (row, (gain, offset)) in rows.enumerate() {
                means.next(&mut mean);
                deviations.next(&mut deviation);
                let start = (first + row) * cols;
                for col in 0..cols {
                    let known = self.counts[start + col];
                    let trust = known / (known + prior).max(1.0);
                    let wanted = deviation[col].max(NOTHING);
                    let own = self.deviation[start + col].max(LEAST_DEVIATION * wanted);
                    gain[col] = 1.0 + trust * (wanted / own - 1.0);
                    offset[col] = mean[col] - gain[col] * self.mean[start + col];
                }
            }
        });
        coefficients.hold_gauge(workers);
    }
}

impl Method for ConstantStatistics {
    fn update(
        &mut self,
        frame: &Frame<'_>,
        coefficients: &mut Coefficients,
        workers: &Workers,
    ) -> bool {
        if !self.motion.moved(frame.raw, workers) {
            return false;
        }
        self.add(frame, workers);
        if self.motion.frames > 1 {
            self.equalise(coefficients, workers);
        }
        self.motion.frames > 1
    }

    fn width(&self) -> usize {
        self.width
    }

    /// Means of n frames have a variance of v/n, and change by v/early − v/n. The errors are waves of some ten pixels, of
    /// which an array has few: at 128×128 pixels the ratio scatters by 15 %, so half is added. Beyond the window they
    /// forget.
    fn forgets(&self, early: u64, frames: u64) -> f64 {
        if frames > self.window { 0.8 } else { 1.5 * early as f64 / (frames - early).max(1) as f64 }
    }

    /// Refuses counts beyond the window, and values that no frame has.
    fn check(&self) -> Result<()> {
        let counts = self.counts.iter().all(|count| *count <= self.window as f32);
        let means = self.mean.iter().all(|mean| (-1.0..=2.0).contains(mean));
        let pairs = self.deviation.iter().zip(&self.variance);
        let roots = pairs.into_iter().all(|(d, v)| (d * d - v).abs() <= 1e-5 * v.max(1e-20));
        if counts && means && roots {
            return Ok(());
        }
        Err(Error::value("state", "holds statistics over time that no frames have"))
    }

    /// Pixels that are compared need the same frames: one that lacks its bright ones has another mean.
    fn leaves_out_saturated(&self) -> bool {
        false
    }

    fn state(&mut self) -> State<'_> {
        let sizes = [self.shape.rows, self.shape.cols];
        State::default()
            .squares("counts", sizes, &mut self.counts)
            .map("mean", sizes, &mut self.mean)
            .squares("variance", sizes, &mut self.variance)
            .squares("deviation", sizes, &mut self.deviation)
            .and(self.motion.state())
    }
}

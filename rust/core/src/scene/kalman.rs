//! Recursive Gauss-Markov estimate of each pixel's gain and offset, with their covariance.
//!
//! After S. N. Torres, M. M. Hayat, "Kalman filtering for adaptive nonuniformity correction in infrared
//! focal-plane arrays", Journal of the Optical Society of America A 20 (2003) 470–480, with the mean of the
//! neighbourhood as the scene. About the middle of the range
//!
//! ```text
//! y − ½ = G (r − ½) + O + e
//! ```
//!
//! with the mean r of the corrected values in a square, and the detail e of the scene within it. A block of
//! n frames gives normal equations of (G, O), of weight 1/V. The detail of neighbouring frames is correlated,
//! so V is not the variance of e, but n times that of its mean: the sums S₁, S₂ of the residuals over the
//! halves of a block give V = ⟨(S₂ − S₁)²⟩ / n. In their difference the pattern of the pixels cancels.
//! Between blocks (G, O) return to (1, 0), and their covariance to the spread given, as a Gauss-Markov
//! process does.

use super::bands::{BAND, bands, fold};
use super::coefficients::Coefficients;
use super::method::{Frame, Method};
use super::motion::Motion;
use super::neighbourhood::Squares;
use super::options::{check_range, check_width};
use super::state::State;
use crate::error::{Error, Result};
use crate::frames::Shape;
use crate::parallel::Workers;

/// Middle of the range.
const MIDDLE: f32 = 0.5;

/// Pattern that is left over its standard deviation, which leaves out patterns wider than the square: at 128×128
/// pixels up to 1.35.
const WIDER: f64 = 1.35;

/// Least response that a gain is the inverse of: that of a dead pixel.
const LEAST_RESPONSE: f64 = 0.1;

/// The estimate of one pixel: G, O and the variances of G, of O, and their covariance.
type Estimate = [f32; 5];

/// Σ (r − ½), Σ (r − ½)², Σ (y − ½), Σ (r − ½)(y − ½) over a block, Σ residual over its first half, and the
/// frames.
type Sums = [f32; 6];

#[derive(Debug)]
pub(super) struct Kalman {
    shape: Shape,
    width: usize,
    block: u64,
    motion: Motion,
    /// Variances of G and O at first, to which they return.
    spread: [f64; 2],
    /// Share of the deviation from (1, 0) that is left after a block.
    kept: f64,
    estimates: Vec<Estimate>,
    sums: Vec<Sums>,
    /// Frames of the block.
    count: u64,
    blocks: u64,
}

impl Kalman {
    pub(super) fn new(
        shape: Shape,
        width: usize,
        block: u64,
        motion: f64,
        [gain_spread, offset_spread, memory]: [f64; 3],
    ) -> Result<Self> {
        check_width(shape, width)?;
        check_range("motion", motion, [0.0, 1.0])?;
        check_range("gain_spread", gain_spread, [1e-6, 1.0])?;
        check_range("offset_spread", offset_spread, [1e-6, 1.0])?;
        if block % 2 == 1 || !(4..=1 << 16).contains(&block) {
            let problem = format!("is {block}, expected an even number from 4 to {}", 1 << 16);
            return Err(Error::value("block", problem));
        }
        check_range("memory", memory, [block as f64, f64::INFINITY])?;
        let spread = [gain_spread * gain_spread, offset_spread * offset_spread];
        let first = [1.0, 0.0, spread[0] as f32, spread[1] as f32, 0.0];
        Ok(Self {
            shape,
            width,
            block,
            motion: Motion::new(shape, motion),
            spread,
            kept: (-(block as f64) / memory).exp(),
            estimates: vec![first; shape.len()],
            sums: vec![[0.0; 6]; shape.len()],
            count: 0,
            blocks: 0,
        })
    }

    /// Adds a frame to the sums of the block.
    fn add(&mut self, frame: &Frame<'_>, workers: &Workers) {
        let (shape, cols, width) = (self.shape, self.shape.cols, self.width);
        let centred = |row: usize, line: &mut [f32]| {
            for (value, corrected) in line.iter_mut().zip(frame.row(row).1) {
                *value = corrected - MIDDLE;
            }
        };
        self.count += 1;
        let half = 2 * self.count == self.block;
        let bands = bands!(BAND * cols; &mut self.sums, &mut self.estimates);
        workers.each(bands, |index, (sums, estimates)| {
            let mut means = Squares::new(shape, width, index * BAND, centred);
            let mut mean = vec![0.0; cols];
            let rows = sums.chunks_mut(cols).zip(estimates.chunks(cols));
            for (row, (sums, estimates)) in rows.enumerate() {
                means.next(&mut mean);
                let raw = frame.row(index * BAND + row).0;
                for (col, sums) in sums.iter_mut().enumerate() {
                    if !frame.leaves_out(index * BAND + row, col) {
                        let (r, y) = (mean[col], raw[col] - MIDDLE);
                        let terms = [r, r * r, y, r * y, 0.0, 1.0];
                        sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
                    }
                    if half {
                        sums[4] = left(sums, &estimates[col]);
                    }
                }
            }
        });
    }

    /// Combines the block with the estimates before it, and begins the next.
    fn learn(&mut self, coefficients: &mut Coefficients, workers: &Workers) {
        let (size, count) = (BAND * self.shape.cols, self.block as f32);
        let bands = bands!(size; &mut self.sums, &mut self.estimates);
        let squares = workers.each(bands, |_, (sums, estimates)| {
            let full = sums.iter().zip(estimates).filter(|(sums, _)| sums[5] == count);
            let squares =
                full.map(|(s, e)| [f64::from(left(s, e) - 2.0 * s[4]).powi(2), 1.0]).collect();
            fold(squares)
        });
        // A pixel that lacks frames has halves that differ by more than the detail.
        let [squares, full] = fold(squares);
        if full == 0.0 {
            self.sums.fill([0.0; 6]);
            self.count = 0;
            return;
        }
        let variance = squares / (full * self.block as f64);
        let bands = bands!(
            size; &mut self.sums, &mut self.estimates, &mut coefficients.gain,
            &mut coefficients.offset
        );
        let (kept, spread) = (self.kept, self.spread);
        workers.each(bands, |_, (sums, estimates, gain, offset)| {
            let coefficients = gain.iter_mut().zip(offset);
            let pixels = sums.iter_mut().zip(estimates).zip(coefficients);
            for ((sums, estimate), (gain, offset)) in pixels {
                let estimated = combined(sums, estimate, variance, kept, spread);
                *estimate = estimated.map(|value| value as f32);
                let inverse = 1.0 / estimated[0].max(LEAST_RESPONSE);
                *gain = inverse as f32;
                *offset = (0.5 - (0.5 + estimated[1]) * inverse) as f32;
                *sums = [0.0; 6];
            }
        });
        let taken = coefficients.hold_gauge(workers);
        // X = s X' + c: G' = s G, O' = O + G (c + (s − 1)/2) about the middle.
        let (scale, turn) = (taken.scale, taken.shift + (taken.scale - 1.0) / 2.0);
        workers.map_blocks(&mut self.estimates, size, |_, estimates| {
            for estimate in estimates {
                *estimate = turned(estimate.map(f64::from), scale, turn).map(|value| value as f32);
            }
        });
        (self.count, self.blocks) = (0, self.blocks + 1);
    }
}

/// Sum of the residuals of a block so far.
fn left(sums: &Sums, estimate: &Estimate) -> f32 {
    sums[2] - estimate[0] * sums[0] - sums[5] * estimate[1]
}

/// The estimate after a block: that before it, carried on as a Gauss-Markov process, and the block's normal
/// equations with weight 1/variance.
fn combined(
    sums: &Sums,
    estimate: &Estimate,
    variance: f64,
    kept: f64,
    spread: [f64; 2],
) -> [f64; 5] {
    let [r, rr, y, ry, _, count] = sums.map(f64::from);
    let [gain, offset, gg, oo, go] = estimate.map(f64::from);
    let (gain, offset) = (1.0 + kept * (gain - 1.0), kept * offset);
    let (square, fresh) = (kept * kept, 1.0 - kept * kept);
    let (gg, oo, go) =
        (square * gg + fresh * spread[0], square * oo + fresh * spread[1], square * go);
    let weight = 1.0 / variance.max(f64::MIN_POSITIVE);
    let before = 1.0 / (gg * oo - go * go);
    let information =
        [oo * before + rr * weight, gg * before + count * weight, r * weight - go * before];
    let inverse = 1.0 / (information[0] * information[1] - information[2] * information[2]);
    let (gg, oo, go) =
        (information[1] * inverse, information[0] * inverse, -information[2] * inverse);
    let gain_left = (ry - gain * rr - offset * r) * weight;
    let offset_left = (y - gain * r - offset * count) * weight;
    [
        gain + gg * gain_left + go * offset_left,
        offset + go * gain_left + oo * offset_left,
        gg,
        oo,
        go,
    ]
}

/// The estimate in another gauge: G' = s G, O' = O + t G.
fn turned([gain, offset, gg, oo, go]: [f64; 5], s: f64, t: f64) -> [f64; 5] {
    let oo = oo + 2.0 * t * go + t * t * gg;
    [s * gain, offset + t * gain, s * s * gg, oo, s * (go + t * gg)]
}

impl Method for Kalman {
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
        if self.count == self.block {
            self.learn(coefficients, workers);
        }
        true
    }

    fn width(&self) -> usize {
        self.width
    }

    fn state(&mut self) -> State<'_> {
        let sizes = [self.shape.rows, 5 * self.shape.cols];
        let sums = [self.shape.rows, 6 * self.shape.cols];
        State::default()
            .map("estimates", sizes, self.estimates.as_flattened_mut())
            .map("sums", sums, self.sums.as_flattened_mut())
            .count_below("count", &mut self.count, self.block)
            .count("blocks", &mut self.blocks)
            .and(self.motion.state())
    }

    /// The median over the pixels, of which masked ones keep their first variances, times `WIDER`².
    ///
    /// A change would not show patterns wider than the square: corrected means contain them, so they persist.
    fn leaves(&self, level: f64) -> Option<f64> {
        let depth = level as f32 - MIDDLE;
        let at = |[_, _, gg, oo, go]: &Estimate| gg * depth * depth + 2.0 * go * depth + oo;
        let mut variances: Vec<f32> = self.estimates.iter().map(at).collect();
        let middle = variances.len() / 2;
        let (_, median, _) = variances.select_nth_unstable_by(middle, f32::total_cmp);
        Some(f64::from(*median) * WIDER * WIDER)
    }

    /// Refuses variances that are not above 0, covariances beyond them, and sums of no frames.
    fn check(&self) -> Result<()> {
        let allowed = 1.0 + 1e-3;
        let sound =
            |[_, _, gg, oo, go]: &Estimate| *gg > 0.0 && *oo > 0.0 && go * go <= allowed * gg * oo;
        let frames = self.count as f32;
        // By Cauchy and Schwarz (Σ r)² ≤ n Σ r².
        let summed = |[r, rr, .., n]: &Sums| {
            (0.0..=frames).contains(n) && *rr >= 0.0 && r * r <= allowed * n * rr + 1e-6
        };
        if self.estimates.iter().all(sound) && self.sums.iter().all(summed) {
            return Ok(());
        }
        Err(Error::value("state", "holds variances below 0, or sums that no frames have"))
    }

    fn variances(&self) -> Option<[Vec<f32>; 2]> {
        // Of g = 1/G and, where the range is in the middle, of o = ½ − (½ + O)/G, to first order.
        let gain = |e: &Estimate| e[2] / e[0].powi(4);
        let offset = |e: &Estimate| {
            let slope = (MIDDLE + e[1]) / e[0];
            (slope * slope * e[2] + e[3] - 2.0 * slope * e[4]) / (e[0] * e[0])
        };
        Some([
            self.estimates.iter().map(gain).collect(),
            self.estimates.iter().map(offset).collect(),
        ])
    }
}

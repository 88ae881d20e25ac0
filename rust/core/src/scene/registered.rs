//! Towards the other frame of a pair, moved by the shift between them.
//!
//! After C. Zuo, Q. Chen, G. Gu, X. Sui, "Scene-based nonuniformity correction algorithm based on interframe
//! registration", Journal of the Optical Society of America A 28 (2011) 1164–1176, with both frames of a pair
//! corrected: with one alone the border, which has no partner, is carried inwards by the motion.

use super::coefficients::Coefficients;
use super::descent::{Descent, Pull};
use super::method::{Frame, Method};
use super::moved::{Move, Own, difference, transposed};
use super::options::check_range;
use super::saturation::any_at;
use super::shift::PhaseCorrelation;
use super::spectrum::{Spectrum, Transform};
use super::spline::prefilter;
use super::stability::check_step;
use super::state::State;
use crate::error::{Error, Result};
use crate::frames::Shape;
use crate::parallel::Workers;

/// The difference E = S X₁ − X₂ of a pair is [S, −1] of the stacked frames, and X₂ changes by η E, X₁ by
/// −η Sᵀ E: the exact gradient of ‖E‖²/2, so the operator is symmetric and not negative. A moved spline is no
/// longer than its image but for 1.7 % at an edge, so the norm of [S, −1] squared is 2; both frames change the
/// same coefficients, which doubles max(y² + 1): η < 2 / (2 · 2 · 2).
const BOUND: f64 = 0.25;

/// Noise of a frame at which the step is halved.
const HALF: f64 = 0.02;

/// Noise in E − Sᵀ E for each noise in a frame: 4 of its variances, where the move is by whole pixels.
const WEIGHT: f64 = 2.0;

/// A pattern p is (S + Sᵀ) p − (1 + Sᵀ S) p in E − Sᵀ E. Of a white one, moved by whole pixels, the first part, which
/// changes with the move, has half of the mean square of the second.
const MOVING: f64 = 0.5;

/// A pair whose difference is larger than that of earlier pairs by this factor is not used. Up to it a frame
/// of another scene adds √3 times their rms, √2 σ of a pattern σ, to the difference: by a step of 0.1 the
/// pattern grows to √(1 + (0.1 · √3 · √2)²) σ, 3 %.
const ALIEN: f64 = 2.0;

/// Pairs over which the mean square of the difference is kept. One that is not used counts with the limit
/// instead, so that after a lasting change pairs are used again.
const REMEMBERED: f64 = 16.0;

/// The errors of the later frame are E = S X₁ − X₂, the difference of a pair less its mean, those of the earlier
/// one −Sᵀ E.
#[derive(Debug)]
pub(super) struct Registered {
    shape: Shape,
    descent: Descent,
    least_motion: f64,
    most_motion: f64,
    /// The least that is asked for, and that chance does not give.
    agreement: f64,
    transform: Transform,
    correlation: PhaseCorrelation,
    /// The earlier frame of the next pair, raw, and the spectrum of it corrected.
    before: Vec<f32>,
    spectrum: Spectrum,
    frames: u64,
    usual: Usual,
    scratch: Scratch,
}

/// Images that live for one update.
#[derive(Debug)]
struct Scratch {
    corrected: Vec<f32>,
    along: Vec<f32>,
    coefficients: Vec<f32>,
    error: Vec<f32>,
    transposed: Vec<f32>,
}

/// Mean square of the differences of earlier pairs, and their number.
#[derive(Debug, Default)]
struct Usual {
    square: f32,
    pairs: u64,
}

impl Usual {
    /// Whether the difference of a pair is one that earlier pairs had.
    fn takes(&mut self, square: f64) -> bool {
        let limit = ALIEN * ALIEN * f64::from(self.square);
        let usual = self.pairs == 0 || square <= limit;
        self.pairs += 1;
        let counted = if usual { square } else { limit };
        let share = 1.0 / (self.pairs as f64).min(REMEMBERED);
        self.square += (share * (counted - f64::from(self.square))) as f32;
        usual
    }
}

impl Registered {
    pub(super) fn new(
        shape: Shape,
        [step, least_motion, cutoff, agreement]: [f64; 4],
        most_motion: usize,
    ) -> Result<Self> {
        check_step(step, BOUND, "pairs of frames")?;
        check_range("cutoff", cutoff, [2.0 / shape.rows.min(shape.cols) as f64, 0.5])?;
        check_range("agreement", agreement, [0.0, 1.0])?;
        let most = shape.rows.min(shape.cols) / 2;
        if !(1..=most).contains(&most_motion) {
            let problem = format!("is {most_motion}, expected 1 to half the shorter side, {most}");
            return Err(Error::value("most_motion", problem));
        }
        check_range("least_motion", least_motion, [0.0, most_motion as f64])?;
        let transform = Transform::new(shape, cutoff);
        let correlation = PhaseCorrelation::new(&transform, cutoff, most_motion);
        let empty = || vec![0.0; shape.len()];
        let amplitudes = transform.sizes().iter().product();
        Ok(Self {
            shape,
            descent: Descent::new(shape, step, WEIGHT * HALF, MOVING),
            least_motion,
            most_motion: most_motion as f64,
            agreement: agreement.max(correlation.chance(cutoff)),
            correlation,
            transform,
            before: empty(),
            spectrum: Spectrum { re: vec![0.0; amplitudes], im: vec![0.0; amplitudes] },
            frames: 0,
            usual: Usual::default(),
            scratch: Scratch {
                corrected: empty(),
                along: empty(),
                coefficients: empty(),
                error: empty(),
                transposed: empty(),
            },
        })
    }

    /// Changes the coefficients by both frames of a pair, the later one shifted by `shift`, if its difference
    /// is one that earlier pairs had.
    fn learn(
        &mut self,
        frame: &Frame<'_>,
        shift: [f64; 2],
        coefficients: &mut Coefficients,
        workers: &Workers,
    ) -> bool {
        let shape = self.shape;
        let Scratch { corrected, along, coefficients: spline, error, transposed: back } =
            &mut self.scratch;
        let (before, way) = (&self.before[..], Move::new(shape, shift));
        coefficients.apply(before, corrected, workers);
        frame.fill.write(corrected);
        prefilter(shape, corrected, along, spline, workers);
        let left_out = saturated(frame, before, &way);
        let own = Own { values: frame.corrected, left_out: left_out.as_deref() };
        let square = difference(shape, spline, own, &way, error, workers);
        if !self.usual.takes(square) {
            return false;
        }
        transposed(shape, error, &way, [spline, along], back, workers);
        // The share of its own noise that each pixel of the later and of the earlier frame pulls on itself: 1 where the
        // move is inside, and the diagonal of Sᵀ S.
        let ([rows, columns], [down, across]) = (&way.inside, way.diagonals(shape));
        let inside = |row: usize, part: &mut [f32]| {
            part.fill(0.0);
            if rows.contains(&row) {
                part[columns.clone()].fill(1.0);
                own.clear(row * shape.cols, part);
            }
        };
        let diagonal = |row: usize, part: &mut [f32]| {
            for (part, across) in part.iter_mut().zip(&across) {
                *part = down[row] * across;
            }
        };
        let pulls = [
            Pull { raw: frame.raw, errors: error, sign: 1.0, part: &inside },
            Pull { raw: before, errors: back, sign: -1.0, part: &diagonal },
        ];
        self.descent.learn(&pulls, coefficients, workers);
        true
    }
}

/// Pixels of the later frame that are saturated, or whose place in the earlier one is within two pixels of
/// such a pixel; none if there is no such pixel.
fn saturated(frame: &Frame<'_>, before: &[f32], way: &Move) -> Option<Vec<bool>> {
    let earlier = |y: &f32| *y >= frame.saturation;
    if frame.left_out.is_none() && !any_at(before, frame.saturation) {
        return None;
    }
    let mut found: Vec<bool> = frame.raw.iter().map(earlier).collect();
    for (pixel, _) in before.iter().enumerate().filter(|(_, y)| earlier(y)) {
        way.near(frame.shape, pixel, |place| found[place] = true);
    }
    Some(found)
}

impl Method for Registered {
    fn update(
        &mut self,
        frame: &Frame<'_>,
        coefficients: &mut Coefficients,
        workers: &Workers,
    ) -> bool {
        self.descent.follow(frame.level);
        let spectrum = self.transform.of(frame.corrected, frame.mean as f32, workers);
        let (mut used, mut replace) = (false, self.frames == 0);
        if !replace {
            let shift = self.correlation.shift(&self.spectrum, &spectrum, workers);
            let [row, col] = shift.pixels;
            let far = row.abs().max(col.abs()) > self.most_motion;
            replace = far || shift.agreement < self.agreement;
            if !replace && row.hypot(col) >= self.least_motion && shift.shows {
                used = self.learn(frame, shift.pixels, coefficients, workers);
                replace = true;
            }
        }
        if replace {
            self.before.copy_from_slice(frame.raw);
            self.spectrum = spectrum;
            self.frames += 1;
        }
        used
    }

    fn width(&self) -> usize {
        1
    }

    fn compares_frames(&self) -> bool {
        true
    }

    fn state(&mut self) -> State<'_> {
        let sizes = [self.shape.rows, self.shape.cols];
        let amplitudes = self.transform.sizes();
        State::default()
            .map("before", sizes, &mut self.before)
            .map("spectrum_real", amplitudes, &mut self.spectrum.re)
            .map("spectrum_imaginary", amplitudes, &mut self.spectrum.im)
            .squares("usual", [1, 1], std::slice::from_mut(&mut self.usual.square))
            .count("frames_before", &mut self.frames)
            .count("pairs", &mut self.usual.pairs)
            .and(self.descent.state())
    }
}

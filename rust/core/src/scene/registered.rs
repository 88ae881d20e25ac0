//! Towards the other frame of a pair, moved by the shift between them.
//!
//! After C. Zuo, Q. Chen, G. Gu, X. Sui, "Scene-based nonuniformity correction algorithm based on interframe
//! registration", Journal of the Optical Society of America A 28 (2011) 1164–1176, with both frames of a pair
//! corrected: with one alone the border, which has no partner, is carried inwards by the motion.

use super::bands::{BAND, bands};
use super::coefficients::Coefficients;
use super::method::{Frame, Method, step_at};
use super::options::check_range;
use super::shift::PhaseCorrelation;
use super::spectrum::{Spectrum, Transform};
use super::spline::{Move, difference, prefilter};
use super::stability::check_step;
use super::state::State;
use crate::error::{Error, Result};
use crate::frames::Shape;
use crate::parallel::Workers;

/// Both differences of a pair, X₁(p + d) − X₂(p) and X₂(p − d) − X₁(p), are −L X of the stacked frames with
/// ‖L‖ ≤ 2, since a moved spline is no longer than the image. Both change the same coefficients, which doubles
/// max(y² + 1): η < 2 / (2 · 2 · 2).
const BOUND: f64 = 0.25;

/// g ← g + η (E₂ y₂ + E₁ y₁), o ← o + η (E₂ + E₁) with the differences E of a pair, less their mean.
#[derive(Debug)]
pub(super) struct Registered {
    shape: Shape,
    step: f32,
    least_motion: f64,
    most_motion: f64,
    agreement: f64,
    transform: Transform,
    correlation: PhaseCorrelation,
    /// The earlier frame of the next pair, raw, and the spectrum of it corrected.
    before: Vec<f32>,
    spectrum: Spectrum,
    frames: u64,
    scratch: Scratch,
}

/// Images that live for one update.
#[derive(Debug)]
struct Scratch {
    corrected: Vec<f32>,
    along: Vec<f32>,
    coefficients: Vec<f32>,
    errors: [Vec<f32>; 2],
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
        let empty = || vec![0.0; shape.len()];
        let amplitudes = transform.sizes().iter().product();
        Ok(Self {
            shape,
            step: step as f32,
            least_motion,
            most_motion: most_motion as f64,
            agreement,
            correlation: PhaseCorrelation::new(&transform, cutoff, most_motion),
            transform,
            before: empty(),
            spectrum: Spectrum { re: vec![0.0; amplitudes], im: vec![0.0; amplitudes] },
            frames: 0,
            scratch: Scratch {
                corrected: empty(),
                along: empty(),
                coefficients: empty(),
                errors: [empty(), empty()],
            },
        })
    }

    /// Changes the coefficients by both frames of a pair, the later one shifted by `shift`.
    fn learn(
        &mut self,
        frame: &Frame<'_>,
        shift: [f64; 2],
        coefficients: &mut Coefficients,
        workers: &Workers,
    ) {
        let (shape, cols, step) = (self.shape, self.shape.cols, self.step);
        let Scratch { corrected, along, coefficients: spline, errors } = &mut self.scratch;
        let before = &self.before[..];
        coefficients.apply(before, corrected, workers);
        let ways = [Move::new(shape, shift), Move::new(shape, shift.map(|shift| -shift))];
        let (first, second) = (&corrected[..], frame.corrected);
        let images = [(first, second), (second, first)];
        let mut means = [0.0; 2];
        for (i, (there, own)) in images.into_iter().enumerate() {
            prefilter(shape, there, along, spline, workers);
            means[i] = difference(shape, spline, own, &ways[i], &mut errors[i], workers);
        }
        let raws = [frame.raw, before];
        let bands = bands!(BAND * cols; &mut coefficients.gain, &mut coefficients.offset);
        workers.each(bands, |index, (gain, offset)| {
            let rows = gain.chunks_mut(cols).zip(offset.chunks_mut(cols));
            for (row, (gain, offset)) in rows.enumerate() {
                let row = index * BAND + row;
                for i in (0..2).filter(|i| ways[*i].inside[0].contains(&row)) {
                    let columns = ways[i].inside[1].clone();
                    let [raw, error] =
                        [raws[i], &errors[i]].map(|image| &image[row * cols..][columns.clone()]);
                    let own = gain[columns.clone()].iter_mut().zip(&mut offset[columns.clone()]);
                    for ((gain, offset), (y, error)) in own.zip(raw.iter().zip(error)) {
                        let change = step_at(step, *y) * (error - means[i]);
                        *gain += change * y;
                        *offset += change;
                    }
                }
            }
        });
        coefficients.hold_gauge(workers);
    }
}

impl Method for Registered {
    fn update(
        &mut self,
        frame: &Frame<'_>,
        coefficients: &mut Coefficients,
        workers: &Workers,
    ) -> bool {
        let spectrum = self.transform.of(frame.corrected, frame.mean as f32, workers);
        let (mut used, mut replace) = (false, self.frames == 0);
        if !replace {
            let shift = self.correlation.shift(&self.spectrum, &spectrum, workers);
            let [row, col] = shift.pixels;
            let far = row.abs().max(col.abs()) > self.most_motion;
            replace = far || shift.agreement < self.agreement;
            used = !replace && row.hypot(col) >= self.least_motion;
            if used {
                self.learn(frame, shift.pixels, coefficients, workers);
            }
        }
        if used || replace {
            self.before.copy_from_slice(frame.raw);
            self.spectrum = spectrum;
            self.frames += 1;
        }
        used
    }

    fn state(&mut self) -> State<'_> {
        let sizes = [self.shape.rows, self.shape.cols];
        let amplitudes = self.transform.sizes();
        State::default()
            .map("before", sizes, &mut self.before)
            .map("spectrum_real", amplitudes, &mut self.spectrum.re)
            .map("spectrum_imaginary", amplitudes, &mut self.spectrum.im)
            .count("frames_before", &mut self.frames)
    }
}

//! Towards a local mean, but only where that mean has changed.
//!
//! R. C. Hardie, F. Baxley, B. Brys, P. Hytla, "Scene-based nonuniformity correction with reduced
//! ghosting using a gated LMS algorithm", Optics Express 17 (2009) 14918–14933.

use super::bands::{BAND, bands, fold};
use super::coefficients::Coefficients;
use super::descent::{Descent, Pull};
use super::method::{Frame, Method};
use super::neighbourhood::Squares;
use super::options::{check_range, check_width};
use super::stability::{check_step, kernel_bound};
use super::state::State;
use crate::error::Result;
use crate::frames::Shape;
use crate::parallel::Workers;

/// Noise in the errors at which the step is halved. The detail of a scene counts as noise; it is half of this in
/// the standard scene.
const HALF: f64 = 0.05;

/// The errors are E = T − X with the mean T of a square, where T less the mean of the frame has changed by more
/// than a threshold since the pixel's last step. They count less where the variance within the square is
/// large.
#[derive(Debug)]
pub(super) struct Gated {
    shape: Shape,
    descent: Descent,
    width: usize,
    threshold: f32,
    texture: f32,
    /// T less the mean of the frame, at the last step of each pixel.
    seen: Vec<f32>,
    frames: u64,
    errors: Vec<f32>,
    part: Vec<f32>,
}

impl Gated {
    pub(super) fn new(
        shape: Shape,
        [step, threshold, texture]: [f64; 3],
        width: usize,
    ) -> Result<Self> {
        check_width(shape, width)?;
        check_range("threshold", threshold, [0.0, 1.0])?;
        check_range("texture", texture, [0.0, f64::INFINITY])?;
        let even = vec![1.0 / (width * width) as f64; width * width];
        check_step(step, kernel_bound(&even, [width; 2])?, "the mean of this width")?;
        Ok(Self {
            shape,
            descent: Descent::new(shape, step, HALF, 0.0),
            width,
            threshold: threshold as f32,
            texture: texture as f32,
            seen: vec![0.0; shape.len()],
            frames: 0,
            errors: vec![0.0; shape.len()],
            part: vec![0.0; shape.len()],
        })
    }
}

impl Method for Gated {
    fn update(
        &mut self,
        frame: &Frame<'_>,
        coefficients: &mut Coefficients,
        workers: &Workers,
    ) -> bool {
        let (shape, cols, width) = (frame.shape, frame.shape.cols, self.width);
        let (threshold, texture) = (self.threshold, self.texture);
        let (first, centre) = (self.frames == 0, frame.mean as f32);
        let centred = |row: usize, line: &mut [f32]| {
            for (value, corrected) in line.iter_mut().zip(frame.row(row).1) {
                *value = corrected - centre;
            }
        };
        let squared = |row: usize, line: &mut [f32]| {
            for (value, corrected) in line.iter_mut().zip(frame.row(row).1) {
                *value = (corrected - centre) * (corrected - centre);
            }
        };
        let bands = bands!(BAND * cols; &mut self.errors, &mut self.part, &mut self.seen);
        let counts = workers.each(bands, |index, (errors, parts, seen)| {
            let mut count = 0_u32;
            let mut means = Squares::new(shape, width, index * BAND, centred);
            let mut squares = Squares::new(shape, width, index * BAND, squared);
            let (mut mean, mut square) = (vec![0.0; cols], vec![0.0; cols]);
            let rows = errors.chunks_mut(cols).zip(parts.chunks_mut(cols));
            for (row, ((errors, parts), seen)) in rows.zip(seen.chunks_mut(cols)).enumerate() {
                means.next(&mut mean);
                squares.next(&mut square);
                if first {
                    seen.copy_from_slice(&mean);
                    continue;
                }
                let (_, corrected) = frame.row(index * BAND + row);
                for col in 0..cols {
                    let scene = mean[col];
                    let variance = (square[col] - scene * scene).max(0.0);
                    let changed = (scene - seen[col]).abs() > threshold
                        && !frame.leaves_out(index * BAND + row, col);
                    count += u32::from(changed);
                    seen[col] = if changed { scene } else { seen[col] };
                    parts[col] = if changed { 1.0 / (1.0 + texture * variance) } else { 0.0 };
                    errors[col] = parts[col] * (scene - (corrected[col] - centre));
                }
            }
            [f64::from(count)]
        });
        self.frames += 1;
        let [changed] = fold(counts);
        self.descent.follow(frame.level);
        if changed > 0.0 {
            let part = |row: usize, line: &mut [f32]| {
                line.copy_from_slice(&self.part[row * cols..(row + 1) * cols]);
            };
            let pull = Pull { raw: frame.raw, errors: &self.errors, sign: 1.0, part: &part };
            self.descent.learn(&[pull], coefficients, workers);
        }
        changed > 0.0
    }

    fn width(&self) -> usize {
        self.width
    }

    fn state(&mut self) -> State<'_> {
        let sizes = [self.shape.rows, self.shape.cols];
        State::default()
            .map("seen", sizes, &mut self.seen)
            .count("seen_frames", &mut self.frames)
            .and(self.descent.state())
    }
}

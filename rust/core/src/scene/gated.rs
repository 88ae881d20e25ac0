//! Towards a local mean, but only where that mean has changed.
//!
//! R. C. Hardie, F. Baxley, B. Brys, P. Hytla, "Scene-based nonuniformity correction with reduced
//! ghosting using a gated LMS algorithm", Optics Express 17 (2009) 14918–14933.

use super::bands::{BAND, bands, fold};
use super::coefficients::Coefficients;
use super::method::{Frame, Method, step_at};
use super::neighbourhood::Squares;
use super::options::{check_range, check_width};
use super::stability::{check_step, kernel_bound};
use super::state::State;
use crate::error::Result;
use crate::frames::Shape;
use crate::parallel::Workers;

/// g ← g + η E y, o ← o + η E with E = T − X and the mean T of a square, where T less the mean of the
/// frame has changed by more than a threshold since the pixel's last step. η falls with the variance
/// within the square.
#[derive(Debug)]
pub(super) struct Gated {
    shape: Shape,
    step: f32,
    width: usize,
    threshold: f32,
    texture: f32,
    /// T less the mean of the frame, at the last step of each pixel.
    seen: Vec<f32>,
    frames: u64,
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
            step: step as f32,
            width,
            threshold: threshold as f32,
            texture: texture as f32,
            seen: vec![0.0; shape.len()],
            frames: 0,
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
        let (step, threshold, texture) = (self.step, self.threshold, self.texture);
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
        let bands = bands!(
            BAND * cols; &mut coefficients.gain, &mut coefficients.offset, &mut self.seen
        );
        let counts = workers.each(bands, |index, (gain, offset, seen)| {
            let mut count = 0_u32;
            let mut means = Squares::new(shape, width, index * BAND, centred);
            let mut squares = Squares::new(shape, width, index * BAND, squared);
            let (mut mean, mut square) = (vec![0.0; cols], vec![0.0; cols]);
            let rows = gain.chunks_mut(cols).zip(offset.chunks_mut(cols));
            for (row, ((gain, offset), seen)) in rows.zip(seen.chunks_mut(cols)).enumerate() {
                means.next(&mut mean);
                squares.next(&mut square);
                if first {
                    seen.copy_from_slice(&mean);
                    continue;
                }
                let (raw, corrected) = frame.row(index * BAND + row);
                for col in 0..cols {
                    if frame.leaves_out(index * BAND + row, col) {
                        continue;
                    }
                    let (y, scene) = (raw[col], mean[col]);
                    let variance = (square[col] - scene * scene).max(0.0);
                    let changed = (scene - seen[col]).abs() > threshold;
                    let share = if changed { 1.0 / (1.0 + texture * variance) } else { 0.0 };
                    let change = step_at(step, y) * share * (scene - (corrected[col] - centre));
                    count += u32::from(changed);
                    seen[col] = if changed { scene } else { seen[col] };
                    gain[col] += change * y;
                    offset[col] += change;
                }
            }
            [f64::from(count)]
        });
        self.frames += 1;
        let [changed] = fold(counts);
        if changed > 0.0 {
            coefficients.hold_gauge(workers);
        }
        changed > 0.0
    }

    fn width(&self) -> usize {
        self.width
    }

    fn state(&mut self) -> State<'_> {
        let sizes = [self.shape.rows, self.shape.cols];
        State::default().map("seen", sizes, &mut self.seen).count("seen_frames", &mut self.frames)
    }
}

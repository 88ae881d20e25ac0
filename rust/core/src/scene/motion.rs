//! Whether the scene has moved since the frame that was used last.

use super::state::State;
use crate::frames::Shape;
use crate::parallel::Workers;

/// Rows and columns of a block.
pub(super) const BLOCK: usize = 8;

/// Standard errors by which the change exceeds that of noise alone.
const SURE: f64 = 4.0;

/// Frames over which the noise is averaged.
const REMEMBERED: f64 = 32.0;

/// Compares frames by the means of blocks of 8×8 pixels, less their own mean: a change of the level alone is no
/// motion, and the patterns of the pixels cancel in the difference. Within blocks the difference shows the noise,
/// which moves their means by an eighth of it.
#[derive(Debug)]
pub(super) struct Motion {
    /// Rms change above which the scene has moved, on the scale [0, 1].
    threshold: f64,
    shape: Shape,
    /// The frame that was used last.
    last: Vec<f32>,
    /// Variance of the noise of a pixel, with that of the detail that the scene changes by.
    pub(super) noise: f32,
    /// Frames that moved, the first one included.
    pub(super) frames: u64,
}

impl Motion {
    pub(super) fn new(shape: Shape, threshold: f64) -> Self {
        Self { threshold, shape, last: vec![0.0; shape.len()], noise: 0.0, frames: 0 }
    }

    /// Whether the scene has moved; then the frame is the next to compare with.
    pub(super) fn moved(&mut self, raw: &[f32], workers: &Workers) -> bool {
        if self.frames > 0 && !self.differs(raw, workers) {
            return false;
        }
        self.last.copy_from_slice(raw);
        self.frames += 1;
        true
    }

    fn differs(&mut self, raw: &[f32], workers: &Workers) -> bool {
        let lines = workers.map(blocks_of(self.shape)[0], |line| self.changes(raw, line));
        let changes: Vec<_> = lines.into_iter().flatten().collect();
        let count = changes.len() as f64;
        let [sum, squares, noise] = changes.iter().fold([0.0; 3], |[sum, squares, noise], each| {
            [sum + each[0], squares + each[0] * each[0], noise + each[1]]
        });
        let square = squares / count - (sum / count).powi(2);
        let noise = noise / count;
        let share = 1.0 / (self.frames as f64).min(REMEMBERED);
        let variance = 0.5 * (BLOCK * BLOCK) as f64 * noise;
        self.noise += (share * (variance - f64::from(self.noise))) as f32;
        let sure = 1.0 + SURE * (2.0 / count).sqrt();
        square > self.threshold * self.threshold + noise * sure
    }

    /// Mean of the change in each block of a line, and its variance by noise.
    fn changes(&self, raw: &[f32], line: usize) -> Vec<[f64; 2]> {
        let cols = self.shape.cols;
        let mut sums = vec![[0.0_f32; 2]; cols / BLOCK];
        for row in line * BLOCK..(line + 1) * BLOCK {
            let (now, _) = raw[row * cols..(row + 1) * cols].as_chunks::<BLOCK>();
            let (last, _) = self.last[row * cols..(row + 1) * cols].as_chunks::<BLOCK>();
            for (sums, (now, last)) in sums.iter_mut().zip(now.iter().zip(last)) {
                for (now, last) in now.iter().zip(last) {
                    let change = now - last;
                    *sums = [sums[0] + change, sums[1] + change * change];
                }
            }
        }
        let pixels = (BLOCK * BLOCK) as f64;
        let moments = |[sum, squares]: [f32; 2]| {
            let mean = f64::from(sum) / pixels;
            let within = (f64::from(squares) - pixels * mean * mean).max(0.0);
            [mean, within / (pixels - 1.0) / pixels]
        };
        sums.into_iter().map(moments).collect()
    }

    pub(super) fn state(&mut self) -> State<'_> {
        let sizes = [self.shape.rows, self.shape.cols];
        State::default()
            .map("last", sizes, &mut self.last)
            .squares("motion_noise", [1, 1], std::slice::from_mut(&mut self.noise))
            .count("moved", &mut self.frames)
    }
}

/// Rows and columns of blocks.
pub(super) fn blocks_of(shape: Shape) -> [usize; 2] {
    [shape.rows / BLOCK, shape.cols / BLOCK]
}

/// Means of all blocks.
pub(super) fn blocks(shape: Shape, raw: &[f32], workers: &Workers) -> Vec<f32> {
    let lines = workers.map(blocks_of(shape)[0], |line| block_means(shape, raw, line));
    lines.into_iter().flatten().collect()
}

/// Means of the blocks of a line of blocks.
fn block_means(shape: Shape, raw: &[f32], line: usize) -> Vec<f32> {
    let mut sums = vec![0.0_f32; shape.cols / BLOCK];
    for row in line * BLOCK..(line + 1) * BLOCK {
        let (blocks, _) = raw[row * shape.cols..(row + 1) * shape.cols].as_chunks::<BLOCK>();
        for (sum, block) in sums.iter_mut().zip(blocks) {
            *sum += block.iter().sum::<f32>();
        }
    }
    sums.into_iter().map(|sum| sum / (BLOCK * BLOCK) as f32).collect()
}

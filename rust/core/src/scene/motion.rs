//! Whether the scene has moved since the frame that was used last.

use super::coefficients::sum;
use super::state::State;
use crate::frames::Shape;
use crate::parallel::Workers;

/// Rows and columns of a block.
pub(super) const BLOCK: usize = 8;

/// Compares frames by the means of blocks of 8×8 pixels, less their own mean: a change of the level
/// alone is no motion, and the patterns of the pixels cancel in the difference.
#[derive(Debug)]
pub(super) struct Motion {
    /// Rms change above which the scene has moved, on the scale [0, 1].
    threshold: f64,
    sizes: [usize; 2],
    blocks: Vec<f32>,
    /// Frames that moved, the first one included.
    pub(super) frames: u64,
}

impl Motion {
    pub(super) fn new(shape: Shape, threshold: f64) -> Self {
        let sizes = [shape.rows / BLOCK, shape.cols / BLOCK];
        Self { threshold, sizes, blocks: vec![0.0; sizes[0] * sizes[1]], frames: 0 }
    }

    /// Whether the scene has moved; then the frame is the next to compare with.
    pub(super) fn moved(&mut self, shape: Shape, raw: &[f32], workers: &Workers) -> bool {
        let lines = workers.map(self.sizes[0], |line| block_means(shape, raw, line));
        let blocks: Vec<f32> = lines.into_iter().flatten().collect();
        if self.frames > 0 {
            let changes: Vec<f32> = blocks.iter().zip(&self.blocks).map(|(a, b)| a - b).collect();
            let count = changes.len() as f64;
            let mean = sum(&changes) / count;
            let squares: f64 =
                changes.iter().map(|change| (f64::from(*change) - mean).powi(2)).sum();
            if (squares / count).sqrt() <= self.threshold {
                return false;
            }
        }
        self.blocks = blocks;
        self.frames += 1;
        true
    }

    pub(super) fn state(&mut self) -> State<'_> {
        State::default()
            .map("blocks", self.sizes, &mut self.blocks)
            .count("moved", &mut self.frames)
    }
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

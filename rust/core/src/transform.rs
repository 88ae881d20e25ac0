//! Cosine transforms of images: the only module that names a transform crate.

use rustdct::{DctPlanner, TransformType2And3};
use std::sync::Arc;

use crate::control::Control;
use crate::error::Result;
use crate::frames::Shape;
use crate::parallel::Workers;

/// Cosine transforms of images of one shape, whose modes have even mirror images at the borders:
/// mode (i, j) is cos(πi(r+½)/R)·cos(πj(c+½)/C).
pub(crate) struct CosineTransform {
    shape: Shape,
    along_rows: Arc<dyn TransformType2And3<f64>>,
    along_cols: Arc<dyn TransformType2And3<f64>>,
}

impl CosineTransform {
    pub(crate) fn new(shape: Shape) -> Self {
        let mut planner = DctPlanner::new();
        let along_rows = planner.plan_dct2(shape.cols);
        let along_cols = planner.plan_dct2(shape.rows);
        Self { shape, along_rows, along_cols }
    }

    /// Multiplies each mode (i, j) of `image` by `factor(i, j)`.
    ///
    /// Fails only if `control` asks to stop; `image` then holds nothing of use.
    pub(crate) fn filter(
        &self,
        image: &mut Vec<f64>,
        factor: impl Fn(usize, usize) -> f64 + Sync,
        workers: &Workers,
        control: &Control,
    ) -> Result<()> {
        let Shape { rows, cols } = self.shape;
        let each_line = |image: &mut [f64], transform: &dyn TransformType2And3<f64>, direction| {
            each_line(image, transform, direction, workers, control)
        };
        each_line(image, &*self.along_rows, Direction::Forward)?;
        let mut modes = transposed(image, self.shape, workers, control);
        each_line(&mut modes, &*self.along_cols, Direction::Forward)?;
        // Forward and back multiply by a quarter of the number of pixels.
        let scale = 4.0 / (rows * cols) as f64;
        workers.map_blocks(&mut modes, rows, |j, line| {
            if control.is_cancelled() {
                return;
            }
            for (i, mode) in line.iter_mut().enumerate() {
                *mode *= scale * factor(i, j);
            }
        });
        each_line(&mut modes, &*self.along_cols, Direction::Back)?;
        *image = transposed(&modes, self.shape.transposed(), workers, control);
        each_line(image, &*self.along_rows, Direction::Back)
    }
}

#[derive(Clone, Copy)]
enum Direction {
    Forward,
    Back,
}

fn each_line(
    image: &mut [f64],
    transform: &dyn TransformType2And3<f64>,
    direction: Direction,
    workers: &Workers,
    control: &Control,
) -> Result<()> {
    const LINES: usize = 16;
    let length = transform.len();
    workers.map_blocks(image, LINES * length, |_, lines| {
        let mut scratch = vec![0.0; transform.get_scratch_len()];
        for line in lines.chunks_exact_mut(length) {
            if control.is_cancelled() {
                return;
            }
            match direction {
                Direction::Forward => transform.process_dct2_with_scratch(line, &mut scratch),
                Direction::Back => transform.process_dct3_with_scratch(line, &mut scratch),
            }
        }
    });
    control.check()
}

/// The transposed image, in square tiles so that both sides stay in cache; nothing of use if
/// `control` asks to stop.
fn transposed(image: &[f64], shape: Shape, workers: &Workers, control: &Control) -> Vec<f64> {
    const TILE: usize = 32;
    let mut result = vec![0.0; image.len()];
    workers.map_blocks(&mut result, TILE * shape.rows, |block, lines| {
        if control.is_cancelled() {
            return;
        }
        let first = block * TILE;
        for top in (0..shape.rows).step_by(TILE) {
            for (col, line) in lines.chunks_exact_mut(shape.rows).enumerate() {
                for row in top..(top + TILE).min(shape.rows) {
                    line[row] = image[row * shape.cols + first + col];
                }
            }
        }
    });
    result
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn a_filter_multiplies_each_cosine_by_its_factor() {
        let workers = Workers::new(None).unwrap();
        for shape in [Shape::new(1, 1), Shape::new(5, 1), Shape::new(37, 50), Shape::new(6, 33)] {
            let (i, j) = (shape.rows / 2, shape.cols / 3);
            let mode: Vec<f64> = (0..shape.len())
                .map(|p| {
                    let (r, c) = ((p / shape.cols) as f64 + 0.5, (p % shape.cols) as f64 + 0.5);
                    (PI * i as f64 * r / shape.rows as f64).cos()
                        * (PI * j as f64 * c / shape.cols as f64).cos()
                })
                .collect();
            let mut image = mode.clone();
            let factor = |a: usize, b: usize| 1.0 + a as f64 + 100.0 * b as f64;
            let transform = CosineTransform::new(shape);
            transform.filter(&mut image, factor, &workers, &Control::new()).unwrap();
            let wanted = factor(i, j);
            for (got, mode) in image.iter().zip(&mode) {
                assert!((got - wanted * mode).abs() < 1e-12 * wanted, "{shape}");
            }
        }
    }
}

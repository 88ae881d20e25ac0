//! Towards the mean of the neighbours, in every frame.

use super::bands::BAND;
use super::coefficients::Coefficients;
use super::descent::{Descent, Pull};
use super::method::{Frame, Method};
use super::neighbourhood::{Image, Kernel};
use super::stability::{check_step, kernel_bound};
use super::state::State;
use crate::error::{Error, Result};
use crate::frames::Shape;
use crate::parallel::Workers;

/// The errors are E = T − X with the mean T of the neighbours.
#[derive(Debug)]
pub(super) struct LocalMean {
    kernel: Kernel,
    descent: Descent,
    errors: Vec<f32>,
}

/// Noise in the errors at which the step is halved. The detail of a scene counts as noise; it is a third of this
/// in the standard scene.
const HALF: f64 = 0.1;

impl LocalMean {
    pub(super) fn new(shape: Shape, step: f64, kernel: &[f64], sizes: [usize; 2]) -> Result<Self> {
        let weights = normalised(shape, kernel, sizes)?;
        check_step(step, kernel_bound(&weights, sizes)?, "this kernel")?;
        Ok(Self {
            kernel: Kernel::new(sizes, &weights),
            descent: Descent::new(shape, step, HALF, 0.0),
            errors: vec![0.0; shape.len()],
        })
    }
}

/// The kernel with the sum 1.
fn normalised(shape: Shape, kernel: &[f64], [rows, cols]: [usize; 2]) -> Result<Vec<f64>> {
    let odd = rows % 2 == 1 && cols % 2 == 1 && kernel.len() == rows * cols;
    if !odd || rows > shape.rows || cols > shape.cols {
        return Err(Error::Shape {
            argument: "kernel",
            got: format!("({rows}, {cols})"),
            wanted: format!("odd numbers of rows and columns, at most those of {shape}"),
        });
    }
    let sum: f64 = kernel.iter().sum();
    if !(sum.is_finite() && sum > 0.0) {
        return Err(Error::value("kernel", format!("has the sum {sum}, expected one above 0")));
    }
    Ok(kernel.iter().map(|weight| weight / sum).collect())
}

impl Method for LocalMean {
    fn update(
        &mut self,
        frame: &Frame<'_>,
        coefficients: &mut Coefficients,
        workers: &Workers,
    ) -> bool {
        let cols = frame.shape.cols;
        let image = Image::new(frame.shape, frame.corrected);
        let part = |row: usize, line: &mut [f32]| {
            for (col, part) in line.iter_mut().enumerate() {
                *part = if frame.leaves_out(row, col) { 0.0 } else { 1.0 };
            }
        };
        workers.map_blocks(&mut self.errors, BAND * cols, |index, errors| {
            let (mut padded, mut taken) = (Vec::new(), vec![0.0; cols]);
            for (row, errors) in errors.chunks_mut(cols).enumerate() {
                let row = index * BAND + row;
                self.kernel.mean(image, row, &mut padded, errors);
                part(row, &mut taken);
                for ((error, part), value) in errors.iter_mut().zip(&taken).zip(frame.row(row).1) {
                    *error = part * (*error - value);
                }
            }
        });
        let pull = Pull { raw: frame.raw, errors: &self.errors, sign: 1.0, part: &part };
        self.descent.follow(frame.level);
        self.descent.learn(&[pull], coefficients, workers);
        true
    }

    fn width(&self) -> usize {
        self.kernel.width()
    }

    fn state(&mut self) -> State<'_> {
        self.descent.state()
    }
}

//! Towards the mean of the neighbours, in every frame.

use super::bands::{BAND, bands};
use super::coefficients::Coefficients;
use super::method::{Frame, Method, step_at};
use super::neighbourhood::{Image, Kernel};
use super::stability::{check_step, kernel_bound};
use super::state::State;
use crate::error::{Error, Result};
use crate::frames::Shape;
use crate::parallel::Workers;

/// g ← g + η E y, o ← o + η E with E = T − X and the mean T of the neighbours.
#[derive(Debug)]
pub(super) struct LocalMean {
    step: f32,
    kernel: Kernel,
}

impl LocalMean {
    pub(super) fn new(shape: Shape, step: f64, kernel: &[f64], sizes: [usize; 2]) -> Result<Self> {
        let weights = normalised(shape, kernel, sizes)?;
        check_step(step, kernel_bound(&weights, sizes)?, "this kernel")?;
        Ok(Self { step: step as f32, kernel: Kernel::new(sizes, &weights) })
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
        let bands = bands!(BAND * cols; &mut coefficients.gain, &mut coefficients.offset);
        workers.each(bands, |index, (gain, offset)| {
            let (mut padded, mut target) = (Vec::new(), vec![0.0; cols]);
            let rows = gain.chunks_mut(cols).zip(offset.chunks_mut(cols));
            for (row, (gain, offset)) in rows.enumerate() {
                let row = index * BAND + row;
                self.kernel.mean(image, row, &mut padded, &mut target);
                let (raw, corrected) = frame.row(row);
                for col in 0..cols {
                    if frame.leaves_out(row, col) {
                        continue;
                    }
                    let y = raw[col];
                    let change = step_at(self.step, y) * (target[col] - corrected[col]);
                    gain[col] += change * y;
                    offset[col] += change;
                }
            }
        });
        coefficients.hold_gauge(workers);
        true
    }

    fn width(&self) -> usize {
        self.kernel.width()
    }

    fn state(&mut self) -> State<'_> {
        State::default()
    }
}

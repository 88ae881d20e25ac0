//! The mean of the frames that hold a spot, and errors about it.

use crate::control::Control;
use crate::error::{Error, Result, SpotProblem};
use crate::frames::{Sample, Shape, Stack};

/// Values stay below this, so that no sum of squares overflows.
const LARGEST: f64 = 1e100;

/// Background and noise are taken from this many blocks along each axis: an image has no fewer pixels.
pub(super) const BLOCKS: usize = 16;

/// An image, with the name that errors give it.
#[derive(Debug)]
pub(super) struct Image {
    pub(super) argument: &'static str,
    pub(super) values: Vec<f64>,
    pub(super) shape: Shape,
}

impl Image {
    /// The mean of frames whose values are all below [`LARGEST`] in size.
    pub(super) fn mean<T: Sample>(
        argument: &'static str,
        frames: Stack<'_, T>,
        control: &Control,
    ) -> Result<Self> {
        let shape = frames.shape();
        if frames.count() == 0 || shape.rows.min(shape.cols) < BLOCKS {
            return Err(Error::Shape {
                argument,
                got: format!("({}, {}, {})", frames.count(), shape.rows, shape.cols),
                wanted: format!("at least one frame of {BLOCKS} rows and columns"),
            });
        }
        let mut values = vec![0.0; shape.len()];
        for index in 0..frames.count() {
            for (row, sums) in values.chunks_mut(shape.cols).enumerate() {
                control.check()?;
                for (col, (sum, value)) in sums.iter_mut().zip(frames.row(index, row)).enumerate() {
                    let value = value.to_f64();
                    if value.is_nan() || value.abs() >= LARGEST {
                        let place = format!("is {value} at frame {index}, row {row}, column {col}");
                        let wanted = format!(": numbers below {LARGEST:e} in size are wanted");
                        return Err(Error::value(argument, place + &wanted));
                    }
                    *sum += value;
                }
            }
        }
        values.iter_mut().for_each(|sum| *sum /= frames.count() as f64);
        Ok(Self { argument, values, shape })
    }

    pub(super) fn missing(&self, level: f64, wanted: f64) -> Error {
        self.problem(SpotProblem::Missing { level, wanted })
    }

    pub(super) fn problem(&self, problem: SpotProblem) -> Error {
        Error::Spot { argument: self.argument, problem }
    }
}

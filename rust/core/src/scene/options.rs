//! The numbers that each method takes, and their ranges.

use super::motion::BLOCK;
use crate::error::{Error, Result};
use crate::frames::Shape;

/// A method and its numbers; steps and thresholds are on the scale [0, 1] of the raw values.
#[derive(Clone, Debug)]
pub enum Options {
    /// Towards the mean of the neighbours, in every frame.
    LocalMean {
        /// Step η.
        step: f64,
        /// Weights of the neighbours, row by row.
        kernel: Vec<f64>,
        /// Rows and columns of the kernel.
        sizes: [usize; 2],
    },
    /// Towards the mean of a square, where it has changed.
    Gated {
        /// Step η.
        step: f64,
        /// Rows and columns of the square.
        width: usize,
        /// Change of the mean above which a pixel is updated.
        threshold: f64,
        /// k of the step η / (1 + k · variance within the square).
        texture: f64,
    },
    /// Towards the other frame of a pair, moved by the shift between them.
    Registered {
        /// Step η.
        step: f64,
        /// Shift in pixels below which the earlier frame of the pair is kept.
        least_motion: f64,
        /// Largest shift along an axis in pixels; above it the pair is not used.
        most_motion: usize,
        /// Highest spatial frequency of the phase correlation, in cycles per pixel.
        cutoff: f64,
        /// Mean cosine of the phases left by the shift, below which the pair is not used.
        agreement: f64,
    },
    /// Mean and deviation over time made equal to those of the neighbourhood.
    ConstantStatistics {
        /// Rows and columns of the neighbourhood.
        width: usize,
        /// Frames that the statistics remember.
        window: u64,
        /// Rms change of block means above which the scene has moved.
        motion: f64,
        /// Frames after which a gain counts half.
        prior: u64,
    },
    /// Recursive estimate of gain and offset, with their variances.
    Kalman {
        /// Rows and columns of the neighbourhood.
        width: usize,
        /// Moving frames of a block.
        block: u64,
        /// Rms change of block means above which the scene has moved.
        motion: f64,
        /// Standard deviation of the gains.
        gain_spread: f64,
        /// Standard deviation of the offsets.
        offset_spread: f64,
        /// Moving frames after which gains and offsets have drifted by their spread · √(1 − e⁻²).
        memory: f64,
    },
}

/// Fewest rows and columns.
const LEAST: usize = 2 * BLOCK;

/// Refuses a sensor that is too small for blocks of pixels.
pub(super) fn check_shape(shape: Shape) -> Result<()> {
    if shape.rows.min(shape.cols) >= LEAST {
        return Ok(());
    }
    Err(Error::Shape {
        argument: "shape",
        got: shape.to_string(),
        wanted: format!("{LEAST} or more rows and columns"),
    })
}

/// Refuses a width that is even, or beyond the sensor.
pub(super) fn check_width(shape: Shape, width: usize) -> Result<()> {
    let most = shape.rows.min(shape.cols);
    if width % 2 == 1 && (3..=most).contains(&width) {
        return Ok(());
    }
    Err(Error::value(
        "width",
        format!("is {width}, expected an odd number from 3 to the shorter side, {most}"),
    ))
}

/// Refuses a number outside of a range, its ends included.
pub(super) fn check_range(argument: &'static str, value: f64, [low, high]: [f64; 2]) -> Result<()> {
    if (low..=high).contains(&value) && value.is_finite() {
        return Ok(());
    }
    let upper = if high.is_finite() { format!(" to {high}") } else { " or more".to_owned() };
    Err(Error::value(argument, format!("is {value}, expected {low}{upper}")))
}

//! What all methods have in common.

use super::coefficients::Coefficients;
use super::fill::Fill;
use super::state::State;
use crate::error::Result;
use crate::frames::Shape;
use crate::parallel::Workers;

/// A frame on the scale [0, 1], raw and corrected by the coefficients before it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Frame<'a> {
    pub(super) shape: Shape,
    pub(super) raw: &'a [f32],
    pub(super) corrected: &'a [f32],
    /// Means of the corrected and of the raw values.
    pub(super) mean: f64,
    pub(super) level: f64,
    /// Raw value from which a pixel is saturated.
    pub(super) saturation: f32,
    /// Pixels that do not learn: saturated ones, and ones with too many of them in the neighbourhood.
    pub(super) left_out: Option<&'a [bool]>,
    /// Masked pixels, which hold the mean of their neighbours.
    pub(super) fill: &'a Fill,
}

impl<'a> Frame<'a> {
    /// Whether a pixel does not learn.
    #[inline(always)]
    pub(super) fn leaves_out(&self, row: usize, col: usize) -> bool {
        self.left_out.is_some_and(|out| out[row * self.shape.cols + col])
    }

    pub(super) fn row(&self, row: usize) -> (&'a [f32], &'a [f32]) {
        let range = row * self.shape.cols..(row + 1) * self.shape.cols;
        (&self.raw[range.clone()], &self.corrected[range])
    }
}

/// A rule that changes the coefficients by a frame.
pub(super) trait Method: std::fmt::Debug + Send + Sync {
    /// Takes a frame; whether it counted.
    fn update(
        &mut self,
        frame: &Frame<'_>,
        coefficients: &mut Coefficients,
        workers: &Workers,
    ) -> bool;

    /// Rows and columns of the neighbourhood of a pixel, odd.
    fn width(&self) -> usize;

    /// Whether saturated pixels do not learn, or only pixels with too many of them in the neighbourhood.
    fn leaves_out_saturated(&self) -> bool {
        true
    }

    /// All that is remembered beside the coefficients.
    fn state(&mut self) -> State<'_>;

    /// Whether it compares frames by itself, so that a foreign one changes nothing.
    fn compares_frames(&self) -> bool {
        false
    }

    /// Upper limit of the variance of the pattern that is left, over that of its change since a copy after `early` of
    /// now `frames`. Of errors that do not remember each other it is a half. Those of low spatial frequencies do: in
    /// simulations it is 0.4 to 0.8.
    fn forgets(&self, _early: u64, _frames: u64) -> f64 {
        0.8
    }

    /// Upper limit of the variance of the pattern that is left at a level, of a method that has variances.
    fn leaves(&self, _level: f64) -> Option<f64> {
        None
    }

    /// Refuses a state that no frames lead to.
    fn check(&self) -> Result<()> {
        Ok(())
    }

    /// Variances of gain and offset, where the method has them.
    fn variances(&self) -> Option<[Vec<f32>; 2]> {
        None
    }
}

/// The step of a pixel: shorter where the raw value is more than 1 from the centre, so that step · (depth² + 1) never
/// exceeds the value that the stability bound assumes.
#[inline(always)]
pub(super) fn step_at(step: f32, depth: f32) -> f32 {
    step / (0.5 * (1.0 + depth * depth)).max(1.0)
}

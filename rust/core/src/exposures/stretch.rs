//! Stretches of one row of one exposure, as the kernels take them.

use std::ops::Range;

use super::measurements::{Measurements, Variance};
use crate::frames::Real;

/// A stretch of one row of one exposure, as the kernels take it.
pub(crate) enum Stretch<'a, T> {
    /// All measurements are used, with one weight.
    Uniform(&'a [T], f64),
    /// The weights stand in the scratch space; where one is 0, the value counts for nothing.
    Weighted(&'a [T], &'a [f64]),
}

/// Fills in the weights of a stretch, in a form that the compiler inlines into code for the CPU at
/// hand.
struct Weigh<'s, T> {
    values: &'s [T],
    variance: Option<&'s [T]>,
    mask: Option<&'s [bool]>,
    same: f64,
    weights: &'s mut [f64],
}

impl<T: Real> pulp::NullaryFnOnce for Weigh<'_, T> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let weights = self.weights;
        if let Some(variance) = self.variance {
            for (weight, variance) in weights.iter_mut().zip(variance) {
                *weight = 1.0 / variance.to_f64();
            }
        } else {
            weights.fill(self.same);
        }
        for (weight, value) in weights.iter_mut().zip(self.values) {
            *weight = if value.to_f64().is_finite() { *weight } else { 0.0 };
        }
        if let Some(mask) = self.mask {
            for (weight, &masked) in weights.iter_mut().zip(mask) {
                *weight = if masked { 0.0 } else { *weight };
            }
        }
    }
}

/// The values of `exposure` in columns `cols` of `row` with their weights; `scratch` is a buffer for these.
pub(super) fn weigh<'a, 's, T: Real>(
    measurements: &Measurements<'a, T>,
    exposure: usize,
    row: usize,
    cols: Range<usize>,
    scratch: &'s mut [f64],
) -> (&'a [T], &'s [f64]) {
    let Measurements { frames, variance, mask } = measurements;
    let values = &frames.row(exposure, row)[cols.clone()];
    let weights = &mut scratch[..values.len()];
    let variance = match variance {
        Variance::Measurements(variance) => Some(&variance.row(exposure, row)[cols.clone()]),
        _ => None,
    };
    let mask = mask.row(exposure, row, frames.shape()).map(|mask| &mask[cols]);
    let same = measurements.exposure_weight(exposure);
    pulp::Arch::new().dispatch(Weigh { values, variance, mask, same, weights: &mut *weights });
    (values, weights)
}

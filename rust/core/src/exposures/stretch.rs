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
struct Weigh<'s, T, W, F> {
    values: &'s [T],
    variance: Option<&'s [T]>,
    mask: Option<&'s [bool]>,
    /// The variance where there is one for all.
    same: f64,
    weights: &'s mut [W],
    /// The weight of a variance.
    inverse: F,
}

impl<T: Real, W: Copy + Default, F: Fn(f64) -> W> pulp::NullaryFnOnce for Weigh<'_, T, W, F> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let (none, same) = (W::default(), (self.inverse)(self.same));
        let weights = self.weights.iter_mut().zip(self.values);
        let used = |value: &T, weight: W| if value.to_f64().is_finite() { weight } else { none };
        if let Some(variance) = self.variance {
            for ((weight, value), variance) in weights.zip(variance) {
                *weight = used(value, (self.inverse)(variance.to_f64()));
            }
        } else {
            weights.for_each(|(weight, value)| *weight = used(value, same));
        }
        if let Some(mask) = self.mask {
            for (weight, &masked) in self.weights.iter_mut().zip(mask) {
                *weight = if masked { none } else { *weight };
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
    let values = &measurements.frames.row(exposure, row)[cols.clone()];
    let weights = &mut scratch[..values.len()];
    fill(measurements, exposure, row, cols, weights, |variance| 1.0 / variance);
    (values, weights)
}

/// The weights times `factor`, at most `largest`, to single precision.
pub(super) fn weigh_roughly<T: Real>(
    measurements: &Measurements<'_, T>,
    exposure: usize,
    row: usize,
    cols: Range<usize>,
    [factor, largest]: [f64; 2],
    weights: &mut [f32],
) {
    let (per, largest) = (1.0 / factor, largest as f32);
    // A quotient in single precision takes a quarter of the time of one in double precision.
    let inverse = |variance| (1.0 / (variance * per) as f32).min(largest);
    fill(measurements, exposure, row, cols, weights, inverse);
}

fn fill<T: Real, W: Copy + Default>(
    measurements: &Measurements<'_, T>,
    exposure: usize,
    row: usize,
    cols: Range<usize>,
    weights: &mut [W],
    inverse: impl Fn(f64) -> W,
) {
    let Measurements { frames, variance, mask } = measurements;
    let values = &frames.row(exposure, row)[cols.clone()];
    let variance = match variance {
        Variance::Measurements(variance) => Some(&variance.row(exposure, row)[cols.clone()]),
        _ => None,
    };
    let same = measurements.exposure_variance(exposure);
    let mask = mask.row(exposure, row, frames.shape()).map(|mask| &mask[cols]);
    pulp::Arch::new().dispatch(Weigh { values, variance, mask, same, weights, inverse });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exposures::Mask;
    use crate::frames::{Shape, Stack};

    /// Every third value is none, every fifth is masked; variances go to both ends of what is allowed.
    fn row(width: usize) -> (Vec<f64>, Vec<f64>, Vec<bool>) {
        let values = (0..width).map(|i| if i % 3 == 1 { f64::NAN } else { i as f64 - 2.0 });
        let powers = (0..width).map(|i| [-100, 0, 3, -7, 100, -30, 12][i % 7]);
        let mask = (0..width).map(|i| i % 5 == 2).collect();
        (values.collect(), powers.map(|power| 1.7 * 10_f64.powi(power)).collect(), mask)
    }

    #[test]
    fn weights_are_inverse_variances_of_what_is_used() {
        for width in 1..=20 {
            let (values, variances, masked) = row(width);
            let frames = Stack::new("frames", &values, 1, Shape::new(1, width)).unwrap();
            let each = Stack::new("variance", &variances, 1, Shape::new(1, width)).unwrap();
            for variance in
                [Variance::Unknown, Variance::Exposures(&[4.0]), Variance::Measurements(each)]
            {
                for mask in [Mask::None, Mask::Pixels(&masked)] {
                    let measurements = Measurements { frames, variance, mask };
                    let (mut double, mut single) = (vec![9.0; width], vec![9.0_f32; width]);
                    let _ = weigh(&measurements, 0, 0, 0..width, &mut double);
                    weigh_roughly(&measurements, 0, 0, 0..width, [2.5, 1e12], &mut single);
                    for i in 0..width {
                        let used = values[i].is_finite()
                            && !(masked[i] && matches!(mask, Mask::Pixels(_)));
                        let variance = match variance {
                            Variance::Unknown => 1.0,
                            Variance::Exposures(_) => 4.0,
                            Variance::Measurements(_) => variances[i],
                        };
                        let wanted = if used { 1.0 / variance } else { 0.0 };
                        assert_eq!(double[i].to_bits(), f64::to_bits(wanted));
                        let wanted = (2.5 * wanted).min(1e12);
                        // The variance in these units and the quotient are rounded; below what single
                        // precision holds it is 0.
                        let rounding = 2.0 * f64::from(f32::EPSILON) * wanted + 1e-38;
                        assert!((f64::from(single[i]) - wanted).abs() <= rounding, "{width} {i}");
                    }
                }
            }
        }
    }
}

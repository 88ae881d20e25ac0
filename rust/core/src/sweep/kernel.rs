//! The arithmetic of a sweep: neighbouring values of L or M, side by side in vector registers.

use std::f64::consts::{FRAC_1_SQRT_2, LN_2, LOG2_E};
use std::marker::PhantomData;

use crate::exposures::Stretch;
use crate::frames::Real;

/// Most columns that the kernel takes at once: their weights stay in the first-level cache.
pub(super) const STRETCH: usize = 1024;
/// Neighbouring values that are solved side by side in vector registers.
const LANES: usize = 16;

/// One exposure's part in a stretch of a row: its values and the factor that is held fixed.
pub(super) struct Line<'s, T> {
    pub(super) measured: Stretch<'s, T>,
    pub(super) known: &'s [f64],
    pub(super) flux: f64,
}

/// Buffers for the weights of every exposure along one stretch.
pub(super) struct Scratch {
    pub(super) weights: Vec<[f64; STRETCH]>,
}

impl Scratch {
    pub(super) fn new(exposures: usize) -> Self {
        Self { weights: vec![[0.0; STRETCH]; exposures] }
    }
}

/// How a measurement differs from its model, and what a step along L or M is.
pub(crate) trait Difference {
    /// Whether L is at its best by plain differences only to begin with.
    const IS_LOGARITHMIC: bool;
    /// What a value of the factor sought is short of, in units of the measurement.
    fn of(value: f64, model: f64) -> f64;
    /// The value sought after a step of the linear problem.
    fn stepped(from: f64, step: f64) -> f64;
}

/// y − c L M: F itself.
pub(crate) struct Plain;

/// c L M ln(y/(c L M)), the first order of which is y − c L M: with it the problem of ln L and ln M is linear.
pub(crate) struct Logarithmic;

impl Difference for Plain {
    const IS_LOGARITHMIC: bool = false;

    #[inline(always)]
    fn of(value: f64, model: f64) -> f64 {
        value - model
    }

    #[inline(always)]
    fn stepped(from: f64, step: f64) -> f64 {
        from + step
    }
}

/// A measurement that is further from its model than by this factor differs plainly: what is nearly dark, such as
/// a pixel under dust in one exposure, has no logarithm.
const FARTHEST: f64 = 200.0;
/// The longest step of a logarithm.
const LONGEST: f64 = 7.0;

impl Difference for Logarithmic {
    const IS_LOGARITHMIC: bool = true;

    #[inline(always)]
    fn of(value: f64, model: f64) -> f64 {
        let ratio = value / model;
        let is_near = model > 0.0 && ratio > 1.0 / FARTHEST && ratio < FARTHEST;
        if is_near { model * logarithm(ratio) } else { value - model }
    }

    #[inline(always)]
    fn stepped(from: f64, step: f64) -> f64 {
        let factor = exponential((step / from).clamp(-LONGEST, LONGEST));
        if from > 0.0 { from * factor } else { from + step }
    }
}

/// ln x of a normal number, to 1e-9: x = 2ᵉ m, ln m = 2 artanh z, z = (m − 1)/(m + 1), |z| < 0.172.
#[inline(always)]
fn logarithm(x: f64) -> f64 {
    const LEAST: u64 = FRAC_1_SQRT_2.to_bits();
    const MANTISSA: u32 = f64::MANTISSA_DIGITS - 1;
    let exponent = (x.to_bits().wrapping_sub(LEAST) as i64 >> MANTISSA) as i32;
    let m = f64::from_bits(x.to_bits().wrapping_sub((i64::from(exponent) << MANTISSA) as u64));
    let z = (m - 1.0) / (m + 1.0);
    let s = z * z;
    let series = 1.0 + s * (1.0 / 3.0 + s * (1.0 / 5.0 + s * (1.0 / 7.0 + s * (1.0 / 9.0))));
    f64::from(exponent) * LN_2 + 2.0 * z * series
}

/// 1/0! to 1/13!.
const INVERSE_FACTORIALS: [f64; 14] = {
    let mut found = [1.0; 14];
    let mut i = 1;
    while i < found.len() {
        found[i] = found[i - 1] / i as f64;
        i += 1;
    }
    found
};

/// eˣ for abs(x) ≤ [`LONGEST`], to rounding: x = n ln 2 + r, eʳ by its series, abs(r) < 0.347.
///
/// What a shorter series lacks would jump where n does, and n changes with the unit of the measurements:
/// results would depend on it.
#[inline(always)]
fn exponential(x: f64) -> f64 {
    // Added to a small number, this leaves its nearest integer in the last bits.
    const ROUNDER: f64 = 1.5 * (1_u64 << (f64::MANTISSA_DIGITS - 1)) as f64;
    let shifted = x * LOG2_E + ROUNDER;
    let r = x - (shifted - ROUNDER) * LN_2;
    let power = (shifted.to_bits() << (f64::MANTISSA_DIGITS - 1)).wrapping_add(1_f64.to_bits());
    let series = INVERSE_FACTORIALS.iter().rev().fold(0.0, |series, term| term + r * series);
    f64::from_bits(power) * series
}

/// Takes each of `sought` to the minimum of F along it; returns their share of F after that.
///
/// L and M enter the model alike: this is the step of both.
pub(super) fn improve<T: Real, D: Difference>(lines: &[Line<'_, T>], sought: &mut [f64]) -> f64 {
    pulp::Arch::new().dispatch(Improve { lines, sought, difference: PhantomData::<D> })
}

/// [`improve`] in a form that the compiler inlines into code for the CPU at hand.
struct Improve<'l, 's, T, D> {
    lines: &'l [Line<'s, T>],
    sought: &'l mut [f64],
    difference: PhantomData<D>,
}

impl<T: Real, D: Difference> pulp::NullaryFnOnce for Improve<'_, '_, T, D> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let (chunks, rest) = self.sought.as_chunks_mut::<LANES>();
        let whole = chunks.len() * LANES;
        let mut objective = [0.0; LANES];
        for (index, chunk) in chunks.iter_mut().enumerate() {
            let before = *chunk;
            let left = Sums::over::<T, D>(self.lines, index * LANES, &before).step::<D>(chunk);
            for (sum, left) in objective.iter_mut().zip(left) {
                *sum += left;
            }
        }
        let mut total: f64 = objective.iter().sum();
        for (index, one) in rest.iter_mut().enumerate() {
            let one = std::array::from_mut(one);
            let before = *one;
            total += Sums::over::<T, D>(self.lines, whole + index, &before).step::<D>(one)[0];
        }
        total
    }
}

/// Writes half the slope of −F and half its curvature along each of `sought`; returns F there.
pub(super) fn measure<T: Real, D: Difference>(
    lines: &[Line<'_, T>],
    sought: &[f64],
    slopes: &mut [f64],
    weights: &mut [f64],
) -> f64 {
    let difference = PhantomData::<D>;
    pulp::Arch::new().dispatch(Measure { lines, sought, slopes, weights, difference })
}

/// [`measure`] in a form that the compiler inlines into code for the CPU at hand.
struct Measure<'l, 's, T, D> {
    lines: &'l [Line<'s, T>],
    sought: &'l [f64],
    slopes: &'l mut [f64],
    weights: &'l mut [f64],
    difference: PhantomData<D>,
}

impl<T: Real, D: Difference> pulp::NullaryFnOnce for Measure<'_, '_, T, D> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let (chunks, rest) = self.sought.as_chunks::<LANES>();
        let whole = chunks.len() * LANES;
        let mut objective = [0.0; LANES];
        for (index, chunk) in chunks.iter().enumerate() {
            let sums = Sums::over::<T, D>(self.lines, index * LANES, chunk);
            self.slopes[index * LANES..][..LANES].copy_from_slice(&sums.slope);
            self.weights[index * LANES..][..LANES].copy_from_slice(&sums.weight);
            for (sum, part) in objective.iter_mut().zip(sums.objective) {
                *sum += part;
            }
        }
        let mut total: f64 = objective.iter().sum();
        for (index, one) in (whole..).zip(rest) {
            let sums = Sums::over::<T, D>(self.lines, index, &[*one]);
            self.slopes[index] = sums.slope[0];
            self.weights[index] = sums.weight[0];
            total += sums.objective[0];
        }
        total
    }
}

/// What the measurements say of `N` neighbouring values of L or M, the other one held fixed.
struct Sums<const N: usize> {
    /// Σ w a r: half the slope of −F, with a = c·(the factor held fixed) and the residual r.
    slope: [f64; N],
    /// Σ w a²: half the curvature of F.
    weight: [f64; N],
    /// Σ w r²: the share of F.
    objective: [f64; N],
}

impl<const N: usize> Sums<N> {
    #[inline(always)]
    fn over<T: Real, D: Difference>(
        lines: &[Line<'_, T>],
        first: usize,
        sought: &[f64; N],
    ) -> Self {
        let mut sums = Self { slope: [0.0; N], weight: [0.0; N], objective: [0.0; N] };
        for line in lines {
            let known = &line.known[first..first + N];
            match line.measured {
                Stretch::Uniform(values, weight) => {
                    let values = &values[first..first + N];
                    for i in 0..N {
                        let factor = line.flux * known[i];
                        let model = factor * sought[i];
                        sums.add::<D>(i, [weight, factor], values[i].to_f64(), model);
                    }
                }
                Stretch::Weighted(values, weights) => {
                    let (values, weights) = (&values[first..first + N], &weights[first..first + N]);
                    for i in 0..N {
                        // A value of weight 0 may be NaN.
                        let value = if weights[i] > 0.0 { values[i].to_f64() } else { 0.0 };
                        let factor = line.flux * known[i];
                        sums.add::<D>(i, [weights[i], factor], value, factor * sought[i]);
                    }
                }
            }
        }
        sums
    }

    #[inline(always)]
    fn add<D: Difference>(&mut self, i: usize, [weight, factor]: [f64; 2], value: f64, model: f64) {
        let (weighted, residual) = (weight * factor, value - model);
        self.slope[i] += weighted * D::of(value, model);
        self.weight[i] += weighted * factor;
        self.objective[i] += weight * residual * residual;
    }

    /// Steps to the minimum; returns F there. F is a parabola: a step s lowers it by s·slope.
    #[inline(always)]
    fn step<D: Difference>(self, sought: &mut [f64; N]) -> [f64; N] {
        let mut left = self.objective;
        for i in 0..N {
            let step = quotient(self.slope[i], self.weight[i]);
            sought[i] = D::stepped(sought[i], step);
            // Below 0 only by rounding, where everything is fitted exactly.
            left[i] = (left[i] - step * self.slope[i]).max(0.0);
        }
        left
    }
}

/// Takes each of `sought` a `share` of its step further.
pub(super) struct Advance<'l, D> {
    pub(super) sought: &'l mut [f64],
    pub(super) steps: &'l [f32],
    pub(super) share: f64,
    pub(super) difference: PhantomData<D>,
}

impl<D: Difference> pulp::NullaryFnOnce for Advance<'_, D> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (sought, &step) in self.sought.iter_mut().zip(self.steps) {
            *sought = D::stepped(*sought, self.share * f64::from(step));
        }
    }
}

/// slope/weight, or 0 without a measurement.
#[inline(always)]
pub(super) fn quotient(slope: f64, weight: f64) -> f64 {
    if weight > 0.0 { slope / weight } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_logarithm_is_that_of_the_library() {
        for step in -3000..=3000 {
            let x = 10_f64.powf(f64::from(step) / 1000.0);
            // The first term that the series lacks is 2 z¹¹/11, |z| < 0.172.
            assert!((logarithm(x) - x.ln()).abs() < 1e-9, "{x}");
        }
    }

    #[test]
    fn the_exponential_is_that_of_the_library() {
        for step in -7000..=7000 {
            let x = f64::from(step) / 1000.0;
            // In units of EPSILON: n ≤ 10 times the rounding of ln 2 is 2.5 of r, that of the product 2;
            // the series has 3, the power of 2 none, the last product and the library 1 each. The
            // first term that the series lacks is r¹⁴/14! < 1e-17, abs(r) < 0.347.
            assert!((exponential(x) / x.exp() - 1.0).abs() < 9.5 * f64::EPSILON, "{x}");
        }
    }

    #[test]
    fn a_difference_of_logarithms_takes_a_value_to_its_measurement_at_once() {
        for [value, model] in [[3.0, 1.5], [0.1, 2.0], [7.0, 6.9]] {
            let step = Logarithmic::of(value, model);
            assert!((Logarithmic::stepped(model, step) / value - 1.0).abs() < 1e-8);
        }
    }
}

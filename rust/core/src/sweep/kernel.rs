//! The arithmetic of a sweep: neighbouring values of L or M, side by side in vector registers.

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

/// Takes each of `sought` to the minimum of F along it; returns their share of F after that.
///
/// L and M enter the model alike: this is the step of both.
pub(super) fn improve<T: Real>(lines: &[Line<'_, T>], sought: &mut [f64]) -> f64 {
    pulp::Arch::new().dispatch(Improve { lines, sought })
}

/// [`improve`] in a form that the compiler inlines into code for the CPU at hand.
struct Improve<'l, 's, T> {
    lines: &'l [Line<'s, T>],
    sought: &'l mut [f64],
}

impl<T: Real> pulp::NullaryFnOnce for Improve<'_, '_, T> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let (chunks, rest) = self.sought.as_chunks_mut::<LANES>();
        let whole = chunks.len() * LANES;
        let mut objective = [0.0; LANES];
        for (index, chunk) in chunks.iter_mut().enumerate() {
            let before = *chunk;
            let left = Sums::over(self.lines, index * LANES, &before).step(chunk);
            for (sum, left) in objective.iter_mut().zip(left) {
                *sum += left;
            }
        }
        let mut total: f64 = objective.iter().sum();
        for (index, one) in rest.iter_mut().enumerate() {
            let one = std::array::from_mut(one);
            let before = *one;
            total += Sums::over(self.lines, whole + index, &before).step(one)[0];
        }
        total
    }
}

/// Writes half the slope of −F and half its curvature along each of `sought`; returns F there.
pub(super) fn measure<T: Real>(
    lines: &[Line<'_, T>],
    sought: &[f64],
    slopes: &mut [f64],
    weights: &mut [f64],
) -> f64 {
    pulp::Arch::new().dispatch(Measure { lines, sought, slopes, weights })
}

/// [`measure`] in a form that the compiler inlines into code for the CPU at hand.
struct Measure<'l, 's, T> {
    lines: &'l [Line<'s, T>],
    sought: &'l [f64],
    slopes: &'l mut [f64],
    weights: &'l mut [f64],
}

impl<T: Real> pulp::NullaryFnOnce for Measure<'_, '_, T> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let (chunks, rest) = self.sought.as_chunks::<LANES>();
        let whole = chunks.len() * LANES;
        let mut objective = [0.0; LANES];
        for (index, chunk) in chunks.iter().enumerate() {
            let sums = Sums::over(self.lines, index * LANES, chunk);
            self.slopes[index * LANES..][..LANES].copy_from_slice(&sums.slope);
            self.weights[index * LANES..][..LANES].copy_from_slice(&sums.weight);
            for (sum, part) in objective.iter_mut().zip(sums.objective) {
                *sum += part;
            }
        }
        let mut total: f64 = objective.iter().sum();
        for (index, one) in (whole..).zip(rest) {
            let sums = Sums::over(self.lines, index, &[*one]);
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
    fn over<T: Real>(lines: &[Line<'_, T>], first: usize, sought: &[f64; N]) -> Self {
        let mut sums = Self { slope: [0.0; N], weight: [0.0; N], objective: [0.0; N] };
        for line in lines {
            let known = &line.known[first..first + N];
            match line.measured {
                Stretch::Uniform(values, weight) => {
                    let values = &values[first..first + N];
                    for i in 0..N {
                        let factor = line.flux * known[i];
                        let residual = values[i].to_f64() - factor * sought[i];
                        sums.add(i, weight, factor, residual);
                    }
                }
                Stretch::Weighted(values, weights) => {
                    let (values, weights) = (&values[first..first + N], &weights[first..first + N]);
                    for i in 0..N {
                        // A value of weight 0 may be NaN.
                        let value = if weights[i] > 0.0 { values[i].to_f64() } else { 0.0 };
                        let factor = line.flux * known[i];
                        sums.add(i, weights[i], factor, value - factor * sought[i]);
                    }
                }
            }
        }
        sums
    }

    #[inline(always)]
    fn add(&mut self, i: usize, weight: f64, factor: f64, residual: f64) {
        let weighted = weight * factor;
        self.slope[i] += weighted * residual;
        self.weight[i] += weighted * factor;
        self.objective[i] += weight * residual * residual;
    }

    /// Steps to the minimum; returns F there. F is a parabola: a step s lowers it by s·slope.
    #[inline(always)]
    fn step(self, sought: &mut [f64; N]) -> [f64; N] {
        let mut left = self.objective;
        for i in 0..N {
            let step = quotient(self.slope[i], self.weight[i]);
            sought[i] += step;
            // Below 0 only by rounding, where everything is fitted exactly.
            left[i] = (left[i] - step * self.slope[i]).max(0.0);
        }
        left
    }
}

/// slope/weight, or 0 without a measurement.
#[inline(always)]
pub(super) fn quotient(slope: f64, weight: f64) -> f64 {
    if weight > 0.0 { slope / weight } else { 0.0 }
}

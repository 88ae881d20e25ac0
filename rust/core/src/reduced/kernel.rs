//! The arithmetic of a product with S: whole rows, side by side in vector registers.

use crate::padded::{LANES, chunk};

/// Weights w c² of one exposure along a row.
#[derive(Clone, Copy)]
pub(super) enum Weight<'s> {
    Same(f32),
    Each(&'s [f32]),
}

impl Weight<'_> {
    #[inline(always)]
    fn chunk(&self, index: usize) -> [f32; LANES] {
        match self {
            Self::Same(weight) => [*weight; LANES],
            Self::Each(weights) => *chunk(weights, index),
        }
    }
}

/// One exposure along a row: its weights and two images as it sees them.
pub(super) struct Line<'s> {
    pub(super) weight: Weight<'s>,
    pub(super) first: &'s [f32],
    pub(super) second: &'s [f32],
}

/// From pixels to cells: Σ w c² M x and Σ w c² M², from lines of M and x.
pub(super) struct Gather<'l, 's> {
    pub(super) lines: &'l [Line<'s>],
    pub(super) signal: &'l mut [f32],
    pub(super) weight: &'l mut [f32],
}

impl pulp::NullaryFnOnce for Gather<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let (signals, weights) = (self.signal.as_chunks_mut().0, self.weight.as_chunks_mut().0);
        for (index, (signal, weight)) in signals.iter_mut().zip(weights).enumerate() {
            let [mut signals, mut weights] = [[0.0; LANES]; 2];
            for line in self.lines {
                let (w, m) = (line.weight.chunk(index), chunk(line.first, index));
                let x = chunk(line.second, index);
                for i in 0..LANES {
                    let wm = w[i] * m[i];
                    signals[i] += wm * x[i];
                    weights[i] += wm * m[i];
                }
            }
            (*signal, *weight) = (signals, weights);
        }
    }
}

/// signal/weight in place of the signal, 0 without a measurement.
pub(super) struct Divide<'l> {
    pub(super) signal: &'l mut [f32],
    pub(super) weight: &'l [f32],
}

impl pulp::NullaryFnOnce for Divide<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (signal, &weight) in self.signal.iter_mut().zip(self.weight) {
            // Below, 1/weight may be infinite.
            *signal = if weight >= f32::MIN_POSITIVE { *signal / weight } else { 0.0 };
        }
    }
}

/// From cells back to pixels: S x = Σ w c² L² (x − M h), from lines of L² and h; returns x · S x.
pub(super) struct Scatter<'l, 's> {
    pub(super) lines: &'l [Line<'s>],
    pub(super) sensitivity: &'l [f32],
    pub(super) x: &'l [f32],
    pub(super) product: &'l mut [f32],
}

impl pulp::NullaryFnOnce for Scatter<'_, '_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let mut total = [0.0; LANES];
        for (index, product) in self.product.as_chunks_mut().0.iter_mut().enumerate() {
            let (x, m) = (chunk(self.x, index), chunk(self.sensitivity, index));
            let mut sum = [0.0; LANES];
            for line in self.lines {
                let (w, light) = (line.weight.chunk(index), chunk(line.first, index));
                let h = chunk(line.second, index);
                for i in 0..LANES {
                    sum[i] += w[i] * light[i] * (x[i] - m[i] * h[i]);
                }
            }
            for i in 0..LANES {
                total[i] += x[i] * sum[i];
            }
            *product = sum;
        }
        total.iter().map(|&sum| f64::from(sum)).sum()
    }
}

/// D = Σ w c² L², from lines of L² (twice).
pub(super) struct Diagonal<'l, 's> {
    pub(super) lines: &'l [Line<'s>],
    pub(super) diagonal: &'l mut [f32],
}

impl pulp::NullaryFnOnce for Diagonal<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (index, diagonal) in self.diagonal.as_chunks_mut().0.iter_mut().enumerate() {
            let mut sum = [0.0; LANES];
            for line in self.lines {
                let (w, light) = (line.weight.chunk(index), chunk(line.first, index));
                for i in 0..LANES {
                    sum[i] += w[i] * light[i];
                }
            }
            *diagonal = sum;
        }
    }
}

/// Adds ω = w c² M² L² along a row of cells, from a line of M and L².
pub(super) struct Weigh<'l, 's> {
    pub(super) line: Line<'s>,
    pub(super) sums: &'l mut [f32],
}

impl pulp::NullaryFnOnce for Weigh<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (index, sum) in self.sums.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
            let (w, m) = (self.line.weight.chunk(index), chunk(self.line.first, index));
            let light = chunk(self.line.second, index);
            for i in 0..LANES {
                sum[i] += w[i] * m[i] * m[i] * light[i];
            }
        }
    }
}

/// ±1/√w along a row, 0 where w is 0: noise of variance 1/w whose signs are given bit by bit.
pub(super) struct Sign<'l, 's> {
    pub(super) weight: Weight<'s>,
    pub(super) signs: &'l [u32],
    pub(super) noise: &'l mut [f32],
}

impl pulp::NullaryFnOnce for Sign<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let chunks = self.noise.as_chunks_mut::<LANES>().0.iter_mut().zip(self.signs);
        for (index, (noise, &signs)) in chunks.enumerate() {
            let w = self.weight.chunk(index);
            for i in 0..LANES {
                let size = if w[i] > 0.0 { 1.0 / w[i].sqrt() } else { 0.0 };
                let sign = (signs << i) & (1 << 31);
                noise[i] = f32::from_bits(size.to_bits() | sign);
            }
        }
    }
}

/// The right-hand side that noise e makes: b = Σ w c² L (e − M h), from lines of L² and h. The sign
/// of L is lost: it turns all noise of one cell, which is as likely either way. Returns
/// Σ w c² e (e − M h).
pub(super) struct NoiseSlope<'l, 's> {
    pub(super) lines: &'l [Line<'s>],
    pub(super) noise: &'l [&'s [f32]],
    pub(super) sensitivity: &'l [f32],
    pub(super) slope: &'l mut [f32],
}

impl pulp::NullaryFnOnce for NoiseSlope<'_, '_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let mut total = [0.0; LANES];
        for (index, slope) in self.slope.as_chunks_mut().0.iter_mut().enumerate() {
            let m = chunk(self.sensitivity, index);
            let mut sum = [0.0; LANES];
            for (line, noise) in self.lines.iter().zip(self.noise) {
                let (w, light) = (line.weight.chunk(index), chunk(line.first, index));
                let (h, e) = (chunk(line.second, index), chunk(noise, index));
                for i in 0..LANES {
                    let left = w[i] * (e[i] - m[i] * h[i]);
                    sum[i] += left * light[i].sqrt();
                    total[i] += left * e[i];
                }
            }
            *slope = sum;
        }
        total.iter().map(|&sum| f64::from(sum)).sum()
    }
}

/// Σ w c L (x − M h), from lines of L² and h, and 1/c of each exposure: what a change of all
/// measurements of a pixel alike does to x · b.
pub(super) struct Common<'l, 's> {
    pub(super) lines: &'l [Line<'s>],
    pub(super) factors: &'l [f32],
    pub(super) sensitivity: &'l [f32],
    pub(super) x: &'l [f32],
    pub(super) sums: &'l mut [f32],
}

impl pulp::NullaryFnOnce for Common<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (index, sums) in self.sums.as_chunks_mut().0.iter_mut().enumerate() {
            let (x, m) = (chunk(self.x, index), chunk(self.sensitivity, index));
            let mut sum = [0.0; LANES];
            for (line, factor) in self.lines.iter().zip(self.factors) {
                let (w, light) = (line.weight.chunk(index), chunk(line.first, index));
                let h = chunk(line.second, index);
                for i in 0..LANES {
                    sum[i] += w[i] * factor * light[i].sqrt() * (x[i] - m[i] * h[i]);
                }
            }
            *sums = sum;
        }
    }
}

/// 1/D + Σ (w c² L M / D)² v, from lines of L² and of the variance v of a cell's L.
pub(super) struct TwoTerms<'l, 's> {
    pub(super) lines: &'l [Line<'s>],
    pub(super) sensitivity: &'l [f32],
    pub(super) inverse_diagonal: &'l [f32],
    pub(super) variance: &'l mut [f32],
}

impl pulp::NullaryFnOnce for TwoTerms<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (index, variance) in self.variance.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
            let (m, d) = (chunk(self.sensitivity, index), chunk(self.inverse_diagonal, index));
            let mut sum = [0.0; LANES];
            for line in self.lines {
                let (w, light) = (line.weight.chunk(index), chunk(line.first, index));
                let v = chunk(line.second, index);
                for i in 0..LANES {
                    let share = w[i] * m[i] * d[i];
                    sum[i] += share * share * light[i] * v[i];
                }
            }
            for i in 0..LANES {
                variance[i] = d[i] + sum[i];
            }
        }
    }
}

//! Gain and offset of each pixel, and the gauge that holds their means.

use super::bands::{BAND, bands, fold, wide};
use crate::frames::Shape;
use crate::parallel::{Workers, dot};

/// Coefficients of the corrected frame X = g y + o, for values y on the scale [0, 1].
#[derive(Clone, Debug)]
pub(super) struct Coefficients {
    pub(super) shape: Shape,
    pub(super) gain: Vec<f32>,
    pub(super) offset: Vec<f32>,
}

/// What the gauge took from the coefficients: X before = scale · X after + shift.
#[derive(Clone, Copy, Debug)]
pub(super) struct Taken {
    pub(super) scale: f64,
    pub(super) shift: f64,
}

impl Coefficients {
    pub(super) fn new(shape: Shape) -> Self {
        Self { shape, gain: vec![1.0; shape.len()], offset: vec![0.0; shape.len()] }
    }

    /// Writes g y + o.
    pub(super) fn apply(&self, raw: &[f32], corrected: &mut [f32], workers: &Workers) {
        let size = BAND * self.shape.cols;
        workers.map_blocks(corrected, size, |index, corrected| {
            let start = index * size;
            applied(&raw[start..], &self.gain[start..], &self.offset[start..], corrected);
        });
    }

    /// Holds the gauge: gives what the mean gain and the mean offset lost, by their [`sums`], back to each pixel in
    /// proportion to its part. Rounding is left, and given back the next time.
    pub(super) fn hold_gauge_by(&mut self, part: &[f32], lost: [f64; 4], workers: &Workers) {
        let size = BAND * self.shape.cols;
        let [gains, offsets, taken, parts] = lost;
        if taken > 0.0 {
            let factor = ((self.shape.len() as f64 - gains) / taken) as f32;
            let shift = (offsets / parts) as f32;
            let bands = bands!(size; &mut self.gain, &mut self.offset);
            workers.each(bands, |index, (gain, offset)| {
                give_back(gain, offset, &part[index * size..], [factor, shift]);
            });
        } else {
            self.hold_gauge(workers);
        }
    }

    /// Holds mean(g) = 1 and mean(o) = 0: the corrected frame becomes (X − mean(o)) / mean(g).
    ///
    /// The errors that the methods reduce vanish for X = constant, so without a gauge the mean gain
    /// decays.
    pub(super) fn hold_gauge(&mut self, workers: &Workers) -> Taken {
        let size = BAND * self.shape.cols;
        let sums =
            workers.map_pairs(&mut self.gain, &mut self.offset, [size, size], |_, gain, offset| {
                [sum(gain), sum(offset)]
            });
        let [gains, offsets] = fold(sums);
        let pixels = self.shape.len() as f64;
        let taken = Taken { scale: gains / pixels, shift: offsets / pixels };
        let (factor, shift) = ((1.0 / taken.scale) as f32, taken.shift as f32);
        let parts = bands!(size; &mut self.gain, &mut self.offset);
        workers.each(parts, |_, (gain, offset)| {
            scale(gain, offset, [factor, shift]);
        });
        taken
    }
}

/// Σ g, Σ o, Σ g part and Σ part.
pub(super) fn sums(gain: &[f32], offset: &[f32], part: &[f32]) -> [f64; 4] {
    [sum(gain), sum(offset), dot(gain, part), sum(part)]
}

wide! {
/// Writes g y + o.
fn applied<'s>(raw: &'s [f32], gain: &'s [f32], offset: &'s [f32], corrected: &'s mut [f32]) -> () {
    for (corrected, ((y, gain), offset)) in corrected.iter_mut().zip(raw.iter().zip(gain).zip(offset)) {
        *corrected = gain * y + offset;
    }
}
}

wide! {
/// g ← g + factor part g, o ← o − shift part.
fn give_back<'s>(gain: &'s mut [f32], offset: &'s mut [f32], part: &'s [f32], by: [f32; 2]) -> () {
    for ((g, o), part) in gain.iter_mut().zip(offset).zip(part) {
        *g += by[0] * part * *g;
        *o -= by[1] * part;
    }
}
}

wide! {
/// g ← factor g, o ← (o − shift) factor.
fn scale<'s>(gain: &'s mut [f32], offset: &'s mut [f32], by: [f32; 2]) -> () {
    for (g, o) in gain.iter_mut().zip(offset) {
        *g *= by[0];
        *o = (*o - by[1]) * by[0];
    }
}
}

wide! {
/// The sum of values in single precision.
pub(super) fn sum<'s>(values: &'s [f32]) -> f64 {
    sum_of(values, |value| value)
}
}

wide! {
/// The sum of the squares of values.
pub(super) fn sum_of_squares<'s>(values: &'s [f32]) -> f64 {
    sum_of(values, |value| value * value)
}
}

#[inline(always)]
fn sum_of(values: &[f32], term: impl Fn(f64) -> f64) -> f64 {
    const LANES: usize = 16;
    let (chunks, rest) = values.as_chunks::<LANES>();
    let mut sums = [0.0_f64; LANES];
    for chunk in chunks {
        for (sum, value) in sums.iter_mut().zip(chunk) {
            *sum += term(f64::from(*value));
        }
    }
    sums.iter().sum::<f64>() + rest.iter().map(|value| term(f64::from(*value))).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gauge_holds_both_means_and_says_what_it_took() {
        let shape = Shape::new(37, 5);
        let mut coefficients = Coefficients::new(shape);
        for i in 0..shape.len() {
            coefficients.gain[i] = 0.8 + 0.001 * i as f32;
            coefficients.offset[i] = 0.1 - 0.002 * i as f32;
        }
        let before = coefficients.clone();
        let workers = Workers::new(std::num::NonZeroUsize::new(2)).unwrap();
        let taken = coefficients.hold_gauge(&workers);
        let mean = |values: &[f32]| sum(values) / shape.len() as f64;
        // Each value is rounded once, to half a unit in the last place of a number below 2.
        assert!((mean(&coefficients.gain) - 1.0).abs() < 2.0 * f64::from(f32::EPSILON));
        assert!(mean(&coefficients.offset).abs() < 2.0 * f64::from(f32::EPSILON));
        for i in 0..shape.len() {
            let was = f64::from(before.gain[i] * 0.4 + before.offset[i]);
            let is = f64::from(coefficients.gain[i] * 0.4 + coefficients.offset[i]);
            assert!((was - taken.scale * is - taken.shift).abs() < 8.0 * f64::from(f32::EPSILON));
        }
    }
}

//! Fixed point at the ends of its words: limits, ties, and the loop against exact arithmetic.

use std::num::NonZeroUsize;

use equipix_core::fixed_point::{Arithmetic, Format, Limited, Loop, Memories, Table, adapt};
use equipix_core::{Control, Shape, Workers};

const FORMAT: Format =
    Format { adc_bits: 8, out_bits: 8, adc: 0, offset: 0, gain: 0, out: 0, base: 0 };

fn workers() -> Workers {
    Workers::new(NonZeroUsize::new(1)).unwrap()
}

#[test]
fn only_outputs_beyond_the_words_are_counted() {
    let shape = Shape::new(1, 5);
    let (words, gain, offset) = ([255, 255, 0, 0, 9], [1, 1, 1, 1, 0], [0, 1, 0, -1, 5]);
    let table = Table::new(shape, &gain, &offset, Arithmetic::new(&FORMAT).unwrap()).unwrap();
    let mut out = [7; 5];
    let limited = table.apply(&words, &mut out, &workers(), &Control::new()).unwrap();
    // 255, 256, 0, −1, and a pixel that must not be used.
    assert_eq!(out, [255, 255, 0, 0, 0]);
    assert_eq!(limited, Limited { below: 1, above: 1 });
}

#[test]
fn sums_of_58_bits_are_the_widest() {
    // An offset word of 16 bits, raised by 42 above the finest step, that of the gain.
    let format = Format { gain: -15, offset: 27, ..FORMAT };
    assert!(Arithmetic::new(&format).is_ok());
    let wider = Arithmetic::new(&Format { offset: 28, ..format }).unwrap_err().to_string();
    assert!(wider.contains("take 59 bits"), "{wider}");
}

/// Gain, offset and output of each pixel.
type Words = [Vec<i32>; 3];

/// Whole numbers below a bound, without order.
struct Scattered(u64);

impl Scattered {
    fn below(&mut self, bound: i32) -> i32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        ((self.0 >> 40) % u64::from(bound.unsigned_abs())) as i32
    }
}

/// Index of a neighbour; the opposite one stands in for one beyond the edge.
fn mirrored(at: usize, step: isize, end: usize) -> usize {
    let next = at as isize + step;
    (if next < 0 || next == end as isize { at as isize - step } else { next }) as usize
}

fn neighbours(x: &[f64], shape: Shape, at: usize) -> f64 {
    let (row, col) = (at / shape.cols, at % shape.cols);
    let vertical = |step| x[mirrored(row, step, shape.rows) * shape.cols + col];
    let horizontal = |step| x[row * shape.cols + mirrored(col, step, shape.cols)];
    (vertical(-1) + vertical(1) + horizontal(-1) + horizontal(1)) / 4.0
}

/// Takes the mean off in whole steps, and limits the words.
fn held(words: &[f64], wanted: f64, [low, high]: [f64; 2]) -> Vec<i32> {
    let mean = words.iter().map(|word| word - wanted).sum::<f64>() / words.len() as f64;
    words.iter().map(|word| (word - mean.round_ties_even()).clamp(low, high) as i32).collect()
}

/// One frame of the loop. All values are fractions of powers of two, so exact in double precision.
fn exact(
    frame: &[i32],
    gain: &[i32],
    offset: &[i32],
    bits: [u32; 3],
    step: u32,
    shape: Shape,
) -> Words {
    let [full, twice, range] = bits.map(|bits| f64::from(1 << bits));
    let (one, eta) = (twice / 2.0, f64::from(step).exp2().recip());
    let y: Vec<f64> = frame.iter().map(|&x| f64::from(x) / full).collect();
    let pixels = 0..frame.len();
    let x: Vec<f64> = pixels
        .clone()
        .map(|p| f64::from(gain[p]) / one * y[p] + f64::from(offset[p]) / range)
        .collect();
    let error: Vec<f64> = pixels.clone().map(|p| neighbours(&x, shape, p) - x[p]).collect();
    let (gains, offsets) = ([0.0, twice - 1.0], [-range / 2.0, range / 2.0 - 1.0]);
    let changed = |word: i32, change: f64, [low, high]: [f64; 2]| {
        (f64::from(word) + change.round_ties_even()).clamp(low, high)
    };
    let new_gain: Vec<f64> =
        pixels.clone().map(|p| changed(gain[p], eta * error[p] * y[p] * one, gains)).collect();
    let new_offset: Vec<f64> =
        pixels.map(|p| changed(offset[p], eta * error[p] * range, offsets)).collect();
    let out = x.iter().map(|x| (x * full).round_ties_even().clamp(0.0, full - 1.0) as i32);
    [held(&new_gain, one, gains), held(&new_offset, 0.0, offsets), out.collect()]
}

fn by_the_loop(
    frame: &[i32],
    gain: &[i32],
    offset: &[i32],
    bits: [u32; 3],
    step: u32,
    shape: Shape,
) -> Words {
    let run = Loop::new(shape, bits, step).unwrap();
    let narrow = |words: &[i32]| words.iter().map(|&word| word as u16).collect::<Vec<_>>();
    let (words, mut gain, mut out) = (narrow(frame), narrow(gain), vec![0; frame.len()]);
    let mut offset: Vec<i16> = offset.iter().map(|&word| word as i16).collect();
    let mut memories = Memories { gain: &mut gain, offset: &mut offset };
    adapt(&run, &mut memories, &words, &mut out, &workers(), &Control::new()).unwrap();
    let wide = |words: &[u16]| words.iter().map(|&word| i32::from(word)).collect();
    [wide(&gain), offset.iter().map(|&word| i32::from(word)).collect(), wide(&out)]
}

#[test]
fn the_loop_is_exact_arithmetic_up_to_the_ends_of_its_words() {
    let mut random = Scattered(1);
    let mut extremes = [0; 6];
    // Sizes are powers of two, so that means have ties.
    for (shape, bits, step) in [
        (Shape::new(2, 2), [8, 6, 7], 1),
        (Shape::new(2, 4), [6, 8, 5], 1),
        (Shape::new(4, 2), [7, 5, 6], 2),
    ] {
        for _ in 0..300 {
            let mut draw = |bits: u32| -> Vec<i32> {
                (0..shape.len()).map(|_| random.below(1 << bits)).collect()
            };
            let (frame, gain, offset) = (draw(bits[0]), draw(bits[1]), draw(bits[2]));
            let offset: Vec<i32> = offset.iter().map(|word| word - (1 << (bits[2] - 1))).collect();
            let found = by_the_loop(&frame, &gain, &offset, bits, step, shape);
            assert_eq!(found, exact(&frame, &gain, &offset, bits, step, shape));
            let half = 1 << (bits[2] - 1);
            let ends = [0, (1 << bits[1]) - 1, -half, half - 1, 0, (1 << bits[0]) - 1];
            for (i, end) in ends.into_iter().enumerate() {
                extremes[i] += found[i / 2].iter().filter(|&&word| word == end).count();
            }
        }
    }
    assert!(extremes.iter().all(|&count| count > 20), "{extremes:?}");
}

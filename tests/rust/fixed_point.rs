//! Corrections in fixed point against rational arithmetic, and the laws of the adaptive loop.

use std::num::NonZeroUsize;

use equipix_core::fixed_point::{Arithmetic, Format, Limited, Loop, Memories, Table, adapt};
use equipix_core::{Control, Shape, Workers};

const SHAPE: Shape = Shape::new(37, 41);

fn workers(count: usize) -> Workers {
    Workers::new(NonZeroUsize::new(count)).unwrap()
}

/// Numbers from 0 to 65 535 without order.
fn scattered(count: usize, seed: u64) -> impl Iterator<Item = u16> {
    let mut state = seed;
    (0..count).map(move |_| {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as u16
    })
}

const FORMAT: Format =
    Format { adc_bits: 12, out_bits: 14, adc: 1, offset: -2, gain: -13, out: -1, base: 300 };

fn applied(format: &Format, words: &[u16], count: usize) -> (Vec<u16>, Limited) {
    let gain: Vec<u16> = scattered(SHAPE.len(), 1).map(|g| g / 4).collect();
    let offset: Vec<i16> = scattered(SHAPE.len(), 2).map(|o| o.cast_signed() / 16).collect();
    let mut out = vec![0; words.len()];
    let table = Table::new(SHAPE, &gain, &offset, Arithmetic::new(format).unwrap()).unwrap();
    let limited = table.apply(words, &mut out, &workers(count), &Control::new()).unwrap();
    (out, limited)
}

/// Products and sums of whole numbers below 2^53 times powers of two are exact in double precision.
fn expected(format: &Format, words: &[u16]) -> (Vec<u16>, Limited) {
    let gain: Vec<u16> = scattered(SHAPE.len(), 1).map(|g| g / 4).collect();
    let offset: Vec<i16> = scattered(SHAPE.len(), 2).map(|o| o.cast_signed() / 16).collect();
    let power = |exponent: i32| f64::from(exponent).exp2();
    let (mut limited, top) = (Limited::default(), f64::from((1_u32 << format.out_bits) - 1));
    let out = words.iter().enumerate().map(|(i, &x)| {
        let p = i % SHAPE.len();
        if gain[p] == 0 {
            return 0;
        }
        let product = f64::from(gain[p]) * f64::from(x) * power(format.gain + format.adc);
        let sum = product + f64::from(offset[p]) * power(format.offset);
        let value = (sum * power(-format.out)).round_ties_even() + f64::from(format.base);
        limited.below += u64::from(value < 0.0);
        limited.above += u64::from(value > top);
        value.clamp(0.0, top) as u16
    });
    (out.collect(), limited)
}

fn words(frames: usize, bits: u32) -> Vec<u16> {
    scattered(frames * SHAPE.len(), 3).map(|x| x >> (16 - bits)).collect()
}

#[test]
fn words_are_corrected_as_exact_arithmetic_does() {
    let formats = [
        FORMAT,
        Format { out: 3, ..FORMAT },
        Format { offset: 4, base: -200, ..FORMAT },
        Format { adc: -3, gain: 0, offset: -6, out: 2, ..FORMAT },
        Format { adc_bits: 16, out_bits: 16, adc: 0, offset: 0, gain: -15, out: 0, base: 0 },
        Format { adc_bits: 8, out_bits: 8, adc: 0, offset: -8, gain: -6, out: 0, base: 3 },
    ];
    for format in formats {
        let words = words(2, format.adc_bits);
        assert_eq!(applied(&format, &words, 1), expected(&format, &words), "{format:?}");
    }
}

#[test]
fn halves_are_rounded_to_even() {
    let format = Format { adc_bits: 4, out_bits: 8, adc: 0, offset: 0, gain: -1, out: 0, base: 2 };
    let words: Vec<u16> = (0..8).collect();
    let (gain, offset) = ([1; 8], [-3; 8]);
    let shape = Shape::new(2, 4);
    let table = Table::new(shape, &gain, &offset, Arithmetic::new(&format).unwrap()).unwrap();
    let mut out = [0; 8];
    let limited = table.apply(&words, &mut out, &workers(1), &Control::new()).unwrap();
    // x/2 − 3 + 2: −1, −0.5, 0, 0.5, 1, 1.5, 2, 2.5; the base is even.
    assert_eq!(out, [0, 0, 0, 0, 1, 2, 2, 2]);
    assert_eq!(limited, Limited { below: 1, above: 0 });
}

#[test]
fn any_number_of_workers_gives_the_same_bytes() {
    let words = words(3, 12);
    assert_eq!(applied(&FORMAT, &words, 1), applied(&FORMAT, &words, 3));
}

#[test]
fn what_does_not_go_together_is_refused() {
    let refused = |format: Format| Arithmetic::new(&format).unwrap_err().to_string();
    assert!(refused(Format { adc_bits: 17, ..FORMAT }).contains("'adc_bits' is 17"));
    assert!(refused(Format { out_bits: 0, ..FORMAT }).contains("'out_bits' is 0"));
    assert!(refused(Format { gain: -41, ..FORMAT }).contains("expected -40 to 40"));
    assert!(refused(Format { offset: -40, ..FORMAT }).contains("whose sums take"));
    let arithmetic = Arithmetic::new(&FORMAT).unwrap();
    let short = Table::new(SHAPE, &[1; 4], &[0; 4], arithmetic).unwrap_err().to_string();
    assert!(short.contains("'gain' has shape 4 words"));
    let (gain, offset) = (vec![1; SHAPE.len()], vec![0; SHAPE.len()]);
    let table = Table::new(SHAPE, &gain, &offset, arithmetic).unwrap();
    let mut out = vec![0; SHAPE.len()];
    let high = table.apply(&vec![4096; SHAPE.len()], &mut out, &workers(1), &Control::new());
    assert!(high.unwrap_err().to_string().contains("holds 4096, above 4095"));
    assert!(Loop::new(SHAPE, [14, 16, 16], 0).unwrap_err().to_string().contains("diverges"));
    assert!(Loop::new(Shape::new(1, 9), [14, 16, 16], 5).is_err());
}

/// A moving scene seen through gains and offsets that differ, in words of `bits`.
fn scene(frame: usize, bits: u32) -> Vec<u16> {
    let (gain, offset): (Vec<u16>, Vec<u16>) =
        (scattered(SHAPE.len(), 7).collect(), scattered(SHAPE.len(), 8).collect());
    let full = f64::from((1_u32 << bits) - 1);
    let level = 0.5 + 0.25 * (frame as f64 / 40.0).sin();
    let word = |at: usize| {
        let (row, col) = ((at / SHAPE.cols) as f64, (at % SHAPE.cols + frame) as f64);
        let light = level + 0.05 * (0.3 * row + 0.2 * col).sin() * (0.13 * col).cos();
        let share = |word: u16| f64::from(word) / 65_535.0 - 0.5;
        let y = (1.0 + 0.1 * share(gain[at])) * light + 0.2 * share(offset[at]);
        (y * full).round() as u16
    };
    (0..SHAPE.len()).map(word).collect()
}

fn adapted(widths: [u32; 3], step: u32, frames: usize, count: usize) -> [Vec<i32>; 3] {
    let run = Loop::new(SHAPE, widths, step).unwrap();
    let mut gain = vec![run.one(); SHAPE.len()];
    let (mut offset, mut out) = (vec![0; SHAPE.len()], vec![0; SHAPE.len()]);
    for frame in 0..frames {
        let mut memories = Memories { gain: &mut gain, offset: &mut offset };
        let words = scene(frame, widths[0]);
        adapt(&run, &mut memories, &words, &mut out, &workers(count), &Control::new()).unwrap();
    }
    let wide = |words: &[u16]| words.iter().map(|&word| i32::from(word)).collect();
    [wide(&gain), offset.iter().map(|&word| i32::from(word)).collect(), wide(&out)]
}

#[test]
fn the_loop_gives_the_same_bytes_for_any_number_of_workers() {
    assert_eq!(adapted([14, 14, 14], 5, 5, 1), adapted([14, 14, 14], 5, 5, 3));
}

#[test]
fn the_loop_holds_the_means_to_half_a_step() {
    let [gain, offset, _] = adapted([14, 14, 14], 5, 20, 2);
    let mean = |words: &[i32]| f64::from(words.iter().sum::<i32>()) / SHAPE.len() as f64;
    assert!((mean(&gain) - f64::from(1 << 13)).abs() <= 0.5);
    assert!(mean(&offset).abs() <= 0.5);
    assert!(offset.iter().any(|&word| word != 0) && gain.iter().any(|&word| word != 1 << 13));
}

/// The same loop in double precision, with no rounding but that of the ADC.
fn adapted_in_floats(bits: u32, step: u32, frames: usize) -> [Vec<f64>; 2] {
    let (mut gain, mut offset) = (vec![1.0; SHAPE.len()], vec![0.0; SHAPE.len()]);
    let (eta, scale) = (f64::from(step).exp2().recip(), f64::from(bits).exp2().recip());
    for frame in 0..frames {
        let y: Vec<f64> = scene(frame, bits).iter().map(|&x| f64::from(x) * scale).collect();
        let x: Vec<f64> = (0..SHAPE.len()).map(|p| gain[p] * y[p] + offset[p]).collect();
        for p in 0..SHAPE.len() {
            let (row, col) = (p / SHAPE.cols, p % SHAPE.cols);
            let mirrored = |at: usize, step: isize, end: usize| {
                let next = at as isize + step;
                (if next < 0 || next == end as isize { at as isize - step } else { next }) as usize
            };
            let value = |row: usize, col: usize| x[row * SHAPE.cols + col];
            let vertical = [-1, 1].map(|step| value(mirrored(row, step, SHAPE.rows), col));
            let horizontal = [-1, 1].map(|step| value(row, mirrored(col, step, SHAPE.cols)));
            let target = (vertical.iter().sum::<f64>() + horizontal.iter().sum::<f64>()) / 4.0;
            gain[p] += eta * (target - x[p]) * y[p];
            offset[p] += eta * (target - x[p]);
        }
        for (words, wanted) in [(&mut gain, 1.0), (&mut offset, 0.0)] {
            let away = words.iter().sum::<f64>() / SHAPE.len() as f64 - wanted;
            words.iter_mut().for_each(|word| *word -= away);
        }
    }
    [gain, offset]
}

#[test]
fn the_loop_with_wide_words_follows_that_in_double_precision() {
    let (bits, step, frames) = (12, 7, 12);
    let [gain, offset, _] = adapted([bits, 16, 16], step, frames, 2);
    let [exact_gain, exact_offset] = adapted_in_floats(bits, step, frames);
    // With y up to 1 an error u of both memories makes one of 4 u in E. A frame adds the rounding of a
    // word, 1/2 step; the means were held to 1/2, move by 1/2 + 4 u/2^s, and are held to 1/2 again:
    // u ← u (1 + 8/2^s) + 2 steps, those of the gain, which are the larger ones.
    let growth = 8.0 / f64::from(step).exp2();
    let limit = 2.0 * ((1.0 + growth).powi(frames as i32) - 1.0) / growth;
    for p in 0..SHAPE.len() {
        let gain_error = f64::from(gain[p]) - exact_gain[p] * f64::from(1 << 15);
        let offset_error = f64::from(offset[p]) - exact_offset[p] * f64::from(1 << 16);
        assert!(
            gain_error.abs() < limit && offset_error.abs() < 2.0 * limit,
            "{gain_error} {offset_error}"
        );
    }
    // What the loop changed is many times that.
    let most = offset.iter().map(|word| word.abs()).max().unwrap();
    assert!(f64::from(most) > 10.0 * limit, "{most} {limit}");
}

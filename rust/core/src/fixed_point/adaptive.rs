//! The adaptive loop with memories of whole numbers.
//!
//! With the word x of the ADC, y = x/2^A and X = g y + o in units of the full scale 2^A, and the mean
//! T of the four neighbours' X, each frame changes the memories by
//!
//! ```text
//! E = T − X,   g ← g + 2^−s E y,   o ← o + 2^−s E
//! ```
//!
//! each change rounded half to even to a step of its memory and limited to its words. X is kept at
//! the full width of its sum. The mean of the gains is then held at 1 and that of the offsets at 0,
//! to whole steps.

use super::arithmetic::{Arithmetic, Format, check_width, round};
use crate::control::Control;
use crate::error::{Error, Result};
use crate::frames::Shape;
use crate::parallel::Workers;

/// Rows that a thread takes at a time.
const ROWS: usize = 16;

/// Largest s: a step of 2⁻¹².
const FINEST: u32 = 12;

/// Widths of the words of the loop, and its step.
#[derive(Clone, Copy, Debug)]
pub struct Loop {
    shape: Shape,
    adc_bits: u32,
    gain_bits: u32,
    offset_bits: u32,
    step: u32,
    arithmetic: Arithmetic,
}

/// The words that the loop changes.
#[derive(Debug)]
pub struct Memories<'a> {
    /// Gains from 0 to 2: 1 is 2^(gain_bits − 1).
    pub gain: &'a mut [u16],
    /// Offsets of at most half the range of the ADC.
    pub offset: &'a mut [i16],
}

/// What one frame changed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Total {
    gain: i64,
    offset: i64,
}

impl Loop {
    /// A loop with the step 2^−step.
    ///
    /// # Errors
    /// [`Error::Value`] if a width or the step is out of range, [`Error::Shape`] if the sensor has
    /// fewer than two rows or columns.
    pub fn new(
        shape: Shape,
        [adc_bits, gain_bits, offset_bits]: [u32; 3],
        step: u32,
    ) -> Result<Self> {
        for (argument, bits) in [("gain_bits", gain_bits), ("offset_bits", offset_bits)] {
            check_width(argument, bits)?;
        }
        check_width("adc_bits", adc_bits)?;
        if shape.rows < 2 || shape.cols < 2 {
            let wanted = "(rows, cols), each 2 or more: pixels are compared with neighbours".into();
            return Err(Error::Shape { argument: "shape", got: shape.to_string(), wanted });
        }
        // Of a chequered pattern E is −2 X, and X changes by 2^−s E (1 + y²): it grows above 1/2 at y = 1.
        if !(1..=FINEST).contains(&step) {
            let problem =
                format!("is 2^-{step}, expected 2^-{FINEST} to 2^-1: above 1/2 the loop diverges");
            return Err(Error::value("step", problem));
        }
        let format = Format {
            adc_bits,
            out_bits: adc_bits,
            adc: 0,
            offset: adc_bits as i32 - offset_bits as i32,
            gain: 1 - gain_bits as i32,
            out: 0,
            base: 0,
        };
        let arithmetic = Arithmetic::new(&format)?;
        Ok(Self { shape, adc_bits, gain_bits, offset_bits, step, arithmetic })
    }

    /// The gain 1.
    #[must_use]
    pub const fn one(&self) -> u16 {
        1 << (self.gain_bits - 1)
    }

    fn largest_gain(&self) -> i64 {
        (1 << self.gain_bits) - 1
    }

    fn largest_offset(&self) -> i64 {
        (1 << (self.offset_bits - 1)) - 1
    }

    /// Changes of gain and offset, in their steps, for four times the error of a sum.
    fn changes(&self, error: i64, word: u16) -> (i64, i64) {
        let common = 2 + self.step;
        let product = error * i64::from(word);
        // In units of the full scale E and y are each 2^A times smaller.
        let gain = round(product, common + 2 * self.adc_bits + self.arithmetic.product_shift());
        (gain, round(error, common + self.arithmetic.offset_shift()))
    }

    fn clamp_gain(&self, gain: i64) -> u16 {
        gain.clamp(0, self.largest_gain()) as u16
    }

    fn clamp_offset(&self, offset: i64) -> i16 {
        offset.clamp(-self.largest_offset() - 1, self.largest_offset()) as i16
    }
}

/// Corrects a frame of words into `out`, then changes the memories.
///
/// # Errors
/// [`Error::Shape`] if an array is of another size; [`Error::Value`] if a word exceeds the largest of
/// the ADC; [`Error::Cancelled`], with the memories as they were.
pub fn adapt(
    run: &Loop,
    memories: &mut Memories<'_>,
    frame: &[u16],
    out: &mut [u16],
    workers: &Workers,
    control: &Control,
) -> Result<()> {
    let size = run.shape.len();
    let lengths = [frame.len(), out.len(), memories.gain.len(), memories.offset.len()];
    if lengths.iter().any(|&length| length != size) {
        let got = format!("{lengths:?} values with 'out', 'gain' and 'offset'");
        let wanted = format!("{} each", run.shape);
        return Err(Error::Shape { argument: "frame", got, wanted });
    }
    run.arithmetic.check_words(frame)?;
    control.check()?;
    let sums = correct(run, memories, frame, out, workers);
    let total = change(run, memories, frame, &sums, workers);
    hold_means(run, memories, total, workers);
    Ok(())
}

/// The sums of all pixels, and the frame that they stand for.
fn correct(
    run: &Loop,
    memories: &Memories<'_>,
    frame: &[u16],
    out: &mut [u16],
    workers: &Workers,
) -> Vec<i64> {
    let (block, mut sums) = (ROWS * run.shape.cols, vec![0; frame.len()]);
    workers.map_pairs(&mut sums, out, [block; 2], |index, sums, out| {
        for (i, (sum, out)) in sums.iter_mut().zip(out).enumerate() {
            let at = index * block + i;
            *sum = run.arithmetic.sum(frame[at], memories.gain[at], memories.offset[at]);
            *out = run.arithmetic.rounded(*sum).clamp(0, run.arithmetic.largest()) as u16;
        }
    });
    sums
}

/// Changes the memories; gives their totals.
fn change(
    run: &Loop,
    memories: &mut Memories<'_>,
    frame: &[u16],
    sums: &[i64],
    workers: &Workers,
) -> Total {
    let block = ROWS * run.shape.cols;
    let totals =
        workers.map_pairs(memories.gain, memories.offset, [block; 2], |index, gains, offsets| {
            let mut total = Total::default();
            for (i, (gain, offset)) in gains.iter_mut().zip(offsets).enumerate() {
                let at = index * block + i;
                let error = neighbours(sums, run.shape, at) - 4 * sums[at];
                let (more_gain, more_offset) = run.changes(error, frame[at]);
                *gain = run.clamp_gain(i64::from(*gain) + more_gain);
                *offset = run.clamp_offset(i64::from(*offset) + more_offset);
                total.gain += i64::from(*gain);
                total.offset += i64::from(*offset);
            }
            total
        });
    let add = |a: Total, b: &Total| Total { gain: a.gain + b.gain, offset: a.offset + b.offset };
    totals.iter().fold(Total::default(), add)
}

/// Sum of the four neighbours; outside of the frame the opposite neighbour takes the place.
fn neighbours(sums: &[i64], shape: Shape, at: usize) -> i64 {
    let (row, col) = (at / shape.cols, at % shape.cols);
    let up = if row > 0 { row - 1 } else { 1 };
    let down = if row + 1 < shape.rows { row + 1 } else { row - 1 };
    let left = if col > 0 { col - 1 } else { 1 };
    let right = if col + 1 < shape.cols { col + 1 } else { col - 1 };
    let value = |row: usize, col: usize| sums[row * shape.cols + col];
    value(up, col) + value(down, col) + value(row, left) + value(row, right)
}

/// Takes whole steps off all words, so that the mean gain is 1 and the mean offset 0.
fn hold_means(run: &Loop, memories: &mut Memories<'_>, total: Total, workers: &Workers) {
    let size = run.shape.len() as i64;
    let gain = divided(total.gain - size * i64::from(run.one()), size);
    let offset = divided(total.offset, size);
    if gain == 0 && offset == 0 {
        return;
    }
    let block = ROWS * run.shape.cols;
    workers.map_pairs(memories.gain, memories.offset, [block; 2], |_, gains, offsets| {
        for (own_gain, own_offset) in gains.iter_mut().zip(offsets) {
            *own_gain = run.clamp_gain(i64::from(*own_gain) - gain);
            *own_offset = run.clamp_offset(i64::from(*own_offset) - offset);
        }
    });
}

/// A quotient rounded half to even; `by` is above 0.
fn divided(value: i64, by: i64) -> i64 {
    let (floor, rest) = (value.div_euclid(by), value.rem_euclid(by));
    let up = 2 * rest > by || (2 * rest == by && floor & 1 == 1);
    floor + i64::from(up)
}

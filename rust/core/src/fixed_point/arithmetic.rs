//! Whole numbers in place of fractions: formats, sums, the rounding.

use std::ops::RangeInclusive;

use crate::error::{Error, Result};

/// Widths of words, in bits.
const WIDTHS: RangeInclusive<u32> = 1..=16;

/// Exponents of steps: from 2⁻⁴⁰ to 2⁴⁰ DN.
const EXPONENTS: RangeInclusive<i32> = -40..=40;

/// Most bits that a term of a sum may take, so that sums of eight of them fit 64 bits.
const TERM: u32 = 58;

/// Widths of the words beside the memories, the powers of two that steps stand for, and the base.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Format {
    /// Bits of the ADC.
    pub adc_bits: u32,
    /// Bits of the output.
    pub out_bits: u32,
    /// A step of the ADC is 2^adc DN.
    pub adc: i32,
    /// A step of the offset is 2^offset DN.
    pub offset: i32,
    /// A step of the gain is 2^gain.
    pub gain: i32,
    /// A step of the output is 2^out DN.
    pub out: i32,
    /// Output of a sum of 0, in steps of the output.
    pub base: i32,
}

/// The arithmetic of a format: how far each term is raised, and how far their sum is lowered.
#[derive(Clone, Copy, Debug)]
pub struct Arithmetic {
    product: u32,
    offset: u32,
    out: u32,
    base: i64,
    largest: i64,
    largest_word: u16,
}

impl Arithmetic {
    /// The arithmetic of a format.
    ///
    /// # Errors
    /// [`Error::Value`] if a width or an exponent is out of range, or the sums need more than 64 bits.
    pub fn new(format: &Format) -> Result<Self> {
        for (argument, bits) in [("adc_bits", format.adc_bits), ("out_bits", format.out_bits)] {
            check_width(argument, bits)?;
        }
        let exponents = [format.adc, format.offset, format.gain, format.out];
        if exponents.iter().any(|exponent| !EXPONENTS.contains(exponent)) {
            let problem = format!("are {exponents:?}, expected -40 to 40");
            return Err(Error::value("exponents", problem));
        }
        let product = format.gain + format.adc;
        let lowest = product.min(format.offset).min(format.out);
        let above = |exponent: i32| (exponent - lowest).unsigned_abs();
        let made = Self {
            product: above(product),
            offset: above(format.offset),
            out: above(format.out),
            base: i64::from(format.base),
            largest: (1 << format.out_bits) - 1,
            largest_word: u16::MAX >> (16 - format.adc_bits),
        };
        let bits = (32 + made.product).max(16 + made.offset).max(made.out);
        if bits > TERM {
            let problem = format!(
                "are {exponents:?}, whose sums take {bits} bits, expected at most {TERM}: take \
                 steps that differ less"
            );
            return Err(Error::value("exponents", problem));
        }
        Ok(made)
    }

    /// Gain times word plus offset, exactly, in steps of the finest of the three terms.
    #[inline(always)]
    #[must_use]
    pub fn sum(&self, word: u16, gain: u16, offset: i16) -> i64 {
        let product = i64::from(gain) * i64::from(word);
        (product << self.product) + (i64::from(offset) << self.offset)
    }

    /// The output that a sum stands for, before it is limited.
    #[inline(always)]
    #[must_use]
    pub fn rounded(&self, sum: i64) -> i64 {
        self.base + round(sum, self.out)
    }

    /// Largest word of the output.
    #[inline(always)]
    #[must_use]
    pub const fn largest(&self) -> i64 {
        self.largest
    }

    /// Bits by which a step of the offset exceeds that of a sum.
    pub(super) const fn offset_shift(&self) -> u32 {
        self.offset
    }

    /// Bits by which a step of gain times word exceeds that of a sum.
    pub(super) const fn product_shift(&self) -> u32 {
        self.product
    }

    /// [`Error::Value`] if a word exceeds the largest of the ADC.
    ///
    /// # Errors
    /// As above.
    pub fn check_words(&self, words: &[u16]) -> Result<()> {
        match words.iter().max() {
            Some(&highest) if highest > self.largest_word => {
                let problem = format!(
                    "holds {highest}, above {}, the largest word of the ADC: frames of another \
                     camera or width",
                    self.largest_word
                );
                Err(Error::value("frames", problem))
            }
            _ => Ok(()),
        }
    }
}

/// A whole number divided by 2^bits, rounded half to even.
#[inline(always)]
pub(super) const fn round(value: i64, bits: u32) -> i64 {
    if bits == 0 {
        return value;
    }
    let odd = (value >> bits) & 1;
    (value + (1 << (bits - 1)) - 1 + odd) >> bits
}

/// A width that a word may have.
pub(super) fn check_width(argument: &'static str, bits: u32) -> Result<()> {
    if WIDTHS.contains(&bits) {
        return Ok(());
    }
    Err(Error::value(argument, format!("is {bits}, expected 1 to 16")))
}

#[cfg(test)]
mod tests {
    use super::round;

    #[test]
    fn halves_go_to_even_on_both_sides_of_zero() {
        for bits in [1, 2, 5] {
            let step = 1_i64 << bits;
            for value in -3 * step..=3 * step {
                let exact = value as f64 / step as f64;
                assert_eq!(round(value, bits) as f64, exact.round_ties_even(), "{value} {bits}");
            }
        }
        assert_eq!(round(-7, 0), -7);
    }
}

//! The words of all pixels, applied to frames.

use std::sync::atomic::{AtomicU64, Ordering};

use super::arithmetic::Arithmetic;
use crate::control::Control;
use crate::error::{Error, Result};
use crate::frames::Shape;
use crate::parallel::Workers;

/// Pixels that a thread corrects at a time.
const BLOCK: usize = 1 << 15;

/// Gains and offsets of all pixels; a gain of 0 marks a pixel that must not be used.
#[derive(Clone, Copy, Debug)]
pub struct Table<'a> {
    shape: Shape,
    gain: &'a [u16],
    offset: &'a [i16],
    arithmetic: Arithmetic,
}

/// Numbers of outputs that were limited to 0 and to the largest word.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Limited {
    /// Outputs below 0.
    pub below: u64,
    /// Outputs above the largest word.
    pub above: u64,
}

impl<'a> Table<'a> {
    /// A view of the words.
    ///
    /// # Errors
    /// [`Error::Shape`] if there is not one of each for each pixel.
    pub fn new(
        shape: Shape,
        gain: &'a [u16],
        offset: &'a [i16],
        arithmetic: Arithmetic,
    ) -> Result<Self> {
        for (argument, length) in [("gain", gain.len()), ("offset", offset.len())] {
            if shape.is_empty() || length != shape.len() {
                return Err(Error::Shape {
                    argument,
                    got: format!("{length} words"),
                    wanted: format!("{shape}, one word for each pixel"),
                });
            }
        }
        Ok(Self { shape, gain, offset, arithmetic })
    }

    /// Corrects frames of words of the ADC; a pixel that must not be used becomes 0.
    ///
    /// # Errors
    /// [`Error::Shape`] if an array holds no whole number of frames, or the two differ in size;
    /// [`Error::Value`] if a word exceeds the largest of the ADC; [`Error::Cancelled`].
    pub fn apply(
        &self,
        frames: &[u16],
        out: &mut [u16],
        workers: &Workers,
        control: &Control,
    ) -> Result<Limited> {
        let size = self.shape.len();
        for (argument, length) in [("frames", frames.len()), ("out", out.len())] {
            if !length.is_multiple_of(size) || length != frames.len() {
                return Err(Error::Shape {
                    argument,
                    got: format!("{length} values"),
                    wanted: format!("{}", self.shape),
                });
            }
        }
        self.arithmetic.check_words(frames)?;
        let (below, above) = (AtomicU64::new(0), AtomicU64::new(0));
        for (frame, out) in frames.chunks(size).zip(out.chunks_mut(size)) {
            control.check()?;
            workers.map_blocks(out, BLOCK, |index, part| {
                let limited = self.correct_block(frame, index * BLOCK, part);
                below.fetch_add(limited.below, Ordering::Relaxed);
                above.fetch_add(limited.above, Ordering::Relaxed);
            });
        }
        Ok(Limited { below: below.into_inner(), above: above.into_inner() })
    }

    fn correct_block(&self, frame: &[u16], at: usize, out: &mut [u16]) -> Limited {
        let mut limited = Limited::default();
        let (end, largest) = (at + out.len(), self.arithmetic.largest());
        let words = self.gain[at..end].iter().zip(&self.offset[at..end]);
        for ((out, &word), (&gain, &offset)) in out.iter_mut().zip(&frame[at..end]).zip(words) {
            if gain == 0 {
                *out = 0;
                continue;
            }
            let value = self.arithmetic.rounded(self.arithmetic.sum(word, gain, offset));
            limited.below += u64::from(value < 0);
            limited.above += u64::from(value > largest);
            *out = value.clamp(0, largest) as u16;
        }
        limited
    }
}

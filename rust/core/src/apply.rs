//! Corrections applied to frames at the rate of memory.
//!
//! A corrected value is a polynomial of the raw value y with coefficients of the pixel's own,
//!
//! ```text
//! c_0 + y (c_1 + y (c_2 + y c_3))
//! ```
//!
//! in single precision, by Horner's scheme. For whole numbers it is rounded, half to even, and limited
//! to what the type, or the camera's bits, can hold. Of bytes that must move, a frame of 16 bits with
//! gain and offset has 12 a pixel: two of the frame, two of the result, eight of the coefficients.
//!
//! The product and the sum are rounded one by one, not fused: the same bytes come out on every
//! processor.

use std::sync::{Mutex, PoisonError};

use crate::control::Control;
use crate::error::{Error, Result};
use crate::frames::{Shape, Stack};
use crate::parallel::Workers;

/// Pixels that a thread corrects at a time.
const BLOCK: usize = 1 << 15;

/// Most pixels that the calling thread corrects alone: a quarter of a millisecond, in which other
/// threads would hardly have started.
const ALONE: usize = 1 << 20;

/// Largest number of coefficients: those of a cubic.
const PLANES: usize = 4;

/// 2²³: a number from 0 to 2²³ added to it keeps its whole part alone, rounded half to even, in the
/// low bits.
const WHOLE: f32 = 8_388_608.0;

/// A raw value as a frame has it.
pub trait Raw: Copy + Send + Sync {
    /// The value in single precision.
    fn value(self) -> f32;
}

/// A corrected value.
pub trait Corrected: Copy + Send + Sync {
    /// The value of `corrected`, at most `largest`, and whether it had to be changed for that.
    fn of(corrected: f32, largest: f32) -> (Self, bool);
}

macro_rules! whole_numbers {
    ($($kind:ty),*) => {$(
        impl Raw for $kind {
            #[inline(always)]
            fn value(self) -> f32 {
                f32::from(self)
            }
        }

        impl Corrected for $kind {
            #[inline(always)]
            fn of(corrected: f32, largest: f32) -> (Self, bool) {
                // What is not a number becomes 0 here, and counts as changed.
                let limited = corrected.max(0.0).min(largest);
                let held = corrected >= -0.5 && corrected < largest + 0.5;
                ((limited + WHOLE).to_bits() as $kind, !held)
            }
        }
    )*};
}

whole_numbers!(u8, u16);

impl Raw for f32 {
    #[inline(always)]
    fn value(self) -> f32 {
        self
    }
}

impl Corrected for f32 {
    #[inline(always)]
    fn of(corrected: f32, _: f32) -> (Self, bool) {
        (corrected, false)
    }
}

/// What becomes of pixels that must not be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unusable {
    /// They are corrected like the others.
    Kept,
    /// Not a number; 0 where the result is of whole numbers.
    Blank,
    /// The mean of the nearest usable pixels.
    Replaced,
}

/// A correction prepared for many frames.
#[derive(Debug)]
pub struct Corrector {
    shape: Shape,
    coefficients: Vec<f32>,
    planes: usize,
    repairs: Repairs,
    /// Values of replaced pixels of the frame at hand, kept so that no frame allocates.
    repaired: Mutex<Vec<f32>>,
}

impl Corrector {
    /// Prepares coefficients, one plane a power of y, lowest first.
    ///
    /// # Errors
    /// [`Error::Shape`] if there are more than four planes or `unusable` is of another size.
    pub fn new(coefficients: Stack<'_, f32>, unusable: &[bool], then: Unusable) -> Result<Self> {
        let (shape, planes) = (coefficients.shape(), coefficients.count());
        if planes == 0 || planes > PLANES || unusable.len() != shape.len() {
            return Err(Error::Shape {
                argument: "coefficients",
                got: format!("({planes}, {}, {})", shape.rows, shape.cols),
                wanted: format!("(1 to {PLANES}, rows, columns) and a mask of as many pixels"),
            });
        }
        let mut coefficients = coefficients.data().to_vec();
        let repairs = match then {
            Unusable::Replaced => Repairs::of(shape, unusable),
            Unusable::Kept | Unusable::Blank => Repairs::default(),
        };
        if then != Unusable::Kept {
            for pixel in (0..shape.len()).filter(|&pixel| unusable[pixel]) {
                set(&mut coefficients, shape, pixel, f32::NAN);
            }
        }
        for &pixel in &repairs.pixels {
            // So the first pass counts no value of theirs as limited.
            set(&mut coefficients, shape, pixel as usize, 0.0);
        }
        let repaired = Mutex::new(vec![0.0; repairs.pixels.len()]);
        Ok(Self { shape, coefficients, planes, repairs, repaired })
    }

    /// Sizes of a frame.
    #[must_use]
    pub const fn shape(&self) -> Shape {
        self.shape
    }

    /// Corrects a frame into `out`; gives the number of values that had to be limited to 0 and
    /// `largest`, which is an odd number.
    ///
    /// # Errors
    /// [`Error::Shape`] if an array is of another size than the sensor; [`Error::Cancelled`].
    pub fn apply<I: Raw, O: Corrected>(
        &self,
        frame: &[I],
        out: &mut [O],
        largest: f32,
        workers: &Workers,
        control: &Control,
    ) -> Result<u64> {
        for (argument, length) in [("frames", frame.len()), ("out", out.len())] {
            if length != self.shape.len() {
                return Err(Error::Shape {
                    argument,
                    got: format!("{length} values"),
                    wanted: format!("{}", self.shape),
                });
            }
        }
        let correct = |index: usize, block: &mut [O]| {
            control.check()?;
            let at = index * BLOCK;
            Ok(self.correct_block(at, &frame[at..at + block.len()], block, largest))
        };
        let limited: Result<u64> = if out.len() <= ALONE {
            out.chunks_mut(BLOCK).enumerate().map(|(index, block)| correct(index, block)).sum()
        } else {
            workers.map_blocks(out, BLOCK, correct).into_iter().sum()
        };
        Ok(limited? + self.repair(frame, out, largest))
    }

    /// Coefficients of power `power` from pixel `at` on.
    fn plane(&self, power: usize, at: usize, length: usize) -> &[f32] {
        &self.coefficients[power * self.shape.len() + at..][..length]
    }

    fn correct_block<I: Raw, O: Corrected>(
        &self,
        at: usize,
        frame: &[I],
        out: &mut [O],
        largest: f32,
    ) -> u64 {
        let plane = |power| self.plane(power, at, frame.len());
        let arch = pulp::Arch::new();
        match self.planes {
            1 => arch.dispatch(Block { frame, planes: [plane(0)], out, largest }),
            2 => arch.dispatch(Block { frame, planes: [plane(0), plane(1)], out, largest }),
            3 => {
                let planes = [plane(0), plane(1), plane(2)];
                arch.dispatch(Block { frame, planes, out, largest })
            }
            _ => {
                let planes = [plane(0), plane(1), plane(2), plane(3)];
                arch.dispatch(Block { frame, planes, out, largest })
            }
        }
    }

    /// The corrected value of one pixel.
    fn value<I: Raw>(&self, frame: &[I], pixel: usize) -> f32 {
        let y = frame[pixel].value();
        (0..self.planes)
            .rev()
            .fold(0.0, |sum, power| sum * y + self.coefficients[power * self.shape.len() + pixel])
    }

    /// Replaces pixels by the means of their sources; gives the number of values limited.
    fn repair<I: Raw, O: Corrected>(&self, frame: &[I], out: &mut [O], largest: f32) -> u64 {
        let mut repaired = self.repaired.lock().unwrap_or_else(PoisonError::into_inner);
        let mut limited = 0;
        for (index, &pixel) in self.repairs.pixels.iter().enumerate() {
            // A value that is not a number counts in no mean, so it does not spread.
            let (mut sum, mut count) = (0.0, 0_u32);
            for source in self.repairs.sources(index) {
                let value = match *source {
                    Source::Pixel(pixel) => self.value(frame, pixel as usize),
                    Source::Repaired(before) => repaired[before as usize],
                };
                if !value.is_nan() {
                    sum += value;
                    count += 1;
                }
            }
            repaired[index] = sum / count as f32;
            let (value, changed) = O::of(repaired[index], largest);
            out[pixel as usize] = value;
            limited += u64::from(changed);
        }
        limited
    }
}

/// Gives a pixel one value for all its coefficients.
fn set(coefficients: &mut [f32], shape: Shape, pixel: usize, value: f32) {
    coefficients.iter_mut().skip(pixel).step_by(shape.len()).for_each(|each| *each = value);
}

/// Pixels of one block, with their coefficients.
struct Block<'s, I, O, const N: usize> {
    frame: &'s [I],
    planes: [&'s [f32]; N],
    out: &'s mut [O],
    largest: f32,
}

impl<I: Raw, O: Corrected, const N: usize> pulp::NullaryFnOnce for Block<'_, I, O, N> {
    type Output = u64;

    #[inline(always)]
    fn call(self) -> u64 {
        let mut limited = 0_u32;
        let length = self.out.len();
        let (frame, planes) = (&self.frame[..length], self.planes.map(|plane| &plane[..length]));
        for (i, out) in self.out.iter_mut().enumerate() {
            let y = frame[i].value();
            let mut sum = planes[N - 1][i];
            for power in (0..N - 1).rev() {
                sum = sum * y + planes[power][i];
            }
            let (value, changed) = O::of(sum, self.largest);
            *out = value;
            limited += u32::from(changed);
        }
        u64::from(limited)
    }
}

/// What a replaced pixel is the mean of.
#[derive(Clone, Copy, Debug)]
enum Source {
    /// A usable pixel.
    Pixel(u32),
    /// A pixel replaced before, by its number among these.
    Repaired(u32),
}

/// Pixels to replace, in such an order that each follows those that it needs.
#[derive(Debug, Default)]
struct Repairs {
    pixels: Vec<u32>,
    /// Where the sources of each begin; one more than pixels.
    starts: Vec<usize>,
    all: Vec<Source>,
}

impl Repairs {
    fn sources(&self, index: usize) -> &[Source] {
        &self.all[self.starts[index]..self.starts[index + 1]]
    }

    /// Round by round: a pixel takes the mean of those of its eight neighbours that are usable, or
    /// were replaced in a round before.
    fn of(shape: Shape, unusable: &[bool]) -> Self {
        const WAITS: u32 = u32::MAX;
        const USABLE: u32 = u32::MAX - 1;
        let mut state: Vec<u32> =
            unusable.iter().map(|&unusable| if unusable { WAITS } else { USABLE }).collect();
        let mut found = Self { starts: vec![0], ..Self::default() };
        let mut waiting: Vec<usize> = (0..state.len()).filter(|&p| state[p] == WAITS).collect();
        loop {
            let before = found.pixels.len();
            waiting.retain(|&pixel| {
                let known = neighbours(shape, pixel).filter(|&q| state[q] != WAITS);
                let sources = known.map(|q| match state[q] {
                    USABLE => Source::Pixel(q as u32),
                    index => Source::Repaired(index),
                });
                let start = found.all.len();
                found.all.extend(sources);
                let ready = found.all.len() > start;
                if ready {
                    found.pixels.push(pixel as u32);
                    found.starts.push(found.all.len());
                }
                !ready
            });
            for index in before..found.pixels.len() {
                state[found.pixels[index] as usize] = index as u32;
            }
            if found.pixels.len() == before {
                return found;
            }
        }
    }
}

/// The up to eight neighbours of a pixel.
fn neighbours(shape: Shape, pixel: usize) -> impl Iterator<Item = usize> {
    let (row, col) = (pixel / shape.cols, pixel % shape.cols);
    let rows = row.saturating_sub(1)..=(row + 1).min(shape.rows - 1);
    rows.flat_map(move |r| {
        let cols = col.saturating_sub(1)..=(col + 1).min(shape.cols - 1);
        cols.map(move |c| r * shape.cols + c)
    })
    .filter(move |&q| q != pixel)
}

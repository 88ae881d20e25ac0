//! Corrections applied to frames at the rate of memory.
//!
//! A corrected value is a polynomial of the raw value y with coefficients of the pixel's own,
//!
//! ```text
//! c_0 + y (c_1 + y (c_2 + y c_3))
//! ```
//!
//! in single or double precision, by Horner's scheme. For whole numbers it is rounded, half to even, and
//! limited to what the type, or the camera's bits, can hold. Of bytes that must move, a frame of 16 bits with
//! gain and offset has 12 a pixel: two of the frame, two of the result, eight of the coefficients.
//!
//! The product and the sum are rounded one by one, not fused: the same bytes come out on every
//! processor.

use std::cell::RefCell;
use std::ops::{Add, Div, Mul};
use std::sync::atomic::{AtomicU64, Ordering};

use crate::control::Control;
use crate::error::{Error, Result};
use crate::frames::{Real, Shape, Stack};
use crate::parallel::Workers;

/// Pixels that a thread corrects at a time.
const BLOCK: usize = 1 << 15;

/// Most pixels that the calling thread corrects with at most one thread beside it: a quarter of a millisecond, in
/// which more threads would hardly have started. Of larger stacks each thread takes whole frames, and of larger
/// frames blocks.
const BRIEF: usize = 1 << 20;

/// Largest number of coefficients: those of a cubic.
const PLANES: usize = 4;

/// 2²³: a number from 0 to 2²³ added to it keeps its whole part alone, rounded half to even, in the
/// low bits.
const WHOLE: f32 = 8_388_608.0;

/// The precision in which values are corrected: single or double.
pub trait Precision:
    Real + Raw<Self> + Corrected<Self> + Add<Output = Self> + Mul<Output = Self> + Div<Output = Self>
{
    /// Bits of a number, as a whole number with a sign.
    type Bits: Ord + Copy + Default;

    /// What is not a number.
    const NAN: Self;

    /// The difference between 1 and the next larger number.
    const EPSILON: f64;

    /// The number of this precision that is nearest.
    fn nearest(value: f64) -> Self;

    /// Bits of the number, which for numbers from 0 on have their order and for others are not above
    /// 0; what is not a number is 0. A maximum of them is found in vector registers, one of numbers is
    /// not.
    fn order(self) -> Self::Bits;

    /// The number of these bits.
    fn ordered(bits: Self::Bits) -> f64;

    /// Whether it is not a number.
    fn is_nan(self) -> bool;
}

/// A raw value as a frame has it.
pub trait Raw<T>: Copy + Send + Sync {
    /// The value in the precision of the correction.
    fn value(self) -> T;
}

/// A corrected value.
pub trait Corrected<T>: Copy + Send + Sync {
    /// The value of `corrected`, at most `largest`, and whether it had to be changed for that.
    fn of(corrected: T, largest: T) -> (Self, bool);
}

macro_rules! whole_numbers {
    ($($kind:ty),*) => {$(
        impl Raw<f32> for $kind {
            #[inline(always)]
            fn value(self) -> f32 {
                f32::from(self)
            }
        }

        impl Corrected<f32> for $kind {
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

macro_rules! precisions {
    ($($kind:ident as $bits:ty),*) => {$(
        impl Precision for $kind {
            type Bits = $bits;

            const NAN: Self = $kind::NAN;

            const EPSILON: f64 = $kind::EPSILON as f64;

            #[inline(always)]
            fn nearest(value: f64) -> Self {
                value as $kind
            }

            #[inline(always)]
            fn order(self) -> $bits {
                if self.is_nan() { 0 } else { self.to_bits().cast_signed() }
            }

            #[inline(always)]
            fn ordered(bits: $bits) -> f64 {
                $kind::from_bits(bits.cast_unsigned()).into()
            }

            #[inline(always)]
            fn is_nan(self) -> bool {
                self.is_nan()
            }
        }

        impl Raw<$kind> for $kind {
            #[inline(always)]
            fn value(self) -> $kind {
                self
            }
        }

        impl Corrected<$kind> for $kind {
            #[inline(always)]
            fn of(corrected: $kind, _: $kind) -> (Self, bool) {
                (corrected, false)
            }
        }
    )*};
}

precisions!(f32 as i32, f64 as i64);

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

/// Which pixels stand for one another.
#[derive(Clone, Copy, Debug)]
pub struct Alike<'a> {
    /// Number of the colour of each pixel; none where all are of one.
    pub colours: Option<&'a [u8]>,
    /// Most rows and columns from a pixel to one of its colour.
    pub reach: usize,
}

impl Alike<'_> {
    /// All pixels are of one colour.
    pub const ALL: Self = Self { colours: None, reach: 1 };

    /// Whether two pixels are of one colour.
    fn are(&self, one: usize, other: usize) -> bool {
        self.colours.is_none_or(|colours| colours[one] == colours[other])
    }
}

/// What was found in frames while they were corrected.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Counts {
    /// Values that had to be limited to 0 and the largest.
    pub limited: u64,
    /// Values that were corrected to below the lowest or above the highest level of their pixel.
    pub extrapolated: u64,
    /// The largest raw value; 0 where none is above 0.
    pub highest: f64,
}

/// Counts to which several threads add.
#[derive(Debug, Default)]
struct Tally {
    limited: AtomicU64,
    extrapolated: AtomicU64,
    /// Bits of a number that is not negative: their order is that of the numbers.
    highest: AtomicU64,
}

impl Tally {
    fn add(&self, counts: Counts) {
        self.limited.fetch_add(counts.limited, Ordering::Relaxed);
        self.extrapolated.fetch_add(counts.extrapolated, Ordering::Relaxed);
        self.highest.fetch_max(counts.highest.to_bits(), Ordering::Relaxed);
    }

    fn counts(self) -> Counts {
        Counts {
            limited: self.limited.into_inner(),
            extrapolated: self.extrapolated.into_inner(),
            highest: f64::from_bits(self.highest.into_inner()),
        }
    }
}

/// Lowest and highest level that a correction was measured at.
#[derive(Debug)]
struct Range<T> {
    /// Of the pixel with the most levels.
    widest: [T; 2],
    /// Pixels with fewer levels, and their own.
    narrower: Vec<(u32, [T; 2])>,
}

impl<T: Precision> Range<T> {
    /// That of all numbers.
    fn everything() -> Self {
        Self { widest: [f64::NEG_INFINITY, f64::INFINITY].map(T::nearest), narrower: Vec::new() }
    }

    /// From the levels of each pixel, all lowest ones first; what is not a number has no range.
    fn of(levels: &[f32], size: usize) -> Self {
        let (low, high) = levels.split_at(size);
        let each = || low.iter().zip(high).map(|(&low, &high)| widened([low, high].map(f64::from)));
        let union = |[low, high]: [f64; 2], [l, h]: [f64; 2]| [low.min(l), high.max(h)];
        let widest = each().fold([f64::INFINITY, f64::NEG_INFINITY], union);
        let own = (0..).zip(each()).filter(|(_, range)| *range != widest && range[0] <= range[1]);
        let narrower = own.map(|(pixel, range)| (pixel, range.map(T::nearest))).collect();
        Self { widest: widest.map(T::nearest), narrower }
    }
}

/// A range with the roundings of a polynomial in single precision, so that a value at a level is in it.
fn widened([low, high]: [f64; 2]) -> [f64; 2] {
    let rounding = 8.0 * <f32 as Precision>::EPSILON * low.abs().max(high.abs());
    [low - rounding, high + rounding].map(|end| f64::from(end as f32))
}

/// Whether a value is outside; what is not a number is not.
#[inline(always)]
fn is_outside<T: Precision>(value: T, [low, high]: [T; 2]) -> bool {
    (value < low) | (value > high)
}

thread_local! {
    /// Values of replaced pixels of the frame at hand, kept so that no frame allocates.
    static REPAIRED: RefCell<Vec<f64>> = const { RefCell::new(Vec::new()) };
}

/// A correction prepared for many frames.
#[derive(Debug)]
pub struct Corrector<T = f32> {
    shape: Shape,
    coefficients: Vec<T>,
    planes: usize,
    repairs: Repairs,
    range: Range<T>,
}

impl<T: Precision> Corrector<T> {
    /// Prepares coefficients, one plane a power of y, lowest first.
    ///
    /// # Errors
    /// [`Error::Shape`] if there are more than four planes, or `unusable` or the colours are of another
    /// size.
    pub fn new(
        coefficients: Stack<'_, T>,
        unusable: &[bool],
        then: Unusable,
        alike: Alike<'_>,
    ) -> Result<Self> {
        let (shape, planes) = (coefficients.shape(), coefficients.count());
        let fits = alike.colours.is_none_or(|colours| colours.len() == shape.len());
        if planes == 0 || planes > PLANES || unusable.len() != shape.len() || !fits {
            return Err(Error::Shape {
                argument: "coefficients",
                got: format!("({planes}, {}, {})", shape.rows, shape.cols),
                wanted: format!(
                    "(1 to {PLANES}, rows, columns), mask and colours of as many pixels"
                ),
            });
        }
        let mut coefficients = coefficients.data().to_vec();
        let repairs = match then {
            Unusable::Replaced => Repairs::of(shape, unusable, alike),
            Unusable::Kept | Unusable::Blank => Repairs::default(),
        };
        if then != Unusable::Kept {
            for pixel in (0..shape.len()).filter(|&pixel| unusable[pixel]) {
                coefficients.iter_mut().skip(pixel).step_by(shape.len()).for_each(|each| {
                    *each = T::NAN;
                });
            }
        }
        Ok(Self { shape, coefficients, planes, repairs, range: Range::everything() })
    }

    /// Counts values that are corrected to outside of these levels: the lowest of each pixel, then
    /// the highest of each.
    ///
    /// # Errors
    /// [`Error::Shape`] if `levels` is of another size.
    pub fn with_levels(self, levels: Stack<'_, f32>) -> Result<Self> {
        if levels.count() != 2 || levels.shape() != self.shape {
            let shape = levels.shape();
            return Err(Error::Shape {
                argument: "levels",
                got: format!("({}, {}, {})", levels.count(), shape.rows, shape.cols),
                wanted: format!("(2, {}, {})", self.shape.rows, self.shape.cols),
            });
        }
        Ok(Self { range: Range::of(levels.data(), self.shape.len()), ..self })
    }

    /// Sizes of a frame.
    #[must_use]
    pub const fn shape(&self) -> Shape {
        self.shape
    }

    /// Corrects frames into `out`; `largest`, to which values are limited, is an odd number.
    ///
    /// # Errors
    /// [`Error::Shape`] if an array holds no whole number of frames, or the two differ in size;
    /// [`Error::Cancelled`].
    pub fn apply<I: Raw<T>, O: Corrected<T>>(
        &self,
        frames: &[I],
        out: &mut [O],
        largest: T,
        workers: &Workers,
        control: &Control,
    ) -> Result<Counts> {
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
        let tally = Tally::default();
        let half = size.div_ceil(2).max(BLOCK);
        let correct = |at: usize, frame: &[I], block: &mut [O]| {
            if !control.is_cancelled() {
                let length = block.len();
                tally.add(self.correct_block(at, &frame[at..at + length], block, largest));
            }
        };
        let each = frames.chunks(size).zip(out.chunks_mut(size));
        // Threads give back results of no size, for which nothing is allocated.
        if frames.len() <= BRIEF {
            for (frame, out) in each {
                // The same half by the same thread, whose cache holds the coefficients.
                let halves = out.chunks_mut(half).enumerate();
                workers.share(halves, |(index, part)| correct(index * half, frame, part));
                self.finish(frame, out, largest, &tally);
            }
        } else if size <= BRIEF {
            workers.map_blocks(out, size, |index, out| {
                let frame = &frames[index * size..][..size];
                let blocks = out.chunks_mut(BLOCK).enumerate();
                blocks.for_each(|(index, part)| correct(index * BLOCK, frame, part));
                self.finish(frame, out, largest, &tally);
            });
        } else {
            for (frame, out) in each {
                workers.map_blocks(out, BLOCK, |index, part| correct(index * BLOCK, frame, part));
                self.finish(frame, out, largest, &tally);
            }
        }
        control.check()?;
        Ok(tally.counts())
    }

    /// Coefficients of power `power` from pixel `at` on.
    fn plane(&self, power: usize, at: usize, length: usize) -> &[T] {
        &self.coefficients[power * self.shape.len() + at..][..length]
    }

    fn correct_block<I: Raw<T>, O: Corrected<T>>(
        &self,
        at: usize,
        frame: &[I],
        out: &mut [O],
        largest: T,
    ) -> Counts {
        let plane = |power| self.plane(power, at, frame.len());
        let (arch, range) = (pulp::Arch::new(), self.range.widest);
        match self.planes {
            1 => arch.dispatch(Block { frame, planes: [plane(0)], out, largest, range }),
            2 => arch.dispatch(Block { frame, planes: [plane(0), plane(1)], out, largest, range }),
            3 => {
                let planes = [plane(0), plane(1), plane(2)];
                arch.dispatch(Block { frame, planes, out, largest, range })
            }
            _ => {
                let planes = [plane(0), plane(1), plane(2), plane(3)];
                arch.dispatch(Block { frame, planes, out, largest, range })
            }
        }
    }

    /// The corrected value of one pixel.
    fn value<I: Raw<T>>(&self, frame: &[I], pixel: usize) -> T {
        let y = frame[pixel].value();
        (0..self.planes).rev().fold(T::nearest(0.0), |sum, power| {
            sum * y + self.coefficients[power * self.shape.len() + pixel]
        })
    }

    /// Replaces pixels of a frame whose blocks are corrected, and counts what the blocks cannot.
    fn finish<I: Raw<T>, O: Corrected<T>>(
        &self,
        frame: &[I],
        out: &mut [O],
        largest: T,
        tally: &Tally,
    ) {
        let narrower = self.range.narrower.iter().filter(|(pixel, range)| {
            let value = self.value(frame, *pixel as usize);
            is_outside(value, *range) && !is_outside(value, self.range.widest)
        });
        tally.extrapolated.fetch_add(narrower.count() as u64, Ordering::Relaxed);
        tally.limited.fetch_add(self.repair(frame, out, largest), Ordering::Relaxed);
        // Their coefficients are not numbers, and so were their values in the blocks.
        let before = u64::from(O::of(T::NAN, largest).1) * self.repairs.pixels.len() as u64;
        tally.limited.fetch_sub(before, Ordering::Relaxed);
    }

    /// Replaces pixels by the means of their sources; gives the number of values limited.
    fn repair<I: Raw<T>, O: Corrected<T>>(&self, frame: &[I], out: &mut [O], largest: T) -> u64 {
        REPAIRED.with_borrow_mut(|repaired| {
            repaired.clear();
            let mut limited = 0;
            for (index, &pixel) in self.repairs.pixels.iter().enumerate() {
                let mean = self.mean_of(self.repairs.sources(index), frame, repaired);
                repaired.push(mean.to_f64());
                let (value, changed) = O::of(mean, largest);
                out[pixel as usize] = value;
                limited += u64::from(changed);
            }
            limited
        })
    }

    /// Mean of the sources of a pixel. A value that is not a number does not count, so it does not
    /// spread.
    fn mean_of<I: Raw<T>>(&self, sources: &[Source], frame: &[I], repaired: &[f64]) -> T {
        let (mut sum, mut count) = (T::nearest(0.0), 0_u32);
        for source in sources {
            let value = match *source {
                Source::Pixel(pixel) => self.value(frame, pixel as usize),
                Source::Repaired(before) => T::nearest(repaired[before as usize]),
            };
            if !value.is_nan() {
                sum = sum + value;
                count += 1;
            }
        }
        sum / T::nearest(count.into())
    }
}

/// Pixels of one block, with their coefficients.
struct Block<'s, T, I, O, const N: usize> {
    frame: &'s [I],
    planes: [&'s [T]; N],
    out: &'s mut [O],
    largest: T,
    range: [T; 2],
}

impl<T: Precision, I: Raw<T>, O: Corrected<T>, const N: usize> pulp::NullaryFnOnce
    for Block<'_, T, I, O, N>
{
    type Output = Counts;

    #[inline(always)]
    fn call(self) -> Counts {
        let (mut limited, mut extrapolated, mut highest) = (0_u32, 0_u32, T::Bits::default());
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
            extrapolated += u32::from(is_outside(sum, self.range));
            highest = highest.max(y.order());
        }
        Counts {
            limited: limited.into(),
            extrapolated: extrapolated.into(),
            highest: T::ordered(highest),
        }
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
    /// were replaced in a round before; of colours, of the nearest square around it with such pixels of
    /// its own.
    fn of(shape: Shape, unusable: &[bool], alike: Alike<'_>) -> Self {
        const WAITS: u32 = u32::MAX;
        const USABLE: u32 = u32::MAX - 1;
        let mut state: Vec<u32> =
            unusable.iter().map(|&unusable| if unusable { WAITS } else { USABLE }).collect();
        let mut found = Self { starts: vec![0], ..Self::default() };
        let mut waiting: Vec<usize> = (0..state.len()).filter(|&p| state[p] == WAITS).collect();
        loop {
            let before = found.pixels.len();
            waiting.retain(|&pixel| {
                let start = found.all.len();
                let ready = (1..=alike.reach).any(|reach| {
                    let around = around(shape, pixel, reach).filter(|&q| alike.are(pixel, q));
                    let known = around.filter(|&q| state[q] != WAITS);
                    found.all.extend(known.map(|q| match state[q] {
                        USABLE => Source::Pixel(q as u32),
                        index => Source::Repaired(index),
                    }));
                    found.all.len() > start
                });
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

/// The pixels on the square around a pixel, `reach` from it: at 1 its up to eight neighbours.
fn around(shape: Shape, pixel: usize, reach: usize) -> impl Iterator<Item = usize> {
    let (row, col) = (pixel / shape.cols, pixel % shape.cols);
    let rows = row.saturating_sub(reach)..=(row + reach).min(shape.rows - 1);
    rows.flat_map(move |r| {
        let cols = col.saturating_sub(reach)..=(col + reach).min(shape.cols - 1);
        let far = move |c: &usize| r.abs_diff(row).max(c.abs_diff(col)) == reach;
        cols.filter(far).map(move |c| r * shape.cols + c)
    })
}

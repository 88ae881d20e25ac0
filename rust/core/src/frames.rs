//! Checked views of frame stacks, the pixel types and the flag bits.
//!
//! The only module that checks shapes: what comes out of [`Stack::new`] has as many samples as its
//! sizes say, and everything behind it relies on that.

use crate::error::{Error, Result};

/// Sizes of one image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Number of rows.
    pub rows: usize,
    /// Number of columns.
    pub cols: usize,
}

impl Shape {
    /// The sizes, in the order (row, column).
    #[must_use]
    pub const fn new(rows: usize, cols: usize) -> Self {
        Self { rows, cols }
    }

    /// Number of pixels.
    #[must_use]
    pub const fn len(self) -> usize {
        self.rows * self.cols
    }

    /// Whether there is no pixel at all.
    #[must_use]
    pub const fn is_empty(self) -> bool {
        self.rows == 0 || self.cols == 0
    }

    /// Rows and columns exchanged.
    #[must_use]
    pub const fn transposed(self) -> Self {
        Self { rows: self.cols, cols: self.rows }
    }
}

impl std::fmt::Display for Shape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "({}, {})", self.rows, self.cols)
    }
}

/// A number as a camera or a file delivers it.
pub trait Sample: Copy + Send + Sync + PartialOrd + std::fmt::Debug + 'static {
    /// The value as a double.
    fn to_f64(self) -> f64;
}

macro_rules! samples {
    ($($kind:ty),*) => {$(
        impl Sample for $kind {
            #[inline(always)]
            fn to_f64(self) -> f64 {
                f64::from(self)
            }
        }
    )*};
}

samples!(u8, u16, f32, f64);

/// The mean frames that a calibration works on: single or double precision.
pub trait Real: Sample {}

impl Real for f32 {}
impl Real for f64 {}

/// `count` images of one shape, one behind the other, row by row.
#[derive(Clone, Copy, Debug)]
pub struct Stack<'a, T> {
    data: &'a [T],
    count: usize,
    shape: Shape,
}

impl<'a, T> Stack<'a, T> {
    /// A view of `data`, called `argument` in errors.
    ///
    /// # Errors
    /// [`Error::Shape`] if `data` does not hold just `count` images of `shape`, or if an image
    /// has no pixel.
    pub fn new(argument: &'static str, data: &'a [T], count: usize, shape: Shape) -> Result<Self> {
        let wanted = shape.rows.checked_mul(shape.cols).and_then(|size| size.checked_mul(count));
        if shape.is_empty() || wanted != Some(data.len()) {
            return Err(Error::Shape {
                argument,
                got: format!("({count}, {}, {}) and {} values", shape.rows, shape.cols, data.len()),
                wanted: "(frames, rows, columns) with at least one row and column".into(),
            });
        }
        Ok(Self { data, count, shape })
    }

    /// Number of images.
    #[must_use]
    pub const fn count(&self) -> usize {
        self.count
    }

    /// Sizes of one image.
    #[must_use]
    pub const fn shape(&self) -> Shape {
        self.shape
    }

    /// All values.
    #[must_use]
    pub const fn data(&self) -> &'a [T] {
        self.data
    }

    /// Image `index`.
    #[must_use]
    pub fn frame(&self, index: usize) -> &'a [T] {
        &self.data[index * self.shape.len()..][..self.shape.len()]
    }

    /// Row `row` of image `index`.
    #[must_use]
    pub fn row(&self, index: usize, row: usize) -> &'a [T] {
        &self.data[index * self.shape.len() + row * self.shape.cols..][..self.shape.cols]
    }
}

/// Flag bits of a pixel, with JWST's numbers.
pub mod flag {
    /// Not to be used: set together with every flag that makes a pixel worthless.
    pub const DO_NOT_USE: u32 = 1 << 0;
    /// Reached the saturation level.
    pub const SATURATED: u32 = 1 << 1;
    /// Does not respond to light.
    pub const DEAD: u32 = 1 << 10;
    /// Much dark signal.
    pub const HOT: u32 = 1 << 11;
    /// The sensitivity could not be determined.
    pub const NO_FLAT_FIELD: u32 = 1 << 18;
    /// The sensitivity is known so badly that it is no use.
    pub const UNRELIABLE_FLAT: u32 = 1 << 25;
}

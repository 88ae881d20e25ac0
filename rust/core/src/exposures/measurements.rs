//! The values of exposures with their variances, and which of them are used.

use crate::error::{Error, Result};
use crate::frames::{Shape, Stack};

/// Mean frames of one beam, one for each exposure, with their variances.
#[derive(Clone, Copy, Debug)]
pub struct Measurements<'a, T> {
    /// The values; what is not finite is not used.
    pub frames: Stack<'a, T>,
    /// The variances of the values.
    pub variance: Variance<'a, T>,
    /// What else is not used.
    pub mask: Mask<'a>,
}

impl<'a, T> From<Stack<'a, T>> for Measurements<'a, T> {
    /// All values, with equal weights.
    fn from(frames: Stack<'a, T>) -> Self {
        Self { frames, variance: Variance::Unknown, mask: Mask::None }
    }
}

/// The variance of the values of a stack of frames.
#[derive(Clone, Copy, Debug)]
pub enum Variance<'a, T> {
    /// Unknown: every weight is 1.
    Unknown,
    /// One value for each exposure.
    Exposures(&'a [f64]),
    /// One value for each measurement.
    Measurements(Stack<'a, T>),
}

/// Which measurements not to use (`true`).
#[derive(Clone, Copy, Debug)]
pub enum Mask<'a> {
    /// All are used.
    None,
    /// The same pixels in every exposure, row by row.
    Pixels(&'a [bool]),
    /// Each measurement, in the order of the frames.
    Measurements(&'a [bool]),
}

impl<'a> Mask<'a> {
    /// Checks that it fits so many exposures of that shape.
    pub(crate) fn check(&self, count: usize, shape: Shape) -> Result<()> {
        let (length, size) = match self {
            Self::None => return Ok(()),
            Self::Pixels(mask) => (mask.len(), shape.len()),
            Self::Measurements(mask) => (mask.len(), shape.len() * count),
        };
        if length == size {
            return Ok(());
        }
        let wanted = format!("{shape} or ({count}, {}, {})", shape.rows, shape.cols);
        Err(Error::Shape { argument: "mask", got: format!("({length},)"), wanted })
    }

    /// The part for a row of an exposure of that shape; `None` if nothing is masked.
    pub(crate) fn row(&self, exposure: usize, row: usize, shape: Shape) -> Option<&'a [bool]> {
        let Shape { rows, cols } = shape;
        match self {
            Self::None => None,
            Self::Pixels(mask) => Some(&mask[row * cols..][..cols]),
            Self::Measurements(mask) => Some(&mask[(exposure * rows + row) * cols..][..cols]),
        }
    }
}

impl<T> Measurements<'_, T> {
    /// Checks that variances and mask fit the frames.
    pub(crate) fn check_shapes(&self) -> Result<()> {
        let (count, shape) = (self.frames.count(), self.frames.shape());
        let wrong = |got, wanted| Err(Error::Shape { argument: "variance", got, wanted });
        match &self.variance {
            Variance::Exposures(v) if v.len() != count => {
                wrong(format!("({},)", v.len()), format!("({count},), one an exposure"))
            }
            Variance::Measurements(v) if v.count() != count || v.shape() != shape => {
                let Shape { rows, cols } = v.shape();
                let wanted = format!("({count}, {}, {})", shape.rows, shape.cols);
                wrong(format!("({}, {rows}, {cols})", v.count()), wanted)
            }
            _ => self.mask.check(count, shape),
        }
    }

    /// The variance of an exposure's measurements where it is the same for all.
    pub(crate) fn exposure_variance(&self, exposure: usize) -> f64 {
        match self.variance {
            Variance::Exposures(variance) => variance[exposure],
            _ => 1.0,
        }
    }
}

//! `Corrector`: a correction prepared for many frames.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | coefficients | float32 or float64, 3 | `Stack<T>` | copy, kept |
//! | unusable | bool, 2 | `&[bool]` | view |
//! | colours | uint8, 2 | `&[u8]` | view |
//! | levels | float32, 3 | `Stack<f32>` | those of pixels with fewer levels than others are kept |
//! | frames, out | uint8, uint16 or float32; float64 with such coefficients, 3 | `&[T]`, `&mut [T]` | view |

use std::num::NonZeroUsize;

use equipix_core::apply::{Alike, Corrected, Corrector, Counts, Precision, Raw, Unusable};
use equipix_core::{Error, Shape, Stack, Workers};
use numpy::{
    Element, PyReadonlyArray2, PyReadonlyArray3, PyReadwriteArray3, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;

use crate::{errors, run};

/// Most values that are corrected without a look at signals: some milliseconds.
const BRIEF: usize = 1 << 24;

/// Raw frames of any type that cameras deliver, the most frequent first: each type that does not fit takes time.
#[derive(FromPyObject)]
pub(crate) enum PyRaw<'py> {
    #[pyo3(transparent)]
    U16(PyReadonlyArray3<'py, u16>),
    #[pyo3(transparent)]
    U8(PyReadonlyArray3<'py, u8>),
    #[pyo3(transparent)]
    F32(PyReadonlyArray3<'py, f32>),
    #[pyo3(transparent)]
    F64(PyReadonlyArray3<'py, f64>),
}

/// Where corrected frames go.
#[derive(FromPyObject)]
pub(crate) enum PyOut<'py> {
    #[pyo3(transparent)]
    U16(PyReadwriteArray3<'py, u16>),
    #[pyo3(transparent)]
    U8(PyReadwriteArray3<'py, u8>),
    #[pyo3(transparent)]
    F32(PyReadwriteArray3<'py, f32>),
    #[pyo3(transparent)]
    F64(PyReadwriteArray3<'py, f64>),
}

/// Coefficients in the precision to correct in.
#[derive(FromPyObject)]
pub(crate) enum PyPlanes<'py> {
    Single(PyReadonlyArray3<'py, f32>),
    Double(PyReadonlyArray3<'py, f64>),
}

/// A correction in either precision.
enum Prepared {
    Single(Corrector<f32>),
    Double(Corrector<f64>),
}

/// A correction prepared for many frames.
#[pyclass(frozen, module = "equipix._native", name = "Corrector")]
pub(crate) struct PyCorrector(Prepared);

#[pymethods]
impl PyCorrector {
    #[new]
    fn new(
        py: Python<'_>,
        coefficients: PyPlanes<'_>,
        unusable: PyReadonlyArray2<'_, bool>,
        flagged: &str,
        levels: Option<PyReadonlyArray3<'_, f32>>,
        colours: Option<PyReadonlyArray2<'_, u8>>,
        reach: usize,
    ) -> PyResult<Self> {
        let colours = colours.as_ref().map(PyReadonlyArray2::as_slice).transpose()?;
        let pixels =
            Pixels { unusable: unusable.as_slice()?, flagged, alike: Alike { colours, reach } };
        let levels = levels.as_ref().map(|levels| stack("levels", levels)).transpose()?;
        let made = match &coefficients {
            PyPlanes::Single(planes) => pixels.prepared(planes, levels)?.map(Prepared::Single),
            PyPlanes::Double(planes) => pixels.prepared(planes, levels)?.map(Prepared::Double),
        };
        made.map(Self).map_err(|error| errors::exception(py, &error))
    }

    /// Corrects frames into `out`; gives the numbers of values limited to 0 and `largest` and of
    /// those outside of the levels, and the largest raw value.
    #[pyo3(signature = (frames, out, largest, *, workers))]
    fn apply(
        &self,
        py: Python<'_>,
        frames: PyRaw<'_>,
        out: PyOut<'_>,
        largest: f32,
        workers: Option<NonZeroUsize>,
    ) -> PyResult<(u64, u64, f64)> {
        let job = Job { largest, workers };
        let counts = match (&self.0, frames, out) {
            (Prepared::Single(by), PyRaw::U8(frames), out) => job.single(py, by, &frames, out),
            (Prepared::Single(by), PyRaw::U16(frames), out) => job.single(py, by, &frames, out),
            (Prepared::Single(by), PyRaw::F32(frames), out) => job.single(py, by, &frames, out),
            (Prepared::Double(by), PyRaw::F64(frames), PyOut::F64(mut out)) => {
                job.write(py, by, frames.as_slice()?, out.as_slice_mut()?)
            }
            _ => Err(other_precision()),
        }?;
        Ok((counts.limited, counts.extrapolated, counts.highest))
    }
}

/// What becomes of the pixels of a correction.
struct Pixels<'a> {
    unusable: &'a [bool],
    flagged: &'a str,
    alike: Alike<'a>,
}

impl Pixels<'_> {
    fn prepared<T: Precision + Element>(
        &self,
        planes: &PyReadonlyArray3<'_, T>,
        levels: Option<equipix_core::Result<Stack<'_, f32>>>,
    ) -> PyResult<equipix_core::Result<Corrector<T>>> {
        let made = stack("coefficients", planes)?.and_then(|planes| {
            Corrector::new(planes, self.unusable, then(self.flagged)?, self.alike)
        });
        Ok(match levels {
            Some(levels) => made.and_then(|corrector| corrector.with_levels(levels?)),
            None => made,
        })
    }
}

/// How frames are to be corrected.
struct Job {
    largest: f32,
    workers: Option<NonZeroUsize>,
}

impl Job {
    fn single<I: Raw<f32> + Element>(
        &self,
        py: Python<'_>,
        by: &Corrector<f32>,
        frames: &PyReadonlyArray3<'_, I>,
        out: PyOut<'_>,
    ) -> PyResult<Counts> {
        match out {
            PyOut::U8(mut out) => self.write(py, by, frames.as_slice()?, out.as_slice_mut()?),
            PyOut::U16(mut out) => self.write(py, by, frames.as_slice()?, out.as_slice_mut()?),
            PyOut::F32(mut out) => self.write(py, by, frames.as_slice()?, out.as_slice_mut()?),
            PyOut::F64(_) => Err(other_precision()),
        }
    }

    fn write<T: Precision, I: Raw<T>, O: Corrected<T>>(
        &self,
        py: Python<'_>,
        by: &Corrector<T>,
        frames: &[I],
        out: &mut [O],
    ) -> PyResult<Counts> {
        let brief = frames.len() <= BRIEF;
        let work = |control: &_| {
            let workers = Workers::new(self.workers)?;
            by.apply(frames, out, T::nearest(self.largest.into()), &workers, control)
        };
        if brief { run::brief(py, work) } else { run::interruptible(py, None, work) }
    }
}

fn other_precision() -> PyErr {
    PyTypeError::new_err("frames and coefficients in float64 give float64, others do not")
}

/// Images of an array of the shape (n, rows, cols).
fn stack<'a, T: Element>(
    name: &'static str,
    array: &'a PyReadonlyArray3<'_, T>,
) -> PyResult<equipix_core::Result<Stack<'a, T>>> {
    let [count, rows, cols] = [0, 1, 2].map(|axis| array.shape()[axis]);
    Ok(Stack::new(name, array.as_slice()?, count, Shape::new(rows, cols)))
}

fn then(flagged: &str) -> equipix_core::Result<Unusable> {
    Ok(match flagged {
        "nan" => Unusable::Blank,
        "keep" => Unusable::Kept,
        "replace" => Unusable::Replaced,
        _ => {
            let problem = format!("is '{flagged}': expected nan, keep or replace");
            return Err(Error::Value { argument: "flagged", problem });
        }
    })
}

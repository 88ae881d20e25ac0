//! `Corrector`: a correction prepared for many frames.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | coefficients | float32, 3 | `Stack<f32>` | copy, kept |
//! | unusable | bool, 2 | `&[bool]` | view |
//! | colours | uint8, 2 | `&[u8]` | view |
//! | levels | float32, 3 | `Stack<f32>` | those of pixels with fewer levels than others are kept |
//! | frames, out | uint8, uint16 or float32, 3 | `&[T]`, `&mut [T]` | view |

use std::num::NonZeroUsize;

use equipix_core::apply::{Alike, Corrected, Corrector, Counts, Raw, Unusable};
use equipix_core::{Error, Shape, Stack, Workers};
use numpy::{
    Element, PyReadonlyArray2, PyReadonlyArray3, PyReadwriteArray3, PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::{errors, run};

/// Most values that are corrected without a look at signals: some milliseconds.
const BRIEF: usize = 1 << 24;

/// Raw frames of any type that cameras deliver.
#[derive(FromPyObject)]
pub(crate) enum PyRaw<'py> {
    U8(PyReadonlyArray3<'py, u8>),
    U16(PyReadonlyArray3<'py, u16>),
    F32(PyReadonlyArray3<'py, f32>),
}

/// Where corrected frames go.
#[derive(FromPyObject)]
pub(crate) enum PyOut<'py> {
    U8(PyReadwriteArray3<'py, u8>),
    U16(PyReadwriteArray3<'py, u16>),
    F32(PyReadwriteArray3<'py, f32>),
}

/// A correction prepared for many frames.
#[pyclass(frozen, module = "equipix._native", name = "Corrector")]
pub(crate) struct PyCorrector(Corrector);

#[pymethods]
impl PyCorrector {
    #[new]
    fn new(
        py: Python<'_>,
        coefficients: PyReadonlyArray3<'_, f32>,
        unusable: PyReadonlyArray2<'_, bool>,
        flagged: &str,
        levels: Option<PyReadonlyArray3<'_, f32>>,
        colours: Option<PyReadonlyArray2<'_, u8>>,
        reach: usize,
    ) -> PyResult<Self> {
        let unusable = unusable.as_slice()?;
        let colours = colours.as_ref().map(PyReadonlyArray2::as_slice).transpose()?;
        let alike = Alike { colours, reach };
        let made = stack("coefficients", &coefficients)?
            .and_then(|planes| Corrector::new(planes, unusable, then(flagged)?, alike));
        let made = match &levels {
            Some(levels) => {
                let levels = stack("levels", levels)?;
                made.and_then(|corrector| corrector.with_levels(levels?))
            }
            None => made,
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
    ) -> PyResult<(u64, u64, f32)> {
        let job = Job { corrector: &self.0, largest, workers };
        let counts = match frames {
            PyRaw::U8(frames) => job.of(py, &frames, out),
            PyRaw::U16(frames) => job.of(py, &frames, out),
            PyRaw::F32(frames) => job.of(py, &frames, out),
        }?;
        Ok((counts.limited, counts.extrapolated, counts.highest))
    }
}

/// Frames to be corrected.
struct Job<'a> {
    corrector: &'a Corrector,
    largest: f32,
    workers: Option<NonZeroUsize>,
}

impl Job<'_> {
    fn of<I: Raw + Element>(
        &self,
        py: Python<'_>,
        frames: &PyReadonlyArray3<'_, I>,
        out: PyOut<'_>,
    ) -> PyResult<Counts> {
        match out {
            PyOut::U8(mut out) => self.write(py, frames.as_slice()?, out.as_slice_mut()?),
            PyOut::U16(mut out) => self.write(py, frames.as_slice()?, out.as_slice_mut()?),
            PyOut::F32(mut out) => self.write(py, frames.as_slice()?, out.as_slice_mut()?),
        }
    }

    fn write<I: Raw, O: Corrected>(
        &self,
        py: Python<'_>,
        frames: &[I],
        out: &mut [O],
    ) -> PyResult<Counts> {
        let brief = frames.len() <= BRIEF;
        let work = |control: &_| {
            let workers = Workers::new(self.workers)?;
            self.corrector.apply(frames, out, self.largest, &workers, control)
        };
        if brief { run::brief(py, work) } else { run::interruptible(py, None, work) }
    }
}

/// Images of an array of the shape (n, rows, cols).
fn stack<'a>(
    name: &'static str,
    array: &'a PyReadonlyArray3<'_, f32>,
) -> PyResult<equipix_core::Result<Stack<'a, f32>>> {
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

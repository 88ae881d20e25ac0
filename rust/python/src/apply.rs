//! `Corrector`: a correction prepared for many frames.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | coefficients | float32, 3 | `Stack<f32>` | copy, kept |
//! | unusable | bool, 2 | `&[bool]` | view |
//! | frames, out | uint8, uint16 or float32, 3 | `&[T]`, `&mut [T]` | view |

use std::num::NonZeroUsize;

use equipix_core::apply::{Corrected, Corrector, Raw, Unusable};
use equipix_core::control::Control;
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
    ) -> PyResult<Self> {
        let [planes, rows, cols] = [0, 1, 2].map(|axis| coefficients.shape()[axis]);
        let made =
            Stack::new("coefficients", coefficients.as_slice()?, planes, Shape::new(rows, cols))
                .and_then(|stack| {
                    Corrector::new(stack, unusable.as_slice().unwrap_or(&[]), then(flagged)?)
                });
        made.map(Self).map_err(|error| errors::exception(py, &error))
    }

    /// Corrects frames into `out`; gives the number of values limited to 0 and `largest`.
    #[pyo3(signature = (frames, out, largest, *, workers))]
    fn apply(
        &self,
        py: Python<'_>,
        frames: PyRaw<'_>,
        out: PyOut<'_>,
        largest: f32,
        workers: Option<NonZeroUsize>,
    ) -> PyResult<u64> {
        let job = Job { corrector: &self.0, largest, workers };
        match frames {
            PyRaw::U8(frames) => job.of(py, &frames, out),
            PyRaw::U16(frames) => job.of(py, &frames, out),
            PyRaw::F32(frames) => job.of(py, &frames, out),
        }
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
    ) -> PyResult<u64> {
        match out {
            PyOut::U8(mut out) => self.into(py, frames.as_slice()?, out.as_slice_mut()?),
            PyOut::U16(mut out) => self.into(py, frames.as_slice()?, out.as_slice_mut()?),
            PyOut::F32(mut out) => self.into(py, frames.as_slice()?, out.as_slice_mut()?),
        }
    }

    fn into<I: Raw, O: Corrected>(
        &self,
        py: Python<'_>,
        frames: &[I],
        out: &mut [O],
    ) -> PyResult<u64> {
        let size = self.corrector.shape().len();
        let brief = frames.len() <= BRIEF;
        let work = |control: &Control| {
            let workers = Workers::new(self.workers)?;
            let mut limited = 0;
            for (frame, out) in frames.chunks(size).zip(out.chunks_mut(size)) {
                limited += self.corrector.apply(frame, out, self.largest, &workers, control)?;
            }
            Ok(limited)
        };
        if brief { run::brief(py, work) } else { run::interruptible(py, None, work) }
    }
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

//! Averaging: partial sums over frames from arrays and files.

use std::num::NonZeroUsize;
use std::path::PathBuf;

use equipix_core::frames::{Shape, Stack};
use equipix_core::io::{self, AnyFrames, Frames};
use equipix_core::parallel::Workers;
use equipix_core::statistics::{self, Statistics, Summable};
use numpy::{
    Element, IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2,
    PyReadonlyArray3,
};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;

use crate::{errors, run};

/// Mean, variance, count, saturated.
type Maps<'py> = (
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray2<u32>>,
    Bound<'py, PyArray2<u32>>,
    f64,
);

enum Sums {
    U8(statistics::Accumulator<u8>),
    U16(statistics::Accumulator<u16>),
    F32(statistics::Accumulator<f32>),
    F64(statistics::Accumulator<f64>),
}

/// Partial sums of frames of one shape and dtype.
#[pyclass(module = "equipix._native")]
pub(crate) struct Accumulator {
    sums: Sums,
    workers: Option<NonZeroUsize>,
}

#[pymethods]
impl Accumulator {
    #[new]
    fn new(
        py: Python<'_>,
        dtype: &str,
        shape: (usize, usize),
        saturation: Option<f64>,
        mask: Option<PyReadonlyArray2<'_, bool>>,
        workers: Option<NonZeroUsize>,
    ) -> PyResult<Self> {
        let shape = Shape::new(shape.0, shape.1);
        let mask = mask.as_ref().map(|mask| mask.as_slice()).transpose()?;
        let sums = match dtype {
            "uint8" => sums(shape, saturation, mask).map(Sums::U8),
            "uint16" => sums(shape, saturation, mask).map(Sums::U16),
            "float32" => sums(shape, saturation, mask).map(Sums::F32),
            _ => sums(shape, saturation, mask).map(Sums::F64),
        };
        let sums = sums.map_err(|error| errors::exception(py, &error))?;
        Ok(Self { sums, workers })
    }

    /// Adds frames (n, rows, cols) of the dtype.
    fn add(&mut self, frames: &Bound<'_, PyAny>) -> PyResult<()> {
        match &mut self.sums {
            Sums::U8(sums) => add(sums, frames, self.workers),
            Sums::U16(sums) => add(sums, frames, self.workers),
            Sums::F32(sums) => add(sums, frames, self.workers),
            Sums::F64(sums) => add(sums, frames, self.workers),
        }
    }

    /// Adds what another of the same dtype has summed over later frames.
    fn merge(&mut self, py: Python<'_>, other: PyRef<'_, Self>) -> PyResult<()> {
        let later = &other.sums;
        let merged = py.detach(|| match (&mut self.sums, later) {
            (Sums::U8(sums), Sums::U8(later)) => Some(sums.merge(later)),
            (Sums::U16(sums), Sums::U16(later)) => Some(sums.merge(later)),
            (Sums::F32(sums), Sums::F32(later)) => Some(sums.merge(later)),
            (Sums::F64(sums), Sums::F64(later)) => Some(sums.merge(later)),
            _ => None,
        });
        let merged = merged.ok_or_else(|| PyTypeError::new_err("other: not the frames' dtype"))?;
        merged.map_err(|error| errors::exception(py, &error))
    }

    /// The sums as bytes, uint8.
    fn state<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u8>> {
        let bytes = py.detach(|| match &self.sums {
            Sums::U8(sums) => sums.to_bytes(),
            Sums::U16(sums) => sums.to_bytes(),
            Sums::F32(sums) => sums.to_bytes(),
            Sums::F64(sums) => sums.to_bytes(),
        });
        bytes.into_pyarray(py)
    }

    /// Takes sums that `state` gave in the place of its own.
    fn restore(&mut self, py: Python<'_>, state: PyReadonlyArray1<'_, u8>) -> PyResult<()> {
        let bytes = state.as_slice()?;
        let restored = py.detach(|| match &mut self.sums {
            Sums::U8(sums) => sums.restore(bytes),
            Sums::U16(sums) => sums.restore(bytes),
            Sums::F32(sums) => sums.restore(bytes),
            Sums::F64(sums) => sums.restore(bytes),
        });
        restored.map_err(|error| errors::exception(py, &error))
    }

    /// Mean, variance, count and number of saturated samples, each (rows, cols).
    fn finish<'py>(&self, py: Python<'py>) -> PyResult<Maps<'py>> {
        let statistics = py.detach(|| match &self.sums {
            Sums::U8(sums) => sums.finish(),
            Sums::U16(sums) => sums.finish(),
            Sums::F32(sums) => sums.finish(),
            Sums::F64(sums) => sums.finish(),
        });
        maps(py, statistics)
    }
}

fn sums<T: Summable>(
    shape: Shape,
    saturation: Option<f64>,
    mask: Option<&[bool]>,
) -> equipix_core::Result<statistics::Accumulator<T>> {
    let sums = statistics::Accumulator::new(shape, saturation)?;
    match mask {
        Some(mask) => sums.masked(mask),
        None => Ok(sums),
    }
}

fn add<T: Summable + Element>(
    sums: &mut statistics::Accumulator<T>,
    frames: &Bound<'_, PyAny>,
    workers: Option<NonZeroUsize>,
) -> PyResult<()> {
    let py = frames.py();
    let frames: PyReadonlyArray3<'_, T> = frames.extract()?;
    let (count, rows, cols) = frames.as_array().dim();
    let samples = frames.as_slice()?;
    run::interruptible(py, None, |control| {
        let stack = Stack::new("frames", samples, count, Shape::new(rows, cols))?;
        sums.add(&stack, &Workers::new(workers)?, control)
    })
}

/// Mean, variance, count and number of saturated samples of all pages of all files.
#[pyfunction]
#[pyo3(signature = (paths, saturation, mask, workers, progress))]
pub(crate) fn average_files<'py>(
    py: Python<'py>,
    paths: Vec<PathBuf>,
    saturation: Option<f64>,
    mask: Option<PyReadonlyArray2<'py, bool>>,
    workers: Option<NonZeroUsize>,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Maps<'py>> {
    let mask = mask.as_ref().map(|mask| mask.as_slice()).transpose()?;
    let statistics = run::interruptible(py, progress, |control| {
        io::average(&paths, saturation, mask, &Workers::new(workers)?, control)
    })?;
    maps(py, statistics)
}

/// All pages of a file, (n, rows, cols), uint8 or uint16.
#[pyfunction]
#[pyo3(signature = (path, workers))]
pub(crate) fn read_file(
    py: Python<'_>,
    path: PathBuf,
    workers: Option<NonZeroUsize>,
) -> PyResult<Bound<'_, PyAny>> {
    let frames =
        run::interruptible(py, None, |control| io::read(&path, &Workers::new(workers)?, control))?;
    match frames {
        AnyFrames::U8(frames) => stack(py, frames),
        AnyFrames::U16(frames) => stack(py, frames),
    }
}

/// Number of pages of a file, and rows, columns and bits per sample of the first.
#[pyfunction]
pub(crate) fn file_format(py: Python<'_>, path: PathBuf) -> PyResult<(usize, usize, usize, u32)> {
    let described = run::interruptible(py, None, |control| io::describe(&path, control))?;
    let (count, shape, bits) = described;
    Ok((count, shape.rows, shape.cols, bits))
}

/// Exposure time in s of a TIFF file; None where it holds none.
#[pyfunction]
pub(crate) fn exposure_s(py: Python<'_>, path: PathBuf) -> PyResult<Option<f64>> {
    run::brief(py, |control| io::exposure_s(&path, control))
}

fn stack<T: Element>(py: Python<'_>, frames: Frames<T>) -> PyResult<Bound<'_, PyAny>> {
    let Frames { count, shape, data } = frames;
    Ok(data.into_pyarray(py).reshape([count, shape.rows, shape.cols])?.into_any())
}

fn maps(py: Python<'_>, statistics: Statistics) -> PyResult<Maps<'_>> {
    let Statistics {
        shape: Shape { rows, cols },
        mean,
        variance,
        count,
        saturated,
        light_variance,
    } = statistics;
    Ok((
        mean.into_pyarray(py).reshape([rows, cols])?,
        variance.into_pyarray(py).reshape([rows, cols])?,
        count.into_pyarray(py).reshape([rows, cols])?,
        saturated.into_pyarray(py).reshape([rows, cols])?,
        light_variance,
    ))
}

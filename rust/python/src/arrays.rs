//! NumPy arrays as the core views them, and its results as arrays.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | frames | float32 or float64, 3 | `Stack<f32>` or `Stack<f64>` | view |
//! | variance | float64, 1, or the frames' dtype, 3 | `Variance` | view |
//! | mask | bool, 2 or 3 | `Mask` | view |
//! | shifts, shift_std | float64, 2 | `Vec<[f64; 2]>` | copy of a few numbers |
//! | rotation | int | `Vec<Rotation>` | copy of a few numbers |

use equipix_core::{Error, Mask, Measurements, Real, Result, Rotation, Shape, Stack, Variance};
use numpy::{
    Element, IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2,
    PyReadonlyArray3, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;

use crate::errors;

/// Mean frames of either precision.
#[derive(FromPyObject)]
pub(crate) enum PyFrames<'py> {
    Single(PyReadonlyArray3<'py, f32>),
    Double(PyReadonlyArray3<'py, f64>),
}

/// Variances: one an exposure, or one a measurement.
#[derive(FromPyObject)]
pub(crate) enum PyVariance<'py> {
    Exposures(PyReadonlyArray1<'py, f64>),
    Single(PyReadonlyArray3<'py, f32>),
    Double(PyReadonlyArray3<'py, f64>),
}

/// Masks: one for all exposures, or one for each.
#[derive(FromPyObject)]
pub(crate) enum PyMask<'py> {
    Pixels(PyReadonlyArray2<'py, bool>),
    Measurements(PyReadonlyArray3<'py, bool>),
}

/// The arrays of exposures, borrowed.
pub(crate) struct PyMeasurements<'py> {
    pub(crate) frames: PyFrames<'py>,
    pub(crate) variance: Option<PyVariance<'py>>,
    pub(crate) mask: Option<PyMask<'py>>,
}

/// Measurements of either precision.
pub(crate) enum AnyMeasurements<'a> {
    Single(Measurements<'a, f32>),
    Double(Measurements<'a, f64>),
}

/// Does the same with measurements of either precision.
macro_rules! either {
    ($any:expr, $measurements:ident => $work:expr) => {
        match $any {
            $crate::arrays::AnyMeasurements::Single($measurements) => $work,
            $crate::arrays::AnyMeasurements::Double($measurements) => $work,
        }
    };
}
pub(crate) use either;

impl PyMeasurements<'_> {
    /// As the core views them: the one place that distinguishes precisions.
    pub(crate) fn view(&self) -> PyResult<AnyMeasurements<'_>> {
        use AnyMeasurements::{Double, Single};
        let mask = view_mask(self.mask.as_ref())?;
        Ok(match (&self.frames, &self.variance) {
            (PyFrames::Single(frames), Some(PyVariance::Single(values))) => Single(Measurements {
                frames: stack("frames", frames)?,
                variance: each(values)?,
                mask,
            }),
            (PyFrames::Double(frames), Some(PyVariance::Double(values))) => Double(Measurements {
                frames: stack("frames", frames)?,
                variance: each(values)?,
                mask,
            }),
            (PyFrames::Single(frames), values) => Single(Measurements {
                frames: stack("frames", frames)?,
                variance: few(values)?,
                mask,
            }),
            (PyFrames::Double(frames), values) => Double(Measurements {
                frames: stack("frames", frames)?,
                variance: few(values)?,
                mask,
            }),
        })
    }
}

/// One variance a measurement.
fn each<'a, T: Element + Real>(values: &'a PyReadonlyArray3<'_, T>) -> PyResult<Variance<'a, T>> {
    Ok(Variance::Measurements(stack("variance", values)?))
}

/// One variance an exposure, or none.
fn few<'a, T>(values: &'a Option<PyVariance<'_>>) -> PyResult<Variance<'a, T>> {
    match values {
        None => Ok(Variance::Unknown),
        Some(PyVariance::Exposures(values)) => Ok(Variance::Exposures(values.as_slice()?)),
        Some(_) => Err(PyTypeError::new_err("variance: not the frames' dtype")),
    }
}

pub(crate) fn stack<'a, T: Element + Real>(
    argument: &'static str,
    array: &'a PyReadonlyArray3<'_, T>,
) -> PyResult<Stack<'a, T>> {
    let shape = array.shape();
    let sizes = Shape::new(shape[1], shape[2]);
    let stack = Stack::new(argument, array.as_slice()?, shape[0], sizes);
    stack.map_err(|error| errors::exception(array.py(), &error))
}

pub(crate) fn view_mask<'a>(mask: Option<&'a PyMask<'_>>) -> PyResult<Mask<'a>> {
    Ok(match mask {
        None => Mask::None,
        Some(PyMask::Pixels(mask)) => Mask::Pixels(mask.as_slice()?),
        Some(PyMask::Measurements(mask)) => Mask::Measurements(mask.as_slice()?),
    })
}

/// Rows of two numbers.
pub(crate) fn pairs(array: &PyReadonlyArray2<'_, f64>) -> PyResult<Vec<[f64; 2]>> {
    Ok(array.as_slice()?.as_chunks().0.to_vec())
}

pub(crate) fn rotations(degrees: &[i64]) -> Result<Vec<Rotation>> {
    degrees.iter().map(|&degrees| rotation(degrees)).collect()
}

pub(crate) fn rotation(degrees: i64) -> Result<Rotation> {
    Rotation::from_degrees(degrees).ok_or_else(|| Error::Value {
        argument: "rotation",
        problem: format!("holds {degrees}: expected 0, 90, 180 or 270 degrees"),
    })
}

/// Values as an array (rows, cols), without a copy, that nobody may write to.
pub(crate) fn image<T: Element>(
    py: Python<'_>,
    values: Vec<T>,
    shape: Shape,
) -> PyResult<Py<PyArray2<T>>> {
    let values = read_only(py, values)?;
    Ok(values.bind(py).reshape([shape.rows, shape.cols])?.unbind())
}

/// Values as an array, without a copy, that nobody may write to: several results share it, and a fit is
/// asked again later.
pub(crate) fn read_only<T: Element>(py: Python<'_>, values: Vec<T>) -> PyResult<Py<PyArray1<T>>> {
    let array = values.into_pyarray(py);
    drop(array.try_readwrite()?.make_nonwriteable());
    Ok(array.unbind())
}

/// The sizes of an array (rows, cols).
pub(crate) fn shape_of<T: Element>(array: &PyReadonlyArray2<'_, T>) -> Shape {
    Shape::new(array.shape()[0], array.shape()[1])
}

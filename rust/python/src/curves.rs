//! `fit_response`: response curves from levels of a uniform source.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | means | float32 or float64, 3 | `Stack<f32>` or `Stack<f64>` | view |
//! | references, noise | float | `Vec` | copy of a few numbers |

use std::num::NonZeroUsize;

use equipix_core::curves::{Form, LevelNoise, Levels, ResponseFit, fit};
use equipix_core::{Error, Real, Shape, Workers};
use numpy::{
    Element, IntoPyArray, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray3,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::arrays::{PyFrames, image, stack};
use crate::{errors, run};

/// Coefficients, their variances, misfit, levels used.
type PyResponse = (Py<PyArray3<f64>>, Py<PyArray3<f64>>, Py<PyArray2<f64>>, Py<PyArray2<u32>>);

/// Deviation of each pixel from the array's mean, as a polynomial of that mean.
#[pyfunction]
#[pyo3(signature = (means, references, *, form, noise, workers))]
pub(crate) fn fit_response(
    py: Python<'_>,
    means: PyFrames<'_>,
    references: Vec<f64>,
    form: &str,
    noise: Option<Vec<(f64, f64, f64)>>,
    workers: Option<NonZeroUsize>,
) -> PyResult<PyResponse> {
    let form = form_of(form).map_err(|error| errors::exception(py, &error))?;
    let law = |(constant, slope, dark)| LevelNoise { constant, slope, dark };
    let noise: Option<Vec<_>> = noise.map(|noise| noise.into_iter().map(law).collect());
    let ask = Question { references: &references, noise: noise.as_deref(), form, workers };
    match means {
        PyFrames::Single(means) => ask.put(py, &means),
        PyFrames::Double(means) => ask.put(py, &means),
    }
}

/// What is asked, beside the frames.
struct Question<'a> {
    references: &'a [f64],
    noise: Option<&'a [LevelNoise]>,
    form: Form,
    workers: Option<NonZeroUsize>,
}

impl Question<'_> {
    fn put<T: Element + Real>(
        &self,
        py: Python<'_>,
        means: &PyReadonlyArray3<'_, T>,
    ) -> PyResult<PyResponse> {
        let levels = Levels {
            means: stack("levels", means)?,
            references: self.references,
            noise: self.noise,
        };
        let found = run::interruptible(py, None, |control| {
            fit(&levels, self.form, &Workers::new(self.workers)?, control)
        })?;
        arrays(py, found, self.form, Shape::new(means.shape()[1], means.shape()[2]))
    }
}

fn arrays(py: Python<'_>, found: ResponseFit, form: Form, shape: Shape) -> PyResult<PyResponse> {
    let sizes = [form.order() + 1, shape.rows, shape.cols];
    Ok((
        found.coefficients.into_pyarray(py).reshape(sizes)?.unbind(),
        found.variances.into_pyarray(py).reshape(sizes)?.unbind(),
        found.misfit.into_pyarray(py).reshape([shape.rows, shape.cols])?.unbind(),
        image(py, found.used, shape)?,
    ))
}

fn form_of(name: &str) -> equipix_core::Result<Form> {
    Ok(match name {
        "offset" => Form::Offset,
        "gain" => Form::Gain,
        "line" => Form::Line,
        "quadratic" => Form::Quadratic,
        "cubic" => Form::Cubic,
        _ => {
            let problem = format!("is '{name}': expected offset, gain, line, quadratic or cubic");
            return Err(Error::Value { argument: "form", problem });
        }
    })
}

//! `Exposures`: what a calibration is made from.
//!
//! The object keeps references to the arrays, and what the check of their values counted. Each later
//! call views the arrays again, without another look at the values.

use std::num::NonZeroUsize;
use std::sync::Arc;

use equipix_core::{
    Error, Exposures, Flux, FluxKind, Method, Options, Positions, Result, Workers, calibrate,
};
use numpy::PyReadonlyArray2;
use pyo3::prelude::*;

use crate::arrays::{either, pairs, rotations};
use crate::data::{Arrays, Data};
use crate::fit::{PyFit, PyStart};
use crate::{errors, run};

/// Mean frames of one beam, and all that is known of them.
#[pyclass(frozen, module = "equipix._native", name = "Exposures")]
pub(crate) struct PyExposures(Arc<Data>);

#[pymethods]
impl PyExposures {
    /// Checks the exposures of an experiment.
    #[new]
    #[pyo3(signature = (frames, shifts, *, shift_std, rotation, flux, flux_model, offset, variance,
                        is_relative, mask, unreliable, workers, progress))]
    #[expect(clippy::too_many_arguments, reason = "all that is known of exposures")]
    fn new(
        py: Python<'_>,
        frames: Py<PyAny>,
        shifts: PyReadonlyArray2<'_, f64>,
        shift_std: Option<PyReadonlyArray2<'_, f64>>,
        rotation: Vec<i64>,
        flux: Vec<f64>,
        flux_model: (String, Vec<f64>),
        offset: bool,
        variance: Option<Py<PyAny>>,
        is_relative: bool,
        mask: Option<Py<PyAny>>,
        unreliable: Option<PyReadonlyArray2<'_, bool>>,
        workers: Option<NonZeroUsize>,
        progress: Option<Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let arrays = Arrays { frames, variance, mask };
        let (shifts, std) = (pairs(&shifts)?, shift_std.as_ref().map(pairs).transpose()?);
        let borrowed = arrays.borrow(py)?;
        let measurements = borrowed.view()?;
        let unreliable = unreliable.as_ref().map(PyReadonlyArray2::as_slice).transpose()?;
        let checked = run::interruptible(py, progress.as_ref(), |control| {
            let positions = Positions { shifts, rotations: rotations(&rotation)?, std };
            let flux = Flux { values: flux, kind: flux_kind(flux_model)? };
            let workers = Workers::new(workers)?;
            either!(measurements, m => {
                let mut exposures = Exposures::new(m, positions, flux, offset, &workers, control)?;
                if let Some(unreliable) = unreliable {
                    exposures = exposures.with_unreliable(unreliable)?;
                }
                if is_relative {
                    exposures = exposures.with_relative_variance();
                }
                Ok(exposures.checked().clone())
            })
        })?;
        drop(borrowed);
        Ok(Self(Arc::new(Data { arrays, checked })))
    }

    /// Minimises F.
    #[pyo3(signature = (*, method, tolerance, max_sweeps, start, workers, progress))]
    fn fit(
        slf: &Bound<'_, Self>,
        method: &str,
        tolerance: f64,
        max_sweeps: Option<u64>,
        start: Option<&Bound<'_, PyStart>>,
        workers: Option<NonZeroUsize>,
        progress: Option<Bound<'_, PyAny>>,
    ) -> PyResult<PyFit> {
        let (py, data) = (slf.py(), &slf.get().0);
        let method = method_named(method).map_err(|error| errors::exception(py, &error))?;
        let options = Options { method, tolerance, max_sweeps };
        let taken = start.map(|start| start.get().take()).transpose();
        let start = taken.map_err(|error| errors::exception(py, &error))?;
        let borrowed = data.arrays.borrow(py)?;
        let measurements = borrowed.view()?;
        let fit = run::interruptible(py, progress.as_ref(), |control| {
            let workers = Workers::new(workers)?;
            either!(measurements, m => {
                let exposures = Exposures::again(m, &data.checked)?;
                calibrate(&exposures, &options, start, &workers, control)
            })
        })?;
        PyFit::new(py, Arc::clone(data), fit)
    }
}

/// The part of a pixel that all shifts have in common, if they differ by whole pixels.
#[pyfunction]
pub(crate) fn common_fraction(shifts: PyReadonlyArray2<'_, f64>) -> PyResult<Option<[f64; 2]>> {
    Ok(Positions::of_shifts(&pairs(&shifts)?).fraction())
}

/// Whether a method takes shifts alone that differ by whole pixels.
#[pyfunction]
pub(crate) fn needs_whole_shifts(py: Python<'_>, method: &str) -> PyResult<bool> {
    let method = method_named(method).map_err(|error| errors::exception(py, &error))?;
    Ok(method.needs_whole_shifts())
}

fn method_named(name: &str) -> Result<Method> {
    match name {
        "multiscale" => Ok(Method::Multiscale),
        "coordinate-descent" => Ok(Method::CoordinateDescent),
        other => Err(Error::Value {
            argument: "method",
            problem: format!("is '{other}': expected 'multiscale' or 'coordinate-descent'"),
        }),
    }
}

/// What is known of the fluxes: the kind, with times or standard deviations.
fn flux_kind((kind, values): (String, Vec<f64>)) -> Result<FluxKind> {
    match kind.as_str() {
        "known" => Ok(FluxKind::Known),
        "fit" => Ok(FluxKind::Free),
        "linear" => Ok(FluxKind::Linear(values)),
        "prior" => Ok(FluxKind::Prior(values)),
        other => Err(Error::Value { argument: "flux", problem: format!("is '{other}'") }),
    }
}

//! `calibrate_frames`, which `Exposures.fit` replaces.

use std::num::NonZeroUsize;

use equipix_core::{
    Ended, Exposures, Fit, Flux, History, Look, Options, Positions, Refinement, Shape, Workers,
    calibrate,
};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyReadonlyArray2};
use pyo3::prelude::*;

use crate::arrays::{
    PyFrames, PyMask, PyMeasurements, PyVariance, either, image, pairs, rotations,
};
use crate::exposures::{flux_kind, method_named};
use crate::{errors, run};

/// What `calibrate` found; see `equipix.Calibration`.
#[pyclass(frozen, get_all, name = "Solution")]
pub(crate) struct PySolution {
    sensitivity: Py<PyArray2<f64>>,
    beam: Py<PyArray2<f64>>,
    coefficients: Option<Py<PyArray2<f64>>>,
    beam_origin: (usize, usize),
    flags: Py<PyArray2<u32>>,
    component_labels: Py<PyArray2<i32>>,
    components: usize,
    sweeps: Py<PyArray1<u64>>,
    objective: Py<PyArray1<f64>>,
    error_estimate: Py<PyArray1<f64>>,
    ended: &'static str,
    degrees_of_freedom: i64,
    flux: Vec<f64>,
    shifts: Option<Vec<[f64; 2]>>,
    offset: Option<Py<PyArray2<f64>>>,
    leaves_tilt: bool,
    refinement: &'static str,
    smallest_ritz: Option<f64>,
    misfit: f64,
}

/// Solves for sensitivity and beam.
#[pyfunction]
#[pyo3(signature = (frames, shifts, *, shift_std, rotation, flux, flux_model, offset, variance, mask,
                    method, tolerance, max_sweeps, workers, progress))]
#[expect(clippy::too_many_arguments, reason = "the keywords of equipix.calibrate")]
pub(crate) fn calibrate_frames(
    py: Python<'_>,
    frames: PyFrames<'_>,
    shifts: PyReadonlyArray2<'_, f64>,
    shift_std: Option<PyReadonlyArray2<'_, f64>>,
    rotation: Vec<i64>,
    flux: Vec<f64>,
    flux_model: (String, Vec<f64>),
    offset: bool,
    variance: Option<PyVariance<'_>>,
    mask: Option<PyMask<'_>>,
    method: &str,
    tolerance: f64,
    max_sweeps: Option<u64>,
    workers: Option<NonZeroUsize>,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<PySolution> {
    let (shifts, std) = (pairs(&shifts)?, shift_std.as_ref().map(pairs).transpose()?);
    let method = method_named(method).map_err(|error| errors::exception(py, &error))?;
    let options = Options { method, tolerance, max_sweeps };
    let arrays = PyMeasurements { frames, variance, mask };
    let measurements = arrays.view()?;
    let (fit, sensor) = run::interruptible(py, progress.as_ref(), |control| {
        let positions = Positions { shifts, rotations: rotations(&rotation)?, std };
        let flux = Flux { values: flux, kind: flux_kind(flux_model)? };
        let workers = Workers::new(workers)?;
        either!(measurements, m => {
            let exposures = Exposures::new(m, positions, flux, offset, &workers, control)?;
            Ok((calibrate(&exposures, &options, None, &workers, control)?, exposures.sensor()))
        })
    })?;
    wrap(py, fit, sensor)
}

fn wrap(py: Python<'_>, solution: Fit, sensor: Shape) -> PyResult<PySolution> {
    let (is_joint, shape) = (solution.is_joint(), solution.beam.shape);
    let History { looks, ended } = solution.history;
    let column = |value: fn(&Look) -> f64| {
        looks.iter().map(value).collect::<Vec<_>>().into_pyarray(py).unbind()
    };
    Ok(PySolution {
        sensitivity: image(py, solution.sensitivity, sensor)?,
        beam: image(py, solution.beam.values.clone(), shape)?,
        coefficients: is_joint
            .then(|| image(py, solution.beam.coefficients.unwrap_or(solution.beam.values), shape))
            .transpose()?,
        beam_origin: solution.beam.origin.into(),
        flags: image(py, solution.flags, sensor)?,
        component_labels: image(py, solution.components.pixels, sensor)?,
        components: solution.components.sizes.len(),
        sweeps: looks.iter().map(|look| look.sweep).collect::<Vec<_>>().into_pyarray(py).unbind(),
        objective: column(|look| look.objective),
        error_estimate: column(|look| look.error),
        ended: match ended {
            Ended::Converged => "converged",
            Ended::SweepsUsed => "sweeps used",
            Ended::Stalled => "stalled",
        },
        degrees_of_freedom: solution.degrees_of_freedom,
        flux: solution.flux,
        shifts: is_joint.then_some(solution.shifts),
        offset: solution.offset.map(|offset| image(py, offset, sensor)).transpose()?,
        leaves_tilt: solution.leaves_tilt,
        refinement: match solution.refinement {
            Refinement::None => "",
            Refinement::NotTried => "as given: the fit ended before",
            Refinement::Undetermined => "as given: the beam tells none",
            Refinement::Done => "refined",
        },
        smallest_ritz: solution.smallest_ritz,
        misfit: solution.misfit,
    })
}

//! The questions that `Fit.uncertainty` replaces.

use std::num::NonZeroUsize;

use equipix_core::{Beam, Exposures, Flux, FluxKind, Positions, Solution, Uncertainty, Workers};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::prelude::*;

use crate::arrays::{
    PyFrames, PyMask, PyMeasurements, PyVariance, either, image, pairs, rotations, shape_of,
};
use crate::exposures::flux_kind;
use crate::run;

/// Attributes of `equipix.uncertainty.Measurements`.
#[derive(FromPyObject)]
pub(crate) struct Measurements<'py> {
    frames: PyFrames<'py>,
    shifts: PyReadonlyArray2<'py, i64>,
    rotation: Vec<i64>,
    flux: Vec<f64>,
    variance: Option<PyVariance<'py>>,
    mask: Option<PyMask<'py>>,
    joint: Option<JointFit<'py>>,
}

/// Attributes of `equipix.uncertainty.JointFit`.
#[derive(FromPyObject)]
pub(crate) struct JointFit<'py> {
    measured: PyReadonlyArray2<'py, f64>,
    shift_std: Option<PyReadonlyArray2<'py, f64>>,
    flux_model: (String, Vec<f64>),
    offset: bool,
    shifts: PyReadonlyArray2<'py, f64>,
    refined: bool,
    unit: f64,
}

macro_rules! answer {
    ($py:expr, $measurements:expr, $sensitivity:expr, $beam:expr, $workers:expr, $progress:expr,
     |$bars:ident| $question:expr) => {{
        let Measurements { frames, shifts, rotation, flux, variance, mask, joint } = $measurements;
        let whole: Vec<[f64; 2]> =
            shifts.as_slice()?.chunks_exact(2).map(|d| [d[0] as f64, d[1] as f64]).collect();
        let (measured, found, std) = match &joint {
            None => (whole.clone(), whole, None),
            Some(joint) => (
                pairs(&joint.measured)?,
                pairs(&joint.shifts)?,
                joint.shift_std.as_ref().map(pairs).transpose()?,
            ),
        };
        let (refined, unit) = joint.as_ref().map_or((false, 1.0), |j| (j.refined, j.unit));
        let offset = joint.as_ref().is_some_and(|j| j.offset);
        let model = joint.as_ref().map(|j| j.flux_model.clone());
        let is_joint = joint.is_some();
        let arrays = PyMeasurements { frames, variance, mask };
        let view = arrays.view()?;
        let (sensitivity, cells) = ($sensitivity.as_slice()?, $beam.as_slice()?);
        let shape = shape_of(&$beam);
        run::interruptible($py, $progress.as_ref(), |control| {
            let positions = Positions { shifts: measured, rotations: rotations(&rotation)?, std };
            let kind = model.map_or(Ok(FluxKind::Known), flux_kind)?;
            let workers = Workers::new($workers)?;
            let solution = Solution {
                sensitivity,
                beam: Beam { values: cells, coefficients: None, tilt: [0.0; 2], shape, origin: [0, 0] },
                flux: &flux,
                shifts: &found,
                refined,
                joint: is_joint,
                unit,
            };
            let flux = Flux { values: flux.clone(), kind };
            either!(view, m => {
                let exposures = Exposures::new(m, positions, flux, offset, &workers, control)?;
                let mut $bars = Uncertainty::new(&exposures, &solution, &workers, control)?;
                $question
            })
        })?
    }};
}

/// The standard deviation of each pixel's M, the draws made, and the relative standard error.
#[pyfunction]
#[pyo3(signature = (measurements, sensitivity, beam, *, workers, progress))]
pub(crate) fn error_map(
    py: Python<'_>,
    measurements: Measurements<'_>,
    sensitivity: PyReadonlyArray2<'_, f64>,
    beam: PyReadonlyArray2<'_, f64>,
    workers: Option<NonZeroUsize>,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<(Py<PyArray2<f64>>, u64, f64)> {
    let shape = shape_of(&sensitivity);
    let map =
        answer!(py, measurements, sensitivity, beam, workers, progress, |bars| bars.error_map());
    Ok((image(py, map.std, shape)?, map.draws, map.exactness))
}

/// The variance of the sum of each functional times M.
#[pyfunction]
#[pyo3(signature = (measurements, sensitivity, beam, *, functionals, workers, progress))]
pub(crate) fn functional_variances(
    py: Python<'_>,
    measurements: Measurements<'_>,
    sensitivity: PyReadonlyArray2<'_, f64>,
    beam: PyReadonlyArray2<'_, f64>,
    functionals: PyReadonlyArray3<'_, f64>,
    workers: Option<NonZeroUsize>,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<Py<PyArray1<f64>>> {
    let stack = functionals.as_slice()?;
    let variances = answer!(py, measurements, sensitivity, beam, workers, progress, |bars| bars
        .variances(stack));
    Ok(variances.into_pyarray(py).unbind())
}

/// The variance of each shift (row, column) that was refined.
#[pyfunction]
#[pyo3(signature = (measurements, sensitivity, beam, *, workers, progress))]
pub(crate) fn shift_variances(
    py: Python<'_>,
    measurements: Measurements<'_>,
    sensitivity: PyReadonlyArray2<'_, f64>,
    beam: PyReadonlyArray2<'_, f64>,
    workers: Option<NonZeroUsize>,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<Vec<[f64; 2]>> {
    let found = answer!(py, measurements, sensitivity, beam, workers, progress, |bars| bars
        .shift_variances());
    Ok(found.unwrap_or_default())
}

/// The variance of what the offsets' errors have in common, and that of one alone.
#[pyfunction]
#[pyo3(signature = (measurements, sensitivity, beam, *, workers, progress))]
pub(crate) fn offset_variances(
    py: Python<'_>,
    measurements: Measurements<'_>,
    sensitivity: PyReadonlyArray2<'_, f64>,
    beam: PyReadonlyArray2<'_, f64>,
    workers: Option<NonZeroUsize>,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<[f64; 2]> {
    let found = answer!(py, measurements, sensitivity, beam, workers, progress, |bars| bars
        .offset_variances());
    Ok(found.unwrap_or_default())
}

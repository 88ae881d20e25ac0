//! `calibrate`: shift calibration.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | frames | float32 or float64, 3 | `Stack<f32>` or `Stack<f64>` | view |
//! | shifts, shift_std | float64, 2 | `Vec<[f64; 2]>` | copy of a few numbers |
//! | rotation, flux, flux_std, time | int64, float64, 1 | `Vec` | copy of a few numbers |
//! | variance | float64, 1, or the frames' dtype, 3 | `Variance` | view |
//! | mask | bool, 2 or 3 | `Mask` | view |

use std::num::NonZeroUsize;

use equipix_core::calibrate::{Method, Solution, calibrate, calibrate_jointly};
use equipix_core::control::Control;
use equipix_core::error::{Error, Result};
use equipix_core::estimate::{Ended, History, Look, Stop};
use equipix_core::frames::{Real, Shape, Stack};
use equipix_core::geometry::{Geometry, Rotation};
use equipix_core::joint::{Flux, Refinement, Unknowns};
use equipix_core::model::{Mask, Model, Variance};
use equipix_core::parallel::Workers;
use numpy::{
    Element, IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2,
    PyReadonlyArray3, PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::{errors, run};

/// Mean frames of either precision.
#[derive(FromPyObject)]
pub(crate) enum Frames<'py> {
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

/// Everything but the frames and their variances, which have a type of their own.
struct Setting<'a> {
    unknowns: Unknowns,
    rotation: Vec<i64>,
    flux: Vec<f64>,
    mask: Mask<'a>,
    method: Method,
    stop: Stop,
    workers: Option<NonZeroUsize>,
}

/// Solves for sensitivity and beam.
#[pyfunction]
#[pyo3(signature = (frames, shifts, *, shift_std, rotation, flux, flux_model, offset, variance, mask,
                    method, tolerance, max_sweeps, workers, progress))]
#[expect(clippy::too_many_arguments, reason = "the keywords of equipix.calibrate")]
pub(crate) fn calibrate_frames(
    py: Python<'_>,
    frames: Frames<'_>,
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
    let unknowns = unknowns(py, &shifts, shift_std.as_ref(), flux_model, offset)?;
    let stop = Stop { tolerance, max_sweeps };
    let mask = mask.as_ref().map_or(Ok(Mask::None), view_mask)?;
    let method = method_named(method).map_err(|error| errors::exception(py, &error))?;
    let setting = Setting { unknowns, rotation, flux, mask, method, stop, workers };
    let progress = progress.as_ref();
    let outcome = match (&frames, &variance) {
        (Frames::Single(frames), Some(PyVariance::Single(variance))) => {
            let (frames, variance) = (stack("frames", frames)?, stack("variance", variance)?);
            let variance = Variance::Measurements(variance);
            run::interruptible(py, progress, |c| solve(frames, variance, &setting, c))
        }
        (Frames::Double(frames), Some(PyVariance::Double(variance))) => {
            let (frames, variance) = (stack("frames", frames)?, stack("variance", variance)?);
            let variance = Variance::Measurements(variance);
            run::interruptible(py, progress, |c| solve(frames, variance, &setting, c))
        }
        (Frames::Single(frames), variance) => {
            let (frames, variance) = (stack("frames", frames)?, by_exposure(variance.as_ref())?);
            run::interruptible(py, progress, |c| solve(frames, variance, &setting, c))
        }
        (Frames::Double(frames), variance) => {
            let (frames, variance) = (stack("frames", frames)?, by_exposure(variance.as_ref())?);
            run::interruptible(py, progress, |c| solve(frames, variance, &setting, c))
        }
    };
    let (solution, sensor) = outcome?;
    wrap(py, solution, sensor)
}

fn solve<T: Real>(
    frames: Stack<'_, T>,
    variance: Variance<'_, T>,
    setting: &Setting<'_>,
    control: &Control,
) -> Result<(Solution, Shape)> {
    let workers = Workers::new(setting.workers)?;
    let rotations = setting.rotation.iter().map(|&degrees| rotation(degrees));
    let rotations = rotations.collect::<Result<Vec<_>>>()?;
    let nearest = |shift: &[f64; 2]| shift.map(|d| d.round_ties_even() as i64);
    let unknowns = &setting.unknowns;
    let shifts: Vec<_> = unknowns.shifts.iter().map(nearest).collect();
    let geometry = Geometry::new(frames.shape(), &shifts, &rotations)?;
    let model =
        Model::new(frames, geometry, &setting.flux, variance, setting.mask, &workers, control)?;
    let solution = if unknowns.is_none() {
        calibrate(&model, setting.method, setting.stop, &workers, control)?
    } else {
        calibrate_jointly(&model, &rotations, unknowns, setting.stop, &workers, control)?
    };
    Ok((solution, model.sensor()))
}

pub(crate) fn unknowns(
    py: Python<'_>,
    shifts: &PyReadonlyArray2<'_, f64>,
    shift_std: Option<&PyReadonlyArray2<'_, f64>>,
    flux_model: (String, Vec<f64>),
    offset: bool,
) -> PyResult<Unknowns> {
    Ok(Unknowns {
        shifts: pairs(shifts)?,
        shift_std: shift_std.map(pairs).transpose()?,
        flux: flux_named(flux_model).map_err(|error| errors::exception(py, &error))?,
        offset,
    })
}

/// Rows of two numbers.
pub(crate) fn pairs(array: &PyReadonlyArray2<'_, f64>) -> PyResult<Vec<[f64; 2]>> {
    Ok(array.as_slice()?.as_chunks().0.to_vec())
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
fn flux_named((kind, values): (String, Vec<f64>)) -> Result<Flux> {
    match kind.as_str() {
        "known" => Ok(Flux::Known),
        "fit" => Ok(Flux::Free),
        "linear" => Ok(Flux::Linear(values)),
        "prior" => Ok(Flux::Prior(values)),
        other => Err(Error::Value { argument: "flux", problem: format!("is '{other}'") }),
    }
}

pub(crate) fn rotation(degrees: i64) -> Result<Rotation> {
    Rotation::from_degrees(degrees).ok_or_else(|| Error::Value {
        argument: "rotation",
        problem: format!("holds {degrees}: expected 0, 90, 180 or 270 degrees"),
    })
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

pub(crate) fn by_exposure<'a, T>(
    variance: Option<&'a PyVariance<'_>>,
) -> PyResult<Variance<'a, T>> {
    match variance {
        Some(PyVariance::Exposures(values)) => Ok(Variance::Exposures(values.as_slice()?)),
        Some(_) => Err(pyo3::exceptions::PyTypeError::new_err("variance: not the frames' dtype")),
        None => Ok(Variance::Unknown),
    }
}

pub(crate) fn view_mask<'a>(mask: &'a PyMask<'_>) -> PyResult<Mask<'a>> {
    Ok(match mask {
        PyMask::Pixels(mask) => Mask::Pixels(mask.as_slice()?),
        PyMask::Measurements(mask) => Mask::Measurements(mask.as_slice()?),
    })
}

fn wrap(py: Python<'_>, solution: Solution, sensor: Shape) -> PyResult<PySolution> {
    let History { looks, ended } = solution.history;
    let column = |value: fn(&Look) -> f64| {
        looks.iter().map(value).collect::<Vec<_>>().into_pyarray(py).unbind()
    };
    Ok(PySolution {
        sensitivity: image(py, solution.sensitivity, sensor)?,
        beam: image(py, solution.beam, solution.beam_shape)?,
        coefficients: solution
            .coefficients
            .map(|values| image(py, values, solution.beam_shape))
            .transpose()?,
        beam_origin: solution.beam_origin.into(),
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
        shifts: solution.shifts,
        offset: solution.offset.map(|offset| image(py, offset, sensor)).transpose()?,
        leaves_tilt: solution.leaves_tilt,
        refinement: match solution.refinement {
            Refinement::None => "",
            Refinement::NotTried => "as given: the fit ended before",
            Refinement::Untold => "as given: the beam tells none",
            Refinement::Done => "refined",
        },
        smallest_ritz: solution.smallest_ritz,
        misfit: solution.objective,
    })
}

pub(crate) fn image<T: Element>(
    py: Python<'_>,
    values: Vec<T>,
    shape: Shape,
) -> PyResult<Py<PyArray2<T>>> {
    Ok(values.into_pyarray(py).reshape([shape.rows, shape.cols])?.unbind())
}

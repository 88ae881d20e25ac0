//! `error_map`, `functional_variances`, `shift_variances` and `offset_variances`: what noise does to a
//! calibration.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | measurements | attributes: frames, variance, mask as for `calibrate`, … | | view |
//! | sensitivity, beam | float64, 2 | `&[f64]` | view |
//! | functionals | float64, 3 | `&[f64]` | view |
//!
//! After a joint fit `beam` holds the coefficients.

use std::num::NonZeroUsize;

use equipix_core::control::Control;
use equipix_core::error::Result;
use equipix_core::frames::{Real, Shape, Stack};
use equipix_core::geometry::Geometry;
use equipix_core::joint::{Solved, Unknowns};
use equipix_core::model::{Mask, Model, Variance};
use equipix_core::parallel::Workers;
use equipix_core::uncertainty;
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::calibrate::{Frames, PyMask, PyVariance};
use crate::calibrate::{by_exposure, image, pairs, rotation, stack, unknowns, view_mask};
use crate::run;

/// Attributes of `equipix.uncertainty.Measurements`.
#[derive(FromPyObject)]
pub(crate) struct Measurements<'py> {
    frames: Frames<'py>,
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

/// Where the measurements were made, which are used, and what was found.
struct Setting<'a> {
    shifts: Vec<[i64; 2]>,
    rotation: &'a [i64],
    flux: &'a [f64],
    mask: Mask<'a>,
    sensitivity: &'a [f64],
    beam: &'a [f64],
    joint: Option<Joint>,
    workers: Option<NonZeroUsize>,
}

struct Joint {
    unknowns: Unknowns,
    shifts: Vec<[f64; 2]>,
    refined: bool,
    unit: f64,
}

/// A solution: M with the beam L, or of a joint fit.
enum Solution<'a> {
    Alone([&'a [f64]; 2]),
    Joint(Solved<'a>),
}

/// What is asked of a solution.
trait Question: Sync {
    type Answer: Send;
    fn ask<T: Real>(
        &self,
        model: &Model<'_, T>,
        solution: &Solution<'_>,
        with: (&Workers, &Control),
    ) -> Result<Self::Answer>;
}

struct OfPixels;
struct OfShifts;
struct OfOffset;
/// Images of weights of M.
struct OfFunctionals<'a>(&'a [f64]);

impl Question for OfPixels {
    type Answer = uncertainty::ErrorMap;
    fn ask<T: Real>(
        &self,
        model: &Model<'_, T>,
        solution: &Solution<'_>,
        (workers, control): (&Workers, &Control),
    ) -> Result<Self::Answer> {
        match solution {
            Solution::Alone([sensitivity, beam]) => {
                uncertainty::error_map(model, sensitivity, beam, workers, control)
            }
            Solution::Joint(solved) => {
                uncertainty::error_map_jointly(model, solved, workers, control)
            }
        }
    }
}

impl Question for OfFunctionals<'_> {
    type Answer = Vec<f64>;
    fn ask<T: Real>(
        &self,
        model: &Model<'_, T>,
        solution: &Solution<'_>,
        (workers, control): (&Workers, &Control),
    ) -> Result<Self::Answer> {
        match solution {
            Solution::Alone([sensitivity, beam]) => {
                uncertainty::variances_of(model, sensitivity, beam, self.0, workers, control)
            }
            Solution::Joint(solved) => {
                uncertainty::variances_of_jointly(model, solved, self.0, workers, control)
            }
        }
    }
}

impl Question for OfShifts {
    type Answer = Vec<[f64; 2]>;
    fn ask<T: Real>(
        &self,
        model: &Model<'_, T>,
        solution: &Solution<'_>,
        (workers, control): (&Workers, &Control),
    ) -> Result<Self::Answer> {
        match solution {
            Solution::Alone(_) => Ok(vec![[0.0; 2]; model.count()]),
            Solution::Joint(solved) => {
                uncertainty::shift_variances(model, solved, workers, control)
            }
        }
    }
}

impl Question for OfOffset {
    type Answer = [f64; 2];
    fn ask<T: Real>(
        &self,
        model: &Model<'_, T>,
        solution: &Solution<'_>,
        (workers, control): (&Workers, &Control),
    ) -> Result<Self::Answer> {
        match solution {
            Solution::Alone(_) => Ok([0.0; 2]),
            Solution::Joint(solved) => {
                uncertainty::offset_variances(model, solved, workers, control)
            }
        }
    }
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
    let setting = setting(py, &measurements, [&sensitivity, &beam], workers)?;
    let map = answer(py, &measurements, &setting, &OfPixels, progress.as_ref())?;
    let shape = sensitivity.shape();
    Ok((image(py, map.std, Shape::new(shape[0], shape[1]))?, map.draws, map.exactness))
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
    let setting = setting(py, &measurements, [&sensitivity, &beam], workers)?;
    let question = OfFunctionals(functionals.as_slice()?);
    let variances = answer(py, &measurements, &setting, &question, progress.as_ref())?;
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
    let setting = setting(py, &measurements, [&sensitivity, &beam], workers)?;
    answer(py, &measurements, &setting, &OfShifts, progress.as_ref())
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
    let setting = setting(py, &measurements, [&sensitivity, &beam], workers)?;
    answer(py, &measurements, &setting, &OfOffset, progress.as_ref())
}

fn setting<'a>(
    py: Python<'_>,
    measurements: &'a Measurements<'_>,
    [sensitivity, beam]: [&'a PyReadonlyArray2<'_, f64>; 2],
    workers: Option<NonZeroUsize>,
) -> PyResult<Setting<'a>> {
    let joint = |fit: &JointFit<'_>| -> PyResult<Joint> {
        let flux_model = fit.flux_model.clone();
        Ok(Joint {
            unknowns: unknowns(py, &fit.measured, fit.shift_std.as_ref(), flux_model, fit.offset)?,
            shifts: pairs(&fit.shifts)?,
            refined: fit.refined,
            unit: fit.unit,
        })
    };
    Ok(Setting {
        shifts: measurements.shifts.as_slice()?.as_chunks().0.to_vec(),
        rotation: &measurements.rotation,
        flux: &measurements.flux,
        mask: measurements.mask.as_ref().map_or(Ok(Mask::None), view_mask)?,
        sensitivity: sensitivity.as_slice()?,
        beam: beam.as_slice()?,
        joint: measurements.joint.as_ref().map(joint).transpose()?,
        workers,
    })
}

fn answer<Q: Question>(
    py: Python<'_>,
    measurements: &Measurements<'_>,
    setting: &Setting<'_>,
    question: &Q,
    progress: Option<&Bound<'_, PyAny>>,
) -> PyResult<Q::Answer> {
    match (&measurements.frames, measurements.variance.as_ref()) {
        (Frames::Single(frames), Some(PyVariance::Single(variance))) => {
            let (frames, variance) = (stack("frames", frames)?, stack("variance", variance)?);
            let variance = Variance::Measurements(variance);
            run::interruptible(py, progress, |c| ask(frames, variance, setting, question, c))
        }
        (Frames::Double(frames), Some(PyVariance::Double(variance))) => {
            let (frames, variance) = (stack("frames", frames)?, stack("variance", variance)?);
            let variance = Variance::Measurements(variance);
            run::interruptible(py, progress, |c| ask(frames, variance, setting, question, c))
        }
        (Frames::Single(frames), variance) => {
            let (frames, variance) = (stack("frames", frames)?, by_exposure(variance)?);
            run::interruptible(py, progress, |c| ask(frames, variance, setting, question, c))
        }
        (Frames::Double(frames), variance) => {
            let (frames, variance) = (stack("frames", frames)?, by_exposure(variance)?);
            run::interruptible(py, progress, |c| ask(frames, variance, setting, question, c))
        }
    }
}

fn ask<T: Real, Q: Question>(
    frames: Stack<'_, T>,
    variance: Variance<'_, T>,
    setting: &Setting<'_>,
    question: &Q,
    control: &Control,
) -> Result<Q::Answer> {
    let workers = Workers::new(setting.workers)?;
    let rotations = setting.rotation.iter().map(|&degrees| rotation(degrees));
    let rotations = rotations.collect::<Result<Vec<_>>>()?;
    let geometry = Geometry::new(frames.shape(), &setting.shifts, &rotations)?;
    let (flux, mask) = (setting.flux, setting.mask);
    let model = Model::new(frames, geometry, flux, variance, mask, &workers, control)?;
    let solution = setting.joint.as_ref().map_or(
        Solution::Alone([setting.sensitivity, setting.beam]),
        |joint| {
            Solution::Joint(Solved {
                unknowns: &joint.unknowns,
                rotations: &rotations,
                sensitivity: setting.sensitivity,
                coefficients: setting.beam,
                shifts: &joint.shifts,
                refined: joint.refined,
                unit: joint.unit,
            })
        },
    );
    question.ask(&model, &solution, (&workers, control))
}

//! `error_map` and `functional_variances`: what noise does to a calibration.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | frames, shifts, rotation, flux, variance, mask | as for `calibrate` | | |
//! | sensitivity, beam | float64, 2 | `&[f64]` | view |
//! | functionals | float64, 3 | `&[f64]` | view |

use std::num::NonZeroUsize;

use equipix_core::control::Control;
use equipix_core::error::Result;
use equipix_core::frames::{Real, Stack};
use equipix_core::geometry::Geometry;
use equipix_core::model::{Mask, Model, Variance};
use equipix_core::parallel::Workers;
use equipix_core::uncertainty;
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::calibrate::{Frames, PyMask, PyVariance};
use crate::calibrate::{by_exposure, image, rotation, stack, view_mask};
use crate::run;

/// Where the measurements were made, and which are used.
struct Setting<'a> {
    shifts: Vec<[i64; 2]>,
    rotation: Vec<i64>,
    flux: Vec<f64>,
    mask: Mask<'a>,
    workers: Option<NonZeroUsize>,
}

/// What is asked of a solution M and L.
trait Question: Sync {
    type Answer: Send;
    fn ask<T: Real>(
        &self,
        model: &Model<'_, T>,
        with: (&Workers, &Control),
    ) -> Result<Self::Answer>;
}

struct OfPixels<'a>([&'a [f64]; 2]);
struct OfFunctionals<'a>([&'a [f64]; 2], &'a [f64]);

impl Question for OfPixels<'_> {
    type Answer = uncertainty::ErrorMap;
    fn ask<T: Real>(
        &self,
        model: &Model<'_, T>,
        (workers, control): (&Workers, &Control),
    ) -> Result<Self::Answer> {
        uncertainty::error_map(model, self.0[0], self.0[1], workers, control)
    }
}

impl Question for OfFunctionals<'_> {
    type Answer = Vec<f64>;
    fn ask<T: Real>(
        &self,
        model: &Model<'_, T>,
        (workers, control): (&Workers, &Control),
    ) -> Result<Self::Answer> {
        let [sensitivity, beam] = self.0;
        uncertainty::variances_of(model, sensitivity, beam, self.1, workers, control)
    }
}

/// The standard deviation of each pixel's M, the draws made, and the relative standard error.
#[pyfunction]
#[pyo3(signature = (frames, shifts, *, rotation, flux, variance, mask, sensitivity, beam, workers,
                    progress))]
#[expect(clippy::too_many_arguments, reason = "the measurements, one by one")]
pub(crate) fn error_map(
    py: Python<'_>,
    frames: Frames<'_>,
    shifts: PyReadonlyArray2<'_, i64>,
    rotation: Vec<i64>,
    flux: Vec<f64>,
    variance: Option<PyVariance<'_>>,
    mask: Option<PyMask<'_>>,
    sensitivity: PyReadonlyArray2<'_, f64>,
    beam: PyReadonlyArray2<'_, f64>,
    workers: Option<NonZeroUsize>,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<(Py<PyArray2<f64>>, u64, f64)> {
    let question = OfPixels([sensitivity.as_slice()?, beam.as_slice()?]);
    let setting = setting(&shifts, rotation, flux, mask.as_ref(), workers)?;
    let map = answer(py, &frames, variance.as_ref(), &setting, &question, progress.as_ref())?;
    let shape = sensitivity.shape();
    let shape = equipix_core::frames::Shape::new(shape[0], shape[1]);
    Ok((image(py, map.std, shape)?, map.draws, map.exactness))
}

/// The variance of the sum of each functional times M.
#[pyfunction]
#[pyo3(signature = (frames, shifts, *, rotation, flux, variance, mask, sensitivity, beam,
                    functionals, workers, progress))]
#[expect(clippy::too_many_arguments, reason = "the measurements, one by one")]
pub(crate) fn functional_variances(
    py: Python<'_>,
    frames: Frames<'_>,
    shifts: PyReadonlyArray2<'_, i64>,
    rotation: Vec<i64>,
    flux: Vec<f64>,
    variance: Option<PyVariance<'_>>,
    mask: Option<PyMask<'_>>,
    sensitivity: PyReadonlyArray2<'_, f64>,
    beam: PyReadonlyArray2<'_, f64>,
    functionals: PyReadonlyArray3<'_, f64>,
    workers: Option<NonZeroUsize>,
    progress: Option<Bound<'_, PyAny>>,
) -> PyResult<Py<PyArray1<f64>>> {
    let solved = [sensitivity.as_slice()?, beam.as_slice()?];
    let question = OfFunctionals(solved, functionals.as_slice()?);
    let setting = setting(&shifts, rotation, flux, mask.as_ref(), workers)?;
    let variances = answer(py, &frames, variance.as_ref(), &setting, &question, progress.as_ref())?;
    Ok(variances.into_pyarray(py).unbind())
}

fn setting<'a>(
    shifts: &PyReadonlyArray2<'_, i64>,
    rotation: Vec<i64>,
    flux: Vec<f64>,
    mask: Option<&'a PyMask<'_>>,
    workers: Option<NonZeroUsize>,
) -> PyResult<Setting<'a>> {
    let shifts = shifts.as_slice()?.chunks_exact(2).map(|d| [d[0], d[1]]).collect();
    let mask = mask.map_or(Ok(Mask::None), view_mask)?;
    Ok(Setting { shifts, rotation, flux, mask, workers })
}

fn answer<Q: Question>(
    py: Python<'_>,
    frames: &Frames<'_>,
    variance: Option<&PyVariance<'_>>,
    setting: &Setting<'_>,
    question: &Q,
    progress: Option<&Bound<'_, PyAny>>,
) -> PyResult<Q::Answer> {
    match (frames, variance) {
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
    let (flux, mask) = (&setting.flux, setting.mask);
    let model = Model::new(frames, geometry, flux, variance, mask, &workers, control)?;
    question.ask(&model, (&workers, control))
}

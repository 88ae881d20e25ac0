//! `SceneCorrection`: gain and offset from the scene, frame by frame.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | frame | uint8, uint16, float32 or float64, 2 | `&[T]` | view |
//! | corrected | float32, 2 | `&mut [f32]` | view |
//! | maps of a state | float32, 2 | `Vec<f32>` | copy, kept |
//!
//! An update lasts milliseconds, and half of one would leave the state without its gauge. So it is not
//! cancelled: signals are checked between updates.

use std::num::NonZeroUsize;
use std::sync::{Mutex, MutexGuard, PoisonError};

use equipix_core::frames::Sample;
use equipix_core::scene::{Options, SceneCorrection, Snapshot};
use equipix_core::{Shape, Workers};
use numpy::{
    Element, IntoPyArray, PyArray2, PyArrayMethods, PyReadonlyArray2, PyReadwriteArray2,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::arrays::image;
use crate::{errors, run};

/// A raw frame of any type that cameras deliver, the most frequent first: each type that does not fit takes time.
#[derive(FromPyObject)]
pub(crate) enum PyFrame<'py> {
    #[pyo3(transparent)]
    U16(PyReadonlyArray2<'py, u16>),
    #[pyo3(transparent)]
    U8(PyReadonlyArray2<'py, u8>),
    #[pyo3(transparent)]
    F32(PyReadonlyArray2<'py, f32>),
    #[pyo3(transparent)]
    F64(PyReadonlyArray2<'py, f64>),
}

type Map = Py<PyArray2<f32>>;
/// Maps and counts, by name.
type State = (Vec<(String, Map)>, Vec<(String, u64)>);

/// A correction that learns from the scene.
#[pyclass(frozen, module = "equipix._native", name = "SceneCorrection")]
pub(crate) struct PySceneCorrection(Mutex<SceneCorrection>);

impl PySceneCorrection {
    fn made(
        py: Python<'_>,
        shape: (usize, usize),
        data_range: [f64; 2],
        options: &Options,
    ) -> PyResult<Self> {
        let made = SceneCorrection::new(Shape::new(shape.0, shape.1), data_range, options);
        made.map(|made| Self(Mutex::new(made))).map_err(|error| errors::exception(py, &error))
    }

    fn lock(&self) -> MutexGuard<'_, SceneCorrection> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn learn<T: Sample + Element>(
        &self,
        py: Python<'_>,
        frame: &PyReadonlyArray2<'_, T>,
        corrected: &mut PyReadwriteArray2<'_, f32>,
        saturation: Option<f64>,
        workers: Option<NonZeroUsize>,
    ) -> PyResult<bool> {
        let (frame, corrected) = (frame.as_slice()?, corrected.as_slice_mut()?);
        run::brief(py, |_| {
            self.lock().update(frame, corrected, saturation, &Workers::new(workers)?)
        })
    }
}

#[pymethods]
impl PySceneCorrection {
    #[staticmethod]
    fn local_mean(
        py: Python<'_>,
        shape: (usize, usize),
        data_range: [f64; 2],
        step: f64,
        kernel: PyReadonlyArray2<'_, f64>,
    ) -> PyResult<Self> {
        let sizes = [kernel.shape()[0], kernel.shape()[1]];
        let kernel = kernel.as_slice()?.to_vec();
        Self::made(py, shape, data_range, &Options::LocalMean { step, kernel, sizes })
    }

    #[staticmethod]
    fn gated(
        py: Python<'_>,
        shape: (usize, usize),
        data_range: [f64; 2],
        step: f64,
        width: usize,
        threshold: f64,
        texture: f64,
    ) -> PyResult<Self> {
        Self::made(py, shape, data_range, &Options::Gated { step, width, threshold, texture })
    }

    #[staticmethod]
    #[allow(clippy::too_many_arguments, reason = "the options of a method, one by one")]
    fn registered(
        py: Python<'_>,
        shape: (usize, usize),
        data_range: [f64; 2],
        step: f64,
        least_motion: f64,
        most_motion: usize,
        cutoff: f64,
        agreement: f64,
    ) -> PyResult<Self> {
        let options = Options::Registered { step, least_motion, most_motion, cutoff, agreement };
        Self::made(py, shape, data_range, &options)
    }

    #[staticmethod]
    fn constant_statistics(
        py: Python<'_>,
        shape: (usize, usize),
        data_range: [f64; 2],
        width: usize,
        window: u64,
        motion: f64,
        prior: u64,
    ) -> PyResult<Self> {
        Self::made(
            py,
            shape,
            data_range,
            &Options::ConstantStatistics { width, window, motion, prior },
        )
    }

    #[staticmethod]
    #[allow(clippy::too_many_arguments, reason = "the options of a method, one by one")]
    fn kalman(
        py: Python<'_>,
        shape: (usize, usize),
        data_range: [f64; 2],
        width: usize,
        block: u64,
        motion: f64,
        gain_spread: f64,
        offset_spread: f64,
        memory: f64,
    ) -> PyResult<Self> {
        let options = Options::Kalman { width, block, motion, gain_spread, offset_spread, memory };
        Self::made(py, shape, data_range, &options)
    }

    /// Corrects a frame into `corrected`, then learns from it; whether it counted.
    #[pyo3(signature = (frame, corrected, *, saturation, workers))]
    fn update(
        &self,
        py: Python<'_>,
        frame: PyFrame<'_>,
        mut corrected: PyReadwriteArray2<'_, f32>,
        saturation: Option<f64>,
        workers: Option<NonZeroUsize>,
    ) -> PyResult<bool> {
        match frame {
            PyFrame::U8(frame) => self.learn(py, &frame, &mut corrected, saturation, workers),
            PyFrame::U16(frame) => self.learn(py, &frame, &mut corrected, saturation, workers),
            PyFrame::F32(frame) => self.learn(py, &frame, &mut corrected, saturation, workers),
            PyFrame::F64(frame) => self.learn(py, &frame, &mut corrected, saturation, workers),
        }
    }

    /// Number of frames that counted.
    fn frames(&self, py: Python<'_>) -> PyResult<u64> {
        run::brief(py, |_| Ok(self.lock().frames()))
    }

    /// Number of usable frames that were given.
    fn taken(&self, py: Python<'_>) -> PyResult<u64> {
        run::brief(py, |_| Ok(self.lock().taken()))
    }

    /// Standard deviation of each pixel over the usable frames, on the scale [0, 1].
    fn deviation(&self, py: Python<'_>) -> PyResult<Map> {
        let (found, shape) = run::brief(py, |_| {
            let scene = self.lock();
            Ok((scene.deviation(), scene.shape()))
        })?;
        image(py, found, shape)
    }

    /// Number of frames that were refused since they are far from the ones around them.
    fn foreign(&self, py: Python<'_>) -> PyResult<u64> {
        run::brief(py, |_| Ok(self.lock().foreign()))
    }

    /// Share of the field that does not move, from 51 frames on.
    fn still(&self, py: Python<'_>) -> PyResult<Option<f64>> {
        run::brief(py, |_| Ok(self.lock().still()))
    }

    /// Standard deviation of the pattern that is left, on the scale [0, 1].
    fn floor(&self, py: Python<'_>, workers: Option<NonZeroUsize>) -> PyResult<Option<f64>> {
        run::brief(py, |_| Ok(self.lock().floor(&Workers::new(workers)?)))
    }

    /// Masks pixels.
    fn mask(&self, py: Python<'_>, mask: PyReadonlyArray2<'_, bool>) -> PyResult<()> {
        let mask = mask.as_slice()?;
        run::brief(py, |_| self.lock().mask(mask))
    }

    /// Gain of each pixel, and offset on the scale [0, 1].
    fn coefficients(&self, py: Python<'_>) -> PyResult<(Map, Map)> {
        let (gain, offset, shape) = run::brief(py, |_| {
            let scene = self.lock();
            Ok((scene.gain().to_vec(), scene.offset().to_vec(), scene.shape()))
        })?;
        Ok((image(py, gain, shape)?, image(py, offset, shape)?))
    }

    /// Variances of gain and offset, of a method that has them.
    fn variances(&self, py: Python<'_>) -> PyResult<Option<(Map, Map)>> {
        let (found, shape) = run::brief(py, |_| {
            let scene = self.lock();
            Ok((scene.variances(), scene.shape()))
        })?;
        let Some([gain, offset]) = found else { return Ok(None) };
        Ok(Some((image(py, gain, shape)?, image(py, offset, shape)?)))
    }

    /// All that is remembered: maps and counts by name.
    fn state(&self, py: Python<'_>) -> PyResult<State> {
        let Snapshot { maps, counts } = run::brief(py, |_| Ok(self.lock().snapshot()))?;
        let map = |(name, sizes, values): (String, [usize; 2], Vec<f32>)| {
            PyResult::Ok((name, values.into_pyarray(py).reshape(sizes)?.unbind()))
        };
        Ok((maps.into_iter().map(map).collect::<PyResult<_>>()?, counts))
    }

    /// Goes on from such a state.
    fn restore(
        &self,
        py: Python<'_>,
        maps: Vec<(String, PyReadonlyArray2<'_, f32>)>,
        counts: Vec<(String, u64)>,
    ) -> PyResult<()> {
        let map = |(name, values): (String, PyReadonlyArray2<'_, f32>)| {
            let sizes = [values.shape()[0], values.shape()[1]];
            PyResult::Ok((name, sizes, values.as_slice()?.to_vec()))
        };
        let maps = maps.into_iter().map(map).collect::<PyResult<_>>()?;
        run::brief(py, |_| self.lock().restore(&Snapshot { maps, counts }))
    }
}

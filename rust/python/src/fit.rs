//! `Fit`, `Beam` and `Uncertainty`: what a calibration found, and what can be asked of it.
//!
//! Large arrays move into NumPy without a copy, read-only; a question views them again.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | values, coefficients | float64, 2 | `Beam<&[f64]>` | view |
//! | functionals, dark_variance | float64, 3 and 2 | `&[f64]` | view |
//! | sensitivity, flags | float64 and uint32, 2 | `&[f64]`, `&[u32]` | view; copied into a start |
//! | lost, an array for each exposure | uintp, 1 | `Vec<&[usize]>` | view |

use std::num::NonZeroUsize;
use std::sync::{Arc, Mutex, PoisonError};

use equipix_core::{
    Beam, Control, Ended, Error, Exposures, Fit, History, Look, Real, Refinement, Result, Shape,
    Solution, Start, Uncertainty, Workers, misfit_by_dark,
};
use numpy::{
    PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3,
};
use pyo3::prelude::*;

use crate::arrays::{either, image, read_only, rotation, shape_of};
use crate::data::Data;
use crate::run;

/// The beam on its grid.
#[pyclass(frozen, get_all, module = "equipix._native", name = "Beam")]
pub(crate) struct PyBeam {
    values: Py<PyArray2<f64>>,
    coefficients: Option<Py<PyArray2<f64>>>,
    origin: (f64, f64),
    tilt: [f64; 2],
}

#[pymethods]
impl PyBeam {
    #[new]
    #[pyo3(signature = (values, coefficients, origin, *, tilt = [0.0, 0.0]))]
    const fn new(
        values: Py<PyArray2<f64>>,
        coefficients: Option<Py<PyArray2<f64>>>,
        origin: (f64, f64),
        tilt: [f64; 2],
    ) -> Self {
        Self { values, coefficients, origin, tilt }
    }

    /// The light L(u) on each pixel of a sensor, without the flux.
    #[pyo3(signature = (shape, shift, rotation, *, workers))]
    fn light(
        &self,
        py: Python<'_>,
        shape: (usize, usize),
        shift: [f64; 2],
        rotation: i64,
        workers: Option<NonZeroUsize>,
    ) -> PyResult<Py<PyArray2<f64>>> {
        let (borrowed, sensor) = (self.borrow(py), Shape::new(shape.0, shape.1));
        let beam = borrowed.view()?;
        let light = run::brief(py, |_| {
            let turned = self::rotation(rotation)?;
            Ok(beam.light(shift, turned, sensor, &Workers::new(workers)?))
        })?;
        image(py, light, sensor)
    }
}

impl PyBeam {
    fn of(py: Python<'_>, beam: Beam) -> PyResult<Self> {
        let Beam { values, coefficients, tilt, shape, origin } = beam;
        let coefficients = coefficients.map(|values| image(py, values, shape)).transpose()?;
        Ok(Self { values: image(py, values, shape)?, coefficients, origin: origin.into(), tilt })
    }

    fn borrow<'py>(&self, py: Python<'py>) -> BorrowedBeam<'py> {
        BorrowedBeam {
            values: self.values.bind(py).readonly(),
            coefficients: self.coefficients.as_ref().map(|values| values.bind(py).readonly()),
            origin: self.origin.into(),
            tilt: self.tilt,
        }
    }
}

/// The arrays of a beam, borrowed.
struct BorrowedBeam<'py> {
    values: PyReadonlyArray2<'py, f64>,
    coefficients: Option<PyReadonlyArray2<'py, f64>>,
    origin: [f64; 2],
    tilt: [f64; 2],
}

impl BorrowedBeam<'_> {
    fn view(&self) -> PyResult<Beam<&[f64]>> {
        let (values, shape) = (self.values.as_slice()?, shape_of(&self.values));
        let coefficients = self.coefficients.as_ref().map(|c| c.as_slice()).transpose()?;
        Ok(Beam { values, coefficients, tilt: self.tilt, shape, origin: self.origin })
    }
}

/// What a calibration found; see `equipix.Calibration`.
#[pyclass(frozen, module = "equipix._native", name = "Fit")]
pub(crate) struct PyFit {
    data: Arc<Data>,
    #[pyo3(get)]
    sensitivity: Py<PyArray2<f64>>,
    #[pyo3(get)]
    beam: Py<PyBeam>,
    #[pyo3(get)]
    flags: Py<PyArray2<u32>>,
    #[pyo3(get)]
    component_labels: Py<PyArray2<i32>>,
    #[pyo3(get)]
    components: usize,
    #[pyo3(get)]
    flux: Vec<f64>,
    #[pyo3(get)]
    shifts: Vec<[f64; 2]>,
    #[pyo3(get)]
    offset: Option<Py<PyArray2<f64>>>,
    #[pyo3(get)]
    sweeps: Py<PyArray1<u64>>,
    #[pyo3(get)]
    objective: Py<PyArray1<f64>>,
    #[pyo3(get)]
    error_estimate: Py<PyArray1<f64>>,
    #[pyo3(get)]
    ended: &'static str,
    #[pyo3(get)]
    misfit: f64,
    #[pyo3(get)]
    degrees_of_freedom: i64,
    #[pyo3(get)]
    unit: f64,
    #[pyo3(get)]
    smallest_ritz: Option<f64>,
    #[pyo3(get)]
    leaves_tilt: bool,
    refinement: Refinement,
    #[pyo3(get)]
    is_joint: bool,
    #[pyo3(get)]
    few: Option<Py<PyArray2<bool>>>,
    #[pyo3(get)]
    lost: Vec<Py<PyArray1<usize>>>,
    /// The weights of the prior of M on pixels in weak light.
    prior: Option<Arc<[f64]>>,
}

#[pymethods]
impl PyFit {
    /// The weights λ of the prior of M on pixels in weak light, if there are such.
    #[getter]
    fn prior(&self, py: Python<'_>) -> PyResult<Option<Py<PyArray2<f64>>>> {
        let weights = self.prior.as_ref().map(|weights| weights.to_vec());
        weights.map(|weights| image(py, weights, self.data.checked.sensor())).transpose()
    }

    /// The initial state of another fit: this one.
    fn start(&self, py: Python<'_>) -> PyResult<PyStart> {
        let borrowed = self.borrow(py);
        let solution = borrowed.solution()?;
        let start = run::interruptible(py, None, |_| solution.start())?;
        Ok(PyStart(Mutex::new(Some(start))))
    }

    /// What became of shifts that were to be refined.
    #[getter]
    const fn refinement(&self) -> &'static str {
        refinement_code(self.refinement)
    }

    /// D = Σ w c² L² of each pixel.
    #[pyo3(signature = (*, workers))]
    fn information(
        &self,
        py: Python<'_>,
        workers: Option<NonZeroUsize>,
    ) -> PyResult<Py<PyArray2<f64>>> {
        let (arrays, borrowed) = (self.data.arrays.borrow(py)?, self.borrow(py));
        let (measurements, solution) = (arrays.view()?, borrowed.solution()?);
        let checked = &self.data.checked;
        let found = run::interruptible(py, None, |control| {
            let workers = Workers::new(workers)?;
            either!(measurements, m => {
                solution.information(&Exposures::again(m, checked)?, &workers, control)
            })
        })?;
        image(py, found, checked.sensor())
    }

    /// What the noise of a dark that was subtracted from all exposures adds to F on average.
    #[pyo3(signature = (dark_variance, *, workers))]
    fn dark_misfit(
        &self,
        py: Python<'_>,
        dark_variance: PyReadonlyArray2<'_, f64>,
        workers: Option<NonZeroUsize>,
    ) -> PyResult<f64> {
        let (arrays, borrowed) = (self.data.arrays.borrow(py)?, self.borrow(py));
        let (measurements, solution) = (arrays.view()?, borrowed.solution()?);
        let (checked, variance) = (&self.data.checked, dark_variance.as_slice()?);
        run::interruptible(py, None, |control| {
            let workers = Workers::new(workers)?;
            either!(measurements, m => {
                let exposures = Exposures::again(m, checked)?;
                workers.enter(|| {
                    misfit_by_dark(&exposures, &solution, variance, &workers, control)
                })
            })
        })
    }

    /// Answers what is asked of it, from one linear problem.
    #[pyo3(signature = (*, error_map, functionals, shifts, offset, workers, progress,
                        dark_variance=None))]
    #[expect(clippy::too_many_arguments, reason = "the questions that there are")]
    fn uncertainty(
        &self,
        py: Python<'_>,
        error_map: bool,
        functionals: Option<PyReadonlyArray3<'_, f64>>,
        shifts: bool,
        offset: bool,
        workers: Option<NonZeroUsize>,
        progress: Option<Bound<'_, PyAny>>,
        dark_variance: Option<PyReadonlyArray2<'_, f64>>,
    ) -> PyResult<PyUncertainty> {
        let functionals = functionals.as_ref().map(|stack| stack.as_slice()).transpose()?;
        let dark = dark_variance.as_ref().map(|image| image.as_slice()).transpose()?;
        let questions = Questions { error_map, functionals, shifts, offset, dark };
        let (arrays, borrowed) = (self.data.arrays.borrow(py)?, self.borrow(py));
        let (measurements, solution) = (arrays.view()?, borrowed.solution()?);
        let checked = &self.data.checked;
        let answers = run::interruptible(py, progress.as_ref(), |control| {
            let workers = Workers::new(workers)?;
            either!(measurements, m => {
                let exposures = Exposures::again(m, checked)?;
                workers.enter(|| questions.ask(&exposures, &solution, &workers, control))
            })
        })?;
        PyUncertainty::new(py, answers, checked.sensor())
    }
}

impl PyFit {
    /// The result of a fit of the exposures of these arrays.
    pub(crate) fn new(py: Python<'_>, data: Arc<Data>, fit: Fit) -> PyResult<Self> {
        let sensor = data.checked.sensor();
        let (unit, is_joint) = (fit.unit(), fit.is_joint());
        let History { looks, ended } = fit.history;
        let column = |value: fn(&Look) -> f64| looks.iter().map(value).collect::<Vec<_>>();
        let sweeps: Vec<_> = looks.iter().map(|look| look.sweep).collect();
        Ok(Self {
            data,
            sensitivity: image(py, fit.sensitivity, sensor)?,
            beam: Py::new(py, PyBeam::of(py, fit.beam)?)?,
            flags: image(py, fit.flags, sensor)?,
            component_labels: image(py, fit.components.pixels, sensor)?,
            components: fit.components.sizes.len(),
            flux: fit.flux,
            shifts: fit.shifts,
            offset: fit.offset.map(|offset| image(py, offset, sensor)).transpose()?,
            sweeps: read_only(py, sweeps)?,
            objective: read_only(py, column(|look| look.objective))?,
            error_estimate: read_only(py, column(|look| look.error))?,
            ended: ended_code(ended),
            misfit: fit.misfit,
            degrees_of_freedom: fit.degrees_of_freedom,
            unit,
            smallest_ritz: fit.smallest_ritz,
            leaves_tilt: fit.leaves_tilt,
            refinement: fit.refinement,
            is_joint,
            few: fit.few.map(|few| image(py, few, sensor)).transpose()?,
            lost: fit
                .lost
                .into_iter()
                .map(|pixels| read_only(py, pixels))
                .collect::<PyResult<_>>()?,
            prior: fit.prior,
        })
    }

    /// The arrays of the solution, borrowed.
    pub(crate) fn borrow<'py>(&'py self, py: Python<'py>) -> BorrowedFit<'py> {
        let (sensitivity, flags) = (self.sensitivity.bind(py), self.flags.bind(py));
        BorrowedFit {
            fit: self,
            sensitivity: sensitivity.readonly(),
            flags: flags.readonly(),
            beam: self.beam.get().borrow(py),
            lost: self.lost.iter().map(|pixels| pixels.bind(py).readonly()).collect(),
        }
    }
}

/// The initial state of a fit, which consumes it.
#[pyclass(frozen, module = "equipix._native", name = "Start")]
pub(crate) struct PyStart(Mutex<Option<Start>>);

impl PyStart {
    pub(crate) fn take(&self) -> Result<Start> {
        let taken = self.0.lock().unwrap_or_else(PoisonError::into_inner).take();
        taken.ok_or_else(|| Error::Value {
            argument: "start",
            problem: "was taken by an earlier fit: call start() of its fit again".into(),
        })
    }
}

/// The arrays of a fit, borrowed.
pub(crate) struct BorrowedFit<'py> {
    fit: &'py PyFit,
    sensitivity: PyReadonlyArray2<'py, f64>,
    flags: PyReadonlyArray2<'py, u32>,
    beam: BorrowedBeam<'py>,
    lost: Vec<PyReadonlyArray1<'py, usize>>,
}

impl BorrowedFit<'_> {
    pub(crate) fn solution(&self) -> PyResult<Solution<'_>> {
        Ok(Solution {
            sensitivity: self.sensitivity.as_slice()?,
            flags: self.flags.as_slice()?,
            beam: self.beam.view()?,
            flux: &self.fit.flux,
            shifts: &self.fit.shifts,
            refinement: self.fit.refinement,
            joint: self.fit.is_joint,
            unit: self.fit.unit,
            prior: self.fit.prior.clone(),
            lost: self.lost.iter().map(|pixels| Ok(pixels.as_slice()?)).collect::<PyResult<_>>()?,
        })
    }
}

/// Which pixels count for the slope of ln M.
#[pyfunction]
pub(crate) fn slope_pixels(
    sensitivity: PyReadonlyArray2<'_, f64>,
    flags: PyReadonlyArray2<'_, u32>,
) -> PyResult<Py<PyArray2<bool>>> {
    let counted = equipix_core::slope_pixels(sensitivity.as_slice()?, flags.as_slice()?);
    image(sensitivity.py(), counted, shape_of(&sensitivity))
}

/// Answers, in units of the variance of a value of weight 1; `None` for what was not asked.
#[pyclass(frozen, get_all, module = "equipix._native", name = "Uncertainty")]
pub(crate) struct PyUncertainty {
    std: Option<Py<PyArray2<f64>>>,
    draws: u64,
    exactness: f64,
    variances: Option<Py<PyArray1<f64>>>,
    shift_variances: Option<Vec<[f64; 2]>>,
    offset_variances: Option<(f64, f64)>,
    incomplete: u64,
}

impl PyUncertainty {
    fn new(py: Python<'_>, answers: Answers, sensor: Shape) -> PyResult<Self> {
        let (draws, exactness) =
            answers.map.as_ref().map_or((0, f64::NAN), |map| (map.draws, map.exactness));
        Ok(Self {
            std: answers.map.map(|map| image(py, map.std, sensor)).transpose()?,
            draws,
            exactness,
            variances: answers.variances.map(|values| read_only(py, values)).transpose()?,
            shift_variances: answers.shifts,
            offset_variances: answers.offset.map(Into::into),
            incomplete: answers.incomplete,
        })
    }
}

/// What is asked of a fit.
struct Questions<'a> {
    error_map: bool,
    /// Images of weights of M.
    functionals: Option<&'a [f64]>,
    shifts: bool,
    offset: bool,
    /// The variance by pixel of a dark that was subtracted from all exposures.
    dark: Option<&'a [f64]>,
}

struct Answers {
    map: Option<equipix_core::ErrorMap>,
    variances: Option<Vec<f64>>,
    shifts: Option<Vec<[f64; 2]>>,
    offset: Option<[f64; 2]>,
    incomplete: u64,
}

impl Questions<'_> {
    fn ask<T: Real>(
        &self,
        exposures: &Exposures<'_, T>,
        solution: &Solution<'_>,
        workers: &Workers,
        control: &Control,
    ) -> Result<Answers> {
        let mut bars = Uncertainty::new(exposures, solution, workers, control)?;
        if let Some(variance) = self.dark {
            bars = bars.with_dark(variance)?;
        }
        let answers = Answers {
            map: self.error_map.then(|| bars.error_map()).transpose()?,
            variances: self.functionals.map(|stack| bars.variances(stack)).transpose()?,
            shifts: if self.shifts { bars.shift_variances()? } else { None },
            offset: if self.offset { bars.offset_variances()? } else { None },
            incomplete: 0,
        };
        Ok(Answers { incomplete: bars.incomplete(), ..answers })
    }
}

const fn ended_code(ended: Ended) -> &'static str {
    match ended {
        Ended::Converged => "converged",
        Ended::SweepsUsed => "sweeps used",
        Ended::Stalled => "stalled",
    }
}

const fn refinement_code(refinement: Refinement) -> &'static str {
    match refinement {
        Refinement::None => "none",
        Refinement::NotTried => "not tried",
        Refinement::Undetermined => "undetermined",
        Refinement::Along(_) | Refinement::Done => "refined",
    }
}

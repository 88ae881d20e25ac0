//! Python binding of [`equipix_core`], the module `equipix._native`.
//!
//! Every function views its arrays, calls the core through `run::interruptible` (which releases
//! the GIL, shows progress and hears Ctrl-C), maps the error and wraps the result; nothing else.
//! The Python layer hands over C-contiguous arrays in native byte order, so nothing is copied here.
//!
//! Callers must not change an array from another thread while a call reads it.

mod apply;
mod arrays;
mod average;
mod centroid;
mod curves;
mod data;
mod errors;
mod exposures;
mod fit;
mod fixed_point;
mod plan;
mod run;
mod scene;

use pyo3::prelude::*;

/// The compiled part of equipix.
#[pymodule]
mod _native {
    use super::{Bound, PyModule, PyResult};
    use pyo3::prelude::*;

    #[pymodule_export]
    use crate::apply::PyCorrector;
    #[pymodule_export]
    use crate::average::{Accumulator, average_files, exposure_s, file_format, read_file};
    #[pymodule_export]
    use crate::centroid::locate_spots;
    #[pymodule_export]
    use crate::curves::fit_response;
    #[pymodule_export]
    use crate::exposures::{PyExposures, common_fraction, needs_whole_shifts};
    #[pymodule_export]
    use crate::fit::{PyBeam, PyFit, PyStart, PyUncertainty, slope_pixels};
    #[pymodule_export]
    use crate::fixed_point::{adapt_words, apply_words};
    #[pymodule_export]
    use crate::plan::planned_components;
    #[pymodule_export]
    use crate::scene::PySceneCorrection;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        // A panic becomes an exception or an error about a file; nothing is printed besides.
        std::panic::set_hook(Box::new(|_| {}));
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}

//! The arrays of checked exposures, kept from one call to the next.

use equipix_core::Checked;
use pyo3::prelude::*;

use crate::arrays::PyMeasurements;

/// References to the arrays that exposures are made of.
pub(crate) struct Arrays {
    pub(crate) frames: Py<PyAny>,
    pub(crate) variance: Option<Py<PyAny>>,
    pub(crate) mask: Option<Py<PyAny>>,
}

/// Checked exposures: their arrays, and what the check of the values left.
pub(crate) struct Data {
    pub(crate) arrays: Arrays,
    pub(crate) checked: Checked,
}

impl Arrays {
    /// The arrays, borrowed.
    pub(crate) fn borrow<'py>(&self, py: Python<'py>) -> PyResult<PyMeasurements<'py>> {
        Ok(PyMeasurements {
            frames: self.frames.extract(py)?,
            variance: self.variance.as_ref().map(|variance| variance.extract(py)).transpose()?,
            mask: self.mask.as_ref().map(|mask| mask.extract(py)).transpose()?,
        })
    }
}

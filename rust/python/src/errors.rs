//! The core's errors as the exceptions of `equipix.errors`, variant by variant.

use equipix_core::Error;
use pyo3::exceptions::PyKeyboardInterrupt;
use pyo3::prelude::*;

/// The Python exception for an error of the core.
pub(crate) fn exception(py: Python<'_>, error: &Error) -> PyErr {
    let class = match error {
        Error::Shape { .. } | Error::Value { .. } => "InputError",
        Error::Spot { .. } => "SpotError",
        Error::File { .. } => "FileError",
        Error::Unsupported { .. } => "UnsupportedFileError",
        Error::Memory { .. } => "InsufficientMemoryError",
        Error::Cancelled => return PyKeyboardInterrupt::new_err(()),
        _ => "EquipixError",
    };
    raise(py, class, error.to_string())
}

/// The exception for a defect of the core itself, which must not reach the user as a panic.
pub(crate) fn internal(py: Python<'_>, message: &str) -> PyErr {
    raise(py, "EquipixError", format!("internal error, please report it: {message}"))
}

fn raise(py: Python<'_>, class: &str, message: String) -> PyErr {
    let build = || py.import("equipix.errors")?.getattr(class)?.call1((message,));
    build().map_or_else(|error| error, PyErr::from_value)
}

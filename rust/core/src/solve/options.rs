//! How to minimise F, and when to stop.

use crate::error::{Error, Result};

/// How to minimise F.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// Gauss-Newton steps on all scales at once.
    Multiscale,
    /// The method of the paper, for shifts that differ by whole pixels and known fluxes.
    CoordinateDescent,
}

impl Method {
    /// Whether the method takes shifts alone that differ by whole pixels: others are rounded before.
    #[must_use]
    pub const fn needs_whole_shifts(self) -> bool {
        matches!(self, Self::CoordinateDescent)
    }
}

/// How to minimise F, and when to stop.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// How.
    pub method: Method,
    /// The largest relative error of M that is wanted.
    pub tolerance: f64,
    /// The most sweeps, or products with the data or its weights, to make; `None` means as many as
    /// it takes.
    pub max_sweeps: Option<u64>,
}

impl Default for Options {
    /// The fast method, to a relative error of 1e-6.
    fn default() -> Self {
        Self { method: Method::Multiscale, tolerance: 1e-6, max_sweeps: None }
    }
}

impl Options {
    /// The most sweeps, if the two values make sense.
    ///
    /// # Errors
    /// [`Error::Value`] for a tolerance that is not a positive number or a limit of 0 sweeps.
    pub(super) fn limit(&self, most: u64) -> Result<u64> {
        let Self { tolerance, max_sweeps, .. } = *self;
        if !(tolerance > 0.0 && tolerance.is_finite()) {
            let problem = format!("is {tolerance}: expected a positive number");
            return Err(Error::value("tolerance", problem));
        }
        if max_sweeps == Some(0) {
            return Err(Error::value("max_sweeps", "is 0: at least one sweep is needed"));
        }
        Ok(max_sweeps.unwrap_or(most))
    }
}

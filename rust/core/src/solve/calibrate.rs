//! From exposures to the sensitivity of their sensor: which loop minimises F, and the result.

use super::options::Options;
use super::{joint, refuse, whole};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::fit::{Fit, Solution};
use crate::frames::Real;
use crate::parallel::Workers;

/// Minimises F, and gives M in the gauge mean(M) = 1 over the pixels of each component.
///
/// Shifts that differ by whole pixels and known fluxes leave M and L alone to be found, by the method
/// asked for; everything else is fitted jointly. Pixels that their measurements leave almost no weight, or
/// whose measurements contradict each other, are flagged and not in the mean. A `start` saves passes over
/// the data; it must be of the same sensor, with as many exposures.
///
/// # Errors
/// [`Error::Value`](crate::Error::Value) for options that make no sense, and for what does not go
/// together: coordinate descent with anything fitted besides or with shifts that differ by parts of pixels,
/// fitted fluxes, shifts or offsets where all shifts are alike, and offsets where all fluxes are;
/// [`Error::Memory`](crate::Error::Memory) if the memory for it cannot be had;
/// [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
pub fn calibrate<T: Real>(
    exposures: &Exposures<'_, T>,
    options: &Options,
    start: Option<&Solution<'_>>,
    workers: &Workers,
    control: &Control,
) -> Result<Fit> {
    refuse::check(exposures, options)?;
    start.map_or(Ok(()), |start| start.check(exposures))?;
    workers.enter(|| {
        let found = if exposures.are_whole() {
            whole::minimise(exposures, options, start, workers, control)?
        } else {
            joint::minimise(exposures, options, start, workers, control)?
        };
        Ok(found.into_fit(exposures.unreliable(), workers))
    })
}

//! What does not go together.

use super::options::Options;
use crate::error::{Error, Result};
use crate::exposures::Exposures;
use crate::frames::Real;

/// Refuses exposures that the method cannot fit, or that do not determine what is sought.
///
/// # Errors
/// [`Error::Value`].
pub(super) fn check<T: Real>(exposures: &Exposures<'_, T>, options: &Options) -> Result<()> {
    check_method(exposures, options)?;
    if !exposures.are_whole() && !exposures.positions().differ(exposures.sensor()) {
        let problem = "are all alike, so that each pixel measures one place of the beam and no two \
                       pixels the same: move the sensor between exposures";
        return Err(Error::value("shifts", problem));
    }
    if exposures.offset() && exposures.are_one_level() {
        let problem = "is 'fit' with one flux for all exposures, where offset and gain are \
                       degenerate: take exposures at two or more levels and give their 'flux', or \
                       subtract a dark";
        return Err(Error::value("dark", problem));
    }
    Ok(())
}

/// Refuses what coordinate descent cannot fit.
fn check_method<T: Real>(exposures: &Exposures<'_, T>, options: &Options) -> Result<()> {
    if !options.method.needs_whole_shifts() || exposures.are_whole() {
        return Ok(());
    }
    let problem = if exposures.seek_more() || exposures.positions().std.is_some() {
        "is 'coordinate-descent', which supports only given shifts and fluxes: use 'multiscale' to \
         fit fluxes, shifts or the dark"
    } else {
        "is 'coordinate-descent', which supports only shifts that differ by whole pixels: round them, or \
         use 'multiscale'"
    };
    Err(Error::value("method", problem))
}

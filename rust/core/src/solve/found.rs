//! A minimum of F as a loop found it, and the result that it becomes.

use crate::connectivity::Components;
use crate::fit::Fit;
use crate::frames::flag;
use crate::gauge::{self, FluxGauge};
use crate::parallel::Workers;

/// A minimum in any gauge, without flags.
pub(super) struct Found {
    pub(super) fit: Fit,
    /// Pixels that the prior of M holds more than their measurements.
    pub(super) held: Vec<usize>,
    /// Pixels that do not respond to light.
    pub(super) dead: Vec<usize>,
    /// Pixels whose measurements do not distinguish offset and gain, where an offset is sought.
    pub(super) without_offset: Vec<usize>,
    /// What fitted fluxes leave to the gauge.
    pub(super) fluxes: Option<FluxGauge>,
}

impl Found {
    /// The result: the pixels' flags, then M in its gauge, of mean 1 in each component; the `unreliable`
    /// pixels are flagged and not in the mean, like those that the prior holds.
    pub(super) fn into_fit(self, unreliable: &[usize], workers: &Workers) -> Fit {
        let Self { mut fit, mut held, dead, without_offset, fluxes } = self;
        held.extend(unreliable);
        held.sort_unstable();
        held.dedup();
        fit.flags = flags(&fit.components);
        let mark = |flags: &mut [u32], pixels: &[usize], flag: u32| {
            pixels.iter().for_each(|&pixel| flags[pixel] |= flag | flag::DO_NOT_USE);
        };
        mark(&mut fit.flags, &held, flag::UNRELIABLE_FLAT);
        mark(&mut fit.flags, &dead, flag::DEAD);
        mark(&mut fit.flags, &without_offset, flag::NO_FLAT_FIELD);
        fluxes.iter().for_each(|fluxes| gauge::fix_fluxes(&mut fit, fluxes));
        gauge::fix_means(&mut fit, &held, workers);
        for pixel in without_offset {
            fit.sensitivity[pixel] = f64::NAN;
            fit.offset.iter_mut().for_each(|offset| offset[pixel] = f64::NAN);
        }
        fit
    }
}

/// What the components say of each pixel: outside the largest, M is not determined.
fn flags(components: &Components) -> Vec<u32> {
    let undetermined = flag::NO_FLAT_FIELD | flag::DO_NOT_USE;
    components.pixels.iter().map(|&label| if label == 0 { 0 } else { undetermined }).collect()
}

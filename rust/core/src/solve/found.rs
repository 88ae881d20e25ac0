//! A minimum of F as a loop found it, and the result that it becomes.

use crate::connectivity::Components;
use crate::fit::Fit;
use crate::frames::flag;
use crate::gauge::{self, FluxGauge};
use crate::parallel::Workers;

/// A minimum in any gauge, without flags.
pub(super) struct Found {
    pub(super) fit: Fit,
    /// Pixels whose M carries too little weight.
    pub(super) left_out: Vec<usize>,
    /// Pixels that do not respond to light.
    pub(super) dead: Vec<usize>,
    /// Pixels whose measurements do not distinguish offset and gain, where an offset is sought.
    pub(super) without_offset: Vec<usize>,
    /// What fitted fluxes leave to the gauge.
    pub(super) fluxes: Option<FluxGauge>,
}

impl Found {
    /// The result: the pixels' flags, then M in its gauge, of mean 1 in each component; the `unreliable`
    /// pixels are flagged and not in the mean, like those left out.
    pub(super) fn into_fit(self, unreliable: &[usize], workers: &Workers) -> Fit {
        let Self { mut fit, mut left_out, dead, without_offset, fluxes } = self;
        left_out.extend(unreliable);
        left_out.sort_unstable();
        left_out.dedup();
        fit.flags = flags(&fit.components);
        let mark = |flags: &mut [u32], pixels: &[usize], flag: u32| {
            pixels.iter().for_each(|&pixel| flags[pixel] |= flag | flag::DO_NOT_USE);
        };
        mark(&mut fit.flags, &left_out, flag::UNRELIABLE_FLAT);
        mark(&mut fit.flags, &dead, flag::DEAD);
        mark(&mut fit.flags, &without_offset, flag::NO_FLAT_FIELD);
        fluxes.iter().for_each(|fluxes| gauge::fix_fluxes(&mut fit, fluxes));
        gauge::fix_means(&mut fit, &left_out, workers);
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

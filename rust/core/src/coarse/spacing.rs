//! How far apart hats stand, how much they count, and the memory that their matrix takes.

use super::hats::Hats;
use super::spectrum::MOST_WAVES;
use crate::geometry::{Geometry, Placement};

/// The factor γ of the second level. Errors that both levels see would count twice with γ = 1, and
/// the largest eigenvalue of P⁻¹S be 1.8; with this it is 1, which saves iterations
/// (docs/method.md). Errors that the second level alone sees get an eigenvalue of γ.
pub(crate) const DAMPING: f64 = 0.25;
/// Hats are as far apart as this times the largest shift.
const SPACING: usize = 3;
/// Pixels between hats at least: closer ones cost more than they save.
const LEAST_SPACING: usize = 8;
/// Most hats: their matrix is factorised in one go, which nothing interrupts, in less than half a
/// second.
const MOST_HATS: usize = 20_000;

/// Most hats where exposures are turned against each other: hats far apart meet then, and the factor
/// of their matrix is nearly full.
const MOST_HATS_TURNED: usize = 1000;
/// Upper limit on the heights of all waves together.
const MOST_HEIGHTS: usize = 30_000;

/// What the matrix of the hats and its factor take in bytes: as measured for 28 000 and 51 000 hats,
/// or those of a full triangle, twice, where exposures are turned against each other. Those of a wave have
/// two heights for each hat.
pub(crate) fn bytes_needed(geometry: &Geometry, waves: usize) -> u64 {
    let hats = Hats::new(geometry.sensor, spacing(geometry)).count() as u64;
    if geometry.views.len() > 1 {
        return 8 * hats * hats;
    }
    let of_wave = Hats::new(geometry.sensor, spacing_of_waves(geometry));
    2700 * hats + 8000 * (waves * of_wave.count()) as u64
}

/// How far apart the hats of a wave stand: as all others, unless they would be too many.
pub(crate) fn spacing_of_waves(geometry: &Geometry) -> [usize; 2] {
    let area = (2 * MOST_WAVES * geometry.sensor.len() / MOST_HEIGHTS).isqrt();
    spacing(geometry).map(|spacing| spacing.max(area))
}

/// How far apart hats stand, along rows and columns of the sensor.
pub(crate) fn spacing(geometry: &Geometry) -> [usize; 2] {
    let reach = |along: fn(&Placement) -> usize| {
        let of_view = |view| {
            let places =
                geometry.placements.iter().filter(move |place| place.view == view).map(along);
            places.clone().max().unwrap_or(0) - places.min().unwrap_or(0)
        };
        (0..geometry.views.len()).map(of_view).max().unwrap_or(0)
    };
    let reach = [reach(|place| place.row), reach(|place| place.col)];
    let most = if geometry.views.len() > 1 { MOST_HATS_TURNED } else { MOST_HATS };
    let area = (geometry.sensor.len() / most).isqrt();
    reach.map(|reach| (SPACING * reach).max(LEAST_SPACING).max(area))
}

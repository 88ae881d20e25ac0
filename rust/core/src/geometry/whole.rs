//! Whole numbers of pixels, but for rounding.

/// The largest part of a pixel that counts as rounding: 11.1 less 0.1 is 11 but for 4e-16.
const ROUNDING: f64 = 1e-6;

/// The whole number that a distance in pixels is, but for rounding.
pub(crate) fn whole_number(distance: f64) -> Option<f64> {
    let nearest = distance.round_ties_even();
    ((distance - nearest).abs() < ROUNDING).then_some(nearest)
}

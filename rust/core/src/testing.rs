//! What the tests of several modules share: a small sensor, numbers that look random, and the law of draws.

use crate::frames::Shape;

pub(crate) const SENSOR: Shape = Shape::new(9, 11);
/// Positions between pixels.
pub(crate) const SHIFTS: [[f64; 2]; 5] =
    [[0.0, 0.0], [0.3, 2.2], [-1.6, 0.7], [2.4, 1.5], [0.8, -2.1]];

/// A number from −1 to 1 that looks random.
pub(crate) fn random_number(index: usize) -> f64 {
    2.0 * ((index as f64 * 12.9898).sin() * 43758.5453).rem_euclid(1.0) - 1.0
}

pub(crate) fn random_vector(length: usize, seed: usize) -> Vec<f64> {
    (0..length).map(|i| random_number(1000 * seed + i)).collect()
}

/// The law of draws along a direction, in units of the standard deviation that they should have: their
/// variance is 1, and neighbouring draws do not correlate.
#[track_caller]
pub(crate) fn assert_unit_and_independent(heights: &[f64]) {
    let draws = heights.len() as f64;
    // Five standard errors: a square of a normal value scatters by √2, a product of two by 1.
    let square = heights.iter().map(|height| height * height).sum::<f64>() / draws;
    assert!((square - 1.0).abs() < 5.0 * (2.0 / draws).sqrt(), "{square}");
    let next = heights.windows(2).map(|pair| pair[0] * pair[1]).sum::<f64>() / draws;
    assert!(next.abs() < 5.0 / draws.sqrt(), "{next}");
}

//! Whole numbers of pixels, but for rounding.

/// The largest part of a pixel that counts as rounding: 11.1 less 0.1 is 11 but for 4e-16.
const ROUNDING: f64 = 1e-6;

/// The nearest whole number of pixels; of two that are equally near, but for rounding, the lower one. A move of
/// half a pixel is then the same from wherever it starts.
pub(crate) fn nearest_whole(distance: f64) -> f64 {
    // What rounds to 0 from below is no −0.
    (distance - (0.5 + ROUNDING)).ceil() + 0.0
}

/// The whole number that a distance in pixels is, but for rounding.
pub(crate) fn whole_number(distance: f64) -> Option<f64> {
    let nearest = nearest_whole(distance);
    ((distance - nearest).abs() < ROUNDING).then_some(nearest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tie_goes_one_way_wherever_it_starts() {
        for first in [-2.0, -0.9, 0.0, 0.6, 1.0, 2.7] {
            for (distance, nearest) in [(0.5, 0.0), (1.5, 1.0), (-0.5, -1.0), (2.51, 3.0)] {
                // Whatever the rounding of first + distance.
                assert!(nearest_whole(first + distance - first) == nearest, "{first} {distance}");
            }
        }
        assert!(nearest_whole(0.2).is_sign_positive() && nearest_whole(3.0) == 3.0);
    }
}

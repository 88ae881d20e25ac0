//! Medians of samples.

use std::cmp::Ordering;

/// The median square of a standard normal value.
pub(crate) const MEDIAN_OF_SQUARES: f64 = 0.4549;

/// The median of a sample, the upper one of an even number; `None` of an empty sample.
pub(crate) fn median<N: Copy>(sample: &mut [N], order: fn(&N, &N) -> Ordering) -> Option<N> {
    let middle = sample.len() / 2;
    (middle < sample.len()).then(|| *sample.select_nth_unstable_by(middle, order).1)
}

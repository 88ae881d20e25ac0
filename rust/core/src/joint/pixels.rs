//! The eliminated pixels at the state of a joint fit.

use super::system::System;
use crate::frames::Real;

impl<T: Real> System<'_, '_, T> {
    /// M and O at the state, row by row.
    pub(crate) fn pixels(&self) -> [Vec<f64>; 2] {
        let mut found = [Vec::new(), Vec::new()];
        self.pass.for_rows(|[sensitivity, _, _, offset, ..]| {
            found[0].extend_from_slice(sensitivity);
            found[1].extend_from_slice(offset);
        });
        found
    }

    /// The mean M of the pixels with measurements.
    pub(super) fn mean_sensitivity(&self) -> f64 {
        let (mut sum, mut count) = (0.0, 0);
        self.pass.for_rows(|[sensitivity, inverse, ..]| {
            for (m, inverse) in sensitivity.iter().zip(inverse) {
                if *inverse > 0.0 {
                    sum += m;
                    count += 1;
                }
            }
        });
        sum / f64::from(count.max(1))
    }

    /// How many pixels have a measurement.
    pub(crate) fn measured(&self) -> usize {
        let mut count = 0;
        self.pass
            .for_rows(|[_, inverse, ..]| count += inverse.iter().filter(|i| **i > 0.0).count());
        count
    }
}

//! What an ordinary measurement is like, by medians of a sample.

use super::checked::Exposures;
use super::stretch::Stretch;
use crate::frames::{Real, Shape};
use crate::median::median;

/// Rows and columns of an exposure that medians are taken from.
const SAMPLED_ROWS: usize = 12;
const SAMPLED_COLS: usize = 16;

impl<T: Real> Exposures<'_, T> {
    /// The light of an ordinary measurement: the median |y|/c of a sample.
    pub(crate) fn typical_light(&self) -> f64 {
        self.sampled(|value, _, flux| value.abs() / flux)
    }

    /// The weight w c² of an ordinary measurement, likewise.
    pub(crate) fn typical_weight(&self) -> f64 {
        self.sampled(|_, weight, flux| weight * flux * flux)
    }

    /// The median over a sample of the measurements used of `quantity(y, w, c)`, where above 0.
    fn sampled(&self, quantity: impl Fn(f64, f64, f64) -> f64) -> f64 {
        let Shape { rows, cols } = self.sensor();
        let mut scratch = vec![0.0; cols];
        let mut sample = Vec::new();
        for (exposure, &flux) in self.flux().iter().enumerate() {
            for row in (0..rows).step_by(rows.div_ceil(SAMPLED_ROWS)) {
                let stretch = self.stretch(exposure, row, 0..cols, &mut scratch);
                for col in (0..cols).step_by(cols.div_ceil(SAMPLED_COLS)) {
                    let (value, weight) = match &stretch {
                        Stretch::Uniform(values, weight) => (values[col], *weight),
                        Stretch::Weighted(values, weights) => (values[col], weights[col]),
                    };
                    if weight > 0.0 {
                        sample.push(quantity(value.to_f64(), weight, flux));
                    }
                }
            }
        }
        sample.retain(|&value| value > 0.0);
        median(&mut sample, f64::total_cmp).unwrap_or(1.0)
    }
}

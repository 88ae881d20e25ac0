//! The factors of a cubic B-spline that a place between cells takes.
//!
//! The beam is L(u) = Σ_j a_j B(u − j) with a coefficient a for each cell and the cubic B-spline B,
//! along rows and columns alike. All pixels of an exposure stand at the same fraction f of a cell, so
//! each is a sum over 4×4 cells with the same factors (de Boor, A Practical Guide to Splines, 1978):
//!
//! ```text
//! B: (1−f)³/6, (4 − 6f² + 3f³)/6, (1 + 3f + 3f² − 3f³)/6, f³/6
//! ```

/// Factors along one axis that a spline needs.
pub(crate) const TAPS: usize = 4;
/// The factors of the cells that a pixel sees along one axis of its view, and their slopes with
/// respect to the shift.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Taps {
    pub(crate) values: [f64; TAPS],
    pub(crate) slopes: [f64; TAPS],
}

impl Taps {
    /// A pixel that sees one cell.
    pub(crate) const WHOLE: Self = Self { values: [1.0, 0.0, 0.0, 0.0], slopes: [0.0; TAPS] };

    /// The factors behind a fraction `f` of a cell.
    pub(crate) fn at(f: f64) -> Self {
        let g = 1.0 - f;
        Self {
            values: [
                g * g * g / 6.0,
                (4.0 + f * f * (3.0 * f - 6.0)) / 6.0,
                (4.0 + g * g * (3.0 * g - 6.0)) / 6.0,
                f * f * f / 6.0,
            ],
            slopes: [-g * g / 2.0, f * (1.5 * f - 2.0), g * (2.0 - 1.5 * g), f * f / 2.0],
        }
    }

    /// The cells that count for what hangs together: the nearest one alone where exposures stand
    /// `whole` numbers of cells apart, else those on either side.
    pub(crate) fn around(&self, whole: bool) -> std::ops::Range<usize> {
        let largest = |a: &usize, b: &usize| self.values[*a].total_cmp(&self.values[*b]);
        let nearest = (0..TAPS).max_by(largest).unwrap_or_default();
        if whole || self.values[nearest] == 1.0 { nearest..nearest + 1 } else { 1..TAPS - 1 }
    }

    /// The factors along a reversed axis.
    pub(crate) fn reversed(mut self) -> Self {
        self.values.reverse();
        self.slopes.reverse();
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn factors_sum_to_one_and_their_slopes_are_derivatives() {
        for f in [0.0, 0.1, 0.5, 0.77, 1.0] {
            let taps = Taps::at(f);
            assert!((taps.values.iter().sum::<f64>() - 1.0).abs() < 4.0 * f64::EPSILON);
            // Cubics have no error but the third derivative's in a central difference: h²/6.
            let h = 1e-4;
            let (after, before) = (Taps::at(f + h), Taps::at(f - h));
            for i in 0..TAPS {
                let slope = (after.values[i] - before.values[i]) / (2.0 * h);
                assert!((slope - taps.slopes[i]).abs() < h * h);
            }
        }
    }
}

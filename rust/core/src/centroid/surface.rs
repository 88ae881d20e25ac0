//! Medians, and the cubic surface that stands for a smooth background.

/// Median absolute deviation of a normal distribution, as a factor that makes it σ.
const NORMAL_MAD: f64 = 1.482_602_218_505_601_8;

/// Points farther from the surface than this many robust standard deviations do not count.
const CLIPPING: f64 = 5.0;

/// How often the surface is fitted anew to the points that count.
const FITS: usize = 5;

/// Median, the mean of the middle two for an even number; `values` get reordered. NaN if empty.
pub(super) fn median(values: &mut [f64]) -> f64 {
    let half = values.len() / 2;
    if values.is_empty() {
        return f64::NAN;
    }
    let odd = values.len() % 2 == 1;
    let (low, upper, _) = values.select_nth_unstable_by(half, f64::total_cmp);
    if odd {
        return *upper;
    }
    (low.iter().copied().fold(f64::NEG_INFINITY, f64::max) + *upper) / 2.0
}

/// Standard deviation of normal values of which a minority may be anything.
pub(super) fn robust_deviation(values: &mut [f64]) -> f64 {
    let centre = median(values);
    values.iter_mut().for_each(|value| *value = (*value - centre).abs());
    NORMAL_MAD * median(values)
}

/// Number of terms of a cubic surface.
const TERMS: usize = 10;

/// The terms of a cubic surface: 1, r, c, r², rc, c², r³, r²c, rc², c³.
pub(super) type Terms = [f64; TERMS];

pub(super) fn terms([r, c]: [f64; 2]) -> Terms {
    let (rr, rc, cc) = (r * r, r * c, c * c);
    [1.0, r, c, rr, rc, cc, rr * r, rr * c, r * cc, cc * c]
}

/// The factors of 1, c, c², c³ that a surface has in the row r.
pub(super) fn along_row(k: &Terms, r: f64) -> [f64; 4] {
    let zeroth = ((k[6] * r + k[3]) * r + k[1]) * r + k[0];
    [zeroth, (k[7] * r + k[4]) * r + k[2], k[8] * r + k[5], k[9]]
}

pub(super) fn dot(a: &Terms, b: &Terms) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// A value at a place.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    pub(super) place: [f64; 2],
    pub(super) value: f64,
}

/// A surface through points, without those that stand out.
#[derive(Debug)]
pub(super) struct Surface {
    /// The factors of the terms.
    pub(super) coefficients: Terms,
    /// Σ φφᵀ over the points that count.
    pub(super) normal: [Terms; TERMS],
    /// Which points count.
    pub(super) kept: Vec<bool>,
}

impl Surface {
    /// Least squares over the points within [`CLIPPING`] robust standard deviations of the
    /// surface, beginning with the constant that is their median: so up to half of them may belong
    /// to a spot. At least half are kept, too many to lie on one cubic curve: the fit is determined.
    pub(super) fn fit(points: &[Point]) -> Self {
        let mut values: Vec<f64> = points.iter().map(|point| point.value).collect();
        let mut coefficients = Terms::default();
        coefficients[0] = median(&mut values);
        let mut surface = Self {
            coefficients,
            normal: [Terms::default(); TERMS],
            kept: vec![true; points.len()],
        };
        for _ in 0..FITS {
            surface.refine(points, &mut values);
        }
        surface
    }

    fn refine(&mut self, points: &[Point], scratch: &mut [f64]) {
        // Terms are found anew each time: kept, they would take four times the memory of the points.
        let residual = |point: &Point, terms: &Terms| point.value - dot(&self.coefficients, terms);
        for (slot, point) in scratch.iter_mut().zip(points) {
            *slot = residual(point, &terms(point.place)).abs();
        }
        let limit = CLIPPING * NORMAL_MAD * median(scratch);
        let mut right = Terms::default();
        self.normal = [Terms::default(); TERMS];
        for (kept, point) in self.kept.iter_mut().zip(points) {
            let terms = terms(point.place);
            let distance = residual(point, &terms);
            *kept = distance.abs() <= limit;
            if *kept {
                for (i, row) in self.normal.iter_mut().enumerate() {
                    right[i] += terms[i] * distance;
                    for (entry, term) in row.iter_mut().zip(&terms) {
                        *entry += terms[i] * term;
                    }
                }
            }
        }
        let step = solve_by_elimination(&self.normal, right);
        self.coefficients.iter_mut().zip(step).for_each(|(value, step)| *value += step);
    }
}

/// Solves a symmetric positive definite system by Gaussian elimination.
pub(super) fn solve_by_elimination(matrix: &[Terms; TERMS], right: Terms) -> Terms {
    let mut rows = *matrix;
    let mut x = right;
    for pivot in 0..TERMS {
        let (upper, lower) = rows.split_at_mut(pivot + 1);
        for (below, row) in lower.iter_mut().enumerate() {
            let ratio = row[pivot] / upper[pivot][pivot];
            row.iter_mut().zip(&upper[pivot]).for_each(|(entry, above)| *entry -= ratio * above);
            x[pivot + 1 + below] -= ratio * x[pivot];
        }
    }
    for pivot in (0..TERMS).rev() {
        let known: f64 = (pivot + 1..TERMS).map(|col| rows[pivot][col] * x[col]).sum();
        x[pivot] = (x[pivot] - known) / rows[pivot][pivot];
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians() {
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&mut [4.0, 1.0, 2.0, 3.0]), 2.5);
        assert!(median(&mut []).is_nan());
        assert_eq!(robust_deviation(&mut [-1.0, 0.0, 1.0, 1e9, 0.5]), 0.5 * NORMAL_MAD);
    }

    #[test]
    fn a_row_of_a_surface_is_a_cubic() {
        let surface = [100.0, 3.0, -2.0, -20.0, 1.0, -15.0, 2.0, -4.0, 1.0, 3.0];
        for (r, c) in [(0.3, -0.7), (-1.0, 1.0), (0.9, 0.2)] {
            let row = along_row(&surface, r);
            let got = row.iter().rev().fold(0.0, |sum, factor| sum * c + factor);
            // Twenty roundings of values up to 200.
            assert!((got - dot(&surface, &terms([r, c]))).abs() < 20.0 * 200.0 * f64::EPSILON);
        }
    }

    #[test]
    fn a_third_of_the_points_may_be_anything() {
        let truth = [100.0, 3.0, -2.0, -20.0, 1.0, -15.0, 2.0, -4.0, 1.0, 3.0];
        let places = |i: usize| [(i / 16) as f64 / 8.0 - 1.0, (i % 16) as f64 / 8.0 - 1.0];
        let points: Vec<Point> = (0..256)
            .map(|i| {
                let spoilt = if (60..145).contains(&i) { 1e4 } else { 0.0 };
                let place = places(i);
                Point { place, value: dot(&truth, &terms(place)) + spoilt }
            })
            .collect();
        let surface = Surface::fit(&points);
        // 5 fits to values of 100, whose normal matrix has a condition below 1000.
        for (got, wanted) in surface.coefficients.iter().zip(truth) {
            assert!((got - wanted).abs() <= 5.0 * 100.0 * 1000.0 * f64::EPSILON, "{got} {wanted}");
        }
        assert!(!surface.kept[60..145].contains(&true));
    }
}

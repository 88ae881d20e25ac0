//! Ritz values: eigenvalues of the tridiagonal matrix that conjugate gradients yield.
//!
//! They approach those of P⁻¹S from within (Golub and Van Loan, Matrix Computations); the smallest
//! turns a residual into an estimate of the error (see [`convergence`](crate::convergence)).

/// The tridiagonal matrix of Lanczos, from the coefficients of conjugate gradients: with steps a
/// and kept shares b its diagonal is 1/a_j + b_(j−1)/a_(j−1), beside it stands √b_j/a_j.
#[derive(Clone, Debug, Default)]
pub(crate) struct Ritz {
    diagonal: Vec<f64>,
    /// Squares of the elements beside the diagonal, the first one before the first row.
    beside: Vec<f64>,
    /// b/a and √b/a, squared, of the last iteration.
    carried: [f64; 2],
}

impl Ritz {
    pub(crate) fn push(&mut self, step: f64, keep: f64) {
        self.diagonal.push(1.0 / step + self.carried[0]);
        self.beside.push(self.carried[1]);
        self.carried = [keep / step, keep / (step * step)];
    }

    /// Whether no iteration was made.
    pub(crate) fn is_empty(&self) -> bool {
        self.diagonal.is_empty()
    }

    /// The smallest eigenvalue, to three digits, by bisection on Sturm's count: below it no pivot
    /// of T − θ is negative (Golub and Van Loan, Matrix Computations, section 8.4).
    pub(crate) fn smallest(&self) -> f64 {
        let (mut low, mut high) =
            (0.0_f64, self.diagonal.iter().copied().fold(f64::INFINITY, f64::min));
        while high - low > 1e-3 * high {
            let middle = 0.5 * (low + high);
            if self.is_below(middle) {
                low = middle;
            } else {
                high = middle;
            }
        }
        high
    }

    /// Whether every eigenvalue is above `theta`.
    fn is_below(&self, theta: f64) -> bool {
        let mut pivot = f64::INFINITY;
        self.diagonal.iter().zip(&self.beside).all(|(diagonal, square)| {
            pivot = diagonal - theta - square / pivot;
            pivot > 0.0
        })
    }
}

/// The smallest Ritz value of all searches so far, after each of their iterations.
#[derive(Clone, Debug)]
pub(crate) struct Lowest {
    values: Vec<f64>,
}

impl Lowest {
    /// Before any iteration, with the smallest eigenvalue that there may be.
    pub(crate) fn new(least: f64) -> Self {
        Self { values: vec![least] }
    }

    /// Drops what iterations have found.
    pub(crate) fn forget(&mut self) {
        self.values.truncate(1);
    }

    /// Whether x · b lacks no more than `lack` even if there is the smallest eigenvalue that there may be. A pattern
    /// of a small one is as small in the residual, so that a search may end before a Ritz value belongs to it.
    pub(crate) fn is_complete(&self, square: f64, lack: f64) -> bool {
        square <= self.values[0] * lack
    }

    /// A value that is none counts as 0.
    pub(crate) fn push(&mut self, value: f64) {
        self.values.push(if value > 0.0 { self.found().min(value) } else { 0.0 });
    }

    /// The smallest so far.
    pub(crate) fn found(&self) -> f64 {
        self.values[self.values.len() - 1]
    }

    /// Where it is going: as far below as it has fallen over the last half of the iterations. A value
    /// that falls no longer is found; one among many eigenvalues near 0 falls like 1/iterations² until
    /// then.
    fn expected(&self) -> f64 {
        self.found().powi(2) / self.values[self.values.len() / 2]
    }

    /// What S⁻¹ makes of a size of P⁻¹ r: that over the smallest eigenvalue. Infinite where rounding has
    /// left no positive one: nothing is known then of what lies along the pattern that belongs to it.
    pub(crate) fn over(&self, size: f64) -> f64 {
        let over = size / self.expected();
        if self.found() > 0.0 && over >= 0.0 { over } else { f64::INFINITY }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_that_still_falls_is_expected_to_fall_on() {
        let mut lowest = Lowest::new(0.25);
        for value in [1.0, 0.2, 0.3, 0.1, 0.1] {
            lowest.push(value);
        }
        assert!((lowest.expected() - 0.1 * 0.1 / 0.2).abs() < 1e-12);
        for _ in 0..6 {
            lowest.push(0.4);
        }
        assert!((lowest.found() - 0.1).abs() < 1e-12 && (lowest.expected() - 0.1).abs() < 1e-12);
    }

    #[test]
    fn no_pattern_of_an_eigenvalue_that_may_be_is_missed() {
        let mut lowest = Lowest::new(0.1);
        lowest.push(0.01);
        assert!(lowest.is_complete(0.9e-7, 1e-6) && !lowest.is_complete(1.1e-7, 1e-6));
        lowest.forget();
        assert!(lowest.found() == 0.1 && (lowest.expected() - 0.1).abs() < 1e-16);
    }

    #[test]
    fn without_a_positive_value_nothing_is_known() {
        for value in [0.0, -1e-3, f64::NEG_INFINITY, f64::NAN] {
            let mut lowest = Lowest::new(0.25);
            assert!((lowest.over(1e-9) - 4e-9).abs() < 1e-20);
            lowest.push(value);
            assert!(lowest.over(1e-9) == f64::INFINITY && lowest.over(0.0) == f64::INFINITY);
        }
        assert!(Lowest::new(0.25).over(f64::NAN) == f64::INFINITY);
    }

    #[test]
    fn the_smallest_ritz_value_of_a_chain_is_known() {
        // T with 2 on the diagonal and −1 beside it: 2 − 2 cos(π/(n+1)).
        let mut ritz = Ritz::default();
        for count in 1..30 {
            ritz.diagonal.push(2.0);
            ritz.beside.push(if count > 1 { 1.0 } else { 0.0 });
            let wanted = 2.0 - 2.0 * (std::f64::consts::PI / f64::from(count + 1)).cos();
            assert!((ritz.smallest() / wanted - 1.0).abs() < 2e-3);
        }
    }
}

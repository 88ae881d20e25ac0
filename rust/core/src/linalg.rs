//! Linear algebra: sparse Cholesky factors, and matrices of two rows. The only module that names faer.

use faer::linalg::solvers::Solve;
use faer::sparse::linalg::solvers::{Llt, SymbolicLlt};
use faer::sparse::{SparseColMat, Triplet};
use faer::{ColMut, Side};

/// What rounding leaves of a determinant.
const SINGULAR: f64 = 1e-12;

/// The Cholesky factor of a sparse symmetric matrix.
pub(crate) struct Cholesky {
    factor: Llt<u32, f64>,
}

impl Cholesky {
    /// Factorises the matrix of `order` rows whose lower triangle holds `entries` (row, column,
    /// value), those of one place being summed; `None` unless it is positive definite.
    pub(crate) fn new(order: usize, entries: &[(u32, u32, f64)]) -> Option<Self> {
        let triplets: Vec<_> =
            entries.iter().map(|&(row, col, value)| Triplet::new(row, col, value)).collect();
        let matrix = SparseColMat::try_new_from_triplets(order, order, &triplets).ok()?;
        let symbolic = SymbolicLlt::try_new(matrix.symbolic(), Side::Lower).ok()?;
        let factor = Llt::try_new_with_symbolic(symbolic, matrix.as_ref(), Side::Lower).ok()?;
        Some(Self { factor })
    }

    /// Replaces the right-hand side by the solution: forward and back substitution.
    pub(crate) fn substitute(&self, right: &mut [f64]) {
        self.factor.solve_in_place(ColMut::from_slice_mut(right));
    }
}

/// The inverse of a matrix [a b; b c] without negative eigenvalues; 0 along the direction that one of
/// rank 1 does not determine, and the matrix over its trace squared along the other.
pub(crate) fn inverse([a, b, c]: [f64; 3]) -> [[f64; 2]; 2] {
    let determinant = a * c - b * b;
    if determinant > SINGULAR * (a + c).powi(2) {
        let mixed = -b / determinant;
        [[c / determinant, mixed], [mixed, a / determinant]]
    } else if a + c > 0.0 {
        let square = (a + c).powi(2);
        [[a / square, b / square], [b / square, c / square]]
    } else {
        [[0.0; 2]; 2]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chain_of_springs_is_solved() {
        // A chain held at its left end and pulled at the other: x = 1, 2, … n.
        let order = 50_u32;
        let diagonal = (0..order).map(|i| (i, i, if i + 1 < order { 2.0 } else { 1.0 }));
        let coupling = (1..order).map(|i| (i, i - 1, -1.0));
        let entries: Vec<_> = diagonal.chain(coupling).collect();
        let mut x = vec![0.0; order as usize];
        x[order as usize - 1] = 1.0;
        Cholesky::new(order as usize, &entries).unwrap().substitute(&mut x);
        // The condition is some order², so as many roundings.
        for (index, x) in x.iter().enumerate() {
            assert!((x - (index + 1) as f64).abs() < 2500.0 * 50.0 * f64::EPSILON);
        }
    }

    #[test]
    fn an_indefinite_matrix_is_none() {
        assert!(Cholesky::new(2, &[(0, 0, 1.0), (1, 0, 2.0), (1, 1, 1.0)]).is_none());
        assert!(Cholesky::new(1, &[(0, 0, 0.0)]).is_none());
    }

    #[test]
    fn what_a_matrix_does_not_tell_is_left_out_of_its_inverse() {
        assert_eq!(inverse([2.0, 1.0, 1.0]), [[1.0, -1.0], [-1.0, 2.0]]);
        // 4 along (1, 1)/√2, nothing across.
        assert_eq!(inverse([2.0, 2.0, 2.0]), [[0.125, 0.125], [0.125, 0.125]]);
        assert_eq!(inverse([0.0, 0.0, 4.0]), [[0.0, 0.0], [0.0, 0.25]]);
        assert_eq!(inverse([0.0; 3]), [[0.0; 2]; 2]);
    }
}

//! The inverse of the matrix of aggregates, nearly: one cycle over coarser and coarser aggregates.
//!
//! There are too many aggregates of pixels for a factor. So each level is smoothed by Jacobi's method, and
//! what is left is solved for on aggregates of its aggregates, without the smoothing of their columns
//! (Vaněk, Mandel and Brezina, Computing 56 (1996) 179). Aggregates have a larger energy than the smooth
//! error that they stand for, so what they find is enlarged (Braess, Computing 55 (1995) 379). As much is
//! smoothed before as after: the cycle is symmetric.

use super::graph::{Graph, NONE, Partition};
use super::matrix::RIDGE;
use crate::connectivity::DisjointSets;
use crate::control::Control;
use crate::error::Result;
use crate::linalg::Cholesky;
use crate::parallel::Workers;

/// The damping of Jacobi's method: eigenvalues of D⁻¹A are at most 2.
const SMOOTHING: f64 = 0.7;
/// How much is made of what coarser aggregates find.
const ENLARGED: f64 = 1.8;
/// The share of what aggregates find that counts, since the diagonal and the hats see a part of it too.
const SHARE: f64 = 0.5;
/// Aggregates whose matrix is factorised.
const FEW: usize = 600;

/// A⁻¹ of a graph, nearly.
pub(crate) struct Cycle {
    levels: Vec<(Graph, Partition)>,
    coarsest: Coarsest,
}

impl Cycle {
    /// Coarser and coarser aggregates of a graph.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn new(graph: Graph, workers: &Workers, control: &Control) -> Result<Self> {
        let mut levels: Vec<(Graph, Partition)> = Vec::new();
        let mut graph = graph;
        while graph.count() > FEW {
            let count = graph.count();
            // What is compared with nothing is no error that S can see. Of all others each aggregate has two.
            let is_compared = |row| graph.row(row).next().is_some();
            let neighbours = |row| graph.strong(row);
            let coarser =
                Partition::neighbourhoods(count, is_compared, neighbours, workers, control)?;
            let next = coarser.graph(&graph, workers, control)?;
            levels.push((graph, coarser));
            graph = next;
        }
        Ok(Self { levels, coarsest: Coarsest::new(&graph) })
    }

    /// A share of A⁻¹ b, nearly.
    pub(crate) fn correct(&self, right: &[f64], workers: &Workers) -> Vec<f64> {
        let mut heights = self.descend(0, right, workers);
        heights.iter_mut().for_each(|height| *height *= SHARE);
        heights
    }

    /// The heights y with A y = b, nearly, from a level on.
    fn descend(&self, level: usize, right: &[f64], workers: &Workers) -> Vec<f64> {
        let Some((graph, coarser)) = self.levels.get(level) else {
            return self.coarsest.solve(right);
        };
        let mut heights = vec![0.0; right.len()];
        smooth(right, graph, &mut heights);
        let left = graph.residual(right, &heights, workers);
        let found = self.descend(level + 1, &coarser.sums(|row| left[row], workers), workers);
        for (height, &aggregate) in heights.iter_mut().zip(&coarser.of) {
            if aggregate != NONE {
                *height += ENLARGED * found[aggregate as usize];
            }
        }
        let left = graph.residual(right, &heights, workers);
        smooth(&left, graph, &mut heights);
        heights
    }
}

/// y ← y + ω D⁻¹ r, where D is not 0.
fn smooth(residual: &[f64], graph: &Graph, heights: &mut [f64]) {
    for ((height, left), &diagonal) in heights.iter_mut().zip(residual).zip(graph.diagonal()) {
        if diagonal > 0.0 {
            *height += SMOOTHING * left / diagonal;
        }
    }
}

/// The coarsest aggregates, with a factor of their matrix.
struct Coarsest {
    /// Aggregates that hang together: constants in a part are no error, or the hats see them where a prior holds
    /// M, and else they are rounding.
    parts: Vec<Vec<usize>>,
    factor: Option<Cholesky>,
}

impl Coarsest {
    fn new(graph: &Graph) -> Self {
        let mut sets = DisjointSets::new(graph.count());
        let mut entries = Vec::new();
        for row in 0..graph.count() {
            let own = graph.diagonal()[row];
            let own = if own > 0.0 { own * (1.0 + RIDGE) } else { 1.0 };
            entries.push((row as u32, row as u32, own));
            for (other, weight) in graph.row(row).filter(|&(other, _)| other < row) {
                sets.union(row, other);
                entries.push((row as u32, other as u32, -f64::from(weight)));
            }
        }
        let mut parts = vec![Vec::new(); graph.count()];
        (0..graph.count()).for_each(|row| parts[sets.find(row)].push(row));
        parts.retain(|part| !part.is_empty());
        let factor = if parts.is_empty() { None } else { Cholesky::new(graph.count(), &entries) };
        Self { parts, factor }
    }

    fn solve(&self, right: &[f64]) -> Vec<f64> {
        let mut heights = right.to_vec();
        let Some(factor) = &self.factor else { return vec![0.0; right.len()] };
        self.take_constants_out(&mut heights);
        factor.substitute(&mut heights);
        self.take_constants_out(&mut heights);
        heights
    }

    fn take_constants_out(&self, values: &mut [f64]) {
        for part in &self.parts {
            let mean = part.iter().map(|&row| values[row]).sum::<f64>() / part.len() as f64;
            part.iter().for_each(|&row| values[row] -= mean);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coarse::Edges;
    use crate::testing::random_number;

    const SIDE: usize = 60;
    /// More than are factorised are compared with nothing: they must not keep levels from growing coarser.
    const ALONE: usize = FEW + SIDE;
    const COUNT: usize = SIDE * SIDE + ALONE;

    /// A square lattice of equal edges, and unknowns by themselves, with a prior on some or on none.
    struct Lattice(f64);

    impl Edges for Lattice {
        fn of(&self, unknown: usize, mut add: impl FnMut(usize, f64)) {
            let (row, col) = (unknown / SIDE, unknown % SIDE);
            if row >= SIDE {
                return;
            }
            let below = (row + 1 < SIDE).then_some(unknown + SIDE);
            let beside = [(col > 0).then(|| unknown - 1), (col + 1 < SIDE).then_some(unknown + 1)];
            let above = (row > 0).then(|| unknown - SIDE);
            [below, above].into_iter().chain(beside).flatten().for_each(|other| add(other, 1.0));
        }

        fn own(&self, unknown: usize) -> f64 {
            if unknown.is_multiple_of(7) { self.0 } else { 0.0 }
        }
    }

    fn dot(a: &[f64], b: &[f64]) -> f64 {
        a.iter().zip(b).map(|(a, b)| a * b).sum()
    }

    /// All that conjugate gradients need: it is symmetric and definite, and B A has no small eigenvalue.
    #[test]
    fn a_cycle_is_symmetric_and_nearly_the_inverse() {
        let (workers, control) = (Workers::new(None).unwrap(), Control::new());
        for own in [0.0, 0.4] {
            let alone = |_| std::iter::empty();
            let each =
                Partition::neighbourhoods(COUNT, |_| true, alone, &workers, &control).unwrap();
            let graph = each.graph(&Lattice(own), &workers, &control).unwrap();
            let cycle = Cycle::new(graph, &workers, &control).unwrap();
            assert!(cycle.levels.len() == 2, "{}", cycle.levels.len());
            let graph = &cycle.levels[0].0;
            let vector = |seed: usize| -> Vec<f64> {
                (0..COUNT).map(|index| random_number(seed + 3 * index)).collect()
            };
            let product = |y: &[f64]| -> Vec<f64> {
                let left = graph.residual(&vec![0.0; COUNT], y, &workers);
                left.into_iter().map(|left| -left).collect()
            };
            // Right-hand sides of errors, without what S does not see.
            let [a, b] = [5, 77].map(|seed| product(&vector(seed)));
            let (of_a, of_b) = (cycle.descend(0, &a, &workers), cycle.descend(0, &b, &workers));
            let [ab, ba] = [dot(&a, &of_b), dot(&b, &of_a)];
            // The edges of both directions are the same numbers: rounding in double precision, of a
            // condition of COUNT.
            let size = (dot(&a, &of_a) * dot(&b, &of_b)).sqrt();
            assert!((ab - ba).abs() < 1e-9 * size, "{ab} {ba}");
            // A power of 2.
            assert!(cycle.correct(&a, &workers).iter().zip(&of_a).all(|(y, z)| *y == SHARE * z));
            // Rayleigh's quotients of B A in the norm of A, of random errors and of the smoothest: of the last
            // Jacobi alone finds some 1.4 (π/SIDE)²/4 = 1e-3, and the cycle a hundred times as much. What
            // two levels find is enlarged to 3.2 at most, and smoothing adds no more than 1.
            let smooth = |at: usize| ((at / SIDE) as f64 / SIDE as f64 * 3.1).cos();
            for error in [vector(9), (0..COUNT).map(smooth).collect()] {
                let right = product(&error);
                let found = cycle.descend(0, &right, &workers);
                let quotient = dot(&found, &right) / dot(&error, &right);
                assert!((0.1..4.3).contains(&quotient), "{quotient}");
            }
        }
    }
}

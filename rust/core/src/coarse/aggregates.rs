//! A third coarse space: aggregates of pixels that exposures compare directly.
//!
//! An error that exposures barely constrain is nearly the same in pixels that see one cell, whatever else
//! its form: only then is gᵀSg small. So each column is 1 in an aggregate, a pixel and all that see a cell
//! of its own, times M, and 0 elsewhere. The columns hold all waves that are barely constrained at once,
//! with their borders, where hats times waves need a space for each. In relative steps the matrix is again
//! the Laplacian of a weighted graph,
//!
//! ```text
//! (A y)_a = Σ_b w_ab (y_a − y_b) + own_a y_a
//! ```
//!
//! with w_ab the sum of the edges between two aggregates. It is large, so A⁻¹ is one cycle over coarser and
//! coarser aggregates of aggregates (Vaněk, Mandel and Brezina, Computing 56 (1996) 179). Aggregates see
//! the energy of a smooth error larger than it is: what they add is enlarged (Braess, Computing 55 (1995)
//! 379).

use super::matrix::RIDGE;
use crate::connectivity::DisjointSets;
use crate::control::Control;
use crate::error::Result;
use crate::linalg::Cholesky;
use crate::parallel::Workers;

/// What stands for the aggregate of an unknown that is in none.
pub(crate) const NONE: u32 = u32::MAX;
/// And of one that waits for its aggregate.
const FREE: u32 = NONE - 1;
/// Marks those that joined an aggregate once its star stood.
const JOINED: u32 = 1 << 31;
/// Edges of less than this share of an unknown's heaviest do not count for stars.
const STRONG: f32 = 0.25;
/// The damping of Jacobi's method: eigenvalues of D⁻¹A are below 2.
const SMOOTHING: f64 = 0.7;
/// How much is made of what coarser aggregates find.
const ENLARGED: f64 = 1.8;
/// Aggregates whose matrix is factorised.
const FEW: usize = 600;
/// The share of aggregates that is left where coarser ones gain nothing.
const NO_GAIN: f64 = 0.7;
/// Blocks of aggregates that threads sum edges of, and the least aggregates of one.
const BLOCKS: usize = 64;
const LEAST_BLOCK: usize = 256;
/// Rows of a matrix that a thread multiplies.
const ROWS: usize = 1 << 11;
/// Unknowns between two looks at whether to stop.
const CHECK_EVERY: usize = 1 << 16;

/// What unknowns are compared with.
pub(crate) trait Edges: Sync {
    /// Calls `add` with each unknown that this one is compared with, and the weight.
    fn of(&self, unknown: usize, add: impl FnMut(usize, f64));
    /// The weight that an unknown has by itself.
    fn own(&self, unknown: usize) -> f64;
}

/// Unknowns by aggregates.
pub(crate) struct Partition {
    /// The aggregate of each unknown, or [`NONE`].
    pub(crate) of: Vec<u32>,
    /// Unknowns, aggregate by aggregate, and where each begins, and the end.
    members: Vec<u32>,
    starts: Vec<usize>,
}

impl Partition {
    /// Stars of the unknowns that `is_used` picks of `size`: one with all its neighbours, where all are free.
    /// What is left joins the heaviest neighbour that is in a star, or stands alone. Neighbours that are no
    /// used unknowns do not count.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn stars<N: Iterator<Item = (usize, f32)>>(
        size: usize,
        is_used: impl Fn(usize) -> bool,
        neighbours: impl Fn(usize) -> N,
        control: &Control,
    ) -> Result<Self> {
        let mut of: Vec<u32> =
            (0..size).map(|unknown| if is_used(unknown) { FREE } else { NONE }).collect();
        let mut count = 0;
        for centre in 0..size {
            if centre % CHECK_EVERY == 0 {
                control.check()?;
            }
            if of[centre] != FREE {
                continue;
            }
            let state = |(other, _)| of.get(other).copied().unwrap_or(NONE);
            let is_open = |state| state == FREE || state == NONE;
            let mut states = neighbours(centre).map(state);
            if states.all(is_open) && neighbours(centre).map(state).any(|state| state == FREE) {
                of[centre] = count;
                for (other, _) in neighbours(centre) {
                    if let Some(place) = of.get_mut(other).filter(|place| **place == FREE) {
                        *place = count;
                    }
                }
                count += 1;
            }
        }
        for unknown in 0..size {
            if unknown % CHECK_EVERY == 0 {
                control.check()?;
            }
            if of[unknown] == FREE {
                let state = |(other, weight)| (of.get(other).copied().unwrap_or(NONE), weight);
                let stars = neighbours(unknown).map(state).filter(|&(star, _)| star < JOINED);
                let heaviest = stars.max_by(|a, b| a.1.total_cmp(&b.1));
                let (star, _) = heaviest.unwrap_or((count, 0.0));
                count = count.max(star + 1);
                of[unknown] = star | JOINED;
            }
        }
        let used = of.iter_mut().filter(|aggregate| **aggregate != NONE);
        used.for_each(|aggregate| *aggregate &= !JOINED);
        Ok(Self::sorted(of, count as usize))
    }

    fn sorted(of: Vec<u32>, count: usize) -> Self {
        let mut starts = vec![0; count + 1];
        let placed = || of.iter().enumerate().filter(|(_, aggregate)| **aggregate != NONE);
        placed().for_each(|(_, &aggregate)| starts[aggregate as usize + 1] += 1);
        for aggregate in 0..count {
            starts[aggregate + 1] += starts[aggregate];
        }
        let mut ends = starts.clone();
        let mut members = vec![0; starts[count]];
        for (unknown, &aggregate) in placed() {
            let end = &mut ends[aggregate as usize];
            members[*end] = unknown as u32;
            *end += 1;
        }
        Self { of, members, starts }
    }

    pub(crate) const fn count(&self) -> usize {
        self.starts.len() - 1
    }

    /// The unknowns of an aggregate.
    pub(crate) fn members(&self, aggregate: usize) -> impl Iterator<Item = usize> {
        let members = &self.members[self.starts[aggregate]..self.starts[aggregate + 1]];
        members.iter().map(|&member| member as usize)
    }

    /// Σ of each aggregate's values.
    pub(crate) fn sums(&self, value: impl Fn(usize) -> f64 + Sync, workers: &Workers) -> Vec<f64> {
        let mut sums = vec![0.0; self.count()];
        workers.map_blocks(&mut sums, ROWS, |block, sums| {
            for (index, sum) in sums.iter_mut().enumerate() {
                *sum = self.members(block * ROWS + index).map(&value).sum();
            }
        });
        sums
    }

    /// The graph of the aggregates.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn graph(
        &self,
        edges: &impl Edges,
        workers: &Workers,
        control: &Control,
    ) -> Result<Graph> {
        let size = self.count().div_ceil(BLOCKS).max(LEAST_BLOCK);
        let blocks = workers.map(self.count().div_ceil(size), |block| {
            let mut part = Graph::default();
            // Where the weight of each aggregate stands: of this row if it is not before its beginning.
            let mut slots = vec![0_u32; self.count()];
            let mut weights: Vec<f64> = Vec::new();
            for aggregate in block * size..((block + 1) * size).min(self.count()) {
                if control.is_cancelled() {
                    break;
                }
                let first = part.others.len();
                weights.clear();
                for member in self.members(aggregate) {
                    edges.of(member, |other, weight| {
                        let other = self.of[other];
                        if other as usize == aggregate {
                            return;
                        }
                        let slot = &mut slots[other as usize];
                        let is_known = *slot as usize >= first
                            && part.others.get(*slot as usize) == Some(&other);
                        if !is_known {
                            *slot = part.others.len() as u32;
                            part.others.push(other);
                            weights.push(0.0);
                        }
                        weights[*slot as usize - first] += weight;
                    });
                }
                let own: f64 = self.members(aggregate).map(|member| edges.own(member)).sum();
                part.starts.push(part.others.len());
                part.diagonal.push(weights.iter().sum::<f64>() + own);
                part.weights.extend(weights.iter().map(|&weight| weight as f32));
            }
            part
        });
        control.check()?;
        let mut whole = Graph { starts: vec![0], ..Graph::default() };
        for block in blocks {
            let first = whole.others.len();
            whole.starts.extend(block.starts.iter().map(|start| first + start));
            whole.others.extend(block.others);
            whole.weights.extend(block.weights);
            whole.diagonal.extend(block.diagonal);
        }
        Ok(whole)
    }
}

/// A matrix with the elements −w beside its diagonal, which holds Σ w and each unknown's own weight.
#[derive(Default)]
pub(crate) struct Graph {
    /// Where the elements of each row begin, and the end.
    starts: Vec<usize>,
    others: Vec<u32>,
    weights: Vec<f32>,
    diagonal: Vec<f64>,
}

impl Graph {
    fn count(&self) -> usize {
        self.diagonal.len()
    }

    fn row(&self, row: usize) -> impl Iterator<Item = (usize, f32)> {
        let places = self.starts[row]..self.starts[row + 1];
        let others = self.others[places.clone()].iter().map(|&other| other as usize);
        others.zip(self.weights[places].iter().copied())
    }

    /// Those neighbours of a row that count for stars.
    fn strong(&self, row: usize) -> impl Iterator<Item = (usize, f32)> {
        let heaviest = self.row(row).fold(0.0, |most: f32, (_, weight)| most.max(weight));
        self.row(row).filter(move |&(_, w)| w > 0.0 && w >= STRONG * heaviest)
    }

    /// y ← y + ω D⁻¹ (b − A y); of y = 0 that is ω D⁻¹ b.
    fn smooth(&self, right: &[f64], heights: &mut [f64], workers: &Workers) {
        let left = self.residual(right, heights, workers);
        for ((height, left), &diagonal) in heights.iter_mut().zip(left).zip(&self.diagonal) {
            *height += damped(left, diagonal);
        }
    }

    /// b − A y.
    pub(crate) fn residual(&self, right: &[f64], heights: &[f64], workers: &Workers) -> Vec<f64> {
        let mut left = right.to_vec();
        workers.map_blocks(&mut left, ROWS, |block, left| {
            for (index, left) in left.iter_mut().enumerate() {
                let row = block * ROWS + index;
                let beside = self.row(row).map(|(other, w)| f64::from(w) * heights[other]);
                *left += beside.sum::<f64>() - self.diagonal[row] * heights[row];
            }
        });
        left
    }
}

impl Edges for Graph {
    fn of(&self, unknown: usize, mut add: impl FnMut(usize, f64)) {
        self.row(unknown).for_each(|(other, weight)| add(other, f64::from(weight)));
    }

    fn own(&self, unknown: usize) -> f64 {
        let beside: f64 = self.row(unknown).map(|(_, weight)| f64::from(weight)).sum();
        // Rounding of weights is none.
        let own = self.diagonal[unknown] - beside;
        if own > 1e-6 * beside { own } else { 0.0 }
    }
}

/// ω b/d: what is compared with nothing is no error that S can see.
fn damped(right: f64, diagonal: f64) -> f64 {
    if diagonal > 0.0 { SMOOTHING * right / diagonal } else { 0.0 }
}

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
            let stars = Partition::stars(count, |_| true, |row| graph.strong(row), control)?;
            if stars.count() as f64 > NO_GAIN * count as f64 {
                break;
            }
            let coarser = stars.graph(&graph, workers, control)?;
            levels.push((graph, stars));
            graph = coarser;
        }
        Ok(Self { levels, coarsest: Coarsest::new(&graph) })
    }

    /// The heights y with A y = b, nearly.
    pub(crate) fn solve(&self, right: &[f64], workers: &Workers) -> Vec<f64> {
        self.descend(0, right, workers)
    }

    fn descend(&self, level: usize, right: &[f64], workers: &Workers) -> Vec<f64> {
        let Some((graph, stars)) = self.levels.get(level) else {
            return self.coarsest.solve(right);
        };
        let diagonal = &graph.diagonal;
        let mut heights: Vec<f64> =
            right.iter().zip(diagonal).map(|(&b, &diagonal)| damped(b, diagonal)).collect();
        let left = graph.residual(right, &heights, workers);
        let found = self.descend(level + 1, &stars.sums(|row| left[row], workers), workers);
        for (height, &star) in heights.iter_mut().zip(&stars.of) {
            *height += ENLARGED * found[star as usize];
        }
        graph.smooth(right, &mut heights, workers);
        heights
    }
}

/// The coarsest aggregates, with a factor of their matrix.
struct Coarsest {
    /// Aggregates that hang together: constants in a part are no error, and what there is of them is rounding.
    parts: Vec<Vec<usize>>,
    factor: Option<Cholesky>,
}

impl Coarsest {
    fn new(graph: &Graph) -> Self {
        let mut sets = DisjointSets::new(graph.count());
        let mut entries = Vec::new();
        for row in 0..graph.count() {
            let own = graph.diagonal[row];
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
        Self { parts, factor: Cholesky::new(graph.count(), &entries) }
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
    use crate::testing::random_number;

    /// A square lattice with edges of weights that look random, some unknowns held by themselves.
    struct Lattice {
        side: usize,
        held: bool,
    }

    impl Lattice {
        const fn count(&self) -> usize {
            self.side * self.side
        }
    }

    impl Edges for Lattice {
        fn of(&self, unknown: usize, mut add: impl FnMut(usize, f64)) {
            let (row, col) = (unknown / self.side, unknown % self.side);
            // Each edge has the number of its upper or left end.
            let weight = |end: usize, along: usize| 1.2 + random_number(2 * end + along);
            if row > 0 {
                add(unknown - self.side, weight(unknown - self.side, 0));
            }
            if col > 0 {
                add(unknown - 1, weight(unknown - 1, 1));
            }
            if row + 1 < self.side {
                add(unknown + self.side, weight(unknown, 0));
            }
            if col + 1 < self.side {
                add(unknown + 1, weight(unknown, 1));
            }
        }

        fn own(&self, unknown: usize) -> f64 {
            if self.held && unknown.is_multiple_of(7) { 0.4 } else { 0.0 }
        }
    }

    /// Each unknown by itself, so that the graph is that of the edges.
    fn whole(edges: &Lattice, workers: &Workers) -> Graph {
        let of = (0..edges.count() as u32).collect();
        let alone = Partition::sorted(of, edges.count());
        alone.graph(edges, workers, &Control::new()).unwrap()
    }

    /// yᵀAy by its definition, of heights of the lattice.
    fn energy(edges: &Lattice, heights: impl Fn(usize) -> f64) -> f64 {
        let mut sum = 0.0;
        for unknown in 0..edges.count() {
            sum += edges.own(unknown) * heights(unknown).powi(2);
            // Each edge is met from both ends.
            edges.of(unknown, |other, weight| {
                sum += weight * (heights(unknown) - heights(other)).powi(2) / 2.0;
            });
        }
        sum
    }

    fn product(graph: &Graph, heights: &[f64], workers: &Workers) -> Vec<f64> {
        let right = vec![0.0; heights.len()];
        graph.residual(&right, heights, workers).into_iter().map(|left| -left).collect()
    }

    fn dot(a: &[f64], b: &[f64]) -> f64 {
        a.iter().zip(b).map(|(a, b)| a * b).sum()
    }

    fn vector(length: usize, seed: usize) -> Vec<f64> {
        (0..length).map(|index| random_number(seed + 3 * index)).collect()
    }

    #[test]
    fn a_star_is_an_unknown_with_all_its_neighbours() {
        // A chain of nine, of which number 4 is not used: 0 1 | 2 3 joins; 5 6 | 7 8 joins.
        let beside = |at: usize| [at.wrapping_sub(1), at + 1].map(|other| (other, 1.0)).into_iter();
        let chain = Partition::stars(9, |at| at != 4, beside, &Control::new()).unwrap();
        assert_eq!(chain.of, [0, 0, 1, 1, NONE, 2, 2, 3, 3]);
        let members: Vec<Vec<usize>> = (0..4).map(|star| chain.members(star).collect()).collect();
        assert_eq!(members, [[0, 1], [2, 3], [5, 6], [7, 8]]);
        let sums = chain.sums(|at| (at * at) as f64, &Workers::new(None).unwrap());
        assert_eq!(sums, [1.0, 13.0, 61.0, 113.0]);
        // 0 and 1 are a star; 2 joins the heavier of two, and 4 is compared with nothing.
        let edges = [vec![(1, 1.0)], vec![(0, 1.0), (2, 2.0)], vec![(1, 2.0), (3, 3.0)]];
        let edges = [&edges[..], &[vec![(2, 3.0)], vec![]]].concat();
        let beside = |at: usize| edges[at].clone().into_iter();
        let lone = Partition::stars(5, |_| true, beside, &Control::new()).unwrap();
        assert_eq!(lone.of, [0, 0, 1, 1, 2]);
    }

    #[test]
    fn a_graph_of_aggregates_has_the_energy_of_its_unknowns() {
        let workers = Workers::new(None).unwrap();
        for held in [false, true] {
            let edges = Lattice { side: 60, held };
            let fine = whole(&edges, &workers);
            let strong = |row| fine.strong(row);
            let stars = Partition::stars(edges.count(), |_| true, strong, &Control::new()).unwrap();
            assert!(stars.count() < edges.count() / 2);
            let coarse = stars.graph(&fine, &workers, &Control::new()).unwrap();
            let heights = vector(stars.count(), 5);
            let found = dot(&heights, &product(&coarse, &heights, &workers));
            let wanted = energy(&edges, |unknown| heights[stars.of[unknown] as usize]);
            // Weights in single precision.
            assert!((found / wanted - 1.0).abs() < 1e-6, "{found} {wanted}");
        }
    }

    /// What conjugate gradients need.
    #[test]
    fn a_cycle_is_nearly_the_inverse_and_symmetric() {
        let workers = Workers::new(None).unwrap();
        for held in [false, true] {
            let edges = Lattice { side: 60, held };
            let cycle = Cycle::new(whole(&edges, &workers), &workers, &Control::new()).unwrap();
            assert!(cycle.levels.len() == 2, "{}", cycle.levels.len());
            let graph = &cycle.levels[0].0;
            let [a, b] = [5, 77].map(|seed| {
                let mut right = vector(edges.count(), seed);
                // Without a prior constants are no right-hand side.
                let mean = right.iter().sum::<f64>() / right.len() as f64;
                right.iter_mut().for_each(|right| *right -= mean);
                right
            });
            let (of_a, of_b) = (cycle.solve(&a, &workers), cycle.solve(&b, &workers));
            let [ab, ba] = [dot(&a, &of_b), dot(&b, &of_a)];
            // Weights in single precision are the same in both directions but for their rounding.
            assert!((ab - ba).abs() < 1e-5 * dot(&a, &of_a), "{ab} {ba}");
            assert!(dot(&a, &of_a) > 0.0);
            // A smooth error is the worst. With eigenvalues of 1/5 to 5 some 60 corrections by 2/5 leave less
            // than a hundredth of it, and of its energy the square.
            let smooth = |at: usize| (at as f64 / edges.count() as f64 * 6.0).sin();
            let error: Vec<f64> = (0..edges.count()).map(smooth).collect();
            let right = product(graph, &error, &workers);
            let mut heights = vec![0.0; edges.count()];
            for _ in 0..60 {
                let left = graph.residual(&right, &heights, &workers);
                let found = cycle.solve(&left, &workers);
                heights.iter_mut().zip(found).for_each(|(height, found)| *height += 0.4 * found);
            }
            let [first, last] = [vec![0.0; error.len()], heights].map(|heights| {
                let left: Vec<f64> = error.iter().zip(&heights).map(|(e, y)| e - y).collect();
                dot(&left, &product(graph, &left, &workers))
            });
            assert!(last < 1e-4 * first, "{last} {first}");
        }
    }
}

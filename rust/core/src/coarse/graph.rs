//! Aggregates: a partition of unknowns, and the graph of what they are compared with.
//!
//! An error that exposures barely constrain is nearly the same in pixels that see one cell, whatever else
//! its form: only then is gᵀSg small. So each column of this coarse space is 1 in an aggregate, a pixel and
//! those that are compared with it, times M, and 0 elsewhere. The columns hold all waves that are barely
//! constrained at once, with their borders, where hats times waves need a space for each. In relative steps
//! the matrix is again the Laplacian of a weighted graph,
//!
//! ```text
//! (A y)_a = Σ_b w_ab (y_a − y_b) + own_a y_a
//! ```
//!
//! with w_ab the sum of the edges between two aggregates, and own_a that of what a prior adds.

use crate::connectivity::in_parts;
use crate::control::Control;
use crate::error::Result;
use crate::parallel::Workers;

/// What stands for the aggregate of an unknown that is in none.
pub(crate) const NONE: u32 = u32::MAX;
/// And of one that waits for its aggregate.
const FREE: u32 = NONE - 1;
/// Marks those that joined an aggregate once its neighbourhood was taken.
const JOINED: u32 = 1 << 31;
/// Edges of less than this share of the heaviest do not make aggregates.
pub(crate) const STRONG: f64 = 0.25;
/// Blocks of aggregates that threads sum edges of, and the least aggregates of one.
const BLOCKS: usize = 64;
const LEAST_BLOCK: usize = 256;
/// The share of a sum of weights that their rounding makes.
const ROUNDING: f64 = 1e-6;
/// Rows of a matrix that a thread multiplies.
const ROWS: usize = 1 << 11;

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
    /// Neighbourhoods of the unknowns that `is_used` picks of `size`: one with all its neighbours, where all
    /// are free. Each of the rest joins the heaviest neighbour that is in one, or is an aggregate by itself
    /// if it has no neighbours. Neighbours that are no used unknowns do not count.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn neighbourhoods<N: Iterator<Item = (usize, f32)>>(
        size: usize,
        is_used: impl Fn(usize) -> bool,
        neighbours: impl Fn(usize) -> N,
        workers: &Workers,
        control: &Control,
    ) -> Result<Self> {
        let mut of = workers.filled(size, NONE, control);
        in_parts(size, control, |unknown| {
            if is_used(unknown) {
                of[unknown] = FREE;
            }
        })?;
        let mut count = 0;
        in_parts(size, control, |centre| {
            if of[centre] != FREE {
                return;
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
        })?;
        in_parts(size, control, |unknown| {
            if of[unknown] == FREE {
                let state = |(other, weight)| (of.get(other).copied().unwrap_or(NONE), weight);
                let taken = neighbours(unknown).map(state).filter(|&(of, _)| of < JOINED);
                let heaviest = taken.max_by(|a, b| a.1.total_cmp(&b.1));
                let (aggregate, _) = heaviest.unwrap_or((count, 0.0));
                count = count.max(aggregate + 1);
                of[unknown] = aggregate | JOINED;
            }
        })?;
        Self::sorted(of, count as usize, control)
    }

    /// That of marked numbers of aggregates.
    fn sorted(mut of: Vec<u32>, count: usize, control: &Control) -> Result<Self> {
        let mut starts = vec![0; count + 1];
        in_parts(of.len(), control, |unknown| {
            if of[unknown] != NONE {
                of[unknown] &= !JOINED;
                starts[of[unknown] as usize + 1] += 1;
            }
        })?;
        for aggregate in 0..count {
            starts[aggregate + 1] += starts[aggregate];
        }
        let mut ends = starts.clone();
        let mut members = vec![0; starts[count]];
        in_parts(of.len(), control, |unknown| {
            if of[unknown] != NONE {
                let end = &mut ends[of[unknown] as usize];
                members[*end] = unknown as u32;
                *end += 1;
            }
        })?;
        Ok(Self { of, members, starts })
    }

    pub(crate) const fn count(&self) -> usize {
        self.starts.len() - 1
    }

    /// The unknowns of an aggregate.
    fn members(&self, aggregate: usize) -> impl Iterator<Item = usize> {
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
                        // What is compared with nothing is in none.
                        if other == NONE || other as usize == aggregate {
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
        let count: usize = blocks.iter().map(|block| block.others.len()).sum();
        let mut whole = Graph {
            starts: Vec::with_capacity(self.count() + 1),
            others: Vec::with_capacity(count),
            weights: Vec::with_capacity(count),
            diagonal: Vec::with_capacity(self.count()),
        };
        whole.starts.push(0);
        for block in blocks {
            control.check()?;
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
    pub(super) fn count(&self) -> usize {
        self.diagonal.len()
    }

    pub(super) fn diagonal(&self) -> &[f64] {
        &self.diagonal
    }

    pub(super) fn row(&self, row: usize) -> impl Iterator<Item = (usize, f32)> {
        let places = self.starts[row]..self.starts[row + 1];
        let others = self.others[places.clone()].iter().map(|&other| other as usize);
        others.zip(self.weights[places].iter().copied())
    }

    /// Those neighbours of a row that make aggregates.
    pub(super) fn strong(&self, row: usize) -> impl Iterator<Item = (usize, f32)> {
        let heaviest = self.row(row).fold(0.0, |most: f32, (_, weight)| most.max(weight));
        self.row(row).filter(move |&(_, weight)| weight >= STRONG as f32 * heaviest)
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
        let own = self.diagonal[unknown] - beside;
        // Weights were rounded to single precision, the diagonal was not.
        if own > ROUNDING * beside { own } else { 0.0 }
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
        let alone = Partition::sorted(of, edges.count(), &Control::new()).unwrap();
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
    fn an_aggregate_is_an_unknown_with_all_its_neighbours() {
        let (workers, control) = (Workers::new(None).unwrap(), Control::new());
        // A chain of nine, of which number 4 is not used: 1 is beside 0, 3 beside 2.
        let beside = |at: usize| [at.wrapping_sub(1), at + 1].map(|other| (other, 1.0)).into_iter();
        let chain = Partition::neighbourhoods(9, |at| at != 4, beside, &workers, &control).unwrap();
        assert_eq!(chain.of, [0, 0, 1, 1, NONE, 2, 2, 3, 3]);
        let members: Vec<Vec<usize>> = (0..4).map(|index| chain.members(index).collect()).collect();
        assert_eq!(members, [[0, 1], [2, 3], [5, 6], [7, 8]]);
        let sums = chain.sums(|at| (at * at) as f64, &workers);
        assert_eq!(sums, [1.0, 13.0, 61.0, 113.0]);
        // 0 takes 1, and 2 takes 3. 4 is beside 1 and 3, and joins the heavier; 5 is by itself.
        for (to_1, to_3, joined) in [(1.0, 2.0, 1), (2.0, 1.0, 0)] {
            for of_4 in [[(1, to_1), (3, to_3)], [(3, to_3), (1, to_1)]] {
                let pairs = |one, other, to_4| [vec![(other, 5.0)], vec![(one, 5.0), (4, to_4)]];
                let edges =
                    [pairs(0, 1, to_1), pairs(2, 3, to_3), [of_4.to_vec(), vec![]]].concat();
                let beside = |at: usize| edges[at].clone().into_iter();
                let joins =
                    Partition::neighbourhoods(6, |_| true, beside, &workers, &control).unwrap();
                assert_eq!(joins.of, [0, 0, 1, 1, joined, 2]);
            }
        }
    }

    #[test]
    fn a_graph_of_aggregates_has_the_energy_of_its_unknowns() {
        let workers = Workers::new(None).unwrap();
        for held in [false, true] {
            let edges = Lattice { side: 60, held };
            let fine = whole(&edges, &workers);
            let strong = |row| fine.strong(row);
            let partition = Partition::neighbourhoods(
                edges.count(),
                |_| true,
                strong,
                &workers,
                &Control::new(),
            )
            .unwrap();
            assert!(partition.count() < edges.count() / 2);
            let coarse = partition.graph(&fine, &workers, &Control::new()).unwrap();
            let heights = vector(partition.count(), 5);
            let found = dot(&heights, &product(&coarse, &heights, &workers));
            let wanted = energy(&edges, |unknown| heights[partition.of[unknown] as usize]);
            // Weights in single precision.
            assert!((found / wanted - 1.0).abs() < 1e-6, "{found} {wanted}");
        }
    }
}

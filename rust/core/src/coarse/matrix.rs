//! The coarse matrix A = Φᵀ S Φ, summed over blocks, and its factor.

use std::collections::HashMap;

use super::hats::Hats;
use crate::connectivity::DisjointSets;
use crate::control::Control;
use crate::error::Result;
use crate::linalg::Cholesky;

/// Hats further apart than this, in rows or columns of the coarse grid, meet only where exposures
/// are turned against each other.
pub(super) const REACH: usize = 2;
/// Places of a matrix element's row behind its column: the same coarse row, and those below.
pub(super) const STENCIL: usize = (REACH + 1) * (2 * REACH + 1);

/// What is added to the diagonal, as a share of it: less than the eigenvalues of parts that hang
/// together weakly.
pub(super) const RIDGE: f64 = 1e-6;
/// A share of the diagonal that rounding alone leaves of an eigenvalue.
pub(super) const NOTHING: f64 = 1e-10;
/// What is added if there are such eigenvalues, besides those of constants in a part, divided by the
/// square of the nodes along a side: a tenth of the smallest eigenvalue of a sensor that hangs
/// together. Single precision leaves errors in those directions, which must not be magnified.
const SINGULAR_RIDGE: f64 = 0.3;
/// Squares of the exposures of blocks between two looks at whether to stop.
const CHECK_EVERY: usize = 1 << 17;
/// Enough for eigenvalues that stand so far apart.
const INVERSE_ITERATIONS: usize = 3;

/// The factorised coarse matrix.
pub(crate) struct Coarse {
    /// Hats that hang together, each with its share of the area; other unknowns have none.
    parts: Vec<Vec<(usize, f64)>>,
    factor: Option<Cholesky>,
}

impl Coarse {
    /// The matrix of the hats, with `own` on their diagonal unless it is empty, and other unknowns, whose own
    /// diagonal elements are `others`, summed over blocks: what each exposure sees of them there.
    pub(crate) fn of_blocks(
        hats: &Hats,
        own: &[f64],
        others: &[f64],
        blocks: impl Iterator<Item = Vec<Entry>>,
        control: &Control,
    ) -> Result<Self> {
        let mut matrix = Matrix::new(hats, others.len());
        let mut unchecked = CHECK_EVERY;
        for entries in blocks {
            if unchecked >= CHECK_EVERY {
                control.check()?;
                unchecked = 0;
            }
            unchecked += entries.len().pow(2);
            matrix.add_block(&entries);
        }
        let of_hats = own.iter().enumerate();
        let of_others =
            others.iter().enumerate().map(|(index, value)| (hats.count() + index, value));
        for (place, &value) in of_hats.chain(of_others) {
            matrix.add(place, place, value);
            matrix.masses[place] += value;
        }
        control.check()?;
        Self::factorised(&matrix, hats, control)
    }

    /// Whether the matrix has a factor; rounding may leave none of a nearly singular one.
    pub(crate) const fn is_factorised(&self) -> bool {
        self.factor.is_some()
    }

    fn factorised(matrix: &Matrix, hats: &Hats, control: &Control) -> Result<Self> {
        let mut sets = DisjointSets::new(hats.count());
        matrix.for_each(|row, col, _| {
            if row.max(col) < hats.count() {
                sets.union(row, col);
            }
        });
        let mut parts: Vec<Vec<(usize, f64)>> = vec![Vec::new(); hats.count()];
        for hat in 0..hats.count() {
            parts[sets.find(hat)].push((hat, hats.share(hat)));
        }
        parts.retain(|part| !part.is_empty());
        let coarse = Self { parts, factor: matrix.factor(RIDGE) };
        control.check()?;
        if !coarse.is_singular(matrix) {
            return Ok(coarse);
        }
        control.check()?;
        let nodes = hats.rows.nodes.max(hats.cols.nodes) as f64;
        Ok(Self { factor: matrix.factor(SINGULAR_RIDGE / (nodes * nodes)), ..coarse })
    }

    /// Whether heights that are not constant in a part weigh nothing, by inverse iteration from
    /// heights without any order.
    fn is_singular(&self, matrix: &Matrix) -> bool {
        let mut heights: Vec<f64> =
            (0..matrix.near.len()).map(|hat| (hat as f64 * 2.4).sin()).collect();
        let mut quotient = f64::INFINITY;
        for _ in 0..INVERSE_ITERATIONS {
            for (hat, height) in heights.iter_mut().enumerate() {
                *height *= matrix.diagonal(hat);
            }
            self.correct(&mut heights, 1.0);
            let scale: f64 = (0..heights.len())
                .map(|hat| matrix.diagonal(hat) * heights[hat] * heights[hat])
                .sum::<f64>()
                .sqrt();
            if scale > 0.0 {
                heights.iter_mut().for_each(|height| *height /= scale);
            }
            quotient = matrix.energy(&heights);
        }
        quotient < NOTHING
    }

    /// The coarse correction: replaces a right-hand side by the heights of the hats and the other unknowns, times
    /// `factor`.
    ///
    /// Constants in a part are left out on either side: they are no error, and what there is of
    /// them is rounding. If rounding in a nearly singular matrix left no factor, the heights are 0
    /// and the first level is left alone.
    pub(crate) fn correct(&self, values: &mut [f64], factor: f64) {
        let Some(cholesky) = &self.factor else { return values.fill(0.0) };
        for part in &self.parts {
            let (sum, area) = part
                .iter()
                .fold((0.0, 0.0), |(sum, area), &(hat, share)| (sum + values[hat], area + share));
            part.iter().for_each(|&(hat, share)| values[hat] -= share * sum / area);
        }
        cholesky.substitute(values);
        // All unknowns by the same: with another for fluxes and shifts the correction is not symmetric.
        values.iter_mut().for_each(|value| *value *= factor);
        for part in &self.parts {
            let (sum, area) = part.iter().fold((0.0, 0.0), |(sum, area), &(hat, share)| {
                (sum + share * values[hat], area + share)
            });
            part.iter().for_each(|&(hat, _)| values[hat] -= sum / area);
        }
    }
}

/// One exposure's part in a block: its weight there, and what it sees of the unknowns.
pub(crate) struct Entry {
    pub(crate) weight: f64,
    pub(crate) hats: [(usize, f64); 4],
    /// Behind the hats.
    pub(crate) others: Vec<(usize, f64)>,
}

impl Entry {
    fn heights(&self) -> impl Iterator<Item = (usize, f64)> {
        self.hats.iter().chain(&self.others).copied()
    }
}

/// The coarse matrix before it is factorised: elements of one triangle.
struct Matrix {
    cols: usize,
    /// By hat and place in the stencil.
    near: Vec<[f64; STENCIL]>,
    /// Σ Ω φ² of each hat: what its diagonal element is compared with.
    masses: Vec<f64>,
    /// Of hats that meet only because exposures are turned against each other.
    far: HashMap<(usize, usize), f64>,
}

impl Matrix {
    fn new(hats: &Hats, others: usize) -> Self {
        Self {
            cols: hats.cols.nodes,
            near: vec![[0.0; STENCIL]; hats.count() + others],
            masses: vec![0.0; hats.count() + others],
            far: HashMap::new(),
        }
    }

    /// Adds Σ_k Ω_k (φ_k − φ̄)(φ_k − φ̄)ᵀ, φ̄ the weighted mean.
    fn add_block(&mut self, entries: &[Entry]) {
        let total: f64 = entries.iter().map(|entry| entry.weight).sum();
        let mut nodes: Vec<usize> =
            entries.iter().flat_map(|entry| entry.heights().map(|hat| hat.0)).collect();
        nodes.sort_unstable();
        nodes.dedup();
        let mut mean = vec![0.0; nodes.len()];
        let mut heights = vec![0.0; entries.len() * nodes.len()];
        for (entry, heights) in entries.iter().zip(heights.chunks_exact_mut(nodes.len().max(1))) {
            for (hat, height) in entry.heights() {
                self.masses[hat] += entry.weight * height * height;
                let at = nodes.partition_point(|&node| node < hat);
                heights[at] += height;
                mean[at] += entry.weight / total * height;
            }
        }
        // Summed before it is added: an element may be one of a map.
        let mut sums = vec![0.0; nodes.len() * nodes.len()];
        for (entry, heights) in entries.iter().zip(heights.chunks_exact_mut(nodes.len().max(1))) {
            for (height, mean) in heights.iter_mut().zip(&mean) {
                *height -= mean;
            }
            for (a, sums) in sums.chunks_exact_mut(nodes.len().max(1)).enumerate() {
                let upper = entry.weight * heights[a];
                let lower = sums[a..].iter_mut().zip(&heights[a..]);
                lower.for_each(|(sum, height)| *sum += upper * height);
            }
        }
        for (a, &upper) in nodes.iter().enumerate() {
            for (b, &lower) in nodes.iter().enumerate().skip(a) {
                self.add(upper, lower, sums[a * nodes.len() + b]);
            }
        }
    }

    /// Adds to the element of two hats, the first being the one with the lower number.
    fn add(&mut self, first: usize, second: usize, value: f64) {
        let rows = second / self.cols - first / self.cols;
        match (second % self.cols + REACH).checked_sub(first % self.cols) {
            Some(cols) if rows <= REACH && cols <= 2 * REACH => {
                self.near[first][rows * (2 * REACH + 1) + cols] += value;
            }
            _ => *self.far.entry((first, second)).or_default() += value,
        }
    }

    /// Calls `visit(row, col, value)` for the elements that are not 0.
    fn for_each(&self, mut visit: impl FnMut(usize, usize, f64)) {
        for (hat, stencil) in self.near.iter().enumerate() {
            for (place, &value) in stencil.iter().enumerate().filter(|(_, value)| **value != 0.0) {
                let (rows, cols) = (place / (2 * REACH + 1), place % (2 * REACH + 1));
                visit(hat, hat + rows * self.cols + cols - REACH, value);
            }
        }
        // The order of the map is another one each time, that of the elements is not.
        let mut far: Vec<_> = self.far.iter().collect();
        far.sort_unstable_by_key(|(place, _)| **place);
        far.iter().for_each(|&(&(row, col), &value)| visit(row, col, value));
    }

    /// The factor of the matrix with a share `ridge` added to its diagonal.
    fn factor(&self, ridge: f64) -> Option<Cholesky> {
        let mut entries = Vec::new();
        self.for_each(|row, col, value| {
            entries.push((row.max(col) as u32, row.min(col) as u32, value));
        });
        for hat in 0..self.near.len() {
            let (diagonal, mass) = (self.diagonal(hat), self.masses[hat]);
            // Exposures at one place compare nothing, and what is left of S is rounding: such a hat
            // gets a matrix of its own. So does one on which no weight falls.
            let more = match mass {
                0.0 => 1.0,
                mass if diagonal < NOTHING * mass => mass,
                _ => ridge * diagonal,
            };
            entries.push((hat as u32, hat as u32, more));
        }
        Cholesky::new(self.near.len(), &entries)
    }

    /// yᵀAy for heights y.
    fn energy(&self, heights: &[f64]) -> f64 {
        let mut energy = 0.0;
        self.for_each(|row, col, value| {
            let both = if row == col { 1.0 } else { 2.0 };
            energy += both * value * heights[row] * heights[col];
        });
        energy
    }

    /// The diagonal element of a hat.
    fn diagonal(&self, hat: usize) -> f64 {
        self.near[hat][REACH]
    }
}

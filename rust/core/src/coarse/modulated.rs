//! A second coarse space: hats times waves that exposures barely constrain.
//!
//! The symbol of S is nearly 0 at some wave vectors q besides 0 (`coarse/spectrum.rs`), and around each
//! there are errors of large scale, modulated by its wave. Their columns are φ_i cos(q·p) and
//! φ_i sin(q·p), times M or the beam as those of the hats alone. With z = y_c − i y_s heights y make
//! exposure k show Re(z_k e^{iq·p}), z_k = Σ_i z_i φ_i h_k. A block holds many periods, so that
//!
//! ```text
//! yᵀAy = ½ Σ_blocks [ Σ_k Ω_k |z_k|² − |Σ_k Ω_k z_k|² / Σ_k Ω_k ]
//! ```
//!
//! Waves of different q are nearly orthogonal: each has a matrix of its own.

use std::ops::Range;

use super::hats::Hats;
use super::modulated_kernel::{Accumulate, Close, Columns, Distribute, Open};
use super::modulated_matrix::{Matrix, SeenWave, Spot};
use super::spacing::DAMPING;
use super::spectrum::Wave;
use crate::linalg::Cholesky;
use crate::parallel::{Value, Workers};

/// The coarse space of some waves.
pub(crate) struct Modulated<N> {
    hats: Hats,
    spaces: Vec<Space<N>>,
    /// The first column behind each node of a row but the last, and the end.
    starts: Vec<usize>,
}

/// The part of one wave.
struct Space<N> {
    factor: Cholesky,
    /// cos and sin along a row, times the hat on the left; then times that on the right.
    columns: [Vec<N>; 4],
    /// cos and sin of each row's part of the phase, times the hat above, then times that below.
    rows: Vec<[N; 4]>,
}

impl<N: Value> Modulated<N> {
    /// The space of waves over an image of so many rows, with its matrix summed over blocks.
    pub(crate) fn new(
        hats: Hats,
        rows: usize,
        waves: &[SeenWave],
        blocks: &[Vec<Spot>],
        workers: &Workers,
    ) -> Self {
        let found = workers.map(waves.len(), |index| {
            let seen = &waves[index];
            let factor = Matrix::new(&hats, blocks, seen).factor(seen.wave.is_alone)?;
            let wave = &seen.wave;
            Some(Space { factor, columns: columns(&hats, wave), rows: factors(&hats, wave, rows) })
        });
        let mut starts: Vec<usize> = (0..hats.cols.nodes - 1)
            .map(|node| hats.columns.partition_point(|&(left, _)| (left as usize) < node))
            .collect();
        starts.push(hats.columns.len());
        Self { hats, spaces: found.into_iter().flatten().collect(), starts }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.spaces.is_empty()
    }

    /// How many heights there are: a cosine's and a sine's for each hat, wave by wave.
    pub(crate) fn size(&self) -> usize {
        2 * self.hats.count() * self.spaces.len()
    }

    /// Sums over hats of rows of values from `first` on, each row `width` long, with the places among all
    /// heights where they begin.
    pub(crate) fn gather(
        &self,
        first: usize,
        values: &[N],
        width: usize,
    ) -> Vec<(usize, Vec<f64>)> {
        let mut found = Vec::new();
        let mut lines = vec![N::default(); 4 * width];
        for (node, rows) in self.stretches(first, values.len() / width) {
            let values = &values[(rows.start - first) * width..(rows.end - first) * width];
            for (index, space) in self.spaces.iter().enumerate() {
                let (factors, lines) = (&space.rows[rows.clone()], &mut lines[..]);
                pulp::Arch::new().dispatch(Accumulate { values, factors, lines });
                for (below, lines) in lines.chunks_exact(2 * width).enumerate() {
                    found.push((self.place(index, node + below), self.close(space, lines)));
                }
            }
        }
        found
    }

    /// The coarse correction: replaces sums by the heights of the hats.
    pub(crate) fn correct(&self, heights: &mut [f64], workers: &Workers) {
        workers.map_blocks(heights, 2 * self.hats.count(), |index, heights| {
            self.spaces[index].factor.substitute(heights);
            heights.iter_mut().for_each(|height| *height *= DAMPING);
        });
    }

    /// Heights along the rows of the coarse grid, wave by wave, at every column: what goes with cos and
    /// with sin of a row's part of the phase.
    pub(crate) fn open(&self, heights: &[f64], width: usize, workers: &Workers) -> Vec<N> {
        let (down, across) = (self.hats.rows.nodes, self.hats.cols.nodes);
        let mut lines = vec![N::default(); 2 * width * down * self.spaces.len()];
        workers.map_blocks(&mut lines, 2 * width, |index, lines| {
            let (space, node) = (&self.spaces[index / down], index % down);
            let heights = &heights[self.place(index / down, node)..][..2 * across];
            let (cos, sin) = lines.split_at_mut(width);
            for (left, heights) in heights.windows(4).step_by(2).enumerate() {
                let columns = self.starts[left]..self.starts[left + 1];
                let heights = std::array::from_fn(|i| N::of(heights[i]));
                let lines = [&mut cos[columns.clone()], &mut sin[columns.clone()]];
                let columns = space.columns(columns);
                pulp::Arch::new().dispatch(Open { heights, columns, lines });
            }
        });
        lines
    }

    /// Adds what such lines are on rows from `first` on to rows of sums.
    pub(crate) fn spread(&self, lines: &[N], first: usize, sums: &mut [N], width: usize) {
        for (node, rows) in self.stretches(first, sums.len() / width) {
            let sums = &mut sums[(rows.start - first) * width..(rows.end - first) * width];
            for (index, space) in self.spaces.iter().enumerate() {
                let factors = &space.rows[rows.clone()];
                let at = (index * self.hats.rows.nodes + node) * 2 * width;
                let (lines, sums) = (&lines[at..at + 4 * width], &mut *sums);
                pulp::Arch::new().dispatch(Distribute { lines, factors, sums });
            }
        }
    }

    /// Where the heights of a wave's hats along a coarse row begin.
    fn place(&self, index: usize, node: usize) -> usize {
        2 * (index * self.hats.count() + node * self.hats.cols.nodes)
    }

    /// Rows from `first` on, cut where the coarse row before them changes.
    fn stretches(&self, first: usize, count: usize) -> Vec<(usize, Range<usize>)> {
        let mut found: Vec<(usize, Range<usize>)> = Vec::new();
        for row in first..first + count {
            let (node, _) = self.hats.rows.at(row as f64);
            match found.last_mut() {
                Some((last, rows)) if *last == node => rows.end = row + 1,
                _ => found.push((node, row..row + 1)),
            }
        }
        found
    }

    /// Sums along a coarse row, of lines that go with cos and sin of a row's part of the phase.
    fn close(&self, space: &Space<N>, lines: &[N]) -> Vec<f64> {
        let (cos, sin) = lines.split_at(lines.len() / 2);
        let mut found = vec![0.0; 2 * self.hats.cols.nodes];
        for (left, ends) in self.starts.windows(2).enumerate() {
            let columns = ends[0]..ends[1];
            let lines = [&cos[columns.clone()], &sin[columns.clone()]];
            let sums = pulp::Arch::new().dispatch(Close { lines, columns: space.columns(columns) });
            found[2 * left..].iter_mut().zip(sums).for_each(|(found, sum)| *found += sum);
        }
        found
    }
}

impl<N> Space<N> {
    fn columns(&self, range: Range<usize>) -> Columns<'_, N> {
        let [a, b, c, d] = self.columns.each_ref().map(|column| &column[range.clone()]);
        Columns { left: [a, b], right: [c, d] }
    }
}

/// cos and sin of each row's part of the phase, times the hat above, then times that below.
fn factors<N: Value>(hats: &Hats, wave: &Wave, rows: usize) -> Vec<[N; 4]> {
    let of_row = |row: usize| {
        let (_, height) = hats.rows.at(row as f64);
        let (sin, cos) = (wave.vector[0] * row as f64).sin_cos();
        [(1.0 - height) * cos, (1.0 - height) * sin, height * cos, height * sin].map(N::of)
    };
    (0..rows).map(of_row).collect()
}

/// cos and sin of a wave along a row, times the hat on the left; then times that on the right.
fn columns<N: Value>(hats: &Hats, wave: &Wave) -> [Vec<N>; 4] {
    let column = |part: usize| {
        let places = hats.columns.iter().enumerate();
        let value = |(col, &(_, share)): (usize, &(u32, f32))| {
            let (sin, cos) = (wave.vector[1] * col as f64).sin_cos();
            let hat = if part < 2 { 1.0 - f64::from(share) } else { f64::from(share) };
            N::of(hat * [cos, sin][part % 2])
        };
        places.map(value).collect()
    };
    [0, 1, 2, 3].map(column)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Shape;
    use crate::testing::random_number;

    const SHAPE: Shape = Shape::new(41, 53);
    const VECTORS: [[f64; 2]; 2] = [[2.3, -0.7], [-1.1, 1.9]];
    const SHIFTS: [[f64; 2]; 3] = [[0.0, 0.0], [1.0, 3.0], [2.0, -2.0]];

    /// Waves as whole shifts show them, with blocks of one cell, all of weight 1.
    fn modulated(workers: &Workers) -> Modulated<f64> {
        let hats = Hats::new(SHAPE, [20, 26]);
        let waves = VECTORS.map(|vector| SeenWave {
            wave: Wave { vector, is_alone: false },
            factors: SHIFTS.map(|d| phase(-vector[0] * d[0] - vector[1] * d[1])).to_vec(),
            penalty: 0.0,
        });
        let spot = |cell: usize, exposure: usize| {
            let [row, col] = [cell / SHAPE.cols, cell % SHAPE.cols];
            let [down, right] = SHIFTS[exposure];
            let hats = hats.over(row as f64 - down, col as f64 - right);
            Spot { exposure, weight: 1.0, hats }
        };
        let blocks: Vec<Vec<Spot>> = (0..SHAPE.len())
            .map(|cell| (0..SHIFTS.len()).map(|exposure| spot(cell, exposure)).collect())
            .collect();
        Modulated::new(hats, SHAPE.rows, &waves, &blocks, workers)
    }

    fn phase(angle: f64) -> [f64; 2] {
        [angle.cos(), angle.sin()]
    }

    /// The column of a height, as its definition has it.
    fn column(space: &Modulated<f64>, place: usize, pixel: [f64; 2]) -> f64 {
        let count = 2 * space.hats.count();
        let [q, p] = VECTORS[place / count];
        let (hat, part) = (place % count / 2, place % 2);
        let covering = space.hats.over(pixel[0], pixel[1]);
        let height: f64 = covering.iter().filter(|over| over.0 == hat).map(|over| over.1).sum();
        let angle = q * pixel[0] + p * pixel[1];
        height * if part == 0 { angle.cos() } else { angle.sin() }
    }

    fn random(index: usize) -> f64 {
        0.5 * random_number(index)
    }

    #[test]
    fn sums_and_columns_are_those_of_the_definition() {
        let workers = Workers::new(None).unwrap();
        let space = modulated(&workers);
        let image: Vec<f64> = (0..SHAPE.len()).map(random).collect();
        let mut sums = vec![0.0; space.size()];
        // In bands of 8 rows.
        for (band, rows) in image.chunks(8 * SHAPE.cols).enumerate() {
            for (place, found) in space.gather(8 * band, rows, SHAPE.cols) {
                sums[place..].iter_mut().zip(found).for_each(|(sum, found)| *sum += found);
            }
        }
        let heights: Vec<f64> = (0..space.size()).map(|place| random(place + 7777)).collect();
        let lines = space.open(&heights, SHAPE.cols, &workers);
        let mut spread = vec![0.0; SHAPE.len()];
        for (band, rows) in spread.chunks_mut(8 * SHAPE.cols).enumerate() {
            space.spread(&lines, 8 * band, rows, SHAPE.cols);
        }
        let pixel = |index: usize| [(index / SHAPE.cols) as f64, (index % SHAPE.cols) as f64];
        // Sums of some thousand products, with hats along columns in single precision.
        let rounding = 2e3 * f64::from(f32::EPSILON) * 1e-1;
        for (place, sum) in sums.iter().enumerate() {
            let terms = image.iter().enumerate();
            let wanted: f64 =
                terms.map(|(index, value)| value * column(&space, place, pixel(index))).sum();
            assert!((sum - wanted).abs() < rounding);
        }
        for (index, value) in spread.iter().enumerate() {
            let terms = heights.iter().enumerate();
            let wanted: f64 = terms.map(|(place, y)| y * column(&space, place, pixel(index))).sum();
            assert!((value - wanted).abs() < rounding);
        }
    }

    /// What is left of heights once the cells have followed: Σ_k (x_k − x̄)² over the cells, with x_k the
    /// value at the pixel that sees a cell.
    #[test]
    fn the_matrix_is_that_of_the_columns() {
        let workers = Workers::new(None).unwrap();
        let space = modulated(&workers);
        let count = 2 * space.hats.count();
        for wave in 0..VECTORS.len() {
            for height in 0..count {
                let mut heights = vec![0.0; count];
                heights[height] = 1.0;
                space.spaces[wave].factor.substitute(&mut heights);
                let energy = |cell: usize| {
                    let [row, col] = [(cell / SHAPE.cols) as f64, (cell % SHAPE.cols) as f64];
                    let heights = SHIFTS.map(|[down, right]| {
                        let terms = heights.iter().enumerate();
                        terms
                            .map(|(place, y)| {
                                y * column(&space, wave * count + place, [row - down, col - right])
                            })
                            .sum::<f64>()
                    });
                    let mean = heights.iter().sum::<f64>() / 3.0;
                    heights.iter().map(|x| (x - mean).powi(2)).sum::<f64>()
                };
                // With A y = e_i, yᵀAy = y_i. Of cos² and sin² of the phase the sum over a hat of some
                // seven periods has half its length, and one period more or less at each end.
                let found: f64 = (0..SHAPE.len()).map(energy).sum();
                assert!(
                    (found / heights[height] - 1.0).abs() < 0.15,
                    "{found} {}",
                    heights[height]
                );
            }
        }
    }
}

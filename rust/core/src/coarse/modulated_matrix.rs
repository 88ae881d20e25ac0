//! The matrix of hats times one wave, before it is factorised.
//!
//! It is half of a Hermitian one, B_ij = Σ_blocks Σ_k Ω_k (φ_ik − φ̄_i)(φ_jk − φ̄_j)* with φ_ik what exposure
//! k makes of hat i. Since z_i z_j* = (c_i − i s_i)(c_j + i s_j), its real part stands between two
//! cosines and between two sines, and its imaginary part between a cosine and a sine:
//!
//! ```text
//! zᵀB z* = Σ_ij Re B_ij (c_i c_j + s_i s_j) − Im B_ij (c_i s_j − s_i c_j)
//! ```

use super::hats::Hats;
use super::matrix::{NOTHING, REACH, RIDGE, STENCIL};
use super::spectrum::{Complex, Wave, times};
use crate::linalg::Cholesky;

/// What one exposure shows in a block: its weight there, and the hats that it sees.
pub(crate) struct Spot {
    pub(crate) exposure: usize,
    pub(crate) weight: f64,
    pub(crate) hats: [(usize, f64); 4],
}

/// A wave with what each exposure makes of it, and the penalty on it in units of the weights.
pub(crate) struct SeenWave {
    pub(crate) wave: Wave,
    pub(crate) factors: Vec<Complex>,
    pub(crate) penalty: f64,
}

pub(super) struct Matrix {
    cols: usize,
    /// B by hat and place in the stencil.
    near: Vec<[Complex; STENCIL]>,
    /// Σ Ω |φ|² of each hat: what its diagonal element is compared with.
    masses: Vec<f64>,
}

impl Matrix {
    /// The sum over blocks of what exposures show there.
    pub(super) fn new(hats: &Hats, blocks: &[Vec<Spot>], seen: &SeenWave) -> Self {
        let mut matrix = Self {
            cols: hats.cols.nodes,
            near: vec![[[0.0; 2]; STENCIL]; hats.count()],
            masses: vec![0.0; hats.count()],
        };
        blocks.iter().for_each(|block| matrix.add(block, seen));
        matrix
    }

    /// Adds Σ_k Ω_k φ_k φ_k* − Ω φ̄ φ̄*, Ω the sum of all weights and φ̄ the weighted mean. An exposure sees few
    /// of the block's hats.
    fn add(&mut self, block: &[Spot], seen: &SeenWave) {
        let total: f64 = block.iter().map(|spot| spot.weight).sum();
        let mut nodes: Vec<usize> =
            block.iter().flat_map(|spot| spot.hats.map(|(hat, _)| hat)).collect();
        nodes.sort_unstable();
        nodes.dedup();
        let mut mean = vec![[0.0; 2]; nodes.len()];
        for Spot { exposure, weight, hats } in block {
            let [re, im] = seen.factors[*exposure];
            let size = re * re + im * im;
            for (i, &(hat, height)) in hats.iter().enumerate() {
                let share = weight / total * height;
                let mean = &mut mean[nodes.partition_point(|&node| node < hat)];
                *mean = [mean[0] + share * re, mean[1] + share * im];
                self.masses[hat] += weight * size * height * height;
                for &(other, beside) in &hats[i..] {
                    let value = weight * (size + seen.penalty) * height * beside;
                    self.add_element(hat, other, [value, 0.0]);
                }
            }
        }
        for (i, &first) in nodes.iter().enumerate() {
            for (j, &second) in nodes.iter().enumerate().skip(i) {
                let [re, im] = times(mean[i], [mean[j][0], -mean[j][1]]);
                self.add_element(first, second, [-total * re, -total * im]);
            }
        }
    }

    /// Adds to the element of two hats, the first being the one with the lower number. Hats further apart
    /// than the stencil do not meet, since exposures reach less far than from one hat to the next.
    fn add_element(&mut self, first: usize, second: usize, value: Complex) {
        let rows = second / self.cols - first / self.cols;
        let cols = (second % self.cols + REACH).checked_sub(first % self.cols);
        let place = cols.filter(|&cols| rows <= REACH && cols <= 2 * REACH);
        if let Some(cols) = place {
            let element = &mut self.near[first][rows * (2 * REACH + 1) + cols];
            *element = [element[0] + value[0], element[1] + value[1]];
        }
    }

    /// The factor of half the matrix, by cosines and sines in turn; of a wave that is its own opposite
    /// the squared cosine is 1 and not 1/2 in the mean.
    pub(super) fn factor(&self, is_alone: bool) -> Option<Cholesky> {
        let mut entries = Vec::new();
        let mean = if is_alone { 1.0 } else { 0.5 };
        for (hat, stencil) in (0_u32..).zip(&self.near) {
            for (place, &[re, im]) in stencil.iter().enumerate() {
                if [re, im] == [0.0; 2] {
                    continue;
                }
                let (rows, cols) = (place / (2 * REACH + 1), place % (2 * REACH + 1));
                let other = (hat as usize + rows * self.cols + cols - REACH) as u32;
                entries.push((2 * other, 2 * hat, mean * re));
                entries.push((2 * other + 1, 2 * hat + 1, mean * re));
                if other > hat && !is_alone {
                    entries.push((2 * other + 1, 2 * hat, -mean * im));
                    entries.push((2 * other, 2 * hat + 1, mean * im));
                }
            }
            let (diagonal, mass) = (self.near[hat as usize][REACH][0], self.masses[hat as usize]);
            let more = match mass {
                0.0 => 1.0,
                mass if diagonal < NOTHING * mass => mass,
                _ => RIDGE * diagonal,
            };
            entries.push((2 * hat, 2 * hat, more));
            entries.push((2 * hat + 1, 2 * hat + 1, more));
        }
        Cholesky::new(2 * self.near.len(), &entries)
    }
}

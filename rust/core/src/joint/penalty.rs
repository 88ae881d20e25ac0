//! The penalty on the beam's fourth differences, τ ‖G a‖², along rows and columns.
//!
//! It tells what the measurements do not: a spline's finest pattern, and its cells behind the edge.
//! Differences count where all five cells are seen. Since the beam has no scale of its own, the
//! penalty acts on what differs from the beam's multiples, in the metric of its weights D:
//! P x = x − a (aᵀD x)/(aᵀD a); otherwise it would pull the beam to 0 and M up.

use super::kernel::Add;
use crate::frames::Shape;
use crate::parallel::{Workers, dot};

const FOURTH: [f64; 5] = [1.0, -4.0, 6.0, -4.0, 1.0];
/// Rows that a thread takes at a time.
const BAND: usize = 16;

pub(super) struct Penalty {
    shape: Shape,
    pub(super) tau: f64,
    /// 1 where the five cells from here on count, down a column and along a row; else 0.
    counted: [Vec<f64>; 2],
    /// D a and aᵀ D a.
    pull: Vec<f64>,
    norm: f64,
}

impl Penalty {
    /// The penalty at a beam of weights D, seen where they are above 0.
    pub(super) fn new(
        shape: Shape,
        beam: &[f64],
        weights: &[f64],
        tau: f64,
        workers: &Workers,
    ) -> Self {
        let Shape { rows, cols } = shape;
        let count = |axis: usize, step: usize| {
            let mut counted = vec![0.0; shape.len()];
            workers.map_blocks(&mut counted, cols, |row, counted| {
                for (col, counted) in counted.iter_mut().enumerate() {
                    let inside = if axis == 0 { row + 4 < rows } else { col + 4 < cols };
                    let cell = row * cols + col;
                    let seen = inside && (0..5).all(|i| weights[cell + i * step] > 0.0);
                    *counted = f64::from(u8::from(seen));
                }
            });
            counted
        };
        let counted = [count(0, cols), count(1, 1)];
        let pull: Vec<f64> = weights.iter().zip(beam).map(|(d, a)| d * a).collect();
        let norm = workers.dot(&pull, beam);
        Self { shape, tau, counted, pull, norm }
    }

    /// The diagonal of τ GᵀG.
    pub(super) fn diagonal(&self) -> Vec<f64> {
        let mut diagonal = vec![0.0; self.pull.len()];
        for (counted, step) in self.counted.iter().zip([self.shape.cols, 1]) {
            for (cell, counted) in counted.iter().enumerate().filter(|(_, counted)| **counted > 0.0)
            {
                for (i, factor) in FOURTH.iter().enumerate() {
                    diagonal[cell + i * step] += self.tau * counted * factor * factor;
                }
            }
        }
        diagonal
    }

    /// P x.
    pub(super) fn relative(&self, beam: &[f64], x: &[f64], workers: &Workers) -> Vec<f64> {
        let scale = workers.dot(&self.pull, x) / self.norm;
        let mut relative = x.to_vec();
        workers.add_multiple(&mut relative, -scale, beam);
        relative
    }

    /// Adds `share` τ Pᵀ GᵀG x to `sums`; returns τ ‖G x‖².
    pub(super) fn add(
        &self,
        beam: &[f64],
        mut x: Vec<f64>,
        share: f64,
        sums: &mut [f64],
        workers: &Workers,
    ) -> f64 {
        let (differences, energy) = self.differences(&x, workers);
        self.pull_at(beam, &differences, share * self.tau, &mut x, sums, workers);
        self.tau * energy
    }

    /// Adds √τ Pᵀ Gᵀ s, whose covariance is that of the penalty, for signs s.
    pub(super) fn add_draw(
        &self,
        beam: &[f64],
        mut sign: impl FnMut() -> f64,
        sums: &mut [f64],
        workers: &Workers,
    ) {
        let mut draw = |counted: &Vec<f64>| counted.iter().map(|c| c * sign()).collect();
        let differences = [draw(&self.counted[0]), draw(&self.counted[1])];
        let mut room = vec![0.0; beam.len()];
        self.pull_at(beam, &differences, self.tau.sqrt(), &mut room, sums, workers);
    }

    /// Adds `share` Pᵀ Gᵀ of differences.
    fn pull_at(
        &self,
        beam: &[f64],
        differences: &[Vec<f64>; 2],
        share: f64,
        room: &mut [f64],
        sums: &mut [f64],
        workers: &Workers,
    ) {
        self.adjoint(differences, room, workers);
        let scale = workers.dot(beam, room) / self.norm;
        workers.add_multiple(room, -scale, &self.pull);
        workers.add_multiple(sums, share, room);
    }

    /// G x, down and along, and ‖G x‖².
    fn differences(&self, x: &[f64], workers: &Workers) -> ([Vec<f64>; 2], f64) {
        let cols = self.shape.cols;
        let size = BAND * cols;
        let mut differences = [0, 1].map(|_| vec![0.0; x.len()]);
        let [down, along] = &mut differences;
        let energies = workers.map_pairs(down, along, [size; 2], |band, down, along| {
            let first = band * size;
            let mut energy = 0.0;
            for (axis, part, step) in [(0, down, cols), (1, along, 1)] {
                let counted = &self.counted[axis][first..][..part.len()];
                pulp::Arch::new().dispatch(Differ { x, first, step, counted, sums: &mut *part });
                energy += dot(part, part);
            }
            energy
        });
        (differences, energies.into_iter().sum())
    }

    /// Gᵀ of differences, which are 0 where they do not count.
    fn adjoint(&self, [down, along]: &[Vec<f64>; 2], sums: &mut [f64], workers: &Workers) {
        let cols = self.shape.cols;
        workers.map_blocks(sums, BAND * cols, |band, part| {
            part.fill(0.0);
            for (values, step) in [(down, cols), (along, 1)] {
                for (i, factor) in FOURTH.iter().enumerate() {
                    // Values from so many cells further back; before the first there are none.
                    let first = band * BAND * cols;
                    let missing = (i * step).saturating_sub(first).min(part.len());
                    let values = &values[first + missing - i * step..];
                    let (factor, sums) = (*factor, &mut part[missing..]);
                    pulp::Arch::new().dispatch(Add { factor, values, sums });
                }
            }
        });
    }
}

/// Fourth differences of x from a cell on, where they count.
struct Differ<'s> {
    x: &'s [f64],
    first: usize,
    step: usize,
    counted: &'s [f64],
    sums: &'s mut [f64],
}

impl pulp::NullaryFnOnce for Differ<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        // Behind the last cell nothing counts.
        let reach = 4 * self.step;
        let whole = self.sums.len().min(self.x.len().saturating_sub(self.first + reach));
        let [a, b, c, d, e] =
            [0, 1, 2, 3, 4].map(|i| &self.x[(self.first + i * self.step).min(self.x.len())..]);
        let inputs = a.iter().zip(b).zip(c).zip(d).zip(e).zip(self.counted);
        for (sum, (((((a, b), c), d), e), counted)) in self.sums[..whole].iter_mut().zip(inputs) {
            *sum = counted * (a - 4.0 * b + 6.0 * c - 4.0 * d + e);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_multiple_of_the_beam_and_a_cubic_cost_nothing() {
        let shape = Shape::new(9, 11);
        let cells = || (0..9).flat_map(|r| (0..11).map(move |c| (f64::from(r), f64::from(c))));
        let beam: Vec<f64> =
            cells().map(|(r, c)| 2.0 + (r * 1.3).sin() + (c * 0.7).cos()).collect();
        let cubic: Vec<f64> = cells().map(|(r, c)| 1.0 + r * r * c - c * c * c).collect();
        let mut weights = vec![1.0; 99];
        weights[0] = 0.0;
        let workers = Workers::new(None).unwrap();
        let penalty = Penalty::new(shape, &beam, &weights, 1.0, &workers);
        let energy = |penalty: &Penalty, beam: &[f64], x: &[f64]| {
            let relative = penalty.relative(beam, x, &workers);
            penalty.add(beam, relative, 1.0, &mut vec![0.0; 99], &workers)
        };
        let twice: Vec<f64> = beam.iter().map(|a| 2.0 * a).collect();
        // Values to 1000, differences of sums of 16 of them.
        assert!(energy(&penalty, &beam, &twice) < 1e-25);
        assert!(energy(&penalty, &beam, &cubic) > 1.0);
        assert!(penalty.add(&beam, cubic, 1.0, &mut vec![0.0; 99], &workers) < 1e-15);
        // Row 5 of 9 is in four of five differences down, column 5 of 11 in all five along.
        assert!(penalty.diagonal()[60] == 69.0 + 70.0);
    }

    #[test]
    fn the_product_is_that_of_a_symmetric_matrix() {
        let shape = Shape::new(8, 7);
        let random = |seed: f64| (0..56).map(|i| (f64::from(i) * seed).sin() + 1.5).collect();
        let (beam, x, y): (Vec<f64>, Vec<f64>, Vec<f64>) = (random(1.7), random(2.9), random(4.1));
        let workers = Workers::new(None).unwrap();
        let penalty = Penalty::new(shape, &beam, &[1.0; 56], 0.7, &workers);
        let product = |x: &[f64]| {
            let mut sums = vec![0.0; 56];
            let relative = penalty.relative(&beam, x, &workers);
            let energy = penalty.add(&beam, relative, 1.0, &mut sums, &workers);
            (sums, energy)
        };
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let ((ax, energy), (ay, _)) = (product(&x), product(&y));
        // Sums of some 56 · 20 products of size 100.
        assert!((dot(&ax, &y) - dot(&ay, &x)).abs() < 1e-10);
        assert!((dot(&ax, &x) - energy).abs() < 1e-10);
    }
}

//! The penalty on the beam's fourth differences, τ ‖G a‖², along rows and columns.
//!
//! It determines what the measurements do not: a spline's finest pattern, and its cells behind the edge.
//! Differences count where all five cells are seen. Since the beam has no scale of its own, the
//! penalty acts on what differs from the beam's multiples, in the metric of its weights D: P x = x − a (s·x) with
//! s = D a/(aᵀD a); otherwise it would pull the beam to 0 and M up.

use crate::control::Control;
use crate::frames::Shape;
use crate::parallel::{Value, Workers, dot};

/// The weight τ of the penalty, as a share of the mean weight of a cell.
pub const SMOOTHING: f64 = 1e-5;
const FOURTH: [f64; 5] = [1.0, -4.0, 6.0, -4.0, 1.0];
/// Rows that a thread takes at a time.
const BAND: usize = 32;

/// The symbol of GᵀG along one axis.
pub(super) fn bent(q: f64) -> f64 {
    (2.0 * (q / 2.0).sin()).powi(8)
}

pub(crate) struct Penalty {
    shape: Shape,
    pub(crate) tau: f64,
    /// 1 where the five cells from here on count, down a column and along a row; else 0.
    counted: [Vec<u8>; 2],
    /// An ordinary light l₀, GᵀG a/l₀ and ‖G a/l₀‖².
    light: f64,
    pub(super) bent: Vec<f32>,
    energy: f64,
}

impl Penalty {
    /// The penalty of weight τ on beams of an ordinary light, seen where the weights D are above 0.
    pub(crate) fn new(
        shape: Shape,
        weights: &[f32],
        [tau, light]: [f64; 2],
        workers: &Workers,
        control: &Control,
    ) -> Self {
        let Shape { rows, cols } = shape;
        let count = |width: usize, height: usize, step: usize| {
            let mut counted = workers.filled(shape.len(), 0, control);
            workers.map_blocks(&mut counted, cols, |row, counted| {
                if row >= height || width == 0 {
                    return;
                }
                let weights = std::array::from_fn(|i| &weights[row * cols + i * step..][..width]);
                pulp::Arch::new().dispatch(Count { weights, counted: &mut counted[..width] });
            });
            counted
        };
        let counted =
            [count(cols, rows.saturating_sub(4), cols), count(cols.saturating_sub(4), rows, 1)];
        let bent = workers.filled(shape.len(), 0.0, control);
        Self { shape, tau, counted, light, bent, energy: 0.0 }
    }

    /// Counts also where another penalty does; returns whether it now counts where the other one does not.
    pub(crate) fn count_where(&mut self, other: &Self) -> bool {
        let mut grows = false;
        for (own, other) in self.counted.iter_mut().zip(&other.counted) {
            for (own, other) in own.iter_mut().zip(other) {
                grows |= *own > *other;
                *own = (*own).max(*other);
            }
        }
        grows
    }

    /// Whether it has a part in a cell.
    pub(super) fn concerns(&self, cell: usize) -> bool {
        let mut found = false;
        self.for_row(cell, |_, _| found = true);
        found
    }

    /// Takes the beam a that its multiples are free of, with D/w₀ and aᵀD a/w₀, and τ Pᵀ GᵀG a from a slope; returns
    /// τ ‖G a‖².
    pub(crate) fn turn_to(
        &mut self,
        beam: &[f64],
        (weights, norm): (&[f32], f64),
        slope: &mut [f64],
        workers: &Workers,
    ) -> f64 {
        let mut bent = std::mem::take(&mut self.bent);
        let size = BAND * self.shape.cols;
        let energies = workers.map_pairs(&mut bent, slope, [size; 2], |band, bent, slope| {
            let mut sums = vec![0.0; bent.len()];
            self.bend_rows(beam, 1.0, band * BAND, &mut sums);
            for ((bent, slope), sum) in bent.iter_mut().zip(slope).zip(&sums) {
                *bent = (sum / self.light) as f32;
                *slope -= self.tau * sum;
            }
            dot(&sums, &beam[band * size..][..sums.len()])
        });
        self.bent = bent;
        let energy: f64 = energies.into_iter().sum();
        self.energy = energy / self.light.powi(2);
        let share = self.tau * energy / norm;
        workers.map_blocks(slope, size, |band, slope| {
            let cells = weights[band * size..].iter().zip(&beam[band * size..]);
            slope
                .iter_mut()
                .zip(cells)
                .for_each(|(slope, (&d, a))| *slope += share * f64::from(d) * a);
        });
        self.tau * energy
    }

    /// Adds τ Pᵀ GᵀG P x to `sums`.
    pub(crate) fn add_product(
        &self,
        x: &[f64],
        scale: &[f32],
        sums: &mut [f64],
        workers: &Workers,
    ) {
        let multiples = self.multiples(x, scale, workers);
        self.add_curvature(x, self.tau, sums, workers);
        for (multiple, of) in multiples.into_iter().zip([&self.bent, scale]) {
            workers.add_multiple(sums, -multiple, of);
        }
    }

    /// The multiples of GᵀG a/l₀ and of s l₀ that P takes off τ GᵀG x.
    pub(super) fn multiples<N: Value>(
        &self,
        x: &[N],
        scale: &[f32],
        workers: &Workers,
    ) -> [f64; 2] {
        let (multiple, bent) = (workers.dot(scale, x), workers.dot(&self.bent, x));
        [multiple, bent - multiple * self.energy].map(|multiple| multiple * self.tau)
    }

    /// Adds √τ Pᵀ Gᵀ s, whose covariance is that of the penalty, for signs s.
    pub(crate) fn add_draw(
        &self,
        beam: &[f64],
        scale: &[f32],
        mut sign: impl FnMut() -> f64,
        sums: &mut [f64],
        workers: &Workers,
    ) {
        let mut drawn = vec![0.0; beam.len()];
        for (counted, step) in self.counted.iter().zip([self.shape.cols, 1]) {
            for first in (0..counted.len()).filter(|&first| counted[first] > 0) {
                let sign = sign();
                for (i, factor) in FOURTH.iter().enumerate() {
                    drawn[first + i * step] += sign * factor;
                }
            }
        }
        let multiple = workers.dot(beam, &drawn) / self.light;
        workers.add_multiple(&mut drawn, -multiple, scale);
        workers.add_multiple(sums, self.tau.sqrt(), &drawn);
    }

    /// Calls `visit(other, value)` for the elements of τ GᵀG in the row of a cell; the values of one
    /// place add up.
    pub(crate) fn for_row(&self, cell: usize, mut visit: impl FnMut(usize, f64)) {
        for (counted, step) in self.counted.iter().zip([self.shape.cols, 1]) {
            for (i, own) in FOURTH.iter().enumerate() {
                let Some(first) = cell.checked_sub(i * step) else { continue };
                if counted[first] > 0 {
                    for (j, other) in FOURTH.iter().enumerate() {
                        visit(first + j * step, self.tau * own * other);
                    }
                }
            }
        }
    }

    /// Adds `factor` GᵀG x to `sums`.
    fn add_curvature(&self, x: &[f64], factor: f64, sums: &mut [f64], workers: &Workers) {
        workers.map_blocks(sums, BAND * self.shape.cols, |band, part| {
            self.bend_rows(x, factor, band * BAND, part);
        });
    }

    /// Adds `factor` GᵀG x to rows of sums from `first` on.
    pub(super) fn bend_rows<N: Value>(&self, x: &[N], factor: N, first: usize, sums: &mut [N]) {
        let Shape { rows, cols } = self.shape;
        let [down, along] = &self.counted;
        // Differences that begin in this row and the four before; along it with zeros around.
        let mut differences = [(); 5].map(|()| vec![N::default(); cols]);
        let mut beside = vec![N::default(); cols + 4];
        for row in first.saturating_sub(4)..first + sums.len() / cols {
            differences.rotate_left(1);
            let line = |i: usize| &x[(row + i) * cols..][..cols];
            let found = &mut differences[4][..];
            if row + 4 < rows {
                let (values, counted) = (std::array::from_fn(line), &down[row * cols..]);
                pulp::Arch::new().dispatch(Differ { values, counted, sums: found });
            } else {
                found.fill(N::default());
            }
            let Some(own) = row.checked_sub(first) else { continue };
            let part = &mut sums[own * cols..][..cols];
            let values = [4, 3, 2, 1, 0].map(|i| &differences[i][..]);
            pulp::Arch::new().dispatch(Bend { values, factor, sums: &mut *part });
            if cols > 4 {
                let (line, counted) = (line(0), &along[row * cols..]);
                let (values, sums) =
                    (std::array::from_fn(|i| &line[i..cols - 4 + i]), &mut beside[4..cols]);
                pulp::Arch::new().dispatch(Differ { values, counted, sums });
                let values = [4, 3, 2, 1, 0].map(|i| &beside[i..cols + i]);
                pulp::Arch::new().dispatch(Bend { values, factor, sums: part });
            }
        }
    }
}

/// Whether all five weights are above 0.
struct Count<'s> {
    weights: [&'s [f32]; 5],
    counted: &'s mut [u8],
}

impl pulp::NullaryFnOnce for Count<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [a, b, c, d, e] = self.weights;
        let weights = a.iter().zip(b).zip(c).zip(d).zip(e);
        for (counted, ((((a, b), c), d), e)) in self.counted.iter_mut().zip(weights) {
            let least = a.min(b.min(*c)).min(d.min(*e));
            *counted = u8::from(least > 0.0);
        }
    }
}

/// Fourth differences, where they count.
struct Differ<'s, N> {
    values: [&'s [N]; 5],
    counted: &'s [u8],
    sums: &'s mut [N],
}

impl<N: Value> pulp::NullaryFnOnce for Differ<'_, N> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [a, b, c, d, e] = self.values;
        let inputs = a.iter().zip(b).zip(c).zip(d).zip(e).zip(self.counted);
        for (sum, (((((a, b), c), d), e), counted)) in self.sums.iter_mut().zip(inputs) {
            let [four, six] = [4.0, 6.0].map(N::of);
            *sum = N::of(f64::from(*counted)) * (*a - four * *b + six * *c - four * *d + *e);
        }
    }
}

/// Adds a multiple of fourth differences.
struct Bend<'s, N> {
    values: [&'s [N]; 5],
    factor: N,
    sums: &'s mut [N],
}

impl<N: Value> pulp::NullaryFnOnce for Bend<'_, N> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [a, b, c, d, e] = self.values;
        let inputs = a.iter().zip(b).zip(c).zip(d).zip(e);
        for (sum, ((((a, b), c), d), e)) in self.sums.iter_mut().zip(inputs) {
            let [four, six] = [4.0, 6.0].map(N::of);
            *sum += self.factor * (*a - four * *b + six * *c - four * *d + *e);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An ordinary light.
    const LIGHT: f64 = 3.0;

    /// aᵀD a and D a l₀/(aᵀD a).
    fn scale(beam: &[f64], weights: &[f32]) -> (f64, Vec<f32>) {
        let pairs = || weights.iter().map(|&d| f64::from(d)).zip(beam);
        let norm: f64 = pairs().map(|(d, a)| d * a * a).sum();
        (norm, pairs().map(|(d, a)| (d * a * LIGHT / norm) as f32).collect())
    }

    #[test]
    fn cells_out_of_sight_stay_in_it() {
        let (shape, workers) = (Shape::new(9, 11), Workers::new(None).unwrap());
        let seen = |rows: usize| -> Vec<f32> {
            (0..99).map(|cell| f32::from(u8::from(cell / 11 < rows))).collect()
        };
        let of = |rows| Penalty::new(shape, &seen(rows), [1.0; 2], &workers, &Control::default());
        let (eight, nine) = (of(8), of(9));
        let (first_of_row_9, mut less, mut more) = (8 * 11, of(8), of(9));
        assert!(!eight.concerns(first_of_row_9) && nine.concerns(first_of_row_9));
        assert!(!less.count_where(&nine) && less.counted == nine.counted);
        assert!(more.count_where(&eight) && more.counted == nine.counted);
    }

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
        let mut penalty =
            Penalty::new(shape, &weights, [1.0, LIGHT], &workers, &Control::default());
        let (norm, scale) = scale(&beam, &weights);
        penalty.turn_to(&beam, (&weights, norm), &mut [0.0; 99], &workers);
        let product = |x: &[f64]| {
            let mut sums = vec![0.0; 99];
            penalty.add_product(x, &scale, &mut sums, &workers);
            sums
        };
        let energy = |x: &[f64]| product(x).iter().zip(x).map(|(s, x)| s * x).sum::<f64>();
        let twice: Vec<f64> = beam.iter().map(|a| 2.0 * a).collect();
        // s and GᵀG a are kept in single precision, and the energy of the beam is some thousands.
        assert!(energy(&twice).abs() < 1e-3 && energy(&beam[..]).abs() < 1e-3);
        assert!(energy(&cubic) > 1.0);
        // Values to 1000, differences of sums of 16 of them.
        let mut bent = vec![0.0; 99];
        penalty.add_curvature(&cubic, 1.0, &mut bent, &workers);
        assert!(bent.iter().all(|value| value.abs() < 1e-9));
        // Row 5 of 9 is in four of five differences down, column 5 of 11 in all five along.
        let mut diagonal = 0.0;
        penalty.for_row(60, |other, value| diagonal += if other == 60 { value } else { 0.0 });
        assert!(diagonal == 69.0 + 70.0);
    }

    #[test]
    fn the_product_is_that_of_a_symmetric_matrix() {
        let shape = Shape::new(8, 7);
        let random = |seed: f64| (0..56).map(|i| (f64::from(i) * seed).sin() + 1.5).collect();
        let (beam, x, y): (Vec<f64>, Vec<f64>, Vec<f64>) = (random(1.7), random(2.9), random(4.1));
        let workers = Workers::new(None).unwrap();
        let known = [0.7, LIGHT];
        let mut penalty = Penalty::new(shape, &[1.0; 56], known, &workers, &Control::default());
        let (norm, scale) = scale(&beam, &[1.0; 56]);
        penalty.turn_to(&beam, (&[1.0; 56], norm), &mut [0.0; 56], &workers);
        let product = |x: &[f64]| {
            let mut sums = vec![0.0; 56];
            penalty.add_product(x, &scale, &mut sums, &workers);
            sums
        };
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let (ax, ay) = (product(&x), product(&y));
        let mut relative = x.clone();
        let multiple = super::dot(&scale, &x) / LIGHT;
        relative.iter_mut().zip(&beam).for_each(|(x, a)| *x -= multiple * a);
        let mut bent = vec![0.0; 56];
        penalty.add_curvature(&relative, 0.7, &mut bent, &workers);
        let energy = dot(&bent, &relative);
        // Sums of some 56 · 20 products of size 100; s and GᵀG a in single precision are of one matrix.
        assert!((dot(&ax, &y) - dot(&ay, &x)).abs() < 1e-10);
        assert!((dot(&ax, &x) - energy).abs() < SINGLE * energy);
    }

    /// A penalty on a beam of which one cell is not seen, beside the rows of G and the matrix P.
    struct Dense {
        penalty: Penalty,
        beam: Vec<f64>,
        scale: Vec<f32>,
        /// What it takes from a slope, and its share of F.
        slope: Vec<f64>,
        objective: f64,
        differences: Vec<Vec<f64>>,
        relative: Vec<Vec<f64>>,
        workers: Workers,
    }

    impl Dense {
        const SHAPE: Shape = Shape::new(6, 7);
        const TAU: f64 = 0.7;

        fn new() -> Self {
            let Shape { rows, cols } = Self::SHAPE;
            let random = |seed: f64| (0..42).map(move |i| (f64::from(i) * seed).sin() + 1.5);
            let beam: Vec<f64> = random(1.7).collect();
            let mut weights: Vec<f32> = random(2.9).map(|d| d as f32).collect();
            weights[3 * cols + 5] = 0.0;
            let line = |first: usize, step: usize| {
                let cells = [0, 1, 2, 3, 4].map(|i| first + i * step);
                let mut row = vec![0.0; 42];
                cells.iter().zip([1.0, -4.0, 6.0, -4.0, 1.0]).for_each(|(&cell, g)| row[cell] = g);
                cells.iter().all(|&cell| weights[cell] > 0.0).then_some(row)
            };
            let down = (0..(rows - 4) * cols).filter_map(|first| line(first, cols));
            let starts = (0..42).filter(|cell| cell % cols + 4 < cols);
            let differences = down.chain(starts.filter_map(|first| line(first, 1))).collect();
            let (norm, scale) = scale(&beam, &weights);
            let element = |row: usize, col: usize| {
                f64::from(row == col) - beam[row] * f64::from(scale[col]) / LIGHT
            };
            let relative =
                (0..42).map(|row| (0..42).map(|col| element(row, col)).collect()).collect();
            let workers = Workers::new(None).unwrap();
            let control = Control::default();
            let known = [Self::TAU, LIGHT];
            let mut penalty = Penalty::new(Self::SHAPE, &weights, known, &workers, &control);
            let mut slope = vec![0.0; 42];
            let objective = penalty.turn_to(&beam, (&weights, norm), &mut slope, &workers);
            Self { penalty, beam, scale, slope, objective, differences, relative, workers }
        }

        /// G P, whose square times τ is the matrix of the penalty.
        fn rows(&self) -> Vec<Vec<f64>> {
            let of = |line: &Vec<f64>| {
                let column = |col: usize| {
                    line.iter().zip(&self.relative).map(|(g, row)| g * row[col]).sum::<f64>()
                };
                (0..42).map(column).collect()
            };
            self.differences.iter().map(of).collect()
        }

        /// What single precision leaves of the largest element of τ GᵀG a.
        fn kept(&self) -> f64 {
            let largest = self.penalty.bent.iter().fold(0.0_f32, |most, bent| most.max(bent.abs()));
            Self::TAU * LIGHT * f64::from(largest * f32::EPSILON)
        }
    }

    /// Sums of some thousand products of size 100.
    const ROUNDING: f64 = 1e-9;
    /// GᵀG a in single precision, in sums of some ten products.
    const SINGLE: f64 = 1e-6;

    fn square(rows: &[Vec<f64>], i: usize, j: usize) -> f64 {
        Dense::TAU * rows.iter().map(|row| row[i] * row[j]).sum::<f64>()
    }

    #[test]
    fn product_and_slope_are_those_of_the_dense_matrix() {
        let dense = Dense::new();
        let (rows, beam) = (dense.rows(), &dense.beam);
        for cell in 0..42 {
            let (mut unit, mut product) = (vec![0.0; 42], vec![0.0; 42]);
            unit[cell] = 1.0;
            dense.penalty.add_product(&unit, &dense.scale, &mut product, &dense.workers);
            for (other, value) in product.iter().enumerate() {
                assert!((value - square(&rows, cell, other)).abs() < dense.kept());
            }
        }
        let bent: Vec<f64> = dense
            .differences
            .iter()
            .map(|line| line.iter().zip(beam).map(|(g, a)| g * a).sum())
            .collect();
        let energy: f64 = bent.iter().map(|difference| difference * difference).sum();
        assert!((dense.objective - Dense::TAU * energy).abs() < ROUNDING);
        for (cell, slope) in dense.slope.iter().enumerate() {
            let wanted: f64 = rows.iter().zip(&bent).map(|(row, g)| row[cell] * g).sum();
            // s of the dense matrix is in single precision.
            assert!((slope + Dense::TAU * wanted).abs() < dense.kept());
        }
    }

    #[test]
    fn draws_have_the_covariance_of_the_dense_matrix() {
        let dense = Dense::new();
        let rows = dense.rows();
        // Each sign alone: draws of independent signs have the sum of these squares as covariance.
        let draws: Vec<Vec<f64>> = (0..rows.len())
            .map(|drawn| {
                let (mut number, mut sums) = (0..rows.len(), vec![0.0; 42]);
                let sign = || if number.next() == Some(drawn) { 1.0 } else { 0.0 };
                dense.penalty.add_draw(&dense.beam, &dense.scale, sign, &mut sums, &dense.workers);
                sums
            })
            .collect();
        for cell in 0..42 {
            let mut elements = vec![0.0; 42];
            dense.penalty.for_row(cell, |other, value| elements[other] += value);
            for other in 0..42 {
                let covariance: f64 = draws.iter().map(|draw| draw[cell] * draw[other]).sum();
                assert!((covariance - square(&rows, cell, other)).abs() < ROUNDING);
                let element = square(&dense.differences, cell, other);
                assert!((elements[other] - element).abs() < ROUNDING);
            }
        }
    }
}

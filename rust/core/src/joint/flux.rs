//! Which fluxes are unknown: ln c = ln c₀ + T θ, with a prior on θ or none.
//!
//! Two tilts of ln M are degenerate with fluxes: with M → M·exp(α·p), L → L·exp(−α·u) and
//! ln c_k → ln c_k + α·d_k nothing that is measured changes, unless exposures are turned against each
//! other. So free fluxes are sought where ln c has no part that is affine in the shifts, and what
//! remains undetermined is left to the gauge. With a prior of weights π the same is done with
//! Σ π a b in place of Σ a b: then the best of the parts that no measurement determines is the given one.
//!
//! At whole shifts free fluxes are sought with the weights of their exposures as π. Else a flux that a light exposure barely
//! determines would change those of heavy ones, which only a tilt of M makes up for: a step along a curve.

use super::layout::Grid;
use crate::exposures::{Exposures, FluxKind};
use crate::frames::Real;
use crate::geometry::Rotation;
use crate::linalg::inverse;

/// ln c = ln c₀ + T θ.
pub(crate) struct Fluxes {
    /// c₀.
    pub(super) values: Vec<f64>,
    /// The columns of T.
    pub(crate) columns: Vec<Vec<f64>>,
    /// T is orthonormal by Σ w a b of these.
    weights: Vec<f64>,
    /// The weight of θ² in F, for each column, where the noise is known.
    pub(crate) precisions: Vec<f64>,
    /// The slope of ln L, a cell, that stands for what a drift linear in time has affine in the shifts,
    /// for θ = 1.
    pub(crate) slope: [f64; 2],
    /// The covariance of the slope along the shifts, a cell, of the part of ln c that hides in a tilt,
    /// by the prior of each.
    pub(crate) hidden_slope: [[f64; 2]; 2],
    /// The directions in the beam, of length 1 and across each other, along which a tilt is left
    /// undetermined.
    pub(crate) open: Vec<[f64; 2]>,
}

/// What rounding leaves of a vector of length 1.
const NOTHING: f64 = 1e-9;
/// The least weight of an exposure, as a share of the largest: shifts far from 0 leave rounding too.
const LEAST: f64 = 1e-12;

impl Fluxes {
    /// Fluxes of these values at θ = 0, of exposures at these shifts on a grid.
    pub(crate) fn of<T: Real>(
        exposures: &Exposures<'_, T>,
        values: &[f64],
        shifts: &[[f64; 2]],
        grid: &Grid,
    ) -> Self {
        // A spline has a penalty, which a tilt of the beam changes: where the minimum lies must not depend on weights.
        let weights = if grid.is_spline() {
            vec![1.0; values.len()]
        } else {
            exposures.exposure_weights(values)
        };
        let rotations = &exposures.positions().rotations;
        Self::new(values, exposures.flux_kind(), shifts, rotations, &weights)
    }

    /// Fluxes of these values at θ = 0, of exposures of these weights.
    pub(crate) fn new(
        values: &[f64],
        flux: &FluxKind,
        shifts: &[[f64; 2]],
        rotations: &[Rotation],
        weights: &[f64],
    ) -> Self {
        let count = shifts.len();
        let turned = rotations.iter().any(|rotation| *rotation != rotations[0]);
        let unit = |k| (0..count).map(|i| if i == k { 1.0 } else { 0.0 }).collect::<Vec<_>>();
        let hidden = |turned: bool| {
            let mut hidden = vec![vec![1.0; count]];
            if !turned {
                hidden.extend([0, 1].map(|axis| shifts.iter().map(|d| d[axis]).collect()));
            }
            hidden
        };
        let (mut slope, mut hidden_slope) = ([0.0; 2], [[0.0; 2]; 2]);
        let weights: Vec<f64> = match flux {
            FluxKind::Prior(std) => std.iter().map(|std| 1.0 / (std * std)).collect(),
            FluxKind::Free => relative(weights),
            FluxKind::Known | FluxKind::Linear(_) => vec![1.0; count],
        };
        let mut by_weight: Vec<usize> = (0..count).collect();
        // What a light exposure adds is not to be the rounding of what heavy ones leave.
        by_weight.sort_by(|&a, &b| weights[a].total_cmp(&weights[b]));
        let (columns, precisions, open) = match flux {
            FluxKind::Known => (Vec::new(), Vec::new(), Vec::new()),
            FluxKind::Free => {
                let free = complement(&hidden(turned), by_weight.into_iter().map(unit), &weights);
                let open = if turned { Vec::new() } else { vec![[1.0, 0.0], [0.0, 1.0]] };
                (free, Vec::new(), open)
            }
            FluxKind::Linear(times) => {
                // What of the times is affine in the shifts is degenerate with a tilt: it follows from the
                // rest.
                let distinct =
                    complement(&hidden(turned), std::iter::once(times.clone()), &weights);
                if let (Some(distinct), false) = (distinct.first(), turned) {
                    slope = affine_part(times, distinct, shifts).map(|part| -part);
                }
                let open =
                    if distinct.is_empty() { vec![growth(times, shifts)] } else { Vec::new() };
                (distinct, Vec::new(), open)
            }
            FluxKind::Prior(_) => {
                let free = complement(&hidden(turned), by_weight.into_iter().map(unit), &weights);
                let precisions = vec![1.0; free.len()];
                if !turned {
                    hidden_slope = slope_covariance(&weights, shifts);
                }
                (free, precisions, Vec::new())
            }
        };
        let precisions = if precisions.is_empty() { vec![0.0; columns.len()] } else { precisions };
        Self { values: values.to_vec(), columns, weights, precisions, slope, hidden_slope, open }
    }

    /// c at θ.
    pub(crate) fn at(&self, theta: &[f64]) -> Vec<f64> {
        let logs = self.spread(theta);
        self.values.iter().zip(&logs).map(|(c, log)| c * log.exp()).collect()
    }

    /// θ, and a + γ·d, the part of ln c affine in the shifts that is not in T θ: that of fluxes which
    /// were brought into a gauge.
    pub(crate) fn split(&self, flux: &[f64], shifts: &[[f64; 2]]) -> (Vec<f64>, f64, [f64; 2]) {
        let logs: Vec<f64> = flux.iter().zip(&self.values).map(|(c, c0)| (c / c0).ln()).collect();
        let theta = self.sought(&logs);
        let rest: Vec<f64> =
            logs.iter().zip(self.spread(&theta)).map(|(log, sought)| log - sought).collect();
        let mean = |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / logs.len() as f64;
        let level = mean(&mut rest.iter().copied());
        let centre = [0, 1].map(|axis| mean(&mut shifts.iter().map(|d| d[axis])));
        let along = [0, 1].map(|axis| {
            rest.iter().zip(shifts).map(|(rest, d)| rest * (d[axis] - centre[axis])).sum::<f64>()
        });
        let slope = slope_covariance(&vec![1.0; shifts.len()], shifts)
            .map(|row| row[0] * along[0] + row[1] * along[1]);
        (theta, level - slope[0] * centre[0] - slope[1] * centre[1], slope)
    }

    /// T θ.
    pub(crate) fn spread(&self, theta: &[f64]) -> Vec<f64> {
        let mut logs = vec![0.0; self.values.len()];
        for (column, value) in self.columns.iter().zip(theta) {
            logs.iter_mut().zip(column).for_each(|(log, t)| *log += t * value);
        }
        logs
    }

    /// The θ whose T θ is nearest to logs, by the weights that T is orthonormal by.
    pub(crate) fn sought(&self, logs: &[f64]) -> Vec<f64> {
        let weighted: Vec<f64> = logs.iter().zip(&self.weights).map(|(log, w)| w * log).collect();
        self.gather(&weighted)
    }

    /// Tᵀ b.
    pub(crate) fn gather(&self, slopes: &[f64]) -> Vec<f64> {
        let dot = |column: &Vec<f64>| column.iter().zip(slopes).map(|(t, b)| t * b).sum();
        self.columns.iter().map(dot).collect()
    }
}

/// Weights in units of the largest; their roots are above what is taken for nothing.
fn relative(weights: &[f64]) -> Vec<f64> {
    let largest = weights.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
    weights.iter().map(|weight| (weight / largest).max(LEAST)).collect()
}

/// The covariance of γ in ln c = a + γ·d, of the weights of each ln c: (Σ π (d − d̄)(d − d̄)ᵀ)⁻¹.
fn slope_covariance(weights: &[f64], shifts: &[[f64; 2]]) -> [[f64; 2]; 2] {
    let sum = |value: &dyn Fn(&[f64; 2]) -> f64| -> f64 {
        weights.iter().zip(shifts).map(|(weight, d)| weight * value(d)).sum()
    };
    let total = sum(&|_| 1.0);
    let [row, col] = [sum(&|d| d[0]) / total, sum(&|d| d[1]) / total];
    inverse([
        sum(&|d| (d[0] - row).powi(2)),
        sum(&|d| (d[0] - row) * (d[1] - col)),
        sum(&|d| (d[1] - col).powi(2)),
    ])
}

/// The direction in which times grow that are affine in the shifts.
fn growth(times: &[f64], shifts: &[[f64; 2]]) -> [f64; 2] {
    let even = vec![1.0; times.len()];
    let mean = |axis: usize| shifts.iter().map(|d| d[axis]).sum::<f64>() / times.len() as f64;
    let along = [0, 1].map(|axis| {
        let mean = mean(axis);
        shifts.iter().zip(times).map(|(d, t)| (d[axis] - mean) * t).sum::<f64>()
    });
    let slope = slope_covariance(&even, shifts).map(|row| row[0] * along[0] + row[1] * along[1]);
    let length = slope[0].hypot(slope[1]);
    slope.map(|part| part / length)
}

/// γ of t/|t·distinct| = distinct + c + γ·d, for d along which the times change at all.
fn affine_part(times: &[f64], distinct: &[f64], shifts: &[[f64; 2]]) -> [f64; 2] {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let scale = dot(times, distinct);
    let basis = [0, 1].map(|axis| shifts.iter().map(|d| d[axis]).collect::<Vec<f64>>());
    let constant = vec![1.0; times.len()];
    // Against the constant, then the second axis against the first too.
    let rows =
        complement(std::slice::from_ref(&constant), std::iter::once(basis[0].clone()), &constant);
    let hidden: Vec<_> = std::iter::once(constant.clone()).chain(rows.iter().cloned()).collect();
    let cols = complement(&hidden, std::iter::once(basis[1].clone()), &constant);
    let along = |column: &[f64], axis: usize| dot(column, &basis[axis]);
    let col = cols.first().map_or(0.0, |c| dot(c, times) / scale / along(c, 1));
    let row =
        rows.first().map_or(0.0, |r| (dot(r, times) / scale - col * along(r, 1)) / along(r, 0));
    [row, col]
}

/// An orthonormal basis, by Σ w a b, of what `vectors` add to the span of `hidden` (Gram and Schmidt,
/// twice).
fn complement(
    hidden: &[Vec<f64>],
    vectors: impl Iterator<Item = Vec<f64>>,
    weights: &[f64],
) -> Vec<Vec<f64>> {
    let dot = |a: &[f64], b: &[f64]| -> f64 {
        a.iter().zip(b).zip(weights).map(|((a, b), w)| w * a * b).sum()
    };
    let norm = |vector: &[f64]| dot(vector, vector).sqrt();
    let mut basis: Vec<Vec<f64>> = Vec::new();
    let mut found = Vec::new();
    let tagged = hidden.iter().cloned().map(|v| (v, true)).chain(vectors.map(|v| (v, false)));
    for (mut vector, is_hidden) in tagged {
        let before = norm(&vector);
        for other in basis.iter().chain(&basis) {
            let share = dot(&vector, other);
            vector.iter_mut().zip(other).for_each(|(a, b)| *a -= share * b);
        }
        let size = norm(&vector);
        if size > NOTHING * before {
            vector.iter_mut().for_each(|value| *value /= size);
            if !is_hidden {
                found.push(vector.clone());
            }
            basis.push(vector);
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    const CROSS: [[f64; 2]; 5] = [[0.0, 0.0], [0.0, 11.0], [0.0, 19.0], [11.0, 0.0], [19.0, 0.0]];

    #[test]
    fn free_fluxes_have_no_part_that_looks_like_a_tilt() {
        let fluxes =
            Fluxes::new(&[1.0; 5], &FluxKind::Free, &CROSS, &[Rotation::None; 5], &[1.0; 5]);
        assert_eq!(fluxes.open, [[1.0, 0.0], [0.0, 1.0]]);
        assert_eq!(fluxes.columns.len(), 2);
        for column in &fluxes.columns {
            for weight in [|_: &[f64; 2]| 1.0, |d: &[f64; 2]| d[0], |d: &[f64; 2]| d[1]] {
                let dot: f64 = column.iter().zip(&CROSS).map(|(t, d)| t * weight(d)).sum();
                assert!(dot.abs() < 1e-13);
            }
        }
    }

    #[test]
    fn a_turned_exposure_determines_all_but_the_mean() {
        let mut rotations = [Rotation::None; 5];
        rotations[4] = Rotation::Half;
        let fluxes = Fluxes::new(&[1.0; 5], &FluxKind::Free, &CROSS, &rotations, &[1.0; 5]);
        assert!(fluxes.open.is_empty());
        assert_eq!(fluxes.columns.len(), 4);
    }

    #[test]
    fn free_fluxes_of_light_exposures_do_not_move_heavy_ones() {
        // Three heavy exposures off one line: what is affine in the shifts matches any of their fluxes.
        let weights = [1.0, 1e-6, 1.0, 1e-8, 1.0];
        let fluxes =
            Fluxes::new(&[1.0; 5], &FluxKind::Free, &CROSS, &[Rotation::None; 5], &weights);
        assert_eq!(fluxes.columns.len(), 2);
        for column in &fluxes.columns {
            let size = |k: usize| weights[k].sqrt() * column[k].abs();
            // Affine functions at 0 and 19 are no larger where the light ones are, between them.
            assert!([0, 2, 4].iter().all(|&heavy| size(heavy) <= 1e-3 * (size(1) + size(3))));
            let affine = |k: usize| 2.0 + 0.3 * CROSS[k][0] - 0.2 * CROSS[k][1];
            let terms = (0..5).map(|k| weights[k] * column[k] * affine(k));
            let size: f64 = terms.clone().map(f64::abs).sum();
            // T to rounding of its largest elements, some thousand times those of heavy exposures.
            assert!(terms.sum::<f64>().abs() < 1e4 * f64::EPSILON * size);
        }
    }

    #[test]
    fn a_drift_that_is_linear_along_the_shifts_is_not_determined() {
        let line = [[0.0, 0.0], [0.0, 3.0], [0.0, 6.0], [0.0, 9.0]];
        let times = |scale: f64| FluxKind::Linear((0..4).map(|k| scale * f64::from(k)).collect());
        let fluxes = Fluxes::new(&[1.0; 4], &times(60.0), &line, &[Rotation::None; 4], &[1.0; 4]);
        assert!(fluxes.open == [[0.0, 1.0]] && fluxes.columns.is_empty());
        let fluxes = Fluxes::new(
            &[1.0; 4],
            &FluxKind::Linear(vec![0.0, 3.0, 1.0, 2.0]),
            &line,
            &[Rotation::None; 4],
            &[1.0; 4],
        );
        assert!(fluxes.open.is_empty() && fluxes.columns.len() == 1);
    }

    #[test]
    fn a_linear_drift_is_its_distinct_and_its_affine_part() {
        let times = [3.0, 10.0, 21.0, 30.0, 47.0];
        let flux = FluxKind::Linear(times.to_vec());
        let fluxes = Fluxes::new(&[1.0; 5], &flux, &CROSS, &[Rotation::None; 5], &[1.0; 5]);
        let distinct = &fluxes.columns[0];
        let [row, col] = fluxes.slope;
        let whole: Vec<f64> =
            distinct.iter().zip(&CROSS).map(|(t, d)| t - row * d[0] - col * d[1]).collect();
        // Linear in time: the same slope between all pairs, to rounding of sums of some ten terms.
        let slope = (whole[1] - whole[0]) / (times[1] - times[0]);
        for k in 2..5 {
            let other = (whole[k] - whole[0]) / (times[k] - times[0]);
            assert!((other / slope - 1.0).abs() < 1e-12);
        }
    }
}

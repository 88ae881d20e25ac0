//! The covariance of what was found: the inverse of the normal matrix, in the gauge of the result.

use super::Dense;
use super::gauge::Gauge;
use super::lamp::{Columns, hidden_tilts};
use super::linear::{Symmetric, dot};
use super::normal::Factorised;
use crate::common::{Answer, Experiment};

/// The covariance at an answer.
pub(crate) struct Covariance {
    pub(crate) pixels: usize,
    /// Of M, row by row.
    pub(crate) of_gain: Vec<f64>,
    /// The part of it that a map of errors samples.
    pub(crate) drawn: Vec<f64>,
    /// The part of that which is known nevertheless, since M follows the dark at once.
    pub(crate) followed: Vec<f64>,
    /// What the noise of the dark adds to F: the mean of eᵀ A e, and its variance where the elements of e
    /// are as large as their standard deviation and only their signs are random.
    pub(crate) misfit: [f64; 2],
    /// The variances of the shifts (row, column) that were refined, less their mean.
    pub(crate) of_shifts: Vec<[f64; 2]>,
    /// The variance of b, the least-squares part b M of the offsets' errors.
    pub(crate) along: f64,
    /// The mean variance of an offset by the noise of its own pixel.
    pub(crate) alone: f64,
}

impl Covariance {
    /// At an answer of `experiment`, for a measurement of weight 1 of this variance; `None` where the
    /// measurements do not determine it.
    pub(crate) fn of(experiment: &Experiment, answer: &Answer, unit: f64) -> Option<Self> {
        let mut at_answer = experiment.clone();
        at_answer.flux.clone_from(&answer.flux);
        at_answer.shifts.clone_from(&answer.shifts);
        let columns = Columns::whole(&at_answer);
        let mut dense = Dense::new(&at_answer, columns, answer.refined);
        dense.unit = unit;
        dense.prior.clone_from(&answer.prior);
        let coefficients = answer.coefficients.as_ref().unwrap_or(&answer.beam);
        let x = dense.unknowns(answer, coefficients);
        let normal = dense.normal(&x);
        let factor = dense.factorised(&normal, &x)?;
        let pixels = dense.pixels();
        let gauge = Gauge::new(&at_answer, &x[..pixels]).without(&answer.flags);
        let whole = columns_of(&factor, pixels);
        let alone = alone(&dense, &normal.matrix, answer.is_joint());
        let mut of_gain = gauge.on_both_sides(&whole);
        let left: Vec<f64> = whole.iter().zip(&alone).map(|(a, b)| a - b).collect();
        let mut drawn = gauge.on_both_sides(&left);
        if let Some(tilts) = of_tilts(&at_answer, &gauge) {
            add(-1.0, &tilts, &mut drawn);
        }
        let considers = experiment.shift_std.is_some() && !answer.refined;
        if considers {
            let wrong = of_wrong_shifts(&at_answer, answer, &gauge, &factor)?;
            add(1.0, &wrong, &mut of_gain);
            add(1.0, &wrong, &mut drawn);
        }
        of_gain.iter_mut().chain(&mut drawn).for_each(|value| *value *= unit);
        let mut of_shifts = of_shifts(&dense, &factor);
        let dark = Dark::of(&dense, &factor, &x);
        let mut followed = vec![0.0; pixels * pixels];
        if let Some(dark) = &dark {
            let of_dark = dark.of_gain(&gauge);
            add(1.0, &of_dark, &mut of_gain);
            add(1.0, &of_dark, &mut drawn);
            followed = gauge.on_both_sides(&dark.followed(&normal.matrix));
            dark.add_to_shifts(&dense, &mut of_shifts);
        }
        Some(Self {
            pixels,
            of_gain,
            drawn,
            followed,
            misfit: dark.map_or([0.0; 2], |dark| dark.misfit()),
            of_shifts,
            along: along(&dense, &factor, &x),
            alone: mean_of_offsets_alone(&dense, &normal.matrix),
        })
    }

    /// The variance of Σ g M.
    pub(crate) fn variance(&self, functional: &[f64]) -> f64 {
        let rows = self.of_gain.chunks_exact(self.pixels).zip(functional);
        rows.map(|(row, g)| g * dot(row, functional)).sum()
    }

    pub(crate) fn std(&self, pixel: usize) -> f64 {
        self.of_gain[pixel * (self.pixels + 1)].sqrt()
    }
}

/// The noise of a dark that was subtracted from all exposures.
struct Dark<'e> {
    variance: &'e [f64],
    /// Jᵀ w 1 of each pixel, what it moves, and the sums of the weights.
    pulls: Vec<Vec<f64>>,
    moves: Vec<Vec<f64>>,
    weights: Vec<f64>,
}

impl<'e> Dark<'e> {
    fn of(dense: &Dense<'e>, factor: &Factorised, x: &[f64]) -> Option<Self> {
        let variance = &dense.experiment.dark[..];
        let (pulls, weights) = dense.pulls_in_common(x);
        let moves = pulls.iter().map(|pull| factor.solve(pull)).collect();
        (!variance.is_empty()).then_some(Self { variance, pulls, moves, weights })
    }

    /// What it adds to the covariance of M.
    fn of_gain(&self, gauge: &Gauge) -> Vec<f64> {
        let pixels = self.variance.len();
        let mut found = vec![0.0; pixels * pixels];
        for (moved, variance) in self.moves.iter().zip(self.variance) {
            let moved = gauge.apply(&moved[..pixels]);
            for (row, a) in found.chunks_exact_mut(pixels).zip(&moved) {
                row.iter_mut().zip(&moved).for_each(|(sum, b)| *sum += variance * a * b);
            }
        }
        found
    }

    /// The variances that M has by it at the beam that there is.
    fn followed(&self, normal: &Symmetric) -> Vec<f64> {
        let pixels = self.variance.len();
        let mut found = vec![0.0; pixels * pixels];
        for pixel in (0..pixels).filter(|&pixel| normal.at(pixel, pixel) > 0.0) {
            let a = self.pulls[pixel][pixel] / normal.at(pixel, pixel);
            found[pixel * (pixels + 1)] = self.variance[pixel] * a * a;
        }
        found
    }

    fn add_to_shifts(&self, dense: &Dense<'_>, of_shifts: &mut [[f64; 2]]) {
        for (index, found) in of_shifts.as_flattened_mut().iter_mut().enumerate() {
            let functional = dense.moves(index / 2, index % 2);
            for (moved, variance) in self.moves.iter().zip(self.variance) {
                let shift: f64 = functional.iter().map(|&(at, z)| z * moved[at]).sum();
                *found += variance * shift * shift;
            }
        }
    }

    /// With A = 1ᵀ w 1 − 1ᵀ w J N⁻¹ Jᵀ w 1.
    fn misfit(&self) -> [f64; 2] {
        let [mut mean, mut scatter] = [0.0; 2];
        for (p, (pull, v)) in self.pulls.iter().zip(self.variance).enumerate() {
            for (q, (moved, u)) in self.moves.iter().zip(self.variance).enumerate() {
                if p == q {
                    mean += v * (self.weights[p] - dot(pull, moved));
                } else {
                    scatter += 2.0 * v * u * dot(pull, moved).powi(2);
                }
            }
        }
        [mean, scatter]
    }
}

fn add(factor: f64, values: &[f64], sums: &mut [f64]) {
    sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += factor * value);
}

/// The first columns of the inverse, as far down.
fn columns_of(factor: &Factorised, count: usize) -> Vec<f64> {
    let column = |index: usize| {
        let mut unit = vec![0.0; factor.order];
        unit[index] = 1.0;
        factor.solve(&unit)[..count].to_vec()
    };
    (0..count).flat_map(column).collect()
}

/// What of the covariance of M is known without draws: that at the beam that there is, D⁻¹; without a joint
/// fit, that by the noise of the beam at the M that there is too, D⁻¹ B D_L⁻¹ Bᵀ D⁻¹.
fn alone(dense: &Dense<'_>, normal: &Symmetric, is_joint: bool) -> Vec<f64> {
    let pixels = dense.pixels();
    let own = |pixel: usize| inverse_of_pixel(dense, normal, pixel)[0];
    let mut known = vec![0.0; pixels * pixels];
    (0..pixels).for_each(|pixel| known[pixel * (pixels + 1)] = own(pixel));
    if !is_joint {
        for cell in dense.layout.cells..dense.layout.fluxes {
            let share: Vec<f64> = (0..pixels).map(|p| own(p) * normal.at(p, cell)).collect();
            for (row, a) in known.chunks_exact_mut(pixels).zip(&share).filter(|(_, a)| **a != 0.0) {
                let weight = a / normal.at(cell, cell);
                row.iter_mut().zip(&share).for_each(|(known, b)| *known += weight * b);
            }
        }
    }
    known
}

/// The elements of M and O of the inverse of a pixel's own normal matrix; 0 where nothing is measured.
fn inverse_of_pixel(dense: &Dense<'_>, normal: &Symmetric, pixel: usize) -> [f64; 2] {
    let a = normal.at(pixel, pixel);
    if a <= 0.0 {
        return [0.0; 2];
    }
    if !dense.experiment.offset {
        return [1.0 / a, 0.0];
    }
    let other = dense.layout.offsets + pixel;
    let (b, c) = (normal.at(pixel, other), normal.at(other, other));
    let determinant = a * c - b * b;
    [c / determinant, a / determinant]
}

/// The covariance of the tilts that a prior on the fluxes leaves open, and that no draw samples.
fn of_tilts(experiment: &Experiment, gauge: &Gauge) -> Option<Vec<f64>> {
    let covariance = hidden_tilts(experiment)?;
    let tilts = [gauge.tilt(0), gauge.tilt(1)];
    let product = |p: usize, q: usize| -> f64 {
        let pairs = (0..4).map(|i| covariance[i / 2][i % 2] * tilts[i / 2][p] * tilts[i % 2][q]);
        pairs.sum()
    };
    let pixels = tilts[0].len();
    Some((0..pixels * pixels).map(|at| product(at / pixels, at % pixels)).collect())
}

/// What shifts that are wrong by their prior do to M: it follows a wrong shift by −N⁻¹ Jᵀw J_d.
fn of_wrong_shifts(
    experiment: &Experiment,
    answer: &Answer,
    gauge: &Gauge,
    factor: &Factorised,
) -> Option<Vec<f64>> {
    // The shifts as unknowns behind all others.
    let dense = Dense::new(experiment, Columns::whole(experiment), true);
    let x = dense.unknowns(answer, answer.coefficients.as_ref()?);
    let normal = dense.normal(&x);
    let pixels = dense.pixels();
    let mut wrong = vec![0.0; pixels * pixels];
    for shift in dense.layout.shifts..dense.layout.end {
        let pull: Vec<f64> = (0..factor.order).map(|i| normal.matrix.at(i, shift)).collect();
        // ζ is in units of the prior's standard deviation.
        let moved = gauge.apply(&factor.solve(&pull)[..pixels]);
        for (row, a) in wrong.chunks_exact_mut(pixels).zip(&moved) {
            row.iter_mut().zip(&moved).for_each(|(wrong, b)| *wrong += a * b);
        }
    }
    Some(wrong)
}

fn of_shifts(dense: &Dense<'_>, factor: &Factorised) -> Vec<[f64; 2]> {
    let variance = |exposure: usize, axis: usize| {
        let mut functional = vec![0.0; factor.order];
        dense.moves(exposure, axis).into_iter().for_each(|(at, z)| functional[at] = z);
        dot(&functional, &factor.solve(&functional))
    };
    let count = dense.shift_std.len();
    (0..count).map(|k| [variance(k, 0), variance(k, 1)]).collect()
}

fn along(dense: &Dense<'_>, factor: &Factorised, x: &[f64]) -> f64 {
    if !dense.experiment.offset {
        return 0.0;
    }
    let m = &x[..dense.pixels()];
    let mut functional = vec![0.0; factor.order];
    for (weight, m_of) in functional[dense.layout.offsets..].iter_mut().zip(m) {
        *weight = m_of / dot(m, m);
    }
    dot(&functional, &factor.solve(&functional))
}

fn mean_of_offsets_alone(dense: &Dense<'_>, normal: &Symmetric) -> f64 {
    let variances = (0..dense.pixels()).map(|pixel| inverse_of_pixel(dense, normal, pixel)[1]);
    let measured: Vec<f64> = variances.filter(|variance| *variance > 0.0).collect();
    measured.iter().sum::<f64>() / measured.len().max(1) as f64
}

//! What a lamp may do: ln c = ln c₀ + T θ.

use super::linear::{Symmetric, dot};
use crate::common::{Answer, Experiment, Lamp};
use crate::simulation::place;

/// The columns of T.
pub(crate) struct Columns {
    of_theta: Vec<Vec<f64>>,
    /// What a sum over the exposures weighs ln c by: the columns that are sought are orthonormal by it.
    weights: Vec<f64>,
    /// Whether each θ has a prior of standard deviation 1 around 0.
    pub(crate) have_prior: bool,
}

impl Columns {
    /// What a fit seeks: what no tilt of M explains, at right angles by the weights of the prior, if there is one.
    pub(crate) fn sought(experiment: &Experiment) -> Self {
        let even = vec![1.0; experiment.shifts.len()];
        let weights = match &experiment.lamp {
            Lamp::Prior(std) => std.iter().map(|std| std.powi(-2)).collect(),
            _ => even.clone(),
        };
        let vectors = match &experiment.lamp {
            Lamp::Known => Vec::new(),
            Lamp::Free | Lamp::Prior(_) => diagonal(&even),
            Lamp::Linear(times) => vec![times.clone()],
        };
        let of_theta = complement(&hidden(experiment), &vectors, &weights);
        Self { of_theta, weights, have_prior: matches!(experiment.lamp, Lamp::Prior(_)) }
    }

    /// What a lamp may do in truth: the prior of each ln c alone, a drift linear in time as it is.
    pub(crate) fn whole(experiment: &Experiment) -> Self {
        let mut columns = Self::sought(experiment);
        match &experiment.lamp {
            Lamp::Prior(std) => columns.of_theta = diagonal(std),
            Lamp::Linear(times) if columns.count() > 0 => columns.of_theta = vec![times.clone()],
            _ => {}
        }
        columns
    }

    pub(crate) fn count(&self) -> usize {
        self.of_theta.len()
    }

    /// T of one exposure.
    pub(crate) fn of(&self, exposure: usize) -> impl Iterator<Item = f64> {
        self.of_theta.iter().map(move |column| column[exposure])
    }

    /// T θ.
    pub(crate) fn spread(&self, theta: &[f64]) -> Vec<f64> {
        let log = |k: usize| self.of(k).zip(theta).map(|(t, theta)| t * theta).sum();
        (0..self.weights.len()).map(log).collect()
    }

    /// θ of ln c − ln c₀ = T θ, for the columns that are sought.
    pub(crate) fn heights(&self, logs: &[f64]) -> Vec<f64> {
        self.of_theta.iter().map(|column| weighted(&self.weights, column, logs)).collect()
    }
}

/// Whether exposures are turned against each other.
pub(crate) fn is_turned(experiment: &Experiment) -> bool {
    experiment.degrees.iter().any(|degrees| *degrees != experiment.degrees[0])
}

/// What of ln c no measurement tells from changes of L and M: M → M·exp(−s·p), L → L·exp(s·u) and
/// ln c → ln c − s·d change nothing, nor does a factor between L and c.
fn hidden(experiment: &Experiment) -> Vec<Vec<f64>> {
    let along = |axis: usize| experiment.shifts.iter().map(|d| d[axis]).collect();
    let mut hidden = vec![vec![1.0; experiment.shifts.len()]];
    if !is_turned(experiment) {
        hidden.extend([along(0), along(1)]);
    }
    hidden
}

fn diagonal(values: &[f64]) -> Vec<Vec<f64>> {
    let unit = |k: usize| (0..values.len()).map(|i| if i == k { values[k] } else { 0.0 }).collect();
    (0..values.len()).map(unit).collect()
}

/// A basis, orthonormal by these weights, of what `vectors` add to the span of `hidden`.
fn complement(hidden: &[Vec<f64>], vectors: &[Vec<f64>], weights: &[f64]) -> Vec<Vec<f64>> {
    let mut basis: Vec<Vec<f64>> = Vec::new();
    let mut found = Vec::new();
    for (index, vector) in hidden.iter().chain(vectors).enumerate() {
        let mut left = vector.clone();
        // Twice, for what rounding leaves the first time.
        for other in basis.iter().chain(&basis) {
            let share = weighted(weights, &left, other);
            left.iter_mut().zip(other).for_each(|(a, b)| *a -= share * b);
        }
        let [size, whole] = [&left, vector].map(|v| weighted(weights, v, v).sqrt());
        if size > 1e-9 * whole {
            left.iter_mut().for_each(|a| *a /= size);
            found.extend((index >= hidden.len()).then(|| left.clone()));
            basis.push(left);
        }
    }
    found
}

/// Σ w a b.
fn weighted(weights: &[f64], a: &[f64], b: &[f64]) -> f64 {
    weights.iter().zip(a).zip(b).map(|((w, a), b)| w * a * b).sum()
}

/// An answer brought to fluxes without what no measurement tells, with the coefficients that go with it: the
/// gauge in which free fluxes and linear drifts are sought.
pub(crate) fn without_gauge(experiment: &Experiment, answer: &Answer) -> (Answer, Vec<f64>) {
    let mut answer = answer.clone();
    let mut coefficients = answer.coefficients.clone().unwrap_or_else(|| answer.beam.clone());
    if matches!(experiment.lamp, Lamp::Free | Lamp::Linear(_)) {
        let logs: Vec<f64> =
            answer.flux.iter().zip(&experiment.flux).map(|(c, given)| (c / given).ln()).collect();
        let (mean, slope) = affine_part(experiment, &logs);
        let along = |at: [f64; 2]| slope[0] * at[0] + slope[1] * at[1];
        for (pixel, m) in answer.sensitivity.iter_mut().enumerate() {
            *m *= (-along(place(experiment.shape, experiment.degrees[0], pixel))).exp();
        }
        for (cell, a) in coefficients.iter_mut().enumerate() {
            let at = [cell / answer.beam_shape[1], cell % answer.beam_shape[1]];
            let at = [0, 1].map(|axis| at[axis] as f64 - answer.origin[axis]);
            *a *= (mean + along(at)).exp();
        }
        for (c, d) in answer.flux.iter_mut().zip(&answer.shifts) {
            *c *= (-mean - along(*d)).exp();
        }
    }
    (answer, coefficients)
}

/// The mean and the slope s of the part mean + s·d of ln c that no measurement tells, by least squares.
fn affine_part(experiment: &Experiment, logs: &[f64]) -> (f64, [f64; 2]) {
    let hidden = hidden(experiment);
    let mut normal = Symmetric::zeros(hidden.len());
    for k in 0..logs.len() {
        let row: Vec<_> = hidden.iter().map(|column| column[k]).enumerate().collect();
        normal.add_square(1.0, &row);
    }
    let right: Vec<f64> = hidden.iter().map(|column| dot(column, logs)).collect();
    let found = normal.factorised().map(|factor| factor.solve(&right)).unwrap_or(right);
    let part = |index: usize| found.get(index).copied().unwrap_or(0.0);
    (part(0), [part(1), part(2)])
}

/// The covariance of the slope s, by the priors of the fluxes, of the part mean + s·d of ln c that no
/// measurement tells.
pub(crate) fn hidden_tilts(experiment: &Experiment) -> Option<[[f64; 2]; 2]> {
    let Lamp::Prior(std) = &experiment.lamp else { return None };
    let mut normal = Symmetric::zeros(3);
    for (std, d) in std.iter().zip(&experiment.shifts) {
        normal.add_square(std.powi(-2), &[(0, 1.0), (1, d[0]), (2, d[1])]);
    }
    let factor = normal.factorised().filter(|_| !is_turned(experiment))?;
    let [row, col] = [factor.solve(&[0.0, 1.0, 0.0]), factor.solve(&[0.0, 0.0, 1.0])];
    Some([[row[1], row[2]], [col[1], col[2]]])
}

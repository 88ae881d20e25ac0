//! How far an answer is from the minimum of F.

use super::Dense;
use super::lamp::{Columns, without_gauge};
use super::normal::Normal;
use crate::common::{Answer, Experiment, Noise};

/// Looks until a fit counts the weight of the penalty as found.
const SETTLING: usize = 3;

/// An answer beside the minimum next to it.
pub(crate) struct Minimum {
    /// The largest change of M that a Gauss-Newton step makes, of M of mean 1.
    pub(crate) step: f64,
    /// The largest slope of F along an unknown, by the sum of the sizes of its terms.
    pub(crate) slope: f64,
    /// What of both an answer may have: see [`Self::beside`].
    pub(crate) allowed: f64,
    /// How far the penalty moves M.
    pub(crate) of_penalty: f64,
    /// F at the answer, and that of the measurements alone.
    pub(crate) objective: f64,
    pub(crate) misfit: f64,
    /// The share of F that may differ since the weights of penalty and priors are those of the third look.
    pub(crate) unsettled: f64,
}

impl Minimum {
    /// `None` where the measurements do not determine the answer.
    ///
    /// The estimate that ends a fit is the largest change of M that P⁻¹ r makes, over the smallest
    /// eigenvalue of P⁻¹S. That bounds the error in the norm of P, a mean square: the largest error of N
    /// pixels is at most √N times it. And a fit keeps two weights as it found them at its third look:
    /// that of the penalty, which goes with M², and that of the priors where no variance is known, which
    /// goes with F. What both do to M is wrong by as much.
    pub(crate) fn beside(experiment: &Experiment, answer: &Answer, tolerance: f64) -> Option<Self> {
        let (sought, coefficients) = without_gauge(experiment, answer);
        let mut dense = Dense::new(experiment, Columns::sought(experiment), answer.refined);
        dense.prior.clone_from(&answer.prior);
        let mut unit_is_off = 0.0;
        let third = answer.history.get(SETTLING - 1).or(answer.history.last())?;
        if let Noise::Unknown | Noise::Relative(_) = experiment.noise {
            // Without the degree of freedom that the gauge is.
            dense.unit = answer.misfit / (answer.degrees_of_freedom - 1) as f64;
            unit_is_off = (third.objective / answer.history.last()?.objective - 1.0).abs();
        }
        let x = dense.unknowns(&sought, &coefficients);
        let normal = dense.normal(&x);
        let factor = dense.factorised(&normal, &x)?;
        let pixels = dense.pixels();
        let moved_by = |slope: &[f64]| largest(&factor.solve(slope)[..pixels]);
        let of_penalty = moved_by(&normal.of_penalty);
        let unsettled = 2.0 * third.error * of_penalty + unit_is_off * moved_by(&normal.of_priors);
        let step = factor.solve(&normal.slope);
        let moved: Vec<f64> = x.iter().zip(step).map(|(x, step)| x + step).collect();
        Some(Self {
            step: apart(&x[..pixels], &moved[..pixels]),
            slope: largest_slope(&normal),
            allowed: (pixels as f64).sqrt() * tolerance + unsettled,
            of_penalty,
            objective: normal.objective,
            misfit: normal.misfit,
            unsettled: 2.0 * third.error + unit_is_off,
        })
    }
}

/// The largest difference of two images once both have the mean 1 where both are known.
pub(crate) fn apart(a: &[f64], b: &[f64]) -> f64 {
    let known = || a.iter().zip(b).filter(|(a, b)| a.is_finite() && b.is_finite());
    let sums = known().fold([0.0; 2], |sum, (a, b)| [sum[0] + a, sum[1] + b]);
    let count = known().count() as f64;
    known().map(|(a, b)| (a / sums[0] - b / sums[1]).abs() * count).fold(0.0, f64::max)
}

fn largest_slope(normal: &Normal) -> f64 {
    let slopes = normal.slope.iter().zip(&normal.terms).filter(|(_, terms)| **terms > 0.0);
    slopes.map(|(slope, terms)| slope.abs() / terms).fold(0.0, f64::max)
}

fn largest(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |largest, value| largest.max(value.abs()))
}

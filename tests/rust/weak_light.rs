//! Weak light: the minimum of F with the prior of M, and its error bars, against dense algebra.

use crate::common::{Answer, Experiment, Method, Options, error_map, fit, variances};
use crate::dense::covariance::Covariance;
use crate::dense::minimum::Minimum;
use crate::simulation::{CROSS, SMALL, Simulation, TURNED, narrow, random};

const TOLERANCE: f64 = 1e-8;
/// What the variance of a functional may lack, and what single precision adds.
const LACK: f64 = 1e-4;
const SINGLE: f64 = 1e-5;

/// A narrow beam with even weights, and with uneven ones and gaps.
fn experiments() -> Vec<Experiment> {
    let of = |degrees: [i64; 5]| {
        let simulation = Simulation::seeing(narrow, SMALL, &CROSS).with_noise(1e-2, 3);
        let experiment = simulation.turned(&degrees).experiment();
        [experiment.clone(), experiment.uneven()]
    };
    [[0; 5], TURNED].into_iter().flat_map(of).collect()
}

fn answer(experiment: &Experiment, method: Method) -> Answer {
    let answer = fit(experiment, Options { method, ..Options::to(TOLERANCE) }).unwrap();
    assert!(answer.converged);
    let held = answer.prior.iter().filter(|weight| **weight > 0.0).count();
    assert!(held > SMALL[0] && held < SMALL[0] * SMALL[1], "{held}");
    answer
}

#[test]
fn both_methods_end_at_the_minimum() {
    for experiment in experiments() {
        for method in [Method::Multiscale, Method::CoordinateDescent] {
            let answer = answer(&experiment, method);
            let minimum = Minimum::beside(&experiment, &answer, TOLERANCE).unwrap();
            assert!(minimum.step <= minimum.allowed, "{method:?} {:e}", minimum.step);
            // Both are the same sums, of values of order 1/variance.
            assert!((answer.misfit / minimum.misfit - 1.0).abs() < 1e-9);
            let objective: Vec<f64> = answer.history.iter().map(|look| look.objective).collect();
            assert!(objective.windows(2).all(|pair| pair[1] <= pair[0] * (1.0 + 1e-12)));
        }
    }
}

#[test]
fn both_methods_have_the_same_prior() {
    for experiment in experiments() {
        let [fast, swept] = [Method::Multiscale, Method::CoordinateDescent]
            .map(|method| answer(&experiment, method).prior);
        assert_eq!(fast, swept);
    }
}

#[test]
fn variances_of_functionals() {
    for experiment in experiments() {
        let answer = answer(&experiment, Method::Multiscale);
        let covariance = Covariance::of(&experiment, &answer, 1.0).unwrap();
        let image = |weight: &dyn Fn(usize) -> f64| -> Vec<f64> {
            let known = |p: usize| if answer.sensitivity[p].is_finite() { weight(p) } else { 0.0 };
            (0..covariance.pixels).map(known).collect()
        };
        let held = |p: usize| f64::from(answer.prior[p] > 0.0);
        let functionals = [image(&|p| random(70, p)), image(&held), image(&|p| 1.0 - held(p))];
        let found = variances(&experiment, &answer, &functionals, 1).unwrap();
        for (found, functional) in found.iter().zip(&functionals) {
            let ratio = found / covariance.variance(functional);
            assert!((1.0 - LACK..=1.0 + SINGLE).contains(&ratio), "{ratio}");
        }
    }
}

#[test]
fn maps_of_errors() {
    for experiment in experiments() {
        let answer = answer(&experiment, Method::Multiscale);
        let covariance = Covariance::of(&experiment, &answer, 1.0).unwrap();
        let map = error_map(&experiment, &answer, 1).unwrap();
        let known: Vec<usize> =
            (0..covariance.pixels).filter(|&p| answer.sensitivity[p].is_finite()).collect();
        let error = |p: &usize| map.std[*p] / covariance.std(*p) - 1.0;
        let square = known.iter().map(|p| error(p).powi(2)).sum::<f64>() / known.len() as f64;
        // A mean square that a few patterns make may be twice what it is on average.
        assert!(square.sqrt() <= 2.0 * map.exactness, "{} {}", square.sqrt(), map.exactness);
    }
}

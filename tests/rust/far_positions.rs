//! Positions so far apart that they leave hundreds of waves barely constrained.

use crate::common::{Options, fit};
use crate::simulation::Simulation;

const SENSOR: [usize; 2] = [120, 160];
const FAR: [[f64; 2]; 5] =
    [[34.0, -24.0], [-39.0, -20.0], [-9.0, 32.0], [-5.0, -41.0], [-17.0, 10.0]];
/// Few dozen, as for any pattern. With the deepest four waves alone these positions take hundreds.
const MOST_PASSES: u64 = 60;

#[test]
fn they_take_a_few_dozen_passes_to_the_truth() {
    let whole = Simulation::new(SENSOR, &FAR);
    let truth = whole.sensitivity();
    // Whole, and with masked measurements of uneven variance.
    for experiment in [whole.experiment(), whole.experiment().uneven()] {
        let answer = fit(&experiment, Options::to(1e-6)).unwrap();
        assert!(answer.converged);
        let last = answer.history.last().unwrap();
        assert!(last.passes <= MOST_PASSES, "{}", last.passes);
        let errors = answer.sensitivity.iter().zip(&truth).map(|(found, m)| (found - m).abs());
        let largest = errors.fold(0.0, f64::max);
        assert!(largest <= last.error && last.error <= 1e-6, "{largest:e} {:e}", last.error);
    }
}

#[test]
fn any_number_of_workers_gives_the_same_bytes() {
    let experiment = Simulation::new(SENSOR, &FAR).with_noise(1e-3, 2).experiment().uneven();
    let of = |workers| fit(&experiment, Options { workers, ..Options::to(1e-6) }).unwrap();
    let [one, three] = [1, 3].map(of);
    assert_eq!(one.sensitivity, three.sensitivity);
    assert_eq!(one.history, three.history);
}

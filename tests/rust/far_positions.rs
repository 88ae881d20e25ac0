//! Positions so far apart that they leave hundreds of waves barely constrained.

use crate::common::{Experiment, Lamp, Noise, Options, fit};
use crate::dense::gauge::Gauge;
use crate::simulation::{DRIFT, Simulation, even};

const SENSOR: [usize; 2] = [120, 160];
const FAR: [[f64; 2]; 5] =
    [[34.0, -24.0], [-39.0, -20.0], [-9.0, 32.0], [-5.0, -41.0], [-17.0, 10.0]];
/// Fewer than the 115 to 121 that equal weights take with the deepest four waves alone.
const MOST_PASSES: u64 = 90;
/// Fewer than the 200 that equal weights take with those waves, and unequal ones thousands.
const MOST_WITH_FLUXES: u64 = 150;

/// Exposures of these variances.
fn unequal(whole: &Simulation, variances: [f64; 5]) -> Experiment {
    Experiment { noise: Noise::Exposures(variances.to_vec()), ..whole.experiment() }
}

#[track_caller]
fn takes_a_few_dozen_passes_to_the_truth(experiment: &Experiment, truth: &[f64]) {
    let answer = fit(experiment, Options::to(1e-6)).unwrap();
    let last = answer.history.last().unwrap();
    let most = if experiment.lamp == Lamp::Known { MOST_PASSES } else { MOST_WITH_FLUXES };
    assert!(answer.converged && last.passes <= most, "{}", last.passes);
    let errors = answer.sensitivity.iter().zip(truth).map(|(found, m)| (found - m).abs());
    let largest = errors.fold(0.0, f64::max);
    // The estimate is below half of the error in none of 2000 (docs/studies.md).
    assert!(largest <= 2.0 * last.error, "{largest:e} {:e}", last.error);
}

#[test]
fn they_take_a_few_dozen_passes_to_the_truth() {
    let whole = Simulation::seeing(even, SENSOR, &FAR);
    let truth = whole.sensitivity();
    // Equal weights, and masked measurements of uneven variance.
    takes_a_few_dozen_passes_to_the_truth(&whole.experiment(), &truth);
    takes_a_few_dozen_passes_to_the_truth(&whole.experiment().uneven(), &truth);
    // One exposure of a hundredth of the weight, or of a hundred times as much. Where the heavy ones are
    // three or two, they leave thousands of parts that light ones alone connect.
    for variances in [
        [1e-6, 1e-6, 1e-4, 1e-6, 1e-6],
        [1e-6, 1e-6, 1e-8, 1e-6, 1e-6],
        [1e-6, 1e-6, 1e-6, 1e-2, 1e-2],
        [1e-6, 1e-6, 1e-4, 1e-4, 1e-4],
    ] {
        takes_a_few_dozen_passes_to_the_truth(&unequal(&whole, variances), &truth);
    }
}

/// A period along the line of the heavy positions is left to the light ones at all wave vectors across it.
#[test]
fn heavy_positions_on_a_line_take_no_more() {
    let cross = [[0.0, 0.0], [0.0, 11.0], [0.0, 19.0], [11.0, 0.0], [19.0, 0.0]];
    let whole = Simulation::seeing(even, SENSOR, &cross);
    for variances in [[1e-6, 1e-6, 1e-6, 1e-3, 1e-3], [1e-6, 1e-6, 1e-2, 1e-2, 1e-2]] {
        takes_a_few_dozen_passes_to_the_truth(&unequal(&whole, variances), &whole.sensitivity());
    }
}

#[test]
fn they_take_few_passes_where_fluxes_are_sought() {
    let whole = Simulation::seeing(even, SENSOR, &FAR).with_flux(&DRIFT);
    let truth = whole.sensitivity();
    let known = [
        whole.experiment(),
        whole.experiment().uneven(),
        unequal(&whole, [1e-6, 1e-6, 1e-4, 1e-6, 1e-6]),
        unequal(&whole, [1e-6, 1e-6, 1e-8, 1e-6, 1e-6]),
        unequal(&whole, [1e-6, 1e-6, 1e-6, 1e-4, 1e-4]),
        unequal(&whole, [1e-6, 1e-6, 1e-4, 1e-4, 1e-4]),
    ];
    for known in known {
        let sought = free(known);
        takes_a_few_dozen_passes_to_the_truth(&sought, &Gauge::new(&sought, &truth).level());
    }
}

/// With fluxes that are sought.
fn free(known: Experiment) -> Experiment {
    Experiment { lamp: Lamp::Free, flux: vec![1.0; FAR.len()], ..known }
}

#[test]
fn any_number_of_workers_gives_the_same_bytes() {
    let known = Simulation::seeing(even, SENSOR, &FAR).with_noise(1e-3, 2).experiment().uneven();
    for experiment in [known.clone(), free(known)] {
        let of = |workers| fit(&experiment, Options { workers, ..Options::to(1e-6) }).unwrap();
        let [one, three] = [1, 3].map(of);
        assert_eq!(one.sensitivity, three.sensitivity);
        assert_eq!(one.history, three.history);
    }
}

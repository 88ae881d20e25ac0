//! Positions so far apart that they leave hundreds of waves barely constrained.

use crate::common::{Experiment, Lamp, Noise, Options, fit};
use crate::dense::gauge::Gauge;
use crate::simulation::{DRIFT, Simulation, even};

const SENSOR: [usize; 2] = [120, 160];
const FAR: [[f64; 2]; 5] =
    [[34.0, -24.0], [-39.0, -20.0], [-9.0, 32.0], [-5.0, -41.0], [-17.0, 10.0]];
/// Exposures of these variances.
fn unequal(whole: &Simulation, variances: [f64; 5]) -> Experiment {
    Experiment { noise: Noise::Exposures(variances.to_vec()), ..whole.experiment() }
}

/// The limits are below what the deepest four waves alone take: 115 to 121 with equal weights and known fluxes, 200 with
/// sought ones, and up to thousands with unequal weights.
#[track_caller]
fn takes_to_the_truth(most: u64, experiment: &Experiment, truth: &[f64]) {
    let answer = fit(experiment, Options::to(1e-6)).unwrap();
    let last = answer.history.last().unwrap();
    assert!(answer.converged && last.passes <= most, "{}", last.passes);
    let errors = answer.sensitivity.iter().zip(truth).map(|(found, m)| (found - m).abs());
    let largest = errors.fold(0.0, f64::max);
    // The estimate is below half of the error in none of 2000 (docs/studies.md).
    assert!(largest <= 2.0 * last.error, "{largest:e} {:e}", last.error);
}

#[test]
fn they_take_a_few_dozen_passes() {
    let whole = Simulation::seeing(even, SENSOR, &FAR);
    let truth = whole.sensitivity();
    // Equal weights, and masked measurements of uneven variance.
    takes_to_the_truth(90, &whole.experiment(), &truth);
    takes_to_the_truth(90, &whole.experiment().uneven(), &truth);
    // One exposure of a hundredth of the weight, or of a hundred times as much. Where the heavy ones are
    // three or two, they leave thousands of parts that light ones alone connect.
    for variances in [
        [1e-6, 1e-6, 1e-4, 1e-6, 1e-6],
        [1e-6, 1e-6, 1e-8, 1e-6, 1e-6],
        [1e-6, 1e-6, 1e-6, 1e-2, 1e-2],
        [1e-6, 1e-6, 1e-4, 1e-4, 1e-4],
    ] {
        takes_to_the_truth(90, &unequal(&whole, variances), &truth);
    }
}

/// A period along the line of the heavy positions is left to the light ones at all wave vectors across it.
#[test]
fn heavy_positions_on_a_line_take_no_more() {
    let cross = [[0.0, 0.0], [0.0, 11.0], [0.0, 19.0], [11.0, 0.0], [19.0, 0.0]];
    let whole = Simulation::seeing(even, SENSOR, &cross);
    for variances in [[1e-6, 1e-6, 1e-6, 1e-3, 1e-3], [1e-6, 1e-6, 1e-2, 1e-2, 1e-2]] {
        takes_to_the_truth(90, &unequal(&whole, variances), &whole.sensitivity());
    }
}

#[test]
fn they_take_few_passes_where_fluxes_are_sought() {
    let whole = Simulation::seeing(even, SENSOR, &FAR).with_flux(&DRIFT);
    let truth = whole.sensitivity();
    for (most, experiment) in [
        (81, whole.experiment()),
        (77, whole.experiment().uneven()),
        (90, unequal(&whole, [1e-6, 1e-6, 1e-4, 1e-6, 1e-6])),
        (176, unequal(&whole, [1e-6, 1e-6, 1e-8, 1e-6, 1e-6])),
        (130, unequal(&whole, [1e-6, 1e-6, 1e-6, 1e-4, 1e-4])),
        (78, unequal(&whole, [1e-6, 1e-6, 1e-4, 1e-4, 1e-4])),
        // The two of most light have most weight, as only the fit finds.
        (130, whole.clone().with_flux(&[1.0, 0.9, 0.1, 0.1, 0.1]).experiment()),
    ] {
        let sought = free(experiment);
        takes_to_the_truth(most, &sought, &Gauge::new(&sought, &truth).level());
    }
}

/// The same, with fluxes that are sought.
fn free(known: Experiment) -> Experiment {
    Experiment { flux: vec![1.0; FAR.len()], ..known }.with_lamp(Lamp::Free)
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

//! Which solver finds an answer, and that those that may find the same do.

use crate::common::{Experiment, Lamp, Method, Options, fit};
use crate::dense::lamp::Columns;
use crate::dense::minimum::{Minimum, apart};
use crate::simulation::{CROSS, DRIFT, SMALL, Simulation, TIMES, TURNED, place};

const TOLERANCE: f64 = 1e-8;

fn by(method: Method) -> Options {
    Options { method, ..Options::to(TOLERANCE) }
}

fn whole(degrees: &[i64]) -> Experiment {
    Simulation::new(SMALL, &CROSS)
        .with_noise(1e-3, 3)
        .with_flux(&DRIFT)
        .turned(degrees)
        .experiment()
}

#[test]
fn both_methods_find_the_minimum_of_whole_pixels() {
    for experiment in [whole(&[0; 5]), whole(&[0; 5]).uneven(), whole(&TURNED).uneven()] {
        let answers = [Method::Multiscale, Method::CoordinateDescent].map(|method| {
            let answer = fit(&experiment, by(method)).unwrap();
            assert!(answer.converged && !answer.is_joint());
            let beside = Minimum::beside(&experiment, &answer, TOLERANCE).unwrap();
            let Minimum { step, slope, allowed, misfit, .. } = beside;
            assert!(step <= allowed && slope <= allowed, "{method:?}: {step:e}, {slope:e}");
            // F after the sweep that M follows: M may have moved since, by the tolerance.
            assert!((answer.misfit / misfit - 1.0).abs() <= allowed);
            (answer, allowed)
        });
        let [(one, allowed), (other, too)] = &answers;
        assert!(apart(&one.sensitivity, &other.sensitivity) <= allowed + too);
    }
}

/// M after so many sweeps, by the closed forms of L and M.
fn swept(experiment: &Experiment, sweeps: usize) -> Vec<f64> {
    let Experiment { shape, frames, shifts, degrees, flux, .. } = experiment;
    let pixels = shape[0] * shape[1];
    let cell = |at: usize| {
        let [row, col] = place(*shape, degrees[at / pixels], at % pixels);
        let [down, right] = shifts[at / pixels];
        ((row + down) * 100.0 + col + right) as usize
    };
    let (mut m, mut beam) = (vec![1.0; pixels], vec![0.0; 10_000]);
    let update =
        |sought: &mut [f64], own: &dyn Fn(usize) -> usize, known: &dyn Fn(usize) -> f64| {
            let mut sums = vec![[0.0; 2]; sought.len()];
            for (at, y) in frames.iter().enumerate() {
                let factor = flux[at / pixels] * known(at);
                sums[own(at)][0] += factor * y;
                sums[own(at)][1] += factor * factor;
            }
            let seen = sought.iter_mut().zip(sums).filter(|(_, [_, square])| *square > 0.0);
            seen.for_each(|(value, [product, square])| *value = product / square);
        };
    for _ in 0..sweeps {
        update(&mut beam, &cell, &|at| m[at % pixels]);
        update(&mut m, &|at| at % pixels, &|at| beam[cell(at)]);
    }
    m
}

#[test]
fn coordinate_descent_sweeps_and_multiscale_does_not() {
    let experiment = whole(&[0; 5]);
    let wanted = swept(&experiment, 5);
    let off = |method: Method| {
        let options = Options { most_passes: Some(5), ..by(method) };
        apart(&fit(&experiment, options).unwrap().sensitivity, &wanted)
    };
    // Five sweeps of sums of five terms.
    assert!(off(Method::CoordinateDescent) < 100.0 * f64::EPSILON);
    assert!(off(Method::Multiscale) > 1e-6);
}

#[test]
fn all_else_is_fitted_jointly() {
    let known = Simulation::new(SMALL, &CROSS).with_noise(1e-3, 3).experiment();
    let mut nearly_whole = known.clone();
    nearly_whole.shifts[3][1] = 0.25;
    let experiments = [
        nearly_whole,
        known.clone().measured_to(&[[1e-3; 2]; 5]),
        known.clone().with_lamp(Lamp::Free),
        known.clone().with_lamp(Lamp::Linear(TIMES.to_vec())),
        known.clone().with_lamp(Lamp::Prior(vec![0.01; 5])),
        Simulation::new(SMALL, &CROSS).with_noise(1e-3, 3).at_two_levels().experiment(),
    ];
    for experiment in experiments {
        assert!(fit(&experiment, Options::to(1e-4)).unwrap().is_joint());
    }
    assert!(!fit(&known, Options::to(1e-4)).unwrap().is_joint());
}

#[test]
fn the_joint_fit_of_what_is_known_is_that_of_the_other_solvers() {
    for experiment in [whole(&[0; 5]), whole(&TURNED).uneven()] {
        let plain = fit(&experiment, Options::to(TOLERANCE)).unwrap();
        let allowed = Minimum::beside(&experiment, &plain, TOLERANCE).unwrap().allowed;
        // Fluxes that are known to 1e-9 move M by less.
        let experiment = Experiment { lamp: Lamp::Prior(vec![1e-9; 5]), ..experiment };
        let joint = fit(&experiment, Options::to(TOLERANCE)).unwrap();
        assert!(joint.is_joint() && joint.converged);
        let off = apart(&plain.sensitivity, &joint.sensitivity);
        assert!(off <= 2.0 * allowed);
        // The same measurements for fewer unknowns, by the fluxes that are sought.
        let sought = Columns::sought(&experiment).count() as i64;
        assert_eq!(joint.degrees_of_freedom, plain.degrees_of_freedom - sought);
    }
}

//! Shifts that have one fraction of a pixel in common differ by whole pixels, and are fitted as whole ones.

use crate::common::{Answer, Experiment, Lamp, Method, Options, error_map, fit, variances};
use crate::simulation::{CROSS, DRIFT, SMALL, Simulation, TIMES, TURNED};

/// Fractions whose sums with whole pixels are not exact in binary, and a half.
const FRACTIONS: [[f64; 2]; 2] = [[0.1, 0.5], [-0.3, 0.0]];

fn simulated(degrees: &[i64]) -> Simulation {
    Simulation::new(SMALL, &CROSS).with_noise(1e-3, 3).with_flux(&DRIFT).turned(degrees)
}

/// One of every kind, at whole shifts.
fn experiments() -> Vec<Experiment> {
    let known = simulated(&[0; 5]).experiment();
    let turned = simulated(&TURNED).experiment().uneven();
    let lamps = [Lamp::Free, Lamp::Linear(TIMES.to_vec()), Lamp::Prior(vec![0.01; 5])];
    let fitted = lamps.into_iter().flat_map(|lamp| {
        [&known, &turned].map(|experiment| experiment.clone().with_lamp(lamp.clone()))
    });
    let offset = Simulation::new(SMALL, &CROSS).with_noise(1e-3, 3).at_two_levels().experiment();
    [known.clone(), turned.clone(), offset].into_iter().chain(fitted).collect()
}

/// The same frames, their shifts being this much larger.
fn moved(experiment: &Experiment, fraction: [f64; 2]) -> Experiment {
    let moved = |shift: &[f64; 2]| [0, 1].map(|axis| shift[axis] + fraction[axis]);
    let shifts = experiment.shifts.iter().map(moved).collect();
    Experiment { shifts, ..experiment.clone() }
}

fn bits(values: &[f64]) -> Vec<u64> {
    values.iter().map(|value| value.to_bits()).collect()
}

/// Numbers that the gauge of fluxes enters: products of some ten factors exp(x), |x| < 1, each of a few
/// roundings.
const OF_GAUGE: f64 = 50.0 * f64::EPSILON;
/// Answers of linear problems with such numbers: the preconditioner leaves a condition below 100, and rounding
/// adds up in some 100 iterations.
const OF_ANSWERS: f64 = 1e4 * OF_GAUGE;

fn assert_alike(one: &[f64], other: &[f64], rounding: f64) {
    assert_eq!(one.len(), other.len());
    for (a, b) in one.iter().zip(other) {
        assert!((a / b - 1.0).abs() < rounding || a.is_nan() && b.is_nan(), "{a} {b}");
    }
}

fn assert_same(whole: &Answer, between: &Answer, experiment: &Experiment, fraction: [f64; 2]) {
    assert_eq!(bits(&whole.sensitivity), bits(&between.sensitivity));
    assert_eq!(whole.offset.as_deref().map(bits), between.offset.as_deref().map(bits));
    assert_eq!((whole.misfit, &whole.history), (between.misfit, &between.history));
    assert_eq!(whole.degrees_of_freedom, between.degrees_of_freedom);
    assert_eq!((&whole.flags, &whole.labels), (&between.flags, &between.labels));
    assert_alike(&whole.beam, &between.beam, OF_GAUGE);
    assert_alike(&whole.flux, &between.flux, OF_GAUGE);
    assert_eq!(between.shifts, experiment.shifts);
    assert_eq!(between.beam_shape, whole.beam_shape);
    let off = [0, 1].map(|axis| whole.origin[axis] - between.origin[axis] - fraction[axis]);
    // Differences of numbers below 4.
    assert!(off.iter().all(|off| off.abs() <= 4.0 * f64::EPSILON), "{off:?}");
}

#[test]
fn the_fit_is_that_of_whole_shifts() {
    for experiment in experiments() {
        let whole = fit(&experiment, Options::to(1e-6)).unwrap();
        for fraction in FRACTIONS {
            let between = moved(&experiment, fraction);
            let found = fit(&between, Options::to(1e-6)).unwrap();
            assert_same(&whole, &found, &between, fraction);
        }
    }
}

#[test]
fn error_bars_are_those_of_whole_shifts() {
    for experiment in experiments().iter().take(4) {
        let pixels = SMALL[0] * SMALL[1];
        let halves = (0..pixels).map(|p| if 2 * p < pixels { 1.0 } else { -1.0 }).collect();
        let halves: [Vec<f64>; 1] = [halves];
        let bars = |experiment: &Experiment| {
            let answer = fit(experiment, Options::to(1e-6)).unwrap();
            let map = error_map(experiment, &answer, 2).unwrap();
            (map.std, variances(experiment, &answer, &halves, 2).unwrap())
        };
        let (whole, between) = (bars(experiment), bars(&moved(experiment, FRACTIONS[0])));
        assert_alike(&whole.0, &between.0, OF_ANSWERS);
        assert_alike(&whole.1, &between.1, OF_ANSWERS);
    }
}

#[test]
fn coordinate_descent_takes_them_too() {
    let options = Options { method: Method::CoordinateDescent, ..Options::to(1e-6) };
    for degrees in [[0; 5], TURNED] {
        let experiment = simulated(&degrees).experiment();
        let whole = fit(&experiment, options).unwrap();
        for fraction in FRACTIONS {
            let between = moved(&experiment, fraction);
            assert_same(&whole, &fit(&between, options).unwrap(), &between, fraction);
        }
        let mut apart = moved(&experiment, FRACTIONS[0]);
        apart.shifts[3][1] += 1e-3;
        let refused = fit(&apart, options).unwrap_err().to_string();
        assert!(refused.contains("shifts that differ by whole pixels"), "{refused}");
    }
}

#[test]
fn a_line_of_positions_takes_as_few_products() {
    let line = [[0.0, 0.0], [0.0, 5.0], [0.0, 11.0]];
    let experiment = Simulation::new([3, 40], &line).with_noise(1e-3, 3).experiment();
    let whole = fit(&experiment, Options::to(1e-6)).unwrap();
    let between = moved(&experiment, [0.3, 0.4]);
    assert_same(&whole, &fit(&between, Options::to(1e-6)).unwrap(), &between, [0.3, 0.4]);
    assert!(whole.converged && whole.history.last().unwrap().passes < 200);
}

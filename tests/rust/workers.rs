//! The same bytes come out for any number of workers.

use crate::common::{
    Answer, Experiment, Lamp, Method, Options, error_map, fit, offset_variances, shift_variances,
    variances,
};
use crate::simulation::{BETWEEN, CROSS, DRIFT, SHIFT_STD, Simulation, even, random};

/// Sensors of several bands of rows, which workers share: bands of eight rows for whole pixels, of 32 for
/// joint fits.
const WHOLE: [usize; 2] = [26, 12];
const TALL: [usize; 2] = [70, 10];
const TURNED: [i64; 5] = [0, 180, 0, 180, 0];

fn simulated(shape: [usize; 2], shifts: &[[f64; 2]], degrees: &[i64]) -> Simulation {
    Simulation::seeing(even, shape, shifts).with_noise(1e-4, 3).turned(degrees)
}

/// The bytes of an answer, in which what is no number equals itself.
fn bytes(answer: &Answer) -> String {
    format!("{answer:?}")
}

/// The answer, which three workers find as one does.
fn found(experiment: &Experiment, method: Method) -> Answer {
    // Coordinate descent would take thousands of sweeps.
    let most_passes = (method == Method::CoordinateDescent).then_some(20);
    let options = Options { method, most_passes, ..Options::to(1e-6) };
    let [one, three] =
        [1, 3].map(|workers| fit(experiment, Options { workers, ..options }).unwrap());
    assert!(bytes(&one) == bytes(&three));
    one
}

fn functionals(experiment: &Experiment) -> [Vec<f64>; 2] {
    let pixels = experiment.shape[0] * experiment.shape[1];
    [70, 71].map(|stream| (0..pixels).map(|pixel| random(stream, pixel)).collect())
}

/// Error bars of an answer, which three workers find as one does.
fn check_error_bars(experiment: &Experiment, answer: &Answer) {
    let [one, three] = [1, 3].map(|workers| {
        let map = error_map(experiment, answer, workers).unwrap();
        let found = variances(experiment, answer, &functionals(experiment), workers).unwrap();
        format!("{map:?} {found:?}")
    });
    assert!(one == three);
}

#[test]
fn whole_pixels() {
    for degrees in [[0; 5], TURNED] {
        let experiment = simulated(WHOLE, &CROSS, &degrees).with_flux(&DRIFT).experiment();
        for experiment in [experiment.clone(), experiment.uneven()] {
            let answer = found(&experiment, Method::Multiscale);
            check_error_bars(&experiment, &answer);
            found(&experiment, Method::CoordinateDescent);
        }
    }
}

#[test]
fn joint_fits() {
    for degrees in [[0; 5], TURNED] {
        let experiment = simulated(TALL, &BETWEEN, &degrees).with_flux(&DRIFT).experiment();
        found(&experiment.uneven().with_lamp(Lamp::Free), Method::Multiscale);
    }
}

#[test]
fn offsets_and_their_error_bars() {
    let experiment = simulated(TALL, &CROSS, &TURNED).at_two_levels().experiment().uneven();
    let answer = found(&experiment, Method::Multiscale);
    check_error_bars(&experiment, &answer);
    let [one, three] =
        [1, 3].map(|workers| offset_variances(&experiment, &answer, workers).unwrap());
    assert_eq!(one, three);
}

#[test]
fn refined_shifts_and_their_error_bars() {
    let experiment = simulated(TALL, &BETWEEN, &TURNED).experiment().measured_to(&SHIFT_STD);
    let answer = found(&experiment, Method::Multiscale);
    assert!(answer.refined);
    let [one, three] = [1, 3].map(|workers| {
        let of_functionals =
            variances(&experiment, &answer, &functionals(&experiment), workers).unwrap();
        (shift_variances(&experiment, &answer, workers).unwrap(), of_functionals)
    });
    assert_eq!(one, three);
}

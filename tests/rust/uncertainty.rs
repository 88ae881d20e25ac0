//! Error bars against the dense covariance.

use crate::common::{
    Answer, ErrorMap, Experiment, Lamp, Noise, Options, error_map, fit, misfit_by_dark,
    offset_variances, shift_variances, variances,
};
use crate::dense::covariance::Covariance;
use crate::simulation::{
    BETWEEN, CROSS, DRIFT, LONG, SHIFT_STD, SMALL, Simulation, TIMES, TURNED, random, rolling,
    smooth,
};

const TOLERANCE: f64 = 1e-8;
/// What the variance of a functional may lack of it.
const LACK: f64 = 1e-4;
/// What rounding adds: sums in single precision, of a problem whose condition is some hundred.
const SINGLE: f64 = 1e-5;
/// The relative standard error that a map is made to, and the most draws that it takes.
const EXACTNESS: f64 = 0.02;
const MOST_DRAWS: f64 = 400.0;
/// What a dark adds to F for each pixel is exact where it is more.
const NEGLIGIBLE: f64 = 1e-3;
/// Draws of what a dark adds to F, on a sensor so small.
const DRAWS_OF_MISFIT: f64 = 64.0;

/// An answer with its covariance.
struct Case {
    experiment: Experiment,
    answer: Answer,
    covariance: Covariance,
}

impl Case {
    fn new(experiment: Experiment) -> Self {
        let answer = fit(&experiment, Options::to(TOLERANCE)).unwrap();
        assert!(answer.converged && answer.few.is_empty());
        let unit = match experiment.noise {
            Noise::Unknown | Noise::Relative(_) => answer.misfit / answer.degrees_of_freedom as f64,
            _ => 1.0,
        };
        let used = experiment.clone().without(&answer.lost);
        let covariance = Covariance::of(&used, &answer, unit).unwrap();
        Self { experiment, answer, covariance }
    }

    fn known(&self) -> impl Iterator<Item = usize> + Clone {
        let known = |pixel: &usize| self.answer.sensitivity[*pixel].is_finite();
        (0..self.covariance.pixels).filter(known)
    }

    /// The variances of functionals are the dense ones, less what they may lack.
    fn check_functionals(&self, functionals: &[Vec<f64>]) {
        let found = variances(&self.experiment, &self.answer, functionals, 1).unwrap();
        assert!(found.len() == functionals.len());
        for (found, functional) in found.iter().zip(functionals) {
            self.check_ratio(found / self.covariance.variance(functional));
        }
    }

    /// A variance by the dense one: what it may lack, and rounding. The part of a dark is a square of the
    /// solution of a linear problem, and wrong by twice its error, which is the root of what it may lack.
    fn check_ratio(&self, ratio: f64) {
        let by_dark = if self.experiment.dark.is_empty() { 0.0 } else { 2.0 * LACK };
        let range = 1.0 - LACK - by_dark..=1.0 + SINGLE + by_dark;
        assert!(range.contains(&ratio), "{ratio}");
    }

    /// The variances of the shifts are the dense ones, less what they may lack.
    fn check_shifts(&self) {
        let found = shift_variances(&self.experiment, &self.answer, 1).unwrap();
        let wanted = self.covariance.of_shifts.as_flattened();
        for (found, wanted) in found.as_flattened().iter().zip(wanted) {
            self.check_ratio(found / wanted);
        }
    }

    /// A functional of every pixel, of one, and of a quarter of the sensor: 0 where M is undetermined.
    fn functionals(&self) -> [Vec<f64>; 3] {
        let [rows, cols] = self.experiment.shape;
        let image = |weight: &dyn Fn(usize) -> f64| -> Vec<f64> {
            let mut image = vec![0.0; self.covariance.pixels];
            self.known().for_each(|pixel| image[pixel] = weight(pixel));
            image
        };
        let quarter = |pixel: usize| 2 * (pixel / cols) < rows && 2 * (pixel % cols) < cols;
        [
            image(&|pixel| random(70, pixel)),
            image(&|pixel| if pixel == cols + 2 { 3.0 } else { 0.0 }),
            image(&|pixel| if quarter(pixel) { 1.0 } else { 0.0 }),
        ]
    }

    /// A map is made of draws, whose covariance between the pixels follows from the part R of Cov M that is
    /// drawn: a mean over n draws of squares of normal values scatters by 2 R²/n. So relative errors of the
    /// deviations scatter by C = R²/(2 n v v), v being the variances; their mean and their mean square must
    /// be those of such errors. The part of R that M follows at once has no scatter of its own.
    fn check_map(&self) {
        let map = error_map(&self.experiment, &self.answer, 1).unwrap();
        let undetermined = map.std.iter().zip(&self.answer.sensitivity);
        assert!(undetermined.clone().all(|(std, m)| std.is_finite() == m.is_finite()));
        let error = |pixel: usize| {
            let variance = self.covariance.std(pixel).powi(2);
            0.5 * (map.std[pixel].powi(2) / variance - 1.0)
        };
        let count = self.known().count() as f64;
        let mean = self.known().map(error).sum::<f64>() / count;
        let square = self.known().map(|pixel| error(pixel).powi(2)).sum::<f64>() / count;
        let [trace, sum, squares] = self.scatter(&map);
        // Four standard errors; six of the mean square, which a few patterns may make.
        assert!(mean.abs() <= 4.0 * sum.sqrt() / count, "the map is off by {mean}");
        let limit = trace / count + 6.0 * (2.0 * squares).sqrt() / count;
        assert!(square <= limit, "the map is off by {} rms", square.sqrt());
        // It says so itself, as far as so many draws tell their own scatter.
        let draws = map.draws as f64;
        let stated = map.exactness / (trace / count).sqrt();
        assert!((stated - 1.0).abs() <= 4.0 / draws.sqrt(), "{stated}");
        assert!(map.exactness <= EXACTNESS || draws >= MOST_DRAWS);
    }

    /// The trace of C, the sum of its elements, and that of their squares.
    fn scatter(&self, map: &ErrorMap) -> [f64; 3] {
        let Covariance { pixels, drawn, followed, .. } = &self.covariance;
        let element = |p: usize, q: usize| {
            let size = self.covariance.std(p) * self.covariance.std(q);
            let squares = drawn[p * pixels + q].powi(2) - followed[p * pixels + q].powi(2);
            squares / size.powi(2) / (2.0 * map.draws as f64)
        };
        let pairs = || self.known().flat_map(|p| self.known().map(move |q| (p, q)));
        [
            self.known().map(|p| element(p, p)).sum(),
            pairs().map(|(p, q)| element(p, q)).sum(),
            pairs().map(|(p, q)| element(p, q).powi(2)).sum(),
        ]
    }
}

fn noisy(shape: [usize; 2], shifts: &[[f64; 2]]) -> Simulation {
    Simulation::new(shape, shifts).with_noise(1e-3, 3)
}

fn given(shifts: &[[f64; 2]], degrees: &[i64]) -> Experiment {
    noisy(SMALL, shifts).with_flux(&DRIFT).turned(degrees).experiment()
}

/// Both with even weights, and with uneven ones and gaps.
fn both(experiment: Experiment) -> [Experiment; 2] {
    [experiment.clone(), experiment.uneven()]
}

fn refined(noise: f64, std: &[[f64; 2]], degrees: &[i64]) -> Experiment {
    let simulation = noisy(LONG, &BETWEEN).with_noise(noise, 3).turned(degrees);
    Simulation { beam: rolling, ..simulation }.experiment().measured_to(std)
}

/// A beam by which shifts cannot be refined.
fn considered() -> Experiment {
    let simulation = Simulation { beam: smooth, ..noisy(SMALL, &BETWEEN) };
    simulation.experiment().measured_to(&[
        [2e-3; 2],
        [1e-3; 2],
        [0.0, 1e-3],
        [1e-3; 2],
        [3e-3, 1e-3],
    ])
}

fn check_all_functionals(experiments: impl IntoIterator<Item = Experiment>) {
    for experiment in experiments {
        let case = Case::new(experiment);
        case.check_functionals(&case.functionals());
    }
}

#[test]
fn functionals_of_whole_pixels() {
    check_all_functionals(both(noisy([4, 5], &CROSS).experiment()));
    check_all_functionals(
        [[0; 5], TURNED].into_iter().flat_map(|degrees| both(given(&CROSS, &degrees))),
    );
}

#[test]
fn functionals_of_given_fluxes() {
    check_all_functionals(
        [[0; 5], TURNED].into_iter().flat_map(|degrees| both(given(&BETWEEN, &degrees))),
    );
}

#[test]
fn functionals_of_free_fluxes() {
    let cases = [
        (CROSS, [0; 5]),
        (CROSS, [270; 5]),
        (CROSS, TURNED),
        (BETWEEN, [90; 5]),
        (BETWEEN, TURNED),
    ];
    for (shifts, degrees) in cases {
        check_all_functionals(both(given(&shifts, &degrees).with_lamp(Lamp::Free)));
    }
}

#[test]
fn a_tilt_that_a_weak_exposure_alone_determines() {
    // The others leave it to the fluxes. A half turn at whole shifts leaves two parts, whose ratio no dense algebra knows.
    for (shifts, turned) in [(CROSS, 90), (BETWEEN, 90), (BETWEEN, 180)] {
        for variance in [1e-4, 1e-2] {
            let noise = Noise::Exposures(vec![1e-6, 1e-6, 1e-6, 1e-6, variance]);
            let experiment = Experiment { noise, ..given(&shifts, &[0, 0, 0, 0, turned]) };
            let case = Case::new(experiment.with_lamp(Lamp::Free));
            let [rows, cols] = SMALL;
            let of_row = |pixel: usize| (pixel / cols) as f64 - (rows - 1) as f64 / 2.0;
            case.check_functionals(&[(0..rows * cols).map(of_row).collect()]);
            case.check_functionals(&case.functionals());
        }
    }
}

#[test]
fn patterns_that_a_light_exposure_alone_determines() {
    // Without the last, rows are compared at one distance only.
    for lamp in [Lamp::Known, Lamp::Free] {
        for variance in [1e-4, 1e-2, 1.0] {
            let noise = Noise::Exposures(vec![1e-6, 1e-6, 1e-6, 1e-6, variance]);
            let experiment = Experiment { noise, ..noisy(LONG, &CROSS).experiment() };
            let case = Case::new(experiment.with_lamp(lamp.clone()));
            // Of eigenvalues of 1e-6 single precision leaves functionals 3 digits, more than draws need.
            if variance < 0.1 {
                case.check_functionals(&case.functionals());
            }
            case.check_map();
        }
    }
}

#[test]
fn functionals_of_fluxes_with_a_prior() {
    // Between pixels the penalty resists the tilt that a prior leaves open, which no error bar knows.
    let std = vec![3e-4, 2e-4, 4e-4, 3e-4, 3e-4];
    for (shifts, degrees) in [(CROSS, [0; 5]), (CROSS, [90; 5]), (CROSS, TURNED), (BETWEEN, TURNED)]
    {
        check_all_functionals(both(given(&shifts, &degrees).with_lamp(Lamp::Prior(std.clone()))));
    }
    let unknown = Experiment { noise: Noise::Unknown, ..given(&CROSS, &[0; 5]) };
    check_all_functionals([unknown.with_lamp(Lamp::Prior(std))]);
}

#[test]
fn functionals_of_a_drift_linear_in_time() {
    let lamp = Lamp::Linear(TIMES.to_vec());
    for (shifts, degrees) in
        [(CROSS, [0; 5]), (CROSS, [270; 5]), (CROSS, TURNED), (BETWEEN, TURNED)]
    {
        check_all_functionals(both(given(&shifts, &degrees).with_lamp(lamp.clone())));
    }
    let raster = [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]];
    for degrees in [0, 90] {
        let experiment = noisy(SMALL, &raster).turned(&[degrees; 4]).experiment();
        check_all_functionals(both(experiment.with_lamp(Lamp::Linear(vec![0.0, 1.0, 2.0, 3.0]))));
    }
}

#[test]
fn functionals_and_offsets_at_two_levels() {
    for (shifts, degrees, lamp) in
        [(CROSS, [0; 5], Lamp::Known), (BETWEEN, TURNED, Lamp::Known), (CROSS, [0; 5], Lamp::Free)]
    {
        let experiment = noisy(SMALL, &shifts).turned(&degrees).at_two_levels().experiment();
        let experiment = if lamp == Lamp::Free { experiment.with_lamp(lamp) } else { experiment };
        let case = Case::new(experiment);
        case.check_functionals(&case.functionals());
        let [along, alone] = offset_variances(&case.experiment, &case.answer, 1).unwrap();
        case.check_ratio(along / case.covariance.along);
        // Sums of ten terms, in a determinant that loses ten times as much.
        assert!((alone / case.covariance.alone - 1.0).abs() < 1e3 * f64::EPSILON);
    }
}

fn check_refined(std: &[[f64; 2]], degrees: &[i64]) {
    // What slopes of noise feign of S, which dense algebra takes for structure, goes with the variance: at 1e-4
    // it was 6e-6 of S.
    for experiment in both(refined(1e-5, std, degrees)) {
        let case = Case::new(experiment);
        assert!(case.answer.refined);
        case.check_functionals(&case.functionals());
        case.check_shifts();
    }
}

#[test]
fn functionals_and_shifts_after_refining() {
    // Priors that know the shifts about as well as the beam does.
    let std = [[0.0; 2], [3e-5; 2], [1e-5, 3e-5], [3e-5; 2], [2e-5; 2]];
    check_refined(&std, &[0; 5]);
    check_refined(&std, &[0, 90, 180, 0, 0]);
}

/// With the noise of a dark: at whole pixels, and jointly between pixels, with free fluxes and refined
/// shifts.
fn with_dark() -> Vec<Experiment> {
    let std = [[0.0; 2], [3e-4; 2], [1e-4, 3e-4], [3e-4; 2], [2e-4; 2]];
    let fractions = noisy(SMALL, &BETWEEN).with_flux(&DRIFT).turned(&TURNED);
    let mut cases: Vec<Experiment> = [[0; 5], TURNED].map(|turns| given(&CROSS, &turns)).into();
    cases.push(fractions.experiment());
    cases.push(fractions.experiment().with_lamp(Lamp::Free));
    cases.push(refined(1e-4, &std, &[0; 5]));
    cases.push(considered());
    let dark = cases.into_iter().map(Experiment::with_dark);
    dark.flat_map(both).collect()
}

#[test]
fn functionals_and_shifts_with_the_noise_of_a_dark() {
    for experiment in with_dark() {
        let case = Case::new(experiment);
        case.check_functionals(&case.functionals());
        if case.answer.refined {
            case.check_shifts();
        }
    }
}

#[test]
fn maps_with_the_noise_of_a_dark() {
    for experiment in with_dark().into_iter().step_by(2) {
        Case::new(experiment).check_map();
    }
}

#[test]
fn the_noise_of_a_dark_adds_to_the_misfit() {
    for experiment in with_dark() {
        let case = Case::new(experiment);
        let found = misfit_by_dark(&case.experiment, &case.answer, 1).unwrap();
        let [mean, scatter] = case.covariance.misfit;
        let standard_error = (scatter / DRAWS_OF_MISFIT).sqrt();
        // Little need not be exact. Of more, a search may lack a share of what the beam follows, which
        // is at most as large as the rest.
        let negligible = NEGLIGIBLE * case.known().count() as f64;
        let inexact = if mean <= negligible { negligible } else { LACK * mean };
        assert!((found - mean).abs() <= 4.0 * standard_error + inexact, "{found} {mean}");
        if mean <= negligible {
            assert!(found >= mean - 4.0 * standard_error, "an upper limit: {found} {mean}");
        }
    }
}

#[test]
fn a_dark_is_no_noise_of_a_fit_with_offsets() {
    let experiment = noisy(SMALL, &BETWEEN).at_two_levels().experiment();
    let plain = Case::new(experiment.clone());
    let found = Case::new(experiment.with_dark());
    let [a, b] = [&plain, &found]
        .map(|case| variances(&case.experiment, &case.answer, &plain.functionals(), 1).unwrap());
    assert_eq!(a, b);
    assert_eq!(misfit_by_dark(&found.experiment, &found.answer, 1).unwrap(), 0.0);
}

#[test]
fn functionals_of_shifts_that_are_wrong_by_their_prior() {
    for experiment in both(considered()) {
        let case = Case::new(experiment);
        assert!(!case.answer.refined);
        case.check_functionals(&case.functionals());
    }
}

#[test]
fn maps_of_whole_pixels() {
    for experiment in both(noisy([4, 5], &CROSS).experiment()) {
        Case::new(experiment).check_map();
    }
    for degrees in [[0; 5], TURNED] {
        Case::new(given(&CROSS, &degrees).uneven()).check_map();
    }
}

#[test]
fn maps_of_free_fluxes_and_drifts() {
    Case::new(given(&CROSS, &[90; 5]).with_lamp(Lamp::Free).uneven()).check_map();
    Case::new(given(&CROSS, &[0; 5]).with_lamp(Lamp::Linear(TIMES.to_vec()))).check_map();
}

#[test]
fn maps_of_fluxes_with_a_prior() {
    let std = vec![3e-4, 2e-4, 4e-4, 3e-4, 3e-4];
    for degrees in [[0; 5], TURNED] {
        Case::new(given(&CROSS, &degrees).with_lamp(Lamp::Prior(std.clone())).uneven()).check_map();
    }
}

#[test]
fn a_map_of_fractional_shifts_with_all_rotations() {
    Case::new(given(&BETWEEN, &TURNED).uneven()).check_map();
}

#[test]
fn a_map_at_two_levels() {
    let experiment = noisy(SMALL, &BETWEEN).at_two_levels().experiment();
    Case::new(experiment.uneven()).check_map();
}

#[test]
fn a_map_after_refining() {
    Case::new(refined(1e-4, &SHIFT_STD, &[0; 5])).check_map();
}

#[test]
fn a_map_of_shifts_that_are_wrong_by_their_prior() {
    Case::new(considered()).check_map();
}

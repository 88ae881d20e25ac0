//! The joint fit against dense algebra, and on measurements whose truth is known.

use crate::common::{Answer, Experiment, Lamp, Noise, Options, fit};
use crate::dense::covariance::Covariance;
use crate::dense::gauge::Gauge;
use crate::dense::minimum::{Minimum, apart};
use crate::simulation::{
    BETWEEN, CROSS, DRIFT, LONG, SHIFT_STD, SMALL, Simulation, TIMES, TURNED, cubic, even, rolling,
};

const TOLERANCE: f64 = 1e-10;

/// What every joint fit must do, with even weights, and with uneven ones and gaps.
fn check(experiment: &Experiment) {
    check_one(experiment);
    check_one(&experiment.clone().uneven());
}

fn check_one(experiment: &Experiment) {
    let answer = fit(experiment, Options::to(TOLERANCE)).unwrap();
    assert!(answer.is_joint() && answer.converged, "{:?}", answer.history.last());
    assert!(answer.few.is_empty(), "F of dense algebra has all pixels");
    let used = experiment.clone().without(&answer.lost);
    let beside = Minimum::beside(&used, &answer, TOLERANCE).unwrap();
    let Minimum { step, slope, allowed, .. } = beside;
    assert!(step <= allowed, "a Gauss-Newton step moves M by {step:e}, above {allowed:e}");
    assert!(slope <= allowed, "F has a slope of {slope:e} of its terms, above {allowed:e}");
    check_objective(&answer, &beside);
    check_history(experiment, &answer);
}

/// F as it is reported is that of the answer. Residuals are some thousandth of the values, so that a thousand
/// roundings of some hundred terms are in them.
fn check_objective(answer: &Answer, beside: &Minimum) {
    let rounding = 1e5 * f64::EPSILON;
    let last = answer.history.last().unwrap().objective;
    assert!((answer.misfit / beside.misfit - 1.0).abs() <= rounding);
    assert!((last / beside.objective - 1.0).abs() <= beside.unsettled + rounding);
}

/// F never rises beyond rounding: from the third look on, since before that the weight of the penalty and the
/// unknown variance follow M, and from the fourth where shifts move, with which cells come into the penalty.
fn check_history(experiment: &Experiment, answer: &Answer) {
    let settled = if answer.refined { 3 } else { 2 };
    let pixels = (experiment.shape[0] * experiment.shape[1]) as f64;
    let weights: f64 = match &experiment.noise {
        Noise::Unknown => experiment.frames.len() as f64,
        Noise::Exposures(v) | Noise::Relative(v) => v.iter().map(|v| pixels / v).sum(),
        Noise::Measurements(variances) => variances.iter().map(|v| 1.0 / v).sum(),
    };
    let brightest = experiment.frames.iter().fold(0.0_f64, |top, y| top.max(y.abs()));
    // Of a sum, and of residuals that are rounding alone.
    let of_residuals = weights * (4.0 * f64::EPSILON * brightest).powi(2);
    for pair in answer.history.get(settled..).unwrap_or_default().windows(2) {
        let rounding = 1e-12 * pair[0].objective + of_residuals;
        assert!(pair[1].objective <= pair[0].objective + rounding, "{:?}", answer.history);
    }
}

fn noisy(shape: [usize; 2], shifts: &[[f64; 2]]) -> Simulation {
    Simulation::new(shape, shifts).with_noise(1e-3, 3)
}

#[test]
fn fractional_shifts() {
    check(&noisy(SMALL, &BETWEEN).with_flux(&DRIFT).experiment());
}

#[test]
fn fractional_shifts_with_all_rotations() {
    check(&noisy(SMALL, &BETWEEN).with_flux(&DRIFT).turned(&TURNED).experiment());
}

#[test]
fn a_sensor_of_several_bands_of_rows() {
    let tall = noisy([70, 6], &BETWEEN).with_flux(&DRIFT).turned(&[0, 0, 180, 0, 0]);
    check_one(&Simulation { beam: even, ..tall }.experiment().uneven());
}

#[test]
fn free_fluxes_with_a_turned_exposure() {
    for shifts in [CROSS, BETWEEN] {
        let simulation = noisy(SMALL, &shifts).with_flux(&DRIFT).turned(&TURNED);
        check(&simulation.experiment().with_lamp(Lamp::Free));
    }
}

#[test]
fn free_fluxes_without_one() {
    for (shifts, degrees) in [(CROSS, 0), (BETWEEN, 0), (BETWEEN, 90), (CROSS, 180), (CROSS, 270)] {
        let simulation = noisy(SMALL, &shifts).with_flux(&DRIFT).turned(&[degrees; 5]);
        check(&simulation.experiment().with_lamp(Lamp::Free));
    }
}

#[test]
fn fluxes_with_a_prior() {
    let std = vec![1e-2, 5e-3, 2e-2, 1e-2, 1e-2];
    for (shifts, degrees) in
        [(CROSS, [0; 5]), (BETWEEN, [0; 5]), (CROSS, TURNED), (BETWEEN, TURNED)]
    {
        let simulation = noisy(SMALL, &shifts).with_flux(&DRIFT).turned(&degrees);
        let experiment = simulation.experiment();
        check(&experiment.clone().with_lamp(Lamp::Prior(std.clone())));
        let unknown = Experiment { noise: Noise::Unknown, ..experiment };
        check(&unknown.clone().with_lamp(Lamp::Prior(std.clone())));
        let relative = Noise::Relative(vec![3e4, 2e4, 1e4, 2e4, 3e4]);
        check(&Experiment { noise: relative, ..unknown }.with_lamp(Lamp::Prior(std.clone())));
    }
}

#[test]
fn equal_variances_in_an_unknown_unit_are_unknown_ones() {
    let simulation = noisy(LONG, &BETWEEN).with_noise(1e-4, 3);
    let simulation = Simulation { beam: rolling, ..simulation };
    let experiment = simulation.experiment().measured_to(&SHIFT_STD);
    let with = |noise| fit(&Experiment { noise, ..experiment.clone() }, Options::to(1e-8)).unwrap();
    let (unknown, relative) = (with(Noise::Unknown), with(Noise::Relative(vec![1.0; 5])));
    assert!(unknown.refined && relative.converged);
    assert_eq!(unknown.sensitivity, relative.sensitivity);
    assert_eq!(unknown.shifts, relative.shifts);
    // Known, they say 1e8 times less than what is known of the shifts.
    assert_ne!(with(Noise::Exposures(vec![1.0; 5])).shifts, relative.shifts);
}

#[test]
fn a_drift_linear_in_time() {
    for (shifts, degrees) in
        [(CROSS, [0; 5]), (BETWEEN, [0; 5]), (BETWEEN, [90; 5]), (CROSS, TURNED)]
    {
        let simulation = noisy(SMALL, &shifts).with_flux(&DRIFT).turned(&degrees);
        check(&simulation.experiment().with_lamp(Lamp::Linear(TIMES.to_vec())));
    }
}

#[test]
fn a_drift_that_is_affine_in_the_shifts() {
    let raster = [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]];
    let experiment = noisy(SMALL, &raster).experiment();
    check(&experiment.with_lamp(Lamp::Linear(vec![0.0, 1.0, 2.0, 3.0])));
}

#[test]
fn refined_shifts() {
    for degrees in [[0; 5], [0, 90, 180, 0, 0]] {
        let simulation = noisy(LONG, &BETWEEN).with_noise(1e-4, 3).turned(&degrees);
        let simulation = Simulation { beam: rolling, ..simulation };
        let experiment = simulation.experiment().measured_to(&SHIFT_STD);
        check(&experiment);
        check_shifts(&experiment, &simulation.shifts);
    }
}

/// Refined shifts are off the truth by what their standard deviations say, less what all have in common: the
/// mean by the prior's weights. Ten values seldom hold one beyond four of them.
fn check_shifts(experiment: &Experiment, truth: &[[f64; 2]]) {
    let answer = fit(experiment, Options::to(TOLERANCE)).unwrap();
    let variances = Covariance::of(experiment, &answer, 1.0).unwrap().of_shifts;
    assert!(answer.refined);
    // The first one is exact, so that it is the mean.
    let off = |shifts: &[[f64; 2]], k: usize, axis: usize| {
        (shifts[k][axis] - shifts[0][axis]) - (truth[k][axis] - truth[0][axis])
    };
    for (k, axis) in (1..truth.len()).flat_map(|k| [(k, 0), (k, 1)]) {
        let score = off(&answer.shifts, k, axis) / variances[k][axis].sqrt();
        assert!(
            score.abs() < 4.0,
            "shift {k} along axis {axis} is off by {score} of its deviation"
        );
    }
}

#[test]
fn offsets_at_two_known_levels() {
    for (shifts, degrees) in [(CROSS, [0; 5]), (BETWEEN, [0; 5]), (BETWEEN, TURNED)] {
        check(&noisy(SMALL, &shifts).turned(&degrees).at_two_levels().experiment());
    }
}

#[test]
fn offsets_at_two_unknown_levels() {
    check_one(&noisy(SMALL, &CROSS).at_two_levels().experiment().with_lamp(Lamp::Free));
}

/// Noise-free exposures of a beam of third degree: the spline is exact and the penalty costs nothing, so that
/// the truth is the minimum, F being 0 there. M may be off the truth by what an answer may be off the minimum, and
/// by what the penalty does where a tilt that the fit has left out bends the beam.
fn exact(shifts: &[[f64; 2]], degrees: &[i64]) -> Simulation {
    Simulation::seeing(cubic, SMALL, shifts).turned(degrees)
}

fn allowed(simulation: &Simulation) -> f64 {
    ((simulation.shape[0] * simulation.shape[1]) as f64).sqrt() * TOLERANCE
}

/// The answer, with M that of the simulation.
fn true_answer(simulation: &Simulation, experiment: &Experiment) -> Answer {
    let answer = fit(experiment, Options::to(TOLERANCE)).unwrap();
    let beside = Minimum::beside(experiment, &answer, TOLERANCE).unwrap();
    let off = apart(&answer.sensitivity, &simulation.sensitivity());
    assert!(answer.converged && off <= beside.of_penalty + beside.allowed, "M is off by {off:e}");
    answer
}

#[test]
fn the_truth_comes_back_between_pixels() {
    for degrees in [[0; 5], TURNED] {
        let simulation = exact(&BETWEEN, &degrees).with_flux(&DRIFT);
        true_answer(&simulation, &simulation.experiment());
        true_answer(&simulation, &simulation.experiment().uneven());
    }
}

/// ln c of mean 0 is that of the truth. A tilt of M that is off by so much across the sensor is a drift by no
/// more.
fn check_fluxes(simulation: &Simulation, answer: &Answer, truth: &[f64]) {
    let mean = truth.iter().sum::<f64>() / truth.len() as f64;
    for (c, log) in answer.flux.iter().zip(truth) {
        assert!((c.ln() - (log - mean)).abs() <= allowed(simulation), "{:?}", answer.flux);
    }
}

#[test]
fn true_fluxes_come_back_where_they_are_determined() {
    let logs: Vec<f64> = TIMES.iter().map(|t| 0.01 * t).collect();
    let drift: Vec<f64> = logs.iter().map(|log| log.exp()).collect();
    let linear = Lamp::Linear(TIMES.to_vec());
    let cases = [
        (CROSS, [0; 5], &linear),
        (CROSS, [90; 5], &linear),
        (CROSS, TURNED, &linear),
        (BETWEEN, TURNED, &linear),
        (CROSS, TURNED, &Lamp::Free),
        (BETWEEN, TURNED, &Lamp::Free),
    ];
    for (shifts, degrees, lamp) in cases {
        let simulation = exact(&shifts, &degrees).with_flux(&drift);
        let answer = true_answer(&simulation, &simulation.experiment().with_lamp(lamp.clone()));
        check_fluxes(&simulation, &answer, &logs);
    }
}

#[test]
fn free_fluxes_leave_the_tilt_to_the_gauge() {
    for degrees in [0, 90, 180, 270] {
        let simulation = exact(&CROSS, &[degrees; 5]).with_flux(&DRIFT);
        let experiment = simulation.experiment().with_lamp(Lamp::Free);
        let answer = fit(&experiment, Options::to(TOLERANCE)).unwrap();
        assert!(answer.leaves_tilt && answer.converged);
        // The truth without its slope: M·exp(−s·u) with c·exp(−s·d).
        let truth = simulation.sensitivity();
        let gauge = Gauge::new(&experiment, &truth);
        let slope = gauge.slope(&truth.iter().map(|m| m.ln()).collect::<Vec<_>>());
        let along = |d: &[f64; 2]| slope[0] * d[0] + slope[1] * d[1];
        assert!(apart(&answer.sensitivity, &gauge.level()) <= allowed(&simulation));
        let logs = DRIFT.iter().zip(&CROSS).map(|(c, d)| c.ln() - along(d));
        check_fluxes(&simulation, &answer, &logs.collect::<Vec<_>>());
    }
}

#[test]
fn free_fluxes_may_be_far_from_those_given() {
    // Ten times dimmer, and seven times as bright: instead of what is affine in the shifts, M would be tilted by
    // orders of magnitude.
    let flux = [1.0, 0.1, 2.0, 0.3, 7.0];
    for (shifts, degrees) in
        [(CROSS, [0; 5]), (CROSS, TURNED), (BETWEEN, [0; 5]), (BETWEEN, TURNED)]
    {
        let simulation = noisy(SMALL, &shifts).with_flux(&flux).turned(&degrees);
        let experiment = simulation.experiment();
        let known = Experiment { lamp: Lamp::Free, ..experiment };
        let unknown = Experiment { flux: vec![1.0; 5], ..known.clone() };
        let [near, far] =
            [&known, &unknown].map(|given| fit(given, Options::to(TOLERANCE)).unwrap());
        assert!(near.converged && far.converged, "{:?}", far.history.last());
        // A tilt of the beam changes the penalty: M differs by no more than the penalty moves it.
        let Minimum { of_penalty, .. } = Minimum::beside(&known, &near, TOLERANCE).unwrap();
        assert!(of_penalty < 1e-3, "above the noise");
        let most = of_penalty + 2.0 * allowed(&simulation);
        let off = apart(&far.sensitivity, &near.sensitivity);
        assert!(off <= most, "{off:e} above {most:e}");
        for (far, near) in far.flux.iter().zip(&near.flux) {
            assert!((far / near - 1.0).abs() <= most);
        }
    }
}

#[test]
fn a_weak_exposure_costs_few_passes_between_pixels() {
    // Where the penalty outweighs cells they grow as one over the root of the weight: 3 and 10 times as many.
    let shifts = [[0.0, 0.0], [0.4, 11.0], [0.0, 19.4], [11.4, 0.4], [19.2, 0.0]];
    let passes = |flux: &[f64], degrees: &[i64]| {
        let simulation = Simulation::seeing(even, [100, 120], &shifts).with_noise(1e-3, 3);
        let experiment = simulation.with_flux(flux).turned(degrees).experiment();
        let answer = fit(&experiment, Options::to(1e-6)).unwrap();
        assert!(answer.converged, "{:?}", answer.history.last());
        answer.history.last().unwrap().passes
    };
    for (degrees, places) in [([0; 5], &[0, 2, 4][..]), ([0, 0, 0, 0, 180], &[4])] {
        let most = 2 * passes(&[1.0; 5], &degrees);
        for light in [0.1, 0.01] {
            for &place in places {
                let mut flux = [1.0; 5];
                flux[place] = light;
                assert!(passes(&flux, &degrees) <= most, "{flux:?}, {degrees:?}");
            }
        }
    }
}

#[test]
fn a_pixel_without_an_offset_does_not_count_for_the_slope_of_the_gauge() {
    let experiment = noisy(SMALL, &CROSS).at_two_levels().experiment().with_lamp(Lamp::Free);
    let (pixels, lost) = (SMALL[0] * SMALL[1], 10);
    // One measurement of a pixel is left, which determines no offset.
    let mask = (0..experiment.frames.len()).map(|i| i >= pixels && i % pixels == lost).collect();
    let experiment = Experiment { mask, ..experiment };
    let answer = fit(&experiment, Options::to(TOLERANCE)).unwrap();
    assert!(answer.leaves_tilt && answer.sensitivity[lost].is_nan());
    let known = answer.sensitivity.iter().map(|m| if m.is_finite() { *m } else { 0.0 });
    let logs: Vec<f64> =
        answer.sensitivity.iter().map(|m| if m.is_finite() { m.ln() } else { 0.0 }).collect();
    let slope = Gauge::new(&experiment, &known.collect::<Vec<_>>()).slope(&logs);
    // Sums of 71 logarithms of up to a tenth, of a normal matrix whose condition is some thousand.
    assert!(slope.iter().all(|slope| slope.abs() < 1e4 * f64::EPSILON), "{slope:?}");
}

#[test]
fn a_prior_that_is_true_changes_nothing() {
    for (shifts, degrees) in [(CROSS, [0; 5]), (BETWEEN, [180; 5]), (CROSS, TURNED)] {
        let simulation = exact(&shifts, &degrees).with_flux(&DRIFT);
        let experiment = Experiment { lamp: Lamp::Prior(vec![1e-3; 5]), ..simulation.experiment() };
        let answer = true_answer(&simulation, &experiment);
        for (c, given) in answer.flux.iter().zip(DRIFT) {
            assert!((c / given - 1.0).abs() <= allowed(&simulation));
        }
    }
}

#[test]
fn true_offsets_come_back() {
    for (shifts, degrees) in [(CROSS, [0; 5]), (BETWEEN, TURNED)] {
        let simulation = exact(&shifts, &degrees).at_two_levels();
        let answer = true_answer(&simulation, &simulation.experiment());
        for (offset, truth) in answer.offset.unwrap().iter().zip(simulation.offsets()) {
            // A gain that is off by so much makes an offset that is off by so much of the light.
            assert!((offset - truth).abs() <= 2.0 * allowed(&simulation));
        }
    }
}

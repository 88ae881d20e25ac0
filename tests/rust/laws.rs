//! Laws that hold whatever the measurements are: of the gauge, of symmetry, and of the number of workers.

use crate::common::{Answer, Experiment, Lamp, Method, Noise, Options, fit};
use crate::dense::gauge::Gauge;
use crate::dense::lamp::is_turned;
use crate::dense::minimum::{Minimum, apart};
use crate::simulation::{BETWEEN, CROSS, DRIFT, SMALL, Simulation, TIMES, TURNED, place};

const TOLERANCE: f64 = 1e-8;

fn simulated(shifts: &[[f64; 2]], degrees: &[i64]) -> Experiment {
    let simulation = Simulation::new(SMALL, shifts).with_noise(1e-3, 3).with_flux(&DRIFT);
    simulation.turned(degrees).experiment().uneven()
}

/// Experiments of all kinds, but those whose shifts are refined.
fn kinds() -> Vec<(Method, Experiment)> {
    let joint =
        |experiment: Experiment, lamp: Lamp| (Method::Multiscale, experiment.with_lamp(lamp));
    let offsets = Simulation::new(SMALL, &CROSS).with_noise(1e-3, 3).at_two_levels();
    let unknown = Experiment { noise: Noise::Unknown, ..simulated(&CROSS, &[0; 5]) };
    vec![
        (Method::Multiscale, simulated(&CROSS, &TURNED)),
        (Method::CoordinateDescent, simulated(&CROSS, &[0; 5])),
        (Method::Multiscale, simulated(&BETWEEN, &[0, 90, 0, 270, 180])),
        joint(simulated(&BETWEEN, &[0; 5]), Lamp::Free),
        joint(simulated(&CROSS, &[90; 5]), Lamp::Free),
        joint(simulated(&CROSS, &[0; 5]), Lamp::Linear(TIMES.to_vec())),
        joint(unknown, Lamp::Prior(vec![1e-2; 5])),
        (Method::Multiscale, offsets.experiment().uneven()),
    ]
}

/// The answer, and how far its M may be off the minimum.
fn answer(method: Method, experiment: &Experiment) -> (Answer, f64) {
    let answer = fit(experiment, Options { method, ..Options::to(TOLERANCE) }).unwrap();
    assert!(answer.converged, "{experiment:?}");
    let allowed = Minimum::beside(experiment, &answer, TOLERANCE).unwrap().allowed;
    (answer, allowed)
}

/// Fits all kinds of experiments and what `change` makes of them: M of the second, brought `back`, must be that of
/// the first, and the fluxes in their order too. Each of the two may be off the minimum.
fn check(
    change: impl Fn(&Experiment) -> Experiment,
    back: impl Fn(&Experiment, &[f64]) -> Vec<f64>,
    order: [usize; 5],
) {
    for (method, experiment) in kinds() {
        let ((first, allowed), (second, too)) =
            (answer(method, &experiment), answer(method, &change(&experiment)));
        let allowed = allowed + too;
        let off = apart(&first.sensitivity, &back(&experiment, &second.sensitivity));
        assert!(off <= allowed, "M is off by {off:e}: {experiment:?}");
        let levels = second.flux.chunks_exact(order.len()).enumerate();
        let fluxes = levels.flat_map(|(level, flux)| {
            order.iter().enumerate().map(move |(to, from)| (level * order.len() + from, flux[to]))
        });
        for (k, flux) in fluxes {
            assert!((flux / first.flux[k] - 1.0).abs() <= allowed, "{:?}", second.flux);
        }
    }
}

const IN_ORDER: [usize; 5] = [0, 1, 2, 3, 4];

/// Each image of a stack as `back` has it.
fn images<T: Copy>(
    experiment: &Experiment,
    values: &[T],
    source: impl Fn(usize) -> usize,
) -> Vec<T> {
    let pixels = experiment.shape[0] * experiment.shape[1];
    (0..values.len()).map(|at| values[at / pixels * pixels + source(at % pixels)]).collect()
}

/// An experiment whose image values at each pixel are those of `source`.
fn rearranged(experiment: &Experiment, source: impl Fn(usize) -> usize) -> Experiment {
    let noise = match &experiment.noise {
        Noise::Measurements(v) => Noise::Measurements(images(experiment, v, &source)),
        other => other.clone(),
    };
    let frames = images(experiment, &experiment.frames, &source);
    let mask = images(experiment, &experiment.mask, &source);
    Experiment { frames, noise, mask, ..experiment.clone() }
}

#[test]
fn the_scale_of_the_measurements_is_that_of_the_beam() {
    const FACTOR: f64 = 300.0;
    let scaled = |experiment: &Experiment| {
        let frames = experiment.frames.iter().map(|y| FACTOR * y).collect();
        let noise = match &experiment.noise {
            Noise::Measurements(v) => {
                Noise::Measurements(v.iter().map(|v| FACTOR * FACTOR * v).collect())
            }
            other => other.clone(),
        };
        Experiment { frames, noise, ..experiment.clone() }
    };
    check(scaled, |_, image| image.to_vec(), IN_ORDER);
    for (method, experiment) in kinds() {
        let ((first, allowed), (second, too)) =
            (answer(method, &experiment), answer(method, &scaled(&experiment)));
        // Of the brightest cell, which many measurements see.
        let brightest = |answer: &Answer| answer.beam.iter().fold(0.0_f64, |top, l| top.max(*l));
        let ratio = brightest(&second) / brightest(&first) / FACTOR;
        assert!((ratio - 1.0).abs() <= allowed + too, "{ratio}");
        if let Some(offset) = &first.offset {
            for (o, scaled) in offset.iter().zip(second.offset.iter().flatten()) {
                assert!((scaled / FACTOR - o).abs() <= brightest(&first) * (allowed + too));
            }
        }
    }
}

#[test]
fn the_order_of_the_exposures_does_not_matter() {
    const ORDER: [usize; 5] = [3, 0, 4, 1, 2];
    let change = |experiment: &Experiment| {
        let pixels = experiment.shape[0] * experiment.shape[1];
        let from = |k: usize| k / 5 * 5 + ORDER[k % 5];
        let each = |values: &[f64]| (0..values.len()).map(|k| values[from(k)]).collect::<Vec<_>>();
        let stack = |at: usize| from(at / pixels) * pixels + at % pixels;
        let count = experiment.shifts.len();
        Experiment {
            frames: (0..experiment.frames.len()).map(|at| experiment.frames[stack(at)]).collect(),
            mask: (0..experiment.mask.len()).map(|at| experiment.mask[stack(at)]).collect(),
            noise: match &experiment.noise {
                Noise::Measurements(v) => {
                    Noise::Measurements((0..v.len()).map(|at| v[stack(at)]).collect())
                }
                other => other.clone(),
            },
            shifts: (0..count).map(|k| experiment.shifts[from(k)]).collect(),
            degrees: (0..count).map(|k| experiment.degrees[from(k)]).collect(),
            flux: each(&experiment.flux),
            lamp: match &experiment.lamp {
                Lamp::Linear(times) => Lamp::Linear(each(times)),
                Lamp::Prior(std) => Lamp::Prior(each(std)),
                other => other.clone(),
            },
            ..experiment.clone()
        }
    };
    check(change, |_, image| image.to_vec(), ORDER);
}

#[test]
fn a_transposed_sensor_is_a_transposed_answer() {
    let turn = |degrees: &i64| (360 - degrees) % 360;
    // The pixel at (r, c) of the transposed image stands at (c, r).
    let source = |[rows, cols]: [usize; 2], at: usize| at % rows * cols + at / rows;
    let change = |experiment: &Experiment| {
        let shape = experiment.shape;
        let shifts = experiment.shifts.iter().map(|[row, col]| [*col, *row]).collect();
        let degrees =
            experiment.degrees.iter().map(|d| if d % 180 == 0 { *d } else { turn(d) }).collect();
        Experiment {
            shape: [shape[1], shape[0]],
            shifts,
            degrees,
            ..rearranged(experiment, |at| source(shape, at))
        }
    };
    let back = |experiment: &Experiment, image: &[f64]| {
        let [rows, cols] = experiment.shape;
        images(experiment, image, |at| source([cols, rows], at))
    };
    check(change, back, IN_ORDER);
}

#[test]
fn a_mirrored_sensor_is_a_mirrored_answer() {
    // Columns in reverse, and those of the beam: a quarter turn becomes the other one.
    let source = |[_, cols]: [usize; 2], at: usize| at / cols * cols + cols - 1 - at % cols;
    let change = |experiment: &Experiment| {
        let shape = experiment.shape;
        let across = shape[1] as f64 - shape[0] as f64;
        let places = experiment.shifts.iter().zip(&experiment.degrees);
        let places = places.map(|([row, col], degrees)| match degrees {
            90 | 270 => ([*row, across - col], 360 - degrees),
            other => ([*row, -col], *other),
        });
        let (shifts, degrees) = places.unzip();
        Experiment { shifts, degrees, ..rearranged(experiment, |at| source(shape, at)) }
    };
    let back = |experiment: &Experiment, image: &[f64]| {
        images(experiment, image, |at| source(experiment.shape, at))
    };
    check(change, back, IN_ORDER);
}

#[test]
fn the_gauge_is_as_it_is_said() {
    // Sums of some hundred terms of order 1, with logarithms and exponentials.
    let rounding = 1e3 * f64::EPSILON;
    for (method, experiment) in kinds() {
        let (answer, _) = answer(method, &experiment);
        let m = &answer.sensitivity;
        let mean = m.iter().sum::<f64>() / m.len() as f64;
        assert!((mean - 1.0).abs() <= rounding, "{mean}");
        if matches!(experiment.lamp, Lamp::Free | Lamp::Linear(_)) {
            let logs = answer.flux.iter().map(|c| c.ln()).sum::<f64>();
            assert!(logs.abs() <= rounding, "{logs}");
        }
        if experiment.lamp == Lamp::Free && !is_turned(&experiment) {
            let logs: Vec<f64> = m.iter().map(|m| m.ln()).collect();
            let slope = Gauge::new(&experiment, m).slope(&logs);
            assert!(slope.iter().all(|slope| slope.abs() <= rounding), "{slope:?}");
        }
        assert_eq!(answer.leaves_tilt, experiment.lamp == Lamp::Free && !is_turned(&experiment));
    }
}

#[test]
fn each_component_has_a_gauge_of_its_own() {
    // Shifts by even numbers compare pixels of even distance alone.
    let shifts = CROSS.map(|d| d.map(|d| 2.0 * d));
    let known = Simulation::new(SMALL, &shifts).with_noise(1e-3, 3).experiment();
    let joint = Experiment { lamp: Lamp::Prior(vec![1e-3; 5]), ..known.clone() };
    for (method, experiment) in [
        (Method::Multiscale, &known),
        (Method::CoordinateDescent, &known),
        (Method::Multiscale, &joint),
    ] {
        let answer = fit(experiment, Options { method, ..Options::to(TOLERANCE) }).unwrap();
        assert!(answer.converged);
        let means = component_means(experiment, &answer);
        assert!(means.len() == 4);
        // M at its closed form may be off the answer's by what that is off the minimum.
        let allowed = (answer.sensitivity.len() as f64).sqrt() * TOLERANCE;
        for mean in means {
            assert!((mean - 1.0).abs() <= allowed, "{mean}");
        }
        for (m, label) in answer.sensitivity.iter().zip(&answer.labels[0]) {
            assert_eq!(m.is_finite(), *label == 0);
        }
    }
}

/// The mean of each component's M, at the closed form Σ w c L y/Σ w c² L² from the answer's beam.
fn component_means(experiment: &Experiment, answer: &Answer) -> Vec<f64> {
    let pixels = experiment.shape[0] * experiment.shape[1];
    let light = |at: usize| {
        let (k, pixel) = (at / pixels, at % pixels);
        let u = place(experiment.shape, experiment.degrees[k], pixel);
        let [row, col] =
            [0, 1].map(|axis| (u[axis] + experiment.shifts[k][axis] + answer.origin[axis]) as i64);
        answer.flux[k] * answer.beam[row as usize * answer.beam_shape[1] + col as usize]
    };
    let m = |pixel: usize| {
        let seen = || {
            (pixel..experiment.frames.len())
                .step_by(pixels)
                .map(|at| (light(at), experiment.frames[at]))
        };
        seen().map(|(e, y)| e * y).sum::<f64>() / seen().map(|(e, _)| e * e).sum::<f64>()
    };
    let labels = &answer.labels[0];
    let count = *labels.iter().max().unwrap() + 1;
    let mean = |label: i32| {
        let members: Vec<usize> = (0..pixels).filter(|pixel| labels[*pixel] == label).collect();
        members.iter().map(|pixel| m(*pixel)).sum::<f64>() / members.len() as f64
    };
    (0..count).map(mean).collect()
}

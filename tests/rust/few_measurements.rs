//! Pixels with one or two measurements of more exposures: they follow the beam, which does not follow them. And
//! measurements that stand apart from others.

use crate::common::{Answer, Experiment, Lamp, Options, error_map, fit};
use crate::simulation::{BETWEEN, CROSS, SHIFT_STD, Simulation, even, random};

const TOLERANCE: f64 = 1e-9;
const SHAPE: [usize; 2] = [16, 40];
const PIXELS: usize = SHAPE[0] * SHAPE[1];
const NOISE: f64 = 1e-3;

/// Every tenth pixel is measured once or twice of five times, but for those at the edge, which see cells alone.
fn few(pixel: usize) -> usize {
    let [row, col] = [pixel / SHAPE[1], pixel % SHAPE[1]];
    if !(5..11).contains(&row) || !(5..35).contains(&col) {
        return 5;
    }
    match random(7, pixel) {
        number if number > 0.9 => 1,
        number if number > 0.8 => 2,
        _ => 5,
    }
}

/// Whether one of so many exposures measures a pixel that is measured so often.
const fn is_used(k: usize, pixel: usize, count: usize, times: usize) -> bool {
    (k + pixel + pixel / SHAPE[1]) % count < times
}

/// An experiment whose mask leaves so many measurements of each pixel, in exposures that differ.
fn with_few(experiment: Experiment, left: impl Fn(usize) -> usize) -> Experiment {
    let count = experiment.shifts.len();
    let used = |k: usize, pixel: usize| is_used(k, pixel, count, left(pixel));
    let mask = (0..count * PIXELS).map(|i| !used(i / PIXELS, i % PIXELS)).collect();
    Experiment { mask, ..experiment }
}

/// M over its mean in pixels with all measurements, which both answers know.
fn in_common(answer: &Answer) -> Vec<f64> {
    let known = (0..PIXELS).filter(|&pixel| few(pixel) == 5);
    let sum: f64 = known.clone().map(|pixel| answer.sensitivity[pixel]).sum();
    let mean = sum / known.count() as f64;
    answer.sensitivity.iter().map(|m| m / mean).collect()
}

#[test]
fn the_answer_of_others_is_that_without_them() {
    for (shifts, lamp, std) in [
        (BETWEEN, Lamp::Known, None),
        (BETWEEN, Lamp::Free, None),
        (CROSS, Lamp::Free, None),
        (BETWEEN, Lamp::Free, Some(SHIFT_STD)),
    ] {
        let simulation = Simulation::seeing(even, SHAPE, &shifts).with_noise(NOISE, 5);
        let mut experiment = simulation.experiment().with_lamp(lamp.clone());
        if let Some(std) = std {
            experiment = experiment.measured_to(&std);
        }
        let all = with_few(experiment.clone(), few);
        let found = fit(&all, Options::to(TOLERANCE)).unwrap();
        let none = |pixel| if few(pixel) < 5 { 0 } else { 5 };
        let others = fit(&with_few(experiment, none), Options::to(TOLERANCE)).unwrap();
        assert!(found.converged && others.converged);
        assert!((0..PIXELS).all(|pixel| found.few[pixel] == (few(pixel) < 5)));
        assert!((found.misfit / others.misfit - 1.0).abs() < 1e-6);
        assert_eq!(found.degrees_of_freedom, others.degrees_of_freedom);
        // Free fluxes leave a tilt to the gauge, which is that of all pixels.
        if found.leaves_tilt {
            continue;
        }
        for (m, other) in in_common(&found).iter().zip(in_common(&others)) {
            // Each is within its tolerance of the same minimum.
            assert!(other.is_nan() || (m / other - 1.0).abs() < 10.0 * TOLERANCE);
        }
        let truth = simulation.sensitivity();
        let std = error_map(&all, &found, 1).unwrap().std;
        let left: Vec<usize> = (0..PIXELS).filter(|&pixel| found.few[pixel]).collect();
        let z = left.iter().map(|&pixel| (found.sensitivity[pixel] - truth[pixel]) / std[pixel]);
        let square = z.map(|z| z * z).sum::<f64>() / left.len() as f64;
        // Five standard errors of the mean square of as many normal numbers.
        assert!((square - 1.0).abs() < 5.0 * (2.0 / left.len() as f64).sqrt(), "{square}");
    }
}

/// The cells that a pixel sees, turned by nothing or by half: those less than two from its place along both axes, and
/// from a place a little further on where shifts are fitted.
fn cells(
    pixel: usize,
    shift: [f64; 2],
    degrees: i64,
    fitted: bool,
) -> impl Iterator<Item = [i64; 2]> {
    let own = [pixel / SHAPE[1], pixel % SHAPE[1]];
    let [rows, cols] = [0, 1].map(|axis| {
        let place = if degrees == 0 { own[axis] } else { SHAPE[axis] - 1 - own[axis] };
        let place = place as f64 + shift[axis];
        let last = if fitted { place.floor() + 1.0 } else { place.ceil() };
        place.floor() as i64 - 1..last as i64 + 2
    });
    rows.flat_map(move |row| cols.clone().map(move |col| [row, col]))
}

/// Which measurements an experiment uses.
type Used<'u> = &'u dyn Fn(usize, usize) -> bool;

/// Whether a measurement is one of 4×4 of its exposure.
fn is_in_block(used: Used<'_>, k: usize, pixel: usize) -> bool {
    let [row, col] = [pixel / SHAPE[1], pixel % SHAPE[1]].map(|at| at as i64);
    let is_used = |row: i64, col: i64| {
        let is_inside = (0..SHAPE[0] as i64).contains(&row) && (0..SHAPE[1] as i64).contains(&col);
        is_inside && used(k, row as usize * SHAPE[1] + col as usize)
    };
    let mut corners = (row - 3..=row).flat_map(|r| (col - 3..=col).map(move |c| [r, c]));
    corners.any(|[r, c]| (0..16).all(|i| is_used(r + i / 4, c + i % 4)))
}

/// What is lost by the words of `lost.rs`, by exposure, of pixels that join no components.
fn lost(used: Used<'_>, degrees: &[i64], margin: i64) -> Vec<Vec<usize>> {
    let mut lost = vec![Vec::new(); BETWEEN.len()];
    loop {
        let is_left = |k: usize, pixel: usize| used(k, pixel) && !lost[k].contains(&pixel);
        let stays = |pixel: usize| (0..BETWEEN.len()).filter(|&k| is_left(k, pixel)).count() > 2;
        let every = || (0..BETWEEN.len()).flat_map(|k| (0..PIXELS).map(move |pixel| (k, pixel)));
        let mut seen = std::collections::HashMap::new();
        for (k, pixel) in every().filter(|&(k, pixel)| is_left(k, pixel) && stays(pixel)) {
            let count = if is_in_block(used, k, pixel) { 16 } else { 1 };
            for cell in cells(pixel, BETWEEN[k], degrees[k], margin > 0) {
                *seen.entry(cell).or_insert(0) += count;
            }
        }
        let around = |[row, col]: [i64; 2]| {
            (-margin..=margin)
                .flat_map(move |r| (-margin..=margin).map(move |c| [row + r, col + c]))
        };
        let is_open = |cell: [i64; 2]| seen.get(&cell).copied().unwrap_or(0) < 16;
        let is_lost = |k: usize, pixel: usize| {
            used(k, pixel)
                && !(is_in_block(used, k, pixel) && stays(pixel))
                && cells(pixel, BETWEEN[k], degrees[k], margin > 0).flat_map(around).any(is_open)
        };
        let found: Vec<Vec<usize>> = (0..BETWEEN.len())
            .map(|k| {
                let is_gone = |&pixel: &usize| lost[k].contains(&pixel) || is_lost(k, pixel);
                (0..PIXELS).filter(is_gone).collect()
            })
            .collect();
        if found == lost {
            return lost;
        }
        lost = found;
    }
}

#[test]
fn pixels_measured_once_are_lost_where_they_alone_see_cells() {
    // The last columns see cells behind those of the others.
    let times = |pixel: usize| if pixel % SHAPE[1] < 34 { 5 } else { 1 };
    let used = |k: usize, pixel: usize| is_used(k, pixel, 5, times(pixel));
    for std in [None, Some(SHIFT_STD)] {
        let gone = lost(&used, &[0; 5], i64::from(std.is_some())).concat();
        let is_lost = |pixel: usize| gone.contains(&pixel);
        assert!((0..PIXELS).any(is_lost) && (0..PIXELS).any(|p| times(p) == 1 && !is_lost(p)));
        assert!(gone.iter().all(|&pixel| times(pixel) == 1));
        let simulation = Simulation::seeing(even, SHAPE, &BETWEEN).with_noise(NOISE, 8);
        let mut experiment = simulation.experiment().with_lamp(Lamp::Known);
        if let Some(std) = std {
            experiment = experiment.measured_to(&std);
        }
        let all = with_few(experiment.clone(), times);
        let found = fit(&all, Options::to(TOLERANCE)).unwrap();
        let none = |pixel| if is_lost(pixel) { 0 } else { times(pixel) };
        let others = fit(&with_few(experiment, none), Options::to(TOLERANCE)).unwrap();
        assert!(found.converged && others.converged);
        assert!((found.misfit / others.misfit - 1.0).abs() < 1e-6);
        assert_eq!(found.degrees_of_freedom, others.degrees_of_freedom);
        let std = error_map(&all, &found, 1).unwrap().std;
        for (pixel, std) in std.iter().enumerate() {
            assert_eq!(found.sensitivity[pixel].is_nan(), is_lost(pixel), "{pixel}");
            assert_eq!(found.labels[0][pixel] < 0, is_lost(pixel));
            assert_eq!(std.is_nan(), is_lost(pixel));
        }
    }
}

fn masked(simulation: &Simulation, used: Used<'_>) -> Experiment {
    let mask = (0..BETWEEN.len() * PIXELS).map(|i| !used(i / PIXELS, i % PIXELS)).collect();
    Experiment { mask, ..simulation.experiment() }
}

#[test]
fn measurements_apart_are_lost_where_they_alone_see_cells() {
    // Of the last columns each exposure has one pixel in three, as along a ragged edge.
    let ragged =
        |k: usize, pixel: usize| pixel % SHAPE[1] < 34 || random(70 + k as u64, pixel) > 2.0 / 3.0;
    for (degrees, std) in [([0; 5], None), ([0; 5], Some(SHIFT_STD)), ([0, 180, 0, 180, 0], None)] {
        let simulation =
            Simulation::seeing(even, SHAPE, &BETWEEN).with_noise(NOISE, 10).turned(&degrees);
        let fitted = |experiment: Experiment| {
            let experiment = match std {
                Some(std) => experiment.measured_to(&std),
                None => experiment,
            };
            fit(&experiment, Options::to(TOLERANCE)).unwrap()
        };
        let found = fitted(masked(&simulation, &ragged));
        assert_eq!(found.lost, lost(&ragged, &degrees, i64::from(std.is_some())));
        let count = found.lost.concat().len();
        let apart = |k: usize| {
            (0..PIXELS).filter(move |&pixel| ragged(k, pixel) && !is_in_block(&ragged, k, pixel))
        };
        assert!(0 < count && count < (0..5).flat_map(apart).count(), "{count}");
        let others = fitted(masked(&simulation, &|k, pixel| {
            ragged(k, pixel) && !found.lost[k].contains(&pixel)
        }));
        assert!(found.converged && others.converged);
        assert!((found.misfit / others.misfit - 1.0).abs() < 1e-6);
        // Degrees of freedom count cells by the weights of whole exposures, those of lost measurements too.
        assert!(found.degrees_of_freedom.abs_diff(others.degrees_of_freedom) <= 1);
        assert_eq!(found.labels[0], others.labels[0]);
        for (m, other) in found.sensitivity.iter().zip(&others.sensitivity) {
            assert!(m.is_nan() == other.is_nan());
            // Each is within its tolerance of the same minimum.
            assert!(other.is_nan() || (m / other - 1.0).abs() < 10.0 * TOLERANCE);
        }
    }
}

/// What a fit finds where all exposures have the same mask.
fn fit_without(is_out: &dyn Fn(usize) -> bool) -> Answer {
    let simulation = Simulation::seeing(even, SHAPE, &BETWEEN).with_noise(NOISE, 11);
    let found = fit(&masked(&simulation, &|_, pixel| !is_out(pixel)), Options::to(1e-6)).unwrap();
    assert!(found.converged);
    found
}

const fn is_black(pixel: usize) -> bool {
    (pixel / SHAPE[1] + pixel % SHAPE[1]).is_multiple_of(2)
}

#[test]
fn none_is_lost_where_many_stand_apart() {
    let at = |pixel: usize| [pixel / SHAPE[1], pixel % SHAPE[1]];
    let masks: [&dyn Fn(usize) -> bool; 3] = [
        // A chessboard, every second column, and all colours but one.
        &is_black,
        &|pixel| at(pixel)[1] % 2 == 1,
        &|pixel| at(pixel).iter().any(|at| at % 2 == 1),
    ];
    for is_out in masks {
        let found = fit_without(is_out);
        assert!(found.lost.is_empty());
        assert!((0..PIXELS).all(|pixel| found.sensitivity[pixel].is_nan() == is_out(pixel)));
    }
}

#[test]
fn many_stand_apart_in_three_tenths_of_a_part_or_half_of_an_exposure() {
    let col = |pixel: usize| pixel % SHAPE[1];
    // A chessboard of 8 measurements in each column behind others: 200 and 176 of 640 pixels, the part being the whole
    // sensor. They are less than half of the measurements.
    let board = |first: usize| move |pixel: usize| col(pixel) >= first && is_black(pixel);
    assert!(fit_without(&board(15)).lost.is_empty());
    assert!(!fit_without(&board(18)).lost.is_empty());
    // Ten columns of 16 measurements apart beside 9 and 11 that are not: 160 of 640 pixels.
    let comb = |first: usize| {
        move |pixel: usize| {
            col(pixel) >= first
                && (col(pixel) >= first + 20 || (col(pixel) - first).is_multiple_of(2))
        }
    };
    assert!(fit_without(&comb(9)).lost.is_empty());
    assert!(!fit_without(&comb(11)).lost.is_empty());
}

#[test]
fn an_exposure_that_would_lose_all_keeps_all() {
    // The last one alone measures its pixels, and all of them see cells that no others see: a component of their own.
    let used =
        |k: usize, pixel: usize| if k < 4 { pixel % SHAPE[1] < 30 } else { pixel % SHAPE[1] >= 36 };
    let gone = lost(&used, &[0; 5], 0);
    let all: Vec<usize> = (0..PIXELS).filter(|&pixel| used(4, pixel)).collect();
    assert_eq!(gone[4], all);
    let simulation = Simulation::seeing(even, SHAPE, &BETWEEN).with_noise(NOISE, 12);
    // The penalty alone determines the light there, so the search is not asked to end.
    let options = Options { most_passes: Some(20), ..Options::to(1e-6) };
    let found = fit(&masked(&simulation, &used), options).unwrap();
    assert!(found.lost.is_empty());
    assert!(all.iter().all(|&pixel| found.labels[0][pixel] == 1));
}

#[test]
fn lost_measurements_that_are_not_of_the_exposures_are_refused() {
    let simulation = Simulation::seeing(even, SHAPE, &BETWEEN).with_noise(NOISE, 13);
    let experiment = simulation.experiment();
    let found = fit(&experiment, Options::to(1e-6)).unwrap();
    let error_with = |lost: Vec<Vec<usize>>| {
        let answer = Answer { lost, ..found.clone() };
        error_map(&experiment, &answer, 1).err().unwrap().to_string()
    };
    let words = error_with(vec![Vec::new(); 4]);
    assert_eq!(words, "'solution' has lost measurements of 4 exposures, expected 5");
    let words = error_with([vec![vec![PIXELS - 1]; 4], vec![vec![PIXELS]]].concat());
    assert_eq!(words, "'solution' has lost pixel 640, expected 0 to 639");
}

#[test]
fn none_is_lost_where_pixels_measured_twice_see_its_cells() {
    // Two of five exposures see the right half, where one pixel in nine misses a second measurement.
    let simulation = Simulation::seeing(even, SHAPE, &BETWEEN).with_noise(NOISE, 9);
    let used = |k: usize, pixel: usize| {
        pixel % SHAPE[1] < 20 || k == 0 || (k == 1 && !pixel.is_multiple_of(9))
    };
    let mask = (0..5 * PIXELS).map(|i| !used(i / PIXELS, i % PIXELS)).collect();
    let found = fit(&Experiment { mask, ..simulation.experiment() }, Options::to(1e-6)).unwrap();
    assert!(found.converged && found.sensitivity.iter().all(|m| m.is_finite()));
}

#[test]
fn they_stay_where_most_are_such_or_they_join_components() {
    let simulation = Simulation::seeing(even, SHAPE, &BETWEEN[..3]).with_noise(NOISE, 6);
    let experiment = simulation.experiment().with_lamp(Lamp::Free);
    let found = fit(&with_few(experiment, |_| 2), Options::to(1e-6)).unwrap();
    assert!(found.few.is_empty() && found.converged);
    // The right half is seen by three exposures far away, and two columns by one exposure of each place.
    let far = BETWEEN[..3].iter().map(|[row, col]| [*row, 36.0 - col]);
    let shifts: Vec<[f64; 2]> = BETWEEN[..3].iter().copied().chain(far).collect();
    let simulation = Simulation::seeing(even, SHAPE, &shifts).with_noise(NOISE, 6);
    let used = |k: usize, col: usize| match col {
        0..20 => k < 3,
        20..22 => k == 0 || k == 3,
        _ => k >= 3,
    };
    let mask = (0..6 * PIXELS).map(|i| !used(i / PIXELS, i % SHAPE[1])).collect();
    let found = fit(&Experiment { mask, ..simulation.experiment() }, Options::to(1e-6)).unwrap();
    assert!(found.few.is_empty() && found.converged);
    assert!(found.labels[0].iter().all(|&label| label == 0));
}

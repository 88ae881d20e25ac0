//! The rim against dense algebra, and products in single precision against those in double.

use super::aggregated;
use super::flux::Fluxes;
use super::layout::Grid;
use super::memory::bytes_needed;
use super::pass::Pass;
use super::preconditioner::{FROM_RIM, Preconditioner, around};
use super::rim::{NEAR_OF_TURNED as NEAR, Rim};
use super::system::System;
use super::unknowns::{ShiftPrior, State};
use crate::coarse::DAMPING;
use crate::control::Control;
use crate::exposures::{Exposures, Flux, FluxKind, Mask, Measurements, Positions, Variance};
use crate::frames::{Shape, Stack};
use crate::geometry::Rotation;
use crate::parallel::Workers;
use crate::testing::{self, SENSOR, random_number};

const ROTATIONS: [Rotation; 4] =
    [Rotation::None, Rotation::Quarter, Rotation::Half, Rotation::ThreeQuarters];
const FLUX: [f64; 4] = [1.0, 1.1, 0.9, 1.2];
const SHIFTS: &[[f64; 2]] = testing::SHIFTS.split_at(4).0;
const BETWEEN: Scan = Scan { sensor: SENSOR, shifts: SHIFTS, rotations: [Rotation::None; 4] };
/// So far apart that aggregates of cells stand for waves.
const FAR: Scan = Scan {
    sensor: Shape::new(43, 61),
    shifts: &[[0.0, 0.0], [17.0, -24.0], [-19.0, 11.0], [6.0, 31.0]],
    ..BETWEEN
};

/// A sensor and the positions that it was brought to.
#[derive(Clone, Copy)]
struct Scan {
    sensor: Shape,
    shifts: &'static [[f64; 2]],
    rotations: [Rotation; 4],
}

/// A number from 0 to 1 that looks random.
fn random(index: usize) -> f64 {
    0.5 + 0.5 * random_number(index)
}

/// Variances of a sensor's measurements, and what is masked.
fn uneven(sensor: Shape) -> (Vec<f64>, Vec<bool>) {
    let each = 0..ROTATIONS.len() * sensor.len();
    (each.clone().map(|i| 0.5 + random(i)).collect(), each.map(|i| random(i + 999) < 0.1).collect())
}

/// Calls `visit` with the linear problem of a sensor that is turned every way, and its dense N.
fn with_turned(visit: impl FnOnce(&System<'_, '_, f64>, &[Vec<f64>])) {
    let (variance, mask) = uneven(SENSOR);
    let scan = Scan { rotations: ROTATIONS, ..BETWEEN };
    with_system(&scan, &each(&variance, SENSOR), &Mask::Measurements(&mask), false, |system| {
        visit(system, &dense(system, &FLUX, &variance, &mask));
    });
}

fn stack(values: &[f64], sensor: Shape) -> Stack<'_, f64> {
    Stack::new("frames", values, ROTATIONS.len(), sensor).unwrap()
}

fn each(variance: &[f64], sensor: Shape) -> Variance<'_, f64> {
    Variance::Measurements(stack(variance, sensor))
}

/// Calls `visit` with the linear problem of the exposures of a scan, which seeks fluxes too if so wanted, and shifts
/// where they are no whole numbers.
fn with_system(
    &Scan { sensor, shifts, rotations }: &Scan,
    variance: &Variance<'_, f64>,
    mask: &Mask<'_>,
    seeks_more: bool,
    visit: impl FnOnce(&mut System<'_, '_, f64>),
) {
    let frames: Vec<f64> =
        (0..ROTATIONS.len() * sensor.len()).map(|i| 1.0 + 0.1 * random(i + 5000)).collect();
    let (workers, control) = (Workers::new(None).unwrap(), Control::new());
    let frames = stack(&frames, sensor);
    let measurements = Measurements { frames, variance: *variance, mask: *mask };
    let is_between = shifts.as_flattened().iter().any(|shift| shift.fract() != 0.0);
    let std = (seeks_more && is_between).then(|| vec![[0.02, 0.05]; shifts.len()]);
    let positions = Positions { shifts: shifts.to_vec(), rotations: rotations.to_vec(), std };
    let prior = ShiftPrior::of(&positions);
    let kind = if seeks_more { FluxKind::Free } else { FluxKind::Known };
    let lamp = Flux { values: FLUX.to_vec(), kind: kind.clone() };
    let exposures =
        Exposures::new(measurements, positions, lamp, false, &workers, &control).unwrap();
    let grid = Grid::of(&exposures).unwrap();
    let fluxes = Fluxes::of(&exposures, &FLUX, shifts, &grid);
    let beam = (0..grid.geometry.beam.len()).map(|cell| 1.0 + 0.1 * random(cell + 300)).collect();
    let state = State { beam, theta: vec![0.0; fluxes.columns.len()], shifts: shifts.to_vec() };
    let mut system = System::new(&exposures, grid, fluxes, state, &workers, &control).unwrap();
    system.seek_shifts(prior);
    system.linearise(&control).unwrap();
    visit(&mut system);
}

/// N: the sum of w c² M² B_i B_j over the measurements that the search uses.
fn dense(
    system: &System<'_, '_, f64>,
    flux: &[f64],
    variance: &[f64],
    mask: &[bool],
) -> Vec<Vec<f64>> {
    let cells = system.state.beam.len();
    let [sensitivity, _] = system.pixels();
    let mut normal = vec![vec![0.0; cells]; cells];
    let few = system.pass.few.image(SENSOR.cols).unwrap();
    let lost = system.pass.few.lost.pixels(SENSOR.cols);
    for at in (0..mask.len()).filter(|&at| !mask[at] && !few[at % SENSOR.len()]) {
        let (k, pixel) = (at / SENSOR.len(), at % SENSOR.len());
        if lost.get(k).is_some_and(|lost| lost.contains(&pixel)) {
            continue;
        }
        let gain = flux[k] * sensitivity[pixel];
        let seen = taps(system, k, pixel);
        for &(i, a) in &seen {
            for &(j, b) in &seen {
                normal[i][j] += gain * gain * a * b / variance[at];
            }
        }
    }
    normal
}

/// The cells that a pixel sees, with B: of the cubic B-spline at A p + t + d.
fn taps(system: &System<'_, '_, f64>, exposure: usize, pixel: usize) -> Vec<(usize, f64)> {
    let [r, c] = [(pixel / SENSOR.cols) as f64, (pixel % SENSOR.cols) as f64];
    let [last_row, last_col] = [SENSOR.rows as f64 - 1.0, SENSOR.cols as f64 - 1.0];
    let p = match ROTATIONS[exposure] {
        Rotation::None => [r, c],
        Rotation::Quarter => [c, last_row - r],
        Rotation::Half => [last_row - r, last_col - c],
        Rotation::ThreeQuarters => [last_col - c, r],
    };
    let geometry = &system.pass.grid.geometry;
    let u = [0, 1].map(|axis| p[axis] + SHIFTS[exposure][axis] + geometry.origin[axis] as f64);
    let b = |x: f64| match x.abs() {
        t if t < 1.0 => 2.0 / 3.0 - t * t + t * t * t / 2.0,
        t if t < 2.0 => (2.0 - t).powi(3) / 6.0,
        _ => 0.0,
    };
    let Shape { cols, .. } = geometry.beam;
    let each = (0..geometry.beam.len())
        .map(|cell| (cell, b(u[0] - (cell / cols) as f64) * b(u[1] - (cell % cols) as f64)));
    each.filter(|(_, b)| *b > 0.0).collect()
}

#[test]
fn the_rim_is_where_a_cell_near_has_less_than_a_sixth() {
    with_turned(|system, normal| {
        let Shape { rows, cols } = system.pass.grid.geometry.beam;
        // D = Σ w c² M² B, the sum of a row of N, since all B of a pixel sum to 1.
        let weight = |row: usize, col: usize| normal[row * cols + col].iter().sum::<f64>();
        let is_rim = |cell: usize| {
            let (row, col) = (cell / cols, cell % cols);
            let near = |at: usize, size: usize| at.saturating_sub(NEAR)..(at + NEAR + 1).min(size);
            let end = |at: usize, size: usize| at < NEAR || at + NEAR >= size;
            let inside = !end(row, rows) && !end(col, cols);
            let mut around = near(row, rows).flat_map(|r| near(col, cols).map(move |c| (r, c)));
            let own = weight(row, col);
            own > 0.0 && (!inside || around.any(|(r, c)| weight(r, c) < own / 6.0))
        };
        let rim = Rim::new(system, &Control::new()).unwrap();
        let mut found: Vec<usize> = rim.cells().collect();
        found.sort_unstable();
        assert!(found == (0..rows * cols).filter(|&cell| is_rim(cell)).collect::<Vec<_>>());
    });
}

#[test]
fn on_the_rim_the_normal_matrix_is_inverted() {
    with_turned(|system, normal| {
        let rim = Rim::new(system, &Control::new()).unwrap();
        let cells: Vec<usize> = rim.cells().collect();
        let right: Vec<f64> = (0..normal.len()).map(|cell| random(cell + 77) - 0.5).collect();
        let mut found = vec![0.0; normal.len()];
        rim.add(&right, &mut found, [1.0; 2], system.pass.workers);
        for &cell in &cells {
            let mut row = normal[cell].clone();
            let penalty = system.penalty.as_ref().unwrap();
            penalty.for_row(cell, |other, value| row[other] += value);
            let terms = || cells.iter().map(|&other| row[other] * found[other]);
            let size: f64 = terms().map(f64::abs).sum();
            // A ridge of 1e-10 of the diagonal is added to N.
            assert!((terms().sum::<f64>() - right[cell]).abs() < 1e-9 * size);
        }
        let outside = (0..normal.len()).filter(|cell| !cells.contains(cell));
        assert!(outside.into_iter().all(|cell| found[cell] == 0.0));
    });
}

#[test]
fn less_is_left_beside_the_rim() {
    with_turned(|system, _| {
        let shape = system.pass.grid.geometry.beam;
        let rim = Rim::new(system, &Control::new()).unwrap();
        let cells: Vec<usize> = rim.cells().collect();
        for (cell, share) in around(&rim, shape).into_iter().enumerate() {
            let away = |other: &usize| {
                let rows = (cell / shape.cols).abs_diff(other / shape.cols);
                rows.max((cell % shape.cols).abs_diff(other % shape.cols))
            };
            let nearest = cells.iter().map(away).min().unwrap();
            assert!(share == FROM_RIM.get(nearest).copied().unwrap_or(1.0));
        }
    });
}

#[test]
fn the_preconditioner_is_symmetric_and_the_same_in_single_precision() {
    for (scan, seeks_more) in [(BETWEEN, false), (BETWEEN, true), (FAR, false), (FAR, true)] {
        is_symmetric_and_the_same(&scan, seeks_more);
    }
}

fn is_symmetric_and_the_same(scan: &Scan, seeks_more: bool) {
    let (variance, mask) = uneven(scan.sensor);
    let (variance, mask) = (each(&variance, scan.sensor), Mask::Measurements(&mask));
    with_system(scan, &variance, &mask, seeks_more, |system| {
        let Pass { exposures, flux, grid, .. } = &system.pass;
        let are_many = aggregated::in_place_of_waves(exposures, flux, grid).is_some();
        assert_eq!(are_many, !grid.is_spline());
        let control = Control::new();
        let preconditioner = Preconditioner::new(system, &control).unwrap();
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        // Pulls at no multiple of the beam, and moves no exposures together, as those of measurements.
        let pulls = |seed: usize| -> Vec<f64> {
            let mut pulls: Vec<f64> =
                (0..system.size()).map(|at| random(at + seed) - 0.5).collect();
            let multiple = dot(&pulls, &system.state.beam) / system.ordinary[0];
            let cells = pulls.iter_mut().zip(&system.scale);
            cells.for_each(|(r, scale)| *r -= multiple * f64::from(*scale));
            let of_shifts = &mut pulls[system.state.beam.len() + system.fluxes.columns.len()..];
            let centred = system.centred_pulls(of_shifts.as_chunks().0.to_vec());
            of_shifts.copy_from_slice(centred.as_flattened());
            pulls
        };
        let apply = |r: &[f64]| {
            let mut z = Vec::new();
            preconditioner.apply(system, r, &mut z, &control).unwrap();
            z
        };
        let r = pulls(17);
        let of_r = apply(&r);
        // Fluxes and shifts alone too: white noise on all cells leaves little of what couples them to hats.
        let mut of_others = pulls(31);
        of_others[..system.state.beam.len()].fill(0.0);
        // Its arrays are in single precision; z is a sum of some 100 of their products.
        let rounding = 100.0 * f64::from(f32::EPSILON);
        let size_beside = |s: &[f64]| {
            let of_s = apply(s);
            let size = (dot(&r, &of_r) * dot(s, &of_s)).sqrt();
            let difference = (dot(&r, &of_s) - dot(s, &of_r)).abs();
            assert!(size > 0.0 && difference < rounding * size, "{difference} of {size}");
            size
        };
        if seeks_more {
            size_beside(&of_others);
        }
        let size = size_beside(&pulls(4711));
        let mut single = Vec::new();
        preconditioner.apply(system, &system.slope_in(r.clone()), &mut single, &control).unwrap();
        let single = system.step_of(single);
        let pairs = single.iter().zip(&of_r).zip(&system.weights);
        let square = |off: f64, d: f32| system.ordinary[1] * f64::from(d) * off * off;
        let off: f64 = pairs.map(|((one, z), d)| square(one - z, *d)).sum();
        assert!(off.sqrt() < rounding * dot(&r, &of_r).sqrt(), "{}", off.sqrt());
        for (one, z) in single.iter().zip(&of_r).skip(system.state.beam.len()) {
            assert!((one - z).abs() < rounding * z.abs().max(size.sqrt()), "{one} {z}");
        }
    });
}

#[test]
fn aggregates_are_counted_and_none_are_of_turned_exposures() {
    let of = |rotation| {
        let mut found = (0, 0, 0);
        let scan = Scan { rotations: [rotation; 4], ..FAR };
        with_system(&scan, &Variance::Unknown, &Mask::None, false, |system| {
            let Pass { exposures, flux, grid, .. } = &system.pass;
            let of_aggregates = aggregated::bytes_needed(exposures, flux, grid);
            let of_view = 16 * grid.geometry.beam.len() as u64;
            found = (bytes_needed(exposures, flux).unwrap(), of_aggregates, of_view);
        });
        found
    };
    let (all, of_aggregates, _) = of(Rotation::None);
    let (turned, none, of_view) = of(Rotation::Half);
    assert!(none == 0 && of_aggregates > 0);
    assert_eq!(all, turned - of_view + of_aggregates);
}

/// Of pixels that see waves of period 7 nearly alike, S and the matrix of hats times those waves agree.
#[test]
fn the_matrix_of_waves_is_that_of_the_product() {
    let sensor = Shape::new(84, 98);
    let shifts = [[0.0, 0.0], [0.3, 7.2], [7.1, -0.4]];
    let frames = vec![1.0; 3 * sensor.len()];
    let (workers, control) = (Workers::new(None).unwrap(), Control::new());
    let frames = Stack::new("frames", &frames, 3, sensor).unwrap();
    let positions = Positions::of_shifts(&shifts);
    let exposures =
        Exposures::new(frames.into(), positions, Flux::steady(3), false, &workers, &control);
    let exposures = exposures.unwrap();
    let grid = Grid::new(sensor, &shifts, &[Rotation::None; 3], false).unwrap();
    let fluxes = Fluxes::of(&exposures, &[1.0; 3], &shifts, &grid);
    let state = State {
        beam: vec![1.0; grid.geometry.beam.len()],
        theta: Vec::new(),
        shifts: shifts.to_vec(),
    };
    let mut system = System::new(&exposures, grid, fluxes, state, &workers, &control).unwrap();
    system.linearise(&control).unwrap();
    let preconditioner = Preconditioner::new(&mut system, &control).unwrap();
    // A wave packet, then what the waves make of what it pulls.
    let white: Vec<f64> = (0..system.size()).map(|cell| random(cell + 13) - 0.5).collect();
    let packet = preconditioner.waves_of(&system, &white);
    let mut pulls = Vec::new();
    system.multiply(&packet, &mut pulls, 0.0, &control).unwrap();
    let found = preconditioner.waves_of(&system, &pulls);
    let square = |values: &[f64]| values.iter().map(|value| value * value).sum::<f64>();
    let off: Vec<f64> = found.iter().zip(&packet).map(|(f, p)| f - DAMPING * p).collect();
    let share = (square(&off) / square(&found)).sqrt();
    // Hats of 24 cells hold some three periods, and a rim of 10 of 100 cells is seen by fewer exposures.
    assert!(square(&packet) > 0.0 && share < 0.3, "{share}");
}

#[test]
fn a_product_in_single_precision_is_that_in_double() {
    let (variance, mask) = uneven(SENSOR);
    let even = (Variance::Exposures(&[1.0, 2.0, 0.5, 3.0]), Mask::None);
    let cases = [(each(&variance, SENSOR), Mask::Measurements(&mask)), even];
    for ((variance, mask), seeks_more) in
        cases.iter().flat_map(|case| [(case, false), (case, true)])
    {
        with_system(&BETWEEN, variance, mask, seeks_more, |system| {
            assert!(system.has_single());
            let control = Control::new();
            let x: Vec<f64> = (0..system.size()).map(|cell| random(cell + 31) - 0.5).collect();
            let short: Vec<f32> = system.step_in(x.clone());
            let (mut single, mut double) = (Vec::new(), Vec::new());
            let sizes = [
                system.multiply(&short, &mut single, 0.5, &control).unwrap(),
                system.multiply(&x, &mut double, 0.5, &control).unwrap(),
            ];
            // An element is a sum of some 4 · 16 · 4 products, the largest of the size of the largest one.
            let rounding = 256.0 * f64::from(f32::EPSILON);
            // The change of the first, less half of itself.
            assert!((sizes[1] / sizes[0] - 0.5).abs() < rounding);
            let ([_, of_cell], cells) = (system.units::<f32>(), system.state.beam.len());
            let (of_cells, of_others) = double.split_at(cells);
            // Those of fluxes and shifts are sums over all pixels, whose roundings are independent.
            let found = |unit: f64| move |one: &f32| unit * f64::from(*one);
            let others = found(system.unit_of_other_slopes::<f32>());
            for (single, double, found) in [
                (&single[..cells], of_cells, &found(of_cell) as &dyn Fn(&f32) -> f64),
                (&single[cells..], of_others, &others),
            ] {
                let size = double.iter().fold(0.0_f64, |top, value| top.max(value.abs()));
                for (one, other) in single.iter().map(found).zip(double) {
                    assert!((one - other).abs() < rounding * size, "{one} {other}");
                }
            }
        });
    }
}

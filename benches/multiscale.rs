//! How long the fast solver takes to a certified 1e-6 on the standard hard case, beside a plain
//! sweep and one product with S, measured in turn; prints a line of JSON for each size and
//! precision. At one size coordinate descent runs to 1e-4 too.

#![allow(clippy::unwrap_used, reason = "a bench has nobody to report to")]

mod common;

use std::time::Instant;

use common::{frames, sensitivity};
use equipix_core::parts::{self, Parts};
use equipix_core::sweep::Estimate;
use equipix_core::{
    Control, Ended, Exposures, Fit, Method, Options, Real, Shape, Workers, calibrate,
};

const OPTIONS: Options = Options { method: Method::Multiscale, tolerance: 1e-6, max_sweeps: None };
const SIZES: [Shape; 5] = [
    Shape::new(240, 320),
    Shape::new(582, 782),
    Shape::new(1164, 1564),
    Shape::new(4096, 4096),
    Shape::new(8192, 8192),
];
const SMALL: [Shape; 1] = [Shape::new(48, 64)];
/// The size at which coordinate descent is waited for, and to what error.
const AWAITED: (Shape, f64) = (SIZES[1], 1e-4);
/// Five times what it takes.
const MOST_SWEEPS: usize = 50_000;
/// Sweeps between two looks at its true error.
const CHECK_EVERY: usize = 100;

fn main() {
    let smoke = std::env::args().any(|argument| argument == "--test");
    let workers = Workers::new(None).unwrap();
    for shape in if smoke { &SMALL[..] } else { &SIZES[..] } {
        measure(*shape, "float64", |value| value, &workers);
        measure(*shape, "float32", |value| value as f32, &workers);
    }
}

fn measure<T: Real>(shape: Shape, precision: &str, convert: fn(f64) -> T, workers: &Workers) {
    let control = Control::new();
    let data = frames(shape, workers, convert);
    let exposures = common::exposures(&data, shape, workers).unwrap();
    let mut solution = None;
    let mut times: [Vec<f64>; 6] = Default::default();
    for _ in 0..((1 << 25) / shape.len()).clamp(2, 9) {
        let [sweep, assemble, factorise, product] = pieces(&exposures, workers, &control);
        let whole = seconds(1, || {
            solution = calibrate(&exposures, &OPTIONS, None, workers, &control).ok();
        });
        let alone =
            seconds(1, || parts::multiscale(&exposures, &OPTIONS, workers, &control).unwrap());
        let taken = [sweep, assemble, factorise, product, whole, alone];
        times.iter_mut().zip(taken).for_each(|(times, taken)| times.push(taken));
    }
    let [sweep, assemble, factorise, product, whole, alone] = times.map(median);
    let Fit { sensitivity, history, .. } = solution.unwrap();
    let last = history.last();
    let awaited = (shape == AWAITED.0).then(|| await_descent(&exposures, workers, &control));
    println!(
        "{{\"rows\": {}, \"cols\": {}, \"precision\": \"{precision}\", \"sweep_s\": {sweep:.3e}, \
         \"assemble_s\": {assemble:.3e}, \"factorise_s\": {factorise:.3e}, \
         \"product_s\": {product:.3e}, \"calibrate_s\": {whole:.3e}, \"solve_s\": {alone:.3e}, \
         \"products\": {}, \"steps\": {}, \"estimate\": {:.2e}, \"error\": {:.2e}, \
         \"converged\": {}, \"descent\": {}}}",
        shape.rows,
        shape.cols,
        last.sweep,
        history.looks.len(),
        last.error,
        true_error(&sensitivity, shape, workers),
        history.ended == Ended::Converged,
        awaited.map_or("null".into(), |(sweeps, s)| format!("[{sweeps}, {s:.3e}]")),
    );
}

/// Seconds of a sweep, of assembling S, of assembling and factorising the coarse matrix, and of a
/// product with S.
fn pieces<T: Real>(exposures: &Exposures<'_, T>, workers: &Workers, control: &Control) -> [f64; 4] {
    // Enough rounds that the clock and the first touch of memory do not count.
    let rounds = (1 << 21) / exposures.sensor().len() + 2;
    let mut estimate = Estimate::new(exposures, workers, control);
    let sweep = seconds(rounds, || estimate.sweep(control).unwrap());
    let mut parts = Parts::new(exposures, workers);
    let assemble = seconds(rounds, || parts.assemble(&estimate, control).unwrap());
    let factorise = seconds(rounds, || parts.factorise(control).unwrap());
    let product = seconds(rounds, || parts.multiply(control).unwrap());
    [sweep, assemble, factorise, product]
}

/// The sweeps and the seconds that coordinate descent takes.
fn await_descent<T: Real>(
    exposures: &Exposures<'_, T>,
    workers: &Workers,
    control: &Control,
) -> (usize, f64) {
    let mut estimate = Estimate::new(exposures, workers, control);
    let (mut sweeps, mut taken) = (0, 0.0);
    while true_error(&estimate.sensitivity, exposures.sensor(), workers) > AWAITED.1 {
        assert!(sweeps < MOST_SWEEPS, "coordinate descent does not get there");
        let each = seconds(CHECK_EVERY, || estimate.sweep(control).unwrap());
        sweeps += CHECK_EVERY;
        taken += CHECK_EVERY as f64 * each;
    }
    (sweeps, taken)
}

/// The largest relative error of M, found and true both divided by their means.
fn true_error(found: &[f64], shape: Shape, workers: &Workers) -> f64 {
    let row = |row: usize| found[row * shape.cols..].iter().zip(sensitivity(shape, row));
    let sums = workers.map(shape.rows, |index| {
        row(index).fold((0.0, 0.0), |(found, truth), (m, t)| (found + m, truth + t))
    });
    let [found, truth] =
        [sums.iter().map(|sum| sum.0).sum::<f64>(), sums.iter().map(|s| s.1).sum()];
    let worst = workers.map(shape.rows, |index| {
        row(index).map(|(m, t)| (m / t * (truth / found) - 1.0).abs()).fold(0.0, f64::max)
    });
    worst.into_iter().fold(0.0, f64::max)
}

fn seconds<R>(rounds: usize, mut work: impl FnMut() -> R) -> f64 {
    let start = Instant::now();
    for _ in 0..rounds {
        drop(work());
    }
    start.elapsed().as_secs_f64() / rounds as f64
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

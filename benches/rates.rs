//! The rate of one sweep beside the machine's copy rate, measured in turn; prints a line of JSON
//! for each size. The yardstick is a copy of as many bytes, half of them read and half written, by as
//! many threads. Two counts of a sweep's bytes: the data twice, as in two separate passes; and all
//! that the fused sweep moves when nothing fits the cache: the data once, L and M read and written.

#![allow(clippy::unwrap_used, reason = "a bench has nobody to report to")]

mod common;

use std::time::Instant;

use common::{exposures, frames};
use equipix_core::sweep::Estimate;
use equipix_core::{Control, Shape, Workers};

/// Values that one thread copies at a time.
const BLOCK: usize = 1 << 16;

fn main() {
    let smoke = std::env::args().any(|argument| argument == "--test");
    let shapes = [Shape::new(582, 782), Shape::new(4096, 4096)];
    for shape in if smoke { &shapes[..1] } else { &shapes[..] } {
        measure(*shape, if smoke { 2 } else { 15 });
    }
}

fn measure(shape: Shape, repetitions: usize) {
    let workers = Workers::new(None).unwrap();
    let control = Control::new();
    let data = frames(shape, &workers, |value| value as f32);
    let exposures = exposures(&data, shape, &workers).unwrap();
    let mut estimate = Estimate::new(&exposures, &workers, &control);
    let mut target = vec![0.0_f32; data.len()];
    // Enough rounds that the clock's and the threads' start do not count.
    let rounds = (1 << 25) / data.len() + 1;
    let (mut sweeps, mut copies) = (Vec::new(), Vec::new());
    for _ in 0..repetitions + 1 {
        copies.push(seconds(rounds, || {
            workers.map_blocks(&mut target, BLOCK, |index, block| {
                block.copy_from_slice(&data[index * BLOCK..][..block.len()]);
            });
        }));
        sweeps.push(seconds(rounds, || {
            estimate.sweep(&control).unwrap();
        }));
    }
    // The first of each touches its memory for the first time.
    let ratios = copies.iter().zip(&sweeps).skip(1).map(|(copy, sweep)| copy / sweep);
    let ratio = median(ratios.collect());
    println!(
        "{{\"rows\": {}, \"cols\": {}, \"threads\": {}, \"sweep_s\": {:.3e}, \"copy_s\": {:.3e}, \
         \"copy_gb_per_s\": {:.2}, \"share_of_copy_rate\": {:.4}, \"share_in_all\": {:.4}}}",
        shape.rows,
        shape.cols,
        workers.count(),
        median(sweeps[1..].to_vec()),
        median(copies[1..].to_vec()),
        (8 * data.len()) as f64 / median(copies[1..].to_vec()) / 1e9,
        ratio,
        ratio * (4 * data.len() + 32 * shape.len()) as f64 / (8 * data.len()) as f64,
    );
}

fn seconds(rounds: usize, mut work: impl FnMut()) -> f64 {
    let start = Instant::now();
    for _ in 0..rounds {
        work();
    }
    start.elapsed().as_secs_f64() / rounds as f64
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

//! One sweep of coordinate descent: a plain loop beside the core's kernels, over sensor sizes.

#![allow(clippy::unwrap_used, reason = "a bench has nobody to report to")]
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use equipix_core::sweep::Estimate;
use equipix_core::{Control, Shape, Workers};
use std::hint::black_box;

mod common;
use common::{SHIFTS, exposures, frames};

/// How far the beam grid reaches beyond the sensor.
const PAD: usize = 19;

/// The same sweep as one would write it down: M and L updated in place, whole images at a time.
fn naive_sweep(frames: &[f32], shape: Shape, sensitivity: &mut [f64], beam: &mut [f64]) {
    let cols = shape.cols + PAD;
    let mut sums = vec![[0.0; 2]; beam.len()];
    for (k, [down, right]) in SHIFTS.into_iter().enumerate() {
        for (r, c) in (0..shape.rows).flat_map(|r| (0..shape.cols).map(move |c| (r, c))) {
            let m = sensitivity[r * shape.cols + c];
            let y = f64::from(frames[k * shape.len() + r * shape.cols + c]);
            let sum = &mut sums[(r + down as usize) * cols + c + right as usize];
            *sum = [sum[0] + m * y, sum[1] + m * m];
        }
    }
    for (cell, [signal, weight]) in beam.iter_mut().zip(sums) {
        *cell = if weight > 0.0 { signal / weight } else { 0.0 };
    }
    for (r, c) in (0..shape.rows).flat_map(|r| (0..shape.cols).map(move |c| (r, c))) {
        let [mut signal, mut weight] = [0.0; 2];
        for (k, [down, right]) in SHIFTS.into_iter().enumerate() {
            let light = beam[(r + down as usize) * cols + c + right as usize];
            signal += light * f64::from(frames[k * shape.len() + r * shape.cols + c]);
            weight += light * light;
        }
        sensitivity[r * shape.cols + c] = signal / weight;
    }
}

fn sweep(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("sweep");
    for shape in [Shape::new(240, 320), Shape::new(582, 782), Shape::new(1164, 1564)] {
        let data = frames(shape, &Workers::new(None).unwrap(), |value| value as f32);
        group.throughput(Throughput::Elements(data.len() as u64));
        let mut sensitivity = vec![1.0; shape.len()];
        let mut beam = vec![0.0; (shape.rows + PAD) * (shape.cols + PAD)];
        group.bench_function(BenchmarkId::new("naive", shape), |bencher| {
            bencher.iter(|| naive_sweep(&data, shape, &mut sensitivity, black_box(&mut beam)));
        });
        for (name, count) in [("one worker", Some(1)), ("all workers", None)] {
            let workers = Workers::new(count.and_then(std::num::NonZeroUsize::new)).unwrap();
            let control = Control::new();
            let exposures = exposures(&data, shape, &workers).unwrap();
            let mut estimate = Estimate::new(&exposures, &workers, &control);
            group.bench_function(BenchmarkId::new(name, shape), |bencher| {
                bencher.iter(|| estimate.sweep(&control).unwrap());
            });
        }
    }
    group.finish();
}

criterion_group!(benches, sweep);
criterion_main!(benches);

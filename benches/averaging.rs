//! Mean and variance of a stack of 16-bit frames: a plain loop beside the core, over sensor sizes.

#![expect(clippy::unwrap_used, reason = "a bench that cannot start says so by a panic")]

use std::hint::black_box;
use std::num::NonZeroUsize;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use equipix_core::statistics::Accumulator;
use equipix_core::{Control, Shape, Stack, Workers};

const FRAMES: usize = 32;

/// Frames whose low bits look random.
fn frames(shape: Shape) -> Vec<u16> {
    (0..FRAMES * shape.len())
        .map(|i| 2000 + (i.wrapping_mul(2_654_435_761) >> 20) as u16 % 128)
        .collect()
}

/// Welford's recurrence, frame by frame, as one would write it down.
fn naive_average(frames: &[u16], shape: Shape) -> (Vec<f64>, Vec<f64>) {
    let mut mean = vec![0.0; shape.len()];
    let mut scatter = vec![0.0; shape.len()];
    for (index, frame) in frames.chunks_exact(shape.len()).enumerate() {
        for ((mean, scatter), &sample) in mean.iter_mut().zip(&mut scatter).zip(frame) {
            let deviation = f64::from(sample) - *mean;
            *mean += deviation / (index + 1) as f64;
            *scatter += deviation * (f64::from(sample) - *mean);
        }
    }
    (mean, scatter)
}

fn average(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("average");
    for shape in [Shape::new(240, 320), Shape::new(582, 782), Shape::new(1164, 1564)] {
        let data = frames(shape);
        group.throughput(Throughput::Elements(data.len() as u64));
        group.bench_function(BenchmarkId::new("naive", shape), |bencher| {
            bencher.iter(|| black_box(naive_average(&data, shape)));
        });
        for (name, count) in [("one worker", Some(1)), ("all workers", None)] {
            let workers = Workers::new(count.and_then(NonZeroUsize::new)).unwrap();
            let stack = Stack::new("frames", &data, FRAMES, shape).unwrap();
            let mut sums = Accumulator::<u16>::new(shape, None).unwrap();
            let control = Control::new();
            group.bench_function(BenchmarkId::new(name, shape), |bencher| {
                bencher.iter(|| sums.add(&stack, &workers, &control).unwrap());
            });
        }
    }
    group.finish();
}

criterion_group!(benches, average);
criterion_main!(benches);

//! Laws of the partial sums, and their agreement with sums in the plainest form.

use std::num::NonZeroUsize;

use equipix_core::control::Control;
use equipix_core::frames::{Sample, Shape, Stack};
use equipix_core::parallel::Workers;
use equipix_core::statistics::{Accumulator, GROUP, Statistics, Summable};
use equipix_core::{Error, Result};
use proptest::prelude::*;

/// The sums of `frames`, added in the pieces that end at `cuts` and merged in their order.
fn merged<T: Summable>(
    frames: &[T],
    shape: Shape,
    cuts: &[usize],
    workers: usize,
) -> Result<Statistics> {
    let workers = Workers::new(NonZeroUsize::new(workers))?;
    let mut total = Accumulator::<T>::new(shape, None)?;
    let count = frames.len() / shape.len();
    let mut start = 0;
    for &end in cuts.iter().chain([&count]) {
        let end = end.clamp(start, count);
        let mut part = Accumulator::<T>::new(shape, None)?;
        let piece = &frames[start * shape.len()..end * shape.len()];
        part.add(&Stack::new("frames", piece, end - start, shape)?, &workers, &Control::new())?;
        total.merge(&part)?;
        start = end;
    }
    Ok(total.finish())
}

/// Mean and unbiased variance of the finite samples of a pixel, in two passes.
fn naive<T: Sample>(frames: &[T], shape: Shape, pixel: usize) -> (f64, f64) {
    let all = frames.iter().skip(pixel).step_by(shape.len()).map(|sample| sample.to_f64());
    let samples: Vec<f64> = all.filter(|value| value.is_finite()).collect();
    let n = samples.len() as f64;
    let mean = samples.iter().sum::<f64>() / n;
    let scatter: f64 = samples.iter().map(|sample| (sample - mean).powi(2)).sum();
    (mean, if n < 2.0 { f64::NAN } else { scatter / (n - 1.0) })
}

/// Unbiased variance of the means of the frames over their finite samples, each less the mean of the
/// first 16 frames in which its pixel has one.
fn of_light<T: Sample>(frames: &[T], shape: Shape) -> f64 {
    let size = shape.len();
    let mut first = vec![f64::NAN; size];
    let mut means = Vec::new();
    for batch in frames.chunks(16 * size) {
        for (pixel, first) in first.iter_mut().enumerate().filter(|(_, first)| first.is_nan()) {
            *first = naive(batch, shape, pixel).0;
        }
        for frame in batch.chunks(size) {
            let values = frame.iter().zip(&first).map(|(sample, first)| sample.to_f64() - first);
            let finite: Vec<f64> = values.filter(|value| value.is_finite()).collect();
            if !finite.is_empty() {
                means.push(finite.iter().sum::<f64>() / finite.len() as f64);
            }
        }
    }
    naive(&means, Shape::new(1, 1), 0).1
}

/// Equal up to the rounding of n terms of size `top`, or both NaN.
fn close(a: f64, b: f64, n: usize, top: f64) -> bool {
    (a.is_nan() && b.is_nan()) || (a - b).abs() <= 4.0 * (n + 8) as f64 * f64::EPSILON * top
}

/// Sizes past those of a block, frames past those of a batch, and where to cut between frames.
fn stacks<T: std::fmt::Debug>(
    sample: impl Strategy<Value = T> + Clone,
) -> impl Strategy<Value = (Vec<T>, Shape, Vec<usize>)> {
    let cuts = prop::collection::vec(0..40_usize, 0..4);
    (0..40_usize, 1..40_usize, 1..60_usize, cuts).prop_flat_map(
        move |(count, rows, cols, mut cuts)| {
            cuts.sort_unstable();
            let size = count * rows * cols;
            let data = prop::collection::vec(sample.clone(), size);
            (data, Just(Shape::new(rows, cols)), Just(cuts))
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn merging_integers_changes_no_bit((frames, shape, cuts) in stacks(any::<u16>())) {
        let whole = merged(&frames, shape, &[], 1).unwrap();
        let parts = merged(&frames, shape, &cuts, 2).unwrap();
        prop_assert_eq!(format!("{whole:?}"), format!("{parts:?}"));
        let count = frames.len() / shape.len();
        let light = of_light(&frames, shape);
        prop_assert!(close(whole.light_variance, light, count, 65535.0_f64.powi(2)));
        for pixel in 0..shape.len() {
            let (mean, variance) = naive(&frames, shape, pixel);
            prop_assert!(close(whole.mean[pixel], mean, count, 65535.0));
            prop_assert!(close(whole.variance[pixel], variance, count, 65535.0_f64.powi(2)));
        }
    }

    #[test]
    fn merging_floats_agrees_up_to_rounding(
        (frames, shape, cuts) in stacks(prop_oneof![9 => -1e3..1e3, 1 => Just(f64::NAN)]),
    ) {
        let parts = merged(&frames, shape, &cuts, 2).unwrap();
        let count = frames.len() / shape.len();
        let one = merged(&frames, shape, &[], 2).unwrap();
        let light = of_light(&frames, shape);
        prop_assert!(close(one.light_variance, light, count + shape.len(), 4e6));
        // Parts have first values of their own, which are as good where no sample is missing.
        let finite: Vec<f64> = frames.iter().map(|x: &f64| if x.is_nan() { 0.0 } else { *x }).collect();
        let cut = merged(&finite, shape, &cuts, 2).unwrap();
        let light = of_light(&finite, shape);
        prop_assert!(close(cut.light_variance, light, count + shape.len(), 4e6));
        for pixel in 0..shape.len() {
            let (mean, variance) = naive(&frames, shape, pixel);
            prop_assert!(close(parts.mean[pixel], mean, count, 1e3));
            prop_assert!(close(parts.variance[pixel], variance, count, 4e6));
        }
    }

    #[test]
    fn workers_change_no_bit((frames, shape, _) in stacks(any::<f32>())) {
        let one = merged(&frames, shape, &[], 1).unwrap();
        let three = merged(&frames, shape, &[], 3).unwrap();
        prop_assert_eq!(format!("{one:?}"), format!("{three:?}"));
    }
}

/// Sums of frames that are added as they come, or in groups that are kept as bytes meanwhile.
fn in_groups<T: Summable>(frames: &[T], shape: Shape, mask: &[bool], kept: bool) -> Statistics {
    let workers = Workers::new(None).unwrap();
    let sums = || Accumulator::<T>::new(shape, None).unwrap().masked(mask).unwrap();
    let mut total = sums();
    for (index, group) in frames.chunks(GROUP as usize * shape.len()).enumerate() {
        let stack = Stack::new("frames", group, group.len() / shape.len(), shape).unwrap();
        let mut part = sums();
        let target = if kept { &mut part } else { &mut total };
        target.add(&stack, &workers, &Control::new()).unwrap();
        if kept {
            let mut read = sums();
            read.restore(&part.to_bytes()).unwrap();
            if index == 0 { total = read } else { total.merge(&read).unwrap() }
        }
    }
    let mut read = sums();
    read.restore(&total.to_bytes()).unwrap();
    assert_eq!(format!("{:?}", total.finish()), format!("{:?}", read.finish()));
    total.finish()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(8))]

    #[test]
    fn groups_kept_as_bytes_change_no_bit(
        count in 1..800_usize, seed in any::<u64>(), missing in 0..3_u64,
    ) {
        let shape = Shape::new(33, 35);
        let value = |i: usize| (i as u64 ^ seed).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40;
        let values = (0..count * shape.len()).map(value);
        let floats: Vec<f64> = values
            .clone()
            .map(|x| if x % 10 < missing { f64::NAN } else { x as f64 / 7.0 })
            .collect();
        let whole: Vec<u16> = values.map(|x| x as u16).collect();
        let mask: Vec<bool> = (0..shape.len()).map(|pixel| pixel % 5 == 0).collect();
        for mask in [&mask, &vec![false; shape.len()]] {
            let (one, other) =
                (in_groups(&floats, shape, mask, false), in_groups(&floats, shape, mask, true));
            prop_assert_eq!(format!("{one:?}"), format!("{other:?}"));
            for pixel in 0..shape.len() {
                let (mean, variance) = naive(&floats, shape, pixel);
                prop_assert!(close(one.mean[pixel], mean, count, 2.4e6));
                prop_assert!(close(one.variance[pixel], variance, count, 2.4e6_f64.powi(2)));
            }
            let (one, other) =
                (in_groups(&whole, shape, mask, false), in_groups(&whole, shape, mask, true));
            prop_assert_eq!(format!("{one:?}"), format!("{other:?}"));
        }
    }
}

#[test]
fn sums_that_do_not_fit_are_refused() {
    let sums = Accumulator::<f32>::new(Shape::new(2, 3), None).unwrap();
    let bytes = sums.to_bytes();
    let read = |bytes: &[u8]| sums.clone().restore(bytes);
    read(&bytes).unwrap();
    let refused = |found| matches!(found, Err(Error::Value { argument: "state", .. }));
    for cut in 0..bytes.len() {
        assert!(refused(read(&bytes[..cut])));
    }
    assert!(refused(read(&[&bytes[..], &[0]].concat())));
    assert!(refused(Accumulator::<f32>::new(Shape::new(3, 2), None).unwrap().restore(&bytes)));
    assert!(refused(Accumulator::<f32>::new(Shape::new(2, 3), Some(9.0)).unwrap().restore(&bytes)));
    assert!(refused(Accumulator::<u16>::new(Shape::new(2, 3), None).unwrap().restore(&bytes)));
}

/// Variance of the light of frames of a ramp, of which this share is missing in one frame.
fn light_of_ramp(missing: usize, mask: Option<&[bool]>) -> f64 {
    let shape = Shape::new(40, 50);
    let light = |frame: usize| 1.0 + 0.001 * frame as f64;
    let value = |frame: usize, pixel: usize| {
        if frame == 5 && pixel < missing { f64::NAN } else { light(frame) * pixel as f64 }
    };
    let frames: Vec<f64> =
        (0..20).flat_map(|frame| (0..shape.len()).map(move |pixel| value(frame, pixel))).collect();
    let mut sums = Accumulator::<f64>::new(shape, None).unwrap();
    if let Some(mask) = mask {
        sums = sums.masked(mask).unwrap();
    }
    let workers = Workers::new(None).unwrap();
    sums.add(&Stack::new("frames", &frames, 20, shape).unwrap(), &workers, &Control::new())
        .unwrap();
    sums.finish().light_variance
}

#[test]
fn blocks_of_missing_samples_are_no_light() {
    let whole = light_of_ramp(0, None);
    // Var(δ) of the ramp's mean, squared.
    let wanted = 35.0 * (0.001_f64 * 999.5).powi(2);
    assert!((whole / wanted - 1.0).abs() < 1e-9);
    // One of 20 deviations counts for half of its pixels, which have 1.5 times the light.
    assert!((light_of_ramp(1000, None) / wanted - 1.0).abs() < 2.0 / 20.0);
}

#[test]
fn masked_pixels_show_no_light() {
    let mask: Vec<bool> = (0..2000).map(|pixel| pixel >= 1000).collect();
    let wanted = 35.0 * (0.001_f64 * 499.5).powi(2);
    assert!((light_of_ramp(0, Some(&mask)) / wanted - 1.0).abs() < 1e-9);
    let sums = Accumulator::<u8>::new(Shape::new(3, 4), None).unwrap();
    assert!(matches!(sums.masked(&mask), Err(Error::Shape { argument: "mask", .. })));
}

#[test]
fn what_does_not_fit_is_refused() {
    let workers = Workers::new(None).unwrap();
    let mut sums = Accumulator::<u8>::new(Shape::new(2, 3), None).unwrap();
    let other = Stack::new("frames", &[0; 6], 1, Shape::new(3, 2)).unwrap();
    let refused = sums.add(&other, &workers, &Control::new());
    assert!(matches!(refused, Err(Error::Shape { .. })));
    let low = Accumulator::<u8>::new(Shape::new(2, 3), Some(9.0)).unwrap();
    assert!(matches!(sums.merge(&low), Err(Error::Value { .. })));
    assert!(matches!(Accumulator::<u8>::new(Shape::new(0, 3), None), Err(Error::Shape { .. })));
    assert!(Accumulator::<u8>::new(Shape::new(2, 3), Some(f64::NAN)).is_err());
}

#[test]
fn cancelled_work_stops() {
    let workers = Workers::new(None).unwrap();
    let mut sums = Accumulator::<u8>::new(Shape::new(1, 1), None).unwrap();
    let control = Control::new();
    control.cancel();
    let frame = Stack::new("frames", &[1], 1, Shape::new(1, 1)).unwrap();
    assert!(matches!(sums.add(&frame, &workers, &control), Err(Error::Cancelled)));
}

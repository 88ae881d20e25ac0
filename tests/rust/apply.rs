//! Frames corrected by the kernel against the formula written out.

use equipix_core::apply::{Alike, Corrected, Corrector, Counts, Raw, Unusable};
use equipix_core::{Control, Shape, Stack, Workers};

const SHAPE: Shape = Shape::new(37, 53);

fn coefficients(planes: usize) -> Vec<f32> {
    let typical = [-20.0, 1.0, 2e-6, -3e-11];
    (0..planes * SHAPE.len())
        .map(|index| {
            let (plane, pixel) = (index / SHAPE.len(), index % SHAPE.len());
            typical[plane] * (1.0 + 0.3 * (pixel as f32 * 0.7 + plane as f32).sin())
        })
        .collect()
}

fn frame() -> Vec<u16> {
    (0..SHAPE.len()).map(|pixel| ((pixel * 7919) % 65536) as u16).collect()
}

fn corrector(planes: usize, bad: &[usize], then: Unusable) -> Corrector {
    let mut unusable = vec![false; SHAPE.len()];
    bad.iter().for_each(|&pixel| unusable[pixel] = true);
    let values = coefficients(planes);
    Corrector::new(
        Stack::new("coefficients", &values, planes, SHAPE).unwrap(),
        &unusable,
        then,
        Alike::ALL,
    )
    .unwrap()
}

fn applied<I: Raw<f32>, O: Corrected<f32>>(
    corrector: &Corrector,
    frame: &[I],
    zero: O,
    largest: f32,
    workers: usize,
) -> (Vec<O>, u64) {
    let (out, counts) = counted(corrector, frame, zero, largest, workers);
    (out, counts.limited)
}

fn counted<I: Raw<f32>, O: Corrected<f32>>(
    corrector: &Corrector,
    frames: &[I],
    zero: O,
    largest: f32,
    workers: usize,
) -> (Vec<O>, Counts) {
    let mut out = vec![zero; frames.len()];
    let workers = Workers::new(std::num::NonZeroUsize::new(workers)).unwrap();
    let counts = corrector.apply(frames, &mut out, largest, &workers, &Control::new()).unwrap();
    (out, counts)
}

/// Σ c_j y^j in single precision by Horner's scheme.
fn formula(planes: usize, pixel: usize, y: f32) -> f32 {
    let values = coefficients(planes);
    (0..planes).rev().fold(0.0, |sum, plane| sum * y + values[plane * SHAPE.len() + pixel])
}

#[test]
fn single_precision_follows_the_formula_at_every_order() {
    for planes in 1..=4 {
        let (out, limited) =
            applied(&corrector(planes, &[], Unusable::Kept), &frame(), 0_f32, 0.0, 1);
        for (pixel, (&got, &y)) in out.iter().zip(&frame()).enumerate() {
            assert_eq!(got.to_bits(), formula(planes, pixel, f32::from(y)).to_bits());
        }
        assert_eq!(limited, 0);
    }
}

#[test]
fn whole_numbers_are_rounded_half_to_even_and_limited() {
    for (largest, planes) in [(65535.0, 2), (4095.0, 4), (255.0, 3)] {
        let (out, limited) =
            applied(&corrector(planes, &[], Unusable::Kept), &frame(), 0_u16, largest, 1);
        let mut wanted = 0;
        for (pixel, (&got, &y)) in out.iter().zip(&frame()).enumerate() {
            let value = formula(planes, pixel, f32::from(y)).round_ties_even();
            wanted += u64::from(!(0.0..=largest).contains(&value));
            assert_eq!(f32::from(got), value.clamp(0.0, largest), "pixel {pixel}");
        }
        assert_eq!(limited, wanted);
        assert!(wanted > 0);
    }
}

#[test]
fn halves_round_to_even_and_the_limits_hold_to_the_last_digit() {
    let shape = Shape::new(1, 8);
    let offsets = [0.5, 1.5, 2.5, -0.5, -0.500_000_06, 254.5, 255.499_98, 255.5];
    let corrector = Corrector::new(
        Stack::new("coefficients", &offsets, 1, shape).unwrap(),
        &[false; 8],
        Unusable::Kept,
        Alike::ALL,
    )
    .unwrap();
    let (mut out, workers) = ([9_u8; 8], Workers::new(None).unwrap());
    let counts = corrector.apply(&[0_u8; 8], &mut out, 255.0, &workers, &Control::new()).unwrap();
    assert_eq!(out, [0, 2, 2, 0, 0, 254, 255, 255]);
    assert_eq!(counts.limited, 2);
}

#[test]
fn frames_of_every_type_give_the_same_values() {
    let eight: Vec<u8> = frame().iter().map(|&y| (y % 256) as u8).collect();
    let sixteen: Vec<u16> = eight.iter().map(|&y| y.into()).collect();
    let single: Vec<f32> = eight.iter().map(|&y| y.into()).collect();
    let corrector = corrector(3, &[], Unusable::Kept);
    let wanted = applied(&corrector, &single, 0_f32, 0.0, 1);
    assert_eq!(applied(&corrector, &eight, 0_f32, 0.0, 1), wanted);
    assert_eq!(applied(&corrector, &sixteen, 0_f32, 0.0, 1), wanted);
}

#[test]
fn blank_pixels_are_not_numbers_or_zero_and_spoil_no_other() {
    let corrector = corrector(2, &[5, 60], Unusable::Blank);
    let (out, _) = applied(&corrector, &frame(), 0_f32, 0.0, 1);
    let blank: Vec<usize> = (0..out.len()).filter(|&pixel| out[pixel].is_nan()).collect();
    assert_eq!(blank, [5, 60]);
    let (whole, _) = applied(&corrector, &frame(), 7_u16, 65535.0, 1);
    assert_eq!((whole[5], whole[60]), (0, 0));
}

#[test]
fn replaced_pixels_are_means_of_their_usable_neighbours() {
    // One alone, one in a corner, and a 3×3 block whose middle has no usable neighbour.
    let block: Vec<usize> = (10..13).flat_map(|r| (20..23).map(move |c| r * 53 + c)).collect();
    let bad: Vec<usize> = [0, 5 * 53 + 5].into_iter().chain(block.iter().copied()).collect();
    let frame = frame();
    let (out, _) = applied(&corrector(2, &bad, Unusable::Replaced), &frame, 0_f32, 0.0, 1);
    let (kept, _) = applied(&corrector(2, &[], Unusable::Kept), &frame, 0_f32, 0.0, 1);
    let mean = |values: &[f32]| values.iter().sum::<f32>() / values.len() as f32;
    assert_eq!(out[0], mean(&[kept[1], kept[53], kept[54]]));
    let around: Vec<usize> = (10..13)
        .flat_map(|r| (20..23).map(move |c| r * 53 + c))
        .filter(|&p| p != 11 * 53 + 21)
        .collect();
    let middle: Vec<f32> = around.iter().map(|&p| out[p]).collect();
    assert_eq!(out[11 * 53 + 21], mean(&middle));
    for pixel in (0..out.len()).filter(|pixel| !bad.contains(pixel)) {
        assert_eq!(out[pixel], kept[pixel]);
    }
}

#[test]
fn a_raw_value_that_is_no_number_does_not_spread_to_its_neighbours() {
    let mut raw: Vec<f32> = frame().iter().map(|&y| y.into()).collect();
    raw[1] = f32::NAN;
    let (out, _) = applied(&corrector(2, &[0], Unusable::Replaced), &raw, 0_f32, 0.0, 1);
    let nan: Vec<usize> = (0..out.len()).filter(|&pixel| out[pixel].is_nan()).collect();
    assert_eq!(nan, [1]);
    assert_eq!(out[0], (out[53] + out[54]) / 2.0);
}

#[test]
fn a_replaced_pixel_counts_once() {
    // Every value is above the limit, so all are limited: each pixel once.
    let corrector = corrector(2, &[0, 54, 700], Unusable::Replaced);
    let frame = vec![60000_u16; SHAPE.len()];
    let (out, limited) = applied(&corrector, &frame, 0_u8, 255.0, 1);
    assert_eq!(limited, SHAPE.len() as u64);
    assert!(out.iter().all(|&value| value == 255));
}

#[test]
fn a_sensor_without_a_usable_pixel_is_blank() {
    let all: Vec<usize> = (0..SHAPE.len()).collect();
    let (out, _) = applied(&corrector(2, &all, Unusable::Replaced), &frame(), 0_f32, 0.0, 1);
    assert!(out.iter().all(|value| value.is_nan()));
}

#[test]
fn any_number_of_workers_gives_the_same_bytes() {
    // Above 2^20 pixels, where several threads work.
    let shape = Shape::new(1031, 1029);
    let planes: Vec<f32> = (0..2 * shape.len())
        .map(|index| if index < shape.len() { -20.0 } else { 1.0 + (index % 997) as f32 * 1e-4 })
        .collect();
    let mut unusable = vec![false; shape.len()];
    unusable[70_000..70_009].fill(true);
    let stack = Stack::new("coefficients", &planes, 2, shape).unwrap();
    let corrector = Corrector::new(stack, &unusable, Unusable::Replaced, Alike::ALL).unwrap();
    let raw: Vec<u16> = (0..shape.len()).map(|pixel| (pixel * 7919 % 65536) as u16).collect();
    let by = |workers| {
        let (mut out, control) = (vec![0_u16; shape.len()], Control::new());
        let workers = Workers::new(std::num::NonZeroUsize::new(workers)).unwrap();
        let counts = corrector.apply(&raw, &mut out, 65535.0, &workers, &control).unwrap();
        (out, counts.limited)
    };
    let wanted = by(1);
    assert!(wanted.1 > 0);
    assert_eq!(by(3), wanted);
}

#[test]
fn arrays_of_other_sizes_are_refused() {
    let corrector = corrector(2, &[], Unusable::Kept);
    let (workers, control) = (Workers::new(None).unwrap(), Control::new());
    let refused = corrector.apply(&[0_u8; 3], &mut [0_u8; 3], 255.0, &workers, &control);
    assert!(refused.unwrap_err().to_string().contains("expected (37, 53)"));
}

#[test]
fn a_stack_is_its_frames_one_by_one_for_any_number_of_workers() {
    // Above 2^20 values, where each thread takes whole frames.
    let corrector = corrector(4, &[0, 54, 55, 700], Unusable::Replaced);
    let count = (1 << 20) / SHAPE.len() + 1;
    let frames: Vec<u16> =
        (0..count * SHAPE.len()).map(|value| (value * 7919 % 65536) as u16).collect();
    let (wanted, counts) = counted(&corrector, &frames, 0_u16, 4095.0, 1);
    assert!(counts.limited > 0);
    assert_eq!(counted(&corrector, &frames, 0_u16, 4095.0, 3), (wanted.clone(), counts));
    let mut limited = 0;
    for (raw, wanted) in frames.chunks(SHAPE.len()).zip(wanted.chunks(SHAPE.len())) {
        let (out, of_frame) = applied(&corrector, raw, 0_u16, 4095.0, 1);
        assert_eq!(out, wanted);
        limited += of_frame;
    }
    assert_eq!(limited, counts.limited);
}

#[test]
fn values_outside_of_the_levels_of_their_pixel_are_counted() {
    // The value is the raw one. Two pixels have fewer levels, one has none, one is replaced.
    let shape = Shape::new(2, 4);
    let identity = [[0.0; 8], [1.0; 8]].concat();
    let mut levels = [[10.0_f32; 8], [100.0; 8]].concat();
    levels[8 + 1] = 50.0;
    levels[2] = 40.0;
    (levels[3], levels[8 + 3]) = (f32::NAN, f32::NAN);
    let mut unusable = [false; 8];
    unusable[7] = true;
    let corrector = Corrector::new(
        Stack::new("coefficients", &identity, 2, shape).unwrap(),
        &unusable,
        Unusable::Replaced,
        Alike::ALL,
    )
    .unwrap()
    .with_levels(Stack::new("levels", &levels, 2, shape).unwrap())
    .unwrap();
    for (raw, wanted) in [
        ([10_u16, 50, 40, 10, 100, 99, 11, 0], 0),
        ([10, 51, 39, 10, 100, 99, 11, 0], 2),
        ([9, 9, 9, 9, 101, 101, 101, 500], 7),
    ] {
        let (_, counts) = counted(&corrector, &raw, 0_u16, 65535.0, 1);
        assert_eq!((counts.extrapolated, counts.limited), (wanted, 0), "{raw:?}");
    }
}

#[test]
fn the_largest_raw_value_is_found_in_every_type() {
    let corrector = corrector(2, &[], Unusable::Kept);
    for pixel in [0, 15, 16, 1000, SHAPE.len() - 1] {
        let mut raw = vec![7_u16; SHAPE.len()];
        raw[pixel] = 200;
        let eight: Vec<u8> = raw.iter().map(|&y| y as u8).collect();
        let mut single: Vec<f32> = raw.iter().map(|&y| y.into()).collect();
        single[3] = f32::NAN;
        assert_eq!(counted(&corrector, &raw, 0_f32, 0.0, 1).1.highest, 200.0);
        assert_eq!(counted(&corrector, &eight, 0_f32, 0.0, 1).1.highest, 200.0);
        assert_eq!(counted(&corrector, &single, 0_f32, 0.0, 1).1.highest, 200.0);
    }
    assert_eq!(counted(&corrector, &vec![-1_f32; SHAPE.len()], 0_f32, 0.0, 1).1.highest, 0.0);
}

#[test]
fn a_pixel_behind_filters_is_replaced_by_the_nearest_of_its_colour() {
    // RGGB, four rows of six; red at even rows and columns, blue at odd ones.
    let shape = Shape::new(4, 6);
    let colours: Vec<u8> = (0..24).map(|p| (p / 6 % 2 + p % 6 % 2) as u8).collect();
    let frame: Vec<f32> =
        (0..24).map(|p| [100.0, 300.0, 130.0][usize::from(colours[p])] + p as f32).collect();
    let planes = [[0.0_f32; 24], [1.0; 24]].concat();
    let mut unusable = [false; 24];
    let (red, green) = (2 * 6 + 2, 6 + 2);
    (unusable[red], unusable[green]) = (true, true);
    let corrector = Corrector::new(
        Stack::new("coefficients", &planes, 2, shape).unwrap(),
        &unusable,
        Unusable::Replaced,
        Alike { colours: Some(&colours), reach: 2 },
    )
    .unwrap();
    let (mut out, workers) = ([0.0_f32; 24], Workers::new(None).unwrap());
    corrector.apply(&frame, &mut out, 0.0, &workers, &Control::new()).unwrap();
    // Five red ones two pixels away, and the four green ones on the diagonals.
    assert_eq!(out[red], (100 * 5 + 12 + 16 + 2 + 4) as f32 / 5.0 + 0.0);
    assert_eq!(out[green], (300 * 4 + 1 + 3 + 13 + 15) as f32 / 4.0);
}

#[test]
fn double_precision_follows_the_formula_and_replaces_pixels() {
    let values: Vec<f64> = coefficients(4).iter().map(|&value| f64::from(value) / 3.0).collect();
    let raw: Vec<f64> = frame().iter().map(|&y| f64::from(y) / 7.0).collect();
    let formula = |pixel: usize| {
        (0..4).rev().fold(0.0, |sum, plane| sum * raw[pixel] + values[plane * SHAPE.len() + pixel])
    };
    let mut unusable = vec![false; SHAPE.len()];
    unusable[0] = true;
    let stack = Stack::new("coefficients", &values, 4, SHAPE).unwrap();
    let corrector = Corrector::new(stack, &unusable, Unusable::Replaced, Alike::ALL).unwrap();
    let (mut out, workers) = (vec![0_f64; SHAPE.len()], Workers::new(None).unwrap());
    let counts = corrector.apply(&raw, &mut out, 0.0, &workers, &Control::new()).unwrap();
    for (pixel, &got) in out.iter().enumerate().skip(1) {
        assert_eq!(got.to_bits(), formula(pixel).to_bits());
    }
    assert_eq!(out[0], (formula(1) + formula(53) + formula(54)) / 3.0);
    let highest = raw.iter().copied().fold(0.0, f64::max);
    assert_eq!((counts.highest, counts.limited), (highest, 0));
}

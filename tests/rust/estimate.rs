//! The estimated error of small problems, many of them nearly singular: a positive number, and no convergence
//! without one.

use proptest::prelude::*;
use proptest::test_runner::RngSeed;

use crate::common::{Experiment, Lamp, Noise, Options, fit};

/// What a shift of so many eighths of a pixel is where all are whole, or between pixels.
fn shift(eighths: [i64; 2], whole: bool) -> [f64; 2] {
    eighths.map(|d| if whole { (d / 8) as f64 } else { d as f64 / 8.0 })
}

/// Experiments of three to five exposures, along one line or not, in structured light that may fade to nothing.
fn experiments() -> impl Strategy<Value = Experiment> {
    let sizes = (2..7_usize, 3..10_usize, 3..6_usize);
    let kinds = (0..4_u8, any::<[bool; 4]>(), 0..3_u8, any::<u64>());
    (sizes, kinds)
        .prop_flat_map(|((rows, cols, count), (lamp, is, fading, seed))| {
            let shifts = prop::collection::vec([-16..17_i64, -16..17_i64], count);
            (Just(([rows, cols], lamp, is, fading, seed)), shifts)
        })
        .prop_map(|((shape, lamp, [whole, along, refined, offset], fading, seed), places)| {
            let shifts =
                places.iter().map(|&[row, col]| shift([if along { 0 } else { row }, col], whole));
            made(shape, &shifts.collect::<Vec<_>>(), [refined, offset], lamp, fading, seed)
        })
}

fn made(
    shape: [usize; 2],
    shifts: &[[f64; 2]],
    [refined, offset]: [bool; 2],
    lamp: u8,
    fading: u8,
    seed: u64,
) -> Experiment {
    let shifts = if offset { [shifts, shifts].concat() } else { shifts.to_vec() };
    let (count, pixels) = (shifts.len(), shape[0] * shape[1]);
    let flux: Vec<f64> =
        (0..count).map(|k| if offset && 2 * k >= count { 0.5 } else { 1.0 }).collect();
    let mut state = seed | 1;
    let mut random = || {
        // Xorshift (Marsaglia 2003).
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state as f64 / u64::MAX as f64 - 0.5
    };
    let mut frames = Vec::new();
    for (d, c) in shifts.iter().zip(&flux) {
        for pixel in 0..pixels {
            let at = [(pixel / shape[1]) as f64 + d[0], (pixel % shape[1]) as f64 + d[1]];
            let fade = (-0.4 * f64::from(fading) * at[1].max(0.0)).exp();
            let light = fade * (1.0 + 0.3 * (0.9 * at[0] + 0.5 * at[1]).sin());
            frames.push(c * light * (1.0 + 0.1 * (7.0 * pixel as f64).sin()) + 0.02 * random());
        }
    }
    let times = (0..count).map(|k| ((k * 3) % count) as f64).collect();
    Experiment {
        shape,
        frames,
        shift_std: refined.then(|| vec![[0.05; 2]; count]),
        degrees: vec![0; count],
        lamp: match lamp {
            0 => Lamp::Known,
            1 => Lamp::Free,
            2 => Lamp::Linear(times),
            _ => Lamp::Prior(vec![0.01; count]),
        },
        noise: Noise::Exposures(vec![0.02 * 0.02 / 12.0; count]),
        mask: Vec::new(),
        offset,
        dark: Vec::new(),
        flux,
        shifts,
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, rng_seed: RngSeed::Fixed(1), ..ProptestConfig::default() })]
    #[test]
    fn every_estimate_is_positive_and_only_a_number_within_the_tolerance_has_converged(
        experiment in experiments(),
    ) {
        let options = Options { most_passes: Some(300), workers: 1, ..Options::to(1e-6) };
        if let Ok(answer) = fit(&experiment, options) {
            prop_assert!(answer.history.iter().all(|look| look.error > 0.0));
            let last = answer.history.last().unwrap().error;
            prop_assert!(!answer.converged || last <= 1e-6);
        }
    }
}

//! Corrections from the scene on a small moving scene whose gains and offsets are known.

use std::f64::consts::PI;
use std::num::NonZeroUsize;

use equipix_core::scene::{Options, SceneCorrection};
use equipix_core::{Error, Shape, Workers};

const SHAPE: Shape = Shape::new(64, 80);

/// Numbers from −1 to 1 by a linear congruence.
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }

    /// A number of mean 0 and standard deviation 1.
    fn normal(&mut self) -> f64 {
        (0..3).map(|_| self.next()).sum()
    }
}

/// Waves of amplitude 1/f, moved along a curve, on pixels with gains and offsets.
struct Scene {
    waves: Vec<[f64; 3]>,
    gain: Vec<f64>,
    offset: Vec<f64>,
    noise: Random,
}

impl Scene {
    fn new(seed: u64) -> Self {
        let mut random = Random(seed);
        let mut wave = || {
            // From 1/64 to 0.45 cycles per pixel, as many in each octave: amplitudes 1/f in the plane.
            let frequency = (28.8_f64).powf(0.5 + 0.5 * random.next()) / 64.0;
            let (sin, cos) = (PI * random.next()).sin_cos();
            let angular = 2.0 * PI * frequency;
            [angular * sin, angular * cos, PI * random.next()]
        };
        let waves: Vec<_> = (0..60).map(|_| wave()).collect();
        let gain = (0..SHAPE.len()).map(|_| 1.0 + 0.05 * random.normal()).collect();
        let offset = (0..SHAPE.len()).map(|_| 0.1 * random.normal()).collect();
        Self { waves, gain, offset, noise: Random(seed + 1) }
    }

    /// Mean level at a frame.
    fn level(index: usize) -> f64 {
        0.5 - 0.25 * (index as f64 * 0.01).cos()
    }

    fn position(index: usize) -> [f64; 2] {
        let t = index as f64;
        [40.0 * (0.031 * t).sin() + 0.37 * t, 60.0 * (0.023 * t).cos() - 0.21 * t]
    }

    /// Contrast 0.1 rms: 60 waves of amplitude a have the rms a √30.
    fn light(&self, index: usize) -> Vec<f64> {
        let [top, left] = Self::position(index);
        let amplitude = 0.1 / 30.0_f64.sqrt();
        let mut light = vec![Self::level(index); SHAPE.len()];
        for [u, v, phase] in &self.waves {
            let along: Vec<_> =
                (0..SHAPE.cols).map(|col| (v * (col as f64 + left)).sin_cos()).collect();
            for (row, line) in light.chunks_mut(SHAPE.cols).enumerate() {
                let (sin, cos) = (u * (row as f64 + top) + phase).sin_cos();
                for (value, (s, c)) in line.iter_mut().zip(&along) {
                    *value += amplitude * (cos * c - sin * s);
                }
            }
        }
        light
    }

    fn frame(&mut self, index: usize) -> Vec<f32> {
        let light = self.light(index);
        let pixels = light.iter().zip(&self.gain).zip(&self.offset);
        pixels.map(|((x, g), o)| (g * x + o + 0.002 * self.noise.normal()) as f32).collect()
    }

    /// Standard deviations of what a correction leaves at the level 1/2, and of its gains.
    fn left(&self, scene: &SceneCorrection) -> [f64; 2] {
        let pixels =
            || (0..SHAPE.len()).map(|p| (f64::from(scene.gain()[p]), f64::from(scene.offset()[p])));
        let response: Vec<_> = pixels().zip(&self.gain).map(|((g, _), gain)| g * gain).collect();
        let pattern = pixels().zip(&response).zip(&self.offset);
        let pattern: Vec<_> =
            pattern.map(|(((g, o), r), offset)| (r - 1.0) * 0.5 + g * offset + o).collect();
        [deviation(&pattern), deviation(&response)]
    }
}

fn deviation(values: &[f64]) -> f64 {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
}

fn options() -> [Options; 5] {
    let kernel = vec![0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0];
    [
        Options::LocalMean { step: 0.02, kernel, sizes: [3, 3] },
        Options::Gated { step: 0.05, width: 11, threshold: 0.02, texture: 100.0 },
        registered(0.1),
        Options::ConstantStatistics { width: 21, window: 4000, motion: 0.004, prior: 100 },
        Options::Kalman {
            width: 21,
            block: 50,
            motion: 0.004,
            gain_spread: 0.05,
            offset_spread: 0.1,
            memory: 1e6,
        },
    ]
}

fn registered(step: f64) -> Options {
    Options::Registered { step, least_motion: 0.5, most_motion: 8, cutoff: 0.1, agreement: 0.3 }
}

fn workers(count: usize) -> Workers {
    Workers::new(NonZeroUsize::new(count)).unwrap()
}

fn made(options: &Options) -> SceneCorrection {
    SceneCorrection::new(SHAPE, [0.0, 1.0], options).unwrap()
}

fn learn(scene: &mut SceneCorrection, frames: &[Vec<f32>], count: usize) -> u64 {
    let (workers, mut corrected) = (workers(count), vec![0.0; SHAPE.len()]);
    frames
        .iter()
        .filter(|frame| scene.update(frame, &mut corrected, None, &workers).unwrap())
        .count() as u64
}

fn frames(count: usize) -> (Scene, Vec<Vec<f32>>) {
    let mut scene = Scene::new(7);
    let frames = (0..count).map(|index| scene.frame(index)).collect();
    (scene, frames)
}

#[test]
fn the_pattern_and_the_gain_error_fall() {
    let (truth, frames) = frames(500);
    // The figures of the standard scene after 500 moving frames; of the gain error a quarter of the way to
    // its figure after 2000, 1.8 or 2.5. A frozen gain stays at 1.
    let least = [(5.0, 0.0), (6.0, 0.0), (12.0, 1.2), (8.0, 1.375), (8.0, 1.375)];
    for (options, (pattern, gain)) in options().iter().zip(least) {
        let mut scene = made(options);
        let before = truth.left(&scene);
        learn(&mut scene, &frames, 2);
        let after = truth.left(&scene);
        let falls = [before[0] / after[0], before[1] / after[1]];
        assert!(falls[0] > pattern, "{options:?}: {falls:?}");
        assert!(falls[1] > gain, "{options:?}: {falls:?}");
    }
}

#[test]
fn the_gauge_holds_at_every_step() {
    let (_, frames) = frames(60);
    for options in options() {
        let mut scene = made(&options);
        for frame in &frames {
            learn(&mut scene, std::slice::from_ref(frame), 2);
            let mean = |values: &[f32]| {
                values.iter().map(|value| f64::from(*value)).sum::<f64>() / values.len() as f64
            };
            // A value is rounded to half a unit in the last place of a number below 2.
            assert!(
                (mean(scene.gain()) - 1.0).abs() < 2.0 * f64::from(f32::EPSILON),
                "{options:?}"
            );
            assert!(mean(scene.offset()).abs() < 2.0 * f64::from(f32::EPSILON), "{options:?}");
        }
    }
}

#[test]
fn the_bytes_depend_neither_on_workers_nor_on_a_break() {
    let (_, frames) = frames(110);
    for options in options() {
        let (mut one, mut three, mut resumed) = (made(&options), made(&options), made(&options));
        learn(&mut one, &frames[..60], 1);
        resumed.restore(&one.snapshot()).unwrap();
        learn(&mut one, &frames[60..], 1);
        learn(&mut resumed, &frames[60..], 2);
        learn(&mut three, &frames, 3);
        assert!(one.gain().iter().any(|gain| *gain != 1.0));
        assert_eq!(one.snapshot(), three.snapshot());
        assert_eq!(one.snapshot(), resumed.snapshot());
    }
}

#[test]
fn unusable_frames_change_nothing() {
    let (_, mut frames) = frames(61);
    let last = frames.pop().unwrap();
    for options in options() {
        let mut scene = made(&options);
        learn(&mut scene, &frames, 2);
        let before = scene.snapshot();
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let mut frame = last.clone();
            frame[700] = bad;
            assert_eq!(learn(&mut scene, &[frame], 2), 0);
        }
        assert_eq!(learn(&mut scene, &[vec![0.5; SHAPE.len()]], 2), 0);
        let (mut frame, mut corrected) = (last.clone(), vec![0.0; SHAPE.len()]);
        frame[700] = 2.5;
        assert!(scene.update(&frame, &mut corrected, None, &workers(2)).is_err());
        assert!(scene.update(&frame[1..], &mut corrected, None, &workers(2)).is_err());
        assert_eq!(scene.snapshot(), before);
    }
}

#[test]
fn a_scene_that_stands_still_counts_for_nothing_where_motion_is_needed() {
    let (mut truth, _) = frames(0);
    let frames: Vec<_> = (0..20).map(|_| truth.frame(3)).collect();
    for options in &options()[1..4] {
        assert_eq!(learn(&mut made(options), &frames, 2), 0, "{options:?}");
    }
}

#[test]
fn steps_from_the_bound_on_are_refused_with_it() {
    for (step, bound) in [(0.25, "0.2500"), (0.3, "0.2500"), (0.0, "0.2500"), (f64::NAN, "0.2500")]
    {
        let refused = SceneCorrection::new(SHAPE, [0.0, 1.0], &registered(step)).unwrap_err();
        assert!(matches!(&refused, Error::Value { argument: "step", .. }));
        assert!(refused.to_string().contains(bound), "{refused}");
    }
}

#[test]
fn a_snapshot_that_does_not_fit_is_refused_whole() {
    let (_, frames) = frames(60);
    for options in options() {
        let mut scene = made(&options);
        learn(&mut scene, &frames, 2);
        let (good, before) = (scene.snapshot(), made(&options).snapshot());
        let mut fresh = made(&options);
        let mut lacking = good.clone();
        lacking.maps.pop();
        let mut cut = good.clone();
        cut.maps[1].1[0] -= 1;
        let mut wrong = good.clone();
        wrong.maps[1].2[5] = f32::NAN;
        let mut counts = good.clone();
        counts.counts.clear();
        for bad in [lacking, cut, wrong, counts] {
            assert!(fresh.restore(&bad).is_err());
            assert_eq!(fresh.snapshot(), before);
        }
    }
}

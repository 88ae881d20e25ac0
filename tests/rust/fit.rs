//! Laws of a fit: the light of its beam leaves the residuals that it minimised; a start saves passes and
//! changes nothing; questions do not depend on each other.

use equipix_core::{
    Control, Ended, Exposures, Fit, Flux, FluxKind, Mask, Measurements, Method, Options, Positions,
    Result, Rotation, Shape, Stack, Variance, Workers, calibrate,
};

const SENSOR: Shape = Shape::new(28, 36);
const COUNT: usize = 5;
/// Standard deviation of the noise.
const NOISE: f64 = 1e-3;

/// What is known of a simulated experiment, and what is sought.
#[derive(Clone)]
struct Case {
    positions: Positions,
    flux: Flux,
    offset: bool,
    /// True shifts and fluxes.
    shifts: Vec<[f64; 2]>,
    lamp: Vec<f64>,
}

impl Case {
    fn at(shifts: [[f64; 2]; COUNT]) -> Self {
        let flux = Flux::steady(COUNT);
        let positions = Positions::of_shifts(&shifts);
        Self { positions, lamp: flux.values.clone(), flux, offset: false, shifts: shifts.to_vec() }
    }

    fn with_lamp(mut self, lamp: [f64; COUNT], kind: FluxKind) -> Self {
        if kind == FluxKind::Known {
            self.flux.values = lamp.to_vec();
        }
        self.lamp = lamp.to_vec();
        self.flux.kind = kind;
        self
    }

    /// y = c L M + O + noise.
    fn frames(&self) -> Vec<f64> {
        let pixels = SENSOR.len();
        let value = |index: usize| {
            let (k, pixel) = (index / pixels, index % pixels);
            let [row, col] = [pixel / SENSOR.cols, pixel % SENSOR.cols].map(|p| p as f64);
            let [u, v] = match self.positions.rotations[k] {
                Rotation::Half => [SENSOR.rows as f64 - 1.0 - row, SENSOR.cols as f64 - 1.0 - col],
                _ => [row, col],
            };
            let m = 1.0 + 0.05 * white(pixel) + 0.03 * (0.1 * row).sin();
            let offset = if self.offset { 0.02 * (1.0 + white(pixel + 7919)) } else { 0.0 };
            let light = beam(u + self.shifts[k][0], v + self.shifts[k][1]);
            // Uniform noise of that standard deviation.
            self.lamp[k] * m * light + offset + NOISE * 3_f64.sqrt() * white(index + 104_729)
        };
        (0..COUNT * pixels).map(value).collect()
    }

    /// Calls `visit` with the exposures.
    fn with<R>(
        &self,
        frames: &[f64],
        variance: &[f64],
        visit: impl FnOnce(&Exposures<'_, f64>, &Workers, &Control) -> Result<R>,
    ) -> R {
        let (workers, control) = (Workers::new(None).unwrap(), Control::new());
        let measurements = Measurements {
            frames: Stack::new("frames", frames, COUNT, SENSOR).unwrap(),
            variance: Variance::Measurements(
                Stack::new("variance", variance, COUNT, SENSOR).unwrap(),
            ),
            mask: Mask::None,
        };
        let (positions, flux) = (self.positions.clone(), self.flux.clone());
        let exposures =
            Exposures::new(measurements, positions, flux, self.offset, &workers, &control).unwrap();
        visit(&exposures, &workers, &control).unwrap()
    }

    fn fit(&self, frames: &[f64], variance: &[f64], options: &Options, start: Option<&Fit>) -> Fit {
        let start = start.map(|start| start.start().unwrap());
        self.with(frames, variance, |exposures, workers, control| {
            calibrate(exposures, options, start, workers, control)
        })
    }
}

/// A beam with structure that determines shifts.
fn beam(u: f64, v: f64) -> f64 {
    let fall = (-((u - 18.0).powi(2) + (v - 22.0).powi(2)) / 120_f64.powi(2)).exp();
    fall * (1.0 + 0.08 * (u / 6.0).sin() * (v / 7.0).cos() + 0.05 * ((u + v) / 4.0).sin())
}

/// A number from −1 to 1 that looks random: SplitMix64 (Steele, Lea and Flood 2014).
fn white(index: usize) -> f64 {
    let mut bits = (index as u64).wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (bits ^ (bits >> 31)) as f64 / (1_u64 << 63) as f64 - 1.0
}

const WHOLE: [[f64; 2]; COUNT] = [[0.0, 0.0], [0.0, 5.0], [0.0, 7.0], [5.0, 0.0], [7.0, 0.0]];
const BETWEEN: [[f64; 2]; COUNT] = [[0.0, 0.0], [0.3, 5.4], [-0.2, 7.1], [5.3, 0.45], [6.6, -0.4]];
/// Whole pixels apart.
const APART: [[f64; 2]; COUNT] = [[0.1, -0.4], [0.1, 4.6], [0.1, 6.6], [5.1, -0.4], [7.1, -0.4]];
const DRIFT: [f64; COUNT] = [1.0, 1.004, 0.997, 1.002, 0.999];

/// One of every kind.
fn cases() -> Vec<(&'static str, Case)> {
    let mut turned = Case::at(BETWEEN).with_lamp(DRIFT, FluxKind::Free);
    turned.positions.rotations[2] = Rotation::Half;
    let mut refined = Case::at(BETWEEN).with_lamp(DRIFT, FluxKind::Prior(vec![3e-3; COUNT]));
    refined.positions.std = Some(vec![[0.02; 2]; COUNT]);
    for (k, shift) in refined.positions.shifts.iter_mut().enumerate() {
        *shift = [0, 1].map(|axis| shift[axis] + 0.02 * white(2 * k + axis));
    }
    let beside = [[0.1, -0.4], [1.1, -0.4], [0.1, 0.6], [5.1, 3.6], [7.1, -3.4]];
    let mut turned_apart = Case::at(beside).with_lamp(DRIFT, FluxKind::Free);
    turned_apart.positions.rotations[4] = Rotation::Half;
    let mut dark = Case::at(WHOLE).with_lamp([1.0, 0.5, 1.0, 0.7, 0.8], FluxKind::Known);
    dark.offset = true;
    let times = vec![0.0, 30.0, 10.0, 40.0, 20.0];
    let linear = [0, 3, 1, 4, 2].map(|t| (1e-3 * f64::from(t)).exp());
    vec![
        ("whole", Case::at(WHOLE)),
        ("free fluxes", Case::at(WHOLE).with_lamp(DRIFT, FluxKind::Free)),
        ("between pixels", Case::at(BETWEEN)),
        ("free fluxes between pixels", Case::at(BETWEEN).with_lamp(DRIFT, FluxKind::Free)),
        ("turned", turned),
        ("whole pixels apart", Case::at(APART)),
        ("free fluxes whole pixels apart, turned", turned_apart),
        ("linear", Case::at(BETWEEN).with_lamp(linear, FluxKind::Linear(times))),
        ("refined", refined),
        ("dark", dark),
    ]
}

/// Iterations before an estimate of the error is made, of any fit.
const ESTIMATED: f64 = 10.0;
const TO: Options = Options { method: Method::Multiscale, tolerance: 1e-6, max_sweeps: None };

/// Σ w (y − c L M − O)², L being the light of the beam that was fitted.
fn misfit(case: &Case, fit: &Fit, frames: &[f64], variance: &[f64]) -> f64 {
    let workers = Workers::new(None).unwrap();
    let mut sum = 0.0;
    for k in 0..COUNT {
        let rotation = case.positions.rotations[k];
        let signal = fit.predict(fit.shifts[k], rotation, fit.flux[k], SENSOR, &workers);
        for (pixel, signal) in signal.iter().enumerate() {
            let index = k * SENSOR.len() + pixel;
            let offset = fit.offset.as_ref().map_or(0.0, |offset| offset[pixel]);
            sum += (frames[index] - signal - offset).powi(2) / variance[index];
        }
    }
    sum
}

#[test]
fn the_light_of_the_beam_leaves_the_residuals_that_were_minimised() {
    for (name, case) in cases() {
        let frames = case.frames();
        let variance = vec![NOISE * NOISE; frames.len()];
        let fit = case.fit(&frames, &variance, &TO, None);
        let sum = misfit(&case, &fit, &frames, &variance);
        // A prediction of size 1 takes some 60 roundings, its residual is 1e-3 of it, and F is their
        // sum of squares: off by 60 eps / 1e-3 twice if all were of one sign.
        let rounding = 2.0 * 60.0 * f64::EPSILON / NOISE;
        assert!((sum / fit.misfit - 1.0).abs() < rounding, "{name}: {sum} {}", fit.misfit);
    }
}

#[test]
fn a_start_leads_to_the_same_minimum_in_fewer_passes() {
    for (name, case) in cases() {
        let frames = case.frames();
        let variance = vec![NOISE * NOISE; frames.len()];
        let first = case.fit(&frames, &variance, &TO, None);
        assert_eq!(first.history.ended, Ended::Converged, "{name}");
        let other: Vec<f64> =
            (0..).zip(&variance).map(|(i, v)| v * (1.0 + 0.1 * white(i + 31))).collect();
        for (variance, share) in [(&variance, 0.5), (&other, 0.9)] {
            let scratch = case.fit(&frames, variance, &TO, None);
            let again = case.fit(&frames, variance, &TO, Some(&first));
            assert_eq!(again.history.ended, Ended::Converged, "{name}");
            let passes = [&again, &scratch].map(|fit| fit.history.last().sweep as f64);
            // Of the passes beyond those that an estimate of the error takes from any start.
            let [started, whole] = passes.map(|count| count - ESTIMATED);
            assert!(started < share * whole, "{name}: {passes:?}");
            // Both are within the tolerance of the minimum, by an estimate that is at most 3.6 times
            // too small on small problems (docs/estimate.py).
            for (a, b) in again.sensitivity.iter().zip(&scratch.sensitivity) {
                assert!((a / b - 1.0).abs() < 2.0 * 3.6 * TO.tolerance, "{name}: {a} {b}");
            }
        }
    }
}

#[test]
fn a_start_may_come_from_another_kind_of_fit() {
    let (whole, free) = (Case::at(WHOLE), Case::at(WHOLE).with_lamp(DRIFT, FluxKind::Free));
    let frames = free.frames();
    let variance = vec![NOISE * NOISE; frames.len()];
    let (apart, between) = (Case::at(APART), Case::at(BETWEEN));
    let pairs = [
        (&whole, &free),
        (&free, &whole),
        (&between, &whole),
        (&apart, &between),
        (&between, &apart),
        (&apart, &free),
        (&free, &apart),
    ];
    for (from, to) in pairs {
        let start = from.fit(&frames, &variance, &TO, None);
        let (scratch, again) =
            (to.fit(&frames, &variance, &TO, None), to.fit(&frames, &variance, &TO, Some(&start)));
        for (a, b) in again.sensitivity.iter().zip(&scratch.sensitivity) {
            assert!((a / b - 1.0).abs() < 2.0 * 3.6 * TO.tolerance);
        }
    }
}

#[test]
fn a_start_of_another_sensor_is_refused() {
    let case = Case::at(WHOLE);
    let frames = case.frames();
    let variance = vec![NOISE * NOISE; frames.len()];
    let mut start = case.fit(&frames, &variance, &TO, None);
    start.sensitivity.pop();
    let refused = case.with(&frames, &variance, |exposures, workers, control| {
        Ok(calibrate(exposures, &TO, Some(start.start()?), workers, control).unwrap_err())
    });
    assert!(refused.to_string().starts_with("'start' has shape 5 exposures of 1007 pixels"));
}

#[test]
fn the_weight_of_a_pixel_is_what_its_measurements_say() {
    for (name, case) in cases() {
        let frames = case.frames();
        let variance: Vec<f64> =
            (0..frames.len()).map(|i| NOISE * NOISE * (1.0 + 0.1 * white(i))).collect();
        let fit = case.fit(&frames, &variance, &TO, None);
        let found = case.with(&frames, &variance, |exposures, workers, control| {
            fit.information(exposures, workers, control)
        });
        let workers = Workers::new(None).unwrap();
        let mut wanted = vec![0.0; SENSOR.len()];
        for k in 0..COUNT {
            let light =
                fit.beam.light(fit.shifts[k], case.positions.rotations[k], SENSOR, &workers);
            for (pixel, light) in light.iter().enumerate() {
                let weight = 1.0 / variance[k * SENSOR.len() + pixel];
                wanted[pixel] += weight * (fit.flux[k] * light).powi(2);
            }
        }
        // Five terms of four roundings, all of one sign.
        let close = |(a, b): (&f64, &f64)| (a / b - 1.0).abs() < 20.0 * f64::EPSILON;
        assert!(found.iter().zip(&wanted).all(close), "{name}");
    }
}

#[test]
fn answers_do_not_depend_on_what_was_asked_before() {
    for (name, case) in
        cases().into_iter().filter(|case| ["whole", "refined", "dark"].contains(&case.0))
    {
        let frames = case.frames();
        let variance = vec![NOISE * NOISE; frames.len()];
        let fit = case.fit(&frames, &variance, &TO, None);
        let half = SENSOR.len() / 2;
        let functional: Vec<f64> =
            (0..SENSOR.len()).map(|p| if p < half { 1.0 } else { -1.0 }).collect();
        case.with(&frames, &variance, |exposures, workers, control| {
            let mut fresh = fit.uncertainty(exposures, workers, control)?;
            let variances = fresh.variances(&functional)?;
            let mut asked = fit.uncertainty(exposures, workers, control)?;
            let map = asked.error_map()?;
            let shifts = asked.shift_variances()?;
            let offset = asked.offset_variances()?;
            assert_eq!(asked.variances(&functional)?, variances, "{name}");
            assert_eq!(fresh.shift_variances()?, shifts, "{name}");
            assert_eq!(fresh.offset_variances()?, offset, "{name}");
            assert_eq!(fresh.error_map()?.std, map.std, "{name}");
            assert_eq!(shifts.is_some(), case.positions.std.is_some(), "{name}");
            assert_eq!(offset.is_some(), case.offset, "{name}");
            Ok(())
        });
    }
}

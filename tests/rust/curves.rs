//! Response curves against polynomials that are known, and against the dense formula.

use equipix_core::curves::{Form, LevelNoise, Levels, fit};
use equipix_core::{Control, Shape, Stack, Workers};

const SHAPE: Shape = Shape::new(3, 4);
const REFERENCES: [f64; 6] = [100.0, 700.0, 1500.0, 2100.0, 3000.0, 4000.0];

/// a, K, c, e of pixel p.
fn truth(p: usize) -> [f64; 4] {
    let p = p as f64;
    [3.0 - p, 0.02 * (p - 5.0), 1e-5 * (p - 3.0), 2e-9 * (6.0 - p)]
}

fn curves(terms: usize) -> Vec<f64> {
    let deviation = |p: usize, v: f64| {
        truth(p)[..terms].iter().rev().fold(0.0, |sum, coefficient| sum * v + coefficient)
    };
    REFERENCES.iter().flat_map(|&v| (0..SHAPE.len()).map(move |p| v + deviation(p, v))).collect()
}

fn fitted(data: &[f64], noise: Option<&[LevelNoise]>, form: Form, workers: usize) -> Vec<Vec<f64>> {
    let means = Stack::new("levels", data, REFERENCES.len(), SHAPE).unwrap();
    let levels = Levels { means, references: &REFERENCES, noise };
    let workers = Workers::new(std::num::NonZeroUsize::new(workers)).unwrap();
    let found = fit(&levels, form, &workers, &Control::new()).unwrap();
    vec![found.coefficients, found.variances, found.misfit]
}

fn noise() -> Vec<LevelNoise> {
    REFERENCES.iter().map(|_| LevelNoise { constant: 4.0, slope: 0.25, dark: 30.0 }).collect()
}

#[test]
fn curves_without_noise_come_back_at_every_order() {
    for (form, terms) in
        [(Form::Offset, 1), (Form::Line, 2), (Form::Quadratic, 3), (Form::Cubic, 4)]
    {
        for noise in [None, Some(noise())] {
            let found = fitted(&curves(terms), noise.as_deref(), form, 1);
            for power in 0..terms {
                for p in 0..SHAPE.len() {
                    let got = found[0][power * SHAPE.len() + p];
                    // Rounding of the values, 4000 · 2^−52, through a condition of some 1e4.
                    let scale = 4000_f64.powi(power as i32);
                    assert!((got - truth(p)[power]).abs() * scale < 1e-8, "{form:?} {power} {p}");
                }
            }
        }
    }
}

#[test]
fn a_gain_alone_goes_through_zero() {
    let data: Vec<f64> = REFERENCES
        .iter()
        .flat_map(|&v| (0..SHAPE.len()).map(move |p| v * (1.0 + truth(p)[1])))
        .collect();
    let found = fitted(&data, Some(&noise()), Form::Gain, 1);
    for p in 0..SHAPE.len() {
        assert!(found[0][p].abs() < 1e-12);
        assert!((found[0][SHAPE.len() + p] - truth(p)[1]).abs() < 1e-12);
    }
}

/// Weighted least squares of a line by its textbook formulas, with weights at the expected signal.
#[test]
fn coefficients_and_variances_are_those_of_weighted_least_squares() {
    let mut data = curves(2);
    for (index, value) in data.iter_mut().enumerate() {
        *value += ((index * 7919) % 13) as f64 - 6.0;
    }
    let found = fitted(&data, Some(&noise()), Form::Line, 1);
    for p in 0..SHAPE.len() {
        let y: Vec<f64> =
            REFERENCES.iter().enumerate().map(|(j, v)| data[j * SHAPE.len() + p] - v).collect();
        let (mut a, mut k, mut variances) = (0.0, 0.0, [0.0; 2]);
        for _ in 0..2 {
            let w: Vec<f64> =
                REFERENCES.iter().map(|v| 1.0 / (4.0 + 0.25 * (v + a + k * v - 30.0))).collect();
            let sum = |f: &dyn Fn(usize) -> f64| (0..6).map(|j| w[j] * f(j)).sum::<f64>();
            let (s, sx) = (sum(&|_| 1.0), sum(&|j| REFERENCES[j]));
            let sxx = sum(&|j| REFERENCES[j].powi(2));
            let (sy, sxy) = (sum(&|j| y[j]), sum(&|j| REFERENCES[j] * y[j]));
            let det = s * sxx - sx * sx;
            (a, k) = ((sxx * sy - sx * sxy) / det, (s * sxy - sx * sy) / det);
            variances = [sxx / det, s / det];
        }
        for (power, (want, variance)) in [a, k].into_iter().zip(variances).enumerate() {
            let at = power * SHAPE.len() + p;
            assert!((found[0][at] - want).abs() < 1e-9 * want.abs().max(1e-3), "{power} {p}");
            assert!((found[1][at] / variance - 1.0).abs() < 1e-9);
        }
    }
}

#[test]
fn a_pixel_with_too_few_levels_is_undetermined_and_spoils_no_other() {
    let mut data = curves(3);
    for level in 0..4 {
        data[level * SHAPE.len() + 5] = f64::NAN;
    }
    let found = fitted(&data, None, Form::Quadratic, 1);
    let nan: Vec<usize> = (0..SHAPE.len()).filter(|&p| found[0][p].is_nan()).collect();
    assert_eq!(nan, [5]);
    assert!(found[1][5].is_nan() && found[2][5].is_nan());
}

#[test]
fn the_misfit_is_that_of_the_residuals() {
    let mut data = curves(2);
    data[3 * SHAPE.len() + 2] += 10.0;
    let found = fitted(&data, None, Form::Line, 1);
    let residual = |j: usize| {
        let v = REFERENCES[j];
        data[j * SHAPE.len() + 2] - v - found[0][2] - found[0][SHAPE.len() + 2] * v
    };
    let sum: f64 = (0..6).map(|j| residual(j).powi(2)).sum();
    assert!((found[2][2] / sum - 1.0).abs() < 1e-9);
}

#[test]
fn any_number_of_workers_gives_the_same_bytes() {
    let (one, three) = (
        fitted(&curves(4), Some(&noise()), Form::Cubic, 1),
        fitted(&curves(4), Some(&noise()), Form::Cubic, 3),
    );
    assert_eq!(one, three);
}

#[test]
fn levels_that_do_not_differ_or_do_not_suffice_are_refused() {
    let workers = Workers::new(None).unwrap();
    let refused = |references: &[f64], form: Form| {
        let data = vec![1.0; references.len() * SHAPE.len()];
        let means = Stack::new("levels", &data, references.len(), SHAPE).unwrap();
        let levels = Levels { means, references, noise: None };
        fit(&levels, form, &workers, &Control::new()).unwrap_err().to_string()
    };
    assert!(refused(&[5.0, 5.0], Form::Line).contains("all have the mean 5"));
    assert!(refused(&[5.0, 6.0], Form::Quadratic).contains("are 2"));
    assert!(refused(&[5.0, f64::NAN], Form::Line).contains("mean NaN"));
}

//! What no measurement fixes: the mean of ln c, and with free fluxes two tilts of ln M.
//!
//! ```text
//! M → M·exp(α·p),   L → L·exp(β·u),   ln c_k → ln c_k − β·d_k,   β = −A α
//! ```
//!
//! changes nothing that is measured, nor does a factor between L and all c.

use super::Fit;
use crate::frames::Shape;
use crate::geometry::Rotation;

/// Brings the mean of ln c to 0, and the slope of ln M, least squares over the pixels of the largest
/// component where M > 0, if the fluxes leave it undetermined.
pub(super) fn fix(fit: &mut Fit, rotation: Rotation, sensor: Shape) {
    if fit.leaves_tilt {
        let slope = slope(&fit.sensitivity, &fit.components.pixels, sensor);
        untilt(fit, slope, rotation, sensor);
    }
    let mean = fit.flux.iter().map(|c| c.ln()).sum::<f64>() / fit.flux.len() as f64;
    fit.flux.iter_mut().for_each(|c| *c /= mean.exp());
    fit.beam.iter_mut().for_each(|value| *value *= mean.exp());
}

/// M → M·exp(−slope·p) and all that goes with it.
fn untilt(fit: &mut Fit, slope: [f64; 2], rotation: Rotation, sensor: Shape) {
    for (pixel, m) in fit.sensitivity.iter_mut().enumerate() {
        let (row, col) = ((pixel / sensor.cols) as f64, (pixel % sensor.cols) as f64);
        *m *= (-slope[0] * row - slope[1] * col).exp();
    }
    let [row, col] = slope;
    // β·u = α·p less what lies between the first pixel and the corner of its turned window.
    let (last_row, last_col) = (sensor.rows as f64 - 1.0, sensor.cols as f64 - 1.0);
    let ([down, along], corner) = match rotation {
        Rotation::None => ([row, col], 0.0),
        Rotation::Quarter => ([col, -row], row * last_row),
        Rotation::Half => ([-row, -col], row * last_row + col * last_col),
        Rotation::ThreeQuarters => ([-col, row], col * last_col),
    };
    for (cell, value) in fit.beam.iter_mut().enumerate() {
        let (row, col) = (cell / fit.beam_shape.cols, cell % fit.beam_shape.cols);
        let u = [row as f64 - fit.origin[0] as f64, col as f64 - fit.origin[1] as f64];
        *value *= (down * u[0] + along * u[1] + corner).exp();
    }
    for (c, d) in fit.flux.iter_mut().zip(&fit.shifts) {
        *c *= (-down * d[0] - along * d[1]).exp();
    }
}

/// The least-squares slope of ln M along rows and columns, a pixel.
fn slope(sensitivity: &[f64], labels: &[i32], sensor: Shape) -> [f64; 2] {
    let pixels = || {
        let known = sensitivity.iter().zip(labels).enumerate();
        known.filter(|(_, (m, label))| **m > 0.0 && **label == 0).map(|(pixel, (m, _))| {
            [(pixel / sensor.cols) as f64, (pixel % sensor.cols) as f64, m.ln()]
        })
    };
    let sum = pixels().fold([0.0; 4], |sum, [row, col, log]| {
        [sum[0] + row, sum[1] + col, sum[2] + log, sum[3] + 1.0]
    });
    let mean = [sum[0] / sum[3], sum[1] / sum[3], sum[2] / sum[3]];
    let [rr, rc, cc, rl, cl] = pixels().fold([0.0; 5], |sum, [row, col, log]| {
        let (r, c, l) = (row - mean[0], col - mean[1], log - mean[2]);
        [sum[0] + r * r, sum[1] + r * c, sum[2] + c * c, sum[3] + r * l, sum[4] + c * l]
    });
    let determinant = rr * cc - rc * rc;
    if determinant > 0.0 {
        [(cc * rl - rc * cl) / determinant, (rr * cl - rc * rl) / determinant]
    } else {
        [if rr > 0.0 { rl / rr } else { 0.0 }, if cc > 0.0 { cl / cc } else { 0.0 }]
    }
}

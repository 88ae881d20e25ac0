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

/// Gives L the slope `drift` that a lamp's drift has in the beam, brings the mean of ln c to 0, and the slope of ln M, least squares over the ordinary pixels of the largest
/// component, if the fluxes leave it undetermined.
pub(super) fn fix(fit: &mut Fit, drift: [f64; 2], rotation: Rotation, sensor: Shape) {
    untilt(fit, in_sensor(drift, rotation), rotation, sensor);
    if fit.leaves_tilt {
        let slope = slope(&fit.sensitivity, &fit.components.pixels, sensor);
        untilt(fit, slope, rotation, sensor);
    }
    let mean = fit.flux.iter().map(|c| c.ln()).sum::<f64>() / fit.flux.len() as f64;
    fit.flux.iter_mut().for_each(|c| *c /= mean.exp());
    fit.beam.iter_mut().for_each(|value| *value *= mean.exp());
}

/// A slope of ln L in the beam as one of ln M on a sensor that is turned: −α = Aᵀ β.
const fn in_sensor([down, along]: [f64; 2], rotation: Rotation) -> [f64; 2] {
    match rotation {
        Rotation::None => [down, along],
        Rotation::Quarter => [-along, down],
        Rotation::Half => [-down, -along],
        Rotation::ThreeQuarters => [along, -down],
    }
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

/// The least-squares slope of ln M along rows and columns, a pixel, over pixels from half to twice the
/// mean: the logarithm of a dead one would weigh more than all others of its row.
fn slope(sensitivity: &[f64], labels: &[i32], sensor: Shape) -> [f64; 2] {
    let counted = || sensitivity.iter().zip(labels).filter(|(_, label)| **label == 0);
    let mean = counted().map(|(m, _)| m).sum::<f64>() / counted().count() as f64;
    let pixels = || {
        let known = sensitivity.iter().zip(labels).enumerate();
        let ordinary = 0.5 * mean..2.0 * mean;
        known.filter(move |(_, (m, label))| **label == 0 && ordinary.contains(m)).map(
            |(pixel, (m, _))| [(pixel / sensor.cols) as f64, (pixel % sensor.cols) as f64, m.ln()],
        )
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

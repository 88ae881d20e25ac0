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

/// What rounding leaves of a determinant.
const SINGULAR: f64 = 1e-12;

/// Gives L the slope `drift` that a lamp's drift has in the beam, brings the mean of ln c to 0, and the
/// slope of ln M, least squares over the ordinary pixels of the largest component, along the
/// directions in the beam that the fluxes leave `open`.
pub(super) fn fix(
    fit: &mut Fit,
    drift: [f64; 2],
    open: &[[f64; 2]],
    rotation: Rotation,
    sensor: Shape,
) {
    untilt(fit, in_sensor(drift, rotation), rotation, sensor);
    if !open.is_empty() {
        let slope = slopes(&fit.sensitivity, &fit.components.pixels, sensor).map(|weights| {
            let pixels = weights.iter().zip(&fit.sensitivity).filter(|(w, _)| **w != 0.0);
            pixels.map(|(weight, m)| weight * m.ln()).sum::<f64>()
        });
        for direction in open.iter().map(|direction| in_sensor(*direction, rotation)) {
            let along = direction[0] * slope[0] + direction[1] * slope[1];
            untilt(fit, direction.map(|part| along * part), rotation, sensor);
        }
    }
    let mean = fit.flux.iter().map(|c| c.ln()).sum::<f64>() / fit.flux.len() as f64;
    fit.flux.iter_mut().for_each(|c| *c /= mean.exp());
    let cells = fit.beam.iter_mut().chain(&mut fit.coefficients);
    cells.for_each(|value| *value *= mean.exp());
}

/// A slope of ln L in the beam as one of ln M on a sensor that is turned: −α = Aᵀ β.
pub(super) const fn in_sensor([down, along]: [f64; 2], rotation: Rotation) -> [f64; 2] {
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
    for (cell, (value, coefficient)) in fit.beam.iter_mut().zip(&mut fit.coefficients).enumerate() {
        let (row, col) = (cell / fit.beam_shape.cols, cell % fit.beam_shape.cols);
        let u = [row as f64 - fit.origin[0] as f64, col as f64 - fit.origin[1] as f64];
        let factor = (down * u[0] + along * u[1] + corner).exp();
        *value *= factor;
        *coefficient *= factor;
    }
    for (c, d) in fit.flux.iter_mut().zip(&fit.shifts) {
        *c *= (-down * d[0] - along * d[1]).exp();
    }
}

/// Weights whose sums with ln M are its least-squares slopes along rows and columns, a pixel, over
/// the pixels of label 0 from half to twice the mean: the logarithm of a dead one would weigh more
/// than all others of its row.
pub(super) fn slopes(sensitivity: &[f64], labels: &[i32], sensor: Shape) -> [Vec<f64>; 2] {
    let counted = || sensitivity.iter().zip(labels).filter(|(_, label)| **label == 0);
    let mean = counted().map(|(m, _)| m).sum::<f64>() / counted().count() as f64;
    let ordinary = 0.5 * mean..2.0 * mean;
    let counts = |pixel: usize| labels[pixel] == 0 && ordinary.contains(&sensitivity[pixel]);
    let place = |pixel: usize| [(pixel / sensor.cols) as f64, (pixel % sensor.cols) as f64];
    let pixels = || (0..sensitivity.len()).filter(|&pixel| counts(pixel)).map(place);
    let sum = pixels().fold([0.0; 3], |s, [row, col]| [s[0] + row, s[1] + col, s[2] + 1.0]);
    let mean = [sum[0] / sum[2], sum[1] / sum[2]];
    let from_mean = |[row, col]: [f64; 2]| [row - mean[0], col - mean[1]];
    let [rr, rc, cc] = pixels()
        .map(from_mean)
        .fold([0.0; 3], |sum, [r, c]| [sum[0] + r * r, sum[1] + r * c, sum[2] + c * c]);
    let inverse = inverse([rr, rc, cc]);
    let weight = |pixel: usize, [of_row, of_col]: [f64; 2]| {
        let [r, c] = from_mean(place(pixel));
        if counts(pixel) { of_row * r + of_col * c } else { 0.0 }
    };
    inverse.map(|axis| (0..sensitivity.len()).map(|pixel| weight(pixel, axis)).collect())
}

/// The inverse of a matrix [a b; b c] without negative eigenvalues; 0 along the direction that one of
/// rank 1 does not tell, and the matrix over its trace squared along the other.
pub(super) fn inverse([a, b, c]: [f64; 3]) -> [[f64; 2]; 2] {
    let determinant = a * c - b * b;
    if determinant > SINGULAR * (a + c).powi(2) {
        let mixed = -b / determinant;
        [[c / determinant, mixed], [mixed, a / determinant]]
    } else if a + c > 0.0 {
        let square = (a + c).powi(2);
        [[a / square, b / square], [b / square, c / square]]
    } else {
        [[0.0; 2]; 2]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_matrix_does_not_tell_is_left_out_of_its_inverse() {
        assert_eq!(inverse([2.0, 1.0, 1.0]), [[1.0, -1.0], [-1.0, 2.0]]);
        // 4 along (1, 1)/√2, nothing across.
        assert_eq!(inverse([2.0, 2.0, 2.0]), [[0.125, 0.125], [0.125, 0.125]]);
        assert_eq!(inverse([0.0, 0.0, 4.0]), [[0.0, 0.0], [0.0, 0.25]]);
        assert_eq!(inverse([0.0; 3]), [[0.0; 2]; 2]);
    }
}

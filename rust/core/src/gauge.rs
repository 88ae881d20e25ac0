//! The gauge: what no measurement fixes, and how it is fixed in a result.
//!
//! ```text
//! M → s M,   L → L/s                                                       in each component
//! M → M·exp(α·p),   L → L·exp(β·u),   ln c_k → ln c_k − β·d_k,   β = −A α   with free fluxes
//! ```
//!
//! The mean of M is 1 in each component, the mean of ln c is 0, and the least-squares slope of ln M over
//! [`slope_pixels`] is 0 along the directions in the beam that free fluxes leave open.

use crate::connectivity::Components;
use crate::fit::Fit;
use crate::frames::{Shape, flag};
use crate::geometry::Rotation;
use crate::linalg::inverse;
use crate::parallel::Workers;

/// Upper limit on rounds of selecting the pixels of the slope and removing it. Few pixels are close to a
/// limit of the range, so two or three rounds are usual. Pixels that a tilt moves to and fro across a limit
/// may leave no set that is its own result: then a slope of their size remains.
const MOST_ROUNDS: usize = 20;

/// Brings M to mean 1, each component for itself, and M to NaN outside the largest, L to NaN outside
/// all. The pixels `left_out` are not in the means unless nothing else is there.
pub(crate) fn fix_means(fit: &mut Fit, left_out: &[usize], workers: &Workers) {
    let Fit { sensitivity, beam, components, .. } = fit;
    let means = component_means(sensitivity, components, left_out);
    rescale(sensitivity, &components.pixels, workers, |value, label| {
        if label == 0 { value / means[0] } else { f64::NAN }
    });
    rescale(&mut beam.values, &components.cells, workers, |value, label| {
        usize::try_from(label).map_or(f64::NAN, |label| value * means[label])
    });
    let coefficients = beam.coefficients.iter_mut().flatten();
    coefficients.for_each(|coefficient| *coefficient *= means[0]);
    if let Some(offset) = &mut fit.offset {
        rescale(
            offset,
            &components.pixels,
            workers,
            |value, label| {
                if label == 0 { value } else { f64::NAN }
            },
        );
    }
}

/// What fitted fluxes leave to the gauge.
pub(crate) struct FluxGauge {
    /// The slope of ln c along the shifts that the search left out or began with, by a lamp's drift or by free fluxes:
    /// which pixels count for the slope of ln M is decided by M at the fluxes given.
    pub(crate) slope: [f64; 2],
    /// The directions in the beam along which a tilt is left undetermined.
    pub(crate) open: Vec<[f64; 2]>,
    /// How the sensor was turned in the first exposure.
    pub(crate) rotation: Rotation,
    pub(crate) sensor: Shape,
}

/// Gives L that slope, brings the mean of ln c to 0, and the slope of ln M to 0 along the open
/// directions; needs the flags.
pub(crate) fn fix_fluxes(fit: &mut Fit, gauge: &FluxGauge) {
    let FluxGauge { slope, open, rotation, sensor } = gauge;
    untilt(fit, rotation.in_sensor(*slope), *rotation, *sensor);
    if !open.is_empty() {
        level(fit, gauge);
    }
    let mean = fit.flux.iter().map(|c| c.ln()).sum::<f64>() / fit.flux.len() as f64;
    fit.flux.iter_mut().for_each(|c| *c /= mean.exp());
    let coefficients = fit.beam.coefficients.iter_mut().flatten();
    fit.beam.values.iter_mut().chain(coefficients).for_each(|value| *value *= mean.exp());
}

/// Brings the slope of ln M to 0 along the open directions. Removing it changes which pixels are within the
/// range of [`slope_pixels`], so both are repeated until the pixels are those of the result.
fn level(fit: &mut Fit, gauge: &FluxGauge) {
    let FluxGauge { open, rotation, sensor, .. } = gauge;
    let mut before = Vec::new();
    for _ in 0..MOST_ROUNDS {
        let counted = slope_pixels(&fit.sensitivity, &fit.flags);
        if counted == before {
            return;
        }
        let slope = slope(&fit.sensitivity, &counted, *sensor);
        for direction in open.iter().map(|direction| rotation.in_sensor(*direction)) {
            let along = direction[0] * slope[0] + direction[1] * slope[1];
            untilt(fit, direction.map(|part| along * part), *rotation, *sensor);
        }
        before = counted;
    }
}

/// The least-squares slope of ln M along rows and columns, a pixel, over the pixels that are `counted`.
fn slope(sensitivity: &[f64], counted: &[bool], sensor: Shape) -> [f64; 2] {
    slopes(counted, sensor).map(|weights| {
        let pixels = weights.iter().zip(sensitivity).filter(|(w, _)| **w != 0.0);
        pixels.map(|(weight, m)| weight * m.ln()).sum()
    })
}

/// M → M·exp(−slope·p) and all that goes with it.
fn untilt(fit: &mut Fit, slope: [f64; 2], rotation: Rotation, sensor: Shape) {
    for (pixel, m) in fit.sensitivity.iter_mut().enumerate() {
        let (row, col) = ((pixel / sensor.cols) as f64, (pixel % sensor.cols) as f64);
        *m *= (-slope[0] * row - slope[1] * col).exp();
    }
    // β·u = α·p less what lies between the first pixel and the corner of its turned window.
    let [down, along] = rotation.direction(slope);
    let last = [sensor.rows as f64 - 1.0, sensor.cols as f64 - 1.0];
    let reversed = rotation.axes().map(|axis| axis.reversed);
    let from_corner = |axis: usize| if reversed[axis] { slope[axis] * last[axis] } else { 0.0 };
    let corner = from_corner(0) + from_corner(1);
    let (shape, origin) = (fit.beam.shape, fit.beam.origin);
    let factor = |cell: usize| {
        let (row, col) = (cell / shape.cols, cell % shape.cols);
        let u = [row as f64 - origin[0], col as f64 - origin[1]];
        (down * u[0] + along * u[1] + corner).exp()
    };
    if fit.beam.coefficients.is_some() {
        fit.beam.tilt = [fit.beam.tilt[0] + down, fit.beam.tilt[1] + along];
    }
    for (cell, value) in fit.beam.values.iter_mut().enumerate() {
        let factor = factor(cell);
        *value *= factor;
        if let Some(coefficients) = &mut fit.beam.coefficients {
            coefficients[cell] *= factor;
        }
    }
    for (c, d) in fit.flux.iter_mut().zip(&fit.shifts) {
        *c *= (-down * d[0] - along * d[1]).exp();
    }
}

/// Which pixels count for the slope of ln M: M is determined, its measurements carry weight, and it is
/// from half to twice the mean of such: the logarithm of a dead one would weigh more than all others of
/// its row.
#[must_use]
pub fn slope_pixels(sensitivity: &[f64], flags: &[u32]) -> Vec<bool> {
    let unreliable = flag::NO_FLAT_FIELD | flag::UNRELIABLE_FLAT;
    let pixels = || sensitivity.iter().zip(flags);
    let reliable = |(m, flags): &(&f64, &u32)| m.is_finite() && **flags & unreliable == 0;
    let counted = || pixels().filter(reliable);
    let mean = counted().map(|(m, _)| m).sum::<f64>() / counted().count() as f64;
    let ordinary = 0.5 * mean..2.0 * mean;
    pixels().map(|pixel| reliable(&pixel) && ordinary.contains(pixel.0)).collect()
}

/// Weights whose sums with ln M are its least-squares slopes along rows and columns, a pixel, over the
/// pixels that are `counted`.
pub(crate) fn slopes(counted: &[bool], sensor: Shape) -> [Vec<f64>; 2] {
    let place = |pixel: usize| [(pixel / sensor.cols) as f64, (pixel % sensor.cols) as f64];
    let pixels = || (0..counted.len()).filter(|&pixel| counted[pixel]).map(place);
    let sum = pixels().fold([0.0; 3], |s, [row, col]| [s[0] + row, s[1] + col, s[2] + 1.0]);
    let mean = [sum[0] / sum[2], sum[1] / sum[2]];
    let from_mean = |[row, col]: [f64; 2]| [row - mean[0], col - mean[1]];
    let [rr, rc, cc] = pixels()
        .map(from_mean)
        .fold([0.0; 3], |sum, [r, c]| [sum[0] + r * r, sum[1] + r * c, sum[2] + c * c]);
    let inverse = inverse([rr, rc, cc]);
    let weight = |pixel: usize, [of_row, of_col]: [f64; 2]| {
        let [r, c] = from_mean(place(pixel));
        if counted[pixel] { of_row * r + of_col * c } else { 0.0 }
    };
    inverse.map(|axis| (0..counted.len()).map(|pixel| weight(pixel, axis)).collect())
}

/// Replaces each value by `scaled(value, label)`.
fn rescale(
    values: &mut [f64],
    labels: &[i32],
    workers: &Workers,
    scaled: impl Fn(f64, i32) -> f64 + Send + Sync,
) {
    const PART: usize = 1 << 16;
    workers.map_blocks(values, PART, |index, part| {
        for (value, &label) in part.iter_mut().zip(&labels[index * PART..]) {
            *value = scaled(*value, label);
        }
    });
}

/// The mean sensitivity of each component, without the pixels `left_out` unless nothing else is
/// there.
fn component_means(sensitivity: &[f64], components: &Components, left_out: &[usize]) -> Vec<f64> {
    let mut kept = vec![(0.0, 0_usize); components.sizes.len()];
    let mut all = kept.clone();
    let mut left_out = left_out.iter().peekable();
    for (pixel, (&value, &label)) in sensitivity.iter().zip(&components.pixels).enumerate() {
        let is_out = left_out.next_if_eq(&&pixel).is_some();
        let Ok(label) = usize::try_from(label) else { continue };
        all[label] = (all[label].0 + value, all[label].1 + 1);
        if !is_out {
            kept[label] = (kept[label].0 + value, kept[label].1 + 1);
        }
    }
    let chosen = kept.iter().zip(&all).map(|(kept, all)| if kept.1 > 0 { kept } else { all });
    chosen.map(|(sum, count)| sum / *count as f64).collect()
}

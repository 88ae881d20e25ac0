//! The gauge of a joint fit's result, and the tilts of M that its linear problem does not see.

use crate::exposures::FluxKind;
use crate::fit::Solution;
use crate::frames::Real;
use crate::gauge;
use crate::geometry::Rotation;
use crate::joint::System;
use crate::parallel::Workers;

/// Tilts of M that S does not see, and the covariance of their heights.
pub(super) struct Hidden {
    pub(super) tilts: [Vec<f64>; 2],
    pub(super) covariance: [[f64; 2]; 2],
}

/// What the gauge takes out of a change of M: P = 1 − Σ U Wᵀ.
pub(super) struct Gauge {
    /// U and W.
    pub(super) parts: Vec<[Vec<f64>; 2]>,
}

impl Gauge {
    /// P x.
    pub(super) fn apply(&self, change: &mut [f64], workers: &Workers) {
        let heights: Vec<f64> = self.parts.iter().map(|[_, w]| workers.dot(w, change)).collect();
        for ([u, _], height) in self.parts.iter().zip(heights) {
            workers.add_multiple(change, -height, u);
        }
    }

    /// The diagonal of P V Pᵀ for a diagonal V.
    pub(super) fn diagonal<'v>(&'v self, own: &'v [f64]) -> impl Iterator<Item = f64> + 'v {
        let parts = &self.parts;
        let dot = |a: &[f64], b: &[f64]| -> f64 {
            a.iter().zip(b).zip(own).map(|((a, b), own)| a * b * own).sum()
        };
        // (1 − U Wᵀ) V (1 − W Uᵀ) = V − U Wᵀ V − V W Uᵀ + U (Wᵀ V W) Uᵀ.
        let mixed: Vec<Vec<f64>> =
            parts.iter().map(|[_, w]| parts.iter().map(|[_, v]| dot(w, v)).collect()).collect();
        (0..own.len()).map(move |pixel| {
            let mut variance = own[pixel];
            for ([u, w], mixed) in parts.iter().zip(&mixed) {
                variance -= 2.0 * u[pixel] * own[pixel] * w[pixel];
                for ([v, _], mixed) in parts.iter().zip(mixed) {
                    variance += u[pixel] * mixed * v[pixel];
                }
            }
            variance
        })
    }

    /// Pᵀ g.
    pub(super) fn transpose(&self, functional: &mut [f64], workers: &Workers) {
        let heights: Vec<f64> =
            self.parts.iter().map(|[u, _]| workers.dot(u, functional)).collect();
        for ([_, w], height) in self.parts.iter().zip(heights) {
            workers.add_multiple(functional, -height, w);
        }
    }
}

/// What the gauge and the fluxes make of a change of M, at a joint fit.
pub(super) struct Tilts {
    pub(super) gauge: Gauge,
    pub(super) hidden: Option<Hidden>,
    /// The pattern of M that a drift linear in time brings, of the first θ.
    pub(super) drift: Option<Vec<f64>>,
}

impl Tilts {
    /// Those of a problem at a solution, with 1 in the `valid` pixels, whose mean M is 1.
    pub(super) fn of<T: Real>(
        system: &System<'_, '_, T>,
        solution: &Solution<'_>,
        valid: &[f32],
    ) -> Self {
        let exposures = system.pass.exposures;
        let (sensor, rotation) = (exposures.sensor(), exposures.positions().rotations[0]);
        let [m, _] = system.pixels();
        let tilts = tilts(&m, valid, sensor.cols);
        let drift = drift(system.fluxes.slope, &tilts, rotation);
        let count = count(valid);
        let of_mean = valid.iter().map(|valid| f64::from(*valid) / count).collect();
        let mut parts = vec![[m.clone(), of_mean]];
        let mut hidden = None;
        if matches!(exposures.flux_kind(), FluxKind::Prior(_)) {
            let turned = covariance_in_sensor(system.fluxes.hidden_slope, rotation);
            let covariance = turned.map(|row| row.map(|x| x / system.unit));
            hidden = Some(Hidden { tilts, covariance });
        } else if !system.fluxes.open.is_empty() {
            let counted = gauge::slope_pixels(solution.sensitivity, solution.flags);
            let slopes = gauge::slopes(&counted, sensor);
            for direction in &system.fluxes.open {
                let direction = rotation.in_sensor(*direction);
                let mut slope = along(direction, &slopes);
                let pixels = slope.iter_mut().zip(&m).filter(|(weight, _)| **weight != 0.0);
                pixels.for_each(|(weight, m)| *weight /= m);
                parts.push([along(direction, &tilts), slope]);
            }
        }
        Self { gauge: Gauge { parts }, hidden, drift }
    }
}

/// 1 in the determined pixels that have a weight, and their mean D⁻¹.
pub(super) fn valid<T: Real>(system: &System<'_, '_, T>, determined: &[bool]) -> (Vec<f32>, f64) {
    let mut valid = vec![0.0; determined.len()];
    let (mut first, mut sum, mut count) = (0, 0.0, 0.0);
    system.pass.for_rows(|[_, inverse, ..]| {
        for (pixel, inverse) in (first..).zip(inverse) {
            if *inverse > 0.0 && determined[pixel] {
                valid[pixel] = 1.0;
                sum += inverse;
                count += 1.0;
            }
        }
        first += inverse.len();
    });
    (valid, sum / count)
}

/// How many pixels are valid.
pub(super) fn count(valid: &[f32]) -> f64 {
    valid.iter().map(|valid| f64::from(*valid)).sum()
}

/// Tilts of M along rows and columns, without their mean.
fn tilts(m: &[f64], valid: &[f32], cols: usize) -> [Vec<f64>; 2] {
    let count = count(valid);
    let mean = |image: &[f64]| {
        let pixels = image.iter().zip(valid).map(|(x, valid)| f64::from(*valid) * x);
        pixels.sum::<f64>() / count
    };
    [0, 1].map(|axis| {
        let place = |pixel: usize| [pixel / cols, pixel % cols][axis] as f64;
        let tilt: Vec<f64> = m.iter().enumerate().map(|(pixel, m)| m * place(pixel)).collect();
        let mean = mean(&tilt);
        tilt.iter().zip(m).map(|(tilt, m)| tilt - mean * m).collect::<Vec<_>>()
    })
}

/// The pattern of M that goes with a slope of ln L, if there is one.
fn drift(slope: [f64; 2], tilts: &[Vec<f64>; 2], rotation: Rotation) -> Option<Vec<f64>> {
    let direction = rotation.in_sensor(slope.map(|slope| -slope));
    (direction != [0.0; 2]).then(|| along(direction, tilts))
}

/// The sum of two patterns, each times its part of a direction.
fn along([row, col]: [f64; 2], [rows, cols]: &[Vec<f64>; 2]) -> Vec<f64> {
    rows.iter().zip(cols).map(|(r, c)| row * r + col * c).collect()
}

/// hᵀ C h.
pub(super) fn form(covariance: &[[f64; 2]; 2], h: [f64; 2]) -> f64 {
    let [[a, b], [_, c]] = covariance;
    a * h[0] * h[0] + 2.0 * b * h[0] * h[1] + c * h[1] * h[1]
}

/// The covariance of a slope in the beam as that of one on a sensor that is turned.
fn covariance_in_sensor(covariance: [[f64; 2]; 2], rotation: Rotation) -> [[f64; 2]; 2] {
    let [first, second] = covariance.map(|row| rotation.in_sensor(row));
    let column = |axis: usize| rotation.in_sensor([first[axis], second[axis]]);
    [column(0), column(1)]
}

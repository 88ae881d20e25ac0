//! The gauge of a result: what no measurement determines.

use super::lamp::{Columns, is_turned};
use super::linear::Symmetric;
use crate::common::{Experiment, Lamp};
use crate::simulation::place;

/// The bit of pixels in weak light.
const UNRELIABLE: u32 = 1 << 25;

/// A change of M brought to the gauge of the result: mean(M) = 1, and where the fluxes leave a tilt of ln M
/// undetermined, no slope of ln M there.
pub(crate) struct Gauge {
    sensitivity: Vec<f64>,
    /// The pixels whose mean M is 1.
    counted: Vec<bool>,
    /// Where each pixel lies in the beam, unless nothing is measured there.
    places: Vec<Option<[f64; 2]>>,
    /// Directions in the beam, of length 1, along which the tilt is undetermined.
    open: Vec<[f64; 2]>,
}

impl Gauge {
    pub(crate) fn new(experiment: &Experiment, sensitivity: &[f64]) -> Self {
        let place = |(pixel, m): (usize, &f64)| {
            (*m != 0.0).then(|| place(experiment.shape, experiment.degrees[0], pixel))
        };
        let open = match &experiment.lamp {
            Lamp::Free if !is_turned(experiment) => vec![[1.0, 0.0], [0.0, 1.0]],
            Lamp::Linear(times) if Columns::sought(experiment).count() == 0 => {
                vec![growth(times, &experiment.shifts)]
            }
            _ => Vec::new(),
        };
        let places = sensitivity.iter().enumerate().map(place).collect();
        let counted = sensitivity.iter().map(|m| *m != 0.0).collect();
        Self { sensitivity: sensitivity.to_vec(), counted, places, open }
    }

    /// The same without the pixels in weak light in the mean.
    pub(crate) fn without(mut self, flags: &[u32]) -> Self {
        let flagged = self.counted.iter_mut().zip(flags).filter(|(_, f)| **f & UNRELIABLE > 0);
        flagged.for_each(|(counted, _)| *counted = false);
        self
    }

    /// The least-squares slope of an image over the beam.
    pub(crate) fn slope(&self, image: &[f64]) -> [f64; 2] {
        plane(self.places.iter().zip(image).filter_map(|(at, value)| Some(((*at)?, *value))))
    }

    /// The plane of that slope over the beam, 0 at its first cell.
    pub(crate) fn plane(&self, slope: [f64; 2]) -> impl Iterator<Item = f64> {
        self.places.iter().map(move |at| at.map_or(0.0, |at| slope[0] * at[0] + slope[1] * at[1]))
    }

    /// M without the slope of its logarithm, of mean 1: what free fluxes leave of it.
    pub(crate) fn level(&self) -> Vec<f64> {
        let logs: Vec<f64> = self.sensitivity.iter().map(|m| m.ln()).collect();
        let tilts = self.sensitivity.iter().zip(self.plane(self.slope(&logs)));
        let level: Vec<f64> = tilts.map(|(m, tilt)| m * (-tilt).exp()).collect();
        let mean = level.iter().sum::<f64>() / level.len() as f64;
        level.into_iter().map(|m| m / mean).collect()
    }

    /// A change of M, in the gauge.
    pub(crate) fn apply(&self, change: &[f64]) -> Vec<f64> {
        let logs: Vec<f64> = change
            .iter()
            .zip(&self.sensitivity)
            .map(|(change, m)| if *m == 0.0 { 0.0 } else { change / m })
            .collect();
        let slope = self.slope(&logs);
        let mut found = logs;
        for [row, col] in &self.open {
            let height = row * slope[0] + col * slope[1];
            for (log, at) in found.iter_mut().zip(&self.places) {
                *log -= at.map_or(0.0, |at| height * (row * at[0] + col * at[1]));
            }
        }
        found.iter_mut().zip(&self.sensitivity).for_each(|(change, m)| *change *= m);
        let sum = |image: &[f64]| -> f64 {
            image.iter().zip(&self.counted).filter(|(_, counted)| **counted).map(|(x, _)| x).sum()
        };
        let (mean, level) = (sum(&found), sum(&self.sensitivity));
        found.iter_mut().zip(&self.sensitivity).for_each(|(change, m)| *change -= mean * m / level);
        found
    }

    /// M times the place in the beam along an axis: a tilt of height 1, in the gauge.
    pub(crate) fn tilt(&self, axis: usize) -> Vec<f64> {
        let along = self.places.iter().map(|at| at.map_or(0.0, |at| at[axis]));
        let tilt: Vec<f64> = along.zip(&self.sensitivity).map(|(at, m)| at * m).collect();
        self.apply(&tilt)
    }

    /// P V Pᵀ.
    pub(crate) fn on_both_sides(&self, covariance: &[f64]) -> Vec<f64> {
        let size = self.places.len();
        let each_row = |matrix: &[f64]| -> Vec<f64> {
            matrix.chunks_exact(size).flat_map(|row| self.apply(row)).collect()
        };
        let transposed = |matrix: &[f64]| -> Vec<f64> {
            (0..size * size).map(|at| matrix[at % size * size + at / size]).collect()
        };
        each_row(&transposed(&each_row(covariance)))
    }
}

/// The slope (row, column) of the plane that is nearest to values at places.
fn plane(values: impl Iterator<Item = ([f64; 2], f64)>) -> [f64; 2] {
    let (mut normal, mut right) = (Symmetric::zeros(3), vec![0.0; 3]);
    for ([row, col], value) in values {
        let line = [1.0, row, col];
        normal.add_square(1.0, &line.into_iter().enumerate().collect::<Vec<_>>());
        right.iter_mut().zip(line).for_each(|(sum, x)| *sum += x * value);
    }
    let found = normal.factorised().map(|factor| factor.solve(&right)).unwrap_or(right);
    [found[1], found[2]]
}

/// The direction in which times grow that are affine in the shifts.
fn growth(times: &[f64], shifts: &[[f64; 2]]) -> [f64; 2] {
    let [row, col] = plane(shifts.iter().copied().zip(times.iter().copied()));
    [row / row.hypot(col), col / row.hypot(col)]
}

//! Coordinate descent beside the same sweep in its plainest form, and the laws it must obey.

use std::num::NonZeroUsize;

use crate::experiment::{Experiment, experiments};
use equipix_core::geometry::Geometry;
use equipix_core::sweep::Estimate;
use equipix_core::{Control, Exposures, Flux, Positions, Result, Shape, Stack, Workers};
use proptest::prelude::*;

impl Experiment {
    /// F after each sweep, and M and L after the last.
    fn swept(&self, sweeps: usize, workers: usize) -> Result<(Vec<f64>, Vec<f64>, Vec<f64>)> {
        let workers = Workers::new(NonZeroUsize::new(workers))?;
        self.with_exposures(&workers, |exposures| {
            let mut estimate = Estimate::new(exposures, &workers, &Control::new());
            let objective = (0..sweeps).map(|_| estimate.sweep(&Control::new()));
            let objective = objective.collect::<Result<_>>()?;
            let beam = estimate.beam();
            Ok((objective, estimate.sensitivity, beam))
        })
    }

    /// The same from the closed forms of L and M, measurement by measurement.
    fn naively_swept(&self, sweeps: usize) -> Result<(Vec<f64>, Vec<f64>, Vec<f64>)> {
        let geometry = Geometry::new(self.shape, &self.shifts, &self.rotations)?;
        let mut sensitivity = vec![1.0; self.shape.len()];
        let mut beam = vec![0.0; geometry.beam.len()];
        let mut objective = Vec::new();
        let used = self.measurements(&geometry);
        for _ in 0..sweeps {
            let mut sums = vec![[0.0; 2]; beam.len()];
            for &(y, w, c, pixel, cell) in &used {
                sums[cell][0] += w * c * sensitivity[pixel] * y;
                sums[cell][1] += w * (c * sensitivity[pixel]).powi(2);
            }
            replace(&mut beam, &sums);
            let mut sums = vec![[0.0; 2]; sensitivity.len()];
            for &(y, w, c, pixel, cell) in &used {
                sums[pixel][0] += w * c * beam[cell] * y;
                sums[pixel][1] += w * (c * beam[cell]).powi(2);
            }
            replace(&mut sensitivity, &sums);
            let residual = |&(y, w, c, pixel, cell): &(f64, f64, f64, usize, usize)| {
                w * (y - c * beam[cell] * sensitivity[pixel]).powi(2)
            };
            objective.push(used.iter().map(residual).sum());
        }
        Ok((objective, sensitivity, beam))
    }

    /// Σ w y², which no F exceeds.
    fn energy(&self) -> f64 {
        let geometry = Geometry::new(self.shape, &self.shifts, &self.rotations).unwrap();
        self.measurements(&geometry).iter().map(|&(y, w, ..)| w * y * y).sum()
    }

    /// Value, weight, flux, pixel and cell of each used measurement.
    fn measurements(&self, geometry: &Geometry) -> Vec<(f64, f64, f64, usize, usize)> {
        let mut used = Vec::new();
        for (k, place) in geometry.placements.iter().enumerate() {
            for pixel in 0..self.shape.len() {
                let index = k * self.shape.len() + pixel;
                let (row, col) = (pixel / self.shape.cols, pixel % self.shape.cols);
                let cell = geometry.views[place.view].cells.at(row + place.row, col + place.col);
                if !self.mask[index] && self.frames[index].is_finite() {
                    let weight = 1.0 / self.variance[index];
                    used.push((self.frames[index], weight, self.flux[k], pixel, cell));
                }
            }
        }
        used
    }
}

fn replace(values: &mut [f64], sums: &[[f64; 2]]) {
    for (value, &[signal, weight]) in values.iter_mut().zip(sums) {
        if weight > 0.0 {
            *value = signal / weight;
        }
    }
}

/// Rounding of `sweeps` sweeps: each takes two quotients of sums of some n + 3 roundings of
/// numbers of one sign, whose errors the next sweep averages.
fn rounding(sweeps: usize) -> f64 {
    (8 * sweeps * 9) as f64 * f64::EPSILON
}

fn close(got: &[f64], wanted: &[f64], sweeps: usize) -> bool {
    let rounding = rounding(sweeps);
    got.iter().zip(wanted).all(|(a, b)| (a - b).abs() <= rounding * b.abs())
}

proptest! {
    #[test]
    fn the_kernels_do_what_the_closed_forms_say(
        experiment in experiments(), sweeps in 1..6_usize,
    ) {
        // An exposure may be left without any measurement, which the model refuses.
        if let Ok((objective, sensitivity, beam)) = experiment.swept(sweeps, 2) {
            let wanted = experiment.naively_swept(sweeps).unwrap();
            prop_assert!(close(&sensitivity, &wanted.1, sweeps));
            prop_assert!(close(&beam, &wanted.2, sweeps));
            // The kernel subtracts from F what a step gains: it is off by what F was before, which
            // is at most the energy, and by twice that for models that differ by rounding.
            let most = 4.0 * rounding(sweeps) * experiment.energy();
            prop_assert!(objective.iter().zip(wanted.0).all(|(a, b)| (a - b).abs() <= most));
        }
    }

    #[test]
    fn the_objective_never_rises(experiment in experiments()) {
        if let Ok((objective, ..)) = experiment.swept(20, 1) {
            let most = 2.0 * rounding(1) * experiment.energy();
            prop_assert!(objective.windows(2).all(|pair| pair[1] <= pair[0] + most));
        }
    }

    #[test]
    fn any_number_of_workers_gives_the_same_bytes(experiment in experiments()) {
        if let Ok(one) = experiment.swept(3, 1) {
            prop_assert_eq!(one, experiment.swept(3, 3).unwrap());
        }
    }
}

#[test]
fn rows_that_do_not_fit_the_cache_make_no_difference() {
    // Wide enough that one sweep takes the rows in several parts.
    let shape = Shape::new(200, 60_000);
    let frames: Vec<f32> =
        (0..2 * shape.len()).map(|i| 1.0 + 0.1 * ((i % 977) as f32).sin()).collect();
    let shifts = [[0.0, 0.0], [3.0, 5.0]];
    let swept = |workers| {
        let workers = Workers::new(NonZeroUsize::new(workers)).unwrap();
        let stack = Stack::new("frames", &frames, 2, shape).unwrap();
        let (positions, control) = (Positions::of_shifts(&shifts), Control::new());
        let flux = Flux::steady(2);
        let exposures =
            Exposures::new(stack.into(), positions, flux, false, &workers, &control).unwrap();
        let mut estimate = Estimate::new(&exposures, &workers, &control);
        (estimate.sweep(&control).unwrap().to_bits(), estimate.sensitivity)
    };
    // Three workers take more rows at a time than one.
    assert!(swept(1) == swept(3));
}

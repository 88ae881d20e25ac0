//! What the noise of a dark does to a joint fit.
//!
//! The dark is subtracted from all exposures, so its error e(p), of variance v(p), stands in every
//! y_k(p) alike. With Q of `joint/system.rs`, which takes out what M follows,
//!
//! ```text
//! δM = a e + C x,   a = D⁻¹ Σ_k w c L,   S x = Jᵀ w Q 1 e
//! ```
//!
//! The variance of a e is known. That of C x and its product with a e are sampled in the draws of the
//! noise. To the variance of gᵀM it adds Σ_p v (a g + 1ᵀ w Q J x)² with S x = Cᵀ g, to F on average
//! eᵀ 1ᵀ w Q 1 e less b · S⁻¹ b with b = Jᵀ w Q 1 e.

use crate::control::Control;
use crate::error::Result;
use crate::frames::{Real, Shape};
use crate::joint::System;
use crate::random;

/// The noise of a dark.
pub(super) struct Dark {
    /// The standard deviation of e, by pixel.
    std: Vec<f32>,
    /// a.
    propagation: Vec<f32>,
    /// The mean of eᵀ 1ᵀ w Q 1 e.
    pub(super) left: f64,
    /// The variance of a e in the gauge, in the units of the map, for which it is found.
    pub(super) in_gauge: Vec<f32>,
}

impl Dark {
    /// That of a system without offsets, of these variances.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(super) fn of<T: Real>(
        system: &mut System<'_, '_, T>,
        variance: &[f64],
        control: &Control,
    ) -> Result<Self> {
        let (beam, mut no_pull) = (&system.state.beam, vec![0.0; system.state.beam.len()]);
        let found = system.pass.run(
            beam,
            &mut no_pull,
            control,
            |pass, row_index, row, workspace, found| {
                pass.weigh_row(row_index, &mut workspace.weights);
                workspace.values().clear();
                let cols = row.change.len();
                let variance = &variance[row_index * cols..];
                for col in 0..cols {
                    let [mut sum, mut along] = [0.0; 2];
                    let lights = workspace.light.chunks_exact(cols);
                    let exposures = workspace.weights.chunks_exact(cols).zip(lights);
                    for (weights, light) in exposures.filter(|_| row.inverse[col] > 0.0) {
                        sum += weights[col];
                        along += weights[col] * light[col];
                    }
                    row.change[col] = row.inverse[col] * along;
                    workspace.sums[0][col] = variance[col] * (sum - row.change[col] * along);
                }
                let left = &mut workspace.sums[0][..cols];
                pass.few.clear(row_index, left);
                found.objective += left.iter().sum::<f64>();
            },
        )?;
        let mut propagation = Vec::with_capacity(variance.len());
        system.pass.for_rows(|[_, _, change, ..]| {
            propagation.extend(change.iter().map(|&change| change as f32));
        });
        let std = variance.iter().map(|v| v.sqrt() as f32).collect();
        Ok(Self { std, propagation, left: found.objective, in_gauge: Vec::new() })
    }

    /// The variance of a e.
    pub(super) fn propagated(&self) -> impl Iterator<Item = f64> {
        self.factors().map(|[a, std]| (a * std).powi(2))
    }

    /// e of a row of pixels in one draw.
    pub(super) fn errors(&self, draw: u64, row: usize, sensor: Shape) -> impl Iterator<Item = f64> {
        let mut sign = random::signs_in_common(draw, row, sensor.rows);
        let std = &self.std[row * sensor.cols..][..sensor.cols];
        std.iter().map(move |&std| sign() * f64::from(std))
    }

    /// a e in one draw.
    pub(super) fn propagate(&self, draw: u64, sensor: Shape) -> Vec<f64> {
        let errors = (0..sensor.rows).flat_map(|row| self.errors(draw, row, sensor));
        errors.zip(&self.propagation).map(|(error, &a)| f64::from(a) * error).collect()
    }

    /// What it adds to the variance of Σ g M where 1ᵀ w Q J x is `influence`.
    pub(super) fn variance_of(&self, gain: &[f64], influence: &[f64]) -> f64 {
        let pixels = self.factors().zip(gain.iter().zip(influence));
        pixels.map(|([a, std], (g, h))| ((a * g + h) * std).powi(2)).sum()
    }

    /// a and the standard deviation of e, by pixel.
    fn factors(&self) -> impl Iterator<Item = [f64; 2]> {
        let pixels = self.propagation.iter().zip(&self.std);
        pixels.map(|(&a, &std)| [a, std].map(f64::from))
    }
}

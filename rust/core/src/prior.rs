//! The prior of M in weak light.
//!
//! In a pixel whose light is below its noise the measurements do not determine M, nor the cells of L that
//! such pixels see: M L fits noise at any M, and F has no minimum. So there
//!
//! ```text
//! R = Σ_p λ_p (M_p/μ − 1)²,   λ = σ²/A² · (1 − D/(K σ²))²   where D < K σ², else 0
//! ```
//!
//! is added to F, with the mean μ of M over the piece of connected pixels, σ² the variance of a measurement of
//! weight 1 and D = Σ w c² L². It acts on weak pixels alone. A prior on all pixels would count N of them as
//! N measurements of a mean, and bias patterns of the sensor's own size.

use std::sync::Arc;

use crate::connectivity::NONE;

/// The standard deviation A of M, relative to its mean, that is assumed where there is no light. With a larger
/// one noise is fitted by M L at the price of M = 0, and the minimum is not at M near its mean.
const SPREAD: f64 = 0.2;
/// D of the faintest pixel without a prior, in units of σ²: its M is known to 10 %.
pub(crate) const LIT: f64 = 100.0;

/// The weights λ of the prior, and of which piece each pixel is.
#[derive(Clone, Debug)]
pub(crate) struct Prior {
    /// λ, row by row; 0 without a prior.
    pub(crate) weights: Arc<[f64]>,
    /// The piece of connected pixels of each; [`NONE`] without a measurement.
    pub(crate) pieces: Arc<[i32]>,
    /// The mean of M in each piece.
    means: Vec<f64>,
    /// What the prior pulls at each M by the mean, alike in a piece.
    common: Vec<f64>,
}

/// λ at this D.
pub(crate) fn weight(information: f64, variance: f64) -> f64 {
    let lacking = (1.0 - information / (LIT * variance)).max(0.0);
    variance / (SPREAD * SPREAD) * lacking * lacking
}

impl Prior {
    pub(crate) fn new(weights: Arc<[f64]>, pieces: Arc<[i32]>) -> Self {
        let count = pieces.iter().max().map_or(0, |&last| (last + 1) as usize);
        Self { weights, pieces, means: vec![1.0; count], common: vec![0.0; count] }
    }

    /// Takes the means at this M; returns R.
    pub(crate) fn at(&mut self, sensitivity: &[f64]) -> f64 {
        let count = self.means.len();
        self.means = means(&self.pieces, count, |pixel| sensitivity[pixel]);
        self.common = vec![0.0; count];
        let mut total = 0.0;
        for (pixel, (&weight, &piece)) in self.weights.iter().zip(&*self.pieces).enumerate() {
            let Ok(piece) = usize::try_from(piece) else { continue };
            if weight == 0.0 {
                continue;
            }
            let relative = sensitivity[pixel] / self.means[piece];
            self.common[piece] += weight * (1.0 - relative) * relative;
            total += weight * (1.0 - relative).powi(2);
        }
        let mut sums = vec![0.0; count];
        self.pieces.iter().filter(|piece| **piece != NONE).for_each(|&p| sums[p as usize] += 1.0);
        let terms = self.common.iter_mut().zip(&self.means).zip(sums);
        terms.for_each(|((common, mean), sum)| *common /= mean * sum);
        total
    }

    /// Half the slope of −R along the M of a pixel, at the means taken last.
    pub(crate) fn slope(&self, pixel: usize, sensitivity: f64) -> f64 {
        let Ok(piece) = usize::try_from(self.pieces[pixel]) else { return 0.0 };
        let mean = self.means[piece];
        self.weights[pixel] * (1.0 - sensitivity / mean) / mean - self.common[piece]
    }

    /// Half the curvature of R along the M of a pixel, its mean being given.
    pub(crate) fn curvature(&self, pixel: usize) -> f64 {
        match usize::try_from(self.pieces[pixel]) {
            Ok(piece) => self.weights[pixel] / self.means[piece].powi(2),
            Err(_) => 0.0,
        }
    }
}

/// The mean of a value in each piece.
fn means(pieces: &[i32], count: usize, value: impl Fn(usize) -> f64) -> Vec<f64> {
    let mut sums = vec![(0.0, 0.0); count];
    for (pixel, &piece) in pieces.iter().enumerate().filter(|(_, piece)| **piece != NONE) {
        let sum = &mut sums[piece as usize];
        *sum = (sum.0 + value(pixel), sum.1 + 1.0);
    }
    sums.into_iter().map(|(sum, count)| sum / count).collect()
}

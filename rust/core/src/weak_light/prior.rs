//! The prior of M: its weights λ, what they leave open, and its slope at an M.

use std::sync::Arc;

use crate::connectivity::NONE;
use crate::median::{MEDIAN_OF_SQUARES, median};

/// The standard deviation A of M, relative to its mean, that is assumed where there is no light. With a larger
/// one noise is fitted by M L at the price of M = 0, and the minimum is not at M near its mean.
const SPREAD: f64 = 0.2;
/// D of a pixel that needs no prior, in units of σ²: its M is known to 10 %.
pub(super) const LIT: f64 = 100.0;
/// D of a pixel that needs one in any light, in units of σ²: its M is not known to 50 %.
const UNKNOWN: f64 = 4.0;
/// D of the faintest reliable pixel in weak light, in units of σ²: its M is known to 4 %.
const RELIABLE: f64 = 625.0;
/// D of a bright pixel over that of one in weak light, at least: a quarter of the light.
const WEAK: f64 = 16.0;
/// The share of lit pixels that is fainter than a bright one: a few brighter ones do not count.
const BRIGHT: f64 = 0.9;
/// Degrees of freedom, as a share of the measurements, of which residuals determine the noise.
const LEAST_FREEDOM: f64 = 0.1;
/// Pixels of a sensor that are looked at for a bright one, at most.
const SAMPLES: usize = 1 << 16;
/// Fewer lit pixels are chance.
const FEWEST: usize = 16;

/// The weights λ of the prior, and of which piece each pixel is.
#[derive(Clone, Debug)]
pub(crate) struct Prior {
    /// λ, row by row; 0 without a prior.
    pub(crate) weights: Arc<[f64]>,
    /// The piece of connected pixels of each; [`NONE`] without a measurement, and in a piece without λ.
    pub(crate) pieces: Arc<[i32]>,
    /// The mean of M in each piece.
    means: Vec<f64>,
    /// What the prior pulls at each M by the mean, alike in a piece.
    common: Vec<f64>,
}

/// λ of each pixel at this D.
pub(super) fn weights(information: &[f64], variance: f64) -> Arc<[f64]> {
    let weak = bright(information, variance) / WEAK;
    let enough = (LIT * variance).min(weak.max(UNKNOWN * variance));
    let weight = |&d: &f64| {
        let lacking = if d > 0.0 { (1.0 - d / enough).max(0.0) } else { 0.0 };
        variance / (SPREAD * SPREAD) * lacking * lacking
    };
    information.iter().map(weight).collect()
}

/// D of a bright pixel: of those that are lit, however few they are, or else of all.
fn bright(information: &[f64], variance: f64) -> f64 {
    let above = move |least: f64| information.iter().copied().filter(move |d| *d > least);
    let lit = above(LIT * variance).count();
    let (least, count) =
        if lit < FEWEST { (0.0, above(0.0).count()) } else { (LIT * variance, lit) };
    let step = count.div_ceil(SAMPLES).max(1);
    let mut sample: Vec<f64> = above(least).step_by(step).collect();
    let place = (sample.len() as f64 * BRIGHT) as usize;
    if sample.is_empty() { 0.0 } else { *sample.select_nth_unstable_by(place, f64::total_cmp).1 }
}

/// The least D above 0, and the largest.
pub(crate) fn range(information: &[f64]) -> [f64; 2] {
    let seen = || information.iter().copied().filter(|d| *d > 0.0);
    [seen().fold(f64::INFINITY, f64::min), seen().fold(0.0, f64::max)]
}

/// The variance of a measurement of weight 1 from squares of some residuals of `used` measurements: their median,
/// which a few false ones do not move. `None` if without a prior, which leaves `freed` unknowns open, so few
/// degrees of freedom are left that it says little.
pub(crate) fn variance(
    mut squares: Vec<f64>,
    used: usize,
    freedom: f64,
    freed: f64,
) -> Option<f64> {
    let square = median(&mut squares, f64::total_cmp).unwrap_or(0.0) / MEDIAN_OF_SQUARES;
    let used = used as f64;
    (freedom >= LEAST_FREEDOM * used).then(|| square * used / (freedom + freed))
}

/// The pixels that have a prior, or light so weak beside others' that M is not reliable; D is that where the
/// mean of M is 1.
pub(super) fn held(weights: &[f64], information: &[f64], variance: f64) -> Vec<usize> {
    let reliable = (RELIABLE * variance).min(bright(information, variance) / WEAK);
    let is_held = |(weight, d): (&f64, &f64)| *weight > 0.0 || (*d > 0.0 && *d < reliable);
    let pixels = weights.iter().zip(information).enumerate();
    pixels.filter(|&(_, pixel)| is_held(pixel)).map(|(pixel, _)| pixel).collect()
}

/// The part of the pixels' unknowns that the data leave to the prior, as the expectation of F shows it, where M
/// scatters about its mean of 1 by `scatter`:
///
/// ```text
/// Σ_p (1 − h)² (1 + D s²/σ²),   h = D/(D + λ)
/// ```
///
/// that is 1 − h where M scatters as the prior supposes.
pub(super) fn freed(weights: &[f64], information: &[f64], variance: f64, scatter: f64) -> f64 {
    // Pixels without D are no unknowns of the search.
    let pixels = weights.iter().zip(information).filter(|(weight, d)| **weight > 0.0 && **d > 0.0);
    let open = pixels.map(|(weight, d)| {
        let left = weight / (d + weight);
        left * left * (1.0 + d * scatter * scatter / variance)
    });
    open.sum()
}

/// The standard deviation of M about its mean, relative to that, in pixels without a prior; at most what the
/// prior supposes.
pub(super) fn scatter(weights: &[f64], sensitivity: &[f64], mean: f64) -> f64 {
    let free = sensitivity.iter().zip(weights).filter(|(_, weight)| **weight == 0.0);
    let mut squares: Vec<f64> = free.map(|(m, _)| (m / mean - 1.0).powi(2)).collect();
    let found = median(&mut squares, f64::total_cmp).unwrap_or(f64::INFINITY);
    (found / MEDIAN_OF_SQUARES).sqrt().min(SPREAD)
}

impl Prior {
    pub(crate) fn new(weights: Arc<[f64]>, mut pieces: Arc<[i32]>) -> Self {
        let count = pieces.iter().max().map_or(0, |&last| (last + 1) as usize);
        let mut has_weight = vec![false; count];
        for (&weight, &piece) in weights.iter().zip(&*pieces).filter(|(_, piece)| **piece != NONE) {
            has_weight[piece as usize] |= weight > 0.0;
        }
        if has_weight.contains(&false) {
            // The mean of a piece may be 0, and with it a slope 0/0.
            let weighs = |piece: i32| usize::try_from(piece).is_ok_and(|piece| has_weight[piece]);
            pieces = pieces.iter().map(|&piece| if weighs(piece) { piece } else { NONE }).collect();
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_piece_without_weights_has_no_part_in_it() {
        let mut prior = Prior::new(vec![2.0, 0.0, 0.0].into(), vec![1, 1, 0].into());
        // Of mean 1, with 1 − M = 0.5 and 0; a step has taken the pixel that is alone to 0.
        let sensitivity = [0.5, 1.5, 0.0];
        assert!((prior.at(&sensitivity) - 0.5).abs() < 1e-15);
        let slopes: Vec<f64> = (0..3).map(|pixel| prior.slope(pixel, sensitivity[pixel])).collect();
        // λ(1 − M) less the mean of λ(1 − M) M over the piece.
        assert!((slopes[0] - 0.75).abs() < 1e-15 && (slopes[1] + 0.25).abs() < 1e-15);
        assert!(slopes[2] == 0.0 && prior.curvature(2) == 0.0 && prior.curvature(0) == 2.0);
    }
}

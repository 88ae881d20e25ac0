//! The pixels around the spot, mended, with their variances.

use super::region::Region;
use super::surface::median;
use crate::control::Control;
use crate::error::Result;
use crate::frames::{Sample, Shape, Stack};

/// A pixel that lies beyond its neighbours, the outermost on either side left out, by more than
/// this many times the distance of these two is hot or dead.
const OUTLIER: f64 = 4.0;

/// Median of the square of a standard normal variable.
const NORMAL_MEDIAN_SQUARE: f64 = 0.454_936_423_119_572;

/// The part of an image where the spot is.
#[derive(Debug)]
pub(super) struct Patch {
    pub(super) region: Region,
    pub(super) values: Vec<f64>,
    /// Which pixels were hot or dead, and are now the median of their neighbours.
    pub(super) mended: Vec<bool>,
}

impl Patch {
    /// The part `region` of `image`, hot and dead pixels mended. The outermost pixels stay as they
    /// are: they are background, where the fit of the surface copes with them.
    pub(super) fn mended(
        image: &[f64],
        shape: Shape,
        region: Region,
        control: &Control,
    ) -> Result<Self> {
        let raw = region.rows(image, shape).collect::<Vec<_>>().concat();
        let (width, height) = (region.width(), region.height());
        let mut patch = Self { region, mended: vec![false; raw.len()], values: raw.clone() };
        for row in 1..height - 1 {
            control.check()?;
            for pixel in row * width + 1..(row + 1) * width - 1 {
                let near = sorted_neighbours(&raw, width, pixel);
                let (low, high) = (near[1], near[6]);
                let beyond = (raw[pixel] - high).max(low - raw[pixel]);
                if beyond > OUTLIER * (high - low) {
                    patch.mended[pixel] = true;
                    patch.values[pixel] = (near[3] + near[4]) / 2.0;
                }
            }
        }
        Ok(patch)
    }

    /// Variance of the mean of at least two frames, from their scatter.
    pub(super) fn variance_of_frames<T: Sample>(
        &self,
        frames: Stack<'_, T>,
        mean: &[f64],
        control: &Control,
    ) -> Result<Vec<f64>> {
        let shape = frames.shape();
        let count = frames.count() as f64;
        let mut variance = vec![0.0; self.values.len()];
        for index in 0..frames.count() {
            control.check()?;
            let values = self.region.rows(frames.frame(index), shape).flatten();
            let means = self.region.rows(mean, shape).flatten();
            for ((sum, value), mean) in variance.iter_mut().zip(values).zip(means) {
                *sum += (value.to_f64() - mean).powi(2);
            }
        }
        variance.iter_mut().for_each(|sum| *sum /= (count - 1.0) * count);
        Ok(self.mend_variance(variance))
    }

    fn mend_variance(&self, raw: Vec<f64>) -> Vec<f64> {
        let mut variance = raw.clone();
        for pixel in (0..raw.len()).filter(|&pixel| self.mended[pixel]) {
            let near = sorted_neighbours(&raw, self.region.width(), pixel);
            variance[pixel] = (near[3] + near[4]) / 2.0;
        }
        variance
    }

    /// Variance of a single image: v₀ + κ·max(signal, 0).
    ///
    /// v₀ is the median of the roughness around the window, κ that of the roughness less v₀ over
    /// the signal in the bright part of the spot. Non-uniformity is rough too and counts as noise.
    pub(super) fn variance_of_one(&self, signal: &[f64], window: Region, bright: f64) -> Vec<f64> {
        let inner = self.region.widened(-1);
        let mut around = Vec::new();
        let mut spot = Vec::new();
        for (pixel, (row, col)) in self.region.pixels().enumerate() {
            if inner.contains(row, col) && !window.contains(row, col) {
                around.push(self.roughness(pixel));
            } else if window.contains(row, col) && signal[pixel] > bright {
                spot.push(pixel);
            }
        }
        let background = median(&mut around);
        let per_signal = |pixel: usize| (self.roughness(pixel) - background) / signal[pixel];
        let mut factors: Vec<f64> = spot.into_iter().map(per_signal).collect();
        let factor = median(&mut factors).max(0.0);
        signal.iter().map(|signal| background + factor * signal.max(0.0)).collect()
    }

    /// Square of the second difference along rows and columns, (1 −2 1)ᵀ(1 −2 1)/6, scaled so that
    /// its median is the variance of normal noise. Smooth light leaves only fourth derivatives.
    fn roughness(&self, pixel: usize) -> f64 {
        let width = self.region.width();
        let along = |middle: usize| {
            self.values[middle - width] - 2.0 * self.values[middle] + self.values[middle + width]
        };
        let both = along(pixel - 1) - 2.0 * along(pixel) + along(pixel + 1);
        both * both / (36.0 * NORMAL_MEDIAN_SQUARE)
    }
}

/// The eight neighbours of an inner pixel in rising order.
fn sorted_neighbours(values: &[f64], width: usize, pixel: usize) -> [f64; 8] {
    let (above, below) = (pixel - width, pixel + width);
    let mut near = [above - 1, above, above + 1, pixel - 1, pixel + 1, below - 1, below, below + 1]
        .map(|neighbour| values[neighbour]);
    near.sort_unstable_by(f64::total_cmp);
    near
}

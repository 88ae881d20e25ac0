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
    /// Which pixels were hot or dead, and are now what their neighbours predict.
    pub(super) mended: Vec<bool>,
}

impl Patch {
    /// The part `region` of `image`, hot and dead pixels mended. The outermost pixels stay as they
    /// are: they are background, where the fit of the surface copes with them.
    ///
    /// A pixel is hot or dead if it lies far beyond its neighbours, or farther from what they
    /// predict than `departure`, which finds the worst on the spot's steep outline too.
    pub(super) fn mended(
        image: &[f64],
        shape: Shape,
        region: Region,
        departure: f64,
        control: &Control,
    ) -> Result<Self> {
        let raw = region.rows(image, shape).collect::<Vec<_>>().concat();
        let (width, height) = (region.width(), region.height());
        let mut patch = Self { region, mended: vec![false; raw.len()], values: raw.clone() };
        for row in 1..height - 1 {
            control.check()?;
            for pixel in row * width + 1..(row + 1) * width - 1 {
                let predicted = predicted(&raw, width, pixel);
                let far = (raw[pixel] - predicted).abs() > departure;
                if far || stands_out(&raw, width, pixel) {
                    patch.mended[pixel] = true;
                    patch.values[pixel] = predicted;
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
            variance[pixel] = predicted(&raw, self.region.width(), pixel);
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

/// Whether an inner pixel lies far beyond its neighbours; one bad neighbour does no harm.
fn stands_out(values: &[f64], width: usize, pixel: usize) -> bool {
    let [[a, b], [c, d], [e, f], [g, h]] = opposite_neighbours(values, width, pixel);
    let mut near = [a, b, c, d, e, f, g, h];
    near.sort_unstable_by(f64::total_cmp);
    let (low, high) = (near[1], near[6]);
    (values[pixel] - high).max(low - values[pixel]) > OUTLIER * (high - low)
}

/// Value of an inner pixel by its neighbours: the median of the means of opposite ones, which
/// follows a slope and is not harmed by one bad neighbour.
fn predicted(values: &[f64], width: usize, pixel: usize) -> f64 {
    let mut means = opposite_neighbours(values, width, pixel).map(|[a, b]| (a + b) / 2.0);
    median(&mut means)
}

fn opposite_neighbours(values: &[f64], width: usize, pixel: usize) -> [[f64; 2]; 4] {
    [1, width - 1, width, width + 1].map(|step| [values[pixel - step], values[pixel + step]])
}

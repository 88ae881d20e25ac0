//! Draws whose squares are averaged over a window around each pixel.
//!
//! The sampled part of a variance is nearly proportional to a part that is known in each pixel: what the
//! noise of each cell of the beam by itself does to M. Their ratio is smooth, so its mean over a window of
//! pixels takes the place of that over many draws. Draws are correlated over large scales, which no window
//! averages: how exact the map is follows from the scatter of the smoothed draws.

use super::sampling::{EXACTNESS, MOST_DRAWS, Sampled};
use crate::control::Control;
use crate::error::Result;
use crate::frames::Shape;

/// Pixels along each side of a window.
const SIDE: usize = 7;
/// The fewest draws: so many average what is common to the pixels of a window.
const FIRST_DRAWS: u64 = 24;
/// The fewest windows along each side of the sensor: the ratio changes at the sensor's edges.
const FEWEST_WINDOWS: usize = 10;

/// What one draw finds in each pixel, in the gauge of the result.
pub(super) struct Change {
    /// What the beam and the other unknowns make of M.
    pub(super) sampled: Vec<f64>,
    /// What M follows of the dark at once; empty without a dark.
    pub(super) propagated: Vec<f64>,
}

/// A linear problem that draws can be made of and smoothed.
pub(super) trait Smooth {
    /// The part of the variance of M that is known.
    fn known(&mut self, control: &Control) -> Result<Vec<f32>>;
    /// What the sampled part is nearly proportional to; 0 in pixels that do not count.
    fn local(&mut self, control: &Control) -> Result<Vec<f64>>;
    /// The part of the known variance whose draws multiply the rest; empty without a dark.
    fn propagated(&self) -> &[f32];
    /// One draw.
    fn change(&mut self, draw: u64, control: &Control) -> Result<Change>;
}

/// Whether draws on such a sensor are smoothed.
pub(super) fn is_smoothed(sensor: Shape) -> bool {
    sensor.rows.min(sensor.cols) >= FEWEST_WINDOWS * SIDE
}

/// As many smoothed draws as it takes.
pub(super) fn smoothed(
    problem: &mut impl Smooth,
    sensor: Shape,
    control: &Control,
) -> Result<Sampled> {
    let known = problem.known(control)?;
    let mut sums = Sums::new(known, problem.local(control)?, sensor);
    let mut wanted = FIRST_DRAWS;
    while sums.draws < wanted {
        control.report("uncertainty", sums.draws, wanted);
        let change = problem.change(sums.draws, control)?;
        sums.add(&change, problem.propagated());
        if sums.draws == wanted {
            let exactness = sums.exactness();
            let needed = wanted as f64 * (exactness / EXACTNESS).powi(2);
            wanted = (needed.ceil() as u64).min(MOST_DRAWS);
        }
    }
    control.report("uncertainty", sums.draws, sums.draws);
    let exactness = sums.exactness();
    let Sums { known, sums: squares, draws, .. } = sums;
    Ok(Sampled { known, squares, draws, exactness })
}

/// Sums over draws.
struct Sums {
    sensor: Shape,
    known: Vec<f32>,
    local: Vec<f64>,
    /// The sum of `local` over the window of each pixel.
    around: Vec<f64>,
    /// Of the smoothed variances, and of their squares.
    sums: Vec<f32>,
    squares: Vec<f32>,
    draws: u64,
}

impl Sums {
    fn new(known: Vec<f32>, local: Vec<f64>, sensor: Shape) -> Self {
        let mut around = local.clone();
        over_windows(&mut around, sensor);
        let [sums, squares] = [(); 2].map(|()| vec![0.0; known.len()]);
        Self { sensor, known, local, around, sums, squares, draws: 0 }
    }

    /// Adds the smoothed variance of one draw.
    fn add(&mut self, change: &Change, propagated: &[f32]) {
        let counts = |pixel: usize| self.local[pixel] > 0.0;
        let squares = change.sampled.iter().enumerate();
        let mut own: Vec<f64> =
            squares.map(|(pixel, x)| if counts(pixel) { x * x } else { 0.0 }).collect();
        over_windows(&mut own, self.sensor);
        for (own, (local, around)) in own.iter_mut().zip(self.local.iter().zip(&self.around)) {
            *own *= if *around > 0.0 { local / around } else { 0.0 };
        }
        for ((own, product), variance) in
            own.iter_mut().zip(self.products(change, propagated)).zip(propagated)
        {
            *own += 2.0 * product * f64::from(*variance);
        }
        for ((own, sum), square) in own.iter().zip(&mut self.sums).zip(&mut self.squares) {
            *sum += *own as f32;
            *square += (own * own) as f32;
        }
        self.draws += 1;
    }

    /// The products of a draw with what M follows at once, over the squares of the latter, in each window.
    fn products(&self, change: &Change, propagated: &[f32]) -> Vec<f64> {
        if propagated.is_empty() {
            return Vec::new();
        }
        let counts = |pixel: usize| self.local[pixel] > 0.0;
        let pairs = change.sampled.iter().zip(&change.propagated).enumerate();
        let mut products: Vec<f64> =
            pairs.map(|(pixel, (a, b))| if counts(pixel) { a * b } else { 0.0 }).collect();
        let squares = propagated.iter().enumerate();
        let mut around: Vec<f64> =
            squares.map(|(pixel, v)| if counts(pixel) { f64::from(*v) } else { 0.0 }).collect();
        over_windows(&mut products, self.sensor);
        over_windows(&mut around, self.sensor);
        for (product, around) in products.iter_mut().zip(around) {
            *product /= if around > 0.0 { around } else { 1.0 };
        }
        products
    }

    /// The relative standard error of the deviations, root mean square over the pixels that count: a
    /// root halves that of the variance.
    fn exactness(&self) -> f64 {
        let draws = self.draws as f64;
        let [mut sum, mut count] = [0.0; 2];
        for pixel in (0..self.known.len()).filter(|&pixel| self.local[pixel] > 0.0) {
            let mean = f64::from(self.sums[pixel]) / draws;
            let scatter = f64::from(self.squares[pixel]) / draws - mean * mean;
            let variance = (f64::from(self.known[pixel]) + mean).max(f64::MIN_POSITIVE);
            sum += scatter.max(0.0) / (draws - 1.0) / variance.powi(2);
            count += 1.0;
        }
        0.5 * (sum / f64::max(count, 1.0)).sqrt()
    }
}

/// Replaces each pixel by the sum over the window around it, as far as it lies on the sensor.
fn over_windows(image: &mut [f64], sensor: Shape) {
    let reach = |at: usize, size: usize| at.saturating_sub(SIDE / 2)..(at + SIDE / 2 + 1).min(size);
    let mut line = vec![0.0; sensor.cols];
    for row in image.chunks_exact_mut(sensor.cols) {
        line.copy_from_slice(row);
        for (col, sum) in row.iter_mut().enumerate() {
            *sum = line[reach(col, sensor.cols)].iter().sum();
        }
    }
    let along_rows = image.to_vec();
    for (row, sums) in image.chunks_exact_mut(sensor.cols).enumerate() {
        sums.fill(0.0);
        for other in reach(row, sensor.rows) {
            let values = &along_rows[other * sensor.cols..][..sensor.cols];
            sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_ends_at_the_edges_of_the_sensor() {
        let sensor = Shape::new(11, 13);
        let mut image: Vec<f64> =
            (0..sensor.len()).map(|pixel| (pixel * pixel % 17) as f64).collect();
        let whole = image.clone();
        over_windows(&mut image, sensor);
        for (pixel, sum) in image.iter().enumerate() {
            let near = |a: usize, b: usize| a.abs_diff(b) <= SIDE / 2;
            let inside = |other: &usize| {
                near(pixel / sensor.cols, other / sensor.cols)
                    && near(pixel % sensor.cols, other % sensor.cols)
            };
            let wanted: f64 = (0..sensor.len()).filter(inside).map(|other| whole[other]).sum();
            // Sums of small whole numbers are exact.
            assert_eq!(*sum, wanted);
        }
    }
}

//! Low spatial frequencies of an image.
//!
//! A direct transform by products with tables of cosines and sines. Only frequencies up to 0.1 cycles per
//! pixel are wanted, a fiftieth of all, so the products take less time than a full FFT in single precision
//! would, and the crate needs no FFT library. Rows and columns are folded about their centre first, which
//! halves the products.

use std::f64::consts::PI;

use super::bands::wide;
use crate::frames::Shape;
use crate::parallel::Workers;

/// Rows of the image that a thread transforms at a time.
const LINES: usize = 8;

/// Factors of one axis: frequency · place about the centre, for places of the first half.
#[derive(Debug)]
struct Axis {
    size: usize,
    /// Number of frequencies 0, 1, … over the size.
    count: usize,
    /// cos and sin, `count` of each for every place.
    cos: Vec<f32>,
    sin: Vec<f32>,
    /// Hann window at each place.
    window: Vec<f32>,
}

impl Axis {
    fn new(size: usize, cutoff: f64) -> Self {
        let count = (cutoff * size as f64).ceil() as usize;
        let angles = |function: fn(f64) -> f64| {
            let half = size.div_ceil(2);
            let place = |i: usize| i as f64 - (size as f64 - 1.0) / 2.0;
            let angle = move |i: usize, k: usize| 2.0 * PI * k as f64 / size as f64 * place(i);
            (0..half * count).map(|i| function(angle(i / count, i % count)) as f32).collect()
        };
        let window = |i: usize| (PI * (i as f64 + 0.5) / size as f64).sin().powi(2) as f32;
        let window = (0..size).map(window).collect();
        Self { size, count, cos: angles(f64::cos), sin: angles(f64::sin), window }
    }

    /// The opposite of a place of the first half; none of the middle.
    fn opposite(&self, place: usize) -> Option<usize> {
        let other = self.size - 1 - place;
        (other > place).then_some(other)
    }

    fn half(&self) -> usize {
        self.size.div_ceil(2)
    }
}

/// The transform of images of one shape.
#[derive(Debug)]
pub(super) struct Transform {
    shape: Shape,
    rows: Axis,
    cols: Axis,
}

/// Amplitudes at the frequencies (k, l), k from −K to K along the rows, l from 0 to L along the columns,
/// about the centre of the image.
#[derive(Clone, Debug, Default)]
pub(super) struct Spectrum {
    pub(super) re: Vec<f32>,
    pub(super) im: Vec<f32>,
}

impl Transform {
    /// Frequencies below `cutoff` cycles per pixel along each axis.
    pub(super) fn new(shape: Shape, cutoff: f64) -> Self {
        Self { shape, rows: Axis::new(shape.rows, cutoff), cols: Axis::new(shape.cols, cutoff) }
    }

    /// Rows and columns of a spectrum.
    pub(super) fn sizes(&self) -> [usize; 2] {
        [2 * self.rows.count - 1, self.cols.count]
    }

    /// Frequencies in radians per pixel of an entry of a spectrum.
    pub(super) fn frequency(&self, entry: usize) -> [f64; 2] {
        let (line, col) = (entry / self.cols.count, entry % self.cols.count);
        let row = line as f64 - (self.rows.count as f64 - 1.0);
        [2.0 * PI * row / self.shape.rows as f64, 2.0 * PI * col as f64 / self.shape.cols as f64]
    }

    /// Amplitudes of an image under a Hann window, less its mean.
    pub(super) fn of(&self, image: &[f32], mean: f32, workers: &Workers) -> Spectrum {
        let count = self.cols.count;
        // A row of amplitudes: count real parts, then as many imaginary ones.
        let mut lines = vec![0.0_f32; self.shape.rows * 2 * count];
        workers.map_blocks(&mut lines, LINES * 2 * count, |index, lines| {
            along_cols(self, image, mean, index * LINES, lines);
        });
        let found = workers.map(self.rows.count, |k| along_rows(self, &lines, k));
        let mut spectrum = Spectrum::default();
        let negative = found[1..].iter().rev().map(|[_, minus]| minus);
        for values in negative.chain(found.iter().map(|[plus, _]| plus)) {
            let (re, im) = values.split_at(count);
            spectrum.re.extend_from_slice(re);
            spectrum.im.extend_from_slice(im);
        }
        spectrum
    }

    /// Transforms some rows: Σ v exp(−iθ) over the columns.
    #[inline(always)]
    fn along_cols(&self, image: &[f32], mean: f32, first: usize, lines: &mut [f32]) {
        let (axis, cols) = (&self.cols, self.shape.cols);
        for (row, line) in lines.chunks_mut(2 * axis.count).enumerate() {
            let values = &image[(first + row) * cols..(first + row + 1) * cols];
            let (re, im) = line.split_at_mut(axis.count);
            let weight = self.rows.window[first + row];
            for place in 0..axis.half() {
                let one = weight * axis.window[place] * (values[place] - mean);
                let other = axis
                    .opposite(place)
                    .map_or(0.0, |other| weight * axis.window[other] * (values[other] - mean));
                let (even, odd) = (one + other, one - other);
                let start = place * axis.count;
                let (cos, sin) = (&axis.cos[start..], &axis.sin[start..]);
                for (re, cos) in re.iter_mut().zip(cos) {
                    *re += even * cos;
                }
                for (im, sin) in im.iter_mut().zip(sin) {
                    *im -= odd * sin;
                }
            }
        }
    }

    /// Amplitudes at the frequencies k and −k along the rows: real parts, then imaginary ones.
    #[inline(always)]
    fn along_rows(&self, lines: &[f32], k: usize) -> [Vec<f32>; 2] {
        let (axis, width) = (&self.rows, 2 * self.cols.count);
        let (mut even, mut odd) = (vec![0.0_f32; width], vec![0.0_f32; width]);
        for place in 0..axis.half() {
            let [cos, sin] = [&axis.cos, &axis.sin].map(|table| table[place * axis.count + k]);
            let one = &lines[place * width..(place + 1) * width];
            match axis.opposite(place) {
                Some(other) => {
                    let other = &lines[other * width..(other + 1) * width];
                    for i in 0..width {
                        even[i] += cos * (one[i] + other[i]);
                        odd[i] += sin * (one[i] - other[i]);
                    }
                }
                None => {
                    for i in 0..width {
                        even[i] += cos * one[i];
                        odd[i] += sin * one[i];
                    }
                }
            }
        }
        // even ∓ i odd.
        let count = self.cols.count;
        [1.0, -1.0].map(|sign: f32| {
            let turn = |i: usize| {
                if i < count { sign * odd[i + count] } else { -sign * odd[i - count] }
            };
            (0..width).map(|i| even[i] + turn(i)).collect()
        })
    }
}

wide! {
/// [`Transform::along_cols`].
fn along_cols<'s>(by: &'s Transform, image: &'s [f32], mean: f32, first: usize, lines: &'s mut [f32]) -> () {
    by.along_cols(image, mean, first, lines);
}
}

wide! {
/// [`Transform::along_rows`].
fn along_rows<'s>(by: &'s Transform, lines: &'s [f32], k: usize) -> [Vec<f32>; 2] {
    by.along_rows(lines, k)
}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn amplitudes_are_the_direct_sums() {
        let shape = Shape::new(31, 48);
        let image: Vec<f32> = (0..shape.len()).map(|i| ((i * 7919) % 1009) as f32 / 1e3).collect();
        let transform = Transform::new(shape, 0.1);
        let workers = Workers::new(std::num::NonZeroUsize::new(2)).unwrap();
        let mean = 0.5_f32;
        let spectrum = transform.of(&image, mean, &workers);
        let [lines, cols] = transform.sizes();
        assert_eq!([lines, cols], [7, 5]);
        let window = |i: usize, size: usize| (PI * (i as f64 + 0.5) / size as f64).sin().powi(2);
        for entry in 0..lines * cols {
            let [u, v] = transform.frequency(entry);
            let mut wanted = [0.0; 2];
            for (i, value) in image.iter().enumerate() {
                let (row, col) = (i / 48, i % 48);
                let value = window(row, 31) * window(col, 48) * f64::from(value - mean);
                let angle = u * (row as f64 - 15.0) + v * (col as f64 - 23.5);
                wanted[0] += value * angle.cos();
                wanted[1] -= value * angle.sin();
            }
            // Rounding of 31 + 48 additions that reach some 100.
            let allowed = 100.0 * 80.0 * f64::from(f32::EPSILON);
            assert!((f64::from(spectrum.re[entry]) - wanted[0]).abs() < allowed, "{entry}");
            assert!((f64::from(spectrum.im[entry]) - wanted[1]).abs() < allowed, "{entry}");
        }
    }
}

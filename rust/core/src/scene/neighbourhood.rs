//! Means over the neighbours of each pixel; at the edges the image is reflected about the edge pixels, which do not repeat.

use super::bands::mirrored;
use crate::frames::Shape;

/// An image of single precision.
#[derive(Clone, Copy, Debug)]
pub(super) struct Image<'a> {
    pub(super) shape: Shape,
    pub(super) values: &'a [f32],
}

impl<'a> Image<'a> {
    pub(super) fn new(shape: Shape, values: &'a [f32]) -> Self {
        Self { shape, values }
    }

    /// A row, reflected where it lies outside.
    fn row(&self, row: isize) -> &'a [f32] {
        let row = mirrored(row, self.shape.rows);
        &self.values[row * self.shape.cols..(row + 1) * self.shape.cols]
    }
}

/// Writes a row between `reach` reflected values on either side.
fn pad(row: &[f32], reach: usize, padded: &mut [f32]) {
    padded[reach..reach + row.len()].copy_from_slice(row);
    for i in 0..reach {
        padded[reach - 1 - i] = row[mirrored(-1 - i as isize, row.len())];
        padded[reach + row.len() + i] = row[mirrored((row.len() + i) as isize, row.len())];
    }
}

/// Weights of the neighbours, of odd sizes, with the sum 1.
#[derive(Clone, Debug)]
pub(super) struct Kernel {
    sizes: [usize; 2],
    weights: Vec<f32>,
}

impl Kernel {
    pub(super) fn new(sizes: [usize; 2], weights: &[f64]) -> Self {
        Self { sizes, weights: weights.iter().map(|weight| *weight as f32).collect() }
    }

    /// Rows and columns of a square that holds it.
    pub(super) fn width(&self) -> usize {
        self.sizes[0].max(self.sizes[1])
    }

    /// The weighted mean of the neighbours for each pixel of a row.
    pub(super) fn mean(
        &self,
        image: Image<'_>,
        row: usize,
        padded: &mut Vec<f32>,
        mean: &mut [f32],
    ) {
        let [rows, cols] = self.sizes;
        padded.resize(image.shape.cols + cols - 1, 0.0);
        mean.fill(0.0);
        for (i, weights) in self.weights.chunks(cols).enumerate() {
            if weights.iter().all(|weight| *weight == 0.0) {
                continue;
            }
            pad(image.row((row + i) as isize - (rows / 2) as isize), cols / 2, padded);
            for (j, weight) in weights.iter().enumerate().filter(|(_, weight)| **weight != 0.0) {
                for (sum, value) in mean.iter_mut().zip(&padded[j..]) {
                    *sum += weight * value;
                }
            }
        }
    }
}

/// Means over squares of odd width, one row of pixels after the other.
///
/// The sums along columns go on from row to row, and those along rows are made of sums of 2, 4, 8, …
/// values, so that both run in vector registers.
#[derive(Debug)]
pub(super) struct Squares<F> {
    width: usize,
    shape: Shape,
    /// Writes the row of the image, reflected where it lies outside.
    values: F,
    row: isize,
    sums: Vec<f32>,
    line: Vec<f32>,
    padded: Vec<f32>,
    doubled: Vec<f32>,
    total: Vec<f32>,
}

impl<F: Fn(usize, &mut [f32])> Squares<F> {
    /// Means from the row `first` on, of the values that `values(row, line)` writes.
    pub(super) fn new(shape: Shape, width: usize, first: usize, values: F) -> Self {
        let (reach, cols) = (width / 2, shape.cols);
        let mut squares = Self {
            width,
            shape,
            values,
            row: first as isize,
            sums: vec![0.0; cols],
            line: vec![0.0; cols],
            padded: vec![0.0; cols + width - 1],
            doubled: vec![0.0; cols + width - 1],
            total: vec![0.0; cols],
        };
        // The last row of the square is added by `next`.
        for row in squares.row - reach as isize..squares.row + reach as isize {
            squares.add(row, 1.0);
        }
        squares
    }

    fn add(&mut self, row: isize, sign: f32) {
        (self.values)(mirrored(row, self.shape.rows), &mut self.line);
        for (sum, value) in self.sums.iter_mut().zip(&self.line) {
            *sum += sign * value;
        }
    }

    /// Writes the means of the next row.
    pub(super) fn next(&mut self, mean: &mut [f32]) {
        let reach = (self.width / 2) as isize;
        self.add(self.row + reach, 1.0);
        pad(&self.sums, self.width / 2, &mut self.padded);
        self.along_row();
        let factor = 1.0 / (self.width * self.width) as f32;
        for (mean, total) in mean.iter_mut().zip(&self.total) {
            *mean = factor * total;
        }
        self.add(self.row - reach, -1.0);
        self.row += 1;
    }

    /// Sums of `width` neighbouring values: those of the binary digits of the width.
    fn along_row(&mut self) {
        self.total.fill(0.0);
        let (mut start, mut length) = (0, 1);
        loop {
            if self.width & length != 0 {
                for (total, value) in self.total.iter_mut().zip(&self.padded[start..]) {
                    *total += value;
                }
                start += length;
            }
            if 2 * length > self.width {
                return;
            }
            let pairs = self.padded.iter().zip(&self.padded[length..]);
            for (sum, (first, second)) in self.doubled.iter_mut().zip(pairs) {
                *sum = first + second;
            }
            std::mem::swap(&mut self.padded, &mut self.doubled);
            length *= 2;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(shape: Shape) -> Vec<f32> {
        (0..shape.len()).map(|i| ((i * 7919) % 1009) as f32 / 1009.0).collect()
    }

    fn naive(image: Image<'_>, sizes: [usize; 2], weights: &[f64], pixel: usize) -> f64 {
        let (row, col) = (pixel / image.shape.cols, pixel % image.shape.cols);
        let mut sum = 0.0;
        for (index, weight) in weights.iter().enumerate() {
            let row = (row + index / sizes[1]) as isize - (sizes[0] / 2) as isize;
            let col = (col + index % sizes[1]) as isize - (sizes[1] / 2) as isize;
            sum += weight * f64::from(image.row(row)[mirrored(col, image.shape.cols)]);
        }
        sum
    }

    #[test]
    fn kernels_and_squares_are_sums_over_reflected_neighbours() {
        let shape = Shape::new(23, 29);
        let values = image(shape);
        let image = Image::new(shape, &values);
        let (mut mean, mut padded) = (vec![0.0; shape.cols], Vec::new());
        for (sizes, width) in [([3, 5], 3), ([5, 1], 11), ([3, 3], 21)] {
            let count = sizes[0] * sizes[1];
            let weights: Vec<f64> = (0..count).map(|i| (i % 4) as f64 / count as f64).collect();
            let kernel = Kernel::new(sizes, &weights);
            let mut squares = Squares::new(shape, width, 4, |row: usize, line: &mut [f32]| {
                line.copy_from_slice(&values[row * shape.cols..(row + 1) * shape.cols]);
            });
            let even = vec![1.0 / (width * width) as f64; width * width];
            for row in 4..20 {
                kernel.mean(image, row, &mut padded, &mut mean);
                // Rounding of as many additions of values below 1.
                let allowed = f64::from(f32::EPSILON) * count as f64;
                for (col, value) in mean.iter().enumerate() {
                    let wanted = naive(image, sizes, &weights, row * shape.cols + col);
                    assert!((f64::from(*value) - wanted).abs() < allowed);
                }
                squares.next(&mut mean);
                // Sums of up to `width` values, rounded at each of 2 · 16 + 2 · width additions.
                let allowed = f64::from(f32::EPSILON) * (32 + 2 * width) as f64;
                for (col, value) in mean.iter().enumerate() {
                    let wanted = naive(image, [width; 2], &even, row * shape.cols + col);
                    assert!((f64::from(*value) - wanted).abs() < allowed, "{width}");
                }
            }
        }
    }
}

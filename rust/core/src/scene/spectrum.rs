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

/// Frequencies along the columns, and rows or frequencies along the rows, of which sums are taken at a time:
/// their sums stay in registers. Of 8 rows they do not, and it takes five times as long.
const TILE: usize = 16;
const LINES: usize = 4;

/// Factors of one axis, for N frequencies at a time.
#[derive(Debug)]
struct Axis<const N: usize> {
    size: usize,
    /// Number of frequencies 0, 1, … over the size.
    count: usize,
    /// cos and sin of frequency · place about the centre, for places of the first half: all those of N
    /// frequencies, then of the next N.
    cos: Vec<[f32; N]>,
    sin: Vec<[f32; N]>,
    /// Hann window at each place.
    window: Vec<f32>,
}

impl<const N: usize> Axis<N> {
    fn new(size: usize, cutoff: f64) -> Self {
        let count = (cutoff * size as f64).ceil() as usize;
        let half = size.div_ceil(2);
        let angles = |function: fn(f64) -> f64| {
            let place = |i: usize| i as f64 - (size as f64 - 1.0) / 2.0;
            let angle = move |i: usize, k: usize| 2.0 * PI * k as f64 / size as f64 * place(i);
            let factors = |i: usize| {
                let first = i / half * N;
                std::array::from_fn(|each| function(angle(i % half, first + each)) as f32)
            };
            (0..count.div_ceil(N) * half).map(factors).collect()
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

    /// How many times N frequencies there are, the last of which may be beyond the count.
    fn blocks(&self) -> usize {
        self.count.div_ceil(N)
    }

    /// cos and sin of N frequencies at the places of the first half.
    fn block(&self, index: usize) -> [&[[f32; N]]; 2] {
        let places = index * self.half()..(index + 1) * self.half();
        [&self.cos[places.clone()], &self.sin[places]]
    }
}

/// The transform of images of one shape.
#[derive(Debug)]
pub(super) struct Transform {
    shape: Shape,
    rows: Axis<LINES>,
    cols: Axis<TILE>,
}

/// Amplitudes at the frequencies (k, l), k from −K to K along the rows, l from 0 to L along the columns,
/// about the centre of the image.
#[derive(Clone, Debug, Default)]
pub(super) struct Spectrum {
    pub(super) re: Vec<f32>,
    pub(super) im: Vec<f32>,
}

/// Sums over places of frequencies along the columns, of rows or frequencies along the rows.
type Sums = [[f32; TILE]; LINES];

/// Rows of amplitudes of a frequency k along the rows, and those of −k.
#[derive(Default)]
struct Lines {
    plus: Spectrum,
    minus: Spectrum,
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
        // A row of amplitudes: real parts of all frequencies, then the imaginary ones.
        let width = 2 * self.cols.blocks();
        let mut lines = vec![[0.0_f32; TILE]; self.shape.rows * width];
        workers.map_blocks(&mut lines, LINES * width, |index, lines| {
            along_cols(self, image, mean, index * LINES, lines);
        });
        let folded = workers.map(width, |tile| self.folded(&lines, tile));
        let found = workers.map(self.rows.blocks(), |block| along_rows(self, &folded, block));
        let found: Vec<_> = found.into_iter().flatten().take(self.rows.count).collect();
        let mut spectrum = Spectrum::default();
        let negative = found[1..].iter().rev().map(|lines| &lines.minus);
        for each in negative.chain(found.iter().map(|lines| &lines.plus)) {
            spectrum.re.extend_from_slice(&each.re[..self.cols.count]);
            spectrum.im.extend_from_slice(&each.im[..self.cols.count]);
        }
        spectrum
    }

    /// Transforms some rows: Σ v exp(−iθ) over the columns.
    #[inline(always)]
    fn along_cols(&self, image: &[f32], mean: f32, first: usize, lines: &mut [[f32; TILE]]) {
        let (axis, cols) = (&self.cols, self.shape.cols);
        let (mut even, mut odd) =
            (vec![[0.0_f32; LINES]; axis.half()], vec![[0.0_f32; LINES]; axis.half()]);
        for row in 0..lines.len() / (2 * axis.blocks()) {
            let values = &image[(first + row) * cols..(first + row + 1) * cols];
            let weight = self.rows.window[first + row];
            for place in 0..axis.half() {
                let one = weight * axis.window[place] * (values[place] - mean);
                let other = axis
                    .opposite(place)
                    .map_or(0.0, |other| weight * axis.window[other] * (values[other] - mean));
                even[place][row] = one + other;
                odd[place][row] = one - other;
            }
        }
        for tile in 0..axis.blocks() {
            let [cos, sin] = axis.block(tile);
            let (re, im) = (sums(&even, cos), sums(&odd, sin));
            for (row, line) in lines.chunks_mut(2 * axis.blocks()).enumerate() {
                line[tile] = re[row];
                line[axis.blocks() + tile] = im[row].map(|value| -value);
            }
        }
    }

    /// Sums and differences of opposite rows, for frequencies of one tile.
    fn folded(&self, lines: &[[f32; TILE]], tile: usize) -> [Vec<[f32; TILE]>; 2] {
        let (axis, width) = (&self.rows, 2 * self.cols.blocks());
        let row = |place: usize| &lines[place * width + tile];
        let pairs = (0..axis.half()).map(|place| {
            let one = row(place);
            let other = axis.opposite(place).map_or(&[0.0; TILE], row);
            let both = |of: fn(f32, f32) -> f32| std::array::from_fn(|i| of(one[i], other[i]));
            (both(|one, other| one + other), both(|one, other| one - other))
        });
        let (even, odd) = pairs.unzip();
        [even, odd]
    }

    /// Amplitudes at some frequencies k and −k along the rows: even ∓ i odd.
    #[inline(always)]
    fn along_rows(&self, folded: &[[Vec<[f32; TILE]>; 2]], block: usize) -> [Lines; LINES] {
        let [cos, sin] = self.rows.block(block);
        let (real, imaginary) = folded.split_at(self.cols.blocks());
        let mut found: [Lines; LINES] = std::array::from_fn(|_| Lines::default());
        for ([even, odd], [even_im, odd_im]) in real.iter().zip(imaginary) {
            let [re, im] = [sums(cos, even), sums(cos, even_im)];
            let [turned_re, turned_im] = [sums(sin, odd_im), sums(sin, odd)];
            for (k, Lines { plus, minus }) in found.iter_mut().enumerate() {
                for i in 0..TILE {
                    plus.re.push(re[k][i] + turned_re[k][i]);
                    plus.im.push(im[k][i] - turned_im[k][i]);
                    minus.re.push(re[k][i] - turned_re[k][i]);
                    minus.im.push(im[k][i] + turned_im[k][i]);
                }
            }
        }
        found
    }
}

/// Σ part · factor over places, of each part and each factor.
#[inline(always)]
fn sums(parts: &[[f32; LINES]], factors: &[[f32; TILE]]) -> Sums {
    let mut sums = [[0.0; TILE]; LINES];
    for (parts, factors) in parts.iter().zip(factors) {
        for line in 0..LINES {
            for i in 0..TILE {
                sums[line][i] += parts[line] * factors[i];
            }
        }
    }
    sums
}

wide! {
/// [`Transform::along_cols`].
fn along_cols<'s>(
    by: &'s Transform, image: &'s [f32], mean: f32, first: usize, lines: &'s mut [[f32; TILE]],
) -> () {
    by.along_cols(image, mean, first, lines);
}
}

wide! {
/// [`Transform::along_rows`].
fn along_rows<'s>(
    by: &'s Transform, folded: &'s [[Vec<[f32; TILE]>; 2]], block: usize,
) -> [Lines; LINES] {
    by.along_rows(folded, block)
}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn amplitudes_are_the_direct_sums() {
        // Frequencies that fill a part of a tile, and several with a rest; sizes odd and even.
        check(Shape::new(31, 48), 0.1, [7, 5]);
        check(Shape::new(44, 73), 0.4, [35, 30]);
    }

    fn check(shape: Shape, cutoff: f64, sizes: [usize; 2]) {
        let image: Vec<f32> = (0..shape.len()).map(|i| ((i * 7919) % 1009) as f32 / 1e3).collect();
        let transform = Transform::new(shape, cutoff);
        let workers = Workers::new(std::num::NonZeroUsize::new(2)).unwrap();
        let mean = 0.5_f32;
        let spectrum = transform.of(&image, mean, &workers);
        assert_eq!(transform.sizes(), sizes);
        let window = |i: usize, size: usize| (PI * (i as f64 + 0.5) / size as f64).sin().powi(2);
        let centre = |size: usize| (size as f64 - 1.0) / 2.0;
        for entry in 0..sizes[0] * sizes[1] {
            let [u, v] = transform.frequency(entry);
            let mut wanted = [0.0; 2];
            for (i, value) in image.iter().enumerate() {
                let (row, col) = (i / shape.cols, i % shape.cols);
                let value =
                    window(row, shape.rows) * window(col, shape.cols) * f64::from(value - mean);
                let angle =
                    u * (row as f64 - centre(shape.rows)) + v * (col as f64 - centre(shape.cols));
                wanted[0] += value * angle.cos();
                wanted[1] -= value * angle.sin();
            }
            // Rounding of as many additions as rows and columns, that reach some 100.
            let additions = (shape.rows + shape.cols) as f64;
            let allowed = 100.0 * additions * f64::from(f32::EPSILON);
            assert!((f64::from(spectrum.re[entry]) - wanted[0]).abs() < allowed, "{entry}");
            assert!((f64::from(spectrum.im[entry]) - wanted[1]).abs() < allowed, "{entry}");
        }
    }
}

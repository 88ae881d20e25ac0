//! Images moved by a fraction of a pixel, S, and the transposed move Sᵀ.

use super::bands::{fold, mirrored, wide};
use super::coefficients::{sum, sum_of_squares};
use super::spline::{REACH, cardinal, prefilter, scale_edges};
use crate::frames::Shape;
use crate::geometry::Taps;
use crate::parallel::Workers;

/// Rows of a band.
const BAND: usize = 64;

/// A move of an image by a shift d: the value at pixel p is that of the spline at p + d.
#[derive(Clone, Debug)]
pub(super) struct Move {
    whole: [isize; 2],
    taps: [[f32; 4]; 2],
    /// Pixels p along each axis for which p + d is inside.
    pub(super) inside: [std::ops::Range<usize>; 2],
}

impl Move {
    pub(super) fn new(shape: Shape, shift: [f64; 2]) -> Self {
        let whole = shift.map(|shift| shift.floor() as isize);
        let taps = shift.map(|shift| Taps::at(shift - shift.floor()).values.map(|tap| tap as f32));
        let sizes = [shape.rows, shape.cols];
        let inside = std::array::from_fn(|axis| {
            let size = sizes[axis] as f64;
            let first = (-shift[axis]).ceil().clamp(0.0, size);
            let last = (size - 1.0 - shift[axis]).floor().clamp(-1.0, size - 1.0);
            first as usize..((last + 1.0) as usize).max(first as usize)
        });
        Self { whole, taps, inside }
    }

    /// Writes the moved values of a row, for the columns inside.
    #[inline(always)]
    pub(super) fn row(
        &self,
        shape: Shape,
        coefficients: &[f32],
        row: usize,
        padded: &mut [f32],
        values: &mut [f32],
    ) {
        let cols = shape.cols;
        let lines: [&[f32]; 4] = std::array::from_fn(|tap| {
            let line = mirrored(row as isize + self.whole[0] + tap as isize - 1, shape.rows);
            &coefficients[line * cols..][..cols]
        });
        let ([first, _], [a, b, c, d]) = (&self.taps, lines);
        for (col, value) in padded[1..][..cols].iter_mut().enumerate() {
            *value = first[0] * a[col] + first[1] * b[col] + first[2] * c[col] + first[3] * d[col];
        }
        padded[0] = padded[1 + mirrored(-1, cols)];
        padded[cols + 1] = padded[1 + mirrored(cols as isize, cols)];
        padded[cols + 2] = padded[1 + mirrored(cols as isize + 1, cols)];
        let inside = self.inside[1].clone();
        // The first tap of column p is at p + whole − 1, which `padded` holds one place later.
        let start = inside.start.saturating_add_signed(self.whole[1]);
        let taps = self.taps[1];
        let values = &mut values[inside];
        let count = values.len();
        let [a, b, c, d] = std::array::from_fn(|tap| &padded[start + tap..start + tap + count]);
        for (i, value) in values.iter_mut().enumerate() {
            *value = taps[0] * a[i] + taps[1] * b[i] + taps[2] * c[i] + taps[3] * d[i];
        }
    }

    /// The diagonals of Sᵀ S along both axes: Σ S(q, p)² over the q inside.
    pub(super) fn diagonals(&self, shape: Shape) -> [Vec<f32>; 2] {
        let sizes = [shape.rows, shape.cols];
        std::array::from_fn(|axis| {
            let (mut sums, mut row) = (vec![0.0; sizes[axis]], vec![0.0_f32; sizes[axis]]);
            let steps = -(REACH as isize)..=REACH as isize;
            let weights: Vec<_> =
                steps.clone().map(|step| cardinal(self.taps[axis], step)).collect();
            for place in self.inside[axis].clone() {
                let first = place as isize + self.whole[axis];
                let pixels = || steps.clone().map(|step| mirrored(first + step, sizes[axis]));
                pixels().zip(&weights).for_each(|(pixel, weight)| row[pixel] += weight);
                for pixel in pixels() {
                    let value = std::mem::take(&mut row[pixel]);
                    sums[pixel] += value * value;
                }
            }
            sums
        })
    }

    /// Calls `found` for the pixels p for which p + d is within two pixels of a pixel.
    pub(super) fn near(&self, shape: Shape, pixel: usize, mut found: impl FnMut(usize)) {
        let place = [pixel / shape.cols, pixel % shape.cols];
        let ends = |axis: usize, size: usize| {
            let centre = place[axis] as isize - self.whole[axis];
            let clamp = |end: isize| end.clamp(0, size as isize) as usize;
            clamp(centre - 2)..clamp(centre + 3)
        };
        for row in ends(0, shape.rows) {
            ends(1, shape.cols).for_each(|col| found(row * shape.cols + col));
        }
    }

    /// Adds the rows of an image, times their taps, that a row of coefficients contributes to.
    #[inline(always)]
    fn gather(&self, shape: Shape, image: &[f32], row: usize, line: &mut [f32]) {
        let cols = self.inside[1].clone();
        let last = shape.rows as isize;
        let beyond = [-1, last, last + 1].into_iter().filter(|p| mirrored(*p, shape.rows) == row);
        for place in beyond.chain([row as isize]) {
            for (tap, weight) in self.taps[0].iter().enumerate() {
                let from = place - self.whole[0] - tap as isize + 1;
                let Ok(from) = usize::try_from(from) else { continue };
                if self.inside[0].contains(&from) {
                    let values = &image[from * shape.cols..][cols.clone()];
                    for (sum, value) in line[cols.clone()].iter_mut().zip(values) {
                        *sum += weight * value;
                    }
                }
            }
        }
    }

    /// Writes a row of coefficients, of the sums that `gather` gave: the transpose of `row` along it.
    #[inline(always)]
    fn spread(&self, line: &[f32], padded: &mut [f32], coefficients: &mut [f32]) {
        let (cols, inside) = (line.len(), self.inside[1].clone());
        let start = inside.start.saturating_add_signed(self.whole[1]);
        padded.fill(0.0);
        for (tap, weight) in self.taps[1].iter().enumerate() {
            for (sum, value) in padded[start + tap..].iter_mut().zip(&line[inside.clone()]) {
                *sum += weight * value;
            }
        }
        coefficients.copy_from_slice(&padded[1..=cols]);
        for place in [-1, cols as isize, cols as isize + 1] {
            coefficients[mirrored(place, cols)] += padded[place.wrapping_add(1) as usize];
        }
    }
}

wide! {
/// [`Move::row`].
fn moved_row<'s>(
    way: &'s Move, shape: Shape, from: (&'s [f32], usize), padded: &'s mut [f32], values: &'s mut [f32],
) -> () {
    way.row(shape, from.0, from.1, padded, values);
}
}

wide! {
/// Writes a row of coefficients that an image is scattered to.
fn scatter<'s>(
    way: &'s Move, shape: Shape, image: (&'s [f32], usize), line: &'s mut [f32], padded: &'s mut [f32],
    values: &'s mut [f32],
) -> () {
    way.gather(shape, image.0, image.1, line);
    way.spread(line, padded, values);
}
}

/// Writes Sᵀ of an image that is 0 where the move is not inside: taps are scattered to coefficients, then the
/// transposed filter is applied. `scratch` is two images.
pub(super) fn transposed(
    shape: Shape,
    image: &[f32],
    way: &Move,
    [scattered, along]: [&mut Vec<f32>; 2],
    result: &mut [f32],
    workers: &Workers,
) {
    let cols = shape.cols;
    workers.map_blocks(scattered, BAND * cols, |index, band| {
        let (mut line, mut padded) = (vec![0.0; cols], vec![0.0; cols + 3]);
        for (row, values) in band.chunks_mut(cols).enumerate() {
            line.fill(0.0);
            scatter(way, shape, (image, index * BAND + row), &mut line, &mut padded, values);
        }
    });
    scale_edges(shape, scattered, 2.0);
    prefilter(shape, scattered, along, result, workers);
    scale_edges(shape, result, 0.5);
}

/// The later frame of a pair, and the pixels that are left out.
#[derive(Clone, Copy, Debug)]
pub(super) struct Own<'a> {
    pub(super) values: &'a [f32],
    pub(super) left_out: Option<&'a [bool]>,
}

impl Own<'_> {
    /// Writes 0 for the pixels that are left out, of some from `start` on, and counts them.
    pub(super) fn clear(&self, start: usize, values: &mut [f32]) -> usize {
        let Some(left_out) = self.left_out else { return 0 };
        let mut count = 0;
        for (value, _) in values.iter_mut().zip(&left_out[start..]).filter(|(_, out)| **out) {
            *value = 0.0;
            count += 1;
        }
        count
    }
}

/// Writes moved − own, less its mean, where the moved image is inside, and 0 elsewhere. The mean is a change
/// of the level between frames, which is no pattern. The mean square of what is written inside is given.
pub(super) fn difference(
    shape: Shape,
    coefficients: &[f32],
    own: Own<'_>,
    way: &Move,
    difference: &mut [f32],
    workers: &Workers,
) -> f64 {
    let cols = shape.cols;
    let [rows, columns] = &way.inside;
    let sums = workers.map_blocks(difference, BAND * cols, |index, band| {
        let (mut padded, mut total, mut count) = (vec![0.0; cols + 3], 0.0, 0);
        band.fill(0.0);
        for (row, values) in band.chunks_mut(cols).enumerate() {
            let row = index * BAND + row;
            if !rows.contains(&row) {
                continue;
            }
            moved_row(way, shape, (coefficients, row), &mut padded, values);
            let values = &mut values[columns.clone()];
            for (value, own) in values.iter_mut().zip(&own.values[row * cols..][columns.clone()]) {
                *value -= own;
            }
            count += values.len() - own.clear(row * cols + columns.start, values);
            total += sum(values);
        }
        [total, count as f64]
    });
    let [total, count] = fold(sums);
    let count = count.max(1.0);
    let mean = (total / count) as f32;
    let squares = workers.map_blocks(difference, BAND * cols, |index, band| {
        let mut squares = 0.0;
        for (row, values) in band.chunks_mut(cols).enumerate() {
            if rows.contains(&(index * BAND + row)) {
                let values = &mut values[columns.clone()];
                values.iter_mut().for_each(|value| *value -= mean);
                own.clear((index * BAND + row) * cols + columns.start, values);
                squares += sum_of_squares(values);
            }
        }
        [squares]
    });
    fold(squares)[0] / count
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(shape: Shape) -> Vec<f32> {
        let wave = |i: usize| (0.9 * i as f64).sin() + 0.3 * (2.1 * i as f64 + 1.0).cos();
        (0..shape.len())
            .map(|i| wave(i / shape.cols) as f32 * wave(i % shape.cols) as f32)
            .collect()
    }

    fn moved(shape: Shape, values: &[f32], shift: [f64; 2]) -> (Vec<f32>, Move) {
        let workers = Workers::new(std::num::NonZeroUsize::new(2)).unwrap();
        let (mut along, mut coefficients) = (vec![0.0; shape.len()], vec![0.0; shape.len()]);
        prefilter(shape, values, &mut along, &mut coefficients, &workers);
        let (way, mut result) = (Move::new(shape, shift), vec![f32::NAN; shape.len()]);
        let mut padded = vec![0.0; shape.cols + 3];
        for row in way.inside[0].clone() {
            let values = &mut result[row * shape.cols..(row + 1) * shape.cols];
            way.row(shape, &coefficients, row, &mut padded, values);
        }
        (result, way)
    }

    #[test]
    fn the_spline_goes_through_the_values_and_moves_them_by_whole_pixels() {
        // Narrower than a strip of columns, and two strips with a rest.
        for width in [37, 150] {
            let shape = Shape::new(75, width);
            let values = image(shape);
            for shift in [[0_isize, 0], [3, -2], [-5, 4]] {
                let (result, way) = moved(shape, &values, shift.map(|shift| shift as f64));
                let [rows, cols] = way.inside;
                assert_eq!(
                    rows.len() * cols.len(),
                    (75 - shift[0].unsigned_abs()) * (width - shift[1].unsigned_abs())
                );
                for row in rows {
                    for col in cols.clone() {
                        let from = row.strict_add_signed(shift[0]) * width
                            + col.strict_add_signed(shift[1]);
                        // Filters of gain (6/(4 − 2))² = 9 at most, of some ten additions, values below 2.
                        let error = result[row * width + col] - values[from];
                        assert!(error.abs() < 200.0 * f32::EPSILON, "{error}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_parabola_about_a_mirror_is_moved_by_a_fraction() {
        // Away from the edges a cubic spline reproduces polynomials up to the third degree; 14 pixels
        // from an edge what the reflection there does has fallen to 1e-8.
        let shape = Shape::new(48, 40);
        let at = |row: f64, col: f64| 0.01 * row + 1e-3 * row * col - 4e-4 * col * col;
        let values: Vec<f32> =
            (0..shape.len()).map(|i| at((i / 40) as f64, (i % 40) as f64) as f32).collect();
        let (result, _) = moved(shape, &values, [0.3, -1.6]);
        for row in 16..32 {
            for col in 18..24 {
                let wanted = at(row as f64 + 0.3, col as f64 - 1.6);
                // The slopes at the edges, up to 0.05 a pixel, and rounding of values below 3.
                assert!((f64::from(result[row * 40 + col]) - wanted).abs() < 3e-6);
            }
        }
    }

    #[test]
    fn the_diagonals_are_the_squares_that_an_impulse_leaves() {
        let shape = Shape::new(21, 24);
        for shift in [[0.0, 1.0], [0.5, -0.5], [-1.3, 2.8]] {
            let [down, across] = Move::new(shape, shift).diagonals(shape);
            for pixel in [0, 5, 24 * 10 + 12, 24 * 19 + 1, 24 * 20 + 23] {
                let mut impulse = vec![0.0; shape.len()];
                impulse[pixel] = 1.0;
                let (result, way) = moved(shape, &impulse, shift);
                let rows = way.inside[0]
                    .clone()
                    .flat_map(|row| way.inside[1].clone().map(move |col| row * shape.cols + col));
                let squares: f64 = rows.map(|i| f64::from(result[i]).powi(2)).sum();
                let found = f64::from(down[pixel / 24] * across[pixel % 24]);
                // Filters of gain 9 at most, of some ten additions, and z¹⁴ = 1e-8 that is left out.
                assert!((found - squares).abs() < 200.0 * f64::from(f32::EPSILON), "{shift:?}");
            }
        }
    }

    #[test]
    fn the_transposed_move_is_the_adjoint() {
        let shape = Shape::new(37, 29);
        let workers = Workers::new(std::num::NonZeroUsize::new(2)).unwrap();
        let x = image(shape);
        let y: Vec<f32> =
            (0..shape.len()).map(|i| ((i * 7919) % 1009) as f32 / 505.0 - 1.0).collect();
        for shift in [[0.0, 0.0], [0.5, 0.5], [-1.3, 2.8], [3.0, -0.2], [-7.75, -6.01]] {
            let (sx, way) = moved(shape, &x, shift);
            let inside = |i: usize| {
                way.inside[0].contains(&(i / shape.cols))
                    && way.inside[1].contains(&(i % shape.cols))
            };
            let masked: Vec<f32> =
                y.iter().enumerate().map(|(i, y)| if inside(i) { *y } else { 0.0 }).collect();
            let mut images = [vec![0.0; shape.len()], vec![0.0; shape.len()]];
            let (mut sty, [first, second]) = (vec![0.0; shape.len()], &mut images);
            transposed(shape, &masked, &way, [first, second], &mut sty, &workers);
            let product = |a: &[f32], b: &[f32]| -> f64 {
                a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
            };
            let sx: Vec<f32> =
                (0..shape.len()).map(|i| if inside(i) { sx[i] } else { 0.0 }).collect();
            let (one, other) = (product(&sx, &masked), product(&x, &sty));
            // Each of the 1073 products of values below 2 has the rounding of the filters, 200 ε as above,
            // of random sign.
            let allowed = 200.0 * f64::from(f32::EPSILON) * (4.0 * 1073.0_f64).sqrt();
            assert!((one - other).abs() < allowed, "{shift:?}: {one} {other}");
            assert!(one.abs() > 100.0 * allowed, "{shift:?}: {one}");
        }
    }
}

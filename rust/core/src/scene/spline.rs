//! Images moved by a fraction of a pixel: the interpolating cubic B-spline.
//!
//! Coefficients follow from values by a recursion in both directions with the pole z = √3 − 2
//! (M. Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Processing Magazine 16
//! (1999) 22–38). A band of rows starts it 14 rows earlier: z¹⁴ = 1e-8 is below the rounding of single
//! precision, so bands do not depend on each other.

use super::bands::{fold, mirrored};
use super::coefficients::sum;
use crate::frames::Shape;
use crate::geometry::Taps;
use crate::parallel::Workers;

/// √3 − 2.
const POLE: f32 = -0.267_949_19;

/// Steps after which the start of the recursion is forgotten.
const REACH: usize = 14;

/// Rows that are filtered side by side along the columns.
const LANES: usize = 8;

/// Rows of a band that is filtered along the rows.
const BAND: usize = 64;

/// Coefficients of the spline through the values of an image; `along` is of its size.
pub(super) fn prefilter(
    shape: Shape,
    values: &[f32],
    along: &mut [f32],
    coefficients: &mut [f32],
    workers: &Workers,
) {
    let cols = shape.cols;
    workers.map_blocks(along, LANES * cols, |index, lines| {
        let start = index * LANES * cols;
        pulp::Arch::new()
            .dispatch(|| filter_lines(&values[start..start + lines.len()], lines, cols));
    });
    let along = &*along;
    workers.map_blocks(coefficients, BAND * cols, |index, band| {
        pulp::Arch::new().dispatch(|| filter_band(shape, along, index * BAND, band));
    });
}

/// Filters up to eight rows along the columns.
#[inline(always)]
fn filter_lines(values: &[f32], lines: &mut [f32], cols: usize) {
    let mut wide = vec![[0.0_f32; LANES]; cols + 2 * REACH];
    for (lane, line) in values.chunks(cols).enumerate() {
        for (i, wide) in wide.iter_mut().enumerate() {
            wide[lane] = line[mirrored(i as isize - REACH as isize, cols)];
        }
    }
    let mut last = [0.0_f32; LANES];
    for value in &mut wide {
        for lane in 0..LANES {
            last[lane] = value[lane] + POLE * last[lane];
        }
        *value = last;
    }
    last = [0.0; LANES];
    for value in wide.iter_mut().rev() {
        for lane in 0..LANES {
            last[lane] = POLE * (last[lane] - value[lane]);
        }
        *value = last;
    }
    for (lane, line) in lines.chunks_mut(cols).enumerate() {
        for (value, wide) in line.iter_mut().zip(&wide[REACH..]) {
            *value = 6.0 * wide[lane];
        }
    }
}

/// Filters the columns of a band of rows.
#[inline(always)]
fn filter_band(shape: Shape, along: &[f32], first: usize, band: &mut [f32]) {
    let cols = shape.cols;
    let rows = band.len() / cols + 2 * REACH;
    let mut wide = vec![0.0_f32; rows * cols];
    let mut last = vec![0.0_f32; cols];
    for (i, line) in wide.chunks_mut(cols).enumerate() {
        let row = mirrored((first + i) as isize - REACH as isize, shape.rows);
        let values = &along[row * cols..(row + 1) * cols];
        for ((last, value), line) in last.iter_mut().zip(values).zip(line) {
            *last = value + POLE * *last;
            *line = *last;
        }
    }
    last.fill(0.0);
    for (i, line) in wide.chunks(cols).enumerate().rev() {
        for (last, value) in last.iter_mut().zip(line) {
            *last = POLE * (*last - value);
        }
        if i >= REACH && i < rows - REACH {
            let start = (i - REACH) * cols;
            for (value, last) in band[start..start + cols].iter_mut().zip(&last) {
                *value = 6.0 * last;
            }
        }
    }
}

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
            &coefficients[line * cols..(line + 1) * cols]
        });
        let [first, _] = &self.taps;
        for (col, value) in padded[1..=cols].iter_mut().enumerate() {
            *value = first[0] * lines[0][col]
                + first[1] * lines[1][col]
                + first[2] * lines[2][col]
                + first[3] * lines[3][col];
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
}

/// Writes moved − own where the moved image is inside, and gives the mean of this difference: a change of
/// the mean level between frames, which is no pattern.
pub(super) fn difference(
    shape: Shape,
    coefficients: &[f32],
    own: &[f32],
    way: &Move,
    difference: &mut [f32],
    workers: &Workers,
) -> f32 {
    let cols = shape.cols;
    let [rows, columns] = &way.inside;
    let sums = workers.map_blocks(difference, BAND * cols, |index, band| {
        let (mut padded, mut total) = (vec![0.0; cols + 3], 0.0);
        for (row, values) in band.chunks_mut(cols).enumerate() {
            let row = index * BAND + row;
            if !rows.contains(&row) {
                continue;
            }
            pulp::Arch::new().dispatch(|| way.row(shape, coefficients, row, &mut padded, values));
            let values = &mut values[columns.clone()];
            for (value, own) in values.iter_mut().zip(&own[row * cols..][columns.clone()]) {
                *value -= own;
            }
            total += sum(values);
        }
        [total]
    });
    let [total] = fold(sums);
    (total / (rows.len() * columns.len()).max(1) as f64) as f32
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
        difference(shape, &coefficients, &vec![0.0; shape.len()], &way, &mut result, &workers);
        (result, way)
    }

    #[test]
    fn the_spline_goes_through_the_values_and_moves_them_by_whole_pixels() {
        let shape = Shape::new(75, 37);
        let values = image(shape);
        for shift in [[0_isize, 0], [3, -2], [-5, 4]] {
            let (result, way) = moved(shape, &values, shift.map(|shift| shift as f64));
            let [rows, cols] = way.inside;
            assert_eq!(
                rows.len() * cols.len(),
                (75 - shift[0].unsigned_abs()) * (37 - shift[1].unsigned_abs())
            );
            for row in rows {
                for col in cols.clone() {
                    let from =
                        row.strict_add_signed(shift[0]) * 37 + col.strict_add_signed(shift[1]);
                    // Filters of gain (6/(4 − 2))² = 9 at most, of some ten additions, values below 2.
                    let error = result[row * 37 + col] - values[from];
                    assert!(error.abs() < 200.0 * f32::EPSILON, "{error}");
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
}

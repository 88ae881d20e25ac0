//! Coefficients of the interpolating cubic B-spline.
//!
//! Coefficients follow from values by a recursion in both directions with the pole z = √3 − 2
//! (M. Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Processing Magazine 16
//! (1999) 22–38). A band of rows starts it 14 rows earlier: z¹⁴ = 1e-8 is below the rounding of single
//! precision, so bands do not depend on each other.

use super::bands::{mirrored, wide};
use crate::frames::Shape;
use crate::parallel::Workers;

/// √3 − 2.
const POLE: f32 = -0.267_949_2;

/// Steps after which the start of the recursion is forgotten.
pub(super) const REACH: usize = 14;

/// Rows that are filtered side by side along the columns.
const LANES: usize = 16;

/// Columns that are filtered side by side along the rows: with those of a band they stay in the first cache.
const STRIP: usize = 64;

/// Rows of a band that is filtered along the rows.
const BAND: usize = 64;

/// Weight of the pixel `step` behind the first of four taps in the value that they give: the coefficients of an
/// impulse are √3 z^|i|.
pub(super) fn cardinal(taps: [f32; 4], step: isize) -> f32 {
    let coefficient = |tap: usize| POLE.powi((tap as isize - 1 - step).unsigned_abs() as i32);
    let sum: f32 = taps.iter().enumerate().map(|(tap, weight)| weight * coefficient(tap)).sum();
    3.0_f32.sqrt() * sum
}

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
        filter_lines(&values[start..start + lines.len()], lines, cols);
    });
    let along = &*along;
    workers.map_blocks(coefficients, BAND * cols, |index, band| {
        filter_band(shape, along, index * BAND, band);
    });
}

wide! {
/// Filters up to `LANES` rows along the columns.
fn filter_lines<'s>(values: &'s [f32], lines: &'s mut [f32], cols: usize) -> () {
    let mut wide = vec![[0.0_f32; LANES]; cols + 2 * REACH];
    let (before, rest) = wide.split_at_mut(REACH);
    let (inside, after) = rest.split_at_mut(cols);
    for (lane, line) in values.chunks(cols).enumerate() {
        for i in 0..REACH {
            before[i][lane] = line[mirrored(i as isize - REACH as isize, cols)];
            after[i][lane] = line[mirrored((cols + i) as isize, cols)];
        }
    }
    for (index, block) in inside.chunks_mut(LANES).enumerate() {
        for (lane, line) in values.chunks(cols).enumerate() {
            for (wide, value) in block.iter_mut().zip(&line[index * LANES..]) {
                wide[lane] = *value;
            }
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
    for (index, block) in wide[REACH..REACH + cols].chunks(LANES).enumerate() {
        for (lane, line) in lines.chunks_mut(cols).enumerate() {
            for (value, wide) in line[index * LANES..].iter_mut().zip(block) {
                *value = 6.0 * wide[lane];
            }
        }
    }
}
}

wide! {
/// Filters the columns of a band of rows.
fn filter_band<'s>(shape: Shape, along: &'s [f32], first: usize, band: &'s mut [f32]) -> () {
    let mut wide = vec![[0.0_f32; STRIP]; band.len() / shape.cols + 2 * REACH];
    for start in (0..shape.cols).step_by(STRIP) {
        // Of a constant width, so that a row of the strip is some registers.
        if start + STRIP <= shape.cols {
            filter_strip(shape, along, first, band, &mut wide, (start, STRIP));
        } else {
            filter_strip(shape, along, first, band, &mut wide, (start, shape.cols - start));
        }
    }
}
}

/// Filters the columns from `start` on of a band of rows.
#[inline(always)]
fn filter_strip(
    shape: Shape,
    along: &[f32],
    first: usize,
    band: &mut [f32],
    wide: &mut [[f32; STRIP]],
    (start, width): (usize, usize),
) {
    let (cols, rows) = (shape.cols, wide.len());
    let mut last = [0.0_f32; STRIP];
    for (i, line) in wide.iter_mut().enumerate() {
        let row = mirrored((first + i) as isize - REACH as isize, shape.rows);
        let values = &along[row * cols + start..][..width];
        for (last, value) in last.iter_mut().zip(values) {
            *last = value + POLE * *last;
        }
        *line = last;
    }
    last = [0.0; STRIP];
    for (i, line) in wide.iter().enumerate().rev() {
        for (last, value) in last.iter_mut().zip(line) {
            *last = POLE * (*last - value);
        }
        if i >= REACH && i < rows - REACH {
            let values = &mut band[(i - REACH) * cols + start..][..width];
            for (value, last) in values.iter_mut().zip(&last) {
                *value = 6.0 * last;
            }
        }
    }
}

/// Multiplies the first and the last row by a factor, then the first and the last column.
///
/// With the half of them as weights W the filter C is symmetric, W C = Cᵀ W: so Cᵀ = W C W⁻¹.
pub(super) fn scale_edges(shape: Shape, values: &mut [f32], factor: f32) {
    let last = (shape.rows - 1) * shape.cols;
    let (first, rest) = values.split_at_mut(shape.cols);
    let line = &mut rest[last - shape.cols..];
    first.iter_mut().chain(line).for_each(|value| *value *= factor);
    for row in values.chunks_mut(shape.cols) {
        row[0] *= factor;
        row[shape.cols - 1] *= factor;
    }
}

//! Saturated pixels, which do not learn.

use super::bands::{BAND, wide};
use super::neighbourhood::Squares;
use crate::frames::Shape;
use crate::parallel::Workers;

/// Share of saturated pixels in a neighbourhood above which its mean is not used. One pixel that is always
/// saturated is less than this in 3×3, and leaves its neighbours to learn.
const MOST: f32 = 0.125;

wide! {
/// Whether a value is at a level or above it: without a branch for each value.
pub(super) fn any_at<'s>(values: &'s [f32], level: f32) -> bool {
    const AT_ONCE: usize = 1024;
    values.chunks(AT_ONCE).any(|part| part.iter().fold(false, |found, y| found | (*y >= level)))
}
}

/// The pixels that are saturated, if `own`, or have too many such pixels in their neighbourhood; none if no pixel is.
pub(super) fn left_out(
    shape: Shape,
    raw: &[f32],
    saturation: f32,
    (width, own): (usize, bool),
    workers: &Workers,
) -> Option<Vec<bool>> {
    if !saturation.is_finite() || !any_at(raw, saturation) {
        return None;
    }
    let (cols, mut found) = (shape.cols, vec![false; shape.len()]);
    let marked = |row: usize, line: &mut [f32]| {
        for (mark, y) in line.iter_mut().zip(&raw[row * cols..(row + 1) * cols]) {
            *mark = if *y >= saturation { 1.0 } else { 0.0 };
        }
    };
    workers.map_blocks(&mut found, BAND * cols, |index, found| {
        let mut shares = Squares::new(shape, width, index * BAND, marked);
        let mut share = vec![0.0; cols];
        for (row, found) in found.chunks_mut(cols).enumerate() {
            shares.next(&mut share);
            let values = &raw[(index * BAND + row) * cols..];
            for ((found, share), y) in found.iter_mut().zip(&share).zip(values) {
                *found = (own && *y >= saturation) || *share > MOST;
            }
        }
    });
    Some(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn saturated_pixels_and_crowded_neighbourhoods_are_left_out() {
        let shape = Shape::new(40, 30);
        let workers = Workers::new(std::num::NonZeroUsize::new(2)).unwrap();
        let mut raw = vec![0.5; shape.len()];
        assert_eq!(left_out(shape, &raw, 1.0, (3, true), &workers), None);
        raw[5 * 30 + 7] = 1.0;
        raw[20 * 30 + 8] = 1.2;
        raw[20 * 30 + 10] = 1.0;
        let found = left_out(shape, &raw, 1.0, (3, true), &workers).unwrap();
        let pixels: Vec<_> =
            (0..shape.len()).filter(|i| found[*i]).map(|i| (i / 30, i % 30)).collect();
        assert_eq!(pixels, [(5, 7), (19, 9), (20, 8), (20, 9), (20, 10), (21, 9)]);
        let found = left_out(shape, &raw, 1.0, (3, false), &workers).unwrap();
        let pixels: Vec<_> =
            (0..shape.len()).filter(|i| found[*i]).map(|i| (i / 30, i % 30)).collect();
        assert_eq!(pixels, [(19, 9), (20, 9), (21, 9)]);
        assert_eq!(left_out(shape, &raw, f32::INFINITY, (3, true), &workers), None);
    }
}

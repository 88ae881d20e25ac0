//! Pixels that are masked: they do not learn, and hold the mean of their neighbours.

use crate::frames::Shape;

/// Masked pixels, each with the good ones of the smallest square around it that has any.
#[derive(Debug, Default)]
pub(super) struct Fill(Vec<(usize, Vec<usize>)>);

impl Fill {
    pub(super) fn new(shape: Shape, masked: &[bool]) -> Self {
        let pixels = (0..shape.len()).filter(|pixel| masked[*pixel]);
        Self(pixels.map(|pixel| (pixel, around(shape, masked, pixel))).collect())
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Writes the means of the neighbours.
    pub(super) fn write(&self, values: &mut [f32]) {
        for (pixel, from) in &self.0 {
            values[*pixel] = from.iter().map(|i| values[*i]).sum::<f32>() / from.len() as f32;
        }
    }

    /// Marks the masked pixels among those that are left out.
    pub(super) fn mark(&self, left_out: Option<Vec<bool>>, count: usize) -> Option<Vec<bool>> {
        if self.is_empty() {
            return left_out;
        }
        let mut marked = left_out.unwrap_or_else(|| vec![false; count]);
        self.0.iter().for_each(|(pixel, _)| marked[*pixel] = true);
        Some(marked)
    }
}

/// Good pixels of the smallest square around a pixel that has any.
fn around(shape: Shape, masked: &[bool], pixel: usize) -> Vec<usize> {
    let (row, col) = (pixel / shape.cols, pixel % shape.cols);
    let span = |place: usize, reach: usize, size: usize| {
        place.saturating_sub(reach)..(place + reach + 1).min(size)
    };
    let square = |reach: usize| -> Vec<usize> {
        let rows = span(row, reach, shape.rows);
        let pixels = rows.flat_map(|r| span(col, reach, shape.cols).map(move |c| (r, c)));
        pixels.map(|(r, c)| r * shape.cols + c).filter(|i| !masked[*i]).collect()
    };
    let found = (1..shape.rows.max(shape.cols)).map(square).find(|found| !found.is_empty());
    found.unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masked_pixels_take_the_mean_of_the_nearest_good_ones() {
        let shape = Shape::new(5, 5);
        let masked: Vec<_> = (0..25).map(|i| (10..15).contains(&i) || i == 6).collect();
        let mut values: Vec<f32> = (0..25).map(|i| i as f32).collect();
        values[6] = 1e9;
        let fill = Fill::new(shape, &masked);
        fill.write(&mut values);
        assert_eq!(values[6], (0.0 + 1.0 + 2.0 + 5.0 + 7.0) / 5.0);
        assert_eq!(values[14], (8.0 + 9.0 + 18.0 + 19.0) / 4.0);
        assert_eq!(fill.mark(None, 25).unwrap(), masked);
        assert!(Fill::new(shape, &[true; 25]).0[0].1.is_empty());
    }
}

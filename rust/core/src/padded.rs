//! How the images of the linear problem lie in memory: rows of one width, with zeros behind each
//! and before and after all of them.
//!
//! A row may then be read from any column that an exposure's place asks for, and what lies outside
//! the image is 0: the kernels know no borders.

use crate::control::Control;
use crate::geometry::Geometry;
use crate::parallel::Workers;

/// Rows that a thread works on at a time.
pub(crate) const BAND: usize = 8;
/// Neighbouring values that are worked on side by side: several registers full, so that what is done
/// once a line and chunk does not count.
pub(crate) const LANES: usize = 32;

/// Chunk number `index` of some values.
#[inline(always)]
pub(crate) fn chunk(values: &[f32], index: usize) -> &[f32; LANES] {
    &values.as_chunks().0[index]
}

/// The layout of all images of one problem.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Padding {
    /// Length of a row, a multiple of [`LANES`].
    pub(crate) width: usize,
    /// Zeros before the first row and after the last.
    pub(crate) lead: usize,
}

impl Padding {
    pub(crate) fn of(geometry: &Geometry) -> Self {
        let reach = geometry.placements.iter().map(|place| place.col).max().unwrap_or(0);
        let widest = geometry.views.iter().map(|view| view.shape.cols).max().unwrap_or(0);
        let width = widest.max(geometry.sensor.cols + reach);
        Self { width: width.next_multiple_of(LANES), lead: reach.next_multiple_of(LANES) }
    }

    /// Values of an image of so many rows.
    pub(crate) const fn size(&self, rows: usize) -> usize {
        2 * self.lead + rows * self.width
    }

    /// An image of zeros, unless `control` asks to stop.
    pub(crate) fn zeros(&self, rows: usize, workers: &Workers, control: &Control) -> Vec<f32> {
        workers.filled(self.size(rows), 0.0, control)
    }

    /// All rows, without the zeros before and after.
    pub(crate) fn body_mut<'i>(&self, image: &'i mut [f32]) -> &'i mut [f32] {
        let end = image.len() - self.lead;
        &mut image[self.lead..end]
    }

    /// Writes `values`, rows of `cols`, to an image.
    pub(crate) fn copy(
        &self,
        values: &[f64],
        cols: usize,
        workers: &Workers,
        image: &mut [f32],
        converted: impl Fn(f64) -> f32 + Sync + Send,
    ) {
        workers.map_blocks(self.body_mut(image), BAND * self.width, |band, rows| {
            let values = values[band * BAND * cols..].chunks_exact(cols);
            for (row, values) in rows.chunks_exact_mut(self.width).zip(values) {
                for (padded, &value) in row.iter_mut().zip(values) {
                    *padded = converted(value);
                }
            }
        });
    }

    /// As [`body_mut`](Self::body_mut), to read.
    pub(crate) fn body<'i, V>(&self, image: &'i [V]) -> &'i [V] {
        &image[self.lead..image.len() - self.lead]
    }

    /// A row of `image`.
    pub(crate) fn row<'i>(&self, image: &'i [f32], row: usize) -> &'i [f32] {
        self.row_from(image, row, 0)
    }

    /// A row of `image`, `right` columns to the right.
    pub(crate) fn row_from<'i>(&self, image: &'i [f32], row: usize, right: usize) -> &'i [f32] {
        &image[self.lead + row * self.width + right..][..self.width]
    }

    /// A row of `image`, `left` columns to the left.
    pub(crate) fn row_before<'i>(&self, image: &'i [f32], row: usize, left: usize) -> &'i [f32] {
        &image[self.lead + row * self.width - left..][..self.width]
    }
}

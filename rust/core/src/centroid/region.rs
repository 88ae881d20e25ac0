//! Rectangles of pixels, which may reach beyond the image.

use crate::frames::Shape;

/// Rows `top..bottom` and columns `left..right`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Region {
    pub(super) top: i64,
    pub(super) bottom: i64,
    pub(super) left: i64,
    pub(super) right: i64,
}

impl Region {
    /// The whole of an image.
    pub(super) const fn of(shape: Shape) -> Self {
        Self { top: 0, bottom: shape.rows as i64, left: 0, right: shape.cols as i64 }
    }

    pub(super) const fn height(self) -> usize {
        (self.bottom - self.top) as usize
    }

    pub(super) const fn width(self) -> usize {
        (self.right - self.left) as usize
    }

    /// The point in the middle.
    pub(super) fn centre(self) -> [f64; 2] {
        [(self.top + self.bottom - 1) as f64 / 2.0, (self.left + self.right - 1) as f64 / 2.0]
    }

    /// With `margin` more pixels on every side.
    pub(super) const fn widened(self, margin: i64) -> Self {
        Self {
            top: self.top - margin,
            bottom: self.bottom + margin,
            left: self.left - margin,
            right: self.right + margin,
        }
    }

    /// The part that lies in `other`.
    pub(super) fn clipped(self, other: Self) -> Self {
        Self {
            top: self.top.max(other.top),
            bottom: self.bottom.min(other.bottom),
            left: self.left.max(other.left),
            right: self.right.min(other.right),
        }
    }

    /// The smallest region that holds this one and a pixel.
    pub(super) fn joined(self, row: i64, col: i64) -> Self {
        Self {
            top: self.top.min(row),
            bottom: self.bottom.max(row + 1),
            left: self.left.min(col),
            right: self.right.max(col + 1),
        }
    }

    pub(super) const fn contains(self, row: i64, col: i64) -> bool {
        self.top <= row && row < self.bottom && self.left <= col && col < self.right
    }

    /// The places of its pixels, row by row.
    pub(super) fn pixels(self) -> impl Iterator<Item = (i64, i64)> {
        (self.top..self.bottom).flat_map(move |row| (self.left..self.right).map(move |c| (row, c)))
    }

    /// The parts of the rows of `image` that it covers; it must lie in the image.
    pub(super) fn rows<T>(self, image: &[T], shape: Shape) -> impl Iterator<Item = &[T]> {
        (self.top as usize..self.bottom as usize)
            .map(move |row| &image[row * shape.cols + self.left as usize..][..self.width()])
    }
}

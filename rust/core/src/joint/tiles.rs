//! The cells of the rim in overlapping tiles of the grid, whose matrices are factorised one by one.
//!
//! An inverse of the rim's matrix decays within some cells, so that of a tile with what lies around is
//! that of the whole in the middle of the tile. With shares s_t of which Σ_t s_t² = 1 in every cell,
//!
//! ```text
//! A⁻¹ ≈ Σ_t s_t A_t⁻¹ s_t
//! ```
//!
//! is symmetric, and off by no more than shares change over the distance at which cells still count.
//! Tiles that end without an overlap leave patterns across their border to conjugate gradients.

use std::f64::consts::FRAC_PI_2;

use crate::frames::Shape;

/// Cells along the side of a tile, at least, unless the grid is smaller. Each is factorised in some
/// hundredths of a second, or in one second where the rim fills it, which nothing interrupts.
const TILE: usize = 256;
/// How far tiles reach beyond their borders, in cells.
const OVERLAP: f64 = 16.0;

/// Those tiles that hold a cell.
pub(super) struct Tiles {
    pub(super) parts: Vec<Tile>,
}

/// One tile: cells from `first` on in a rectangle of `shape`.
pub(super) struct Tile {
    first: [usize; 2],
    shape: Shape,
    /// Its cells in the order of the grid, each with its share.
    pub(super) cells: Vec<(u32, f64)>,
    /// Cells of a row of the grid.
    cols: usize,
}

/// The shares of the cells along one side of a tile.
struct Span {
    first: usize,
    shares: Vec<f64>,
}

impl Tiles {
    /// The tiles of these cells, which stand in the order of the grid.
    pub(super) fn new(shape: Shape, cells: &[u32]) -> Self {
        let (down, along) = (spans(shape.rows), spans(shape.cols));
        let places = down.iter().flat_map(|rows| along.iter().map(move |cols| [rows, cols]));
        let tile = |[rows, cols]: [&Span; 2]| Tile {
            first: [rows.first, cols.first],
            shape: Shape::new(rows.shares.len(), cols.shares.len()),
            cells: Vec::new(),
            cols: shape.cols,
        };
        let mut parts: Vec<Tile> = places.map(tile).collect();
        for &cell in cells {
            let [row, col] = [cell as usize / shape.cols, cell as usize % shape.cols];
            for (i, rows) in down.iter().enumerate() {
                let Some(height) = rows.share(row) else { continue };
                for (j, cols) in along.iter().enumerate() {
                    if let Some(width) = cols.share(col) {
                        parts[i * along.len() + j].cells.push((cell, height * width));
                    }
                }
            }
        }
        parts.retain(|tile| !tile.cells.is_empty());
        Self { parts }
    }
}

impl Tile {
    /// Where a cell of the grid lies in the tile.
    pub(super) fn place(&self, cell: usize) -> Option<usize> {
        let row = (cell / self.cols).checked_sub(self.first[0])?;
        let col = (cell % self.cols).checked_sub(self.first[1])?;
        (row < self.shape.rows && col < self.shape.cols).then_some(row * self.shape.cols + col)
    }

    /// The numbers of its cells by place; the largest one where there is none.
    pub(super) fn numbers(&self) -> Vec<u32> {
        let mut numbers = vec![u32::MAX; self.shape.len()];
        for (&(cell, _), number) in self.cells.iter().zip(0..) {
            if let Some(place) = self.place(cell as usize) {
                numbers[place] = number;
            }
        }
        numbers
    }
}

impl Span {
    /// The share of a row or column that is in the span.
    fn share(&self, place: usize) -> Option<f64> {
        self.shares.get(place.checked_sub(self.first)?).copied()
    }
}

/// The tiles along a side of the grid: shares rise as a sine where tiles overlap, and fall as a cosine.
fn spans(length: usize) -> Vec<Span> {
    let count = (length / TILE).max(1);
    let size = length as f64 / count as f64;
    let risen = |place: usize, border: f64| {
        ((place as f64 + 0.5 - border + OVERLAP) / (2.0 * OVERLAP)).clamp(0.0, 1.0)
    };
    let span = |index: usize| {
        let [begin, end] = [index as f64 * size, (index + 1) as f64 * size];
        let share = |place: usize| {
            let rising = if index == 0 { 1.0 } else { risen(place, begin) };
            let falling = if index + 1 == count { 0.0 } else { risen(place, end) };
            (FRAC_PI_2 * rising).sin() * (FRAC_PI_2 * falling).cos()
        };
        let first = if index == 0 { 0 } else { (begin - OVERLAP) as usize };
        let last = if index + 1 == count { length } else { (end + OVERLAP).ceil() as usize };
        Span { first, shares: (first..last).map(share).collect() }
    };
    (0..count).map(span).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn squares_of_shares_sum_to_one() {
        for length in [1, 40, 255, 511, 512, 601, 801, 3000] {
            let spans = spans(length);
            for place in 0..length {
                let shares = spans.iter().filter_map(|span| span.share(place));
                let sum: f64 = shares.map(|share| share * share).sum();
                assert!((sum - 1.0).abs() < 8.0 * f64::EPSILON);
            }
        }
    }

    #[test]
    fn a_tile_numbers_its_cells() {
        let shape = Shape::new(700, 600);
        let cells: Vec<u32> = (0..420_000).filter(|cell| cell % 97 == 0).collect();
        let tiles = Tiles::new(shape, &cells);
        assert!(tiles.parts.len() == 4);
        for tile in &tiles.parts {
            let numbers = tile.numbers();
            for (number, &(cell, _)) in tile.cells.iter().enumerate() {
                let place = tile.place(cell as usize).unwrap();
                assert!(numbers[place] as usize == number && cell % 97 == 0);
            }
        }
        // Every cell is in one tile at least, and not twice in any.
        let mut found: Vec<u32> =
            tiles.parts.iter().flat_map(|tile| tile.cells.iter().map(|cell| cell.0)).collect();
        found.sort_unstable();
        found.dedup();
        assert!(found == cells);
    }
}

//! How the sensor is cut into bands of rows for a pass, and where the sums of a band lie.

use super::layout::{Grid, Window};

/// Rows of pixels in a band, at least.
const FEWEST_ROWS: usize = 64;
/// The most bands, if shifts allow so many: the rows that two bands both add to are kept twice.
const MOST: usize = 64;

/// How the sensor is cut into bands, and where their sums lie.
#[derive(Default)]
pub(crate) struct Bands {
    /// Rows of pixels.
    pub(crate) height: usize,
    pub(crate) strips: Vec<Strip>,
    /// Values of one band's sums.
    pub(crate) length: usize,
}

/// The sums of a band in one view.
#[derive(Clone, Copy)]
pub(crate) struct Strip {
    /// The row of the view that the first one of band 0 is.
    pub(crate) first: usize,
    rows: usize,
    pub(crate) cols: usize,
    /// Where they begin among the sums of the band.
    pub(crate) start: usize,
}

impl Bands {
    /// Bands for exposures at these places: a band adds to as many rows of cells and those that shifts reach.
    pub(crate) fn new(grid: &Grid, windows: &[Window]) -> Self {
        let (views, rows) = (&grid.geometry.views, grid.sensor.rows);
        let reach = |view: usize| {
            let rows = windows.iter().filter(|window| window.view == view).map(|window| window.row);
            let first = rows.clone().min().unwrap_or(0);
            (first, rows.max().unwrap_or(0) - first)
        };
        let reaches: Vec<_> = (0..views.len()).map(reach).collect();
        let furthest = reaches.iter().map(|reach| reach.1).max().unwrap_or(0);
        let height = FEWEST_ROWS.max(furthest).max(rows / MOST);
        let mut length = 0;
        let strips = views.iter().zip(reaches).map(|(view, (first, reach))| {
            let (rows, cols, start) = (height + reach + grid.width - 1, view.shape.cols, length);
            length += rows * cols;
            Strip { first, rows, cols, start }
        });
        let strips = strips.collect();
        Self { height, strips, length }
    }

    /// Values of all bands of a sensor of so many rows.
    pub(crate) fn size(&self, rows: usize) -> usize {
        rows.div_ceil(self.height) * self.length
    }

    /// The bands that see a row of a view, each with that row of its sums.
    pub(crate) fn seeing<'s, N>(
        &self,
        sums: &'s [N],
        view: usize,
        row: usize,
    ) -> impl Iterator<Item = &'s [N]> + use<'s, N> {
        let (height, length, strip) = (self.height, self.length, self.strips[view]);
        let before = (row + height).saturating_sub(strip.first + strip.rows) / height;
        let bands = before..sums.len() / length;
        bands.map_while(move |band| {
            let at = row.checked_sub(strip.first + band * height)?;
            Some(&sums[band * length + strip.start + at * strip.cols..][..strip.cols])
        })
    }
}

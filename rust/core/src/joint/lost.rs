//! Measurements that are lost, as if they had not been made.
//!
//! Along the ragged edge of a mask, pixels stand apart from all others of their exposure. Such a measurement sees up
//! to 16 cells of a spline that hardly another one sees. It cannot determine them, the penalty does not reach all of
//! them, and they take values of 1e8 that the search follows without an end. So a measurement is firm if it is one of
//! 2×2 of its exposure, and one that is not firm is lost where it sees a cell that no firm one sees. What the
//! others say does not change: these cells would have taken any value that fits it.

use std::ops::Range;

use super::layout::{Grid, Window};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::{Real, Shape};
use crate::geometry::Rotation;

/// The columns of lost measurements, by exposure and row; empty if there are none.
#[derive(Debug, Default)]
pub(crate) struct Lost {
    columns: Vec<Vec<usize>>,
    rows: usize,
}

impl Lost {
    /// Those in a row of an exposure, sorted.
    pub(crate) fn in_row(&self, exposure: usize, row: usize) -> &[usize] {
        self.columns.get(exposure * self.rows + row).map_or(&[], Vec::as_slice)
    }

    pub(crate) fn contains(&self, exposure: usize, row: usize, col: usize) -> bool {
        self.in_row(exposure, row).binary_search(&col).is_ok()
    }

    pub(crate) const fn is_empty(&self) -> bool {
        self.columns.is_empty()
    }

    pub(crate) fn count(&self) -> usize {
        self.columns.iter().map(Vec::len).sum()
    }

    /// The pixels of all of them, of a sensor of so many columns.
    pub(super) fn pixels(&self, cols: usize) -> impl Iterator<Item = usize> {
        let rows = self.columns.iter().enumerate();
        rows.flat_map(move |(i, own)| own.iter().map(move |col| i % self.rows * cols + col))
    }
}

/// The measurements that are not lost, and the cells that they see at the shifts that were given.
pub(super) struct Survey<'e, 'a, T> {
    pub(super) exposures: &'e Exposures<'a, T>,
    pub(super) grid: &'e Grid,
    pub(super) control: &'e Control,
    pub(super) lost: Lost,
    windows: Vec<Window>,
}

impl<'e, 'a, T: Real> Survey<'e, 'a, T> {
    pub(super) fn new(
        exposures: &'e Exposures<'a, T>,
        grid: &'e Grid,
        control: &'e Control,
    ) -> Self {
        let positions = exposures.positions();
        let windows = grid.windows(&positions.on_grid(&positions.shifts));
        Self { exposures, grid, control, lost: Lost::default(), windows }
    }

    /// Calls `visit(exposure, row, columns)` for the measurements that stand side by side.
    pub(super) fn for_each_stretch(
        &self,
        mut visit: impl FnMut(usize, usize, Range<usize>),
    ) -> Result<()> {
        self.exposures.for_each_stretch(self.control, |k, row, cols| {
            let mut first = cols.start;
            for &col in self.lost.in_row(k, row).iter().filter(|col| cols.contains(col)) {
                if first < col {
                    visit(k, row, first..col);
                }
                first = col + 1;
            }
            if first < cols.end {
                visit(k, row, first..cols.end);
            }
        })
    }

    /// How often each pixel is measured.
    pub(super) fn times(&self) -> Result<Vec<u8>> {
        let Shape { cols: width, .. } = self.exposures.sensor();
        let mut times = vec![0_u8; self.exposures.sensor().len()];
        self.for_each_stretch(|_, row, cols| {
            let pixels = &mut times[row * width..][cols];
            pixels.iter_mut().for_each(|times| *times = times.saturating_add(1));
        })?;
        Ok(times)
    }

    /// How many measurements of each exposure are such, by exposure and pixel, and all of them.
    pub(super) fn shares(&self, is_such: impl Fn(usize, usize) -> bool) -> Result<Vec<[usize; 2]>> {
        let width = self.exposures.sensor().cols;
        let mut shares = vec![[0; 2]; self.exposures.count()];
        self.for_each_stretch(|k, row, cols| {
            let own = cols.clone().filter(|col| is_such(k, row * width + col));
            shares[k] = [shares[k][0] + own.count(), shares[k][1] + cols.len()];
        })?;
        Ok(shares)
    }

    /// The cells that a pixel of an exposure sees, and those as far around them as `margin`.
    pub(super) fn cells(
        &self,
        exposure: usize,
        row: usize,
        col: usize,
        margin: usize,
    ) -> impl Iterator<Item = usize> {
        let window = &self.windows[exposure];
        let places = self.grid.geometry.views[window.view].cells;
        let (row, col, side) =
            (row + window.row - margin, col + window.col - margin, self.grid.width + 2 * margin);
        (0..side * side).map(move |i| places.at(row + i / side, col + i % side))
    }

    /// Which cells such measurements see, by exposure and pixel.
    pub(super) fn seen_by(&self, is_such: impl Fn(usize, usize) -> bool) -> Result<Vec<bool>> {
        let width = self.exposures.sensor().cols;
        let mut seen = vec![false; self.grid.geometry.beam.len()];
        self.for_each_stretch(|k, row, cols| {
            let pixels: Vec<bool> = cols.clone().map(|col| is_such(k, row * width + col)).collect();
            let mut first = cols.start;
            for alike in pixels.chunk_by(|a, b| a == b) {
                if alike[0] {
                    self.see(k, row, first..first + alike.len(), &mut seen);
                }
                first += alike.len();
            }
        })?;
        Ok(seen)
    }

    /// Marks the cells that pixels side by side see.
    fn see(&self, exposure: usize, row: usize, cols: Range<usize>, seen: &mut [bool]) {
        let (window, width) = (&self.windows[exposure], self.grid.width);
        let view = &self.grid.geometry.views[window.view];
        if view.rotation != Rotation::None {
            let cells = cols.flat_map(|col| self.cells(exposure, row, col, 0));
            return cells.for_each(|cell| seen[cell] = true);
        }
        for i in 0..width {
            let first = view.cells.at(row + window.row + i, cols.start + window.col);
            seen[first..first + cols.len() + width - 1].fill(true);
        }
    }

    /// Those that are lost, and such measurements, by exposure and pixel.
    pub(super) fn with_lost(&self, is_such: impl Fn(usize, usize) -> bool) -> Result<Lost> {
        let Shape { rows, cols: width } = self.exposures.sensor();
        let mut columns = vec![Vec::new(); self.exposures.count() * rows];
        self.exposures.for_each_stretch(self.control, |k, row, cols| {
            let is_lost =
                |col: &usize| self.lost.contains(k, row, *col) || is_such(k, row * width + col);
            columns[k * rows + row].extend(cols.filter(is_lost));
        })?;
        Ok(Lost { columns, rows })
    }

    /// Those that are not firm and see a cell that no firm one sees; none where that were more than half of an
    /// exposure, as with masks of single pixels everywhere.
    pub(super) fn apart(&self) -> Result<Lost> {
        if !self.grid.is_spline() {
            return Ok(Lost::default());
        }
        let (sensor, count) = (self.exposures.sensor(), self.exposures.count());
        let mut firm = vec![false; count * sensor.len()];
        self.for_each_stretch(|k, row, cols| {
            firm[k * sensor.len() + row * sensor.cols..][cols].fill(true);
        })?;
        firm.chunks_mut(sensor.len()).for_each(|used| open(used, sensor));
        let is_firm = |k: usize, pixel: usize| firm[k * sensor.len() + pixel];
        let seen = self.seen_by(is_firm)?;
        let is_apart = |k: usize, pixel: usize| {
            let (row, col) = (pixel / sensor.cols, pixel % sensor.cols);
            !is_firm(k, pixel) && !self.cells(k, row, col, 0).all(|cell| seen[cell])
        };
        let shares = self.shares(is_apart)?;
        let is_rare = shares.iter().all(|[apart, used]| 2 * apart <= *used);
        if is_rare && shares.iter().any(|[apart, _]| *apart > 0) {
            return self.with_lost(is_apart);
        }
        Ok(Lost::default())
    }
}

/// Leaves those pixels that are one of 2×2 which are set, or of as many as there are along an axis.
fn open(image: &mut [bool], Shape { rows, cols }: Shape) {
    let (height, width) = (rows.min(2), cols.min(2));
    let mut kept = vec![false; image.len()];
    for row in 0..=rows - height {
        for col in 0..=cols - width {
            let mut block = (0..height * width).map(|i| (row + i / width) * cols + col + i % width);
            if block.clone().all(|pixel| image[pixel]) {
                block.by_ref().for_each(|pixel| kept[pixel] = true);
            }
        }
    }
    image.copy_from_slice(&kept);
}

//! Measurements that the search leaves out, as if they had not been made.
//!
//! Along the edge of a mask some cells of a spline are seen by few measurements. These do not determine them, the
//! penalty does not reach all of them, and coefficients of 1e8 fit as well, which the search follows for thousands of
//! passes. So a cell counts as determined where a measurement in a block sees it, or [`ENOUGH`] others. A block is a
//! square of 4×4 pixels that one exposure measures: as many as one of them sees cells. Only pixels count that stay in
//! the search and are measured at least twice. All other measurements are lost where they see a cell that is not
//! determined.
//!
//! Wide parts of the sensor are no edges. Where most pixels of one are measured twice, and no others see their cells,
//! they are treated as an experiment of two exposures. And where at least half of the measurements of an exposure are
//! in no block, or many in a part of it ([`SPARSE`]), as behind a mask like a chessboard, they count as if they were.
//!
//! What the rule does not do:
//!
//! - Blocks are found once, from all measurements that are used. Those of pixels that leave the search later form
//!   blocks too.
//! - Measurements are only ever lost, never taken back. So the search for them ends.
//! - No exposure is emptied. One that would lose all the measurements that it has left keeps them.
//! - An exposure that holds nothing but a ragged crescent has few blocks. All of its measurements count as blocks then,
//!   and none is lost but of pixels that leave the search or are measured once.

use std::ops::Range;

use super::layout::{Grid, MARGIN, Window};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::{Real, Shape};
use crate::geometry::{Rotation, TAPS};

/// Measurements of a pixel that are few where there are more exposures.
pub(super) const FEW: u8 = 2;

/// Measurements outside blocks that determine a cell: as many as one of them sees cells.
const ENOUGH: u8 = (TAPS * TAPS) as u8;

/// Squares of so many pixels a side, of which at least a share is set.
#[derive(Clone, Copy)]
struct Squares {
    side: usize,
    share: f64,
}

/// Measurements all of which are used.
const BLOCKS: Squares = Squares { side: TAPS, share: 1.0 };

/// Parts of the sensor that may be an experiment of two exposures: so many of their pixels are measured twice.
const WIDE: Squares = Squares { side: 32, share: 0.5 };

/// Parts of an exposure where measurements outside of blocks count as blocks: so many of their pixels have one, more
/// than along a ragged edge, less than of a chessboard.
const SPARSE: Squares = Squares { side: 64, share: 0.3 };

/// The columns of lost measurements, by exposure and row; empty if there are none.
#[derive(Debug, Default)]
pub(crate) struct Lost {
    columns: Vec<Vec<u32>>,
    rows: usize,
}

impl Lost {
    /// Those in a row of an exposure, sorted.
    pub(crate) fn in_row(&self, exposure: usize, row: usize) -> &[u32] {
        self.columns.get(exposure * self.rows + row).map_or(&[], Vec::as_slice)
    }

    pub(crate) const fn is_empty(&self) -> bool {
        self.columns.is_empty()
    }

    pub(crate) fn count(&self) -> usize {
        self.columns.iter().map(Vec::len).sum()
    }

    /// Their pixels in each exposure of a sensor of so many columns.
    pub(crate) fn pixels(&self, cols: usize) -> Vec<Vec<usize>> {
        let of_exposure = |lines: &[Vec<u32>]| {
            let lines = lines.iter().enumerate();
            lines
                .flat_map(|(row, own)| own.iter().map(move |&col| row * cols + col as usize))
                .collect()
        };
        self.columns.chunks(self.rows.max(1)).map(of_exposure).collect()
    }

    /// Calls `visit(columns)` for the parts of some columns between lost measurements.
    pub(crate) fn split(
        &self,
        exposure: usize,
        row: usize,
        cols: Range<usize>,
        mut visit: impl FnMut(Range<usize>),
    ) {
        let own = self.in_row(exposure, row);
        let mut first = cols.start;
        let inside = own[own.partition_point(|col| (*col as usize) < cols.start)..].iter();
        for col in inside.map(|col| *col as usize).take_while(|col| *col < cols.end) {
            if first < col {
                visit(first..col);
            }
            first = col + 1;
        }
        if first < cols.end {
            visit(first..cols.end);
        }
    }
}

/// The measurements that are not lost, and the cells that they see at the shifts that were given.
pub(super) struct Survey<'e, 'a, T> {
    pub(super) exposures: &'e Exposures<'a, T>,
    pub(super) grid: &'e Grid,
    pub(super) control: &'e Control,
    pub(super) lost: Lost,
    windows: Vec<Window>,
    /// How many measurements each exposure has.
    used: Vec<usize>,
    /// Whether each measurement is in a block, by exposure and pixel.
    blocks: Vec<bool>,
}

impl<'e, 'a, T: Real> Survey<'e, 'a, T> {
    pub(super) fn new(
        exposures: &'e Exposures<'a, T>,
        grid: &'e Grid,
        control: &'e Control,
    ) -> Result<Self> {
        let positions = exposures.positions();
        let windows = grid.windows(&positions.on_grid(&positions.shifts));
        let (blocks, used) = blocks(exposures, grid.is_spline(), control)?;
        Ok(Self { exposures, grid, control, lost: Lost::default(), windows, used, blocks })
    }

    /// Loses these measurements too, but none of exposures that would have none left; whether there were more.
    pub(super) fn lose(&mut self, found: &Lost) -> bool {
        if found.is_empty() {
            return false;
        }
        let mut columns = std::mem::take(&mut self.lost.columns);
        columns.resize(found.columns.len(), Vec::new());
        let mut grows = false;
        let of_exposures = columns.chunks_mut(found.rows).zip(found.columns.chunks(found.rows));
        for ((own, found), used) in of_exposures.zip(&self.used) {
            let joined: Vec<_> =
                own.iter().zip(found).map(|(own, found)| union(own, found)).collect();
            let count = |rows: &[Vec<u32>]| rows.iter().map(Vec::len).sum::<usize>();
            if count(own) < count(&joined) && count(&joined) < *used {
                own.clone_from_slice(&joined);
                grows = true;
            }
        }
        let is_empty = columns.iter().all(Vec::is_empty);
        self.lost = if is_empty { Lost::default() } else { Lost { columns, rows: found.rows } };
        grows
    }

    /// Calls `visit(exposure, row, columns)` for the measurements that stand side by side.
    pub(super) fn for_each_stretch(
        &self,
        mut visit: impl FnMut(usize, usize, Range<usize>),
    ) -> Result<()> {
        self.exposures.for_each_stretch(self.control, |k, row, cols| {
            self.lost.split(k, row, cols, |cols| visit(k, row, cols));
        })
    }

    /// How often each pixel is measured.
    pub(super) fn times(&self) -> Result<Vec<u8>> {
        let sensor = self.exposures.sensor();
        let mut times = vec![0_u8; sensor.len()];
        self.for_each_stretch(|_, row, cols| {
            let pixels = &mut times[row * sensor.cols..][cols];
            pixels.iter_mut().for_each(|times| *times = times.saturating_add(1));
        })?;
        Ok(times)
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
        let [rows, cols] = self.seen(window);
        let (row, height) = (row + window.row + rows.start - margin, rows.len() + 2 * margin);
        let (col, width) = (col + window.col + cols.start - margin, cols.len() + 2 * margin);
        (0..height * width).map(move |i| places.at(row + i / width, col + i % width))
    }

    /// Which cells from the first one on the pixels see along both axes: one less than a spline has at places that are
    /// whole and stay so.
    fn seen(&self, window: &Window) -> [Range<usize>; 2] {
        let moves = self.exposures.positions().std.is_some();
        [&window.along_rows, &window.along_cols].map(|taps| {
            let factors = &taps.values[..self.grid.width];
            let is_seen = |factor: &f64| moves || *factor != 0.0;
            let first = factors.iter().position(is_seen).unwrap_or(0);
            first..factors.iter().rposition(is_seen).map_or(0, |last| last + 1)
        })
    }

    /// The number of measurements of some pixels that see each cell; one in a block counts as enough.
    pub(super) fn seeing(&self, is_one: impl Fn(usize) -> bool) -> Result<Vec<u8>> {
        let sensor = self.exposures.sensor();
        let mut seeing = vec![0; self.grid.geometry.beam.len()];
        self.for_each_stretch(|k, row, cols| {
            let in_block = &self.blocks[k * sensor.len() + row * sensor.cols..];
            let weight = |col: usize| match (is_one(row * sensor.cols + col), in_block[col]) {
                (true, true) => ENOUGH,
                (true, false) => 1,
                (false, _) => 0,
            };
            let mut first = cols.start;
            while first < cols.end {
                let counts = weight(first);
                let alike = (first..cols.end).take_while(|&col| weight(col) == counts).count();
                match counts {
                    0 => {}
                    ENOUGH => self.count(k, row, first..first + alike, ENOUGH, &mut seeing),
                    _ => (first..first + alike)
                        .for_each(|col| self.count(k, row, col..col + 1, counts, &mut seeing)),
                }
                first += alike;
            }
        })?;
        Ok(seeing)
    }

    /// Adds to the count of all cells that pixels side by side see.
    fn count(&self, exposure: usize, row: usize, cols: Range<usize>, add: u8, counts: &mut [u8]) {
        let window = &self.windows[exposure];
        let (view, [rows, across]) = (&self.grid.geometry.views[window.view], self.seen(window));
        let mut count = |cell: usize| counts[cell] = counts[cell].saturating_add(add);
        if view.rotation != Rotation::None {
            return cols.for_each(|col| self.cells(exposure, row, col, 0).for_each(&mut count));
        }
        for i in rows {
            let first = view.cells.at(row + window.row + i, cols.start + window.col + across.start);
            (first..first + cols.len() + across.len() - 1).for_each(&mut count);
        }
    }

    /// The measurements that are lost where these pixels determine the cells: all those that see other cells, but for
    /// those in blocks of these pixels.
    pub(super) fn undetermined(&self, determine: impl Fn(usize) -> bool) -> Result<Lost> {
        let Shape { rows, cols: width } = self.exposures.sensor();
        let seeing = self.seeing(&determine)?;
        // As far as a fitted shift may move, and not at all where it does not.
        let margin = if self.exposures.positions().std.is_some() { MARGIN } else { 0 };
        let mut columns = vec![Vec::new(); self.exposures.count() * rows];
        self.exposures.for_each_stretch(self.control, |k, row, cols| {
            let of_row = &self.blocks[(k * rows + row) * width..];
            let lost = cols.filter(|&col| {
                let holds = of_row[col] && determine(row * width + col);
                !holds && self.cells(k, row, col, margin).any(|cell| seeing[cell] < ENOUGH)
            });
            columns[k * rows + row].extend(lost.map(|col| col as u32));
        })?;
        let is_empty = columns.iter().all(Vec::is_empty);
        Ok(if is_empty { Lost::default() } else { Lost { columns, rows } })
    }
}

fn union(some: &[u32], others: &[u32]) -> Vec<u32> {
    let mut union = [some, others].concat();
    union.sort_unstable();
    union.dedup();
    union
}

/// The pixels that lose measurements and have two, where they form wide parts of the sensor.
pub(super) fn wide(
    lost: &Lost,
    times: &[u8],
    sensor: Shape,
    control: &Control,
) -> Result<Vec<bool>> {
    let mut image = vec![false; sensor.len()];
    let lost = lost.pixels(sensor.cols);
    lost.iter().flatten().for_each(|&pixel| image[pixel] = times[pixel] == FEW);
    let mut wide = in_squares(&image, sensor, WIDE, control)?;
    wide.iter_mut().zip(image).for_each(|(wide, is_one)| *wide &= is_one);
    Ok(wide)
}

/// Whether each measurement is in a block, or counts as one; all do where a cell is its own value. And how many
/// measurements each exposure has.
fn blocks<T: Real>(
    exposures: &Exposures<'_, T>,
    is_spline: bool,
    control: &Control,
) -> Result<(Vec<bool>, Vec<usize>)> {
    let (sensor, count) = (exposures.sensor(), exposures.count());
    let (mut blocks, mut counts) = (vec![false; count * sensor.len()], vec![0; count]);
    exposures.for_each_stretch(control, |k, row, cols| {
        counts[k] += cols.len();
        blocks[k * sensor.len() + row * sensor.cols..][cols].fill(true);
    })?;
    let is_masked = |k: &usize| is_spline && exposures.uniform_weight(*k).is_none();
    for k in (0..count).filter(is_masked) {
        blocks_of(&mut blocks[k * sensor.len()..][..sensor.len()], counts[k], sensor, control)?;
    }
    Ok((blocks, counts))
}

/// Leaves those of the measurements of an exposure, of which there are so many, that are in a block or count as one.
fn blocks_of(used: &mut [bool], count: usize, sensor: Shape, control: &Control) -> Result<()> {
    let blocks = in_squares(used, sensor, BLOCKS, control)?;
    let apart: Vec<bool> = used.iter().zip(&blocks).map(|(used, block)| used & !block).collect();
    if 2 * apart.iter().filter(|is_apart| **is_apart).count() < count {
        let sparse = in_squares(&apart, sensor, SPARSE, control)?;
        for (pixel, used) in used.iter_mut().enumerate() {
            *used = blocks[pixel] | (apart[pixel] & sparse[pixel]);
        }
    }
    Ok(())
}

/// The pixels in such squares, which have as many pixels along an axis as the image where that has fewer.
fn in_squares(
    image: &[bool],
    Shape { rows, cols }: Shape,
    Squares { side, share }: Squares,
    control: &Control,
) -> Result<Vec<bool>> {
    let (height, width) = (rows.min(side), cols.min(side));
    let least = (share * (height * width) as f64).ceil() as usize;
    // The last pixel of each square, and how many are set of the last rows of each column.
    let (mut found, mut columns) = (vec![false; image.len()], vec![0; cols]);
    for row in 0..rows {
        control.check()?;
        let mut count = 0;
        for col in 0..cols {
            columns[col] += usize::from(image[row * cols + col]);
            columns[col] -= usize::from(row >= height && image[(row - height) * cols + col]);
            count += columns[col];
            count -= if col < width { 0 } else { columns[col - width] };
            found[row * cols + col] = row + 1 >= height && col + 1 >= width && count >= least;
        }
    }
    // Each of the pixels before it, from the end: the nearest row below with a last pixel near to the right.
    let mut below = vec![usize::MAX; cols];
    for row in (0..rows).rev() {
        control.check()?;
        let mut right = usize::MAX;
        for col in (0..cols).rev() {
            if found[row * cols + col] {
                right = col;
            }
            if right - col < width {
                below[col] = row;
            }
            found[row * cols + col] = below[col] - row < height;
        }
    }
    Ok(found)
}

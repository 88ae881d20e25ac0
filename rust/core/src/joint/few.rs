//! Pixels with few measurements, which follow the beam and pull at nothing.
//!
//! A pixel that is measured once has no residual and no word on the beam. One that is measured twice, of many
//! exposures, says little of the beam, and where masks leave many such pixels along the edge of what they leave, as of
//! discs, the search follows their noise for thousands of passes. So they leave it: M follows the beam at its
//! closed form, as that of all pixels does, but the pulls of their measurements are 0, in products, in D and in draws
//! of noise. Their variance follows too, since that of any pixel is D⁻¹ and what S leaves open of the beam.
//!
//! They stay in it where they say what no other pixel does: where cells are seen by them alone, or where they join
//! components. But a pixel that is measured once says nothing of cells that no other pixel sees, since its M follows
//! any light: these cells would take any value, and with them its M. It is lost, as if it had not been measured.

use std::ops::Range;

use super::connected::connected;
use super::layout::{Grid, MARGIN, Window};
use crate::connectivity::NONE;
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;

/// Measurements that are few where there are more exposures.
const FEW: u8 = 2;

/// The columns of such pixels and of lost ones, by row of the sensor.
#[derive(Debug, Default)]
pub(crate) struct Few {
    rows: Vec<Vec<usize>>,
    lost: Vec<Vec<usize>>,
    /// How many pixels follow the beam.
    pub(crate) pixels: usize,
    /// How many measurements the search does not use: theirs and those of lost pixels.
    pub(crate) measurements: usize,
}

impl Few {
    /// Those of exposures at the shifts that were given.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn of<T: Real>(
        exposures: &Exposures<'_, T>,
        grid: &Grid,
        control: &Control,
    ) -> Result<Self> {
        let (sensor, count) = (exposures.sensor(), exposures.count());
        let is_whole = (0..count).all(|k| exposures.uniform_weight(k).is_some());
        if count <= usize::from(FEW) || is_whole || exposures.offset() {
            return Ok(Self::default());
        }
        let mut times = vec![0_u8; sensor.len()];
        exposures.for_each_stretch(control, |_, row, cols| {
            let pixels = &mut times[row * sensor.cols..][cols];
            pixels.iter_mut().for_each(|times| *times = times.saturating_add(1));
        })?;
        let mut leaves: Vec<bool> = times.iter().map(|times| (1..=FEW).contains(times)).collect();
        if !leaves.contains(&true) {
            return Ok(Self::default());
        }
        stay_where_needed(&mut leaves, exposures, grid, control)?;
        let shares = shares(&leaves, exposures, control)?;
        // What overlaps others so little is determined by such pixels.
        if shares.iter().any(|[leaving, used]| 2 * leaving > *used) {
            leaves.fill(false);
        }
        let mut lost = alone(&times, &leaves, exposures, grid, control)?;
        // No exposure may lose all its measurements.
        if self::shares(&lost, exposures, control)?.iter().any(|[lost, used]| lost == used) {
            lost.fill(false);
        }
        let count = |pixels: &[bool]| pixels.iter().filter(|is_one| **is_one).count();
        let unused = leaves.iter().zip(&lost).map(|(leaves, lost)| *leaves || *lost);
        let measurements =
            unused.zip(&times).map(|(unused, n)| usize::from(unused) * usize::from(*n));
        Ok(Self {
            pixels: count(&leaves),
            measurements: measurements.sum(),
            rows: columns(&leaves, sensor.cols),
            lost: columns(&lost, sensor.cols),
        })
    }

    /// Sets the values of a row to 0 in them.
    pub(crate) fn clear<T: Default>(&self, row: usize, values: &mut [T]) {
        self.in_row(row).iter().for_each(|&col| values[col] = T::default());
    }

    /// Sets values of some columns of a row to 0 in them and in lost pixels.
    pub(crate) fn clear_all<T: Default>(&self, row: usize, cols: &Range<usize>, values: &mut [T]) {
        for columns in [self.in_row(row), self.lost_in_row(row)] {
            let first = columns.partition_point(|col| *col < cols.start);
            let inside = columns[first..].iter().take_while(|col| **col < cols.end);
            inside.for_each(|col| values[col - cols.start] = T::default());
        }
    }

    /// Their columns in a row.
    pub(crate) fn in_row(&self, row: usize) -> &[usize] {
        self.rows.get(row).map_or(&[], Vec::as_slice)
    }

    /// The columns of lost pixels in a row.
    pub(crate) fn lost_in_row(&self, row: usize) -> &[usize] {
        self.lost.get(row).map_or(&[], Vec::as_slice)
    }

    /// Whether any pixel is lost.
    pub(crate) const fn has_lost(&self) -> bool {
        !self.lost.is_empty()
    }

    /// Which of the pixels they are, if any.
    pub(crate) fn image(&self, cols: usize) -> Option<Vec<bool>> {
        (self.pixels > 0).then(|| image(&self.rows, cols))
    }

    /// Which of the pixels are lost; empty if none is.
    pub(crate) fn lost(&self, cols: usize) -> Vec<bool> {
        image(&self.lost, cols)
    }
}

/// The columns of some pixels by row; empty if there are none.
fn columns(pixels: &[bool], cols: usize) -> Vec<Vec<usize>> {
    let of_row = |row: &[bool]| (0..cols).filter(|&col| row[col]).collect();
    let rows = if pixels.contains(&true) { pixels } else { &[] };
    rows.chunks(cols).map(of_row).collect()
}

/// The inverse of [`columns`].
fn image(rows: &[Vec<usize>], cols: usize) -> Vec<bool> {
    let mut image = vec![false; rows.len() * cols];
    for (row, columns) in rows.iter().enumerate() {
        columns.iter().for_each(|col| image[row * cols + col] = true);
    }
    image
}

/// How many measurements of each exposure are of some pixels, and of all.
fn shares<T: Real>(
    pixels: &[bool],
    exposures: &Exposures<'_, T>,
    control: &Control,
) -> Result<Vec<[usize; 2]>> {
    let (mut shares, width) = (vec![[0; 2]; exposures.count()], exposures.sensor().cols);
    exposures.for_each_stretch(control, |k, row, cols| {
        let own = pixels[row * width..][cols.clone()].iter().filter(|is_one| **is_one);
        shares[k] = [shares[k][0] + own.count(), shares[k][1] + cols.len()];
    })?;
    Ok(shares)
}

/// The cells that a pixel sees through a window, and those as far around them as `margin`.
fn cells<'g>(
    grid: &'g Grid,
    window: &Window,
    row: usize,
    col: usize,
    margin: usize,
) -> impl Iterator<Item = usize> + 'g {
    let places = grid.geometry.views[window.view].cells;
    let (row, col, side) =
        (row + window.row - margin, col + window.col - margin, grid.width + 2 * margin);
    (0..side * side).map(move |i| places.at(row + i / side, col + i % side))
}

/// Which cells some pixels see.
fn seen_by<T: Real>(
    is_one: impl Fn(usize) -> bool,
    exposures: &Exposures<'_, T>,
    grid: &Grid,
    windows: &[Window],
    control: &Control,
) -> Result<Vec<bool>> {
    let (mut seen, width) = (vec![false; grid.geometry.beam.len()], exposures.sensor().cols);
    exposures.for_each_stretch(control, |k, row, cols| {
        for col in cols.filter(|col| is_one(row * width + col)) {
            cells(grid, &windows[k], row, col, 0).for_each(|cell| seen[cell] = true);
        }
    })?;
    Ok(seen)
}

/// The pixels that are measured once, and see a cell that none does which is measured more often.
fn alone<T: Real>(
    times: &[u8],
    leaves: &[bool],
    exposures: &Exposures<'_, T>,
    grid: &Grid,
    control: &Control,
) -> Result<Vec<bool>> {
    let (mut alone, width) = (vec![false; times.len()], exposures.sensor().cols);
    let positions = exposures.positions();
    let windows = grid.windows(&positions.on_grid(&positions.shifts));
    let stays = |pixel: usize| !leaves[pixel] && times[pixel] > 1;
    let seen = seen_by(stays, exposures, grid, &windows, control)?;
    exposures.for_each_stretch(control, |k, row, cols| {
        for col in cols {
            let pixel = row * width + col;
            alone[pixel] = times[pixel] == 1
                && !leaves[pixel]
                && !cells(grid, &windows[k], row, col, 0).all(|cell| seen[cell]);
        }
    })?;
    Ok(alone)
}

/// Keeps those of which not all cells are seen by pixels that stay, and of one component.
fn stay_where_needed<T: Real>(
    leaves: &mut [bool],
    exposures: &Exposures<'_, T>,
    grid: &Grid,
    control: &Control,
) -> Result<()> {
    let (sensor, positions) = (exposures.sensor(), exposures.positions());
    let shifts = positions.on_grid(&positions.shifts);
    let windows = grid.windows(&shifts);
    let labels = connected(exposures, grid, &shifts, leaves, control)?.cells;
    // As far as a fitted shift may move, and not at all where it does not.
    let margin = if positions.std.is_some() { MARGIN } else { 0 };
    let stays = |pixel: usize| !leaves[pixel];
    let seen = seen_by(stays, exposures, grid, &windows, control)?;
    let mut found = vec![NONE; sensor.len()];
    exposures.for_each_stretch(control, |k, row, cols| {
        for pixel in cols.map(|col| row * sensor.cols + col) {
            if !leaves[pixel] {
                continue;
            }
            let col = pixel % sensor.cols;
            leaves[pixel] &= cells(grid, &windows[k], row, col, margin).all(|cell| seen[cell]);
            for cell in cells(grid, &windows[k], row, col, 0).filter(|&cell| labels[cell] != NONE) {
                leaves[pixel] &= found[pixel] == NONE || found[pixel] == labels[cell];
                found[pixel] = labels[cell];
            }
        }
    })
}

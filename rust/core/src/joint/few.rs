//! Pixels with few measurements, which follow the beam and pull at nothing.
//!
//! A pixel that is measured once has no residual and no word on the beam. One that is measured twice, of many
//! exposures, says little of the beam, and where masks leave many such pixels along the edge of what they leave, as of
//! discs, the search follows their noise for thousands of passes. So they leave it: M follows the beam at its
//! closed form, as that of all pixels does, but the pulls of their measurements are 0, in products, in D and in draws
//! of noise. Their variance follows too, since that of any pixel is D⁻¹ and what S leaves open of the beam.
//!
//! They stay in it where they say what no other pixel does: where cells are seen by them alone, or where they join
//! components. A pixel that is measured once says nothing there either, since its M follows any light. Cells that it
//! alone sees would take any value, and with them its M: it is lost, as if it had not been measured.

use super::connected::connected;
use super::layout::{Grid, MARGIN, Window};
use crate::connectivity::NONE;
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;

/// Measurements that are few where there are more exposures.
const FEW: u8 = 2;

/// The columns of such pixels and of lost ones, by row of the sensor, how many measurements both have, and how
/// many pixels there are of the former.
#[derive(Debug, Default)]
pub(crate) struct Few {
    rows: Vec<Vec<usize>>,
    lost: Vec<Vec<usize>>,
    pub(crate) measurements: usize,
    pub(crate) pixels: usize,
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
        let goes = |pixel: usize| leaves[pixel] || times[pixel] == 1;
        let mut shares = vec![[0; 2]; count];
        exposures.for_each_stretch(control, |k, row, cols| {
            let going = cols.clone().filter(|col| goes(row * sensor.cols + col));
            shares[k] = [shares[k][0] + going.count(), shares[k][1] + cols.len()];
        })?;
        // What overlaps others so little is determined by such pixels.
        if shares.iter().any(|[going, used]| 2 * going > *used) {
            return Ok(Self::default());
        }
        let by_row = |is_one: &dyn Fn(usize) -> bool| {
            let of_row = |row: usize| {
                (0..sensor.cols).filter(|col| is_one(row * sensor.cols + col)).collect()
            };
            (0..sensor.rows).map(of_row).collect()
        };
        Ok(Self {
            rows: by_row(&|pixel| leaves[pixel]),
            lost: by_row(&|pixel| times[pixel] == 1 && !leaves[pixel]),
            measurements: shares.iter().map(|[going, _]| going).sum(),
            pixels: leaves.iter().filter(|leaves| **leaves).count(),
        })
    }

    /// Sets the values of a row to 0 in them.
    pub(crate) fn clear<T: Default>(&self, row: usize, values: &mut [T]) {
        self.in_row(row).iter().for_each(|&col| values[col] = T::default());
    }

    /// Their columns in a row.
    pub(crate) fn in_row(&self, row: usize) -> &[usize] {
        self.rows.get(row).map_or(&[], Vec::as_slice)
    }

    /// Whether lost pixels were sought.
    pub(crate) const fn loses(&self) -> bool {
        !self.lost.is_empty()
    }

    /// The columns of lost pixels in a row.
    pub(crate) fn lost_in_row(&self, row: usize) -> &[usize] {
        self.lost.get(row).map_or(&[], Vec::as_slice)
    }

    /// Which of the pixels they are, if any.
    pub(crate) fn image(&self, cols: usize) -> Option<Vec<bool>> {
        (self.pixels > 0).then(|| image(&self.rows, cols))
    }

    /// Which of the pixels are lost; empty if none were sought.
    pub(crate) fn lost(&self, cols: usize) -> Vec<bool> {
        image(&self.lost, cols)
    }
}

fn image(rows: &[Vec<usize>], cols: usize) -> Vec<bool> {
    let mut image = vec![false; rows.len() * cols];
    for (row, columns) in rows.iter().enumerate() {
        columns.iter().for_each(|col| image[row * cols + col] = true);
    }
    image
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
    let cells = |window: &Window, row: usize, col: usize, margin: usize| {
        let places = grid.geometry.views[window.view].cells;
        let (row, col, side) =
            (row + window.row - margin, col + window.col - margin, grid.width + 2 * margin);
        (0..side * side).map(move |i| places.at(row + i / side, col + i % side))
    };
    let mut seen = vec![false; labels.len()];
    exposures.for_each_stretch(control, |k, row, cols| {
        for col in cols.filter(|col| !leaves[row * sensor.cols + col]) {
            cells(&windows[k], row, col, 0).for_each(|cell| seen[cell] = true);
        }
    })?;
    let mut found = vec![NONE; sensor.len()];
    exposures.for_each_stretch(control, |k, row, cols| {
        for pixel in cols.map(|col| row * sensor.cols + col) {
            if !leaves[pixel] {
                continue;
            }
            let col = pixel % sensor.cols;
            leaves[pixel] &= cells(&windows[k], row, col, margin).all(|cell| seen[cell]);
            for cell in cells(&windows[k], row, col, 0).filter(|&cell| labels[cell] != NONE) {
                leaves[pixel] &= found[pixel] == NONE || found[pixel] == labels[cell];
                found[pixel] = labels[cell];
            }
        }
    })
}

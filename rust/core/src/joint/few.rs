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
//!
//! Lost are also measurements that stand apart from others of their exposure and see cells that no others determine
//! (`lost.rs`).

use std::ops::Range;

use super::connected::connected;
use super::layout::{Grid, MARGIN};
use super::lost::{Lost, Survey};
use crate::connectivity::NONE;
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;

/// Measurements that are few where there are more exposures.
const FEW: u8 = 2;

/// The columns of such pixels, by row of the sensor, and lost measurements.
#[derive(Debug, Default)]
pub(crate) struct Few {
    rows: Vec<Vec<usize>>,
    pub(crate) lost: Lost,
    /// Measured pixels of which all measurements are lost.
    pub(crate) lost_pixels: Vec<usize>,
    /// How many pixels follow the beam.
    pub(crate) pixels: usize,
    /// How many measurements the search does not use: theirs and lost ones.
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
        let mut survey = Survey::new(exposures, grid, control);
        survey.lost = survey.apart()?;
        let times = survey.times()?;
        let mut leaves: Vec<bool> = times.iter().map(|times| (1..=FEW).contains(times)).collect();
        if leaves.contains(&true) {
            stay_where_needed(&mut leaves, &survey)?;
            // What overlaps others so little is determined by such pixels.
            let shares = survey.shares(|_, pixel| leaves[pixel])?;
            if shares.iter().any(|[leaving, used]| 2 * leaving > *used) {
                leaves.fill(false);
            }
            survey.lost = lost_alone(&times, &leaves, &survey)?;
        }
        let lost_pixels = if survey.lost.is_empty() { Vec::new() } else { lost_pixels(&survey)? };
        let leaving = (0..sensor.len()).filter(|&pixel| leaves[pixel]);
        let of_row = |row: &[bool]| (0..sensor.cols).filter(|&col| row[col]).collect();
        let rows = if leaves.contains(&true) { &leaves[..] } else { &[] };
        Ok(Self {
            rows: rows.chunks(sensor.cols).map(of_row).collect(),
            lost_pixels,
            pixels: leaving.clone().count(),
            measurements: leaving.map(|pixel| usize::from(times[pixel])).sum::<usize>()
                + survey.lost.count(),
            lost: survey.lost,
        })
    }

    /// Sets the values of a row to 0 in them.
    pub(crate) fn clear<T: Default>(&self, row: usize, values: &mut [T]) {
        self.in_row(row).iter().for_each(|&col| values[col] = T::default());
    }

    /// Sets values of some columns of a row of an exposure to 0 in them and where measurements are lost.
    pub(crate) fn clear_all<T: Default>(
        &self,
        exposure: usize,
        row: usize,
        cols: &Range<usize>,
        values: &mut [T],
    ) {
        for columns in [self.in_row(row), self.lost.in_row(exposure, row)] {
            let first = columns.partition_point(|col| *col < cols.start);
            let inside = columns[first..].iter().take_while(|col| **col < cols.end);
            inside.for_each(|col| values[col - cols.start] = T::default());
        }
    }

    /// Their columns in a row.
    pub(crate) fn in_row(&self, row: usize) -> &[usize] {
        self.rows.get(row).map_or(&[], Vec::as_slice)
    }

    /// Which of the pixels they are, if any.
    pub(crate) fn image(&self, cols: usize) -> Option<Vec<bool>> {
        let mut image = vec![false; self.rows.len() * cols];
        for (row, columns) in self.rows.iter().enumerate() {
            columns.iter().for_each(|col| image[row * cols + col] = true);
        }
        (self.pixels > 0).then_some(image)
    }
}

/// What is lost, and pixels that are measured once and see a cell that none does which is measured more often; but
/// no exposure may lose all its measurements.
fn lost_alone<T: Real>(times: &[u8], leaves: &[bool], survey: &Survey<'_, '_, T>) -> Result<Lost> {
    let width = survey.exposures.sensor().cols;
    let seen = survey.seen_by(|_, pixel| !leaves[pixel] && times[pixel] > 1)?;
    let is_alone = |k: usize, pixel: usize| {
        let see_all = || survey.cells(k, pixel / width, pixel % width, 0).all(|cell| seen[cell]);
        times[pixel] == 1 && !leaves[pixel] && !see_all()
    };
    let shares = survey.shares(is_alone)?;
    let none_is_empty = shares.iter().all(|[alone, used]| alone < used);
    survey.with_lost(|k, pixel| none_is_empty && is_alone(k, pixel))
}

/// The pixels that are measured, but of which all measurements are lost.
fn lost_pixels<T: Real>(survey: &Survey<'_, '_, T>) -> Result<Vec<usize>> {
    let used = survey.times()?;
    let losing = survey.lost.pixels(survey.exposures.sensor().cols);
    let mut pixels: Vec<_> = losing.filter(|&pixel| used[pixel] == 0).collect();
    pixels.sort_unstable();
    pixels.dedup();
    Ok(pixels)
}

/// Keeps those of which not all cells are seen by pixels that stay, and of one component.
fn stay_where_needed<T: Real>(leaves: &mut [bool], survey: &Survey<'_, '_, T>) -> Result<()> {
    let Survey { exposures, grid, lost, control, .. } = survey;
    let (sensor, positions) = (exposures.sensor(), exposures.positions());
    let shifts = positions.on_grid(&positions.shifts);
    let is_out = |k: usize, row: usize, col: usize| {
        leaves[row * sensor.cols + col] || lost.contains(k, row, col)
    };
    let labels = connected(exposures, grid, &shifts, is_out, control)?.cells;
    // As far as a fitted shift may move, and not at all where it does not.
    let margin = if positions.std.is_some() { MARGIN } else { 0 };
    let seen = survey.seen_by(|_, pixel| !leaves[pixel])?;
    let mut found = vec![NONE; sensor.len()];
    survey.for_each_stretch(|k, row, cols| {
        for col in cols {
            let pixel = row * sensor.cols + col;
            if !leaves[pixel] {
                continue;
            }
            leaves[pixel] &= survey.cells(k, row, col, margin).all(|cell| seen[cell]);
            for cell in survey.cells(k, row, col, 0).filter(|&cell| labels[cell] != NONE) {
                leaves[pixel] &= found[pixel] == NONE || found[pixel] == labels[cell];
                found[pixel] = labels[cell];
            }
        }
    })
}

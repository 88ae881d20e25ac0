//! Pixels with few measurements, which follow the beam and pull at nothing.
//!
//! A pixel that is measured once has no residual and no word on the beam. One that is measured twice, of many
//! exposures, says little of the beam, and where masks leave many such pixels along the edge of what they leave, as of
//! discs, the search follows their noise for thousands of passes. So they leave it: M follows the beam at its
//! closed form, as that of all pixels does, but the pulls of their measurements are 0, in products, in D and in draws
//! of noise. Their variance follows too, since that of any pixel is D⁻¹ and what S leaves open of the beam.
//!
//! They stay in it where they join components, where most measurements of an exposure are of such pixels, and where
//! cells are seen by them alone; between pixels only in wide parts of the sensor. In strips of a few pixels a pattern
//! of M and its inverse in L fit as well, and measurements there are lost (`lost.rs`). Lost is also the
//! measurement of a pixel that is measured once, where no other pixel sees its cells: its M follows any light. A pixel
//! of which all measurements are lost has no M.

use std::ops::Range;

use super::connected::connected;
use super::layout::Grid;
use super::lost::{FEW, Lost, Survey, wide};
use crate::connectivity::NONE;
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;

/// The columns of such pixels, by row of the sensor, and lost measurements.
#[derive(Debug, Default)]
pub(crate) struct Few {
    rows: Vec<Vec<usize>>,
    pub(crate) lost: Lost,
    /// Pixels with lost measurements and no others.
    pub(crate) lost_pixels: Vec<usize>,
    /// How many pixels follow the beam.
    pub(crate) pixels: usize,
    /// How many measurements the search does not use: theirs and lost ones.
    pub(crate) measurements: usize,
}

impl Few {
    /// Those of exposures at the shifts that were given; none of two exposures, nor where an offset is sought.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn of<T: Real>(
        exposures: &Exposures<'_, T>,
        grid: &Grid,
        control: &Control,
    ) -> Result<Self> {
        let count = exposures.count();
        let is_whole = exposures.used() == count * exposures.sensor().len();
        if count <= usize::from(FEW) || is_whole || exposures.offset() {
            return Ok(Self::default());
        }
        let mut survey = Survey::new(exposures, grid, control)?;
        let mut stay = Vec::new();
        loop {
            let times = survey.times()?;
            let mut leaves = leaving(&times, &survey)?;
            let lost_of =
                |leaves: &[bool]| survey.undetermined(|pixel| !leaves[pixel] && times[pixel] > 1);
            let mut lost = lost_of(&leaves)?;
            if stay.is_empty() {
                stay = wide(&lost, &times, exposures.sensor(), control)?;
            }
            let stays = |pixel: usize| stay[pixel] && times[pixel] == FEW;
            if (0..leaves.len()).any(|pixel| leaves[pixel] && stays(pixel)) {
                leaves.iter_mut().enumerate().for_each(|(pixel, leaves)| *leaves &= !stays(pixel));
                lost = lost_of(&leaves)?;
            }
            // Pixels that lose measurements may have few, whose cells are then seen by others.
            if !survey.lose(&lost) {
                return Ok(Self::new(&times, &leaves, survey));
            }
        }
    }

    fn new<T: Real>(times: &[u8], leaves: &[bool], survey: Survey<'_, '_, T>) -> Self {
        let cols = survey.exposures.sensor().cols;
        let leaving = (0..leaves.len()).filter(|&pixel| leaves[pixel]);
        let of_row = |row: &[bool]| (0..cols).filter(|&col| row[col]).collect();
        let rows = if leaves.contains(&true) { leaves } else { &[] };
        let mut lost_pixels = survey.lost.pixels(cols).concat();
        lost_pixels.retain(|&pixel| times[pixel] == 0);
        lost_pixels.sort_unstable();
        lost_pixels.dedup();
        Self {
            rows: rows.chunks(cols).map(of_row).collect(),
            lost_pixels,
            pixels: leaving.clone().count(),
            measurements: leaving.map(|pixel| usize::from(times[pixel])).sum::<usize>()
                + survey.lost.count(),
            lost: survey.lost,
        }
    }

    /// Sets the values of a row to 0 in them.
    pub(crate) fn clear<T: Default>(&self, row: usize, values: &mut [T]) {
        self.in_row(row).iter().for_each(|&col| values[col] = T::default());
    }

    /// Sets values of some columns of a row of an exposure to 0 in them and where measurements are lost.
    pub(crate) fn clear_all<T: Copy + Default>(
        &self,
        exposure: usize,
        row: usize,
        cols: &Range<usize>,
        values: &mut [T],
    ) {
        let own = self.in_row(row);
        let inside = own[own.partition_point(|col| *col < cols.start)..].iter();
        inside
            .take_while(|col| **col < cols.end)
            .for_each(|col| values[col - cols.start] = T::default());
        let lost = self.lost.in_row(exposure, row).iter().map(|col| *col as usize);
        lost.filter(|col| cols.contains(col))
            .for_each(|col| values[col - cols.start] = T::default());
    }

    /// Whether the search uses a measurement, if there is one.
    pub(crate) fn uses(&self, exposure: usize, row: usize, col: usize) -> bool {
        let is_lost = self.lost.in_row(exposure, row).binary_search(&(col as u32)).is_ok();
        !is_lost && self.in_row(row).binary_search(&col).is_err()
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

/// Which pixels with so many measurements leave the search.
fn leaving<T: Real>(times: &[u8], survey: &Survey<'_, '_, T>) -> Result<Vec<bool>> {
    let mut leaves: Vec<bool> = times.iter().map(|times| (1..=FEW).contains(times)).collect();
    if leaves.contains(&true) {
        stay_where_needed(&mut leaves, survey)?;
        let (width, mut shares) =
            (survey.exposures.sensor().cols, vec![[0; 2]; survey.exposures.count()]);
        survey.for_each_stretch(|k, row, cols| {
            let own = leaves[row * width..][cols.clone()].iter().filter(|leaves| **leaves).count();
            shares[k] = [shares[k][0] + own, shares[k][1] + cols.len()];
        })?;
        // What overlaps others so little is determined by such pixels.
        if shares.iter().any(|[leaving, used]| 2 * leaving > *used) {
            leaves.fill(false);
        }
    }
    Ok(leaves)
}

/// Keeps those that see several components of the others, and, where a cell is its own value, cells of none.
fn stay_where_needed<T: Real>(leaves: &mut [bool], survey: &Survey<'_, '_, T>) -> Result<()> {
    let Survey { exposures, grid, lost, control, .. } = survey;
    let (sensor, positions) = (exposures.sensor(), exposures.positions());
    let shifts = positions.on_grid(&positions.shifts);
    let labels = connected(exposures, grid, &shifts, lost, leaves, control)?.cells;
    let mut found = vec![NONE; sensor.len()];
    survey.for_each_stretch(|k, row, cols| {
        for col in cols {
            let pixel = row * sensor.cols + col;
            if !leaves[pixel] {
                continue;
            }
            for label in survey.cells(k, row, col, 0).map(|cell| labels[cell]) {
                if label == NONE {
                    leaves[pixel] &= grid.is_spline();
                } else {
                    leaves[pixel] &= found[pixel] == NONE || found[pixel] == label;
                    found[pixel] = label;
                }
            }
        }
    })
}

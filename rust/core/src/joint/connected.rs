//! Which pixels and cells the measurements of a joint fit connect.

use std::ops::Range;

use super::layout::Grid;
use super::lost::Lost;
use crate::connectivity::{Components, Edges, Stretches};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::geometry::{Rotation, View, whole_number};

/// The components of pixels and cells, without lost measurements and pixels that are left out, if any are.
///
/// Along an axis where all shifts differ by whole numbers of pixels, a pixel hangs on one value of the beam; else
/// on the two beside it, which is a necessary condition alone: then a Ritz value near 0 shows patterns that are not
/// determined.
pub(super) fn connected<T: Real>(
    exposures: &Exposures<'_, T>,
    grid: &Grid,
    shifts: &[[f64; 2]],
    lost: &Lost,
    left_out: &[bool],
    control: &Control,
) -> Result<Components> {
    let Grid { geometry, sensor, .. } = grid;
    let whole = [0, 1].map(|axis| {
        let apart = |d: &[f64; 2]| d[axis] - shifts[0][axis];
        shifts.iter().all(|d| whole_number(apart(d)).is_some())
    });
    let windows = grid.windows(shifts);
    let mut edges = Edges::new(sensor.len(), geometry.beam.len());
    let mut stretches = Stretches::new(*sensor, geometry.beam);
    let mut join = |exposure: usize, row: usize, cols: Range<usize>| {
        let window = &windows[exposure];
        let View { cells, rotation, .. } = geometry.views[window.view];
        let [down, along] = if window.swaps_axes { [whole[1], whole[0]] } else { whole };
        let (down, along) = (window.along_rows.around(down), window.along_cols.around(along));
        if rotation == Rotation::None && along.len() > 1 {
            // Pixels side by side see a cell in common.
            let seen = cols.start + window.col + along.start..cols.end + window.col + along.end - 1;
            let rows = row + window.row + down.start..row + window.row + down.end;
            return stretches.join(&mut edges, row, cols, rows, seen);
        }
        for col in cols {
            for i in down.clone() {
                for j in along.clone() {
                    let cell = cells.at(row + window.row + i, col + window.col + j);
                    edges.add(row * sensor.cols + col, cell);
                }
            }
        }
    };
    exposures.for_each_stretch(control, |exposure, row, cols| {
        lost.split(exposure, row, cols, |cols| {
            let Some(left_out) = left_out.get(row * sensor.cols..(row + 1) * sensor.cols) else {
                return join(exposure, row, cols);
            };
            let mut first = cols.start;
            for alike in left_out[cols].chunk_by(|a, b| a == b) {
                if !alike[0] {
                    join(exposure, row, first..first + alike.len());
                }
                first += alike.len();
            }
        });
    })?;
    edges.components(control)
}

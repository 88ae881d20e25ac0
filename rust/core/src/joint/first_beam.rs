//! The first beam of a joint fit, from values on another grid.

use super::layout::Grid;
use crate::control::Control;
use crate::error::Result;
use crate::frames::Shape;
use crate::parallel::Workers;

/// Values on another grid; 0 where nothing is known.
pub(crate) struct Source<F> {
    pub(crate) shape: Shape,
    /// The cell that the sensor's first pixel sees at shift 0 on the grid, not turned.
    pub(crate) origin: [i64; 2],
    /// The value at (row, column).
    pub(crate) value: F,
}

/// The values of `source` on the grid; cells around take what is beside them, since a spline reaches
/// beyond the cells that whole shifts see.
///
/// # Errors
/// [`Error::Cancelled`](crate::Error::Cancelled).
pub(crate) fn first_beam(
    grid: &Grid,
    source: &Source<impl Fn(usize, usize) -> f64 + Sync>,
    workers: &Workers,
    control: &Control,
) -> Result<Vec<f64>> {
    let (shape, origin) = (grid.geometry.beam, grid.geometry.origin);
    let from = source.shape;
    let [down, right] = [0, 1].map(|axis| source.origin[axis] - origin[axis] as i64);
    let beside = |place: usize, offset: i64, side: usize| {
        place.checked_add_signed(offset as isize).filter(|&place| place < side)
    };
    let mut beam = workers.filled(shape.len(), 0.0, control);
    workers.map_blocks(&mut beam, shape.cols, |row, cells| {
        let Some(row) = beside(row, down, from.rows) else { return };
        for (col, value) in cells.iter_mut().enumerate() {
            *value = beside(col, right, from.cols).map_or(0.0, |col| (source.value)(row, col));
        }
    });
    if !grid.is_spline() {
        return Ok(beam);
    }
    // As far as factors and margins reach beyond the nearest whole shift.
    let mut before = workers.filled(shape.len(), 0.0, control);
    for _ in 0..grid.width {
        control.check()?;
        before.copy_from_slice(&beam);
        workers.map_blocks(&mut beam, shape.cols, |row, cells| {
            let dark = cells.iter_mut().enumerate().filter(|(_, value)| **value == 0.0);
            for (col, value) in dark {
                let cell = row * shape.cols + col;
                let beside = [
                    (row > 0).then(|| cell - shape.cols),
                    (row + 1 < shape.rows).then(|| cell + shape.cols),
                    (col > 0).then(|| cell - 1),
                    (col + 1 < shape.cols).then(|| cell + 1),
                ];
                let lit = beside.into_iter().flatten().map(|cell| before[cell]);
                let lit = lit.filter(|&a| a != 0.0);
                let (sum, count) = lit.fold((0.0, 0.0), |(sum, count), a| (sum + a, count + 1.0));
                if count > 0.0 {
                    *value = sum / count;
                }
            }
        });
    }
    Ok(beam)
}

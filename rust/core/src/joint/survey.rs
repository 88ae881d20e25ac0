//! What the exposures show of the beam, in sums over blocks of pixels.

use super::system::System;
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;

/// What one exposure shows in a block of pixels, with the light e = c L: Σ w (M e)², and with its
/// slopes along the shift Σ w M² e ∂e and Σ w M² (∂e)².
#[derive(Clone, Copy, Default)]
pub(crate) struct Block {
    pub(crate) weight: f64,
    pub(crate) slope: [f64; 2],
    pub(crate) square: [f64; 2],
}

impl<T: Real> System<'_, '_, T> {
    /// Sums of each block of pixels and exposure, for blocks of `size`.
    pub(crate) fn blocks(&mut self, size: [usize; 2], control: &Control) -> Result<Vec<Block>> {
        self.pass.count += 1;
        let (sensor, count) = (self.pass.exposures.sensor(), self.pass.exposures.count());
        let (down, across) = (sensor.rows.div_ceil(size[0]), sensor.cols.div_ceil(size[1]));
        let beams = self.pass.views_of(&self.state.beam);
        let found = self.pass.workers.map(down, |block_row| {
            let mut workspace = self.pass.workspace();
            let mut found = vec![Block::default(); across * count];
            for row_index in block_row * size[0]..sensor.rows.min((block_row + 1) * size[0]) {
                control.check()?;
                let row = self.pass.row(row_index);
                self.pass.weigh_row(row_index, &mut workspace.weights);
                self.pass.see_beam(&beams, row_index, &mut workspace);
                for k in 0..count {
                    let mut few = self.pass.few.in_row(row_index).iter().peekable();
                    for col in 0..sensor.cols {
                        if few.next_if_eq(&&col).is_some() {
                            continue;
                        }
                        let at = k * sensor.cols + col;
                        let block = &mut found[col / size[1] * count + k];
                        let (weight, light) =
                            (workspace.weights[at] * row[col].powi(2), workspace.light[at]);
                        block.weight += weight * light * light;
                        for (axis, slopes) in workspace.slopes.iter().enumerate() {
                            let Some(slope) = slopes.get(at) else { continue };
                            let slope = self.pass.flux[k] * slope;
                            block.slope[axis] += weight * light * slope;
                            block.square[axis] += weight * slope * slope;
                        }
                    }
                }
            }
            Ok(found)
        });
        let found: Result<Vec<Vec<Block>>> = found.into_iter().collect();
        Ok(found?.concat())
    }
}

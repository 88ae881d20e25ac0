//! The arrays of one thread for a row of pixels, and what a pass gathers.

use super::kernel::Lines;
use crate::geometry::TAPS;
use crate::parallel::Add;

/// The arrays of one thread for a row of pixels.
pub(crate) struct Workspace {
    pub(crate) weights: Vec<f64>,
    /// c L of the row.
    pub(crate) light: Vec<f64>,
    /// Values of the row, then its pulls; before them the pulls of the rows before.
    pub(crate) lines: [Lines; TAPS],
    pub(crate) line: Vec<f64>,
    pub(crate) sums: [Vec<f64>; 4],
    /// ∂L/∂d of the row, by axis and exposure, where shifts are sought.
    pub(crate) slopes: [Vec<f64>; 2],
}

impl Workspace {
    /// Values of the row.
    pub(crate) fn values(&mut self) -> &mut Lines {
        &mut self.lines[TAPS - 1]
    }

    /// Begins a row with what changes of ln c, divided by c, and of d make of the light.
    pub(crate) fn begin(&mut self, shares: &[f64], moves: &[[f64; 2]]) {
        let cols = self.light.len() / shares.len();
        let values = &mut self.lines[TAPS - 1];
        values.clear();
        for (k, (light, share)) in self.light.chunks_exact(cols).zip(shares).enumerate() {
            let values = values.of_mut(k);
            if *share != 0.0 {
                Add { factor: *share, values: light, sums: &mut *values }.dispatch();
            }
            for (slopes, &factor) in self.slopes.iter().zip(moves.get(k).into_iter().flatten()) {
                Add { factor, values: &slopes[k * cols..][..cols], sums: &mut *values }.dispatch();
            }
        }
    }

    /// What the kernels need beside the row: the light, the weights, the values, and arrays for sums.
    pub(crate) fn parts(&mut self) -> (&[f64], &[f64], &mut Lines, &mut [Vec<f64>; 4]) {
        (&self.light, &self.weights, &mut self.lines[TAPS - 1], &mut self.sums)
    }
}

/// What one pass gathers besides the pulls: F, the largest change of M, and the slopes of ln c and d of
/// each exposure.
#[derive(Clone, Default)]
pub(crate) struct Sums {
    pub(crate) objective: f64,
    pub(crate) largest: f64,
    pub(crate) flux: Vec<f64>,
    pub(crate) shifts: Vec<[f64; 2]>,
}

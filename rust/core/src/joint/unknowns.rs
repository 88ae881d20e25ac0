//! The unknowns of the joint fit besides M and O, and what is known of the shifts among them.

use crate::exposures::Positions;

/// A shift that is known is one with this standard deviation, in pixels.
const EXACT_SHIFT: f64 = 1e-6;
/// How far a shift may come from where it was measured, in pixels: the grid reaches no further.
const FURTHEST: f64 = 0.99;

/// What is sought.
#[derive(Clone)]
pub(crate) struct State {
    /// The coefficients of the beam, cell by cell.
    pub(crate) beam: Vec<f64>,
    /// θ of the fluxes.
    pub(crate) theta: Vec<f64>,
    pub(crate) shifts: Vec<[f64; 2]>,
}

/// Where shifts were measured, and the weights of their squared deviations where noise is known.
#[derive(Clone)]
pub(crate) struct ShiftPrior {
    pub(crate) measured: Vec<[f64; 2]>,
    pub(crate) precisions: Vec<[f64; 2]>,
}

impl ShiftPrior {
    /// What is known of shifts that are to be refined.
    pub(crate) fn of(positions: &Positions) -> Option<Self> {
        let precision = |std: &[f64; 2]| std.map(|std| std.max(EXACT_SHIFT).powi(-2));
        positions.std.as_ref().map(|std| Self {
            measured: positions.shifts.clone(),
            precisions: std.iter().map(precision).collect(),
        })
    }

    /// Brings shifts back to where the grid reaches.
    pub(crate) fn keep_near(&self, shifts: &mut [[f64; 2]]) {
        let measured = self.measured.as_flattened();
        for (shift, measured) in shifts.as_flattened_mut().iter_mut().zip(measured) {
            *shift = shift.clamp(measured - FURTHEST, measured + FURTHEST);
        }
    }

    /// Changes of shifts less their mean, by the weights of the prior: to move all exposures moves
    /// but the beam, which no measurement determines.
    ///
    /// As Σ_j π_j (d_k − d_j)/Σ π: where one shift is all but exact, it is all but the mean, and what
    /// rounding leaves of their difference would pull at it with all its weight.
    pub(crate) fn centred(&self, shifts: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let shares = self.shares();
        let from_mean = |shift: &[f64; 2], axis: usize| -> f64 {
            let others = shares.iter().zip(shifts);
            others
                .map(|(share, other): (_, &[f64; 2])| share[axis] * (shift[axis] - other[axis]))
                .sum()
        };
        shifts.iter().map(|shift| [0, 1].map(|axis| from_mean(shift, axis))).collect()
    }

    /// What pulls at shifts pulls at them less their mean: the transpose of [`centred`](Self::centred).
    pub(crate) fn centred_pulls(&self, pulls: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let shares = self.shares();
        let left = |k: usize, axis: usize| -> f64 {
            let others = (0..pulls.len()).filter(|&j| j != k);
            others
                .map(|j| shares[j][axis] * pulls[k][axis] - shares[k][axis] * pulls[j][axis])
                .sum()
        };
        (0..pulls.len()).map(|k| [0, 1].map(|axis| left(k, axis))).collect()
    }

    /// The share of each shift in their mean.
    fn shares(&self) -> Vec<[f64; 2]> {
        let sum = [0, 1].map(|axis| self.precisions.iter().map(|p| p[axis]).sum::<f64>());
        self.precisions.iter().map(|p| [p[0] / sum[0], p[1] / sum[1]]).collect()
    }
}

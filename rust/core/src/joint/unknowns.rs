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
    /// The shifts on the grid of the beam.
    pub(crate) shifts: Vec<[f64; 2]>,
}

/// Where shifts were measured, and the weights of their squared deviations where noise is known.
#[derive(Clone)]
pub(crate) struct ShiftPrior {
    pub(crate) measured: Vec<[f64; 2]>,
    pub(crate) precisions: Vec<[f64; 2]>,
    /// The direction, of length 1, along which alone shifts are sought, if not along both axes.
    pub(crate) along: Option<[f64; 2]>,
}

impl ShiftPrior {
    /// What is known of shifts that are to be refined.
    pub(crate) fn of(positions: &Positions) -> Option<Self> {
        let precision = |std: &[f64; 2]| std.map(|std| std.max(EXACT_SHIFT).powi(-2));
        positions.std.as_ref().map(|std| Self {
            measured: positions.shifts.clone(),
            precisions: std.iter().map(precision).collect(),
            along: None,
        })
    }

    /// The part of shifts along the direction in which they are sought.
    fn projected(&self, shifts: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let Some([e, f]) = self.along else { return shifts.to_vec() };
        shifts.iter().map(|[row, col]| [e, f].map(|part| part * (e * row + f * col))).collect()
    }

    /// What this prior pulls at deviations of shifts, in units of the noise.
    pub(crate) fn pull(&self, deviations: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let weighted = deviations.iter().zip(&self.precisions);
        let pulls: Vec<[f64; 2]> = weighted.map(|(d, p)| [p[0] * d[0], p[1] * d[1]]).collect();
        // Along both axes what pulls at deviations less their mean has none.
        if self.along.is_some() { self.centred_pulls(&pulls) } else { pulls }
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
        let (shares, shifts) = (self.shares(), &self.projected(shifts));
        let from_mean = |shift: &[f64; 2], axis: usize| -> f64 {
            let others = shares.iter().zip(shifts);
            others
                .map(|(share, other): (_, &[f64; 2])| share[axis] * (shift[axis] - other[axis]))
                .sum()
        };
        let found: Vec<[f64; 2]> =
            shifts.iter().map(|shift| [0, 1].map(|axis| from_mean(shift, axis))).collect();
        self.projected(&found)
    }

    /// What pulls at shifts pulls at them less their mean: the transpose of [`centred`](Self::centred).
    pub(crate) fn centred_pulls(&self, pulls: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let (shares, pulls) = (self.shares(), &self.projected(pulls));
        let left = |k: usize, axis: usize| -> f64 {
            let others = (0..pulls.len()).filter(|&j| j != k);
            others
                .map(|j| shares[j][axis] * pulls[k][axis] - shares[k][axis] * pulls[j][axis])
                .sum()
        };
        let found: Vec<[f64; 2]> =
            (0..pulls.len()).map(|k| [0, 1].map(|axis| left(k, axis))).collect();
        self.projected(&found)
    }

    /// The share of each shift in their mean.
    fn shares(&self) -> Vec<[f64; 2]> {
        let sum = [0, 1].map(|axis| self.precisions.iter().map(|p| p[axis]).sum::<f64>());
        self.precisions.iter().map(|p| [p[0] / sum[0], p[1] / sum[1]]).collect()
    }
}

/// The prior of M, M = mean ± 1/√weight, in the pixels in weak light.
pub(crate) struct Prior {
    /// Row by row; 0 elsewhere.
    pub(crate) weights: Vec<f64>,
    pub(crate) mean: f64,
}

//! The arithmetic of the preconditioner and of the vectors of conjugate gradients, row by row.

use crate::padded::{LANES, chunk};

/// r ← r − a q; returns r · r/D, and adds M r to the sums of the two coarse rows around.
pub(super) struct Descend<'l> {
    pub(super) residual: &'l mut [f32],
    pub(super) step: f32,
    pub(super) product: &'l [f32],
    pub(super) inverse_diagonal: &'l [f32],
    pub(super) sensitivity: &'l [f32],
    /// Height of the lower coarse row's hats along this row.
    pub(super) height: f32,
    pub(super) above: &'l mut [f32],
    pub(super) below: &'l mut [f32],
    /// M r.
    pub(super) level: &'l mut [f32],
}

impl pulp::NullaryFnOnce for Descend<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let mut total = [0.0; LANES];
        let above = self.above.as_chunks_mut::<LANES>().0;
        let below = self.below.as_chunks_mut::<LANES>().0;
        let level = self.level.as_chunks_mut::<LANES>().0;
        let rows = self.residual.as_chunks_mut::<LANES>().0.iter_mut().zip(level);
        for (index, ((residual, level), (above, below))) in
            rows.zip(above.iter_mut().zip(below)).enumerate()
        {
            let (q, d) = (chunk(self.product, index), chunk(self.inverse_diagonal, index));
            let m = chunk(self.sensitivity, index);
            for i in 0..LANES {
                // A pixel that is not in the system takes no part.
                let r = if d[i] > 0.0 { residual[i] - self.step * q[i] } else { 0.0 };
                residual[i] = r;
                total[i] += r * (r * d[i]);
                level[i] = m[i] * r;
                let part = self.height * level[i];
                below[i] += part;
                above[i] += level[i] - part;
            }
        }
        total.iter().map(|&sum| f64::from(sum)).sum()
    }
}

/// x ← x + a p, then p ← z + b p with z = r/D + Φ y; returns the largest |z|.
pub(super) struct Direction<'l> {
    pub(super) x: &'l mut [f32],
    pub(super) direction: &'l mut [f32],
    pub(super) step: f32,
    pub(super) keep: f32,
    pub(super) residual: &'l [f32],
    pub(super) inverse_diagonal: &'l [f32],
    pub(super) sensitivity: &'l [f32],
    pub(super) height: f32,
    pub(super) above: &'l [f32],
    pub(super) below: &'l [f32],
    /// What hats times waves, or aggregates, have of y.
    pub(super) modulated: &'l [f32],
}

impl pulp::NullaryFnOnce for Direction<'_> {
    type Output = f32;

    #[inline(always)]
    fn call(self) -> f32 {
        let mut largest = [0.0_f32; LANES];
        let directions = self.direction.as_chunks_mut::<LANES>().0;
        let rows = self.x.as_chunks_mut::<LANES>().0.iter_mut().zip(directions);
        for (index, (x, direction)) in rows.enumerate() {
            let (r, d) = (chunk(self.residual, index), chunk(self.inverse_diagonal, index));
            let m = chunk(self.sensitivity, index);
            let (above, below) = (chunk(self.above, index), chunk(self.below, index));
            let modulated = chunk(self.modulated, index);
            for i in 0..LANES {
                let smooth = modulated[i] + above[i] + self.height * (below[i] - above[i]);
                let z = if d[i] > 0.0 { r[i] * d[i] + m[i] * smooth } else { 0.0 };
                x[i] += self.step * direction[i];
                direction[i] = z + self.keep * direction[i];
                largest[i] = largest[i].max(z.abs());
            }
        }
        largest.iter().copied().fold(0.0, f32::max)
    }
}

/// Σ s and Σ i s of sums s along columns i.
pub(super) struct Close<'l>(pub(super) &'l [f32]);

impl pulp::NullaryFnOnce for Close<'_> {
    type Output = [f64; 2];

    #[inline(always)]
    fn call(self) -> [f64; 2] {
        const SUMMED: usize = 8;
        let (chunks, last) = self.0.as_chunks::<SUMMED>();
        let [mut all, mut moments] = [[0.0; SUMMED]; 2];
        let mut places = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0];
        for sums in chunks {
            for i in 0..SUMMED {
                let sum = f64::from(sums[i]);
                all[i] += sum;
                moments[i] += places[i] * sum;
                places[i] += SUMMED as f64;
            }
        }
        for (i, &sum) in last.iter().enumerate() {
            all[i] += f64::from(sum);
            moments[i] += places[i] * f64::from(sum);
        }
        [all, moments].map(|sums| sums.iter().sum())
    }
}

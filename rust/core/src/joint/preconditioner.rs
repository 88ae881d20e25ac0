//! The preconditioner of the joint problem: a filter, the rim, and hats on a coarse grid over the beam.
//!
//! ```text
//! P⁻¹ r = χ K D⁻¹ K χ r + R (N + τ GᵀG)⁻¹ Rᵀ r + γ Φ A⁻¹ Φᵀ r
//! ```
//!
//! Coefficients of a spline are no values: what pixels see of a fine pattern is a third of it along each
//! axis, by the factors 1/6, 4/6, 1/6. K is a filter that is near to their inverse, so that D weighs
//! values. χ is 1 but at the rim of the beam, where R takes over (`joint/rim.rs`). The third part is that of
//! [`coarse`](crate::coarse), with the columns of Φ hats times the beam
//! (`joint/wide.rs`). Hats times waves stand beside them (`joint/waves.rs`), or aggregates of cells where waves are
//! many (`joint/aggregated.rs`). Fluxes and shifts stand beside the hats in the coarse problem: a tilt or a bend of M
//! that they could explain is distinguished from theirs by large scales alone.

use super::aggregated::Aggregated;
use super::rim::Rim;
use super::survey::Block;
use super::system::{Precision, System};
use super::waves::Waves;
use super::wide::Wide;
use crate::coarse::{Coarse, DAMPING, Entry, Hats, spacing};
use crate::control::Control;
use crate::error::Result;
use crate::frames::{Real, Shape};
use crate::parallel::{Value, Workers};

/// Blocks of pixels along the distance of two hats.
const BLOCKS: usize = 3;
/// Rows of cells that a thread takes at a time.
const BAND: usize = 32;
/// Cells with less than this share of the mean weight are as good as unseen.
const FAINTEST: f64 = 1e-12;
/// K along an axis, 1 + t/8 + 2t²/25 with t = 2 − 2 cos q: 2.8 at the finest pattern where the inverse of
/// 1/6, 4/6, 1/6 is 3.
const FILTER: [f32; 5] = [0.08, -0.445, 1.73, -0.445, 0.08];

/// What is left of 1/D so many cells away from the rim: nothing on it, and less beside it, since a filter that is
/// cut off takes fine patterns there for three times what they are.
pub(super) const FROM_RIM: [f32; 3] = [0.0, 0.5, 0.7];

/// Its arrays are in single precision, in units of an ordinary light and weight.
pub(crate) struct Preconditioner {
    wide: Wide,
    short: ShortScale,
    /// 1/D of cells that are not of the rim, less beside it ([`FROM_RIM`]); else 0.
    inverse: Vec<f32>,
    rim: Rim,
    /// 1/D of θ and shifts; 0 for what no measurement determines.
    params: Vec<f64>,
    coarse: Coarse,
    /// Whether the beam is a spline.
    filters: bool,
}

impl Preconditioner {
    pub(crate) fn new<T: Real>(system: &mut System<'_, '_, T>, control: &Control) -> Result<Self> {
        let geometry = system.pass.exposures.geometry();
        let spacing = spacing(geometry);
        let (beam, origin) = (system.pass.grid.geometry.beam, system.pass.grid.geometry.origin);
        let hats = Hats::new(beam, spacing);
        let size = spacing.map(|spacing| (spacing / BLOCKS).max(1));
        let aggregated = Aggregated::where_waves_are_many(system, control)?;
        let blocks = system.blocks(size, control)?;
        let (sensor, count) = (system.pass.exposures.sensor(), system.pass.exposures.count());
        let params = system.fluxes.columns.len();
        let across = sensor.cols.div_ceil(size[1]);
        // The cell that the middle of a block sees.
        let seen = |index: usize, k: usize| {
            let corner = [index / across * size[0], index % across * size[1]];
            let centre = |axis: usize, side: usize| {
                let end = (corner[axis] + size[axis]).min(side) - 1;
                (corner[axis] + end) as f64 / 2.0
            };
            let place = system.pass.grid.place(k, [centre(0, sensor.rows), centre(1, sensor.cols)]);
            [0, 1].map(|axis| place[axis] + system.state.shifts[k][axis] + origin[axis] as f64)
        };
        let entry = |index: usize, k: usize, block: &Block| {
            let [row, col] = seen(index, k);
            let columns = system.fluxes.columns.iter().enumerate();
            let mut others: Vec<_> =
                columns.map(|(index, column)| (hats.count() + index, column[k])).collect();
            if system.seeks_shifts() {
                let first = hats.count() + params + 2 * k;
                others.extend([0, 1].map(|axis| (first + axis, block.slope[axis] / block.weight)));
            }
            Entry { weight: block.weight, hats: hats.over(row, col), others }
        };
        let entries = blocks.chunks_exact(count).enumerate().map(|(index, blocks)| {
            let lit = blocks.iter().enumerate().filter(|(_, block)| block.weight > 0.0);
            lit.map(|(k, block)| entry(index, k, block)).collect()
        });
        // What a block's mean slope leaves of its mean square is the parameter's own.
        let mut own = system.precisions();
        let mut whole = own.clone();
        for (index, block) in blocks.iter().enumerate().filter(|(_, block)| block.weight > 0.0) {
            let k = index % count;
            for (whole, column) in whole.iter_mut().zip(&system.fluxes.columns) {
                *whole += block.weight * column[k] * column[k];
            }
            if system.seeks_shifts() {
                for axis in 0..2 {
                    let place = params + 2 * k + axis;
                    whole[place] += block.square[axis];
                    own[place] += block.square[axis] - block.slope[axis].powi(2) / block.weight;
                }
            }
        }
        let of_prior = prior_of_hats(system, &hats);
        let coarse = Coarse::of_blocks(&hats, &of_prior, &own, entries, control)?;
        control.check()?;
        let waves = || ShortScale::Waves(Waves::new(system, &blocks, seen));
        let short = aggregated.map_or_else(waves, ShortScale::Aggregated);
        let rim = Rim::new(system, control)?;
        let invert = |d: f64| if d > 0.0 { 1.0 / d } else { 0.0 };
        let weights = &system.weights;
        let least = FAINTEST * system.total_weight() / weights.len() as f64;
        let mut inverse = around(&rim, beam);
        for (inverse, d) in inverse.iter_mut().zip(weights) {
            *inverse *= if f64::from(*d) > least { 1.0 / d } else { 0.0 };
        }
        let params = whole.into_iter().map(invert).collect();
        let (wide, filters) = (Wide::new(hats, system, control), system.pass.grid.is_spline());
        Ok(Self { wide, short, inverse, rim, params, coarse, filters })
    }

    /// Whether the coarse matrix has a factor.
    pub(crate) const fn sees_large_scales(&self) -> bool {
        self.coarse.is_factorised()
    }

    /// z = P⁻¹ r.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn apply<N: Precision, T: Real>(
        &self,
        system: &System<'_, '_, T>,
        r: &[N],
        z: &mut Vec<N>,
        control: &Control,
    ) -> Result<()> {
        let (workers, cols) = (system.pass.workers, system.pass.grid.geometry.beam.cols);
        let (of_cells, of_params) = r.split_at(self.inverse.len());
        debug_assert_eq!(of_params.len(), self.params.len());
        let [inward, outward, energy] = self.scales::<N, T>(system);
        let of_other = system.unit_of_other_slopes::<N>();
        let of_params: Vec<f64> = of_params.iter().map(|&r| of_other * r.into()).collect();
        let mut heights = self.wide.gather(of_cells, workers);
        heights.iter_mut().for_each(|height| *height *= inward * energy);
        heights.extend_from_slice(&of_params);
        self.coarse.correct(&mut heights, DAMPING);
        control.check()?;
        let of_short = self.short.correct(&self.wide, of_cells, [inward, energy], workers);
        control.check()?;
        let (of_hats, coarse) = heights.split_at_mut(self.wide.hats.count());
        of_hats.iter_mut().for_each(|height| *height *= outward);
        z.resize(of_cells.len(), N::default());
        workers.map_blocks(z, BAND * cols, |band, part| {
            if control.is_cancelled() {
                return;
            }
            let first = band * BAND;
            if self.filters {
                let (inverse, scales) = (&self.inverse[..], [inward, outward]);
                let z = &mut *part;
                let filtered = Filtered { r: of_cells, inverse, cols, first, scales, z };
                pulp::Arch::new().dispatch(filtered);
            } else {
                let own = of_cells[first * cols..].iter().zip(&self.inverse[first * cols..]);
                for (z, (&r, &inverse)) in part.iter_mut().zip(own) {
                    *z = N::of(outward * f64::from(inverse) * (inward * r.into()));
                }
            }
            self.wide.spread(of_hats, first, part);
            self.short.spread(&self.wide, &of_short, first, outward, part);
        });
        control.check()?;
        self.rim.add(of_cells, z, system.units::<N>(), workers);
        let params = of_params.iter().zip(&self.params).zip(coarse);
        z.extend(params.map(|((r, inverse), height)| N::of(r * inverse + *height)));
        // A multiple of the beam is no error, nor is what moves all exposures alike; what rounding
        // leaves of them must not grow.
        system.take_scale_out(&mut z[..self.inverse.len()]);
        let shifts = &mut z[self.inverse.len() + system.fluxes.columns.len()..];
        let moves: Vec<f64> = shifts.iter().map(|&shift| shift.into()).collect();
        let moves = system.centred(&moves);
        shifts.iter_mut().zip(moves.as_flattened()).for_each(|(z, &shift)| *z = N::of(shift));
        Ok(())
    }

    /// What brings r into the units of single precision, z out of them, and w₀ times the square of an ordinary
    /// light, which the matrices of hats and waves are in.
    fn scales<N: Precision, T: Real>(&self, system: &System<'_, '_, T>) -> [f64; 3] {
        let ([of_z, of_r], [light, weight]) = (system.units::<N>(), system.ordinary);
        [of_r / (weight * light), light / of_z, weight * light * light]
    }

    /// The part of waves of P⁻¹ r.
    #[cfg(test)]
    pub(super) fn waves_of<T: Real>(&self, system: &System<'_, '_, T>, r: &[f64]) -> Vec<f64> {
        let [inward, outward, energy] = self.scales::<f64, T>(system);
        let of_short = self.short.correct(&self.wide, r, [inward, energy], system.pass.workers);
        let mut found = vec![0.0; r.len()];
        self.short.spread(&self.wide, &of_short, 0, outward, &mut found);
        found
    }
}

/// What sees the waves that exposures barely constrain.
enum ShortScale {
    Waves(Waves),
    Aggregated(Aggregated),
}

impl ShortScale {
    /// The heights that r makes of them, or what waves have of those at every column.
    fn correct<N: Value>(
        &self,
        wide: &Wide,
        r: &[N],
        [inward, energy]: [f64; 2],
        workers: &Workers,
    ) -> Vec<f32> {
        match self {
            Self::Waves(waves) => waves.correct(wide, r, [inward, energy], workers),
            Self::Aggregated(aggregated) => aggregated.correct(wide, r, inward, workers),
        }
    }

    /// Adds them to rows of cells from `first` on.
    fn spread<N: Value>(
        &self,
        wide: &Wide,
        heights: &[f32],
        first: usize,
        outward: f64,
        z: &mut [N],
    ) {
        match self {
            Self::Waves(waves) => waves.spread(wide, heights, first, outward, z),
            Self::Aggregated(aggregated) => aggregated.spread(wide, heights, first, outward, z),
        }
    }
}

/// χ K D⁻¹ K χ r on rows of cells from `first` on, times `inward` and `outward`.
struct Filtered<'s, N> {
    r: &'s [N],
    inverse: &'s [f32],
    cols: usize,
    first: usize,
    scales: [f64; 2],
    z: &'s mut [N],
}

impl<N: Value> pulp::NullaryFnOnce for Filtered<'_, N> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { r, inverse, cols, first, scales, z } = self;
        let around = FILTER.len() / 2;
        let [mut before, mut between] = [FilterRows::new(cols), FilterRows::new(cols)];
        let [inward, outward] = scales.map(N::of);
        let mut found = vec![0.0; cols];
        // Rows that come in, counted from as many above as both filters reach.
        for step in 0..z.len() / cols + 4 * around {
            // A row above the first one wraps to beyond the last.
            let row = (first + step).wrapping_sub(2 * around);
            let line = before.next();
            if row < r.len() / cols {
                let cells = row * cols..(row + 1) * cols;
                let input = r[cells.clone()].iter().zip(&inverse[cells]);
                for (line, (&r, &d)) in line.iter_mut().zip(input) {
                    *line = if d > 0.0 { Into::<f64>::into(inward * r) as f32 } else { 0.0 };
                }
            } else {
                line.fill(0.0);
            }
            let row = row.wrapping_sub(around);
            let line = between.next();
            if row < r.len() / cols {
                before.filter(line);
                let of_row = &inverse[row * cols..(row + 1) * cols];
                line.iter_mut().zip(of_row).for_each(|(line, d)| *line *= d);
            } else {
                line.fill(0.0);
            }
            if let Some(own) = step.checked_sub(4 * around) {
                between.filter(&mut found);
                let output = found.iter().zip(&inverse[(first + own) * cols..]);
                for (z, (&found, &d)) in z[own * cols..(own + 1) * cols].iter_mut().zip(output) {
                    *z = outward * N::of(f64::from(if d > 0.0 { found } else { 0.0 }));
                }
            }
        }
    }
}

/// The share of 1/D that each cell keeps.
pub(super) fn around(rim: &Rim, Shape { rows, cols }: Shape) -> Vec<f32> {
    let mut shares = vec![1.0_f32; rows * cols];
    let near = |at: usize, end: usize| {
        let reach = FROM_RIM.len() - 1;
        at.saturating_sub(reach)..(at + reach + 1).min(end)
    };
    for (row, col) in rim.cells().map(|cell| (cell / cols, cell % cols)) {
        for other in near(row, rows) {
            for beside in near(col, cols) {
                let share = &mut shares[other * cols + beside];
                *share = share.min(FROM_RIM[other.abs_diff(row).max(beside.abs_diff(col))]);
            }
        }
    }
    shares
}

/// What the prior of M adds to the hats' own elements, M² D λ/(D + λ) of each pixel in the middle of the cells
/// that it sees; empty without one.
fn prior_of_hats<T: Real>(system: &System<'_, '_, T>, hats: &Hats) -> Vec<f64> {
    let Some(prior) = &system.prior else { return Vec::new() };
    let (cols, count) = (system.pass.exposures.sensor().cols, system.pass.exposures.count());
    let origin = system.pass.grid.geometry.origin;
    let (mut own, information) = (vec![0.0; hats.count()], system.information());
    let [sensitivity, _] = system.pixels();
    let weak = prior.weights.iter().enumerate().filter(|(_, weight)| **weight > 0.0);
    for (pixel, weight) in weak {
        let d = information[pixel];
        let share = sensitivity[pixel].powi(2) * d * weight / (d + weight) / count as f64;
        for k in 0..count {
            let place = system.pass.grid.place(k, [pixel / cols, pixel % cols].map(|x| x as f64));
            let [row, col] =
                [0, 1].map(|i| place[i] + system.state.shifts[k][i] + origin[i] as f64);
            hats.over(row, col).into_iter().for_each(|(hat, height)| own[hat] += share * height);
        }
    }
    own
}

/// As many rows of cells as the filter takes.
struct FilterRows {
    rows: [Vec<f32>; FILTER.len()],
    /// One row, with zeros around.
    line: Vec<f32>,
}

impl FilterRows {
    fn new(cols: usize) -> Self {
        let rows = [(); FILTER.len()].map(|()| vec![0.0; cols]);
        Self { rows, line: vec![0.0; cols + FILTER.len() - 1] }
    }

    /// A buffer for the row that comes in; the first one goes.
    fn next(&mut self) -> &mut [f32] {
        self.rows.rotate_left(1);
        &mut self.rows[FILTER.len() - 1]
    }

    /// K at the row in the middle.
    #[inline(always)]
    fn filter(&mut self, found: &mut [f32]) {
        let cols = found.len();
        let [s, t, u, v, w] = FILTER;
        let [a, b, c, d, e] = self.rows.each_ref().map(|row| &row[..cols]);
        let inner = &mut self.line[FILTER.len() / 2..][..cols];
        for col in 0..cols {
            inner[col] = s * a[col] + t * b[col] + u * c[col] + v * d[col] + w * e[col];
        }
        let [a, b, c, d, e] = [0, 1, 2, 3, 4].map(|from| &self.line[from..from + cols]);
        for col in 0..cols {
            found[col] = s * a[col] + t * b[col] + u * c[col] + v * d[col] + w * e[col];
        }
    }
}

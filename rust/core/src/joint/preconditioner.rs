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
//! (`joint/wide.rs`). Fluxes and shifts stand beside the hats in the coarse problem: a tilt or a bend of M
//! that they could explain is distinguished from theirs by large scales alone.

use super::rim::Rim;
use super::survey::Block;
use super::system::System;
use super::waves::Waves;
use super::wide::Wide;
use crate::coarse::{Coarse, DAMPING, Entry, Hats, spacing};
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;

/// Blocks of pixels along the distance of two hats.
const BLOCKS: usize = 3;
/// Rows of cells that a thread takes at a time.
const BAND: usize = 32;
/// Cells with less than this share of the mean weight are as good as unseen.
const FAINTEST: f64 = 1e-12;
/// K along an axis, 1 + t/8 + 2t²/25 with t = 2 − 2 cos q: 2.8 at the finest pattern where the inverse of
/// 1/6, 4/6, 1/6 is 3.
const FILTER: [f64; 5] = [0.08, -0.445, 1.73, -0.445, 0.08];

pub(crate) struct Preconditioner {
    wide: Wide,
    waves: Waves,
    /// 1/D of cells that are not of the rim, else 0.
    inverse: Vec<f64>,
    rim: Rim,
    /// 1/D of θ and shifts; 0 for what no measurement determines.
    params: Vec<f64>,
    coarse: Coarse,
    /// Cells of a row.
    cols: usize,
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
        let waves = Waves::new(system, &blocks, seen);
        let rim = Rim::new(system, control)?;
        let invert = |d: f64| if d > 0.0 { 1.0 / d } else { 0.0 };
        let weights = &system.weights;
        let least = FAINTEST * weights.iter().sum::<f64>() / weights.len() as f64;
        let invert_seen = |&d: &f64| if d > least { 1.0 / d } else { 0.0 };
        let mut inverse: Vec<f64> = weights.iter().map(invert_seen).collect();
        rim.cells().for_each(|cell| inverse[cell] = 0.0);
        let params = whole.into_iter().map(invert).collect();
        let (wide, filters) = (Wide::new(hats, system, control), system.pass.grid.is_spline());
        let cols = system.pass.grid.geometry.beam.cols;
        Ok(Self { wide, waves, inverse, rim, params, coarse, cols, filters })
    }

    /// Whether the coarse matrix has a factor.
    pub(crate) const fn sees_large_scales(&self) -> bool {
        self.coarse.is_factorised()
    }

    /// z = P⁻¹ r.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn apply<T: Real>(
        &self,
        system: &System<'_, '_, T>,
        r: &[f64],
        z: &mut Vec<f64>,
        control: &Control,
    ) -> Result<()> {
        let (workers, cols) = (system.pass.workers, system.pass.grid.geometry.beam.cols);
        let (of_cells, of_params) = r.split_at(self.inverse.len());
        let mut heights = self.wide.gather(of_cells, workers);
        heights.extend_from_slice(of_params);
        self.coarse.correct(&mut heights, DAMPING);
        control.check()?;
        let lines = self.waves.correct(&self.wide, of_cells, workers);
        control.check()?;
        z.resize(of_cells.len(), 0.0);
        workers.map_blocks(z, BAND * cols, |band, part| {
            if control.is_cancelled() {
                return;
            }
            let first = band * BAND;
            if self.filters {
                self.filter(of_cells, first, part);
            } else {
                let own = of_cells[first * cols..].iter().zip(&self.inverse[first * cols..]);
                part.iter_mut().zip(own).for_each(|(z, (r, inverse))| *z = r * inverse);
            }
            self.wide.spread(&heights, first, part);
            self.waves.spread(&self.wide, &lines, first, part);
        });
        control.check()?;
        self.rim.add(of_cells, z, workers);
        let coarse = &heights[self.wide.hats.count()..];
        let params = of_params.iter().zip(&self.params).zip(coarse);
        z.extend(params.map(|((r, inverse), height)| r * inverse + height));
        // A multiple of the beam is no error, nor is what moves all exposures alike; what rounding
        // leaves of them must not grow.
        system.take_scale_out(&mut z[..self.inverse.len()]);
        let shifts = &mut z[self.inverse.len() + system.fluxes.columns.len()..];
        let moves = system.centred(shifts);
        shifts.copy_from_slice(moves.as_flattened());
        Ok(())
    }

    /// The part of waves of P⁻¹ r.
    #[cfg(test)]
    pub(super) fn waves_of<T: Real>(&self, system: &System<'_, '_, T>, r: &[f64]) -> Vec<f64> {
        let lines = self.waves.correct(&self.wide, r, system.pass.workers);
        let mut found = vec![0.0; r.len()];
        self.waves.spread(&self.wide, &lines, 0, &mut found);
        found
    }

    /// χ K D⁻¹ K χ r on rows of cells from `first` on.
    fn filter(&self, r: &[f64], first: usize, z: &mut [f64]) {
        let (cols, around) = (self.cols, FILTER.len() / 2);
        let [mut before, mut between] = [(); 2].map(|()| FilterRows::new(cols));
        let mut found = vec![0.0; cols];
        // Rows that come in, counted from as many above as both filters reach.
        for step in 0..z.len() / cols + 4 * around {
            let line = before.next();
            let inside = |row: Option<usize>| row.filter(|&row| row < r.len() / cols);
            let of = |row: usize| row * cols..(row + 1) * cols;
            match inside((first + step).checked_sub(2 * around)).map(of) {
                Some(row) => {
                    let input = r[row.clone()].iter().zip(&self.inverse[row]);
                    let seen = |(r, d): (&f64, &f64)| if *d > 0.0 { *r } else { 0.0 };
                    line.iter_mut().zip(input).for_each(|(line, input)| *line = seen(input));
                }
                None => line.fill(0.0),
            }
            let line = between.next();
            match inside((first + step).checked_sub(3 * around)).map(of) {
                Some(row) => {
                    before.filter(line);
                    line.iter_mut().zip(&self.inverse[row]).for_each(|(line, d)| *line *= d);
                }
                None => line.fill(0.0),
            }
            if let Some(own) = step.checked_sub(4 * around) {
                between.filter(&mut found);
                let row = of(first + own);
                let output = found.iter().zip(&self.inverse[row]);
                for (z, (found, d)) in z[of(own)].iter_mut().zip(output) {
                    *z = if *d > 0.0 { *found } else { 0.0 };
                }
            }
        }
    }
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
    rows: [Vec<f64>; FILTER.len()],
    /// One row, with zeros around.
    line: Vec<f64>,
}

impl FilterRows {
    fn new(cols: usize) -> Self {
        let rows = [(); FILTER.len()].map(|()| vec![0.0; cols]);
        Self { rows, line: vec![0.0; cols + FILTER.len() - 1] }
    }

    /// A buffer for the row that comes in; the first one goes.
    fn next(&mut self) -> &mut [f64] {
        self.rows.rotate_left(1);
        &mut self.rows[FILTER.len() - 1]
    }

    /// K at the row in the middle.
    fn filter(&mut self, found: &mut [f64]) {
        let Self { rows, line } = self;
        let rows = rows.each_ref().map(|row| &row[..]);
        pulp::Arch::new().dispatch(Filter { rows, line, found });
    }
}

struct Filter<'s> {
    rows: [&'s [f64]; FILTER.len()],
    line: &'s mut [f64],
    found: &'s mut [f64],
}

impl pulp::NullaryFnOnce for Filter<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let cols = self.found.len();
        let [s, t, u, v, w] = FILTER;
        let [a, b, c, d, e] = self.rows.map(|row| &row[..cols]);
        let line = &mut self.line[..cols + FILTER.len() - 1];
        let inner = &mut line[FILTER.len() / 2..][..cols];
        for col in 0..cols {
            inner[col] = s * a[col] + t * b[col] + u * c[col] + v * d[col] + w * e[col];
        }
        let [a, b, c, d, e] = [0, 1, 2, 3, 4].map(|from| &line[from..from + cols]);
        for col in 0..cols {
            self.found[col] = s * a[col] + t * b[col] + u * c[col] + v * d[col] + w * e[col];
        }
    }
}

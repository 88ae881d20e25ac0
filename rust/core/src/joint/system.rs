//! The linear problem of one step, with the pixels eliminated.
//!
//! The unknowns are the beam's coefficients a, the fluxes and the shifts; M, and the offset O where
//! one is sought, follow at their closed forms. With the light e = c L that an exposure shows at
//! a pixel, its change u = c M (B·a′ + L·ln c′ + ∇L·d′) and Q = 1 − e(eᵀwe)⁻¹eᵀw, which takes out
//! what M can follow (and O likewise),
//!
//! ```text
//! S x = Jᵀ w Q J x + priors,   J x = u
//! ```
//!
//! (Golub and Pereyra 1973, with the simplification of Kaufman 1975.) Two passes make a product: one
//! along rows of pixels, which all exposures share, and one along rows of cells, which collects.

use super::flux::Fluxes;
use super::grid::{Grid, TAPS, Taps, Window};
use super::kernel::{Add, Follow, Interpolate, Row, Solve, Spread};
use super::penalty::Penalty;
use crate::control::Control;
use crate::error::Result;
use crate::frames::{Real, Shape};
use crate::geometry::{Rotation, View};
use crate::model::{Model, Stretch};
use crate::parallel::{Workers, dot};

/// Cells between slopes that are compared.
const APART: usize = 8;
/// Binomial factors of standard deviation 1.
const SMOOTH: [f64; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];
/// Rows that a thread takes at a time.
const BAND: usize = 8;
/// A determinant that is rounding alone, of two columns that a pixel cannot tell from each other.
const SINGULAR: f64 = 1e-12;

/// What is sought.
#[derive(Clone)]
pub(super) struct State {
    /// The coefficients of the beam, cell by cell.
    pub(super) beam: Vec<f64>,
    /// θ of the fluxes.
    pub(super) theta: Vec<f64>,
    pub(super) shifts: Vec<[f64; 2]>,
}

/// Where shifts were measured, and the weights of their squared deviations where noise is known.
pub(super) struct ShiftPrior {
    pub(super) measured: Vec<[f64; 2]>,
    pub(super) precisions: Vec<[f64; 2]>,
}

/// The problem at a state.
pub(super) struct System<'m, 'a, T> {
    pub(super) model: &'m Model<'a, T>,
    pub(super) workers: &'m Workers,
    pub(super) grid: Grid,
    pub(super) fluxes: Fluxes,
    pub(super) shift_prior: Option<ShiftPrior>,
    pub(super) with_offset: bool,
    /// F of the measurements alone, at the state last linearised.
    pub(super) misfit: f64,
    /// The variance of a measurement of weight 1.
    pub(super) unit: f64,
    pub(super) state: State,
    /// c of each exposure.
    pub(super) flux: Vec<f64>,
    windows: Vec<Window>,
    /// [`Row`] by row.
    rows: Vec<f64>,
    /// What the pixels pull, along columns of the views: by row and exposure.
    pulls: Vec<f64>,
    /// Σ w c² M² of the pixels that see a cell, by their factors.
    pub(super) weights: Vec<f64>,
    /// D a/(aᵀD a) with these weights D and the coefficients a.
    scale: Vec<f64>,
    pub(super) penalty: Option<Penalty>,
}

/// What one exposure shows in a block of pixels, with the light e = c L: Σ w (M e)², and with its
/// slopes along the shift Σ w M² e ∂e and Σ w M² (∂e)².
#[derive(Clone, Copy, Default)]
pub(super) struct Block {
    pub(super) weight: f64,
    pub(super) slope: [f64; 2],
    pub(super) square: [f64; 2],
}

/// Room of one thread for a row of pixels.
pub(super) struct Room {
    pub(super) weights: Vec<f64>,
    pub(super) values: Vec<f64>,
    /// A row of coefficients, or one of pixels with zeros around.
    row: Vec<f64>,
    pub(super) sums: [Vec<f64>; 2],
    slope: Vec<f64>,
}

/// What one pass gathers besides the pulls: F, and the slopes of ln c and d of each exposure.
#[derive(Clone, Default)]
pub(super) struct Sums {
    objective: f64,
    flux: Vec<f64>,
    shifts: Vec<[f64; 2]>,
}

impl<'m, 'a, T: Real> System<'m, 'a, T> {
    pub(super) fn new(
        model: &'m Model<'a, T>,
        grid: Grid,
        fluxes: Fluxes,
        with_offset: bool,
        state: State,
        workers: &'m Workers,
        control: &Control,
    ) -> Self {
        let (sensor, count) = (model.sensor(), model.count());
        let wide = sensor.cols + grid.width - 1;
        Self {
            model,
            workers,
            fluxes,
            shift_prior: None,
            with_offset,
            misfit: 0.0,
            unit: 1.0,
            flux: model.flux.clone(),
            windows: grid.windows(&state.shifts),
            rows: workers.filled(sensor.rows * Row::length(count, sensor.cols), 0.0, control),
            pulls: workers.filled(sensor.rows * count * wide, 0.0, control),
            weights: Vec::new(),
            scale: Vec::new(),
            penalty: None,
            state,
            grid,
        }
    }

    /// Values of a vector of unknowns: cells, θ, shifts.
    pub(super) fn size(&self) -> usize {
        let shifts = if self.shift_prior.is_some() { 2 * self.model.count() } else { 0 };
        self.state.beam.len() + self.fluxes.columns.len() + shifts
    }

    /// Finds M at the state, F there, and half the slope of −F along the unknowns.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled), here and below.
    pub(super) fn linearise(&mut self, tau: f64, control: &Control) -> Result<(f64, Vec<f64>)> {
        self.windows = self.grid.windows(&self.state.shifts);
        let logs = self.fluxes.spread(&self.state.theta, self.model.count());
        self.flux = self.model.flux.iter().zip(&logs).map(|(c, log)| c * log.exp()).collect();
        let views = self.views_of(&self.state.beam);
        let slopes = self.shift_prior.is_some().then_some(&views[..]);
        let sums = self.pass(slopes, control, |system, row_index, row, room| {
            let cols = system.model.sensor().cols;
            for (k, flux) in system.flux.iter().enumerate() {
                let light = &mut row.light[k * cols..][..cols];
                let window = &system.windows[k];
                let taps = [&window.along_rows.values, &window.along_cols.values];
                system.interpolate(&views, window, row_index, taps, &mut room.row, light);
                light.iter_mut().for_each(|light| *light *= flux);
                system.measure(k, row_index, room);
            }
            pulp::Arch::new().dispatch(Solve {
                row,
                fluxes: &system.flux,
                weights: &room.weights,
                values: &mut room.values,
                with_offset: system.with_offset,
                singular: SINGULAR,
            })
        })?;
        let mut objective = sums.objective;
        self.misfit = objective;
        let mut slope = self.collect(sums);
        self.weigh(tau, control)?;
        if let Some(penalty) = &self.penalty {
            let beam = &self.state.beam;
            let cells = &mut slope[..beam.len()];
            objective += penalty.add(beam, beam.clone(), -1.0, cells, self.workers);
        }
        objective += self.pull_by_priors(&mut slope);
        Ok((objective, slope))
    }

    /// The pull of the priors, added to a slope; returns their share of F.
    fn pull_by_priors(&self, slope: &mut [f64]) -> f64 {
        let cells = self.state.beam.len();
        let mut objective = 0.0;
        let params = self.fluxes.columns.len();
        let of_flux = slope[cells..].iter_mut().zip(&self.state.theta).zip(&self.fluxes.precisions);
        for ((slope, theta), precision) in of_flux {
            *slope -= self.unit * precision * theta;
            objective += self.unit * precision * theta * theta;
        }
        if let Some(prior) = &self.shift_prior {
            let known = prior.measured.as_flattened().iter().zip(prior.precisions.as_flattened());
            let found = self.state.shifts.as_flattened();
            let of_shifts = slope[cells + params..].iter_mut().zip(found).zip(known);
            for ((slope, found), (measured, precision)) in of_shifts {
                let deviation = found - measured;
                *slope -= self.unit * precision * deviation;
                objective += self.unit * precision * deviation * deviation;
            }
        }
        objective
    }

    /// How many pixels have a measurement.
    pub(super) fn measured(&self) -> usize {
        let mut count = 0;
        self.for_rows(|[_, _, inverse, ..]| count += inverse.iter().filter(|i| **i > 0.0).count());
        count
    }

    /// The pixels whose measurements do not tell an offset from a gain, where one is sought.
    pub(super) fn untold(&self) -> Vec<usize> {
        let (mut untold, mut first) = (Vec::new(), 0);
        if self.with_offset {
            self.for_rows(|[_, _, gain, _, offset, _]| {
                let pixels = gain.iter().zip(offset).enumerate();
                let told = pixels.filter(|(_, (gain, offset))| **gain > 0.0 && **offset == 0.0);
                untold.extend(told.map(|(col, _)| first + col));
                first += gain.len();
            });
        }
        untold
    }

    /// S x, and the change of M that goes with x in each [`Row`].
    pub(super) fn multiply(&mut self, x: &[f64], control: &Control) -> Result<Vec<f64>> {
        let cells = self.state.beam.len();
        let params = self.fluxes.columns.len();
        let logs = self.fluxes.spread(&x[cells..cells + params], self.model.count());
        let moves = self.centred(&x[cells + params..]);
        let (views, beams) = (self.views_of(&x[..cells]), self.beam_views());
        let sums = self.pass(beams.as_deref(), control, |system, row_index, row, room| {
            let cols = system.model.sensor().cols;
            for (k, (log, flux)) in logs.iter().zip(&system.flux).enumerate() {
                let window = &system.windows[k];
                system.weigh_row(k, row_index, room);
                let values = &mut room.values[k * cols..][..cols];
                let taps = [&window.along_rows.values, &window.along_cols.values];
                system.interpolate(&views, window, row_index, taps, &mut room.row, values);
                let share = log / flux;
                for (value, light) in values.iter_mut().zip(&row.light[k * cols..]) {
                    *value += share * light;
                }
                if let (Some(shift), Some(beams)) = (moves.get(k), &beams) {
                    for (axis, step) in shift.iter().enumerate() {
                        let taps = slopes(window, axis);
                        let slope = &mut room.slope[..];
                        system.interpolate(beams, window, row_index, taps, &mut room.row, slope);
                        let values = &mut room.values[k * cols..][..cols];
                        for (value, slope) in values.iter_mut().zip(slope) {
                            *value += step * *slope;
                        }
                    }
                }
            }
            let [first, second] = &mut room.sums;
            pulp::Arch::new().dispatch(Follow {
                row,
                fluxes: &system.flux,
                weights: &room.weights,
                values: &mut room.values,
                sums: [first, second],
            });
            0.0
        })?;
        let mut product = self.collect(sums);
        if let Some(penalty) = &self.penalty {
            let relative = penalty.relative(&self.state.beam, &x[..cells], self.workers);
            penalty.add(&self.state.beam, relative, 1.0, &mut product[..cells], self.workers);
        }
        let found = x[cells..cells + params].iter().chain(moves.as_flattened());
        let priors = product[cells..].iter_mut().zip(found).zip(self.precisions());
        priors.for_each(|((product, x), precision)| *product += precision * x);
        Ok(product)
    }

    /// Changes of shifts less their mean, by the weights of the prior: to move all exposures moves
    /// but the beam, which no measurement tells.
    ///
    /// As Σ_j π_j (d_k − d_j)/Σ π: where one shift is all but exact, it is all but the mean, and what
    /// rounding leaves of their difference would pull at it with all its weight.
    pub(super) fn centred(&self, shifts: &[f64]) -> Vec<[f64; 2]> {
        let shifts = shifts.as_chunks().0;
        let Some(shares) = self.shares() else { return shifts.to_vec() };
        let from_mean = |shift: &[f64; 2], axis: usize| -> f64 {
            let others = shares.iter().zip(shifts);
            others
                .map(|(share, other): (_, &[f64; 2])| share[axis] * (shift[axis] - other[axis]))
                .sum()
        };
        shifts.iter().map(|shift| [0, 1].map(|axis| from_mean(shift, axis))).collect()
    }

    /// What pulls at shifts pulls at them less their mean: the transpose of [`centred`](Self::centred).
    pub(super) fn centred_pulls(&self, pulls: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
        let Some(shares) = self.shares() else { return pulls };
        let left = |k: usize, axis: usize| -> f64 {
            let others = (0..pulls.len()).filter(|&j| j != k);
            others
                .map(|j| shares[j][axis] * pulls[k][axis] - shares[k][axis] * pulls[j][axis])
                .sum()
        };
        (0..pulls.len()).map(|k| [0, 1].map(|axis| left(k, axis))).collect()
    }

    /// The share of each shift in their mean, if they are sought.
    fn shares(&self) -> Option<Vec<[f64; 2]>> {
        let precisions = &self.shift_prior.as_ref()?.precisions;
        let sum = [0, 1].map(|axis| precisions.iter().map(|p| p[axis]).sum::<f64>());
        Some(precisions.iter().map(|p| [p[0] / sum[0], p[1] / sum[1]]).collect())
    }

    /// The priors' weights of the parameters.
    pub(super) fn precisions(&self) -> Vec<f64> {
        let shifts = self.shift_prior.iter().flat_map(|prior| prior.precisions.as_flattened());
        self.fluxes.precisions.iter().chain(shifts).map(|precision| self.unit * precision).collect()
    }

    /// x − a (aᵀD x)/(aᵀD a), without the multiple of the beam that no measurement tells.
    pub(super) fn take_scale_out(&self, x: &mut [f64]) {
        let multiple = self.workers.dot(&self.scale, x);
        self.workers.add_multiple(x, -multiple, &self.state.beam);
    }

    /// D, Σ w c² M² by the pixels' factors, and the penalty where it is seen.
    fn weigh(&mut self, tau: f64, control: &Control) -> Result<()> {
        self.weights = self.diagonal(false, control)?;
        let pulls = self.weights.iter().zip(&self.state.beam).map(|(d, a)| d * a);
        self.scale = pulls.collect();
        let norm = self.workers.dot(&self.scale, &self.state.beam);
        self.scale.iter_mut().for_each(|pull| *pull /= norm);
        if self.grid.is_spline() {
            let total: f64 = self.weights.iter().sum();
            let typical = self.workers.dot(&self.weights, &self.weights) / total;
            let (shape, beam) = (self.grid.geometry.beam, &self.state.beam);
            // τ stays until it is asked for anew, or F would not be one function.
            let tau = self.penalty.as_ref().map_or(tau * typical, |penalty| penalty.tau);
            self.penalty = Some(Penalty::new(shape, beam, &self.weights, tau, self.workers));
        }
        Ok(())
    }

    /// Σ w c² M² over the pixels that see a cell, by their factors or the squares of those: with the
    /// penalty's, the diagonal of S but for what M takes out.
    pub(super) fn diagonal(&mut self, squared: bool, control: &Control) -> Result<Vec<f64>> {
        let windows = self.windows.clone();
        if squared {
            self.windows = windows.iter().map(|window| window.squared()).collect();
        }
        let passed = self.pass(None, control, |system, row_index, row, room| {
            let cols = system.model.sensor().cols;
            for (k, flux) in system.flux.iter().enumerate() {
                system.weigh_row(k, row_index, room);
                let values = &mut room.values[k * cols..][..cols];
                let weights = &room.weights[k * cols..];
                for ((value, weight), m) in values.iter_mut().zip(weights).zip(&*row.sensitivity) {
                    *value = weight * (flux * m) * (flux * m);
                }
            }
            0.0
        });
        let diagonal = passed.map(|_| self.collect_cells());
        self.windows = windows;
        let mut diagonal = diagonal?;
        if let (true, Some(penalty)) = (squared, &self.penalty) {
            self.workers.add_multiple(&mut diagonal, 1.0, &penalty.diagonal());
        }
        Ok(diagonal)
    }

    /// M and O at the state, row by row.
    pub(super) fn pixels(&self) -> [Vec<f64>; 2] {
        let mut found = [Vec::new(), Vec::new()];
        self.for_rows(|row| {
            found[0].extend_from_slice(row[0]);
            found[1].extend_from_slice(row[1]);
        });
        found
    }

    /// The mean M of the pixels with measurements.
    pub(super) fn mean_sensitivity(&self) -> f64 {
        let (mut sum, mut count) = (0.0, 0);
        self.for_rows(|[sensitivity, _, inverse, ..]| {
            for (m, inverse) in sensitivity.iter().zip(inverse) {
                if *inverse > 0.0 {
                    sum += m;
                    count += 1;
                }
            }
        });
        sum / f64::from(count.max(1))
    }

    /// Calls `visit([M, O, i₁₁, i₁₂, i₂₂, the last change of M])` for each row of pixels: i is the
    /// inverse of their normal matrices, i₁₁ that of M, i₂₂ that of O, which is 0 where no offset is
    /// told.
    pub(super) fn for_rows(&self, mut visit: impl FnMut([&[f64]; 6])) {
        let (cols, count) = (self.model.sensor().cols, self.model.count());
        for row in self.rows.chunks_exact(Row::length(count, cols)) {
            let part = |index: usize| &row[(count + index) * cols..][..cols];
            visit([0, 1, 2, 3, 4, 5].map(part));
        }
    }

    /// The largest size of the last change of M, less `share` of what `earlier` holds, which it
    /// replaces; pixels without weight do not count.
    pub(super) fn largest_change(&self, share: f64, earlier: &mut Vec<f64>) -> f64 {
        let (cols, count) = (self.model.sensor().cols, self.model.count());
        earlier.resize(self.model.sensor().len(), 0.0);
        let length = Row::length(count, cols);
        let rows = self.workers.map_blocks(earlier, cols, |row, earlier| {
            let change = &self.rows[(row + 1) * length - cols..][..cols];
            let mut largest = [0.0_f64; 2];
            for (index, (earlier, change)) in earlier.iter_mut().zip(change).enumerate() {
                let size = (change - share * *earlier).abs();
                // A maximum would lose what is no number.
                let size = if size.is_finite() { size } else { f64::INFINITY };
                largest[index % 2] = largest[index % 2].max(size);
                *earlier = *change;
            }
            largest[0].max(largest[1])
        });
        rows.into_iter().fold(0.0, f64::max)
    }

    /// Sums of each block of pixels and exposure, for blocks of `size`.
    pub(super) fn blocks(&self, size: [usize; 2], control: &Control) -> Result<Vec<Block>> {
        let (sensor, count) = (self.model.sensor(), self.model.count());
        let (down, across) = (sensor.rows.div_ceil(size[0]), sensor.cols.div_ceil(size[1]));
        let (beams, length) = (self.beam_views(), Row::length(count, sensor.cols));
        let found = self.workers.map(down, |block_row| {
            let mut room = self.room();
            let mut found = vec![Block::default(); across * count];
            for row_index in block_row * size[0]..sensor.rows.min((block_row + 1) * size[0]) {
                control.check()?;
                let row = &self.rows[row_index * length..][..length];
                let (light, rest) = row.split_at(count * sensor.cols);
                for k in 0..count {
                    self.weigh_row(k, row_index, &mut room);
                    let measured = |col: usize| {
                        let at = k * sensor.cols + col;
                        (col / size[1] * count + k, room.weights[at] * rest[col].powi(2), light[at])
                    };
                    for col in 0..sensor.cols {
                        let (block, weight, light) = measured(col);
                        found[block].weight += weight * light * light;
                    }
                    let Some(beams) = &beams else { continue };
                    for axis in 0..2 {
                        let window = &self.windows[k];
                        let (taps, slope) = (slopes(window, axis), &mut room.slope[..]);
                        self.interpolate(beams, window, row_index, taps, &mut room.row, slope);
                        for (col, slope) in slope.iter().enumerate() {
                            let (block, weight, light) = measured(col);
                            let slope = self.flux[k] * slope;
                            found[block].slope[axis] += weight * light * slope;
                            found[block].square[axis] += weight * slope * slope;
                        }
                    }
                }
            }
            Ok(found)
        });
        let found: Result<Vec<Vec<Block>>> = found.into_iter().collect();
        Ok(found?.concat())
    }

    /// How much the beam's slopes change from place to place, over those of noise: the mean square of
    /// the smoothed slopes' second differences over [`APART`] cells, by that of what smoothing took
    /// away. A beam without structure, such as a Gaussian, has slopes of its own too, but by those
    /// shifts are hardly told from a bend of M.
    pub(super) fn structure(&self) -> f64 {
        let Shape { rows, cols } = self.grid.geometry.beam;
        let beam = &self.state.beam;
        let seen = |cell: usize| self.weights.get(cell).is_some_and(|&weight| weight > 0.0);
        let [mut kept, mut lost] = [0.0, 0.0];
        for (step, length) in [(1, cols), (cols, rows)] {
            let slope = |cell: usize| beam[cell + step] - beam[cell - step];
            let smooth = |cell: usize| {
                let terms = SMOOTH.iter().enumerate();
                terms.map(|(i, t)| t * slope(cell + i * step - 2 * step)).sum::<f64>()
            };
            for cell in 0..beam.len() {
                let place = cell / step % length;
                let ends = 3..length.saturating_sub(3 + 2 * APART);
                if !ends.contains(&place) {
                    continue;
                }
                let places = [cell, cell + APART * step, cell + 2 * APART * step];
                let known =
                    |cell: usize| seen(cell - 3 * step) && seen(cell) && seen(cell + 3 * step);
                if places.into_iter().all(known) {
                    let [first, middle, last] = places.map(smooth);
                    kept += (first - 2.0 * middle + last).powi(2) / 6.0;
                    lost += (slope(cell) - first).powi(2);
                }
            }
        }
        kept / lost
    }

    /// Calls `work` for each row of pixels, which leaves the pull of each exposure in the room's
    /// values, and spreads those along the columns of the views; returns the sums, those of shifts by
    /// the slopes of `beams`, the beam in each view.
    pub(super) fn pass(
        &mut self,
        beams: Option<&[Vec<f64>]>,
        control: &Control,
        work: impl Fn(&Self, usize, Row<'_>, &mut Room) -> f64 + Sync,
    ) -> Result<Sums> {
        let (sensor, count) = (self.model.sensor(), self.model.count());
        let wide = sensor.cols + self.grid.width - 1;
        let sizes = [Row::length(count, sensor.cols), count * wide];
        let mut rows = std::mem::take(&mut self.rows);
        let mut pulls = std::mem::take(&mut self.pulls);
        let system = &*self;
        let bands = system.workers.map_pairs(
            &mut rows,
            &mut pulls,
            sizes.map(|size| BAND * size),
            |band, rows, pulls| {
                let mut room = system.room();
                let mut sums = Sums {
                    objective: 0.0,
                    flux: vec![0.0; count],
                    shifts: vec![[0.0; 2]; beams.map_or(0, |_| count)],
                };
                let rows = rows.chunks_exact_mut(sizes[0]);
                for (index, (row, pulls)) in rows.zip(pulls.chunks_exact_mut(sizes[1])).enumerate()
                {
                    if control.is_cancelled() {
                        break;
                    }
                    let row_index = band * BAND + index;
                    let parts = Row::of(row, count, sensor.cols);
                    sums.objective += work(system, row_index, parts, &mut room);
                    for k in 0..count {
                        let pull = &room.values[k * sensor.cols..][..sensor.cols];
                        let light = &row[k * sensor.cols..][..sensor.cols];
                        if !system.fluxes.columns.is_empty() {
                            sums.flux[k] += dot(light, pull) / system.flux[k];
                        }
                        if let Some(beams) = beams {
                            let window = &system.windows[k];
                            for axis in 0..2 {
                                let (taps, slope) = (slopes(window, axis), &mut room.slope[..]);
                                let room = &mut room.row;
                                system.interpolate(beams, window, row_index, taps, room, slope);
                                sums.shifts[k][axis] += dot(slope, pull);
                            }
                        }
                        system.spread(k, pull, &mut room.row, &mut pulls[k * wide..][..wide]);
                    }
                }
                sums
            },
        );
        (self.rows, self.pulls) = (rows, pulls);
        control.check()?;
        let mut total = Sums::default();
        total.flux.resize(count, 0.0);
        for sums in bands {
            total.objective += sums.objective;
            total.flux.iter_mut().zip(sums.flux).for_each(|(total, sum)| *total += sum);
            total.shifts.resize(sums.shifts.len(), [0.0; 2]);
            let pairs = total.shifts.as_flattened_mut().iter_mut();
            pairs.zip(sums.shifts.as_flattened()).for_each(|(total, sum)| *total += sum);
        }
        Ok(total)
    }

    /// Spreads a row of pulls along the columns that its pixels see.
    fn spread(&self, exposure: usize, pull: &[f64], room: &mut [f64], sums: &mut [f64]) {
        if !self.grid.is_spline() {
            return sums.copy_from_slice(pull);
        }
        let around = TAPS - 1;
        let room = &mut room[..pull.len() + 2 * around];
        room.fill(0.0);
        room[around..][..pull.len()].copy_from_slice(pull);
        let along_cols = &self.windows[exposure].along_cols.values;
        pulp::Arch::new().dispatch(Spread { values: room, along_cols, sums });
    }

    /// Collects what the last pass spread, on cells, then θ and the shifts.
    pub(super) fn collect(&self, sums: Sums) -> Vec<f64> {
        let mut total = self.collect_cells();
        total.extend(self.fluxes.gather(&sums.flux));
        total.extend_from_slice(self.centred_pulls(sums.shifts).as_flattened());
        total
    }

    /// Collects what the last pass spread on cells.
    fn collect_cells(&self) -> Vec<f64> {
        let (sensor, count) = (self.model.sensor(), self.model.count());
        let wide = sensor.cols + self.grid.width - 1;
        let mut total = Vec::with_capacity(self.size());
        total.resize(self.state.beam.len(), 0.0);
        let geometry = &self.grid.geometry;
        for (index, view) in geometry.views.iter().enumerate() {
            let mut found = vec![0.0; view.shape.len()];
            self.workers.map_blocks(&mut found, BAND * view.shape.cols, |band, part| {
                for (i, sums) in part.chunks_exact_mut(view.shape.cols).enumerate() {
                    let row = band * BAND + i;
                    let windows = self.windows.iter().enumerate();
                    for (k, window) in windows.filter(|(_, window)| window.view == index) {
                        for (j, &factor) in
                            window.along_rows.values[..self.grid.width].iter().enumerate()
                        {
                            let pixel = row.checked_sub(window.row + j);
                            let Some(pixel) = pixel.filter(|&row| row < sensor.rows) else {
                                continue;
                            };
                            let values = &self.pulls[(pixel * count + k) * wide..][..wide];
                            let sums = &mut sums[window.col..][..wide];
                            pulp::Arch::new().dispatch(Add { factor, values, sums });
                        }
                    }
                }
            });
            self.turn_back(view, &found, &mut total);
        }
        total
    }

    /// Adds what was found in a view to the beam's grid.
    fn turn_back(&self, view: &View, found: &[f64], cells: &mut [f64]) {
        if view.rotation == Rotation::None {
            return self.workers.add_multiple(cells, 1.0, found);
        }
        let cols = self.grid.geometry.beam.cols;
        self.workers.map_blocks(cells, cols, |row, cells| {
            for (col, cell) in cells.iter_mut().enumerate() {
                *cell += found[view.places.at(row, col)];
            }
        });
    }

    /// Values on cells in the order of each view.
    fn views_of(&self, cells: &[f64]) -> Vec<Vec<f64>> {
        let turned = |view: &View| {
            if view.rotation == Rotation::None {
                return cells.to_vec();
            }
            let mut turned = vec![0.0; cells.len()];
            self.workers.map_blocks(&mut turned, view.shape.cols, |row, values| {
                for (col, value) in values.iter_mut().enumerate() {
                    *value = cells[view.cells.at(row, col)];
                }
            });
            turned
        };
        self.grid.geometry.views.iter().map(turned).collect()
    }

    /// The beam in the order of each view, if its slopes are asked for.
    pub(super) fn beam_views(&self) -> Option<Vec<Vec<f64>>> {
        self.shift_prior.as_ref().map(|_| self.views_of(&self.state.beam))
    }

    /// What the pixels of one row of an exposure see of values on cells.
    fn interpolate(
        &self,
        views: &[Vec<f64>],
        window: &Window,
        row: usize,
        [along_rows, along_cols]: [&[f64; TAPS]; 2],
        room: &mut [f64],
        seen: &mut [f64],
    ) {
        let cols = self.grid.geometry.views[window.view].shape.cols;
        let wide = seen.len() + self.grid.width - 1;
        let line = |i| &views[window.view][(row + window.row + i) * cols + window.col..][..wide];
        let lines: [&[f64]; TAPS] = std::array::from_fn(|i| line(i.min(self.grid.width - 1)));
        let room = &mut room[..wide];
        let rows = &lines[..self.grid.width];
        pulp::Arch::new().dispatch(Interpolate { rows, along_rows, along_cols, room, seen });
    }

    /// The weights and values of one row of an exposure.
    fn measure(&self, exposure: usize, row: usize, room: &mut Room) {
        let cols = self.model.sensor().cols;
        let weights = &mut room.weights[exposure * cols..][..cols];
        let values = &mut room.values[exposure * cols..][..cols];
        match self.model.stretch(exposure, row, 0..cols, weights) {
            Stretch::Uniform(measured, weight) => {
                values.iter_mut().zip(measured).for_each(|(value, y)| *value = y.to_f64());
                weights.fill(weight);
            }
            Stretch::Weighted(measured, weights) => {
                for ((value, y), weight) in values.iter_mut().zip(measured).zip(weights) {
                    *value = if *weight > 0.0 { y.to_f64() } else { 0.0 };
                }
            }
        }
    }

    /// The weights of one row of an exposure.
    pub(super) fn weigh_row(&self, exposure: usize, row: usize, room: &mut Room) {
        let cols = self.model.sensor().cols;
        let weights = &mut room.weights[exposure * cols..][..cols];
        match self.model.uniform_weight(exposure) {
            Some(weight) => weights.fill(weight),
            None => {
                let _ = self.model.stretch(exposure, row, 0..cols, weights);
            }
        }
    }

    fn room(&self) -> Room {
        let (cols, count) = (self.model.sensor().cols, self.model.count());
        Room {
            weights: vec![0.0; count * cols],
            values: vec![0.0; count * cols],
            row: vec![0.0; cols + 2 * TAPS],
            sums: [vec![0.0; cols], vec![0.0; cols]],
            slope: vec![0.0; cols],
        }
    }
}

/// The factors of ∂L/∂d along one axis of the beam.
fn slopes(window: &Window, axis: usize) -> [&[f64; TAPS]; 2] {
    let (rows, cols): (&Taps, &Taps) = (&window.along_rows, &window.along_cols);
    let along_rows = (axis == 0) != window.swaps_axes;
    if along_rows { [&rows.slopes, &cols.values] } else { [&rows.values, &cols.slopes] }
}

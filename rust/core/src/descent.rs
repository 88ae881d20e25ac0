//! Coordinate descent: the method of the paper, sweep by sweep.
//!
//! With M fixed each cell of the beam has a closed form, and with L fixed each pixel has:
//!
//! ```text
//! L(u) = Σ w c M y / Σ w c² M²     over the measurements that see cell u
//! M(p) = Σ w c L y / Σ w c² L²     over the exposures of pixel p
//! ```
//!
//! One sweep updates all L, then all M (Stukachev and Kozhevatov 2011, section 2, who take the
//! method from Vasil'ev 1988). The objective F never rises. Pixel-scale errors of M fade in some
//! twenty sweeps, an error of the sensor's own size in (size/shift)² sweeps: see
//! [`estimate`](crate::estimate) for how to tell.
//!
//! Both are updated in the form M += Σ w c L r / Σ w c² L² with the residuals r = y − c L M, which
//! gives F in the same pass and keeps its accuracy when the residuals become small.

use std::ops::Range;

use crate::control::Control;
use crate::error::{Error, Result};
use crate::estimate::{Estimate, Estimator, ROUNDING};
use crate::frames::{Real, Shape};
use crate::geometry::{Placement, View};
use crate::model::{Model, Stretch};
use crate::parallel::Workers;

/// Fewest sweeps between two estimates of the error, each of which costs about as much.
const CHECK_EVERY: u64 = 16;
/// A step that may be rounding alone, where some pixels are much brighter than others.
const TINY_STEP: f64 = 1e-11;
/// Rows that a thread works on at a time.
const BAND: usize = 8;
/// Bytes of data that may be expected to stay in the last-level cache.
const IN_CACHE: usize = 1 << 25;
/// Most columns that a kernel takes at once: their weights stay in the first-level cache.
const STRETCH: usize = 1024;
/// Neighbouring values that are solved side by side in vector registers.
const LANES: usize = 16;

/// When to stop.
#[derive(Clone, Copy, Debug)]
pub struct Stop {
    /// The largest relative error of M that is wanted.
    pub tolerance: f64,
    /// The most sweeps to make; `None` means as many as it takes.
    pub max_sweeps: Option<u64>,
}

/// How a calibration went, sweep by sweep.
#[derive(Clone, Debug, Default)]
pub struct History {
    /// F after each sweep.
    pub objective: Vec<f64>,
    /// The estimated largest error of M at those sweeps where it was estimated.
    pub error_estimate: Vec<Estimate>,
}

impl History {
    /// Number of sweeps made.
    #[must_use]
    pub const fn sweeps(&self) -> u64 {
        self.objective.len() as u64
    }

    /// The last estimate of the largest relative error of M.
    #[must_use]
    pub fn last_estimate(&self) -> f64 {
        self.error_estimate.last().map_or(f64::INFINITY, |estimate| estimate.error)
    }

    /// Whether only rounding is left to see: no step can be told from it, or the steps are tiny and
    /// the estimate is no smaller than it was at half the sweeps.
    fn stalled(&self) -> bool {
        let [earlier @ .., last] = &self.error_estimate[..] else { return false };
        let half = earlier.iter().find(|estimate| 2 * estimate.sweep >= last.sweep);
        let falling = half.is_none_or(|half| last.error < half.error);
        last.step < ROUNDING || (last.step < TINY_STEP && !falling)
    }

    /// How many sweeps it will be until `tolerance` is met, if errors go on to fade as they did
    /// between the last two estimates, or by `rate` a sweep where there are no two.
    fn forecast(&self, tolerance: f64, rate: f64) -> u64 {
        let rate = match self.error_estimate[..] {
            [.., from, to] if to.error < from.error => {
                (from.error / to.error).ln() / (to.sweep - from.sweep) as f64
            }
            _ => rate,
        };
        let missing = (self.last_estimate() / tolerance).ln() / rate;
        self.sweeps().saturating_add(missing.max(0.0) as u64)
    }
}

/// Sweeps until the estimated error of M is at most the tolerance, the sweeps are used up, or the
/// estimate no longer falls.
///
/// `components` is the number of connected components of the measurements.
///
/// # Errors
/// [`Error::Value`] for a tolerance that is not a positive number or a limit of 0 sweeps,
/// [`Error::Cancelled`] if `control` asks to stop.
pub fn solve<'m, 'a, T: Real>(
    model: &'m Model<'a, T>,
    components: usize,
    stop: Stop,
    workers: &'m Workers,
    control: &Control,
) -> Result<(Descent<'m, 'a, T>, History)> {
    let Stop { tolerance, max_sweeps } = stop;
    if !(tolerance > 0.0 && tolerance.is_finite()) {
        let problem = format!("is {tolerance}: expected a positive number");
        return Err(Error::value("tolerance", problem));
    }
    if max_sweeps == Some(0) {
        return Err(Error::value("max_sweeps", "is 0: at least one sweep is needed"));
    }
    let mut estimator = Estimator::new(model, components, workers);
    let limit = max_sweeps.unwrap_or(u64::MAX);
    let mut descent = Descent::new(model, workers);
    let mut history = History::default();
    let mut next_check = limit.min(CHECK_EVERY / 2);
    for sweep in 1..=limit {
        if sweep < next_check {
            history.objective.push(descent.sweep(control)?);
            continue;
        }
        let before = descent.sensitivity.clone();
        history.objective.push(descent.sweep(control)?);
        let estimate = estimator.largest_error(descent.step_since(before), sweep, control)?;
        history.error_estimate.push(estimate);
        if estimate.error <= tolerance || history.stalled() {
            break;
        }
        let total = history.forecast(tolerance, estimator.longest()).min(limit);
        control.report("calibrate", sweep, total);
        // Rarer as the run grows longer, but not far beyond the sweep that may be the last.
        let wait = (total - sweep).min(sweep / 4).max(CHECK_EVERY);
        next_check = limit.min(sweep + wait);
    }
    Ok((descent, history))
}

/// An estimate of the sensitivity M and the beam L, improved sweep by sweep.
pub struct Descent<'m, 'a, T> {
    model: &'m Model<'a, T>,
    workers: &'m Workers,
    /// M, row by row; 1 where no measurement tells.
    pub sensitivity: Vec<f64>,
    /// L in each of the geometry's views; 0 where no measurement tells.
    beams: Vec<Vec<f64>>,
}

impl<'m, 'a, T: Real> Descent<'m, 'a, T> {
    /// Starts from a sensor of equal pixels, M = 1.
    #[must_use]
    pub fn new(model: &'m Model<'a, T>, workers: &'m Workers) -> Self {
        let cells = model.geometry.beam.len();
        Self {
            model,
            workers,
            sensitivity: vec![1.0; model.sensor().len()],
            beams: vec![vec![0.0; cells]; model.geometry.views.len()],
        }
    }

    /// One sweep: all L, then all M. Returns F after it.
    ///
    /// # Errors
    /// [`Error::Cancelled`]; the state is then no whole sweep's.
    pub fn sweep(&mut self, control: &Control) -> Result<f64> {
        let Shape { rows, cols } = self.model.sensor();
        let mut bands = Vec::with_capacity(rows.div_ceil(BAND));
        if self.beams.len() == 1 {
            let places = self.model.geometry.exposures.iter();
            let reach = places.map(|place| place.row).max().unwrap_or(0);
            let mut done = 0;
            for start in (0..rows).step_by(self.rows_in_cache()) {
                let end = (start + self.rows_in_cache()).min(rows);
                self.update_beam(done..end + reach, control);
                done = end + reach;
                bands.extend(self.update_sensitivity(start * cols..end * cols, control));
            }
        } else {
            self.update_turned_beams(control);
            bands.extend(self.update_sensitivity(0..rows * cols, control));
        }
        control.check()?;
        Ok(bands.into_iter().sum())
    }

    /// Rows whose data are still in cache when M is updated, right after the cells of L that see
    /// them. The cells of the rows that follow still see the old M, so nothing changes but the
    /// number of times that the data come from memory: once a sweep, not twice.
    fn rows_in_cache(&self) -> usize {
        let Shape { cols, .. } = self.model.sensor();
        let row = cols * self.model.count() * size_of::<T>();
        (IN_CACHE / row).max(4 * BAND * self.workers.count()).next_multiple_of(BAND)
    }

    /// L on the beam grid, row by row; 0 where no measurement tells.
    #[must_use]
    pub fn beam(&self) -> Vec<f64> {
        let geometry = &self.model.geometry;
        let mut beam = vec![0.0; geometry.beam.len()];
        self.workers.map_blocks(&mut beam, geometry.beam.cols, |row, cells| {
            for (col, cell) in cells.iter_mut().enumerate() {
                *cell = self.beams[0][geometry.views[0].places.at(row, col)];
            }
        });
        beam
    }

    /// The change of M since it was `before`, in units of the mean of M.
    fn step_since(&self, before: Vec<f64>) -> Vec<f64> {
        let mean = self.sensitivity.iter().sum::<f64>() / self.sensitivity.len() as f64;
        let mut step = before;
        for (step, now) in step.iter_mut().zip(&self.sensitivity) {
            *step = (now - *step) / mean;
        }
        step
    }

    /// Updates some rows of the beam, which has one view.
    fn update_beam(&mut self, rows: Range<usize>, control: &Control) {
        let cols = self.model.geometry.views[0].shape.cols;
        let (model, sensitivity) = (self.model, &self.sensitivity[..]);
        let first = rows.start;
        let cells = &mut self.beams[0][rows.start * cols..rows.end * cols];
        self.workers.map_blocks(cells, BAND * cols, |band, rows| {
            let mut scratch = Scratch::new(model.count());
            for (index, row) in rows.chunks_exact_mut(cols).enumerate() {
                if control.is_cancelled() {
                    return;
                }
                let row_of_view = first + band * BAND + index;
                let seen = BeamRow { model, sensitivity, view: 0, row: row_of_view };
                seen.for_each_stretch(&mut scratch, |lines, cells| {
                    improve(lines, &mut row[cells]);
                });
            }
        });
    }

    /// The update of L where exposures are turned against each other: the sums of each view are
    /// brought together on the beam grid, and the new beam is turned into each view.
    fn update_turned_beams(&mut self, control: &Control) {
        let (views, beams) = (&self.model.geometry.views, &self.beams);
        let sums: Vec<_> = (0..views.len()).map(|view| self.view_sums(view, control)).collect();
        let Shape { rows, cols } = self.model.geometry.beam;
        let mut beam = vec![0.0; rows * cols];
        self.workers.map_blocks(&mut beam, cols, |row, cells| {
            for (col, cell) in cells.iter_mut().enumerate() {
                *cell = beams[0][views[0].places.at(row, col)];
                let [mut slope, mut weight] = [0.0; 2];
                for (view, sums) in views.iter().zip(&sums) {
                    let more = &sums[view.places.at(row, col)];
                    slope += more[0];
                    weight += more[1];
                }
                *cell += quotient(slope, weight);
            }
        });
        for (view, turned) in views.iter().zip(&mut self.beams) {
            turn(view, &beam, turned, self.workers);
        }
    }

    /// Slope and weight of one view's exposures, for each of its cells.
    fn view_sums(&self, view: usize, control: &Control) -> Vec<[f64; 2]> {
        let (model, sensitivity, beam) = (self.model, &self.sensitivity[..], &self.beams[view]);
        let shape = model.geometry.views[view].shape;
        let mut result = vec![[0.0; 2]; shape.len()];
        self.workers.map_blocks(&mut result, BAND * shape.cols, |band, rows| {
            let mut scratch = Scratch::new(model.count());
            for (index, sums) in rows.chunks_exact_mut(shape.cols).enumerate() {
                if control.is_cancelled() {
                    return;
                }
                let row = band * BAND + index;
                let sought = &beam[row * shape.cols..][..shape.cols];
                let seen = BeamRow { model, sensitivity, view, row };
                seen.for_each_stretch(&mut scratch, |lines, cells| {
                    for (index, sum) in sums[cells.clone()].iter_mut().enumerate() {
                        let found = Sums::<1>::over(lines, index, &[sought[cells.start + index]]);
                        *sum = [found.slope[0], found.weight[0]];
                    }
                });
            }
        });
        result
    }

    /// Updates M in a range of pixels, whole rows; returns the share of F of each band of them.
    fn update_sensitivity(&mut self, pixels: Range<usize>, control: &Control) -> Vec<f64> {
        let cols = self.model.sensor().cols;
        let (model, beams) = (self.model, &self.beams[..]);
        let first = pixels.start / cols;
        let pixels = &mut self.sensitivity[pixels];
        self.workers.map_blocks(pixels, BAND * cols, |band, rows| {
            let mut scratch = Scratch::new(model.count());
            let mut objective = 0.0;
            for (index, pixels) in rows.chunks_exact_mut(cols).enumerate() {
                if control.is_cancelled() {
                    return objective;
                }
                let row = first + band * BAND + index;
                for start in (0..cols).step_by(STRETCH) {
                    let stretch = start..(start + STRETCH).min(cols);
                    let lines = pixel_lines(model, beams, row, stretch.clone(), &mut scratch);
                    objective += improve(&lines, &mut pixels[stretch]);
                }
            }
            objective
        })
    }
}

/// Copies `beam` into the orientation of `view`.
fn turn(view: &View, beam: &[f64], turned: &mut [f64], workers: &Workers) {
    workers.map_blocks(turned, view.shape.cols, |row, cells| {
        for (col, cell) in cells.iter_mut().enumerate() {
            *cell = beam[view.cells.at(row, col)];
        }
    });
}

/// One exposure's part in a stretch of a row: its values and the factor that is held fixed.
struct Line<'s, T> {
    measured: Stretch<'s, T>,
    known: &'s [f64],
    flux: f64,
}

/// Room for the weights of every exposure along one stretch.
struct Scratch {
    weights: Vec<[f64; STRETCH]>,
}

impl Scratch {
    fn new(exposures: usize) -> Self {
        Self { weights: vec![[0.0; STRETCH]; exposures] }
    }
}

/// The exposures along a stretch of a row of pixels, with the beam that they see.
fn pixel_lines<'s, T: Real>(
    model: &Model<'s, T>,
    beams: &'s [Vec<f64>],
    row: usize,
    cols: Range<usize>,
    scratch: &'s mut Scratch,
) -> Vec<Line<'s, T>> {
    let exposures = model.geometry.exposures.iter().zip(&model.flux).enumerate();
    exposures
        .zip(&mut scratch.weights)
        .map(|((exposure, (place, &flux)), weights)| {
            let view_cols = model.geometry.views[place.view].shape.cols;
            let first = (row + place.row) * view_cols + place.col + cols.start;
            let known = &beams[place.view][first..][..cols.len()];
            Line { measured: model.stretch(exposure, row, cols.clone(), weights), known, flux }
        })
        .collect()
}

/// One row of beam cells, in one view, and what the exposures there see of it.
struct BeamRow<'r, 'a, T> {
    model: &'r Model<'a, T>,
    sensitivity: &'r [f64],
    view: usize,
    row: usize,
}

impl<T: Real> BeamRow<'_, '_, T> {
    /// Calls `work(lines, cells)` for each stretch of cells that the same exposures see.
    fn for_each_stretch(
        &self,
        scratch: &mut Scratch,
        mut work: impl FnMut(&[Line<'_, T>], Range<usize>),
    ) {
        let edges = self.edges();
        for pair in edges.windows(2) {
            for start in (pair[0]..pair[1]).step_by(STRETCH) {
                let cells = start..(start + STRETCH).min(pair[1]);
                let lines = self.lines(cells.clone(), scratch);
                work(&lines, cells);
            }
        }
    }

    /// Where windows of exposures begin and end along the row, rising.
    fn edges(&self) -> Vec<usize> {
        let cols = self.model.sensor().cols;
        let ends = self.exposures().flat_map(|(_, place)| [place.col, place.col + cols]);
        let mut edges: Vec<usize> = ends.collect();
        edges.sort_unstable();
        edges.dedup();
        edges
    }

    /// The exposures whose windows reach this row.
    fn exposures(&self) -> impl Iterator<Item = (usize, &Placement)> {
        let rows = self.model.sensor().rows;
        let places = self.model.geometry.exposures.iter().enumerate();
        places.filter(move |(_, place)| {
            place.view == self.view && (place.row..place.row + rows).contains(&self.row)
        })
    }

    /// The exposures that see `cells`, with the sensitivities of the pixels that do.
    fn lines<'s>(&'s self, cells: Range<usize>, scratch: &'s mut Scratch) -> Vec<Line<'s, T>> {
        let cols = self.model.sensor().cols;
        let seeing = self
            .exposures()
            .filter(|(_, place)| place.col <= cells.start && cells.end <= place.col + cols);
        seeing
            .zip(&mut scratch.weights)
            .map(|((exposure, place), weights)| {
                let row = self.row - place.row;
                let pixels = cells.start - place.col..cells.end - place.col;
                let known = &self.sensitivity[row * cols..][pixels.clone()];
                let measured = self.model.stretch(exposure, row, pixels, weights);
                Line { measured, known, flux: self.model.flux[exposure] }
            })
            .collect()
    }
}

/// Takes each of `sought` to the minimum of F along it; returns their share of F after that.
///
/// L and M enter the model alike: this is the step of both.
fn improve<T: Real>(lines: &[Line<'_, T>], sought: &mut [f64]) -> f64 {
    pulp::Arch::new().dispatch(Improve { lines, sought })
}

/// [`improve`] in a form that the compiler inlines into code for the CPU at hand.
struct Improve<'l, 's, T> {
    lines: &'l [Line<'s, T>],
    sought: &'l mut [f64],
}

impl<T: Real> pulp::NullaryFnOnce for Improve<'_, '_, T> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let (chunks, rest) = self.sought.as_chunks_mut::<LANES>();
        let whole = chunks.len() * LANES;
        let mut objective = [0.0; LANES];
        for (index, chunk) in chunks.iter_mut().enumerate() {
            let before = *chunk;
            let left = Sums::over(self.lines, index * LANES, &before).step(chunk);
            for (sum, left) in objective.iter_mut().zip(left) {
                *sum += left;
            }
        }
        let mut total: f64 = objective.iter().sum();
        for (index, one) in rest.iter_mut().enumerate() {
            let one = std::array::from_mut(one);
            let before = *one;
            total += Sums::over(self.lines, whole + index, &before).step(one)[0];
        }
        total
    }
}

/// What the measurements say of `N` neighbouring values of L or M, the other one held fixed.
struct Sums<const N: usize> {
    /// Σ w a r: half the slope of −F, with a = c·(the factor held fixed) and the residual r.
    slope: [f64; N],
    /// Σ w a²: half the curvature of F.
    weight: [f64; N],
    /// Σ w r²: the share of F.
    objective: [f64; N],
}

impl<const N: usize> Sums<N> {
    #[inline(always)]
    fn over<T: Real>(lines: &[Line<'_, T>], first: usize, sought: &[f64; N]) -> Self {
        let mut sums = Self { slope: [0.0; N], weight: [0.0; N], objective: [0.0; N] };
        for line in lines {
            let known = &line.known[first..first + N];
            match line.measured {
                Stretch::Uniform(values, weight) => {
                    let values = &values[first..first + N];
                    for i in 0..N {
                        let factor = line.flux * known[i];
                        let residual = values[i].to_f64() - factor * sought[i];
                        sums.add(i, weight, factor, residual);
                    }
                }
                Stretch::Weighted(values, weights) => {
                    let (values, weights) = (&values[first..first + N], &weights[first..first + N]);
                    for i in 0..N {
                        // A value of weight 0 may be NaN.
                        let value = if weights[i] > 0.0 { values[i].to_f64() } else { 0.0 };
                        let factor = line.flux * known[i];
                        sums.add(i, weights[i], factor, value - factor * sought[i]);
                    }
                }
            }
        }
        sums
    }

    #[inline(always)]
    fn add(&mut self, i: usize, weight: f64, factor: f64, residual: f64) {
        let weighted = weight * factor;
        self.slope[i] += weighted * residual;
        self.weight[i] += weighted * factor;
        self.objective[i] += weight * residual * residual;
    }

    /// Steps to the minimum; returns F there. F is a parabola: a step s lowers it by s·slope.
    #[inline(always)]
    fn step(self, sought: &mut [f64; N]) -> [f64; N] {
        let mut left = self.objective;
        for i in 0..N {
            let step = quotient(self.slope[i], self.weight[i]);
            sought[i] += step;
            // Below 0 only by rounding, where everything is fitted exactly.
            left[i] = (left[i] - step * self.slope[i]).max(0.0);
        }
        left
    }
}

/// slope/weight, or 0 where no measurement tells.
#[inline(always)]
fn quotient(slope: f64, weight: f64) -> f64 {
    if weight > 0.0 { slope / weight } else { 0.0 }
}

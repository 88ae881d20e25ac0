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
//! M is updated in the form M += Σ w c L r / Σ w c² L² with the residuals r = y − c L M, which
//! gives F in the same pass and keeps its accuracy when the residuals become small.

use std::ops::Range;

use crate::control::Control;
use crate::error::{Error, Result};
use crate::estimate::Estimator;
use crate::frames::{Real, Shape};
use crate::geometry::View;
use crate::model::{Model, Stretch};
use crate::parallel::Workers;

/// Sweeps between two estimates of the error, at first; later a sixteenth of those made.
const CHECK_EVERY: u64 = 16;
/// Rows that a thread works on at a time.
const BAND: usize = 8;
/// Columns that a kernel works on at a time: its sums stay in the first-level cache.
const BLOCK: usize = 400;

/// When to stop.
#[derive(Clone, Copy, Debug)]
pub struct Stop {
    /// The largest relative error of M that is wanted.
    pub tolerance: f64,
    /// The most sweeps to make; `None` means five times as many as the slowest mode should need.
    pub max_sweeps: Option<u64>,
}

/// How a calibration went, sweep by sweep.
#[derive(Clone, Debug, Default)]
pub struct History {
    /// F after each sweep.
    pub objective: Vec<f64>,
    /// The estimated largest error of M at those sweeps where it was estimated.
    pub error_estimate: Vec<(u64, f64)>,
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
        self.error_estimate.last().map_or(f64::INFINITY, |&(_, estimate)| estimate)
    }

    /// How many sweeps it will be until `tolerance` is met, if errors go on to fade as they did
    /// between the last two estimates, or by `rate` a sweep where there are no two.
    fn forecast(&self, tolerance: f64, rate: f64) -> u64 {
        let rate = match self.error_estimate[..] {
            [.., (from, before), (to, after)] if after < before => {
                (before / after).ln() / (to - from) as f64
            }
            _ => rate,
        };
        let missing = (self.last_estimate() / tolerance).ln() / rate;
        self.sweeps().saturating_add(missing.max(0.0) as u64)
    }
}

/// Sweeps until the estimated error of M is at most the tolerance, or the sweeps are used up.
///
/// # Errors
/// [`Error::Value`] for a tolerance that is not a positive number or a limit of 0 sweeps,
/// [`Error::Cancelled`] if `control` asks to stop.
pub fn solve<'m, 'a, T: Real>(
    model: &'m Model<'a, T>,
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
    let mut estimator = Estimator::new(model, workers);
    let enough = 5.0 * (1.0 / tolerance).ln().max(1.0) / estimator.slowest();
    let limit = max_sweeps.unwrap_or(enough.ceil().max(100.0) as u64);
    let mut descent = Descent::new(model, workers);
    let mut history = History::default();
    let mut next_check = limit.min(CHECK_EVERY);
    for sweep in 1..=limit {
        if sweep < next_check {
            history.objective.push(descent.sweep(control)?);
            continue;
        }
        let before = descent.sensitivity.clone();
        history.objective.push(descent.sweep(control)?);
        let estimate = estimator.largest_error(descent.step_since(before), sweep, control)?;
        history.error_estimate.push((sweep, estimate));
        if estimate <= tolerance {
            break;
        }
        // An estimate costs several sweeps: rarer checks as the run grows longer.
        next_check = limit.min(sweep + CHECK_EVERY.max(sweep / CHECK_EVERY));
        let total = history.forecast(tolerance, estimator.slowest());
        control.report("calibrate", sweep, total.min(limit));
    }
    Ok((descent, history))
}

/// An estimate of the sensitivity M and the beam L, improved sweep by sweep.
pub struct Descent<'m, 'a, T> {
    model: &'m Model<'a, T>,
    workers: &'m Workers,
    arch: pulp::Arch,
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
            arch: pulp::Arch::new(),
            sensitivity: vec![1.0; model.sensor().len()],
            beams: vec![vec![0.0; cells]; model.geometry.views.len()],
        }
    }

    /// One sweep: all L, then all M. Returns F after it.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled); the state is then no whole sweep's.
    pub fn sweep(&mut self, control: &Control) -> Result<f64> {
        self.update_beam(control)?;
        self.update_sensitivity(control)
    }

    /// L on the beam grid, row by row; 0 where no measurement tells.
    #[must_use]
    pub fn beam(&self) -> Vec<f64> {
        let view = &self.model.geometry.views[0];
        let places = (0..self.model.geometry.beam.rows)
            .flat_map(|row| (0..self.model.geometry.beam.cols).map(move |col| (row, col)));
        places.map(|(row, col)| self.beams[0][view.places.at(row, col)]).collect()
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

    fn update_beam(&mut self, control: &Control) -> Result<()> {
        if let [beam] = &mut self.beams[..] {
            let cols = self.model.geometry.views[0].shape.cols;
            let (model, arch, sensitivity) = (self.model, self.arch, &self.sensitivity[..]);
            self.workers.map_blocks(beam, BAND * cols, |band, rows| {
                let mut sums = BeamSums::default();
                for (index, row) in rows.chunks_exact_mut(cols).enumerate() {
                    if control.is_cancelled() {
                        return;
                    }
                    for (block, cells) in row.chunks_mut(BLOCK).enumerate() {
                        let first = block * BLOCK;
                        let stretch = first..first + cells.len();
                        let row = band * BAND + index;
                        arch.dispatch(
                            #[inline(always)]
                            || {
                                sums.fill(model, 0, row, stretch, sensitivity);
                                sums.divide(cells);
                            },
                        );
                    }
                }
            });
        } else {
            self.update_turned_beams(control);
        }
        control.check()
    }

    /// The update of L where exposures are turned against each other: the sums of each view are
    /// brought together on the beam grid, and the new beam is turned into each view.
    fn update_turned_beams(&mut self, control: &Control) {
        let (model, workers) = (self.model, self.workers);
        let views = &model.geometry.views;
        let sums: Vec<_> = (0..views.len()).map(|view| self.view_sums(view, control)).collect();
        let Shape { rows, cols } = model.geometry.beam;
        let mut beam = vec![0.0; rows * cols];
        workers.map_blocks(&mut beam, cols, |row, cells| {
            for (col, cell) in cells.iter_mut().enumerate() {
                let [mut signal, mut weight] = [0.0; 2];
                for (view, sums) in views.iter().zip(&sums) {
                    let [more_signal, more_weight] = sums[view.places.at(row, col)];
                    signal += more_signal;
                    weight += more_weight;
                }
                *cell = if weight > 0.0 { signal / weight } else { 0.0 };
            }
        });
        for (view, turned) in views.iter().zip(&mut self.beams) {
            turn(view, &beam, turned, workers);
        }
    }

    /// Σ w c M y and Σ w c² M² of one view's exposures, for each of its cells.
    fn view_sums(&self, view: usize, control: &Control) -> Vec<[f64; 2]> {
        let shape = self.model.geometry.views[view].shape;
        let mut result = vec![[0.0; 2]; shape.len()];
        self.workers.map_blocks(&mut result, shape.cols, |row, cells| {
            if control.is_cancelled() {
                return;
            }
            let mut sums = BeamSums::default();
            for (block, cells) in cells.chunks_mut(BLOCK).enumerate() {
                let stretch = block * BLOCK..block * BLOCK + cells.len();
                self.arch.dispatch(
                    #[inline(always)]
                    || sums.fill(self.model, view, row, stretch, &self.sensitivity),
                );
                for (index, cell) in cells.iter_mut().enumerate() {
                    *cell = [sums.signal[index], sums.weight[index]];
                }
            }
        });
        result
    }

    fn update_sensitivity(&mut self, control: &Control) -> Result<f64> {
        let cols = self.model.sensor().cols;
        let (model, arch, beams) = (self.model, self.arch, &self.beams[..]);
        let bands = self.workers.map_blocks(&mut self.sensitivity, BAND * cols, |band, rows| {
            let mut sums = PixelSums::default();
            let mut objective = 0.0;
            for (index, row) in rows.chunks_exact_mut(cols).enumerate() {
                if control.is_cancelled() {
                    return objective;
                }
                for (block, pixels) in row.chunks_mut(BLOCK).enumerate() {
                    let stretch = block * BLOCK..block * BLOCK + pixels.len();
                    let row = band * BAND + index;
                    objective += arch.dispatch(
                        #[inline(always)]
                        || {
                            sums.fill(model, row, stretch, beams, pixels);
                            sums.step(pixels)
                        },
                    );
                }
            }
            objective
        });
        control.check()?;
        Ok(bands.into_iter().sum())
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

/// The sums that give L in one block of cells, with scratch space for weights.
struct BeamSums {
    signal: [f64; BLOCK],
    weight: [f64; BLOCK],
    scratch: [f64; BLOCK],
}

impl Default for BeamSums {
    fn default() -> Self {
        Self { signal: [0.0; BLOCK], weight: [0.0; BLOCK], scratch: [0.0; BLOCK] }
    }
}

impl BeamSums {
    /// Sums over the exposures of `view` that see `cells` of its row `row`.
    #[inline(always)]
    fn fill<T: Real>(
        &mut self,
        model: &Model<'_, T>,
        view: usize,
        row: usize,
        cells: Range<usize>,
        sensitivity: &[f64],
    ) {
        let Shape { rows, cols } = model.sensor();
        self.signal[..cells.len()].fill(0.0);
        self.weight[..cells.len()].fill(0.0);
        for (exposure, place) in model.geometry.exposures.iter().enumerate() {
            if place.view != view || row < place.row || row >= place.row + rows {
                continue;
            }
            let start = cells.start.max(place.col);
            let end = cells.end.min(place.col + cols);
            if start >= end {
                continue;
            }
            let pixels = start - place.col..end - place.col;
            let sums = start - cells.start..end - cells.start;
            let signal = &mut self.signal[sums.clone()];
            let weight = &mut self.weight[sums];
            let flux = model.flux[exposure];
            let row = row - place.row;
            let pixel_row = &sensitivity[row * cols..][pixels.clone()];
            match model.stretch(exposure, row, pixels, &mut self.scratch) {
                Stretch::Uniform(values, w) => {
                    add_to_cells(signal, weight, values, pixel_row, flux, |_| w);
                }
                Stretch::Weighted(values, w) => {
                    add_to_cells(signal, weight, values, pixel_row, flux, |i| w[i]);
                }
            }
        }
    }

    /// L = Σ w c M y / Σ w c² M²
    #[inline(always)]
    fn divide(&self, cells: &mut [f64]) {
        for ((cell, &signal), &weight) in cells.iter_mut().zip(&self.signal).zip(&self.weight) {
            *cell = if weight > 0.0 { signal / weight } else { 0.0 };
        }
    }
}

#[inline(always)]
fn add_to_cells<T: Real>(
    signal: &mut [f64],
    weight: &mut [f64],
    values: &[T],
    sensitivity: &[f64],
    flux: f64,
    weight_of: impl Fn(usize) -> f64,
) {
    let length = values.len();
    let (signal, weight) = (&mut signal[..length], &mut weight[..length]);
    let sensitivity = &sensitivity[..length];
    for i in 0..length {
        let w = weight_of(i);
        let response = flux * sensitivity[i];
        signal[i] += w * response * value_of(values[i], w);
        weight[i] += w * response * response;
    }
}

/// The value of a measurement, 0 where its weight is 0 (it may be NaN).
#[inline(always)]
fn value_of<T: Real>(value: T, weight: f64) -> f64 {
    if weight > 0.0 { value.to_f64() } else { 0.0 }
}

/// The sums that give M in one block of pixels, with scratch space for weights.
struct PixelSums {
    slope: [f64; BLOCK],
    weight: [f64; BLOCK],
    objective: [f64; BLOCK],
    scratch: [f64; BLOCK],
}

impl Default for PixelSums {
    fn default() -> Self {
        let zero = [0.0; BLOCK];
        Self { slope: zero, weight: zero, objective: zero, scratch: zero }
    }
}

impl PixelSums {
    /// Sums over the exposures of the pixels in `cols` of `row`, whose sensitivity is given.
    #[inline(always)]
    fn fill<T: Real>(
        &mut self,
        model: &Model<'_, T>,
        row: usize,
        cols: Range<usize>,
        beams: &[Vec<f64>],
        sensitivity: &[f64],
    ) {
        let length = cols.len();
        self.slope[..length].fill(0.0);
        self.weight[..length].fill(0.0);
        self.objective[..length].fill(0.0);
        for (exposure, place) in model.geometry.exposures.iter().enumerate() {
            let first = (row + place.row) * model.geometry.views[place.view].shape.cols + place.col;
            let beam = &beams[place.view][first + cols.start..][..length];
            let flux = model.flux[exposure];
            let slope = &mut self.slope[..length];
            let weight = &mut self.weight[..length];
            let objective = &mut self.objective[..length];
            match model.stretch(exposure, row, cols.clone(), &mut self.scratch) {
                Stretch::Uniform(values, w) => {
                    add_to_pixels(slope, weight, objective, values, beam, sensitivity, flux, |_| w);
                }
                Stretch::Weighted(values, w) => {
                    add_to_pixels(slope, weight, objective, values, beam, sensitivity, flux, |i| {
                        w[i]
                    });
                }
            }
        }
    }

    /// Takes the step to the closed form of M; returns the block's share of F after it.
    ///
    /// Along M, F is a parabola: a step of s = slope/weight lowers it by s·slope.
    #[inline(always)]
    fn step(&mut self, pixels: &mut [f64]) -> f64 {
        let length = pixels.len();
        let (slope, weight) = (&self.slope[..length], &self.weight[..length]);
        let objective = &mut self.objective[..length];
        for i in 0..length {
            let step = if weight[i] > 0.0 { slope[i] / weight[i] } else { 0.0 };
            pixels[i] += step;
            // Below 0 only by rounding, where a pixel is fitted exactly.
            objective[i] = (objective[i] - step * slope[i]).max(0.0);
        }
        sum(objective)
    }
}

#[inline(always)]
#[expect(clippy::too_many_arguments, reason = "slices that the compiler knows not to overlap")]
fn add_to_pixels<T: Real>(
    slope: &mut [f64],
    weight: &mut [f64],
    objective: &mut [f64],
    values: &[T],
    beam: &[f64],
    sensitivity: &[f64],
    flux: f64,
    weight_of: impl Fn(usize) -> f64,
) {
    let length = values.len();
    let (slope, weight) = (&mut slope[..length], &mut weight[..length]);
    let objective = &mut objective[..length];
    let (beam, sensitivity) = (&beam[..length], &sensitivity[..length]);
    for i in 0..length {
        let w = weight_of(i);
        let light = flux * beam[i];
        let residual = value_of(values[i], w) - light * sensitivity[i];
        slope[i] += w * light * residual;
        weight[i] += w * light * light;
        objective[i] += w * residual * residual;
    }
}

/// A sum in eight interleaved parts, which a vector unit can add.
#[inline(always)]
fn sum(values: &[f64]) -> f64 {
    let mut parts = [0.0; 8];
    let chunks = values.chunks_exact(8);
    let rest: f64 = chunks.remainder().iter().sum();
    for chunk in chunks {
        for (part, value) in parts.iter_mut().zip(chunk) {
            *part += value;
        }
    }
    parts.iter().sum::<f64>() + rest
}

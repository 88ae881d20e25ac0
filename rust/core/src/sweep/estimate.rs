//! One sweep over all exposures: which lines of data meet in which cells and pixels.

use std::marker::PhantomData;
use std::ops::Range;

use super::kernel::{Advance, Difference, Plain, STRETCH, Scratch, improve, measure, quotient};
use super::lines::{BeamRow, darkest, pixel_lines, stands_out};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::{Exposures, Stretch};
use crate::frames::{Real, Shape};
use crate::geometry::View;
use crate::information;
use crate::median::median;
use crate::padded::Padding;
use crate::parallel::Workers;
use crate::weak_light::{self, Prior};

/// Rows that a thread works on at a time.
const BAND: usize = 8;
/// Bytes of data that may be expected to stay in the last-level cache.
const IN_CACHE: usize = 1 << 25;

/// How many times brighter or darker than those around a pixel starts from its own brightness.
const UNLIKE: f64 = 4.0;
/// So many pixels on either side of it.
const AROUND: usize = 4;

/// Rows and columns whose residuals are sampled.
const SAMPLED: usize = 64;
/// Cells that a thread counts at a time.
const COUNTED: usize = 1 << 16;

/// An estimate of the sensitivity M and the beam L, improved sweep by sweep.
pub struct Estimate<'m, 'a, T> {
    exposures: &'m Exposures<'a, T>,
    workers: &'m Workers,
    /// M, row by row; 1 without a measurement.
    pub sensitivity: Vec<f64>,
    /// L in each of the geometry's views; 0 without a measurement.
    beams: Vec<Vec<f64>>,
    /// The prior of M, where light is weak.
    pub(crate) prior: Option<Prior>,
}

impl<'m, 'a, T: Real> Estimate<'m, 'a, T> {
    /// Starts from a sensor of equal pixels, M = 1.
    #[must_use]
    pub fn new(exposures: &'m Exposures<'a, T>, workers: &'m Workers, control: &Control) -> Self {
        Self {
            exposures,
            workers,
            sensitivity: workers.filled(exposures.sensor().len(), 1.0, control),
            beams: vec![Vec::new(); exposures.geometry().views.len()],
            prior: None,
        }
    }

    /// Starts again from M = 1, and pixels that are much brighter or darker than those around, in every
    /// exposure, from what they show: with M = 1 they would change the beam that they see, and with it
    /// their neighbours.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn start(&mut self, control: &Control) -> Result<()> {
        self.workers.fill(&mut self.sensitivity, 1.0, control);
        let (exposures, cols) = (self.exposures, self.exposures.sensor().cols);
        self.workers.map_blocks(&mut self.sensitivity, BAND * cols, |band, rows| {
            let mut scratch = vec![0.0; cols];
            for (index, pixels) in rows.chunks_exact_mut(cols).enumerate() {
                if control.is_cancelled() {
                    return;
                }
                let row_of_sensor = band * BAND + index;
                let row = darkest(exposures, row_of_sensor, &mut scratch);
                for (col, m) in pixels.iter_mut().enumerate() {
                    let range = col.saturating_sub(AROUND)..cols.min(col + AROUND + 1);
                    // Where nothing is measured it is infinite.
                    let around = &row[range.clone()];
                    // Most are settled by the two at the ends.
                    let ends = [around[0], around[around.len() - 1]];
                    let [low, high] = [ends[0].min(ends[1]), ends[0].max(ends[1])];
                    if row[col] > UNLIKE * low || UNLIKE * row[col] < high {
                        let mut known: Vec<f64> =
                            around.iter().copied().filter(|y| y.is_finite()).collect();
                        let median = median(&mut known, f64::total_cmp).unwrap_or(0.0);
                        let place = [row_of_sensor, col];
                        let bright = row[col] > UNLIKE * median
                            && stands_out(exposures, place, &range, |y, m| y > UNLIKE * m);
                        let dark = UNLIKE * row[col] < median
                            && stands_out(exposures, place, &range, |y, m| UNLIKE * y < m);
                        if median > 0.0 && row[col].is_finite() && (bright || dark) {
                            *m = row[col] / median;
                        }
                    }
                }
            }
        });
        control.check()
    }

    /// One sweep: all L, then all M. Returns F after it.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled); the state is then no whole sweep's.
    pub fn sweep(&mut self, control: &Control) -> Result<f64> {
        self.with_best_beam::<Plain>(control, |estimate, rows| {
            estimate.update_sensitivity(rows, control)
        })
    }

    /// Updates all L; writes half the slope of −F − R along each pixel's M, times `scale`, to `slopes`
    /// and returns F + R, R being that of the prior. With logarithmic differences it is the slope of the
    /// problem of ln L and ln M.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn slopes<D: Difference>(
        &mut self,
        scale: f64,
        slopes: &mut [f32],
        control: &Control,
    ) -> Result<f64> {
        let padding = Padding::of(self.exposures.geometry());
        let body = padding.body_mut(slopes);
        let sensitivity = &self.sensitivity;
        let of_prior = self.prior.as_mut().map_or(0.0, |prior| prior.at(sensitivity));
        let misfit = self.with_best_beam::<D>(control, |estimate, rows| {
            let body = &mut body[rows.start * padding.width..rows.end * padding.width];
            estimate.measure_slopes::<D>(rows, scale, &padding, body, control)
        })?;
        Ok(misfit + of_prior)
    }

    /// Allocates L where there is none, by the threads that will use it.
    fn remember_beams(&mut self, control: &Control) {
        let cells = self.exposures.geometry().beam.len();
        for beam in self.beams.iter_mut().filter(|beam| beam.is_empty()) {
            *beam = self.workers.filled(cells, 0.0, control);
        }
    }

    /// Gives the memory of L back until it is found anew from M.
    pub(crate) fn forget_beams(&mut self) {
        self.beams.iter_mut().for_each(|beam| *beam = Vec::new());
    }

    /// Updates all L, and calls `work` for ranges of pixel rows, in order, once the cells that they
    /// see are up to date; returns the sum of what it returns.
    fn with_best_beam<D: Difference>(
        &mut self,
        control: &Control,
        mut work: impl FnMut(&mut Self, Range<usize>) -> Vec<f64>,
    ) -> Result<f64> {
        self.remember_beams(control);
        let rows = self.exposures.sensor().rows;
        let mut bands = Vec::with_capacity(rows.div_ceil(BAND));
        if self.beams.len() == 1 {
            let places = self.exposures.geometry().placements.iter();
            let reach = places.map(|place| place.row).max().unwrap_or(0);
            let mut done = 0;
            for start in (0..rows).step_by(self.rows_in_cache()) {
                let end = (start + self.rows_in_cache()).min(rows);
                self.update_beam::<D>(done..end + reach, control);
                done = end + reach;
                bands.extend(work(self, start..end));
            }
        } else {
            self.update_turned_beams::<Plain>(control);
            if D::IS_LOGARITHMIC {
                self.update_turned_beams::<D>(control);
            }
            bands.extend(work(self, 0..rows));
        }
        control.check()?;
        Ok(bands.into_iter().sum())
    }

    /// Rows whose data are still in cache when M is updated, right after the cells of L that see
    /// them. The cells of the rows that follow still see the old M, so nothing changes but the
    /// number of times that the data come from memory: once a sweep, not twice.
    fn rows_in_cache(&self) -> usize {
        let Shape { cols, .. } = self.exposures.sensor();
        let row = cols * self.exposures.count() * size_of::<T>();
        (IN_CACHE / row).max(4 * BAND * self.workers.count()).next_multiple_of(BAND)
    }

    /// D = Σ w c² L² of each pixel, with the best L for equal pixels but for bright ones.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled), here and below.
    pub(crate) fn first_information(
        exposures: &'m Exposures<'a, T>,
        workers: &'m Workers,
        control: &Control,
    ) -> Result<Vec<f64>> {
        let mut first = Self::new(exposures, workers, control);
        first.start(control)?;
        // What a dark pixel shows is noise, which has no part in the prior.
        first.sensitivity.iter_mut().for_each(|m| *m = m.max(1.0));
        first.with_best_beam::<Plain>(control, |_, _| Vec::new())?;
        first.information(control)
    }

    /// D of each pixel with the L that there is.
    pub(crate) fn information(&self, control: &Control) -> Result<Vec<f64>> {
        let (geometry, Shape { rows, cols }) = (self.exposures.geometry(), self.exposures.sensor());
        let mut found = self.workers.filled(rows * cols, 0.0, control);
        self.workers.map_blocks(&mut found, cols, |row, sums| {
            let exposures = geometry.placements.iter().zip(self.exposures.flux()).enumerate();
            for (k, (place, &flux)) in exposures {
                let width = geometry.views[place.view].shape.cols;
                let light =
                    &self.beams[place.view][(row + place.row) * width + place.col..][..cols];
                information::add(self.exposures, k, [row, 0], flux, light, sums);
            }
        });
        control.check()?;
        Ok(found)
    }

    /// The variance of a measurement of weight 1 from a sample of residuals, with this number of unknown M, of
    /// which `freed` are left to a prior; `None` if there are nearly as many unknowns as measurements.
    pub(crate) fn variance(&self, pixels: usize, freed: f64) -> Option<f64> {
        let Shape { rows, cols } = self.exposures.sensor();
        let geometry = self.exposures.geometry();
        let mut squares = Vec::new();
        let mut weights = vec![0.0; cols];
        for row in (0..rows).step_by(rows.div_ceil(SAMPLED)) {
            for (k, place) in geometry.placements.iter().enumerate() {
                let width = geometry.views[place.view].shape.cols;
                let light =
                    &self.beams[place.view][(row + place.row) * width + place.col..][..cols];
                let measured = self.exposures.stretch(k, row, 0..cols, &mut weights);
                for col in (0..cols).step_by(cols.div_ceil(SAMPLED)) {
                    let (value, weight) = match &measured {
                        Stretch::Uniform(values, weight) => (values[col], *weight),
                        Stretch::Weighted(values, weights) => (values[col], weights[col]),
                    };
                    if weight > 0.0 {
                        let model = self.exposures.flux()[k] * light[col];
                        let left = value.to_f64() - model * self.sensitivity[row * cols + col];
                        squares.push(weight * left * left);
                    }
                }
            }
        }
        let blocks: Vec<_> = self.beams[0].chunks(COUNTED).collect();
        let seen = |index: usize| blocks[index].iter().filter(|light| **light != 0.0).count();
        let cells: usize = self.workers.map(blocks.len(), seen).into_iter().sum();
        let used = self.exposures.used();
        weak_light::variance(squares, used, used as f64 - (pixels + cells) as f64, freed)
    }

    /// Takes M as given; what is not a number becomes 1.
    #[must_use]
    pub(crate) fn at(mut self, sensitivity: &[f64]) -> Self {
        self.sensitivity.iter_mut().zip(sensitivity).for_each(|(m, &given)| {
            *m = if given.is_finite() { given } else { 1.0 };
        });
        self
    }

    /// M and L, row by row.
    pub(crate) fn into_maps(self) -> (Vec<f64>, Vec<f64>) {
        let beam = self.beam();
        (self.sensitivity, beam)
    }

    /// L on the beam grid, row by row; 0 without a measurement.
    #[must_use]
    pub fn beam(&self) -> Vec<f64> {
        let geometry = &self.exposures.geometry();
        let mut beam = vec![0.0; geometry.beam.len()];
        self.workers.map_blocks(&mut beam, geometry.beam.cols, |row, cells| {
            for (col, cell) in cells.iter_mut().enumerate() {
                *cell = self.beams[0][geometry.views[0].places.at(row, col)];
            }
        });
        beam
    }

    /// Updates some rows of the beam, which has one view.
    fn update_beam<D: Difference>(&mut self, rows: Range<usize>, control: &Control) {
        let cols = self.exposures.geometry().views[0].shape.cols;
        let (exposures, sensitivity) = (self.exposures, &self.sensitivity[..]);
        let first = rows.start;
        let cells = &mut self.beams[0][rows.start * cols..rows.end * cols];
        self.workers.map_blocks(cells, BAND * cols, |band, rows| {
            let mut scratch = Scratch::new(exposures.count());
            for (index, row) in rows.chunks_exact_mut(cols).enumerate() {
                if control.is_cancelled() {
                    return;
                }
                let row_of_view = first + band * BAND + index;
                let seen = BeamRow { exposures, sensitivity, view: 0, row: row_of_view };
                seen.for_each_stretch(&mut scratch, |lines, cells| {
                    let cells = &mut row[cells];
                    improve::<T, Plain>(lines, cells);
                    if D::IS_LOGARITHMIC {
                        improve::<T, D>(lines, cells);
                    }
                });
            }
        });
    }

    /// The update of L where exposures are turned against each other: the sums of each view are
    /// brought together on the beam grid, and the new beam is turned into each view.
    fn update_turned_beams<D: Difference>(&mut self, control: &Control) {
        let (views, beams) = (&self.exposures.geometry().views, &self.beams);
        let sums: Vec<_> =
            (0..views.len()).map(|view| self.view_sums::<D>(view, control)).collect();
        let Shape { rows, cols } = self.exposures.geometry().beam;
        let mut beam = vec![0.0; rows * cols];
        self.workers.map_blocks(&mut beam, cols, |row, cells| {
            for (col, cell) in cells.iter_mut().enumerate() {
                *cell = beams[0][views[0].places.at(row, col)];
                let [mut slope, mut weight] = [0.0; 2];
                for (view, sums) in views.iter().zip(&sums) {
                    let place = view.places.at(row, col);
                    slope += sums[0][place];
                    weight += sums[1][place];
                }
                *cell = D::stepped(*cell, quotient(slope, weight));
            }
        });
        for (view, turned) in views.iter().zip(&mut self.beams) {
            turn(view, &beam, turned, self.workers);
        }
    }

    /// Slope and weight of one view's exposures, for each of its cells.
    fn view_sums<D: Difference>(&self, view: usize, control: &Control) -> [Vec<f64>; 2] {
        let (exposures, sensitivity, beam) =
            (self.exposures, &self.sensitivity[..], &self.beams[view]);
        let shape = exposures.geometry().views[view].shape;
        let mut slopes = vec![0.0; shape.len()];
        let mut weights = vec![0.0; shape.len()];
        let size = BAND * shape.cols;
        self.workers.map_pairs(&mut slopes, &mut weights, [size; 2], |band, slopes, weights| {
            let mut scratch = Scratch::new(exposures.count());
            let rows = slopes.chunks_exact_mut(shape.cols);
            let rows = rows.zip(weights.chunks_exact_mut(shape.cols)).enumerate();
            for (index, (slopes, weights)) in rows {
                if control.is_cancelled() {
                    return;
                }
                let row = band * BAND + index;
                let sought = &beam[row * shape.cols..][..shape.cols];
                let seen = BeamRow { exposures, sensitivity, view, row };
                seen.for_each_stretch(&mut scratch, |lines, cells| {
                    let (slopes, weights) =
                        (&mut slopes[cells.clone()], &mut weights[cells.clone()]);
                    measure::<T, D>(lines, &sought[cells], slopes, weights);
                });
            }
        });
        [slopes, weights]
    }

    /// Updates M in a range of rows; returns the share of F of each band of them.
    fn update_sensitivity(&mut self, rows: Range<usize>, control: &Control) -> Vec<f64> {
        let cols = self.exposures.sensor().cols;
        let (exposures, beams) = (self.exposures, &self.beams[..]);
        let pixels = &mut self.sensitivity[rows.start * cols..rows.end * cols];
        self.workers.map_blocks(pixels, BAND * cols, |band, pixels| {
            let mut scratch = Scratch::new(exposures.count());
            let mut objective = 0.0;
            for (index, pixels) in pixels.chunks_exact_mut(cols).enumerate() {
                if control.is_cancelled() {
                    return objective;
                }
                let row = rows.start + band * BAND + index;
                for start in (0..cols).step_by(STRETCH) {
                    let stretch = start..(start + STRETCH).min(cols);
                    let lines = pixel_lines(exposures, beams, row, stretch.clone(), &mut scratch);
                    objective += improve::<T, Plain>(&lines, &mut pixels[stretch]);
                }
            }
            objective
        })
    }

    /// Slopes along M in a range of rows, times `scale`; returns the share of F of each band.
    fn measure_slopes<D: Difference>(
        &self,
        rows: Range<usize>,
        scale: f64,
        padding: &Padding,
        slopes: &mut [f32],
        control: &Control,
    ) -> Vec<f64> {
        let cols = self.exposures.sensor().cols;
        self.workers.map_blocks(slopes, BAND * padding.width, |band, slopes| {
            let mut scratch = Scratch::new(self.exposures.count());
            let [mut found, mut weights] = [[0.0; STRETCH]; 2];
            let mut objective = 0.0;
            for (index, slopes) in slopes.chunks_exact_mut(padding.width).enumerate() {
                if control.is_cancelled() {
                    return objective;
                }
                let row = rows.start + band * BAND + index;
                for start in (0..cols).step_by(STRETCH) {
                    let stretch = start..(start + STRETCH).min(cols);
                    let sought = &self.sensitivity[row * cols..][stretch.clone()];
                    let lines = pixel_lines(
                        self.exposures,
                        &self.beams,
                        row,
                        stretch.clone(),
                        &mut scratch,
                    );
                    objective += measure::<T, D>(&lines, sought, &mut found, &mut weights);
                    if let Some(prior) = &self.prior {
                        let pixels = stretch.clone().map(|col| row * cols + col).zip(sought);
                        for (found, (pixel, &m)) in found.iter_mut().zip(pixels) {
                            *found += prior.slope(pixel, m);
                        }
                    }
                    for (slope, found) in slopes[stretch].iter_mut().zip(&found) {
                        *slope = (found * scale) as f32;
                    }
                }
            }
            objective
        })
    }

    /// M ← M + share·x, or M eᵗ with t = share·x/M, for an `x` that lies as [`slopes`](Self::slopes) does.
    pub(crate) fn advance<D: Difference>(&mut self, x: &[f32], share: f64) {
        let cols = self.exposures.sensor().cols;
        let padding = Padding::of(self.exposures.geometry());
        self.workers.map_blocks(&mut self.sensitivity, cols, |row, pixels| {
            let (steps, difference) = (padding.row(x, row), PhantomData::<D>);
            pulp::Arch::new().dispatch(Advance { sought: pixels, steps, share, difference });
        });
    }

    /// L in each of the geometry's views; 0 without a measurement.
    pub(crate) fn beams(&self) -> &[Vec<f64>] {
        &self.beams
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

//! One pass over the measurements: what pixels see of values on cells, and what cells get of the pixels'
//! pulls.
//!
//! The sensor is cut into bands of rows. A band interpolates, lets its pixels pull, keeps the pulls of
//! the last four rows of pixels, and adds what they make to the cells that it sees, in sums of its own;
//! these are folded in the order of the bands. So between the two nothing of the size of the data is
//! written, and the same bytes come out for any number of threads.

use std::borrow::Cow;

use super::bands::Bands;
use super::few::Few;
use super::kernel::{AROUND, Combine, Lines, Row};
use super::layout::{Grid, Window};
use super::workspace::{Sums, Workspace};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::{Exposures, Stretch};
use crate::frames::Real;
use crate::geometry::{Rotation, TAPS, Taps, View};
use crate::parallel::dot;
use crate::parallel::{Add, Workers};

/// Rows of cells that a thread folds at a time.
const FOLDED: usize = 16;

/// A pass over the measurements: where the exposures lie on the grid, and what is kept of each row of
/// pixels from one pass to the next.
pub(crate) struct Pass<'m, 'a, T> {
    pub(crate) exposures: &'m Exposures<'a, T>,
    pub(crate) workers: &'m Workers,
    pub(crate) grid: Grid,
    pub(crate) windows: Vec<Window>,
    bands: Bands,
    /// Pixels that pull at nothing, unless it is asked what they themselves are moved by.
    pub(crate) few: Few,
    pub(crate) few_pull: bool,
    /// c of each exposure.
    pub(crate) flux: Vec<f64>,
    pub(crate) with_offset: bool,
    /// Whether slopes of ln c are gathered.
    pub(crate) with_flux: bool,
    /// Whether slopes of the shifts are gathered.
    pub(crate) with_shifts: bool,
    /// [`Row`] by row.
    pub(super) rows: Vec<f64>,
    /// What cells get of the pixels' pulls, by band.
    sums: Vec<f64>,
    /// Passes made.
    pub(crate) count: u64,
}

/// Values on cells in the order of each view.
pub(crate) type Views<'v> = [Cow<'v, [f64]>];

impl<'m, 'a, T: Real> Pass<'m, 'a, T> {
    /// Exposures on a grid, before they are placed.
    pub(crate) fn new(
        exposures: &'m Exposures<'a, T>,
        grid: Grid,
        few: Few,
        with_flux: bool,
        workers: &'m Workers,
        control: &Control,
    ) -> Self {
        let (sensor, with_offset) = (exposures.sensor(), exposures.offset());
        let length = Row::length(sensor.cols, with_offset);
        Self {
            exposures,
            workers,
            grid,
            windows: Vec::new(),
            bands: Bands::default(),
            few,
            few_pull: false,
            flux: Vec::new(),
            with_offset,
            with_flux,
            with_shifts: false,
            rows: workers.filled(sensor.rows * length, 0.0, control),
            sums: Vec::new(),
            count: 0,
        }
    }

    /// Where the exposures lie.
    pub(crate) fn place(&mut self, shifts: &[[f64; 2]]) {
        self.windows = self.grid.windows(shifts);
        self.bands = Bands::new(&self.grid, &self.windows);
    }

    /// Frees the sums of bands, until the next pass.
    pub(crate) fn free_sums(&mut self) {
        self.sums = Vec::new();
    }

    /// Calls `work` for each row of pixels with the beam's light there, and with its slopes if shifts are sought;
    /// `work` leaves the pull of each exposure in the workspace's values; finds what `cells` get of them.
    pub(crate) fn run(
        &mut self,
        beam: &[f64],
        cells: &mut [f64],
        control: &Control,
        work: impl Fn(&Self, usize, Row<'_>, &mut Workspace, &mut Sums) + Sync,
    ) -> Result<Sums> {
        let (sensor, count) = (self.exposures.sensor(), self.exposures.count());
        let length = Row::length(sensor.cols, self.with_offset);
        let mut rows = std::mem::take(&mut self.rows);
        let mut sums = std::mem::take(&mut self.sums);
        let size = self.bands.size(sensor.rows);
        if sums.len() != size {
            drop(sums);
            sums = self.workers.filled(size, 0.0, control);
        }
        let (pass, height) = (&*self, self.bands.height);
        let beams = pass.views_of(beam);
        let sizes = [height * length, self.bands.length];
        let bands = pass.workers.map_pairs(&mut rows, &mut sums, sizes, |band, rows, strips| {
            let mut workspace = pass.workspace();
            let mut found = pass.no_sums();
            strips.fill(0.0);
            let rows = rows.chunks_exact_mut(length);
            let last = rows.len();
            for (index, row) in rows.enumerate() {
                if control.is_cancelled() {
                    break;
                }
                workspace.lines.rotate_left(1);
                let number = band * height + index;
                pass.see_beam(&beams, number, &mut workspace);
                work(pass, number, Row::of(row, sensor.cols), &mut workspace, &mut found);
                if !pass.few_pull {
                    workspace.values().silence(pass.few.in_row(number), count);
                }
                pass.gather(&workspace, &mut found);
                pass.spread(index, &mut workspace, strips);
            }
            for index in last..last + pass.grid.width - 1 {
                workspace.lines.rotate_left(1);
                workspace.values().clear();
                pass.spread(index, &mut workspace, strips);
            }
            found
        });
        drop(beams);
        (self.rows, self.sums) = (rows, sums);
        self.count += 1;
        control.check()?;
        self.fold(cells, control);
        control.check()?;
        let mut total = self.no_sums();
        for sums in bands {
            total.objective += sums.objective;
            total.largest = total.largest.max(sums.largest);
            total.flux.iter_mut().zip(sums.flux).for_each(|(total, sum)| *total += sum);
            let pairs = total.shifts.as_flattened_mut().iter_mut();
            pairs.zip(sums.shifts.as_flattened()).for_each(|(total, sum)| *total += sum);
        }
        Ok(total)
    }

    pub(super) fn no_sums(&self) -> Sums {
        let count = self.exposures.count();
        let moved = if self.with_shifts { count } else { 0 };
        Sums { flux: vec![0.0; count], shifts: vec![[0.0; 2]; moved], ..Sums::default() }
    }

    /// The pulls of a row at fluxes and shifts.
    fn gather(&self, workspace: &Workspace, found: &mut Sums) {
        let cols = self.exposures.sensor().cols;
        for (k, flux) in self.flux.iter().enumerate() {
            let pull = workspace.lines[TAPS - 1].of(k);
            if self.with_flux {
                found.flux[k] += dot(&workspace.light[k * cols..][..cols], pull) / flux;
            }
            if let Some(found) = found.shifts.get_mut(k) {
                for (found, slopes) in found.iter_mut().zip(&workspace.slopes) {
                    *found += dot(&slopes[k * cols..][..cols], pull);
                }
            }
        }
    }

    /// Adds to a band's sums what the pulls of the last rows make of the row of cells that the first
    /// factors lead to.
    fn spread(&self, index: usize, workspace: &mut Workspace, strips: &mut [f64]) {
        let wide = self.exposures.sensor().cols + self.grid.width - 1;
        for (k, window) in self.windows.iter().enumerate() {
            let strip = &self.bands.strips[window.view];
            let at = strip.start + (index + window.row - strip.first) * strip.cols + window.col;
            let sums = &mut strips[at..][..wide];
            if !self.grid.is_spline() {
                Add { factor: 1.0, values: workspace.lines[TAPS - 1].of(k), sums }.dispatch();
                continue;
            }
            let rows = workspace.lines.each_ref().map(|lines| lines.padded(k));
            let [along_rows, along_cols] = [&window.along_rows, &window.along_cols].map(|taps| {
                let [s, t, u, v] = taps.values;
                [v, u, t, s]
            });
            let line = &mut workspace.line[..wide + AROUND];
            Combine { rows, along_rows, along_cols, line, sums }.dispatch();
        }
    }

    /// What cells get: the sums of all bands.
    fn fold(&self, cells: &mut [f64], control: &Control) {
        self.workers.fill(cells, 0.0, control);
        let (bands, sums) = (&self.bands, &self.sums[..]);
        for (index, view) in self.grid.geometry.views.iter().enumerate() {
            let cols = view.shape.cols;
            let fold = |part: &mut [f64], first: usize| {
                for (row, part) in part.chunks_exact_mut(cols).enumerate() {
                    for values in bands.seeing(sums, index, first + row) {
                        Add { factor: 1.0, values, sums: &mut *part }.dispatch();
                    }
                }
            };
            let fold_all = |cells: &mut [f64]| {
                let fold = |block: usize, part: &mut [f64]| fold(part, block * FOLDED);
                self.workers.map_blocks(cells, FOLDED * cols, fold);
            };
            if view.rotation == Rotation::None {
                fold_all(cells);
            } else {
                let mut found = self.workers.filled(view.shape.len(), 0.0, control);
                fold_all(&mut found);
                self.turn_back(view, &found, cells);
            }
        }
    }

    /// Adds what was found in a view to the beam's grid.
    fn turn_back(&self, view: &View, found: &[f64], cells: &mut [f64]) {
        self.workers.map_blocks(cells, self.grid.geometry.beam.cols, |row, cells| {
            for (col, cell) in cells.iter_mut().enumerate() {
                *cell += found[view.places.at(row, col)];
            }
        });
    }

    /// Values on cells in the order of each view.
    pub(crate) fn views_of<'v>(&self, cells: &'v [f64]) -> Vec<Cow<'v, [f64]>> {
        let turned = |view: &View| {
            if view.rotation == Rotation::None {
                return Cow::Borrowed(cells);
            }
            let mut turned = vec![0.0; cells.len()];
            self.workers.map_blocks(&mut turned, view.shape.cols, |row, values| {
                for (col, value) in values.iter_mut().enumerate() {
                    *value = cells[view.cells.at(row, col)];
                }
            });
            Cow::Owned(turned)
        };
        self.grid.geometry.views.iter().map(turned).collect()
    }

    /// Adds to `seen` what the pixels of one row of an exposure see of values on cells, by these factors
    /// along rows and columns.
    pub(crate) fn interpolate(
        &self,
        views: &Views<'_>,
        window: &Window,
        row: usize,
        [along_rows, along_cols]: [[f64; TAPS]; 2],
        line: &mut [f64],
        seen: &mut [f64],
    ) {
        let cols = self.grid.geometry.views[window.view].shape.cols;
        let wide = seen.len() + self.grid.width - 1;
        let of = |i| &views[window.view][(row + window.row + i) * cols + window.col..][..wide];
        if !self.grid.is_spline() {
            return Add { factor: along_rows[0] * along_cols[0], values: of(0), sums: seen }
                .dispatch();
        }
        let (rows, line) = (std::array::from_fn(of), &mut line[..wide]);
        Combine { rows, along_rows, along_cols, line, sums: seen }.dispatch();
    }

    /// The light c L that one pixel sees of the beam.
    pub(crate) fn light_at(&self, beam: &[f64], exposure: usize, [row, col]: [usize; 2]) -> f64 {
        let window = &self.windows[exposure];
        let cells = &self.grid.geometry.views[window.view].cells;
        let mut light = 0.0;
        for (i, down) in window.along_rows.values[..self.grid.width].iter().enumerate() {
            for (j, along) in window.along_cols.values[..self.grid.width].iter().enumerate() {
                light += down * along * beam[cells.at(row + window.row + i, col + window.col + j)];
            }
        }
        self.flux[exposure] * light
    }

    /// What the pixels of a row see of values on cells, added to the workspace's values.
    pub(crate) fn see(&self, views: &Views<'_>, row: usize, workspace: &mut Workspace) {
        for (k, window) in self.windows.iter().enumerate() {
            let taps = [window.along_rows.values, window.along_cols.values];
            let Workspace { lines: [.., values], line, .. } = workspace;
            self.interpolate(views, window, row, taps, line, values.of_mut(k));
        }
    }

    /// The light c L of each exposure that the pixels of a row see of the beam, left in the workspace, and its
    /// slopes along both axes of the beam where shifts are sought.
    pub(crate) fn see_beam(&self, views: &Views<'_>, row: usize, workspace: &mut Workspace) {
        let cols = self.exposures.sensor().cols;
        let Workspace { light, line, .. } = workspace;
        light.fill(0.0);
        for ((window, light), flux) in
            self.windows.iter().zip(light.chunks_exact_mut(cols)).zip(&self.flux)
        {
            let taps = [window.along_rows.values, window.along_cols.values];
            self.interpolate(views, window, row, taps, line, light);
            light.iter_mut().for_each(|light| *light *= flux);
        }
        for (axis, slopes) in workspace.slopes.iter_mut().enumerate() {
            slopes.fill(0.0);
            for (window, slopes) in self.windows.iter().zip(slopes.chunks_exact_mut(cols)) {
                let taps = slopes_along(window, axis);
                self.interpolate(views, window, row, taps, &mut workspace.line, slopes);
            }
        }
    }

    /// The weights and values of one row of each exposure.
    pub(crate) fn measure(&self, row: usize, workspace: &mut Workspace) {
        let cols = self.exposures.sensor().cols;
        let Workspace { weights, lines: [.., values], .. } = workspace;
        for (k, weights) in weights.chunks_exact_mut(cols).enumerate() {
            let values = values.of_mut(k);
            match self.exposures.stretch(k, row, 0..cols, weights) {
                Stretch::Uniform(measured, _) => {
                    values.iter_mut().zip(measured).for_each(|(value, y)| *value = y.to_f64());
                }
                Stretch::Weighted(measured, weights) => {
                    for ((value, y), weight) in values.iter_mut().zip(measured).zip(weights) {
                        *value = if *weight > 0.0 { y.to_f64() } else { 0.0 };
                    }
                }
            }
        }
        self.leave_lost_out(row, weights);
    }

    /// A buffer for the weights of one row of each exposure; those that are all the same stand in it.
    pub(crate) fn row_of_weights(&self) -> Vec<f64> {
        let weight = |k| self.exposures.uniform_weight(k).unwrap_or(0.0);
        let count = 0..self.exposures.count();
        count.flat_map(|k| std::iter::repeat_n(weight(k), self.exposures.sensor().cols)).collect()
    }

    /// The weights of one row of each exposure, in a buffer for them.
    pub(crate) fn weigh_row(&self, row: usize, weights: &mut [f64]) {
        let cols = self.exposures.sensor().cols;
        for (k, weights) in weights.chunks_exact_mut(cols).enumerate() {
            if self.exposures.uniform_weight(k).is_none() {
                let _ = self.exposures.stretch(k, row, 0..cols, weights);
            }
        }
        self.leave_lost_out(row, weights);
    }

    /// Takes the weights of lost measurements out of those of a row.
    fn leave_lost_out(&self, row: usize, weights: &mut [f64]) {
        if self.few.lost.is_empty() {
            return;
        }
        let cols = self.exposures.sensor().cols;
        for (k, weights) in weights.chunks_exact_mut(cols).enumerate() {
            if let Some(weight) = self.exposures.uniform_weight(k) {
                // The row before may have lost others.
                weights.fill(weight);
            }
            self.few.lost.in_row(k, row).iter().for_each(|&col| weights[col as usize] = 0.0);
        }
    }

    pub(crate) fn workspace(&self) -> Workspace {
        let (cols, count) = (self.exposures.sensor().cols, self.exposures.count());
        let moved = if self.with_shifts { count * cols } else { 0 };
        Workspace {
            weights: self.row_of_weights(),
            light: vec![0.0; count * cols],
            lines: [(); TAPS].map(|()| Lines::new(count, cols)),
            line: vec![0.0; cols + 2 * AROUND],
            sums: [(); 4].map(|()| vec![0.0; cols]),
            slopes: [(); 2].map(|()| vec![0.0; moved]),
        }
    }

    /// Calls `visit([M, i₁₁, the last change of M, O, i₁₂, i₂₂])` for each row of pixels, i being the
    /// inverse of their normal matrices; the last three are empty where no offset is sought.
    pub(crate) fn for_rows(&self, mut visit: impl FnMut([&[f64]; 6])) {
        let cols = self.exposures.sensor().cols;
        for row in self.rows.chunks_exact(Row::length(cols, self.with_offset)) {
            let part = |index: usize| row.chunks_exact(cols).nth(index).unwrap_or_default();
            visit([0, 1, 2, 3, 4, 5].map(part));
        }
    }

    /// What is kept of one row of pixels: M and the rest.
    pub(crate) fn row(&self, index: usize) -> &[f64] {
        let length = Row::length(self.exposures.sensor().cols, self.with_offset);
        &self.rows[index * length..][..length]
    }
}

/// The factors of ∂L/∂d along one axis of the beam.
pub(crate) fn slopes_along(window: &Window, axis: usize) -> [[f64; TAPS]; 2] {
    let (rows, cols): (&Taps, &Taps) = (&window.along_rows, &window.along_cols);
    let along_rows = (axis == 0) != window.swaps_axes;
    if along_rows { [rows.slopes, cols.values] } else { [rows.values, cols.slopes] }
}

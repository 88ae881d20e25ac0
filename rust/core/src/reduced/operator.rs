//! The operator S: products, its diagonal, and the pixels that leave it.

use super::dark::Dark;
use super::kernel::{Diagonal, Divide, Gather, Line, Scatter, Weigh, Weight};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::geometry::{Placement, View};
use crate::padded::{BAND, Padding};
use crate::parallel::Workers;
use crate::weak_light::{Prior, Term};

/// Pixels whose D is sampled.
const SAMPLES: usize = 1024;
/// The share of them that is fainter than a bright one: a few brighter ones do not count.
const BRIGHT: f64 = 0.9;

/// The largest squared light and weight, in units of an ordinary one: products of several stay within
/// single precision. Beyond, S is softer than it is, and steps are shortened.
const LARGEST: f64 = 1e12;
/// A weight D below which single precision has no inverse.
const FAINTEST: f32 = 1e-30;

/// The operator S at one M and L, scaled so that its elements are of order 1.
pub(crate) struct Reduced<'m, 'a, T> {
    pub(crate) exposures: &'m Exposures<'a, T>,
    pub(super) workers: &'m Workers,
    pub(crate) scale: Scale,
    pub(crate) padding: Padding,
    /// M.
    pub(crate) sensitivity: Vec<f32>,
    /// 1/D, the prior's weight included; 0 at pixels without measurement.
    pub(crate) inverse_diagonal: Vec<f32>,
    /// Σ D over all pixels.
    pub(crate) trace: f64,
    /// The mean of M over the pixels of the system.
    pub(crate) mean: f64,
    /// The least D above 0 and that of a bright pixel, without the prior.
    pub(crate) range: [f64; 2],
    /// The prior of M, where light is weak.
    pub(super) weak: Option<Term>,
    /// (L/scale)² in each view; 0 where unobserved.
    pub(super) light: Vec<Vec<f32>>,
    /// h in each view: a buffer for the first half of a product.
    eliminated: Vec<Vec<f32>>,
    /// The noise of a dark that was subtracted from all exposures, where it is known.
    pub(super) dark: Option<Dark>,
}

/// D of a bright pixel of a sample of them.
fn bright(values: &[f32]) -> f64 {
    let step = values.len().div_ceil(SAMPLES);
    let mut sample: Vec<f32> =
        values.iter().copied().step_by(step | 1).filter(|&value| value > 0.0).collect();
    sample.sort_unstable_by(f32::total_cmp);
    sample.get((sample.len() as f64 * BRIGHT) as usize).copied().map_or(0.0, f64::from)
}

/// The units of the linear problem.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scale {
    /// The light that an ordinary pixel sees.
    light: f64,
    /// An ordinary w c².
    weight: f64,
}

impl Scale {
    pub(crate) fn of<T: Real>(exposures: &Exposures<'_, T>) -> Self {
        Self { light: exposures.typical_light(), weight: exposures.typical_weight() }
    }

    /// What half a slope of F is multiplied by to become a right-hand side.
    pub(crate) fn slope(&self) -> f64 {
        1.0 / (self.weight * self.light * self.light)
    }

    /// What a standard deviation of measurements is multiplied by to become one of the noise there.
    pub(super) fn noise(&self) -> f64 {
        self.weight.sqrt()
    }

    /// The standard deviation of an M where that of the linear problem is 1.
    pub(crate) fn deviation(&self) -> f64 {
        self.slope().sqrt()
    }
}

impl<'m, 'a, T: Real> Reduced<'m, 'a, T> {
    /// Buffers for the operator of `model`.
    pub(crate) fn new(
        exposures: &'m Exposures<'a, T>,
        workers: &'m Workers,
        control: &Control,
    ) -> Self {
        let (padding, views) = (Padding::of(exposures.geometry()), &exposures.geometry().views);
        let of_views =
            || views.iter().map(|v| padding.zeros(v.shape.rows, workers, control)).collect();
        let of_sensor = || padding.zeros(exposures.sensor().rows, workers, control);
        Self {
            exposures,
            workers,
            scale: Scale::of(exposures),
            padding,
            sensitivity: of_sensor(),
            inverse_diagonal: of_sensor(),
            trace: 0.0,
            mean: 1.0,
            range: [0.0; 2],
            weak: None,
            light: of_views(),
            eliminated: of_views(),
            dark: None,
        }
    }

    /// Makes it the operator at M and L, the latter in each of the geometry's views.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn linearise(
        &mut self,
        sensitivity: &[f64],
        beams: &[Vec<f64>],
        prior: Option<&Prior>,
        control: &Control,
    ) -> Result<()> {
        let Self { exposures, workers, padding, scale, .. } = *self;
        let cols = exposures.sensor().cols;
        padding.copy(sensitivity, cols, workers, &mut self.sensitivity, |m| m as f32);
        let views = exposures.geometry().views.iter().zip(beams).zip(&mut self.light);
        for ((view, beam), light) in views {
            let square = |l: f64| (l / scale.light).powi(2).min(LARGEST) as f32;
            padding.copy(beam, view.shape.cols, workers, light, square);
            control.check()?;
        }
        let slope = scale.slope();
        self.weak = prior.map(|prior| Term::new(prior, slope, sensitivity, &self.site()));
        self.invert_diagonal(control)
    }

    /// Writes S x to `product` and returns x · S x.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled); the product is then no whole one.
    pub(crate) fn multiply(
        &mut self,
        x: &[f32],
        product: &mut [f32],
        control: &Control,
    ) -> Result<f64> {
        self.eliminate(Input::Step(x), control);
        let (padding, rows) = (self.padding, self.exposures.sensor().rows);
        let bands = self.workers.map_blocks(
            padding.body_mut(product),
            BAND * padding.width,
            |band, products| {
                let mut scratch = self.scratch();
                let mut total = 0.0;
                for (index, product) in products.chunks_exact_mut(padding.width).enumerate() {
                    let row = band * BAND + index;
                    if control.is_cancelled() {
                        return total;
                    }
                    let lines = self.pixel_lines(row, &mut scratch);
                    let sensitivity = padding.row(&self.sensitivity, row);
                    let x = padding.row(x, row);
                    let scatter = Scatter { lines: &lines, sensitivity, x, product };
                    total += pulp::Arch::new().dispatch(scatter);
                }
                total
            },
        );
        debug_assert!(bands.len() == rows.div_ceil(BAND));
        control.check()?;
        let of_prior = self.weak.as_ref().map_or(0.0, |term| term.add(&self.site(), x, product));
        Ok(bands.into_iter().sum::<f64>() + of_prior)
    }

    /// The least D above 0 and that of a bright pixel, without the prior, where the mean of M is 1.
    pub(crate) fn information_range(&self) -> [f64; 2] {
        self.range.map(|d| d * self.mean * self.mean)
    }

    /// The first half of a product: h, in each view, of an input.
    pub(super) fn eliminate(&mut self, input: Input<'_>, control: &Control) {
        let mut eliminated = std::mem::take(&mut self.eliminated);
        let padding = self.padding;
        if let [eliminated] = &mut eliminated[..] {
            let size = BAND * padding.width;
            self.workers.map_blocks(padding.body_mut(eliminated), size, |band, signals| {
                let mut scratch = self.scratch();
                let mut weight = vec![0.0; padding.width];
                for (index, signal) in signals.chunks_exact_mut(padding.width).enumerate() {
                    if control.is_cancelled() {
                        return;
                    }
                    let lines = self.cell_lines(0, band * BAND + index, input, &mut scratch);
                    let arch = pulp::Arch::new();
                    arch.dispatch(Gather { lines: &lines, signal, weight: &mut weight });
                    if let Input::Weight = input {
                        signal.fill(1.0);
                    }
                    arch.dispatch(Divide { signal, weight: &weight });
                }
            });
        } else {
            self.eliminate_turned(input, &mut eliminated, control);
        }
        self.eliminated = eliminated;
    }

    /// h where exposures are turned against each other: the sums of each view are brought together
    /// on the beam grid and turned into each view.
    fn eliminate_turned(&self, input: Input<'_>, eliminated: &mut [Vec<f32>], control: &Control) {
        let (padding, views) = (self.padding, &self.exposures.geometry().views);
        let gathered = |(index, view): (usize, &View)| {
            let mut signal = padding.zeros(view.shape.rows, self.workers, control);
            let mut weight = padding.zeros(view.shape.rows, self.workers, control);
            let (signals, weights) = (padding.body_mut(&mut signal), padding.body_mut(&mut weight));
            let size = BAND * padding.width;
            self.workers.map_pairs(signals, weights, [size; 2], |band, signals, weights| {
                let mut scratch = self.scratch();
                let signals = signals.chunks_exact_mut(padding.width);
                let weights = weights.chunks_exact_mut(padding.width);
                for (row, (signal, weight)) in signals.zip(weights).enumerate() {
                    if control.is_cancelled() {
                        return;
                    }
                    let lines = self.cell_lines(index, band * BAND + row, input, &mut scratch);
                    pulp::Arch::new().dispatch(Gather { lines: &lines, signal, weight });
                }
            });
            (signal, weight)
        };
        let sums: Vec<_> = views.iter().enumerate().map(gathered).collect();
        let beam_cols = self.exposures.geometry().beam.cols;
        for (view, eliminated) in views.iter().zip(eliminated) {
            let body = padding.body_mut(eliminated);
            self.workers.map_blocks(body, padding.width, |row, cells| {
                for (col, cell) in cells[..view.shape.cols].iter_mut().enumerate() {
                    let place = view.cells.at(row, col);
                    let [mut signal, mut weight] = [0.0; 2];
                    for (view, sums) in views.iter().zip(&sums) {
                        let place = view.places.at(place / beam_cols, place % beam_cols);
                        let (row, col) = (place / view.shape.cols, place % view.shape.cols);
                        signal += padding.row(&sums.0, row)[col];
                        weight += padding.row(&sums.1, row)[col];
                    }
                    if let Input::Weight = input {
                        signal = 1.0;
                    }
                    *cell = if weight > 0.0 { signal / weight } else { 0.0 };
                }
            });
        }
    }

    /// Finds 1/D, and how D ranges.
    fn invert_diagonal(&mut self, control: &Control) -> Result<()> {
        let (padding, cols) = (self.padding, self.exposures.sensor().cols);
        let mut diagonal = std::mem::take(&mut self.inverse_diagonal);
        let body = padding.body_mut(&mut diagonal);
        let bands = self.workers.map_blocks(body, BAND * padding.width, |band, rows| {
            let mut scratch = self.scratch();
            let mut sum = 0.0;
            for (index, diagonal) in rows.chunks_exact_mut(padding.width).enumerate() {
                if control.is_cancelled() {
                    break;
                }
                let lines = self.pixel_lines(band * BAND + index, &mut scratch);
                pulp::Arch::new().dispatch(Diagonal { lines: &lines, diagonal });
                diagonal[cols..].fill(0.0);
                sum += diagonal.iter().map(|&d| f64::from(d)).sum::<f64>();
            }
            sum
        });
        control.check()?;
        self.trace = bands.into_iter().sum();
        let bright = bright(body);
        let sensitivity = padding.body_mut(&mut self.sensitivity);
        let prior = self.weak.as_ref().map(|weak| padding.body(&weak.weights));
        let size = BAND * padding.width;
        let bands =
            self.workers.map_pairs(sensitivity, body, [size; 2], |band, sensitivity, rows| {
                let (mut sum, mut count, mut least) = (0.0, 0_usize, f32::INFINITY);
                for (index, (m, d)) in sensitivity.iter().zip(rows).enumerate() {
                    if *d > FAINTEST {
                        least = least.min(*d);
                    }
                    *d += prior.map_or(0.0, |prior| prior[band * size + index]);
                    if *d > FAINTEST {
                        *d = 1.0 / *d;
                        sum += f64::from(*m);
                        count += 1;
                    } else {
                        *d = 0.0;
                    }
                }
                (sum, count, least)
            });
        let (mut sum, mut count, mut least) = (0.0, 0, f32::INFINITY);
        for (of_band, in_band, of_faintest) in bands {
            sum += of_band;
            count += in_band;
            least = least.min(of_faintest);
        }
        self.mean = sum / count as f64;
        self.range = [f64::from(least), bright].map(|d| d / self.scale.slope());
        self.inverse_diagonal = diagonal;
        Ok(())
    }

    /// Adds ω = w c² L² M² of one exposure along a row of cells of its view to `sums`.
    pub(crate) fn weigh(
        &self,
        exposure: usize,
        row: usize,
        sums: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let place = &self.exposures.geometry().placements[exposure];
        let Some(pixel_row) = self.row_seeing(place, row) else { return };
        let scratch = &mut scratch.of_exposures[exposure].weight;
        let weight = self.weight(exposure, pixel_row, scratch);
        let line = Line {
            weight: weight.before(&self.padding, place.col),
            first: self.padding.row_before(&self.sensitivity, pixel_row, place.col),
            second: self.padding.row(&self.light[place.view], row),
        };
        pulp::Arch::new().dispatch(Weigh { line, sums });
    }

    /// The row of pixels that sees a row of cells, if one does.
    fn row_seeing(&self, place: &Placement, row: usize) -> Option<usize> {
        row.checked_sub(place.row).filter(|&row| row < self.exposures.sensor().rows)
    }

    /// The exposures that see a row of cells, with M of the pixels that do and what they show.
    fn cell_lines<'s>(
        &'s self,
        view: usize,
        row: usize,
        input: Input<'s>,
        scratch: &'s mut Scratch,
    ) -> Vec<Line<'s>> {
        let places = self.exposures.geometry().placements.iter().enumerate();
        places
            .zip(&mut scratch.of_exposures)
            .filter(|((_, place), _)| place.view == view)
            .filter_map(|((exposure, place), scratch)| {
                let pixel_row = self.row_seeing(place, row)?;
                let ExposureScratch { weight, noise } = scratch;
                let weight = self.weight(exposure, pixel_row, weight);
                let first = self.padding.row_before(&self.sensitivity, pixel_row, place.col);
                let second = match input {
                    Input::Step(x) => self.padding.row_before(x, pixel_row, place.col),
                    Input::Noise(noise_of) => {
                        let row = self.noise(noise_of, exposure, pixel_row, weight, noise);
                        &row[self.padding.lead - place.col..][..self.padding.width]
                    }
                    Input::Weight => first,
                };
                Some(Line { weight: weight.before(&self.padding, place.col), first, second })
            })
            .collect()
    }

    /// The exposures of a row of pixels, with L² and h of the cells that they see.
    pub(super) fn pixel_lines<'s>(&'s self, row: usize, scratch: &'s mut Scratch) -> Vec<Line<'s>> {
        let places = self.exposures.geometry().placements.iter().enumerate();
        places
            .zip(&mut scratch.of_exposures)
            .map(|((exposure, place), scratch)| {
                let view_row = row + place.row;
                Line {
                    weight: self.weight(exposure, row, &mut scratch.weight).at(&self.padding),
                    first: self.padding.row_from(&self.light[place.view], view_row, place.col),
                    second: self.padding.row_from(
                        &self.eliminated[place.view],
                        view_row,
                        place.col,
                    ),
                }
            })
            .collect()
    }

    /// w c² of a row of an exposure's pixels.
    pub(super) fn weight<'s>(
        &self,
        exposure: usize,
        row: usize,
        scratch: &'s mut Vec<f32>,
    ) -> RowWeight<'s> {
        if let Some(weight) = self.uniform_weight(exposure) {
            return RowWeight::Same(weight);
        }
        scratch.resize(2 * self.padding.lead + self.padding.width, 0.0);
        let weights = &mut scratch[self.padding.lead..][..self.exposures.sensor().cols];
        let cols = 0..weights.len();
        self.exposures.rough_weights(exposure, row, cols, self.factor(exposure), weights);
        RowWeight::Padded(scratch)
    }

    /// What a weight of an exposure is multiplied by, and the most that it may be then.
    fn factor(&self, exposure: usize) -> [f64; 2] {
        [self.exposures.flux()[exposure].powi(2) / self.scale.weight, LARGEST]
    }

    /// w c² of an exposure whose measurements all have the same weight.
    pub(super) fn uniform_weight(&self, exposure: usize) -> Option<f32> {
        let [factor, largest] = self.factor(exposure);
        let weight = self.exposures.uniform_weight(exposure)?;
        Some((weight * factor).min(largest) as f32)
    }

    /// w c² of a measurement of a pixel of the padded image.
    pub(super) fn weight_of(&self, exposure: usize, pixel: usize) -> f32 {
        let place = pixel - self.padding.lead;
        let (row, col) = (place / self.padding.width, place % self.padding.width);
        let mut weight = [0.0];
        let factor = self.factor(exposure);
        self.exposures.rough_weights(exposure, row, col..col + 1, factor, &mut weight);
        weight[0]
    }

    /// L² h of a cell of the only view, where h is what the last elimination left there.
    pub(super) fn share_of_cell(&self, cell: usize) -> f32 {
        self.light[0][cell] * self.eliminated[0][cell]
    }

    pub(crate) fn scratch(&self) -> Scratch {
        Scratch { of_exposures: vec![ExposureScratch::default(); self.exposures.count()] }
    }
}

/// Buffers for the weights of one row of each exposure.
pub(crate) struct Scratch {
    pub(super) of_exposures: Vec<ExposureScratch>,
}

#[derive(Clone, Default)]
pub(super) struct ExposureScratch {
    pub(super) weight: Vec<f32>,
    pub(super) noise: Vec<f32>,
}

/// A draw of noise, by its number.
#[derive(Clone, Copy)]
pub(crate) enum Draw {
    /// Of each measurement by itself.
    Measurements(u64),
    /// Of the dark, less what M follows of it (`dark_noise.rs`).
    Dark(u64),
}

/// What each exposure brings into the elimination of the beam.
#[derive(Clone, Copy)]
pub(super) enum Input<'x> {
    /// The step x.
    Step(&'x [f32]),
    /// The noise of a draw, in place of M h.
    Noise(Draw),
    /// Nothing: in place of h stands 1/Σ w c² M².
    Weight,
}

/// Weights of a row of pixels.
#[derive(Clone, Copy)]
pub(super) enum RowWeight<'s> {
    Same(f32),
    /// With zeros before and after.
    Padded(&'s [f32]),
}

impl<'s> RowWeight<'s> {
    pub(super) fn at(self, padding: &Padding) -> Weight<'s> {
        self.before(padding, 0)
    }

    /// The weights from so many columns further left.
    fn before(self, padding: &Padding, left: usize) -> Weight<'s> {
        match self {
            Self::Same(weight) => Weight::Same(weight),
            Self::Padded(row) => Weight::Each(&row[padding.lead - left..][..padding.width]),
        }
    }
}

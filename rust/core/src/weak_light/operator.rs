//! The prior in the linear problem of whole shifts.
//!
//! With t = Σ x / Σ M over a piece of connected pixels it adds Vᵀ Λ V, V x = x − M t, to S: a change of M by a
//! factor in a whole piece still weighs nothing.

use std::sync::Arc;

use super::prior::Prior;
use crate::coarse::Hats;
use crate::connectivity::NONE;
use crate::frames::Shape;
use crate::padded::{BAND, Padding};
use crate::parallel::Workers;
use crate::random;

/// The linear problem that the prior is a part of: its images are padded.
pub(crate) struct Site<'r> {
    pub(crate) sensor: Shape,
    pub(crate) padding: Padding,
    pub(crate) workers: &'r Workers,
    /// M.
    pub(crate) sensitivity: &'r [f32],
}

/// The prior's part of S at one M.
pub(crate) struct Term {
    /// λ/μ², in the units of S, padded.
    pub(crate) weights: Vec<f32>,
    pieces: Arc<[i32]>,
    /// Σ M of each piece.
    totals: Vec<f64>,
}

/// Sums over the pixels of each piece; in bands of rows where there is one piece.
fn sums(
    pieces: &[i32],
    count: usize,
    cols: usize,
    workers: &Workers,
    value: impl Fn(usize, usize) -> f64 + Sync + Send,
) -> Vec<f64> {
    let of_row = |row: usize, sums: &mut [f64]| {
        for (col, &piece) in pieces[row * cols..][..cols].iter().enumerate() {
            if piece != NONE {
                sums[piece as usize] += value(row, col);
            }
        }
    };
    let rows = pieces.len() / cols;
    let mut total = vec![0.0; count];
    if count == 1 {
        let by_band = workers.map(rows.div_ceil(BAND), |band| {
            let mut sum = [0.0];
            (band * BAND..rows.min((band + 1) * BAND)).for_each(|row| of_row(row, &mut sum));
            sum[0]
        });
        total[0] = by_band.into_iter().sum();
    } else {
        (0..rows).for_each(|row| of_row(row, &mut total));
    }
    total
}

impl Term {
    /// That of a prior at this M; `scale` brings a curvature to the units of S.
    pub(crate) fn new(prior: &Prior, scale: f64, sensitivity: &[f64], site: &Site<'_>) -> Self {
        let (padding, cols) = (site.padding, site.sensor.cols);
        let mut weights = vec![0.0; site.sensitivity.len()];
        for (row, line) in
            padding.body_mut(&mut weights).chunks_exact_mut(padding.width).enumerate()
        {
            for (col, weight) in line[..cols].iter_mut().enumerate() {
                *weight = (prior.curvature(row * cols + col) * scale) as f32;
            }
        }
        let pieces = Arc::clone(&prior.pieces);
        let count = pieces.iter().max().map_or(0, |&last| (last + 1) as usize);
        let value = |row: usize, col: usize| sensitivity[row * cols + col];
        let totals = sums(&pieces, count, cols, site.workers, value);
        Self { weights, pieces, totals }
    }

    /// Adds Vᵀ Λ V x to a product; returns x · Vᵀ Λ V x.
    pub(crate) fn add(&self, site: &Site<'_>, x: &[f32], product: &mut [f32]) -> f64 {
        let (padding, cols) = (site.padding, site.sensor.cols);
        let by_piece = |value: &(dyn Fn(usize, usize) -> f64 + Sync + Send)| {
            sums(&self.pieces, self.totals.len(), cols, site.workers, value)
        };
        let lead = padding.lead;
        let place = |row: usize, col: usize| lead + row * padding.width + col;
        let moved = by_piece(&|row, col| f64::from(x[place(row, col)]));
        let shares: Vec<f64> =
            moved.iter().zip(&self.totals).map(|(sum, total)| sum / total).collect();
        let varied = |row: usize, col: usize| {
            let (at, piece) = (place(row, col), self.pieces[row * cols + col] as usize);
            f64::from(x[at]) - shares[piece] * f64::from(site.sensitivity[at])
        };
        let weight = |row: usize, col: usize| f64::from(self.weights[place(row, col)]);
        let pull = |row: usize, col: usize| match weight(row, col) {
            0.0 => 0.0,
            weight => weight * varied(row, col),
        };
        let energy = by_piece(&|row, col| match weight(row, col) {
            0.0 => 0.0,
            weight => weight * varied(row, col).powi(2),
        });
        self.add_balanced(site, product, pull);
        energy.iter().sum()
    }

    /// Adds Vᵀ of what is pulled at pixels.
    fn add_balanced(
        &self,
        site: &Site<'_>,
        product: &mut [f32],
        pull: impl Fn(usize, usize) -> f64 + Sync + Send,
    ) {
        let (padding, cols) = (site.padding, site.sensor.cols);
        let count = self.totals.len();
        let moment = |row: usize, col: usize| {
            pull(row, col) * f64::from(site.sensitivity[padding.lead + row * padding.width + col])
        };
        let common = sums(&self.pieces, count, cols, site.workers, moment);
        let common: Vec<f64> =
            common.iter().zip(&self.totals).map(|(sum, total)| sum / total).collect();
        let body = padding.body_mut(product);
        site.workers.map_blocks(body, BAND * padding.width, |band, rows| {
            for (index, line) in rows.chunks_exact_mut(padding.width).enumerate() {
                let row = band * BAND + index;
                let pieces = &self.pieces[row * cols..][..cols];
                for (col, (value, &piece)) in line.iter_mut().zip(pieces).enumerate() {
                    if let Ok(piece) = usize::try_from(piece) {
                        *value += (pull(row, col) - common[piece]) as f32;
                    }
                }
            }
        });
    }

    /// What the prior adds to the hats' own elements of the coarse matrix.
    pub(crate) fn of_hats(&self, site: &Site<'_>, hats: &Hats) -> Vec<f64> {
        let mut own = vec![0.0; hats.count()];
        for row in 0..site.sensor.rows {
            let line = site.padding.row(&self.weights, row).iter();
            let pixels = line.zip(site.padding.row(site.sensitivity, row)).enumerate();
            for (col, (&weight, &m)) in pixels.filter(|(_, (weight, _))| **weight > 0.0) {
                for (hat, height) in hats.over(row as f64, col as f64) {
                    own[hat] += height * f64::from(weight * m * m);
                }
            }
        }
        own
    }

    /// Adds a draw of the prior's noise, of the covariance of its part of S, to a right-hand side.
    pub(crate) fn draw(&self, site: &Site<'_>, draw: u64, slope: &mut [f32]) {
        let (sensor, padding) = (site.sensor, site.padding);
        let signs = site.workers.map(sensor.rows, |row| {
            let mut sign = random::signs_of_prior(draw, row, sensor.rows);
            (0..sensor.cols).map(|_| sign()).collect::<Vec<f64>>()
        });
        self.add_balanced(site, slope, |row, col| {
            f64::from(padding.row(&self.weights, row)[col]).sqrt() * signs[row][col]
        });
    }
}

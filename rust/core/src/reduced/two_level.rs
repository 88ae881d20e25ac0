//! The two-level preconditioner of the linear problem S x = b.
//!
//! ```text
//! P⁻¹ b = b/D + γ Φ A⁻¹ Φᵀ b
//! ```
//!
//! The first level, the diagonal of S, does for errors of the scale of pixels what a sweep does. The
//! second solves for errors of larger scale exactly: the columns of Φ are bilinear hats φ_i(p) on a
//! coarse grid over the sensor, times M(p), so that their sum is the gauge direction M itself. The
//! grid is three times as wide as the largest shift, since an error shorter than that is seen by
//! the first level; then the number of iterations does not depend on the size of the sensor.
//!
//! A = Φᵀ S Φ is summed over blocks of beam cells: the weights ω_k of an exposure are summed within
//! a block exactly, and the hats are evaluated at its centre:
//!
//! ```text
//! yᵀAy = Σ_blocks [ Σ_k Ω_k g_k² − (Σ_k Ω_k g_k)² / Σ_k Ω_k ],   g_k = Σ_i y_i φ_i(centre − d_k)
//! ```
//!
//! Each block adds a positive semidefinite part in which constants weigh nothing, so A is one too.
//! A slight ridge makes it definite: what it is not definite in, by constants in pieces that do not
//! hang together or by shifts along one line only, is no error that S can see.
//!
//! What exposures barely constrain besides is not smooth, and has columns of its own: hats times its
//! deepest waves, or aggregates of pixels where its waves are many (`ShortWaves`).

use super::aggregated::Aggregated;
use super::blocks::coarse_spaces;
use super::operator::Reduced;
use super::two_level_kernel::{Close, Descend, Direction};
use crate::coarse::{Coarse, DAMPING, Hats, Modulated, ShortWaves, spacing};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::padded::{BAND, Padding};
use crate::parallel::Workers;

/// The preconditioner, at the weights for which it was made.
pub(crate) struct TwoLevel<'m> {
    workers: &'m Workers,
    padding: Padding,
    hats: Hats,
    short: ShortWaves,
    coarse: Option<Coarse>,
    /// One value a hat: Φᵀ r, then the heights y.
    heights: Vec<f64>,
    /// Those heights along the rows of the coarse grid, at every column of the sensor.
    spread: Vec<f32>,
    /// Hats times waves, or aggregates, and their heights; those of waves likewise along rows.
    waves: Option<Modulated<f32>>,
    aggregated: Option<Aggregated>,
    fine: Vec<f32>,
}

impl<'m> TwoLevel<'m> {
    /// The hats over the sensor of `model`.
    pub(crate) fn new<T: Real>(
        exposures: &'m Exposures<'_, T>,
        padding: Padding,
        workers: &'m Workers,
    ) -> Self {
        let geometry = exposures.geometry();
        let hats = Hats::new(exposures.sensor(), spacing(geometry));
        let spread = vec![0.0; hats.rows.nodes * padding.width];
        let heights = vec![0.0; hats.count()];
        Self {
            workers,
            padding,
            hats,
            short: ShortWaves::of(exposures, exposures.flux()),
            coarse: None,
            heights,
            spread,
            waves: None,
            aggregated: None,
            fine: Vec::new(),
        }
    }

    /// Sums and factorises the coarse matrix, unless that has been done at other weights: it need
    /// not be exact.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn prepare<T: Real>(
        &mut self,
        reduced: &mut Reduced<'_, '_, T>,
        control: &Control,
    ) -> Result<()> {
        if self.coarse.is_none() {
            let Self { hats, short, workers, .. } = self;
            let (coarse, waves) = coarse_spaces(hats, short, reduced, workers, control)?;
            if let ShortWaves::Aggregates { .. } = short {
                self.aggregated = Some(Aggregated::new(reduced, workers, control)?);
            }
            self.waves = Some(waves).filter(|waves| !waves.is_empty());
            self.coarse = Some(coarse);
        }
        Ok(())
    }

    /// Has it made anew.
    pub(crate) fn forget(&mut self) {
        (self.coarse, self.waves, self.aggregated) = (None, None, None);
    }

    /// Whether large scales are in it: without a factor of the coarse matrix nothing sees them.
    pub(crate) fn sees_large_scales(&self) -> bool {
        self.coarse.as_ref().is_some_and(Coarse::is_factorised)
    }

    /// r ← r − a q, and finds P⁻¹ r, which [`turn`](Self::turn) makes use of; returns r · P⁻¹ r.
    pub(crate) fn descend<T: Real>(
        &mut self,
        reduced: &Reduced<'_, '_, T>,
        residual: &mut [f32],
        step: f64,
        product: &[f32],
    ) -> f64 {
        let (padding, hats) = (self.padding, &self.hats);
        let bands = self.workers.map_blocks(
            padding.body_mut(residual),
            SUMMED * padding.width,
            |band, rows| {
                let mut sums = CoarseSums::new(hats, padding.width);
                // M r, of all rows where waves need it.
                let kept = if self.waves.is_some() { rows.len() } else { padding.width };
                let mut level = vec![0.0; kept];
                let mut total = 0.0;
                for (index, residual) in rows.chunks_exact_mut(padding.width).enumerate() {
                    let row = band * SUMMED + index;
                    let (height, above, below) = sums.around(row);
                    total += pulp::Arch::new().dispatch(Descend {
                        residual,
                        step: step as f32,
                        product: padding.row(product, row),
                        inverse_diagonal: padding.row(&reduced.inverse_diagonal, row),
                        sensitivity: padding.row(&reduced.sensitivity, row),
                        height,
                        above,
                        below,
                        level: &mut level[index * padding.width % kept..][..padding.width],
                    });
                }
                let of_waves = self.waves.as_ref();
                let of_waves =
                    of_waves.map(|waves| waves.gather(band * SUMMED, &level, padding.width));
                (total, sums.finish(), of_waves.unwrap_or_default())
            },
        );
        self.heights.fill(0.0);
        let mut by_diagonal = 0.0;
        let mut of_waves = vec![0.0; self.waves.as_ref().map_or(0, Modulated::size)];
        for (total, sums, waves) in bands {
            by_diagonal += total;
            for (first, sums) in waves {
                of_waves[first..].iter_mut().zip(sums).for_each(|(sum, found)| *sum += found);
            }
            for (first, sums) in sums {
                for (height, sum) in self.heights[first..].iter_mut().zip(sums) {
                    *height += sum;
                }
            }
        }
        let Self { workers, padding, hats, coarse, heights, spread, waves, aggregated, .. } = self;
        let of_hats = || solve_hats(hats, coarse.as_ref(), heights, spread, padding.width, workers);
        let of_fine = || match (waves, aggregated) {
            (Some(waves), _) => solve_waves(waves, of_waves, padding.width, workers),
            (None, Some(aggregated)) => aggregated.solve(residual, &reduced.sensitivity, workers),
            (None, None) => (0.0, Vec::new()),
        };
        let (by_hats, (by_fine, fine)) = workers.both(of_hats, of_fine);
        self.fine = fine;
        by_diagonal + by_fine + by_hats
    }

    /// x ← x + a p, then p ← P⁻¹ r + b p for the r of the last [`descend`](Self::descend); returns
    /// the largest size of P⁻¹ r.
    pub(crate) fn turn<T: Real>(
        &self,
        reduced: &Reduced<'_, '_, T>,
        residual: &[f32],
        [x, direction]: [&mut [f32]; 2],
        [step, keep]: [f64; 2],
    ) -> f64 {
        let (padding, hats) = (self.padding, &self.hats);
        let (x, direction) = (padding.body_mut(x), padding.body_mut(direction));
        let size = BAND * padding.width;
        let bands = self.workers.map_pairs(x, direction, [size; 2], |band, x, direction| {
            let mut modulated = vec![0.0; x.len()];
            if let Some(waves) = &self.waves {
                waves.spread(&self.fine, band * BAND, &mut modulated, padding.width);
            }
            if let Some(aggregated) = &self.aggregated {
                aggregated.spread(&self.fine, band * BAND, &mut modulated);
            }
            let rows = x.chunks_exact_mut(padding.width);
            let rows = rows.zip(direction.chunks_exact_mut(padding.width)).enumerate();
            let by_row = rows.map(|(index, (x, direction))| {
                let row = band * BAND + index;
                let (node, height) = hats.rows.at(row as f64);
                let spread = &self.spread[node * padding.width..];
                pulp::Arch::new().dispatch(Direction {
                    x,
                    direction,
                    step: step as f32,
                    keep: keep as f32,
                    residual: padding.row(residual, row),
                    inverse_diagonal: padding.row(&reduced.inverse_diagonal, row),
                    sensitivity: padding.row(&reduced.sensitivity, row),
                    height: height as f32,
                    above: &spread[..padding.width],
                    below: &spread[padding.width..][..padding.width],
                    modulated: &modulated[index * padding.width..][..padding.width],
                })
            });
            by_row.fold(0.0, f32::max)
        });
        f64::from(bands.into_iter().fold(0.0, f32::max))
    }
}

/// Replaces Φᵀ r by the heights of the hats, and finds those along the rows of the coarse grid; returns the
/// product of the two.
fn solve_hats(
    hats: &Hats,
    coarse: Option<&Coarse>,
    heights: &mut [f64],
    spread: &mut [f32],
    width: usize,
    workers: &Workers,
) -> f64 {
    let right = heights.to_vec();
    match coarse {
        Some(coarse) => coarse.correct(heights, DAMPING),
        None => heights.fill(0.0),
    }
    workers.map_blocks(spread, width, |row, line| {
        let heights = &heights[row * hats.cols.nodes..][..hats.cols.nodes];
        for (value, &(node, height)) in line.iter_mut().zip(&hats.columns) {
            let (left, right) = (heights[node as usize], heights[node as usize + 1]);
            *value = (left + f64::from(height) * (right - left)) as f32;
        }
    });
    right.iter().zip(heights).map(|(b, y)| b * *y).sum()
}

/// The product of Ψᵀ r and the heights of waves that follow from it, and these along the rows of the coarse
/// grid.
fn solve_waves(
    waves: &Modulated<f32>,
    right: Vec<f64>,
    width: usize,
    workers: &Workers,
) -> (f64, Vec<f32>) {
    let mut heights = right.clone();
    waves.correct(&mut heights, workers);
    let product = right.iter().zip(&heights).map(|(b, y)| b * y).sum();
    (product, waves.open(&heights, width, workers))
}

/// Rows whose sums over hats a thread makes at a time.
const SUMMED: usize = 64;

/// Φᵀ r over some rows of the sensor.
struct CoarseSums<'h> {
    hats: &'h Hats,
    width: usize,
    node: usize,
    /// Of the coarse rows above and below, by column of the sensor.
    sums: [Vec<f32>; 2],
    found: Vec<(usize, Vec<f64>)>,
}

impl<'h> CoarseSums<'h> {
    fn new(hats: &'h Hats, width: usize) -> Self {
        let sums = [vec![0.0; width], vec![0.0; width]];
        Self { hats, width, node: usize::MAX, sums, found: Vec::new() }
    }

    /// The height of the hats below along `row`, and the sums to add to.
    fn around(&mut self, row: usize) -> (f32, &mut [f32], &mut [f32]) {
        let (node, height) = self.hats.rows.at(row as f64);
        if node != self.node {
            self.close();
            self.node = node;
        }
        let [above, below] = &mut self.sums;
        (height as f32, above, below)
    }

    /// Sums along the rows, of what was added since the coarse row changed.
    fn close(&mut self) {
        let cols = self.hats.cols.nodes;
        if self.node == usize::MAX {
            return;
        }
        for (below, sums) in self.sums.iter_mut().enumerate() {
            let mut found = vec![0.0; cols];
            let mut first = 0;
            for columns in self.hats.columns.chunk_by(|(a, _), (b, _)| a == b) {
                let (node, height) = self.hats.cols.at(first as f64);
                let sums = &sums[first..first + columns.len()];
                let [all, moment] = pulp::Arch::new().dispatch(Close(sums));
                let right = height * all + moment / self.hats.cols.spacing;
                found[node] += all - right;
                found[node + 1] += right;
                first += columns.len();
            }
            sums.clear();
            sums.resize(self.width, 0.0);
            self.found.push(((self.node + below) * cols, found));
        }
    }

    /// The sums found, each with the first hat that it belongs to.
    fn finish(mut self) -> Vec<(usize, Vec<f64>)> {
        self.close();
        self.found
    }
}

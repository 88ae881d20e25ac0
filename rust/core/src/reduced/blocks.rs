//! The coarse spaces of S, with their matrices summed over blocks of beam cells.

use super::operator::Reduced;
use crate::coarse::{self, Coarse, Entry, Hats, Modulated, ShortWaves, Spot, spacing_of_waves};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::{Real, Shape};
use crate::geometry::{Geometry, Placement, Walk};
use crate::parallel::Workers;

/// Blocks of cells along the distance of two hats.
const BLOCKS: usize = 3;

/// What the coarse spaces of these exposures take, in bytes: those of aggregates for each place of the padded
/// sensor.
pub(super) fn bytes_needed<T: Real>(exposures: &Exposures<'_, T>, places: u64) -> u64 {
    let short = ShortWaves::of(exposures, exposures.flux());
    let of_aggregates = match short {
        ShortWaves::Aggregates { bytes, .. } => bytes as u64 * places,
        ShortWaves::Waves(_) => 0,
    };
    coarse::bytes_needed(exposures.geometry(), short.waves().len()) + of_aggregates
}

/// The hats with the coarse matrix of S, factorised, and those times waves.
///
/// # Errors
/// [`Error::Cancelled`](crate::Error::Cancelled).
pub(super) fn coarse_spaces<T: Real>(
    hats: &Hats,
    short: &ShortWaves,
    reduced: &Reduced<'_, '_, T>,
    workers: &Workers,
    control: &Control,
) -> Result<(Coarse, Modulated<f32>)> {
    let geometry = reduced.exposures.geometry();
    let blocks = Blocks::new(hats, geometry);
    let weights = blocks.weights(geometry, reduced, workers, control)?;
    let entries = weights
        .chunks_exact(geometry.placements.len())
        .enumerate()
        .map(|(block, weights)| blocks.entries(block, weights, hats, geometry));
    let coarse = Coarse::of_blocks(hats, &reduced.prior_of_hats(hats), &[], entries, control)?;
    control.check()?;
    let finer = Hats::new(geometry.sensor, spacing_of_waves(geometry));
    // What a prior holds is no wave.
    let seen = if reduced.weak.is_some() { &[] } else { short.waves() };
    let spots: Vec<Vec<Spot>> = match seen {
        [] => Vec::new(),
        _ => weights
            .chunks_exact(geometry.placements.len())
            .enumerate()
            .map(|(block, weights)| blocks.spots(block, weights, &finer, geometry))
            .collect(),
    };
    let waves = Modulated::new(finer, geometry.sensor.rows, seen, &spots, workers);
    Ok((coarse, waves))
}

/// The blocks of cells, numbered row by row of the beam grid.
struct Blocks {
    rows: Vec<usize>,
    cols: Vec<usize>,
}

impl Blocks {
    fn new(hats: &Hats, geometry: &Geometry) -> Self {
        let sizes = [hats.rows.spacing, hats.cols.spacing].map(|s| (s as usize / BLOCKS).max(1));
        let turned = geometry.views.iter().any(|view| view.rotation.swaps_axes());
        let [height, width] = if turned { [sizes[0].min(sizes[1]); 2] } else { sizes };
        let edges = |length: usize, size: usize| {
            (0..length).step_by(size).chain(std::iter::once(length)).collect()
        };
        Self { rows: edges(geometry.beam.rows, height), cols: edges(geometry.beam.cols, width) }
    }

    fn shape(&self) -> Shape {
        Shape::new(self.rows.len() - 1, self.cols.len() - 1)
    }

    /// Ω of each block and exposure.
    fn weights<T: Real>(
        &self,
        geometry: &Geometry,
        reduced: &Reduced<'_, '_, T>,
        workers: &Workers,
        control: &Control,
    ) -> Result<Vec<f32>> {
        let count = geometry.placements.len();
        let mut weights = vec![0.0; self.shape().len() * count];
        for (index, view) in geometry.views.iter().enumerate() {
            let [rows, cols] = view.rotation.turned_edges(&self.rows, &self.cols);
            let blocks = Walk::new(view.rotation, self.shape());
            let seen = |&(_, place): &(usize, &Placement)| place.view == index;
            let exposures: Vec<_> =
                geometry.placements.iter().enumerate().filter(seen).map(|(k, _)| k).collect();
            let by_row = workers.map(rows.len() - 1, |i| {
                let mut scratch = reduced.scratch();
                let mut found = Vec::with_capacity((cols.len() - 1) * exposures.len());
                for &exposure in &exposures {
                    let mut sums = vec![0.0; reduced.padding.width];
                    for row in rows[i]..rows[i + 1] {
                        control.check()?;
                        reduced.weigh(exposure, row, &mut sums, &mut scratch);
                    }
                    found.extend(cols.windows(2).map(|c| sums[c[0]..c[1]].iter().sum::<f32>()));
                }
                Ok(found)
            });
            for (i, found) in by_row.into_iter().enumerate() {
                let found: Vec<f32> = found?;
                for (&exposure, found) in exposures.iter().zip(found.chunks_exact(cols.len() - 1)) {
                    for (j, weight) in found.iter().enumerate() {
                        weights[blocks.at(i, j) * count + exposure] = *weight;
                    }
                }
            }
        }
        Ok(weights)
    }

    /// What one block adds.
    fn entries(
        &self,
        block: usize,
        weights: &[f32],
        hats: &Hats,
        geometry: &Geometry,
    ) -> Vec<Entry> {
        let spots = self.spots(block, weights, hats, geometry).into_iter();
        spots.map(|Spot { weight, hats, .. }| Entry { weight, hats, others: Vec::new() }).collect()
    }

    /// The weight of each exposure in a block and the hats at the pixel that sees its centre.
    fn spots(&self, block: usize, weights: &[f32], hats: &Hats, geometry: &Geometry) -> Vec<Spot> {
        let (i, j) = (block / self.shape().cols, block % self.shape().cols);
        let centre = |edges: &[usize], at: usize| (edges[at] + edges[at + 1] - 1) as f64 / 2.0;
        let centre = [centre(&self.rows, i), centre(&self.cols, j)];
        let exposures = geometry.placements.iter().zip(weights).enumerate();
        let seeing = exposures.filter(|(_, (_, weight))| **weight > 0.0);
        seeing
            .map(|(exposure, (place, &weight))| {
                let rotation = geometry.views[place.view].rotation;
                let [row, col] = rotation.to_view(centre, geometry.beam);
                let hats = hats.over(row - place.row as f64, col - place.col as f64);
                Spot { exposure, weight: f64::from(weight), hats }
            })
            .collect()
    }
}

//! Which lines of data meet in a row of pixels, and in a row of beam cells.

use std::ops::Range;

use super::kernel::{Line, STRETCH, Scratch};
use crate::exposures::{Exposures, Stretch};
use crate::frames::Real;
use crate::geometry::Placement;
use crate::median::median;

/// The least y/c of each pixel of a row; infinite without measurement.
pub(super) fn darkest<T: Real>(
    exposures: &Exposures<'_, T>,
    row: usize,
    scratch: &mut [f64],
) -> Vec<f64> {
    let mut least = vec![f64::INFINITY; scratch.len()];
    for (exposure, flux) in exposures.flux().iter().enumerate() {
        match exposures.stretch(exposure, row, 0..least.len(), scratch) {
            Stretch::Uniform(values, _) => {
                for (least, value) in least.iter_mut().zip(values) {
                    *least = least.min(value.to_f64() / flux);
                }
            }
            Stretch::Weighted(values, weights) => {
                for ((least, value), &weight) in least.iter_mut().zip(values).zip(weights) {
                    let value = if weight > 0.0 { value.to_f64() / flux } else { f64::INFINITY };
                    *least = least.min(value);
                }
            }
        }
    }
    least
}

/// Whether a pixel `differs` from those of a stretch of its row, their median, in each exposure: an edge of the
/// beam makes pixels differ in some exposures only.
pub(super) fn stands_out<T: Real>(
    exposures: &Exposures<'_, T>,
    [row, col]: [usize; 2],
    around: &Range<usize>,
    differs: impl Fn(f64, f64) -> bool,
) -> bool {
    let mut scratch = vec![0.0; around.len()];
    (0..exposures.count()).all(|exposure| {
        let mut found: Vec<f64> =
            match exposures.stretch(exposure, row, around.clone(), &mut scratch) {
                Stretch::Uniform(values, _) => values.iter().map(|value| value.to_f64()).collect(),
                // A measurement that is not used may have any value, or none.
                Stretch::Weighted(values, weights) => {
                    let used = |(value, weight): (&T, &f64)| {
                        if *weight > 0.0 { value.to_f64() } else { f64::NAN }
                    };
                    values.iter().zip(weights).map(used).collect()
                }
            };
        let own = found[col - around.start];
        found.retain(|value| value.is_finite());
        !own.is_finite() || median(&mut found, f64::total_cmp).is_none_or(|m| differs(own, m))
    })
}

/// The exposures along a stretch of a row of pixels, with the beam that they see.
pub(super) fn pixel_lines<'s, T: Real>(
    exposures: &Exposures<'s, T>,
    beams: &'s [Vec<f64>],
    row: usize,
    cols: Range<usize>,
    scratch: &'s mut Scratch,
) -> Vec<Line<'s, T>> {
    let places = exposures.geometry().placements.iter().zip(exposures.flux()).enumerate();
    places
        .zip(&mut scratch.weights)
        .map(|((exposure, (place, &flux)), weights)| {
            let view_cols = exposures.geometry().views[place.view].shape.cols;
            let first = (row + place.row) * view_cols + place.col + cols.start;
            let known = &beams[place.view][first..][..cols.len()];
            Line { measured: exposures.stretch(exposure, row, cols.clone(), weights), known, flux }
        })
        .collect()
}

/// One row of beam cells, in one view, and what the exposures there see of it.
pub(super) struct BeamRow<'r, 'a, T> {
    pub(super) exposures: &'r Exposures<'a, T>,
    pub(super) sensitivity: &'r [f64],
    pub(super) view: usize,
    pub(super) row: usize,
}

impl<T: Real> BeamRow<'_, '_, T> {
    /// Calls `work(lines, cells)` for each stretch of cells that the same exposures see.
    pub(super) fn for_each_stretch(
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
        let cols = self.exposures.sensor().cols;
        let ends = self.seeing().flat_map(|(_, place)| [place.col, place.col + cols]);
        let mut edges: Vec<usize> = ends.collect();
        edges.sort_unstable();
        edges.dedup();
        edges
    }

    /// The exposures whose windows reach this row.
    fn seeing(&self) -> impl Iterator<Item = (usize, &Placement)> {
        let rows = self.exposures.sensor().rows;
        let places = self.exposures.geometry().placements.iter().enumerate();
        places.filter(move |(_, place)| {
            place.view == self.view && (place.row..place.row + rows).contains(&self.row)
        })
    }

    /// The exposures that see `cells`, with the sensitivities of the pixels that do.
    fn lines<'s>(&'s self, cells: Range<usize>, scratch: &'s mut Scratch) -> Vec<Line<'s, T>> {
        let cols = self.exposures.sensor().cols;
        let seeing = self
            .seeing()
            .filter(|(_, place)| place.col <= cells.start && cells.end <= place.col + cols);
        seeing
            .zip(&mut scratch.weights)
            .map(|((exposure, place), weights)| {
                let row = self.row - place.row;
                let pixels = cells.start - place.col..cells.end - place.col;
                let known = &self.sensitivity[row * cols..][pixels.clone()];
                let measured = self.exposures.stretch(exposure, row, pixels, weights);
                Line { measured, known, flux: self.exposures.flux()[exposure] }
            })
            .collect()
    }
}

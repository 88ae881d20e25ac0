//! The aggregates of pixels of S, with their matrix.

use std::collections::BTreeMap;

use super::operator::{Input, Reduced};
use crate::coarse::{Cycle, Edges, Graph, NONE, Partition, STRONG};
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::padded::Padding;
use crate::parallel::Workers;

/// The factor of what aggregates find, since the diagonal and the hats see a part of it too.
const DAMPING: f64 = 0.5;

/// Aggregates of pixels.
pub(super) struct Aggregated {
    padding: Padding,
    pixels: Partition,
    cycle: Cycle,
}

impl Aggregated {
    /// Those of S at its M and L, for exposures of one orientation.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(super) fn new<T: Real>(
        reduced: &mut Reduced<'_, '_, T>,
        workers: &Workers,
        control: &Control,
    ) -> Result<Self> {
        let (pixels, graph) = graph(reduced, workers, control)?;
        Ok(Self { padding: reduced.padding, pixels, cycle: Cycle::new(graph, workers, control)? })
    }

    /// The product of Φᵀ r and the heights that follow from it, and these.
    pub(super) fn solve(
        &self,
        residual: &[f32],
        sensitivity: &[f32],
        workers: &Workers,
    ) -> (f64, Vec<f32>) {
        let of = |pixel: usize| f64::from(residual[pixel] * sensitivity[pixel]);
        let right = self.pixels.sums(of, workers);
        let heights = self.cycle.solve(&right, workers);
        let product = right.iter().zip(&heights).map(|(b, y)| DAMPING * b * y).sum();
        (product, heights.into_iter().map(|y| (DAMPING * y) as f32).collect())
    }

    /// Heights at rows of pixels from `first` on.
    pub(super) fn spread(&self, heights: &[f32], first: usize, values: &mut [f32]) {
        let pixels = &self.padding.body(&self.pixels.of)[first * self.padding.width..];
        for (value, &aggregate) in values.iter_mut().zip(pixels) {
            *value = if aggregate == NONE { 0.0 } else { heights[aggregate as usize] };
        }
    }
}

/// The aggregates, and their matrix Φᵀ S Φ.
fn graph<T: Real>(
    reduced: &mut Reduced<'_, '_, T>,
    workers: &Workers,
    control: &Control,
) -> Result<(Partition, Graph)> {
    reduced.eliminate(Input::Weight, control);
    control.check()?;
    let reduced = &*reduced;
    let places = &reduced.exposures.geometry().placements;
    let places: Vec<usize> =
        places.iter().map(|place| place.row * reduced.padding.width + place.col).collect();
    let inverse = &reduced.inverse_diagonal;
    let apart = apart(&places, &reduced.exposures.shares());
    let beside = |pixel: usize| apart.iter().map(move |apart| (pixel.wrapping_add(*apart), 1.0));
    let is_used = |pixel: usize| inverse[pixel] > 0.0;
    let pixels = Partition::neighbourhoods(inverse.len(), is_used, beside, control)?;
    let uniform = (0..places.len()).map(|exposure| reduced.uniform_weight(exposure)).collect();
    let edges = Pixels { reduced, places, pixels: &pixels, uniform };
    let graph = pixels.graph(&edges, workers, control)?;
    Ok((pixels, graph))
}

/// How far apart pixels are, in a padded image, that see a cell in two exposures of much weight: in what
/// exposures barely constrain such pixels are nearly alike. There are as many pairs at least as connect all
/// positions.
fn apart(places: &[usize], shares: &[f64]) -> Vec<usize> {
    let mut by_place = BTreeMap::new();
    for (&place, share) in places.iter().zip(shares) {
        *by_place.entry(place).or_insert(0.0) += share;
    }
    let seen: Vec<(usize, f64)> = by_place.into_iter().collect();
    let others = |one: usize| seen.iter().skip(one + 1);
    let mut pairs: Vec<(f64, usize)> = seen
        .iter()
        .enumerate()
        .flat_map(|(index, one)| others(index).map(|other| (one.1 * other.1, other.0 - one.0)))
        .collect();
    pairs.sort_by(|a, b| b.0.total_cmp(&a.0));
    let enough = pairs.get(seen.len().saturating_sub(2)).map_or(0.0, |pair| pair.0);
    let least = pairs.first().map_or(0.0, |pair| STRONG * pair.0).min(enough);
    let strong = pairs.iter().filter(|pair| pair.0 >= least).map(|pair| pair.1);
    let mut apart: Vec<usize> = strong.flat_map(|apart| [apart, apart.wrapping_neg()]).collect();
    apart.sort_unstable();
    apart.dedup();
    apart
}

/// The pixels that see a cell are compared with each other: Ω_k Ω_l / Σ Ω, with Ω = w c² L² M².
struct Pixels<'r, 'm, 'a, T> {
    reduced: &'r Reduced<'m, 'a, T>,
    /// How far behind a pixel the cell stands that an exposure sees there.
    places: Vec<usize>,
    pixels: &'r Partition,
    /// w c² of exposures where it is the same for all measurements.
    uniform: Vec<Option<f32>>,
}

impl<T: Real> Pixels<'_, '_, '_, T> {
    /// w c² M².
    fn weight(&self, exposure: usize, pixel: usize) -> f64 {
        let weight = self.uniform[exposure];
        let weight = weight.unwrap_or_else(|| self.reduced.weight_of(exposure, pixel));
        f64::from(weight) * f64::from(self.reduced.sensitivity[pixel]).powi(2)
    }
}

impl<T: Real> Edges for Pixels<'_, '_, '_, T> {
    fn of(&self, pixel: usize, mut add: impl FnMut(usize, f64)) {
        for (exposure, place) in self.places.iter().enumerate() {
            let cell = pixel + place;
            let share = f64::from(self.reduced.share_of_cell(cell));
            // Of a cell that only the weakest measurements see, 1/Σ w c² M² may be infinite.
            if !(share > 0.0 && share.is_finite()) {
                continue;
            }
            let weight = self.weight(exposure, pixel);
            for (beside, place) in self.places.iter().enumerate() {
                // Before the first pixel there is none.
                let other = cell.wrapping_sub(*place);
                if self.pixels.of.get(other).is_some_and(|&of| of != NONE) {
                    // The same number from either end.
                    let weight = share * (weight * self.weight(beside, other));
                    if weight > 0.0 {
                        add(other, weight);
                    }
                }
            }
        }
    }

    fn own(&self, pixel: usize) -> f64 {
        let m = f64::from(self.reduced.sensitivity[pixel]);
        let prior = self.reduced.weak.as_ref();
        prior.map_or(0.0, |prior| f64::from(prior.weights[pixel]) * m * m)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::exposures::{Exposures, Flux, FluxKind, Mask, Measurements, Positions, Variance};
    use crate::frames::{Shape, Stack};
    use crate::reduced::ConjugateGradients;
    use crate::testing::random_number;
    use crate::weak_light::Prior;

    const SENSOR: Shape = Shape::new(23, 31);
    /// Far apart, so that pixels see cells alone, and one cell of two exposures each in places.
    const SHIFTS: [[f64; 2]; 4] = [[0.0, 0.0], [7.0, -12.0], [-9.0, 5.0], [3.0, 16.0]];

    #[test]
    fn neighbours_are_those_of_much_weight_and_connect_all_positions() {
        let of = |places: &[usize], shares: &[f64]| {
            let apart = apart(places, shares);
            let back: Vec<usize> = apart.iter().map(|apart| apart.wrapping_neg()).collect();
            assert!(back.iter().all(|back| apart.contains(back)));
            apart.into_iter().filter(|apart| *apart < usize::MAX / 2).collect::<Vec<_>>()
        };
        assert_eq!(of(&[0, 100, 10, 1000], &[0.25; 4]), [10, 90, 100, 900, 990, 1000]);
        // One of little weight; one of much; two of much at one place, which compare nothing there.
        assert_eq!(of(&[0, 10, 100, 1000], &[1.0, 1.0, 1.0, 0.01]), [10, 90, 100]);
        assert_eq!(of(&[0, 10, 100, 1000], &[1.0, 0.01, 0.01, 0.01]), [10, 100, 1000]);
        assert_eq!(of(&[10, 10, 0, 100], &[1.0, 1.0, 0.1, 0.1]), [10, 90]);
        // Two of much weight are not enough.
        assert_eq!(of(&[0, 1, 10, 100], &[1.0, 1.0, 0.1, 0.1]), [1, 9, 10, 99, 100]);
        assert!(of(&[5, 5], &[0.5; 2]).is_empty());
    }

    #[test]
    fn the_matrix_is_that_of_the_columns() {
        let (workers, control) = (Workers::new(None).unwrap(), Control::new());
        let positive = |seed: usize| 1.0 + 0.4 * random_number(seed);
        let count = SHIFTS.len() * SENSOR.len();
        let frames: Vec<f64> = (0..count).map(positive).collect();
        let variance: Vec<f64> = (0..count).map(|at| 1e-3 * positive(at + 99_000)).collect();
        let masked: Vec<bool> = (0..count).map(|at| random_number(at + 5) > 0.9).collect();
        let stack = |values| Stack::new("frames", values, SHIFTS.len(), SENSOR).unwrap();
        let whole = [Variance::Unknown, Variance::Exposures(&[4e-6, 9e-5, 5e-7, 1e-6])];
        let cases = [
            (whole[0], Mask::None),
            (whole[1], Mask::None),
            (whole[1], Mask::Measurements(&masked)),
            (Variance::Measurements(stack(&variance)), Mask::Measurements(&masked)),
        ];
        for (variance, mask) in cases {
            let measurements = Measurements { frames: stack(&frames), variance, mask };
            let flux = Flux { values: vec![1.0, 0.7, 1.6, 0.4], kind: FluxKind::Known };
            let positions = Positions::of_shifts(&SHIFTS);
            let exposures =
                Exposures::new(measurements, positions, flux, false, &workers, &control).unwrap();
            let mut solver = ConjugateGradients::new(&exposures, &workers, &control);
            // Every ninth pixel is dead.
            let of = |at: usize| if at.is_multiple_of(9) { 0.0 } else { positive(at + 7) };
            let sensitivity: Vec<f64> = (0..SENSOR.len()).map(of).collect();
            let cells = exposures.geometry().views[0].shape.len();
            let beams = [(0..cells).map(|at| positive(at + 4321)).collect()];
            solver.linearise(&sensitivity, &beams, None, &control).unwrap();
            let reduced = &mut solver.reduced;
            let (pixels, matrix) = graph(reduced, &workers, &control).unwrap();
            assert!(pixels.count() > 20 && pixels.count() < SENSOR.len() / 2);
            let heights: Vec<f64> = (0..pixels.count()).map(|at| random_number(at + 11)).collect();
            let x: Vec<f32> = pixels
                .of
                .iter()
                .zip(&reduced.sensitivity)
                .map(|(&of, m)| if of == NONE { 0.0 } else { m * heights[of as usize] as f32 })
                .collect();
            let mut product = vec![0.0; x.len()];
            let wanted = reduced.multiply(&x, &mut product, &control).unwrap();
            let left = matrix.residual(&vec![0.0; heights.len()], &heights, &workers);
            let found: f64 = left.iter().zip(&heights).map(|(left, y)| -left * y).sum();
            // Single precision, and the product is a difference of sums some times as large.
            assert!((found / wanted - 1.0).abs() < 1e-5, "{found} {wanted}");
            // A prior alone resists what is the same everywhere.
            let held = Arc::from(vec![1e6; SENSOR.len()]);
            let mut prior = Prior::new(held, vec![0; SENSOR.len()].into());
            prior.at(&sensitivity);
            solver.linearise(&sensitivity, &beams, Some(&prior), &control).unwrap();
            let reduced = &mut solver.reduced;
            let (pixels, matrix) = graph(reduced, &workers, &control).unwrap();
            let ones = vec![1.0; pixels.count()];
            let left = matrix.residual(&vec![0.0; ones.len()], &ones, &workers);
            let weights = &reduced.weak.as_ref().unwrap().weights;
            let of = |pixel: usize| f64::from(weights[pixel]);
            let of = |pixel| of(pixel) * f64::from(reduced.sensitivity[pixel]).powi(2);
            let scale = left.iter().fold(0.0, |most: f64, left| most.max(-left));
            for (found, wanted) in left.iter().zip(pixels.sums(of, &workers)) {
                assert!((found + wanted).abs() < 1e-5 * scale, "{found} {wanted}");
            }
        }
    }
}

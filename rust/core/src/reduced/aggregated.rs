//! The aggregates of pixels of S, with their matrix.

use std::collections::BTreeMap;

use super::operator::{Input, Reduced};
use crate::coarse::{Cycle, Edges, Graph, NONE, Partition, Places, pairs};
use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::padded::Padding;
use crate::parallel::Workers;

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
        let heights = self.cycle.correct(&right, workers);
        let product = right.iter().zip(&heights).map(|(b, y)| b * y).sum();
        (product, heights.into_iter().map(|y| y as f32).collect())
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
    let sources = Source::all(reduced);
    let inverse = &reduced.inverse_diagonal;
    let [strong, weak] = apart(&sources);
    let beside = |pixel: usize| {
        strong.iter().map(move |&(apart, weight)| (pixel.wrapping_add(apart), weight as f32))
    };
    let is_seen = |pixel: usize| inverse.get(pixel).is_some_and(|&inverse| inverse > 0.0);
    // The diagonal does those that are compared with nothing.
    let is_used = |pixel: usize| {
        let mut all = strong.iter().chain(&weak).map(|&(apart, _)| pixel.wrapping_add(apart));
        is_seen(pixel) && all.any(is_seen)
    };
    let pixels = Partition::neighbourhoods(inverse.len(), is_used, beside, workers, control)?;
    let edges = Pixels { reduced, sources, pixels: &pixels };
    let graph = pixels.graph(&edges, workers, control)?;
    Ok((pixels, graph))
}

/// The exposures at one place: for what they compare they are one.
struct Source {
    /// How far behind a pixel the cell stands that they see there, in a padded image.
    behind: usize,
    exposures: Vec<usize>,
    /// Their share of all weight.
    share: f64,
    /// Σ w c² where it is the same for all pixels.
    uniform: Option<f32>,
}

impl Source {
    fn all<T: Real>(reduced: &Reduced<'_, '_, T>) -> Vec<Self> {
        let Places { at, exposures, shares } =
            Places::of(reduced.exposures, reduced.exposures.flux());
        let places = at.into_iter().zip(exposures).zip(shares);
        places
            .map(|(([row, col], exposures), share)| Self {
                behind: row * reduced.padding.width + col,
                share,
                uniform: exposures.iter().map(|&one| reduced.uniform_weight(one)).sum(),
                exposures,
            })
            .collect()
    }
}

/// How far apart pixels are that see a cell in two exposures, in either direction, and the weight of that
/// comparison: first those of strong pairs, then all others.
fn apart(sources: &[Source]) -> [Vec<(usize, f64)>; 2] {
    let shares: Vec<f64> = sources.iter().map(|source| source.share).collect();
    let [mut strong, mut weak] = [BTreeMap::new(), BTreeMap::new()];
    for pair in pairs(&shares) {
        let [one, other] = pair.places.map(|place| sources[place].behind);
        let apart = if pair.is_strong { &mut strong } else { &mut weak };
        let largest = apart.entry(one.wrapping_sub(other)).or_insert(0.0_f64);
        *largest = largest.max(pair.weight);
    }
    weak.retain(|distance, _| !strong.contains_key(distance));
    [strong, weak].map(|apart| apart.into_iter().collect())
}

/// The pixels that see a cell are compared with each other: Ω_k Ω_l / Σ Ω, with Ω = w c² L² M².
struct Pixels<'r, 'm, 'a, T> {
    reduced: &'r Reduced<'m, 'a, T>,
    sources: Vec<Source>,
    pixels: &'r Partition,
}

impl<T: Real> Pixels<'_, '_, '_, T> {
    /// Σ w c² M² of the exposures of one place.
    fn weight(&self, source: &Source, pixel: usize) -> f64 {
        let each = || source.exposures.iter().map(|&one| self.reduced.weight_of(one, pixel)).sum();
        let weight = source.uniform.unwrap_or_else(each);
        f64::from(weight) * f64::from(self.reduced.sensitivity[pixel]).powi(2)
    }
}

impl<T: Real> Edges for Pixels<'_, '_, '_, T> {
    fn of(&self, pixel: usize, mut add: impl FnMut(usize, f64)) {
        for source in &self.sources {
            let cell = pixel + source.behind;
            let share = f64::from(self.reduced.share_of_cell(cell));
            // Of a cell that only the weakest measurements see, L²/Σ w c² M² may be infinite.
            if !(share > 0.0 && share.is_finite()) {
                continue;
            }
            let weight = self.weight(source, pixel);
            for beside in &self.sources {
                // Before the first pixel there is none.
                let other = cell.wrapping_sub(beside.behind);
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
    /// Far apart, so that pixels see cells alone, and one cell of two exposures each in places; two are at one.
    const SHIFTS: [[f64; 2]; 5] =
        [[0.0, 0.0], [7.0, -12.0], [-9.0, 5.0], [3.0, 16.0], [7.0, -12.0]];

    #[test]
    fn strong_neighbours_are_those_of_much_weight() {
        let of = |places: &[(usize, f64)]| {
            let source =
                |&(behind, share)| Source { behind, exposures: vec![], share, uniform: None };
            let [strong, weak] = apart(&places.iter().map(source).collect::<Vec<_>>());
            let count = places.len() * (places.len() - 1);
            assert_eq!(strong.len() + weak.len(), count);
            // The weight is the same in both directions.
            let back = |&(apart, weight): &(usize, f64)| (apart.wrapping_neg(), weight);
            assert!(strong.iter().map(back).all(|back| strong.contains(&back)));
            let ahead = strong.into_iter().filter(|(apart, _)| *apart < usize::MAX / 2);
            ahead.collect::<Vec<_>>()
        };
        let found = of(&[(0, 0.5), (100, 0.4), (10, 0.25)]);
        assert_eq!(found, [(10, 0.125), (90, 0.1), (100, 0.2)]);
        // One of little weight; one of much, so that its pairs are the heaviest; two of much.
        let found = of(&[(0, 1.0), (10, 1.0), (100, 1.0), (1000, 0.01)]);
        assert_eq!(found, [(10, 1.0), (90, 1.0), (100, 1.0)]);
        let found = of(&[(0, 1.0), (10, 0.01), (100, 0.01), (1000, 0.01)]);
        assert_eq!(found, [(10, 0.01), (100, 0.01), (1000, 0.01)]);
        assert_eq!(of(&[(0, 1.0), (1, 1.0), (10, 0.1), (100, 0.1)]), [(1, 1.0)]);
        assert!(of(&[(5, 1.0)]).is_empty());
        // Of two pairs that are as far apart the heavier counts.
        let source = |behind, share| Source { behind, exposures: vec![], share, uniform: None };
        let [strong, _] = apart(&[source(0, 0.25), source(7, 0.25), source(14, 0.5)]);
        assert!(strong.contains(&(7, 0.125)), "{strong:?}");
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
        let whole = [Variance::Unknown, Variance::Exposures(&[4e-6, 9e-5, 5e-7, 1e-6, 2e-4])];
        let cases = [
            (whole[0], Mask::None),
            (whole[1], Mask::None),
            (whole[1], Mask::Measurements(&masked)),
            (Variance::Measurements(stack(&variance)), Mask::Measurements(&masked)),
        ];
        for (variance, mask) in cases {
            let measurements = Measurements { frames: stack(&frames), variance, mask };
            let flux = Flux { values: vec![1.0, 0.7, 1.6, 0.4, 1.2], kind: FluxKind::Known };
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

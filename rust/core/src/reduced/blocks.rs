//! The coarse spaces of S, with their matrices summed over blocks of beam cells.

use std::f64::consts::PI;

use super::operator::Reduced;
use crate::coarse::{
    self, BarelyConstrained, Coarse, Complex, Entry, Hats, Modulated, STRONG, SeenWave, Spot,
    Symbol, barely_constrained, spacing_of_waves, times,
};
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::{Real, Shape};
use crate::geometry::{Geometry, Placement, Walk};
use crate::parallel::Workers;

/// Blocks of cells along the distance of two hats.
const BLOCKS: usize = 3;
/// Of more waves that are barely constrained the deepest four are too few, and aggregates see them all.
const MANY: f64 = 150.0;

/// Bytes of aggregates for each pixel above which they take longer than they save: of 8 positions, two of
/// which had 1e4 times the weight of the others, 450 bytes and twice the time; of 20, 2400 and 14 times.
const MOST_BYTES: usize = 250;

/// What sees the waves that exposures barely constrain.
pub(crate) enum ShortWaves {
    /// Hats times the deepest of them, as a cell sees them: e^{−iq·d} of the pixel that sees it.
    Waves(Vec<SeenWave>),
    /// Of so many bytes for each place of the padded sensor.
    Aggregates { bytes: usize },
}

impl ShortWaves {
    /// That of these exposures. Where they are turned against each other no wave is seen as one.
    pub(crate) fn of<T: Real>(exposures: &Exposures<'_, T>) -> Self {
        let geometry = exposures.geometry();
        if geometry.views.len() > 1 {
            return Self::Waves(Vec::new());
        }
        let places = Places::of(exposures);
        let reach = [0, 1].map(|axis| {
            let along = places.at.iter().map(|place| place[axis]);
            along.clone().max().unwrap_or(0) - along.min().unwrap_or(0)
        });
        let spacing = hats_of_waves(geometry);
        let spacing = [spacing.rows.spacing, spacing.cols.spacing];
        let BarelyConstrained { waves, are_all, share, below } =
            barely_constrained(&places, &places.shares, reach, spacing);
        // λ is below t in an ellipse around each minimum, of the share t/(4π √det Σ) where it is deep. Where the
        // places of much weight are on a line det Σ is nearly 0, and λ all along lines of wave vectors; what few
        // of them leave undetermined those of little weight barely determine.
        let many = 4.0 * PI * places.spread() * share / below > MANY;
        let is_wanted = many || (places.are_unlike() && !are_all);
        let bytes = bytes_of_aggregates(&places.shares);
        if is_wanted && bytes <= MOST_BYTES {
            return Self::Aggregates { bytes };
        }
        let seen = waves.into_iter().map(|wave| {
            let [q, p] = wave.vector;
            let factor = |at: &Placement| times(phase(at.row, q), phase(at.col, p));
            SeenWave {
                wave,
                factors: geometry.placements.iter().map(factor).collect(),
                penalty: 0.0,
            }
        });
        Self::Waves(seen.collect())
    }

    fn waves(&self) -> &[SeenWave] {
        match self {
            Self::Waves(waves) => waves,
            Self::Aggregates { .. } => &[],
        }
    }
}

/// What the coarse spaces of these exposures take, in bytes: those of aggregates for each place of the padded
/// sensor.
pub(super) fn bytes_needed<T: Real>(exposures: &Exposures<'_, T>, places: u64) -> u64 {
    let short = ShortWaves::of(exposures);
    let of_aggregates = match short {
        ShortWaves::Aggregates { bytes } => bytes as u64 * places,
        ShortWaves::Waves(_) => 0,
    };
    coarse::bytes_needed(exposures.geometry(), short.waves().len()) + of_aggregates
}

/// What aggregates take for each pixel that is seen at places of these shares. As measured for five to seven
/// positions, and for five of which one to three are of much weight: the fewer pairs make aggregates, the smaller
/// these are, and the more edges there are between them.
fn bytes_of_aggregates(shares: &[f64]) -> usize {
    let others = |one: usize| shares.iter().skip(one + 1).map(move |other| shares[one] * other);
    let pairs = || (0..shares.len()).flat_map(others);
    let least = least_strong(shares);
    let strong = pairs().filter(|&pair| pair >= least).count().max(1);
    12 + 4 * shares.len() * pairs().count() / strong
}

fn hats_of_waves(geometry: &Geometry) -> Hats {
    Hats::new(geometry.sensor, spacing_of_waves(geometry))
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
    let finer = hats_of_waves(geometry);
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

/// The places of exposures, with those at each and their share.
pub(crate) struct Places {
    /// Rows and columns.
    pub(crate) at: Vec<[usize; 2]>,
    /// The exposures at each, in their order.
    pub(crate) exposures: Vec<Vec<usize>>,
    /// Their share of all weight.
    pub(crate) shares: Vec<f64>,
}

impl Places {
    pub(crate) fn of<T: Real>(all: &Exposures<'_, T>) -> Self {
        let (mut at, mut exposures): (Vec<_>, Vec<Vec<usize>>) = (Vec::new(), Vec::new());
        for (exposure, place) in all.geometry().placements.iter().enumerate() {
            let place = [place.row, place.col];
            match at.iter().position(|&other| other == place) {
                Some(known) => exposures[known].push(exposure),
                None => {
                    at.push(place);
                    exposures.push(vec![exposure]);
                }
            }
        }
        let each = all.shares();
        let share = |alike: &Vec<usize>| alike.iter().map(|&exposure| each[exposure]).sum();
        let shares = exposures.iter().map(share).collect();
        Self { at, exposures, shares }
    }

    /// Whether one has much less weight than another.
    fn are_unlike(&self) -> bool {
        let heaviest = self.shares.iter().copied().fold(0.0, f64::max);
        self.shares.iter().any(|&share| share < STRONG * heaviest)
    }

    /// √det Σ, with Σ the covariance of the shifts.
    fn spread(&self) -> f64 {
        let at = |place: &[usize; 2]| place.map(|along| along as f64);
        let mean = |value: &dyn Fn([f64; 2]) -> f64| -> f64 {
            self.at.iter().zip(&self.shares).map(|(place, share)| share * value(at(place))).sum()
        };
        let [row, col] = [0, 1].map(|axis| mean(&|at| at[axis]));
        let of = |i: usize, j: usize| mean(&|at| (at[i] - [row, col][i]) * (at[j] - [row, col][j]));
        // Of shifts on a line rounding may leave less than 0.
        (of(0, 0) * of(1, 1) - of(0, 1).powi(2)).max(0.0).sqrt()
    }
}

impl Symbol for Places {
    fn along(&self, axis: usize, place: usize, q: f64) -> Complex {
        phase(self.at[place][axis], q)
    }

    fn penalty(&self, _: f64) -> f64 {
        0.0
    }
}

/// e^{−iqd}.
fn phase(shift: usize, q: f64) -> Complex {
    let (sin, cos) = (q * shift as f64).sin_cos();
    [cos, -sin]
}

/// The least weight of strong pairs of places of these shares, a quarter of that of the heaviest pair.
pub(crate) fn least_strong(shares: &[f64]) -> f64 {
    let mut falling = shares.to_vec();
    falling.sort_by(|one, other| other.total_cmp(one));
    STRONG * falling.iter().take(2).product::<f64>()
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exposures::{Flux, FluxKind, Mask, Measurements, Positions, Variance};
    use crate::frames::Stack;

    const CROSS: [[f64; 2]; 5] = [[0.0, 0.0], [0.0, 11.0], [0.0, 19.0], [11.0, 0.0], [19.0, 0.0]];
    const FAR: [[f64; 2]; 5] =
        [[34.0, -24.0], [-39.0, -20.0], [-9.0, 32.0], [-5.0, -41.0], [-17.0, 10.0]];

    /// Whether aggregates see the short waves, and what the spaces are said to take.
    fn of(shifts: &[[f64; 2]], variances: &[f64]) -> (bool, u64) {
        let (workers, control) = (Workers::new(None).unwrap(), Control::new());
        let sensor = Shape::new(120, 160);
        let frames = vec![1.0; shifts.len() * sensor.len()];
        let frames = Stack::new("frames", &frames[..], shifts.len(), sensor).unwrap();
        let measurements =
            Measurements { frames, variance: Variance::Exposures(variances), mask: Mask::None };
        let flux = Flux { values: vec![1.0; shifts.len()], kind: FluxKind::Known };
        let positions = Positions::of_shifts(shifts);
        let exposures =
            Exposures::new(measurements, positions, flux, false, &workers, &control).unwrap();
        let is_many = matches!(ShortWaves::of(&exposures), ShortWaves::Aggregates { .. });
        (is_many, bytes_needed(&exposures, 30_000))
    }

    #[test]
    fn aggregates_are_for_positions_far_apart() {
        let equal = [1e-6; 5];
        let heavy = |variance| [1e-6, 1e-6, variance, 1e-6, 1e-6];
        for variances in [equal, heavy(1e-4), heavy(1e-8)] {
            assert!(!of(&CROSS, &variances).0, "{variances:?}");
            assert!(of(&FAR, &variances).0, "{variances:?}");
        }
        // Where heavy ones are on a line.
        assert!(of(&CROSS, &[1e-6, 1e-6, 1e-2, 1e-2, 1e-2]).0);
        assert!(of(&CROSS, &[1e-6, 1e-6, 1e-6, 1e-3, 1e-3]).0);
        // Two of seven have edges to so many others that aggregates take longer.
        let seven = [&CROSS[..], &[[5.0, 7.0], [13.0, 2.0]]].concat();
        assert!(!of(&seven, &[1e-6, 1e-6, 1e-2, 1e-2, 1e-2, 1e-2, 1e-2]).0);
        // Where all are, none of equal weight, whether λ is 0 at places of the scan or beside them.
        let spaced = [0.0, 17.0, 34.0, 51.0, 68.0].map(|col| [0.0, col]);
        for line in [FAR.map(|[row, _]| [row, 2.0 * row]), spaced] {
            assert!(!of(&line, &equal).0);
        }
    }

    #[test]
    fn exposures_at_one_place_count_as_one_of_their_weight() {
        for shifts in [CROSS, FAR] {
            let weighed = of(&shifts, &[1e-6, 1e-6, 1e-6, 1e-6, 0.5e-6]);
            let repeated = [&shifts[..], &shifts[4..]].concat();
            assert_eq!(of(&repeated, &[1e-6; 6]), weighed);
        }
    }
}

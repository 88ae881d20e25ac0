//! What sees the waves that exposures barely constrain: hats times the deepest, or aggregates where they are many.

use std::f64::consts::PI;

use super::graph::STRONG;
use super::hats::Hats;
use super::modulated_matrix::SeenWave;
use super::spacing::spacing_of_waves;
use super::spectrum::{BarelyConstrained, Complex, Symbol, barely_constrained, times};
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::geometry::Placement;

/// Of more waves that are barely constrained the deepest four are too few, and aggregates see them all.
const MANY: f64 = 150.0;

/// Bytes of aggregates for each unknown above which they take longer than they save: of 8 positions, two of
/// which had 1e4 times the weight of the others, 450 bytes and twice the time; of 20, 2400 and 14 times.
const MOST_BYTES: usize = 250;

/// What sees the waves that exposures barely constrain.
pub(crate) enum ShortWaves {
    /// Hats times the deepest of them, as a cell sees them: e^{−iq·d} of the pixel that sees it.
    Waves(Vec<SeenWave>),
    /// Of so many bytes for each unknown, and of exposures at so many places.
    Aggregates { bytes: usize, places: usize },
}

impl ShortWaves {
    /// That of these exposures at these fluxes. Where they are turned against each other no wave is seen as one.
    pub(crate) fn of<T: Real>(exposures: &Exposures<'_, T>, flux: &[f64]) -> Self {
        let geometry = exposures.geometry();
        if geometry.views.len() > 1 {
            return Self::Waves(Vec::new());
        }
        let places = Places::of(exposures, flux);
        let reach = [0, 1].map(|axis| {
            let along = places.at.iter().map(|place| place[axis]);
            along.clone().max().unwrap_or(0) - along.min().unwrap_or(0)
        });
        let hats = Hats::new(geometry.sensor, spacing_of_waves(geometry));
        let spacing = [hats.rows.spacing, hats.cols.spacing];
        let BarelyConstrained { waves, are_all, share, below } =
            barely_constrained(&places, &places.shares, reach, spacing);
        // λ is below t in an ellipse around each minimum, of the share t/(4π √det Σ) where it is deep. Where the
        // places of much weight are on a line det Σ is nearly 0, and λ all along lines of wave vectors; what few
        // of them leave undetermined those of little weight barely determine.
        let many = 4.0 * PI * places.spread() * share / below > MANY;
        let is_wanted = many || (places.are_unlike() && !are_all);
        let bytes = bytes_of_aggregates(&places.shares);
        if is_wanted && bytes <= MOST_BYTES {
            return Self::Aggregates { bytes, places: places.at.len() };
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

    pub(crate) fn waves(&self) -> &[SeenWave] {
        match self {
            Self::Waves(waves) => waves,
            Self::Aggregates { .. } => &[],
        }
    }
}

/// What aggregates take for each unknown that is compared between places of these shares. As measured for five to
/// seven positions, and for five of which one to three are of much weight: the fewer pairs make aggregates, the
/// smaller these are, and the more edges there are between them.
fn bytes_of_aggregates(shares: &[f64]) -> usize {
    let pairs = pairs(shares);
    let strong = pairs.iter().filter(|pair| pair.is_strong).count().max(1);
    12 + 4 * shares.len() * pairs.len() / strong
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
    pub(crate) fn of<T: Real>(all: &Exposures<'_, T>, flux: &[f64]) -> Self {
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
        let each = all.shares(flux);
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

/// Two places whose exposures are compared.
pub(crate) struct Pair {
    pub(crate) places: [usize; 2],
    /// The product of their shares.
    pub(crate) weight: f64,
    /// Whether that is at least a quarter of the heaviest pair's: what such a pair compares is nearly alike in all that
    /// exposures barely constrain, so that it may be in one aggregate.
    ///
    /// Others make no aggregates, even if strong ones alone do not connect all unknowns: what they barely constrain is
    /// the height of each part, so that no aggregate may reach over two.
    pub(crate) is_strong: bool,
}

/// All pairs of places of these shares, in either order.
pub(crate) fn pairs(shares: &[f64]) -> Vec<Pair> {
    let mut falling = shares.to_vec();
    falling.sort_by(|one, other| other.total_cmp(one));
    let least = STRONG * falling.iter().take(2).product::<f64>();
    let each = 0..shares.len();
    let all = each.clone().flat_map(|one| each.clone().map(move |other| [one, other]));
    let pair = |places: [usize; 2]| {
        let weight = places.iter().map(|&place| shares[place]).product();
        Pair { places, weight, is_strong: weight >= least }
    };
    all.filter(|[one, other]| one != other).map(pair).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Control;
    use crate::exposures::{Flux, FluxKind, Mask, Measurements, Positions, Variance};
    use crate::frames::{Shape, Stack};
    use crate::parallel::Workers;

    const CROSS: [[f64; 2]; 5] = [[0.0, 0.0], [0.0, 11.0], [0.0, 19.0], [11.0, 0.0], [19.0, 0.0]];
    const FAR: [[f64; 2]; 5] =
        [[34.0, -24.0], [-39.0, -20.0], [-9.0, 32.0], [-5.0, -41.0], [-17.0, 10.0]];

    /// Whether aggregates see the short waves, and otherwise how many waves do.
    fn of(shifts: &[[f64; 2]], variances: &[f64]) -> (Option<[usize; 2]>, usize) {
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
        let short = ShortWaves::of(&exposures, exposures.flux());
        let aggregates = match short {
            ShortWaves::Aggregates { bytes, places } => Some([bytes, places]),
            ShortWaves::Waves(_) => None,
        };
        (aggregates, short.waves().len())
    }

    #[test]
    fn aggregates_are_for_positions_far_apart() {
        let equal = [1e-6; 5];
        let heavy = |variance| [1e-6, 1e-6, variance, 1e-6, 1e-6];
        for variances in [equal, heavy(1e-4), heavy(1e-8)] {
            assert!(of(&CROSS, &variances).0.is_none(), "{variances:?}");
            assert!(of(&FAR, &variances).0.is_some(), "{variances:?}");
        }
        // Where heavy ones are on a line.
        assert!(of(&CROSS, &[1e-6, 1e-6, 1e-2, 1e-2, 1e-2]).0.is_some());
        assert!(of(&CROSS, &[1e-6, 1e-6, 1e-6, 1e-3, 1e-3]).0.is_some());
        // Two of seven have edges to so many others that aggregates take longer.
        let seven = [&CROSS[..], &[[5.0, 7.0], [13.0, 2.0]]].concat();
        assert!(of(&seven, &[1e-6, 1e-6, 1e-2, 1e-2, 1e-2, 1e-2, 1e-2]).0.is_none());
        // Where all are, none of equal weight, whether λ is 0 at places of the scan or beside them.
        let spaced = [0.0, 17.0, 34.0, 51.0, 68.0].map(|col| [0.0, col]);
        for line in [FAR.map(|[row, _]| [row, 2.0 * row]), spaced] {
            assert!(of(&line, &equal).0.is_none());
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

//! The waves that exposures barely constrain: wave vectors q ≠ 0 at which the symbol of S is nearly 0.
//!
//! Let h_k be what exposure k makes of a wave of height 1, at a pixel at the origin. What is left once the
//! unknowns that were eliminated have followed it is, as a share,
//!
//! ```text
//! λ(q) = 1 − |Σ ω_k h_k(q)|² / Σ ω_k |h_k(q)|² + g(q)/Σ ω_k |h_k(q)|²,   Σ ω_k = 1
//! ```
//!
//! with g the symbol of a penalty. For whole shifts h_k = e^{iq·d_k}. λ is 0 at q = 0, and may be nearly so
//! where all products q·d_k are close to multiples of 2π: there the shifts nearly repeat the wave.

use std::f64::consts::{PI, TAU};

/// A number x + iy.
pub(crate) type Complex = [f64; 2];

/// Waves of a larger λ do not delay conjugate gradients: the second level has eigenvalues of 1/4.
const DEEPEST: f64 = 0.2;
/// Below, a wave is as good as undetermined, and single precision leaves errors in it.
const DETERMINED: f64 = 1e-5;
/// Minima of the scan that are followed further down.
const MOST_CANDIDATES: usize = 12;
/// Upper limit on waves: more save few iterations (docs/method.md, section 5).
pub(crate) const MOST_WAVES: usize = 4;
/// Steps over the wave vectors along an axis, for each pixel that shifts reach, and at least and at most.
const STEPS_A_PIXEL: usize = 8;
const STEPS: [usize; 2] = [16, 512];
/// The share of `below` under which a wave delays conjugate gradients where no hats are around it.
const NEARLY_ZERO: f64 = 0.05;
/// How often the steps are halved to come to a minimum: λ is then off by some 1e-7, so that a wave that is not
/// determined at all is recognised.
const HALVINGS: usize = 12;

/// What each exposure makes of a wave along one axis, and the penalty on it.
pub(crate) trait Symbol {
    /// Σ_j t_j e^{iq(first + j)} of an exposure along an axis.
    fn along(&self, axis: usize, exposure: usize, q: f64) -> Complex;
    /// The penalty along one axis, in units of Σ ω = 1.
    fn penalty(&self, q: f64) -> f64;
}

pub(crate) fn times([a, b]: Complex, [c, d]: Complex) -> Complex {
    [a * c - b * d, a * d + b * c]
}

/// A wave that exposures barely constrain.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Wave {
    /// Its wave vector along rows and columns, from −π to π.
    pub(crate) vector: [f64; 2],
    /// Whether it is its own opposite, as (−1)^row is: then its sine is 0 in every pixel.
    pub(crate) is_alone: bool,
}

/// The waves that exposures barely constrain.
pub(crate) struct BarelyConstrained {
    /// The deepest minima of λ, apart from q = 0.
    pub(crate) waves: Vec<Wave>,
    /// The share of all wave vectors at which λ is below `below`.
    pub(crate) share: f64,
    /// A quarter of λ's mean over waves whose phases at the exposures have nothing in common.
    pub(crate) below: f64,
    /// Whether λ is nearly 0 at none besides.
    pub(crate) are_all: bool,
}

/// Those of exposures of these shares that reach so many pixels, and hats so far apart: the hats around one
/// wave hold those that are nearer to it than π over that.
pub(crate) fn barely_constrained(
    symbol: &impl Symbol,
    shares: &[f64],
    reach: [usize; 2],
    spacing: [f64; 2],
) -> BarelyConstrained {
    let sizes = reach.map(|reach| (STEPS_A_PIXEL * reach).clamp(STEPS[0], STEPS[1]));
    let scan = Scan::new(symbol, shares, sizes);
    let mut places = scan.minima();
    places.sort_by(|a, b| a.0.total_cmp(&b.0));
    places.truncate(MOST_CANDIDATES);
    let mut found: Vec<(f64, [f64; 2])> =
        places.into_iter().map(|(_, at)| descend(symbol, shares, at, sizes)).collect();
    found.retain(|&(depth, _)| DETERMINED < depth && depth < DEEPEST);
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    let below = (1.0 - shares.iter().map(|share| share * share).sum::<f64>()) / 4.0;
    let count = scan.depths.iter().filter(|&&depth| depth < below).count();
    let mut waves: Vec<Wave> = Vec::new();
    let mut are_all = true;
    for (depth, vector) in found {
        let is_near = |other: [f64; 2]| {
            (0..2).all(|axis| folded(vector[axis] - other[axis]).abs() * spacing[axis] < PI)
        };
        let is_new = |wave: &Wave| !is_near(wave.vector) && !is_near(wave.vector.map(|q| -q));
        if is_near([0.0; 2]) || !waves.iter().all(is_new) {
            continue;
        }
        if waves.len() == MOST_WAVES {
            are_all = depth >= NEARLY_ZERO * below;
            break;
        }
        let is_alone = is_near(vector.map(|q| -q));
        let vector = if is_alone { vector.map(|q| PI * (q / PI).round()) } else { vector };
        waves.push(Wave { vector, is_alone });
    }
    BarelyConstrained { waves, are_all, share: count as f64 / scan.depths.len() as f64, below }
}

/// A wave vector between −π and π.
fn folded(q: f64) -> f64 {
    q - TAU * (q / TAU).round()
}

/// λ of what exposures make of a wave along rows and columns.
fn left(shares: &[f64], factors: impl Iterator<Item = [Complex; 2]>, penalty: f64) -> f64 {
    let (mut seen, mut along) = (0.0, [0.0; 2]);
    for (share, [down, right]) in shares.iter().zip(factors) {
        let h = times(down, right);
        seen += share * (h[0] * h[0] + h[1] * h[1]);
        along = [along[0] + share * h[0], along[1] + share * h[1]];
    }
    (seen - along[0] * along[0] - along[1] * along[1] + penalty) / seen
}

/// λ at a wave vector.
fn depth(symbol: &impl Symbol, shares: &[f64], [q, p]: [f64; 2]) -> f64 {
    let factors = (0..shares.len()).map(|k| [symbol.along(0, k, q), symbol.along(1, k, p)]);
    left(shares, factors, symbol.penalty(q) + symbol.penalty(p))
}

/// The minimum of λ near a place of the scan, and where it is.
fn descend(
    symbol: &impl Symbol,
    shares: &[f64],
    at: [f64; 2],
    sizes: [usize; 2],
) -> (f64, [f64; 2]) {
    let mut best = (depth(symbol, shares, at), at);
    let mut steps = sizes.map(|size| TAU / size as f64);
    for _ in 0..HALVINGS {
        steps = steps.map(|step| step / 2.0);
        let centre = best.1;
        for place in 0..9 {
            let aside = [place / 3, place % 3].map(|i| f64::from(i) - 1.0);
            let at = [0, 1].map(|axis| centre[axis] + steps[axis] * aside[axis]);
            let found = depth(symbol, shares, at);
            if found < best.0 {
                best = (found, at);
            }
        }
    }
    (best.0, best.1.map(folded))
}

/// λ over half of all wave vectors, the other half being the same.
struct Scan {
    sizes: [usize; 2],
    depths: Vec<f64>,
}

impl Scan {
    fn new(symbol: &impl Symbol, shares: &[f64], sizes: [usize; 2]) -> Self {
        let vector = |axis: usize, index: usize| TAU * index as f64 / sizes[axis] as f64;
        let [down, right] = [0, 1].map(|axis| {
            let at = |index: usize| {
                let factors = (0..shares.len())
                    .map(|k| symbol.along(axis, k, vector(axis, index)))
                    .collect::<Vec<_>>();
                (factors, symbol.penalty(vector(axis, index)))
            };
            (0..sizes[axis]).map(at).collect::<Vec<_>>()
        });
        let rows = down.iter().take(sizes[0] / 2 + 1);
        let depths = rows.flat_map(|(down, stiff)| {
            right.iter().map(move |(right, stiffer)| {
                let factors = down.iter().zip(right).map(|(down, right)| [*down, *right]);
                left(shares, factors, stiff + stiffer)
            })
        });
        Self { sizes, depths: depths.collect() }
    }

    /// λ at a place, which may lie beside the half.
    fn at(&self, row: isize, col: isize) -> f64 {
        let [rows, cols] = self.sizes.map(usize::cast_signed);
        let row = row.rem_euclid(rows);
        let (row, col) = if row > rows / 2 { (rows - row, -col) } else { (row, col) };
        self.depths[(row * cols + col.rem_euclid(cols)).cast_unsigned()]
    }

    /// The wave vectors that no neighbour is below, with λ there.
    fn minima(&self) -> Vec<(f64, [f64; 2])> {
        let cols = self.sizes[1];
        let places = (0..self.depths.len()).map(move |place| [place / cols, place % cols]);
        let lowest = places.filter(|&[row, col]| {
            let [row, col] = [row, col].map(usize::cast_signed);
            let own = self.at(row, col);
            own < 2.0 * DEEPEST && (0..9).all(|i| own <= self.at(row + i / 3 - 1, col + i % 3 - 1))
        });
        let found = lowest.map(|place| {
            let vector = [0, 1].map(|axis| TAU * place[axis] as f64 / self.sizes[axis] as f64);
            (self.depths[place[0] * cols + place[1]], vector)
        });
        found.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whole shifts.
    struct Shifts<'s>(&'s [[f64; 2]]);

    impl Symbol for Shifts<'_> {
        fn along(&self, axis: usize, exposure: usize, q: f64) -> Complex {
            let (sin, cos) = (q * self.0[exposure][axis]).sin_cos();
            [cos, -sin]
        }

        fn penalty(&self, _: f64) -> f64 {
            0.0
        }
    }

    /// 1 − |Σ e^{iq·d}|²/n², by its definition.
    fn lambda(shifts: &[[f64; 2]], q: [f64; 2]) -> f64 {
        let angles = shifts.iter().map(|d| q[0] * d[0] + q[1] * d[1]);
        let (re, im) = angles.fold((0.0, 0.0), |(re, im), a: f64| (re + a.cos(), im + a.sin()));
        1.0 - (re * re + im * im) / (shifts.len() * shifts.len()) as f64
    }

    #[test]
    fn waves_of_a_cross_are_its_deepest_minima() {
        let cross = [[0.0, 0.0], [0.0, 11.0], [0.0, 19.0], [11.0, 0.0], [19.0, 0.0]];
        let waves = barely_constrained(&Shifts(&cross), &[0.2; 5], [19, 19], [57.0, 57.0]).waves;
        assert!(waves.len() == MOST_WAVES);
        let depths: Vec<f64> = waves.iter().map(|wave| lambda(&cross, wave.vector)).collect();
        assert!(depths.is_sorted() && depths.iter().all(|depth| (0.0..DEEPEST).contains(depth)));
        // The deepest of a fine grid over one half, away from 0 and from what was found.
        let far = |q: [f64; 2], other: [f64; 2]| {
            (0..2).any(|axis| folded(q[axis] - other[axis]).abs() * 57.0 >= PI)
        };
        for place in 0..600 * 1200 {
            let q = [place / 1200, place % 1200].map(|i| TAU * f64::from(i) / 1200.0);
            let known = |wave: &Wave| !far(q, wave.vector) || !far(q, wave.vector.map(|q| -q));
            if far(q, [0.0; 2]) && !waves.iter().any(known) {
                // A place of the grid is off a minimum by less than what the deepest left differs by.
                assert!(lambda(&cross, q) > depths[MOST_WAVES - 1] - 1e-2, "{q:?}");
            }
        }
    }

    #[test]
    fn where_little_weight_determines_many_waves_four_are_not_all() {
        let cross = [[0.0, 0.0], [0.0, 11.0], [0.0, 19.0], [11.0, 0.0], [19.0, 0.0]];
        let of = |shifts: &[[f64; 2]], weights: &[f64]| {
            let total: f64 = weights.iter().sum();
            let shares: Vec<f64> = weights.iter().map(|weight| weight / total).collect();
            let reach = [0, 1].map(|axis| {
                shifts.iter().map(|shift| shift[axis] as usize).max().unwrap_or_default()
            });
            let spacing = reach.map(|reach| (3.0 * reach as f64).max(8.0));
            barely_constrained(&Shifts(shifts), &shares, reach, spacing).are_all
        };
        assert!(of(&cross, &[1.0; 5]));
        // Heavy ones on a line, and those that leave five waves of a period of 11 columns.
        assert!(!of(&cross, &[1.0, 1.0, 1.0, 1e-3, 1e-3]));
        assert!(!of(&cross, &[1.0, 1.0, 1.0, 1e-4, 1e-4]));
        assert!(!of(&cross, &[1.0, 1.0, 1e-3, 1.0, 1.0]));
        // Nearly all weight at one place, and one place alone: λ is below what is determined anywhere.
        for light in [1e-5, 1e-6] {
            assert!(of(&cross[..2], &[1.0, light]));
        }
        assert!(of(&cross[..1], &[1.0]));
    }

    #[test]
    fn what_is_undetermined_is_no_wave() {
        // Of two exposures, and of a lattice that leaves every other pixel out, λ is 0 at waves besides 0.
        let pair = [[0.0, 0.0], [3.0, 5.0]];
        assert!(
            barely_constrained(&Shifts(&pair), &[0.5; 2], [3, 5], [9.0, 15.0]).waves.is_empty()
        );
        let even = [[0.0, 0.0], [0.0, 2.0], [2.0, 0.0], [4.0, 2.0], [2.0, 6.0]];
        for wave in barely_constrained(&Shifts(&even), &[0.2; 5], [4, 6], [12.0, 18.0]).waves {
            assert!(lambda(&even, wave.vector) > DETERMINED);
        }
    }

    #[test]
    fn a_wave_of_alternate_rows_is_its_own_opposite() {
        // All row shifts even but one, of little weight.
        let shifts = [[0.0, 0.0], [2.0, 1.0], [4.0, 3.0], [2.0, 5.0], [1.0, 2.0]];
        let shares = [0.245, 0.245, 0.245, 0.245, 0.02];
        let waves = barely_constrained(&Shifts(&shifts), &shares, [4, 5], [12.0, 15.0]).waves;
        let alone = waves.iter().find(|wave| wave.is_alone).unwrap();
        assert!(alone.vector[0].abs() == PI && alone.vector[1] == 0.0);
    }
}

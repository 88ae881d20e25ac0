//! The waves that exposures barely constrain, in the space of the beam's coefficients.
//!
//! With the taps t of exposure k a wave e^{iq·u} of coefficients is seen as e^{iq·p} h_k,
//! h_k = Σ_j t_j e^{iq·(first + j)}, along rows and columns alike. Where exposures are turned against each
//! other no wave is seen as one.

use super::freedom::symbol;
use super::layout::Window;
use super::penalty::{SMOOTHING, bent};
use super::survey::Block;
use super::system::System;
use super::wide::Wide;
use crate::coarse::{
    Complex, Hats, Modulated, SeenWave, Spot, Symbol, barely_constrained, spacing_of_waves, times,
};
use crate::frames::Real;
use crate::geometry::Rotation;
use crate::parallel::{Value, Workers};

/// Rows of cells whose sums a thread makes at a time.
const BAND: usize = 32;

/// The coarse space of these waves, times the beam.
pub(super) struct Waves {
    space: Modulated<f32>,
    cols: usize,
}

impl Waves {
    /// The waves of exposures with these sums over blocks, whose centres are given in cells.
    pub(super) fn new<T: Real>(
        system: &System<'_, '_, T>,
        blocks: &[Block],
        centre: impl Fn(usize, usize) -> [f64; 2],
    ) -> Self {
        let (grid, count) = (&system.pass.grid.geometry, system.pass.exposures.count());
        let spacing = spacing_of_waves(system.pass.exposures.geometry());
        let hats = Hats::new(grid.beam, spacing);
        let is_turned = grid.views.iter().any(|view| view.rotation != Rotation::None);
        // What a prior holds is no wave.
        let without = is_turned || system.prior.is_some();
        let seen = if without { Vec::new() } else { seen(system, &hats) };
        let spots = |(index, blocks): (usize, &[Block])| {
            let lit = blocks.iter().enumerate().filter(|(_, block)| block.weight > 0.0);
            let spot = |(exposure, block): (usize, &Block)| {
                let [row, col] = centre(index, exposure);
                Spot { exposure, weight: block.weight, hats: hats.over(row, col) }
            };
            lit.map(spot).collect()
        };
        let blocks: Vec<Vec<Spot>> = match &seen[..] {
            [] => Vec::new(),
            _ => blocks.chunks_exact(count).enumerate().map(spots).collect(),
        };
        let space = Modulated::new(hats, grid.beam.rows, &seen, &blocks, system.pass.workers);
        Self { space, cols: grid.beam.cols }
    }

    /// The lines of the heights that Ψᵀ r has; `inward` brings r into single precision, and `energy` what it
    /// makes of heights into the units of their matrix.
    pub(super) fn correct<N: Value>(
        &self,
        wide: &Wide,
        r: &[N],
        [inward, energy]: [f64; 2],
        workers: &Workers,
    ) -> Vec<f32> {
        if self.space.is_empty() {
            return Vec::new();
        }
        let rows = r.len() / self.cols;
        let bands = workers.map(rows.div_ceil(BAND), |band| {
            let cells = band * BAND * self.cols..r.len().min((band + 1) * BAND * self.cols);
            let beam = &wide.beam[cells.clone()];
            let values: Vec<f32> =
                r[cells].iter().zip(beam).map(|(&r, a)| (inward * r.into()) as f32 * a).collect();
            self.space.gather(band * BAND, &values, self.cols)
        });
        let mut heights = vec![0.0; self.space.size()];
        for (first, sums) in bands.into_iter().flatten() {
            let sums = heights[first..].iter_mut().zip(sums);
            sums.for_each(|(height, sum)| *height += energy * sum);
        }
        self.space.correct(&mut heights, workers);
        self.space.open(&heights, self.cols, workers)
    }

    /// Adds Ψ y to rows of cells from `first` on.
    pub(super) fn spread<N: Value>(
        &self,
        wide: &Wide,
        lines: &[f32],
        first: usize,
        outward: f64,
        z: &mut [N],
    ) {
        if self.space.is_empty() {
            return;
        }
        let mut sums = vec![0.0; z.len()];
        self.space.spread(lines, first, &mut sums, self.cols);
        let beam = &wide.beam[first * self.cols..];
        pulp::Arch::new().dispatch(Lit { sums: &sums, beam, outward, z });
    }
}

/// Adds sums times the beam.
struct Lit<'s, N> {
    sums: &'s [f32],
    beam: &'s [f32],
    outward: f64,
    z: &'s mut [N],
}

impl<N: Value> pulp::NullaryFnOnce for Lit<'_, N> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let outward = N::of(self.outward);
        for (z, (sum, a)) in self.z.iter_mut().zip(self.sums.iter().zip(self.beam)) {
            *z += outward * N::of(f64::from(sum * a));
        }
    }
}

/// The waves that the exposures barely constrain, as they see them.
fn seen<T: Real>(system: &System<'_, '_, T>, hats: &Hats) -> Vec<SeenWave> {
    let windows = &system.pass.windows;
    let is_spline = system.pass.grid.is_spline();
    let taps = Taps { windows, stiffness: if is_spline { SMOOTHING } else { 0.0 } };
    let shares = system.pass.exposures.shares(&system.pass.flux);
    let reach = [0, 1].map(|axis| {
        let place = |window: &Window| [window.row, window.col][axis];
        let places = windows.iter().map(place);
        places.clone().max().unwrap_or(0) - places.min().unwrap_or(0)
    });
    let spacing = [hats.rows.spacing, hats.cols.spacing];
    let waves = barely_constrained(&taps, &shares, reach, spacing).waves;
    let seen = waves.into_iter().map(|wave| {
        let [q, p] = wave.vector;
        let factor = |k: usize| times(taps.along(0, k, q), taps.along(1, k, p));
        SeenWave {
            wave,
            factors: (0..windows.len()).map(factor).collect(),
            penalty: taps.penalty(q) + taps.penalty(p),
        }
    });
    seen.collect()
}

struct Taps<'w> {
    windows: &'w [Window],
    stiffness: f64,
}

impl Symbol for Taps<'_> {
    fn along(&self, axis: usize, exposure: usize, q: f64) -> Complex {
        let window = &self.windows[exposure];
        match axis {
            0 => symbol(&window.along_rows.values, window.row, q),
            _ => symbol(&window.along_cols.values, window.col, q),
        }
    }

    fn penalty(&self, q: f64) -> f64 {
        self.stiffness * bent(q)
    }
}

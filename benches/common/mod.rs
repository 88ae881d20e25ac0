//! What the benches of the solver share: five noise-free exposures of one beam, the standard hard
//! case. M varies from pixel to pixel and over the whole sensor:
//!
//! ```text
//! M = (1 + ξ) (1 + 0.05 cos(3v + 1) cos 2u),   |ξ| ≤ 0.05,   u, v from −0.5 to 0.5
//! ```

use equipix_core::{Control, Exposures, Flux, Positions, Real, Result, Shape, Stack, Workers};

/// The cross of the paper.
pub(crate) const SHIFTS: [[i64; 2]; 5] = [[0, 0], [0, 11], [0, 19], [11, 0], [19, 0]];

/// The exposures of these frames.
pub(crate) fn exposures<'a, T: Real>(
    data: &'a [T],
    shape: Shape,
    workers: &Workers,
) -> Result<Exposures<'a, T>> {
    let frames = Stack::new("frames", data, SHIFTS.len(), shape)?;
    let positions = Positions::of_shifts(&SHIFTS.map(|shift| shift.map(|d| d as f64)));
    let flux = Flux::steady(SHIFTS.len());
    Exposures::new(frames.into(), positions, flux, false, workers, &Control::new())
}

/// The exposures, one behind the other, as `convert` gives their values.
pub(crate) fn frames<T: Copy + Send>(
    shape: Shape,
    workers: &Workers,
    convert: impl Fn(f64) -> T + Sync + Send,
) -> Vec<T> {
    let width = 1000.0 * (shape.cols as f64 / 782.0).max(1.0);
    let gaussian = |at: i64, size: usize| (-((at as f64 - middle(size)) / width).powi(2)).exp();
    let mut frames = vec![convert(0.0); SHIFTS.len() * shape.len()];
    workers.map_blocks(&mut frames, shape.cols, |index, pixels| {
        let (exposure, row) = (index / shape.rows, index % shape.rows);
        let [down, right] = SHIFTS[exposure];
        let along_rows = gaussian(row as i64 + down, shape.rows);
        let response = sensitivity(shape, row);
        for ((col, pixel), m) in (0_i64..).zip(pixels).zip(response) {
            *pixel = convert(along_rows * gaussian(col + right, shape.cols) * m);
        }
    });
    frames
}

/// M along a row of the sensor.
pub(crate) fn sensitivity(shape: Shape, row: usize) -> impl Iterator<Item = f64> {
    let across = |at: usize, size: usize| (at as f64 - middle(size)) / (size - 1) as f64;
    let height = 0.05 * (2.0 * across(row, shape.rows)).cos();
    (0..shape.cols).map(move |col| {
        let large_scale = 1.0 + height * (3.0 * across(col, shape.cols) + 1.0).cos();
        (1.0 + 0.05 * white((row * shape.cols + col) as u64)) * large_scale
    })
}

const fn middle(size: usize) -> f64 {
    (size - 1) as f64 / 2.0
}

/// A number from −1 to 1 that looks random: SplitMix64 (Steele, Lea and Flood 2014).
const fn white(index: u64) -> f64 {
    let mut bits = index.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    bits ^= bits >> 31;
    bits as f64 / (1_u64 << 63) as f64 - 1.0
}

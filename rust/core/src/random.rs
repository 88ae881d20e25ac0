//! Random signs: all that a draw of noise needs, since of it no more than its covariance is asked.
//!
//! The only module that names the generator. Each row of each draw has a stream of its own, so that
//! any thread may ask for any of them.

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};

/// The bits of one stream, 32 at a time.
pub(crate) fn bits(stream: u64) -> impl FnMut() -> u32 {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(stream);
    move || random.next_u32()
}

/// The signs of one stream, 1 or −1.
pub(crate) fn signs(stream: u64) -> impl FnMut() -> f64 {
    let mut bits = bits(stream);
    let (mut drawn, mut left) = (0, 0);
    move || {
        if left == 0 {
            (drawn, left) = (bits(), 32);
        }
        left -= 1;
        if drawn >> left & 1 == 0 { 1.0 } else { -1.0 }
    }
}

/// The first stream of what all exposures have in common; those of single exposures lie below.
const COMMON: u64 = 1 << 63;

/// The first stream of what a prior draws.
const PRIOR: u64 = 1 << 62;

/// The signs of a row of pixels of the prior of M in a draw.
pub(crate) fn signs_of_prior(draw: u64, row: usize, rows: usize) -> impl FnMut() -> f64 {
    signs(PRIOR + Streams::new(1, rows).number(draw, 0, row))
}

/// The signs of a row of pixels that all exposures of a draw have in common.
pub(crate) fn signs_in_common(draw: u64, row: usize, rows: usize) -> impl FnMut() -> f64 {
    signs(COMMON + Streams::new(1, rows).number(draw, 0, row))
}

/// The numbers of the streams that draws take: of each part of a draw, such as an exposure, by row.
#[derive(Clone, Copy)]
pub(crate) struct Streams {
    parts: u64,
    rows: u64,
}

impl Streams {
    pub(crate) const fn new(parts: usize, rows: usize) -> Self {
        Self { parts: parts as u64, rows: rows as u64 }
    }

    /// Another number for each draw, part and row.
    pub(crate) const fn number(self, draw: u64, part: usize, row: usize) -> u64 {
        (draw * self.parts + part as u64) * self.rows + row as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_of_every_part_of_every_draw_has_a_stream_of_its_own() {
        let streams = Streams::new(5, 7);
        let mut numbers: Vec<u64> = (0..9 * 5 * 7)
            .map(|i| streams.number(i / 35, i as usize / 7 % 5, i as usize % 7))
            .collect();
        numbers.sort_unstable();
        numbers.dedup();
        assert_eq!(numbers.len(), 9 * 5 * 7);
    }
}

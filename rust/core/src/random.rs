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

//! Bands of rows, the blocks that threads share out.

/// Rows of a band. It does not depend on the number of threads, so results do not either.
pub(super) const BAND: usize = 16;

/// Cuts several arrays into bands of one size, as a vector of tuples of slices.
macro_rules! bands {
    ($size:expr; $first:expr, $second:expr) => {
        $first.chunks_mut($size).zip($second.chunks_mut($size)).collect::<Vec<_>>()
    };
    ($size:expr; $first:expr, $second:expr, $third:expr) => {
        $first
            .chunks_mut($size)
            .zip($second.chunks_mut($size))
            .zip($third.chunks_mut($size))
            .map(|((first, second), third)| (first, second, third))
            .collect::<Vec<_>>()
    };
    ($size:expr; $first:expr, $second:expr, $third:expr, $fourth:expr) => {
        $first
            .chunks_mut($size)
            .zip($second.chunks_mut($size))
            .zip($third.chunks_mut($size).zip($fourth.chunks_mut($size)))
            .map(|((first, second), (third, fourth))| (first, second, third, fourth))
            .collect::<Vec<_>>()
    };
}
pub(super) use bands;

/// Defines a function that runs in the widest vector registers of the processor. A closure given to pulp is compiled for
/// the narrowest, unless it is short.
macro_rules! wide {
    ($(#[$doc:meta])* $vis:vis fn $name:ident<$life:lifetime $(, $kind:ident: $bound:ident)?>(
        $($argument:ident: $type:ty),* $(,)?
    ) -> $output:ty $body:block) => {
        $(#[$doc])*
        $vis fn $name<$life $(, $kind: $bound)?>($($argument: $type),*) -> $output {
            struct Call<$life $(, $kind: $bound)?> { $($argument: $type),* }
            impl<$life $(, $kind: $bound)?> pulp::NullaryFnOnce for Call<$life $(, $kind)?> {
                type Output = $output;

                #[inline(always)]
                fn call(self) -> $output {
                    let Self { $($argument),* } = self;
                    $body
                }
            }
            pulp::Arch::new().dispatch(Call { $($argument),* })
        }
    };
}
pub(super) use wide;

/// The sums of bands, added in the order of the bands.
pub(super) fn fold<const N: usize>(sums: Vec<[f64; N]>) -> [f64; N] {
    sums.into_iter().fold([0.0; N], |total, each| std::array::from_fn(|i| total[i] + each[i]))
}

/// Index within 0..size of a place that may lie outside, reflected about the edge pixel: −1 becomes 1.
pub(super) fn mirrored(place: isize, size: usize) -> usize {
    let period = (2 * size as isize - 2).max(1);
    let place = place.rem_euclid(period);
    place.min(period - place) as usize % size.max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_outside_are_reflected() {
        let mirror: Vec<_> = (-3..7).map(|place| mirrored(place, 4)).collect();
        assert_eq!(mirror, [3, 2, 1, 0, 1, 2, 3, 2, 1, 0]);
        assert_eq!(mirrored(5, 1), 0);
    }
}

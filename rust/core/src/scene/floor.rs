//! What the coefficients still change by: the pattern that a method leaves, from itself.

use super::bands::fold;
use super::coefficients::Coefficients;
use super::state::State;
use crate::parallel::Workers;

/// Fewest frames that counted before the first copy.
const FIRST: u64 = 16;

/// Patterns after 2^k and 2^(k + 1) frames that counted: (g − 1) l + o at the mean level l of the frames until then.
///
/// At another level the errors of early gains would show, which are larger than what is left at their own.
#[derive(Debug)]
pub(super) struct Floor {
    sizes: [usize; 2],
    /// The earlier one, then the later one.
    copies: [Vec<f32>; 2],
    at: [u64; 2],
}

impl Floor {
    pub(super) fn new(first: &Coefficients) -> Self {
        let zeros = || vec![0.0; first.gain.len()];
        let sizes = [first.shape.rows, first.shape.cols];
        Self { sizes, copies: [zeros(), zeros()], at: [0, 0] }
    }

    /// Copies the pattern after a power of two of frames.
    pub(super) fn follow(
        &mut self,
        frames: u64,
        coefficients: &Coefficients,
        level: impl FnOnce() -> f64,
    ) {
        if frames < FIRST || !frames.is_power_of_two() || frames == self.at[1] {
            return;
        }
        let level = level();
        self.copies.swap(0, 1);
        for (pixel, copy) in self.copies[1].iter_mut().enumerate() {
            *copy = pattern(coefficients, level, pixel) as f32;
        }
        self.at = [self.at[1], frames];
    }

    /// Rms change of the pattern since the earlier copy to that at a level, and the frames of that copy.
    pub(super) fn change(
        &self,
        coefficients: &Coefficients,
        level: f64,
        workers: &Workers,
    ) -> Option<(f64, u64)> {
        let early = &self.copies[0];
        let sums = workers.map(self.sizes[0], |row| {
            let line = row * self.sizes[1]..(row + 1) * self.sizes[1];
            line.fold([0.0; 2], |[sum, squares], i| {
                let change = pattern(coefficients, level, i) - f64::from(early[i]);
                [sum + change, squares + change * change]
            })
        });
        let [sum, squares] = fold(sums).map(|sum| sum / early.len() as f64);
        (self.at[0] > 0).then(|| ((squares - sum * sum).max(0.0).sqrt(), self.at[0]))
    }

    pub(super) fn state(&mut self) -> State<'_> {
        let ([early, late], [first, second]) = (&mut self.copies, &mut self.at);
        State::default()
            .map("early_pattern", self.sizes, early)
            .map("late_pattern", self.sizes, late)
            .count("early_frames", first)
            .count("late_frames", second)
    }
}

/// What the coefficients change of a pixel at a level.
fn pattern(of: &Coefficients, level: f64, pixel: usize) -> f64 {
    (f64::from(of.gain[pixel]) - 1.0) * level + f64::from(of.offset[pixel])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Shape;

    #[test]
    fn the_change_is_that_of_the_pattern_since_the_earlier_copy() {
        let workers = Workers::new(std::num::NonZeroUsize::new(1)).unwrap();
        let mut now = Coefficients::new(Shape::new(4, 6));
        let mut floor = Floor::new(&now);
        floor.follow(FIRST / 2, &now, || 0.5);
        floor.follow(FIRST, &now, || 0.5);
        assert!(floor.change(&now, 0.5, &workers).is_none());
        for (pixel, (gain, offset)) in now.gain.iter_mut().zip(&mut now.offset).enumerate() {
            let sign = if pixel % 2 == 0 { 1.0 } else { -1.0 };
            (*gain, *offset) = (*gain + 0.25 * sign, *offset + 0.0625 * sign);
        }
        floor.follow(2 * FIRST, &now, || -0.25);
        // Neither the same number of frames again nor one that is no power of two makes a copy.
        floor.follow(2 * FIRST, &Coefficients::new(now.shape), || 0.5);
        floor.follow(3 * FIRST, &Coefficients::new(now.shape), || 0.5);
        // A change that all pixels have in common is no pattern.
        now.offset.iter_mut().for_each(|offset| *offset += 0.5);
        assert_eq!(floor.change(&now, 0.5, &workers), Some((0.1875, FIRST)));
        assert_eq!(floor.change(&now, -0.25, &workers), Some((0.0, FIRST)));
        // The copy keeps its own level: at -0.25 there was no pattern, which at 0.5 is 0.1875.
        floor.follow(4 * FIRST, &now, || 0.5);
        assert_eq!(floor.change(&now, 0.5, &workers), Some((0.1875, 2 * FIRST)));
        assert_eq!(floor.change(&now, -0.25, &workers), Some((0.0, 2 * FIRST)));
    }
}

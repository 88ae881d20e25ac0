//! What the coefficients still change by: the pattern that a method leaves, from itself.

use super::bands::fold;
use super::coefficients::Coefficients;
use super::state::State;
use crate::parallel::Workers;

/// Fewest frames that counted before the first copy.
const FIRST: u64 = 16;

/// Copies of the coefficients after 2^k and 2^(k + 1) frames that counted.
#[derive(Debug)]
pub(super) struct Floor {
    sizes: [usize; 2],
    /// Gain and offset of the earlier copy, then of the later one.
    copies: [Vec<f32>; 4],
    at: [u64; 2],
}

impl Floor {
    pub(super) fn new(first: &Coefficients) -> Self {
        let copies = std::array::from_fn(|i| [&first.gain, &first.offset][i % 2].clone());
        Self { sizes: [first.shape.rows, first.shape.cols], copies, at: [0, 0] }
    }

    /// Copies the coefficients after a power of two of frames.
    pub(super) fn follow(&mut self, frames: u64, coefficients: &Coefficients) {
        if frames < FIRST || !frames.is_power_of_two() || frames == self.at[1] {
            return;
        }
        self.copies.rotate_left(2);
        self.copies[2].copy_from_slice(&coefficients.gain);
        self.copies[3].copy_from_slice(&coefficients.offset);
        self.at = [self.at[1], frames];
    }

    /// Rms change of the pattern at a level since the earlier copy, and the frames of that copy.
    pub(super) fn change(
        &self,
        coefficients: &Coefficients,
        level: f64,
        workers: &Workers,
    ) -> Option<(f64, u64)> {
        let [gain, offset, ..] = &self.copies;
        let pixels = gain.len();
        let sums = workers.map(self.sizes[0], |row| {
            let line = row * self.sizes[1]..(row + 1) * self.sizes[1];
            line.fold([0.0; 2], |[sum, squares], i| {
                let slope = f64::from(coefficients.gain[i] - gain[i]);
                let change = slope * level + f64::from(coefficients.offset[i] - offset[i]);
                [sum + change, squares + change * change]
            })
        });
        let [sum, squares] = fold(sums).map(|sum| sum / pixels as f64);
        (self.at[0] > 0).then(|| ((squares - sum * sum).max(0.0).sqrt(), self.at[0]))
    }

    pub(super) fn state(&mut self) -> State<'_> {
        let ([a, b, c, d], [first, second]) = (&mut self.copies, &mut self.at);
        State::default()
            .map("early_gain", self.sizes, a)
            .map("early_offset", self.sizes, b)
            .map("late_gain", self.sizes, c)
            .map("late_offset", self.sizes, d)
            .count("early_frames", first)
            .count("late_frames", second)
    }
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
        floor.follow(FIRST / 2, &now);
        floor.follow(FIRST, &now);
        assert!(floor.change(&now, 0.5, &workers).is_none());
        for (pixel, (gain, offset)) in now.gain.iter_mut().zip(&mut now.offset).enumerate() {
            let sign = if pixel % 2 == 0 { 1.0 } else { -1.0 };
            (*gain, *offset) = (*gain + 0.25 * sign, *offset + 0.0625 * sign);
        }
        floor.follow(2 * FIRST, &now);
        // Neither the same number of frames again nor one that is no power of two makes a copy.
        floor.follow(2 * FIRST, &Coefficients::new(now.shape));
        floor.follow(3 * FIRST, &Coefficients::new(now.shape));
        // A change that all pixels have in common is no pattern.
        now.offset.iter_mut().for_each(|offset| *offset += 0.5);
        assert_eq!(floor.change(&now, 0.5, &workers), Some((0.1875, FIRST)));
        assert_eq!(floor.change(&now, -0.25, &workers), Some((0.0, FIRST)));
        floor.follow(4 * FIRST, &now);
        assert_eq!(floor.change(&now, 0.5, &workers), Some((0.0, 2 * FIRST)));
    }
}

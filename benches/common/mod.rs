//! What the benches of the solver share: five exposures of one beam.

use equipix_core::frames::Shape;

/// The cross of the paper.
pub(crate) const SHIFTS: [[i64; 2]; 5] = [[0, 0], [0, 11], [0, 19], [11, 0], [19, 0]];
/// Five exposures of a Gaussian beam on a sensor with a 5 % ripple.
pub(crate) fn frames(shape: Shape) -> Vec<f32> {
    let width = 1000.0 * (shape.cols as f64 / 782.0).max(1.0);
    let gaussian = |x: f64, size: usize| (-((x - size as f64 / 2.0) / width).powi(2)).exp();
    let pixels = || (0..shape.rows).flat_map(|r| (0..shape.cols).map(move |c| (r, c)));
    let signal = |[down, right]: [i64; 2], (r, c): (usize, usize)| {
        let beam = gaussian(r as f64 + down as f64, shape.rows)
            * gaussian(c as f64 + right as f64, shape.cols);
        (beam * (1.0 + 0.05 * ((r * 7 + c * 13) as f64).sin())) as f32
    };
    SHIFTS.into_iter().flat_map(|shift| pixels().map(move |p| signal(shift, p))).collect()
}

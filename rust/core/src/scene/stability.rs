//! Largest stable step of methods that descend along a gradient.
//!
//! A step changes g by η z E and o' by η E with z = y − m and the error E = −L X of the corrected values
//! X = A θ, θ = (g, o'), A = (diag z, 1). So θ ← (1 − η Aᵀ L A) θ. With a symmetric L of eigenvalues in [0, λ] and
//! A Aᵀ = z² + 1 ≤ 2 this is no expansion for
//!
//! ```text
//! η < 2 / (λ · max(z² + 1)) = 1 / λ
//! ```
//!
//! whatever the frames are. For a mean of neighbours L = 1 − K. Edges are reflected about the edge pixels, so for a
//! kernel that is symmetric along both axes W L is symmetric, with weights W of ½ at an edge and ¼ in a corner, and
//! L has the eigenvalues 1 − K̂(ω). W is diagonal, as the blocks of A are, so W Aᵀ L A = Aᵀ (W L) A is symmetric, and
//! the bound holds in the norm θᵀ W θ. The mean of four has λ = 2. The errors of the frames themselves, noise and a
//! scene that differs from its target, add to this: their part is what the step must be shortened for.
//! Of other kernels 1 − K̂ = d is complex, and |1 − η d (y² + 1)| < 1 takes η < Re d / |d|².

use std::f64::consts::PI;

use crate::error::{Error, Result};

/// Samples of the frequency for each pixel of the kernel. Between samples 1 − K̂ differs from its value
/// at an extremum by at most (π/16)²/8 of it, 0.5 %.
const SAMPLES: usize = 16;

/// Below this |1 − K̂|, K̂ is 1: the kernel leaves the frequency as it is.
const ZERO: f64 = 1e-9;

/// Refuses a step that is not below the bound.
pub(super) fn check_step(step: f64, bound: f64, of: &str) -> Result<()> {
    if step > 0.0 && step < bound {
        return Ok(());
    }
    Err(Error::value(
        "step",
        format!(
            "is {step}, expected above 0 and below {bound:.4}, the stability bound 2 / (λ · \
             max(y² + 1)) of {of} for y in [0, 1]"
        ),
    ))
}

/// Largest stable step for a kernel of so many rows and columns, whose sum is 1.
pub(super) fn kernel_bound(kernel: &[f64], [rows, cols]: [usize; 2]) -> Result<f64> {
    let mut bound = f64::INFINITY;
    let samples = [SAMPLES * rows, SAMPLES * cols];
    for i in 0..=samples[0] / 2 {
        for j in 0..samples[1] {
            let [u, v] = [(i, samples[0]), (j, samples[1])]
                .map(|(index, count)| 2.0 * PI * index as f64 / count as f64);
            let [re, im] = response(kernel, [rows, cols], [u, v]);
            let square = (1.0 - re) * (1.0 - re) + im * im;
            if square > ZERO * ZERO {
                bound = bound.min((1.0 - re) / square);
            }
        }
    }
    if bound > ZERO && bound.is_finite() {
        return Ok(bound);
    }
    Err(Error::value(
        "kernel",
        "has no stable step: it amplifies some spatial frequency, or changes none; use weights \
         that are not negative, around the pixel",
    ))
}

/// K̂(ω) = Σ K exp(iω·p) about the centre of the kernel.
fn response(kernel: &[f64], [rows, cols]: [usize; 2], [u, v]: [f64; 2]) -> [f64; 2] {
    let mut sum = [0.0; 2];
    for (index, weight) in kernel.iter().enumerate() {
        let row = (index / cols) as f64 - (rows / 2) as f64;
        let col = (index % cols) as f64 - (cols / 2) as f64;
        let (sin, cos) = (u * row + v * col).sin_cos();
        sum = [sum[0] + weight * cos, sum[1] + weight * sin];
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_of_four_has_the_bound_one_half() {
        let kernel = [0.0, 0.25, 0.0, 0.25, 0.0, 0.25, 0.0, 0.25, 0.0];
        assert!((kernel_bound(&kernel, [3, 3]).unwrap() - 0.5).abs() < 1e-12);
    }

    #[test]
    fn a_kernel_of_the_pixel_alone_or_that_amplifies_is_refused() {
        assert!(kernel_bound(&[1.0], [1, 1]).is_err());
        assert!(kernel_bound(&[-1.0, 3.0, -1.0], [1, 3]).is_err());
    }

    #[test]
    fn a_neighbour_on_one_side_has_the_bound_of_its_complex_response() {
        // d = 1 − exp(iω): Re d / |d|² = 1/2 at every frequency.
        assert!((kernel_bound(&[0.0, 0.0, 1.0], [1, 3]).unwrap() - 0.5).abs() < 1e-9);
    }
}

//! Steps where shifts are sought: conjugate directions, each as far as F falls along it.
//!
//! The linear problem leaves out the second derivatives of the model. Those by one shift and one cell of the
//! beam, times residuals, vanish on average, but not their squares: a wrong shift makes cells follow noise
//! that they should not, and those make the next shift wrong. Where slopes of noise add N to the curvature I
//! along a shift, a step leaves ±√(N/(I + N)) of such errors, 0.45 for fringes of 18 % and
//! 100 pixels. So steps are those of nonlinear conjugate gradients (Polak and Ribière 1969) with the
//! linear problem as the preconditioner, which end such errors after a few.

use crate::parallel::Workers;

/// Lengths of a step, in units of that of the linear problem, that are believed.
const LENGTHS: [f64; 2] = [0.25, 2.5];
/// A length that is so near to 1 stays.
const NEAR: f64 = 0.03;

/// The last step, in the units of single precision.
pub(super) struct Course {
    direction: Vec<f32>,
    /// The slope of −F where it began, and the product of that with the step of the linear problem.
    slope: Vec<f32>,
    fall: f64,
    is_measured: bool,
}

impl Course {
    /// Makes a step of the linear problem at a `slope` conjugate to the last one.
    pub(super) fn turn(
        step: &mut [f32],
        slope: Vec<f32>,
        last: Option<&Self>,
        workers: &Workers,
    ) -> Self {
        let fall = workers.dot(step, &slope);
        if let Some(last) = last {
            let keep = (fall - workers.dot(step, &last.slope)) / last.fall;
            // More than all of it would be no correction.
            if keep > 0.0 && keep < 1.0 {
                workers.add_multiple(step, keep, &last.direction);
            }
        }
        Self { direction: step.to_vec(), slope, fall, is_measured: false }
    }

    /// By which multiple of its direction the step is to be made longer, for how F falls along it at its end; once.
    pub(super) fn missing(
        &mut self,
        fall: impl Fn(&[f32]) -> f64,
        workers: &Workers,
    ) -> Option<f64> {
        if std::mem::replace(&mut self.is_measured, true) {
            return None;
        }
        let first = workers.dot(&self.direction, &self.slope);
        let length = first / (first - fall(&self.direction));
        let believed = LENGTHS[0] < length && length < LENGTHS[1];
        (believed && (length - 1.0).abs() > NEAR).then_some(length - 1.0)
    }

    pub(super) fn direction(&self) -> &[f32] {
        &self.direction
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// F = xᵀH x/2 with H = S + E that the steps S⁻¹b of S = 1 do not know.
    fn slope(x: &[f32]) -> Vec<f32> {
        vec![-1.45 * x[0], -0.55 * x[1], -x[2]]
    }

    #[test]
    fn three_eigenvalues_end_after_three_steps() {
        let workers = Workers::new(None).unwrap();
        let mut x = vec![1.0, -2.0, 3.0];
        let mut last: Option<Course> = None;
        for _ in 0..3 {
            let mut step = slope(&x);
            let mut course = Course::turn(&mut step, slope(&x), last.as_ref(), &workers);
            workers.add_multiple(&mut x, 1.0, &step);
            let fall = |step: &[f32], x: &[f32]| workers.dot(step, &slope(x));
            if let Some(missing) = course.missing(|step| fall(step, &x), &workers) {
                workers.add_multiple(&mut x, missing, course.direction());
            }
            assert!(course.missing(|step| fall(step, &x), &workers).is_none());
            last = Some(course);
        }
        // A length is off by NEAR at most, which leaves as much of an error of 3.
        assert!(x.iter().all(|x| x.abs() < 3.0 * NEAR as f32), "{x:?}");
    }
}

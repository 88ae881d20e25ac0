//! Symmetric systems of a few hundred unknowns, solved in the plainest way.

/// A symmetric matrix without negative eigenvalues, row by row.
#[derive(Clone)]
pub(crate) struct Symmetric {
    pub(crate) order: usize,
    values: Vec<f64>,
}

impl Symmetric {
    pub(crate) fn zeros(order: usize) -> Self {
        Self { order, values: vec![0.0; order * order] }
    }

    pub(crate) fn at(&self, row: usize, col: usize) -> f64 {
        self.values[row * self.order + col]
    }

    pub(crate) fn add(&mut self, row: usize, col: usize, value: f64) {
        self.values[row * self.order + col] += value;
    }

    /// Adds `weight` times the outer product of a sparse vector with itself.
    pub(crate) fn add_square(&mut self, weight: f64, vector: &[(usize, f64)]) {
        for &(row, a) in vector {
            for &(col, b) in vector {
                self.add(row, col, weight * a * b);
            }
        }
    }

    /// Adds `weight` (a bᵀ + b aᵀ)/2.
    pub(crate) fn add_pair(&mut self, weight: f64, a: &[f64], b: &[f64]) {
        for row in (0..self.order).filter(|&row| a[row] != 0.0 || b[row] != 0.0) {
            let values = &mut self.values[row * self.order..][..self.order];
            for (value, (x, y)) in values.iter_mut().zip(a.iter().zip(b)) {
                *value += 0.5 * weight * (a[row] * y + b[row] * x);
            }
        }
    }

    /// The rows and columns of these numbers.
    pub(crate) fn part(&self, numbers: &[usize]) -> Self {
        let pairs = numbers.iter().flat_map(|&row| numbers.iter().map(move |&col| (row, col)));
        Self { order: numbers.len(), values: pairs.map(|(row, col)| self.at(row, col)).collect() }
    }

    /// The Cholesky factor of the matrix scaled to a diagonal of 1; `None` unless it is definite.
    pub(crate) fn factorised(&self) -> Option<Cholesky> {
        let order = self.order;
        let scale: Vec<f64> = (0..order).map(|i| self.at(i, i).sqrt().recip()).collect();
        let mut lower = self.values.clone();
        for (index, value) in lower.iter_mut().enumerate() {
            *value *= scale[index / order] * scale[index % order];
        }
        let mut column = vec![0.0; order];
        for k in 0..order {
            let pivot = lower[k * order + k];
            if pivot.is_nan() || pivot <= 0.0 {
                return None;
            }
            for i in k..order {
                lower[i * order + k] /= pivot.sqrt();
                column[i] = lower[i * order + k];
            }
            for i in k + 1..order {
                let row = &mut lower[i * order + k + 1..=i * order + i];
                row.iter_mut().zip(&column[k + 1..]).for_each(|(a, b)| *a -= column[i] * b);
            }
        }
        Some(Cholesky { order, lower, scale })
    }
}

pub(crate) struct Cholesky {
    order: usize,
    lower: Vec<f64>,
    scale: Vec<f64>,
}

impl Cholesky {
    /// A⁻¹ b.
    pub(crate) fn solve(&self, right: &[f64]) -> Vec<f64> {
        let (n, lower) = (self.order, &self.lower);
        let mut x: Vec<f64> = right.iter().zip(&self.scale).map(|(b, s)| b * s).collect();
        for i in 0..n {
            x[i] = (x[i] - dot(&lower[i * n..][..i], &x[..i])) / lower[i * n + i];
        }
        for i in (0..n).rev() {
            x[i] /= lower[i * n + i];
            let (head, own) = (&lower[i * n..][..i], x[i]);
            x[..i].iter_mut().zip(head).for_each(|(x, l)| *x -= own * l);
        }
        x.iter().zip(&self.scale).map(|(x, s)| x * s).collect()
    }
}

pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

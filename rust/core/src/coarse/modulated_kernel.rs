//! The arithmetic of hats times waves, inlined into code for the CPU at hand.

use crate::parallel::Value;

/// Values side by side, which vector registers hold.
const LANES: usize = 16;

/// Sums over rows: lines(i, col) = Σ_row f(row, i) values(row, col), for four lines.
pub(super) struct Accumulate<'s, N> {
    /// Rows of values, as wide as a line.
    pub(super) values: &'s [N],
    pub(super) factors: &'s [[N; 4]],
    /// Four lines.
    pub(super) lines: &'s mut [N],
}

impl<N: Value> pulp::NullaryFnOnce for Accumulate<'_, N> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let width = self.lines.len() / 4;
        let whole = width - width % LANES;
        for start in (0..whole).step_by(LANES) {
            // One loop for each sum: in one loop over all four they are not kept in registers.
            let [mut a, mut b, mut c, mut d] = [[N::default(); LANES]; 4];
            for (row, &[s, t, u, v]) in self.values.chunks_exact(width).zip(self.factors) {
                let Some(values) = row[start..].first_chunk::<LANES>() else { break };
                add(&mut a, s, values);
                add(&mut b, t, values);
                add(&mut c, u, values);
                add(&mut d, v, values);
            }
            for (line, sums) in self.lines.chunks_exact_mut(width).zip(&[a, b, c, d]) {
                line[start..start + LANES].copy_from_slice(sums);
            }
        }
        for col in whole..width {
            for i in 0..4 {
                let rows = self.values.chunks_exact(width).zip(self.factors);
                let mut sum = N::default();
                rows.for_each(|(row, factors)| sum += factors[i] * row[col]);
                self.lines[i * width + col] = sum;
            }
        }
    }
}

/// sums ← sums + factor · values
#[inline(always)]
fn add<N: Value>(sums: &mut [N; LANES], factor: N, values: &[N; LANES]) {
    for i in 0..LANES {
        sums[i] += factor * values[i];
    }
}

/// The transpose: adds Σ_i f(row, i) lines(i, col) to rows of sums.
pub(super) struct Distribute<'s, N> {
    /// Four lines.
    pub(super) lines: &'s [N],
    pub(super) factors: &'s [[N; 4]],
    /// Rows of sums, as wide as a line.
    pub(super) sums: &'s mut [N],
}

impl<N: Value> pulp::NullaryFnOnce for Distribute<'_, N> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let width = self.lines.len() / 4;
        let [a, b, c, d] = [0, 1, 2, 3].map(|i| &self.lines[i * width..][..width]);
        for (row, &[s, t, u, v]) in self.sums.chunks_exact_mut(width).zip(self.factors) {
            for ((((sum, a), b), c), d) in row.iter_mut().zip(a).zip(b).zip(c).zip(d) {
                *sum += s * *a + t * *b + (u * *c + v * *d);
            }
        }
    }
}

/// cos and sin of a wave along a row, times the hat on the left and on the right.
#[derive(Clone, Copy)]
pub(super) struct Columns<'s, N> {
    pub(super) left: [&'s [N]; 2],
    pub(super) right: [&'s [N]; 2],
}

/// Sums along columns between two nodes, of lines X, Y that go with cos and sin of a row's part of the phase:
/// Σ X cos − Y sin and Σ Y cos + X sin, for the hat on the left and on the right.
pub(super) struct Close<'s, N> {
    pub(super) lines: [&'s [N]; 2],
    pub(super) columns: Columns<'s, N>,
}

impl<N: Value> pulp::NullaryFnOnce for Close<'_, N> {
    type Output = [f64; 4];

    #[inline(always)]
    fn call(self) -> [f64; 4] {
        let [x, y] = self.lines;
        let length = x.len();
        let Columns { left: [lc, ls], right: [rc, rs] } = self.columns;
        let (y, lc, ls) = (&y[..length], &lc[..length], &ls[..length]);
        let (rc, rs) = (&rc[..length], &rs[..length]);
        let mut sums = [[N::default(); LANES]; 4];
        for start in (0..length).step_by(LANES) {
            let end = length.min(start + LANES);
            let [x, y] = [&x[start..end], &y[start..end]];
            let [lc, ls] = [&lc[start..end], &ls[start..end]];
            let [rc, rs] = [&rc[start..end], &rs[start..end]];
            for i in 0..end - start {
                sums[0][i] += x[i] * lc[i] - y[i] * ls[i];
                sums[1][i] += y[i] * lc[i] + x[i] * ls[i];
                sums[2][i] += x[i] * rc[i] - y[i] * rs[i];
                sums[3][i] += y[i] * rc[i] + x[i] * rs[i];
            }
        }
        sums.map(|sums| sums.into_iter().map(Into::<f64>::into).sum())
    }
}

/// The transpose: lines P, Q of heights y of the hats on the left and on the right,
/// Σ y_c cos + y_s sin and Σ y_s cos − y_c sin.
pub(super) struct Open<'s, N> {
    /// y_c and y_s on the left, then on the right.
    pub(super) heights: [N; 4],
    pub(super) columns: Columns<'s, N>,
    pub(super) lines: [&'s mut [N]; 2],
}

impl<N: Value> pulp::NullaryFnOnce for Open<'_, N> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [p, q] = self.lines;
        let length = p.len();
        let Columns { left: [lc, ls], right: [rc, rs] } = self.columns;
        let (q, lc, ls) = (&mut q[..length], &lc[..length], &ls[..length]);
        let (rc, rs) = (&rc[..length], &rs[..length]);
        let [yc, ys, zc, zs] = self.heights;
        for col in 0..length {
            p[col] = yc * lc[col] + ys * ls[col] + (zc * rc[col] + zs * rs[col]);
            q[col] = ys * lc[col] - yc * ls[col] + (zs * rc[col] - zc * rs[col]);
        }
    }
}

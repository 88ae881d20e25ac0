//! Products and pulls of the joint problem that its covariance takes.

use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::joint::{Pass, Precision, Row, System, Workspace};

/// Cᵀ of a functional: what changes of the other unknowns do to it through M and O, which follow a
/// change u = c M v of the light by −α = −(i₁₁ eᵀw u + i₁₂ 1ᵀw u) and −β = −(i₁₂ eᵀw u + i₂₂ 1ᵀw u).
pub(super) fn pull_of<T: Real>(
    system: &mut System<'_, '_, T>,
    gain: &[f64],
    offset: &[f64],
    control: &Control,
) -> Result<Vec<f64>> {
    system.pass.few_pull = true;
    let pull = pull_by(system, control, |pass, row_index, row, workspace| {
        let cols = pass.exposures.sensor().cols;
        let (gain, offset) = (&gain[row_index * cols..], &offset[row_index * cols..]);
        let [_, i12, i22] = row.offset;
        let (light, weights, values, _) = workspace.parts();
        for (k, (weights, flux)) in weights.chunks_exact(cols).zip(&pass.flux).enumerate() {
            let light = &light[k * cols..];
            for (col, value) in values.of_mut(k).iter_mut().enumerate() {
                let (mut along_light, mut alone) = (row.inverse[col] * gain[col], 0.0);
                if !i22.is_empty() {
                    along_light += i12[col] * offset[col];
                    alone = i12[col] * gain[col] + i22[col] * offset[col];
                }
                let change = along_light * light[col] + alone;
                *value = -flux * row.sensitivity[col] * weights[col] * change;
            }
        }
    });
    system.pass.few_pull = false;
    pull
}

/// What pixels pull at the unknowns if `work` leaves their pulls in the workspace's values, with their
/// weights beside.
pub(super) fn pull_by<T: Real>(
    system: &mut System<'_, '_, T>,
    control: &Control,
    work: impl Fn(&Pass<'_, '_, T>, usize, Row<'_>, &mut Workspace) + Sync,
) -> Result<Vec<f64>> {
    let (beam, mut pull) = (&system.state.beam, vec![0.0; system.state.beam.len()]);
    let found =
        system.pass.run(beam, &mut pull, control, |pass, row_index, row, workspace, _| {
            pass.weigh_row(row_index, &mut workspace.weights);
            work(pass, row_index, row, workspace);
        })?;
    system.append(&found, &mut pull);
    Ok(pull)
}

/// S x.
pub(super) fn product<N: Precision, T: Real>(
    system: &mut System<'_, '_, T>,
    x: &[N],
    control: &Control,
) -> Result<Vec<N>> {
    let mut product = Vec::new();
    system.multiply(x, &mut product, 0.0, control)?;
    Ok(product)
}

/// Adds the change of M that goes with the last product.
pub(super) fn add_change<T: Real>(system: &System<'_, '_, T>, change: &mut [f64]) {
    let mut sums = change.iter_mut();
    system.pass.for_rows(|[_, _, change, ..]| {
        sums.by_ref().zip(change).for_each(|(sum, change)| *sum += change);
    });
}

/// What the noise of each cell of the beam, at the M that there is, does by itself to the variance of M:
/// Σ_k (i₁₁ w e c M)² V with 1/V = Σ w c² M² over the pixels that see a cell.
pub(super) fn variance_by_cells<T: Real>(
    system: &mut System<'_, '_, T>,
    control: &Control,
) -> Result<Vec<f64>> {
    let [_, unit] = system.ordinary;
    let weights: Vec<f64> = system.weights.iter().map(|&d| unit * f64::from(d)).collect();
    let views = system.pass.views_of(&weights);
    let (beam, mut no_pull) = (&system.state.beam, vec![0.0; system.weights.len()]);
    system.pass.run(beam, &mut no_pull, control, |pass, row_index, row, workspace, _| {
        pass.weigh_row(row_index, &mut workspace.weights);
        workspace.values().clear();
        pass.see(&views, row_index, workspace);
        let cols = row.change.len();
        let (light, weights, values, _) = workspace.parts();
        row.change.fill(0.0);
        for (k, flux) in pass.flux.iter().enumerate() {
            let (weights, light) = (&weights[k * cols..][..cols], &light[k * cols..][..cols]);
            for (col, weight) in values.of_mut(k).iter_mut().enumerate() {
                let share =
                    row.inverse[col] * weights[col] * light[col] * flux * row.sensitivity[col];
                row.change[col] += if *weight > 0.0 { share * share / *weight } else { 0.0 };
                *weight = 0.0;
            }
        }
    })?;
    let mut variance = vec![0.0; system.pass.exposures.sensor().len()];
    add_change(system, &mut variance);
    Ok(variance)
}

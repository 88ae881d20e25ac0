"""What noise leaves uncertain in M, by dense algebra, for tiny sensors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from reference.least_squares import gradient, prior_rows
from reference.model import problem

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


def covariance(
    frames: ArrayLike,
    shifts: ArrayLike,
    sensitivity: NDArray[Any],
    beam: NDArray[Any],
    *,
    variance: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    flux: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    prior: NDArray[Any] | None = None,
) -> NDArray[Any]:
    """Covariance of M in the gauge mean 1: the Cramér-Rao bound for Gaussian noise.

    Parameters
    ----------
    frames, shifts : array_like
        As for `reference.model.problem`; of the frames only their NaN count.
    sensitivity : ndarray, shape (rows, cols)
        M, of mean 1 over the pixels that are not NaN, which are one component.
    beam : ndarray, shape of the padded grid
        L.
    variance, mask, flux, rotation : array_like, optional
        As for `reference.model.problem`.
    prior : ndarray, shape (rows, cols), optional
        Weights λ of a prior of M, as for `reference.solve_dense`: each counts as a
        measurement.

    Returns
    -------
    ndarray, shape (rows * cols, rows * cols)
        The covariance; NaN in rows and columns of pixels that are NaN in M.

    Notes
    -----
    With J the derivatives of √w·c·L·M with respect to (M, L), those of the other components left
    out, (JᵀJ)⁺ is the covariance in the gauge of least norm. That of mean 1 follows by the
    projection P = 1 − M·1ᵀ/N onto changes of mean 0.
    """
    data = problem(frames, shifts, variance=variance, mask=mask, flux=flux, rotation=rotation)
    known = np.isfinite(sensitivity).ravel()
    rows, _, _ = gradient(data, np.nan_to_num(sensitivity), np.nan_to_num(beam))
    rows = rows[rows[:, : known.size][:, known].any(axis=1)]
    if prior is not None:
        pieces = np.where(known, 0, -1).reshape(sensitivity.shape)
        of_prior, _ = prior_rows(prior, pieces, sensitivity)
        rows = np.vstack([rows, np.pad(of_prior, ((0, 0), (0, beam.size)))])
    normal = np.linalg.pinv(rows.T @ rows, rcond=1e-11, hermitian=True)
    project = np.eye(known.size) - np.outer(np.nan_to_num(sensitivity), known) / known.sum()
    result = project @ normal[: known.size, : known.size] @ project.T
    result[~known] = np.nan
    result[:, ~known] = np.nan
    return np.asarray(result)

"""Corrections towards the mean of the neighbours: LocalMean and Gated."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from equipix._check import as_array, number
from equipix._native import SceneCorrection as Native
from equipix.scene.adaptive import SceneCorrection, whole_number

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike

    from equipix.scene.adaptive import DataRange

FOUR = ((0, 1, 0), (1, 0, 1), (0, 1, 0))
"""Weights of the mean of four neighbours."""


class LocalMean(SceneCorrection):
    """Gain and offset towards the mean of the neighbours, in every frame.

    Parameters
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols), 16 or more.
    data_range : dtype or tuple of float
        Lowest and highest raw value in DN, or the dtype of whole numbers.
    step : float
        Step η, below the stability bound 1/λ (Notes).
    kernel : array_like, shape (odd, odd)
        Weights of the neighbours; they are divided by their sum.
    saturation : float, optional
        Raw value in DN from which a pixel is saturated and does not learn; by default the largest
        whole number of the frames' dtype, and none for floats.
    workers : int, optional
        Number of threads; by default one for each processor.
    mask : array_like, shape (rows, cols), optional
        Pixels that are not 0 in it do not learn, and others do not learn from them.

    Raises
    ------
    InputError
        If the step is not above 0 and below the bound, or the kernel has none.

    Notes
    -----
    X = g y + o, E = T − X with the weighted mean T of the neighbours, edges reflected; then
    g ← g + η E y and o ← o + η E: the steepest descent of ΣE² of Scribner's method [1]_. λ is the
    largest 1 − K̂ of the kernel over all spatial frequencies, 2 for the mean of four; with
    y² + 1 ≤ 2 the bound is 2/(2λ), 0.5 for the mean of four. Where y is outside of [0, 1] the step
    is shorter. While the scene stands still, its details are taken for a pattern: use `Gated`,
    `Registered`, `ConstantStatistics` or `Kalman` where it stops.

    References
    ----------
    .. [1] D. A. Scribner, K. A. Sarkady, M. R. Kruer, J. T. Caulfield, J. D. Hunt, C. Herman,
       "Adaptive nonuniformity correction for IR focal-plane arrays using neural networks", Proc.
       SPIE 1541 (1991) 100-109.

    Examples
    --------
    >>> from equipix import scene, simulate
    >>> moving = simulate.MovingScene(seed=1, shape=(48, 64))
    >>> method = scene.LocalMean((48, 64), data_range=(0, 1))
    >>> for frame in moving.frames(200):
    ...     corrected = method.update(frame.values)
    >>> left = moving.residual_pattern(method.gain, method.offset, frame.level)
    >>> left < moving.offset_spread / 4
    True
    """

    method: ClassVar[str] = "local-mean"

    def __init__(
        self,
        shape: tuple[int, int],
        data_range: DTypeLike | DataRange,
        *,
        step: float = 0.025,
        kernel: ArrayLike = FOUR,
        saturation: float | None = None,
        workers: int | None = None,
        mask: ArrayLike | None = None,
    ) -> None:
        """Begin with gain 1 and offset 0."""
        weights = as_array("kernel", kernel, ndim=2).astype(np.float64)
        options = {"step": number("step", step), "kernel": weights.tolist()}
        super().__init__(shape, data_range, saturation, workers, options, mask)

    def _made(self) -> Native:
        kernel = np.array(self._options["kernel"], np.float64)
        return Native.local_mean(self._shape, self._range, self._options["step"], kernel)


class Gated(SceneCorrection):
    """Gain and offset towards a local mean, only where that mean has changed.

    Parameters
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols), 16 or more.
    data_range : dtype or tuple of float
        Lowest and highest raw value in DN, or the dtype of whole numbers.
    step : float
        Step η, below the stability bound 1/λ; it is 0.82 for a width of 11.
    width : int
        Rows and columns of the square, odd.
    threshold : float
        Change of the local mean, less the mean of the frame, above which a pixel is updated, on the
        scale [0, 1]. 0 switches the gate off.
    texture : float
        Factor k of the step η / (1 + k σ²) with the variance σ² of the corrected values in the
        square, on the scale [0, 1]. With 1000 the pattern itself makes the first steps too short.
    saturation : float, optional
        Raw value in DN from which a pixel is saturated and does not learn; by default the largest
        whole number of the frames' dtype, and none for floats.
    workers : int, optional
        Number of threads; by default one for each processor.
    mask : array_like, shape (rows, cols), optional
        Pixels that are not 0 in it do not learn, and others do not learn from them.

    Raises
    ------
    InputError
        If a number is out of its range.

    Notes
    -----
    The method of Hardie et al. [1]_, with the mean of the frame taken off the local mean, so that a
    change of the level alone updates hardly anything. T less that mean is kept for each pixel from
    its last update.

    References
    ----------
    .. [1] R. C. Hardie, F. Baxley, B. Brys, P. Hytla, "Scene-based nonuniformity correction with
       reduced ghosting using a gated LMS algorithm", Optics Express 17 (2009) 14918-14933.
    """

    method: ClassVar[str] = "gated"
    _UNLEARNED: ClassVar[str] = (
        "the local mean never changed by more than 'threshold'; take a moving scene"
    )

    def __init__(
        self,
        shape: tuple[int, int],
        data_range: DTypeLike | DataRange,
        *,
        step: float = 0.06,
        width: int = 11,
        threshold: float = 0.02,
        texture: float = 100.0,
        saturation: float | None = None,
        workers: int | None = None,
        mask: ArrayLike | None = None,
    ) -> None:
        """Begin with gain 1 and offset 0."""
        options = {
            "step": number("step", step),
            "width": whole_number("width", width),
            "threshold": number("threshold", threshold),
            "texture": number("texture", texture),
        }
        super().__init__(shape, data_range, saturation, workers, options, mask)

    def _made(self) -> Native:
        return Native.gated(self._shape, self._range, **self._options)

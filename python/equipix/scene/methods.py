"""The methods of corrections from the scene, and their states read from files."""

from dataclasses import dataclass
from os import PathLike
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import Array, positive_workers
from equipix._native import SceneCorrection as Native
from equipix.errors import EquipixError, FileError
from equipix.scene.scene_correction import SceneCorrection, SceneState

FOUR = ((0, 1, 0), (1, 0, 1), (0, 1, 0))
"""Weights of the mean of four neighbours."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class LocalMean(SceneCorrection):
    """Gain and offset towards the mean of the neighbours, in every frame.

    Attributes
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols), 16 or more.
    data_range : dtype or tuple of float
        Lowest and highest raw value in DN, or the dtype of whole numbers.
    saturation : float, optional
        Raw value in DN from which a pixel is saturated and does not learn; by default the largest
        whole number of the frames' dtype, and none for floats.
    workers : int, optional
        Number of threads; by default one for each processor.
    mask : array_like, shape (rows, cols), optional
        Pixels that are not 0 in it do not learn, and others do not learn from them.
    step : float
        Step η, below the stability bound 1/λ (Notes).
    kernel : array_like, shape (odd, odd)
        Weights of the neighbours; they are divided by their sum.

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
    step: float = 0.025
    kernel: ArrayLike = FOUR

    def _made(self) -> Native:
        return Native.local_mean(self.shape, self._range, self.step, np.array(self.kernel))


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Gated(SceneCorrection):
    """Gain and offset towards a local mean, only where that mean has changed.

    Attributes
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols), 16 or more.
    data_range : dtype or tuple of float
        Lowest and highest raw value in DN, or the dtype of whole numbers.
    saturation : float, optional
        Raw value in DN from which a pixel is saturated and does not learn; by default the largest
        whole number of the frames' dtype, and none for floats.
    workers : int, optional
        Number of threads; by default one for each processor.
    mask : array_like, shape (rows, cols), optional
        Pixels that are not 0 in it do not learn, and others do not learn from them.
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
    step: float = 0.06
    width: int = 11
    threshold: float = 0.02
    texture: float = 100.0


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Registered(SceneCorrection):
    """Gain and offset towards the other frame of a pair, moved by the shift between them.

    Attributes
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols), 20 or more.
    data_range : dtype or tuple of float
        Lowest and highest raw value in DN, or the dtype of whole numbers.
    saturation : float, optional
        Raw value in DN from which a pixel is saturated and does not learn; by default the largest
        whole number of the frames' dtype, and none for floats.
    workers : int, optional
        Number of threads; by default one for each processor.
    mask : array_like, shape (rows, cols), optional
        Pixels that are not 0 in it do not learn, and others do not learn from them.
    step : float
        Step η, below the stability bound 0.25.
    least_motion : float
        Shift in pixels below which the earlier frame of a pair is kept for a later one.
    most_motion : int
        Largest shift along an axis in pixels.
    cutoff : float
        Highest spatial frequency of the phase correlation in cycles per pixel. Above 0.1 the
        pattern of the pixels, which stands still, decides the shift of usual scenes.
    agreement : float
        Least mean cosine of the phases that the shift leaves, 0 to 1; pairs below, as after a
        change of scene, are not used. On small arrays, of few phases, at least what the best shift
        between unrelated frames exceeds in 1 % of them is asked for: 0.36 at 96×96, 0.62 at 48×64.

    Raises
    ------
    InputError
        If a number is out of its range.

    Notes
    -----
    The method of Zuo et al. [1]_, with both frames of a pair corrected. For two frames with
    X₂(p) = X₁(p + d) the difference is E(p) = X₁(p + d) − X₂(p) = S X₁ − X₂, by a cubic B-spline,
    less its mean. The step is that of steepest descent of ΣE²: g ← g + η (E y₂ − (Sᵀ E) y₁) and
    o ← o + η (E − Sᵀ E) with the transpose Sᵀ, so no sequence of frames makes errors grow. One
    shift holds for the whole frame: rotation, parallax and moving objects are not modelled.

    References
    ----------
    .. [1] C. Zuo, Q. Chen, G. Gu, X. Sui, "Scene-based nonuniformity correction algorithm based on
       interframe registration", Journal of the Optical Society of America A 28 (2011) 1164-1176.
    """

    method: ClassVar[str] = "registered"
    _UNLEARNED: ClassVar[str] = (
        "the scene never moved by 'least_motion', or no pair of frames agreed; take a moving scene"
    )
    step: float = 0.1
    least_motion: float = 0.5
    most_motion: int = 8
    cutoff: float = 0.1
    agreement: float = 0.3


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ConstantStatistics(SceneCorrection):
    """Mean and deviation of each pixel over time made equal to those of its neighbourhood.

    Attributes
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols), 16 or more.
    data_range : dtype or tuple of float
        Lowest and highest raw value in DN, or the dtype of whole numbers.
    saturation : float, optional
        Raw value in DN from which a pixel is saturated and does not learn; by default the largest
        whole number of the frames' dtype, and none for floats.
    workers : int, optional
        Number of threads; by default one for each processor.
    mask : array_like, shape (rows, cols), optional
        Pixels that are not 0 in it do not learn, and others do not learn from them.
    width : int
        Rows and columns of the neighbourhood, odd.
    window : int
        Frames that the statistics remember: all have the same weight up to it, and later older
        ones fade exponentially.
    motion : float
        Rms change of the means of 8×8 pixels, less their own mean, above which the scene has moved,
        on the scale [0, 1]. Only frames that moved count.
    prior : int
        Number of moving frames at which half of a gain's deviation from 1 is believed.

    Raises
    ------
    InputError
        If a number is out of its range.

    Notes
    -----
    The method of Harris and Chiang [1]_ with a square around each pixel in the place of the array.
    With the mean m and the standard deviation s of a pixel over n frames, m̄ and s̄ their means
    over the square, g = 1 + n/(n + prior) · (s̄/s − 1) and o = m̄ − g m. Patterns wider than the
    square are not corrected: of white offsets 1/`width` remains.

    References
    ----------
    .. [1] J. G. Harris, Y.-M. Chiang, "Nonuniformity correction of infrared image sequences using
       the constant-statistics constraint", IEEE Transactions on Image Processing 8 (1999)
       1148-1151.
    """

    method: ClassVar[str] = "constant-statistics"
    _UNLEARNED: ClassVar[str] = "the scene never moved by more than 'motion'; take a moving scene"
    width: int = 21
    window: int = 4000
    motion: float = 0.004
    prior: int = 100


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Kalman(SceneCorrection):
    """Recursive estimate of drifting gains and offsets from blocks of frames, with variances.

    Attributes
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols), 16 or more.
    data_range : dtype or tuple of float
        Lowest and highest raw value in DN, or the dtype of whole numbers.
    saturation : float, optional
        Raw value in DN from which a pixel is saturated and does not learn; by default the largest
        whole number of the frames' dtype, and none for floats.
    workers : int, optional
        Number of threads; by default one for each processor.
    mask : array_like, shape (rows, cols), optional
        Pixels that are not 0 in it do not learn, and others do not learn from them.
    width : int
        Rows and columns of the neighbourhood, odd.
    block : int
        Moving frames of a block, even; after each the coefficients change.
    motion : float
        Rms change of the means of 8×8 pixels, less their own mean, above which the scene has moved,
        on the scale [0, 1]. Only frames that moved count.
    gain_spread, offset_spread : float
        Standard deviations of gains, and of offsets on the scale [0, 1], over the pixels.
    memory : float
        Moving frames over which gains and offsets drift: their correlation after n frames is
        exp(−n/memory).

    Raises
    ------
    InputError
        If a number is out of its range.

    Notes
    -----
    The method of Torres and Hayat [1]_ with the mean r of the corrected values in a square as the
    scene: y − ½ = G (r − ½) + O + e. The frames of a block give normal equations of (G, O). The
    detail e of neighbouring frames is correlated, so its variance follows from the difference
    between the halves of a block, over the whole array. The variances include neither patterns
    wider than the square, nor a scene that differs from place to place, nor the errors of r: at a
    contrast of 1 % the errors are 1.6 times the standard deviations.

    References
    ----------
    .. [1] S. N. Torres, M. M. Hayat, "Kalman filtering for adaptive nonuniformity correction in
       infrared focal-plane arrays", Journal of the Optical Society of America A 20 (2003) 470-480.
    """

    method: ClassVar[str] = "kalman"
    _UNLEARNED: ClassVar[str] = (
        "no block of moving frames is complete; take a moving scene, or a shorter 'block'"
    )
    width: int = 21
    block: int = 50
    motion: float = 0.004
    gain_spread: float = 0.05
    offset_spread: float = 0.1
    memory: float = 1e6

    def _learned(self) -> bool:
        return self.frames >= self.block

    @property
    def gain_std(self) -> Array:
        """Standard deviation of each gain, shape (rows, cols), float32."""
        return np.sqrt(self._variances()[0])

    @property
    def offset_std(self) -> Array:
        """Standard deviation of each offset in DN, shape (rows, cols), float32."""
        low, high = self._range
        return np.sqrt(self._variances()[1]) * np.float32(high - low)

    def _variances(self) -> tuple[Array, Array]:
        found = self._native.variances()
        if found is None:
            raise EquipixError("the compiled part gave no variances: please report this")
        return found


METHODS: dict[str, type[SceneCorrection]] = {
    each.method: each for each in (LocalMean, Gated, Registered, ConstantStatistics, Kalman)
}
"""The class of each method by its name."""


def resumed(
    path: str | PathLike[str], state: SceneState, *, workers: int | None = None
) -> SceneCorrection:
    """Make the correction of a state that was read from a file.

    Raises
    ------
    FileError
        If no correction can have that state.
    """
    positive_workers(workers)
    try:
        made = METHODS[state.method](
            state.shape,
            state.data_range,
            saturation=state.saturation,
            workers=workers,
            mask=state.mask,
            **state.options,
        )
        made.restore(state)
    except (ArithmeticError, KeyError, TypeError, ValueError) as error:
        raise FileError(
            f"{path}: is damaged: {error} (in {state.KIND}): use a copy, or learn again"
        ) from error
    return made

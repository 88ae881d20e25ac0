"""Corrections by statistics over time: ConstantStatistics and Kalman."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from equipix._check import number
from equipix._native import SceneCorrection as Native
from equipix.errors import EquipixError
from equipix.scene.adaptive import SceneCorrection, whole_number

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike

    from equipix._types import Array
    from equipix.scene.adaptive import DataRange


class ConstantStatistics(SceneCorrection):
    """Mean and deviation of each pixel over time made equal to those of its neighbourhood.

    Parameters
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols), 16 or more.
    data_range : dtype or tuple of float
        Lowest and highest raw value in DN, or the dtype of whole numbers.
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

    def __init__(
        self,
        shape: tuple[int, int],
        data_range: DTypeLike | DataRange,
        *,
        width: int = 21,
        window: int = 4000,
        motion: float = 0.004,
        prior: int = 100,
        saturation: float | None = None,
        workers: int | None = None,
        mask: ArrayLike | None = None,
    ) -> None:
        """Begin with gain 1 and offset 0."""
        options = {
            "width": whole_number("width", width),
            "window": whole_number("window", window),
            "motion": number("motion", motion),
            "prior": whole_number("prior", prior),
        }
        super().__init__(shape, data_range, saturation, workers, options, mask)

    def _made(self) -> Native:
        return Native.constant_statistics(self._shape, self._range, **self._options)


class Kalman(SceneCorrection):
    """Recursive estimate of drifting gains and offsets from blocks of frames, with variances.

    Parameters
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols), 16 or more.
    data_range : dtype or tuple of float
        Lowest and highest raw value in DN, or the dtype of whole numbers.
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

    def __init__(
        self,
        shape: tuple[int, int],
        data_range: DTypeLike | DataRange,
        *,
        width: int = 21,
        block: int = 50,
        motion: float = 0.004,
        gain_spread: float = 0.05,
        offset_spread: float = 0.1,
        memory: float = 1e6,
        saturation: float | None = None,
        workers: int | None = None,
        mask: ArrayLike | None = None,
    ) -> None:
        """Begin with gain 1 and offset 0."""
        options = {
            "width": whole_number("width", width),
            "block": whole_number("block", block),
            "motion": number("motion", motion),
            "gain_spread": number("gain_spread", gain_spread),
            "offset_spread": number("offset_spread", offset_spread),
            "memory": number("memory", memory),
        }
        super().__init__(shape, data_range, saturation, workers, options, mask)

    def _made(self) -> Native:
        return Native.kalman(self._shape, self._range, **self._options)

    def _learned(self) -> bool:
        return self.frames >= int(self._options["block"])

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

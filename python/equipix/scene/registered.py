"""Correction by pairs of frames: Registered."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from equipix._check import number
from equipix._native import SceneCorrection as Native
from equipix.scene.adaptive import SceneCorrection, whole_number

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike

    from equipix.scene.adaptive import DataRange


class Registered(SceneCorrection):
    """Gain and offset towards the other frame of a pair, moved by the shift between them.

    Parameters
    ----------
    shape : tuple of int
        Sizes of the sensor (rows, cols), 20 or more.
    data_range : dtype or tuple of float
        Lowest and highest raw value in DN, or the dtype of whole numbers.
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

    def __init__(
        self,
        shape: tuple[int, int],
        data_range: DTypeLike | DataRange,
        *,
        step: float = 0.1,
        least_motion: float = 0.5,
        most_motion: int = 8,
        cutoff: float = 0.1,
        agreement: float = 0.3,
        saturation: float | None = None,
        workers: int | None = None,
        mask: ArrayLike | None = None,
    ) -> None:
        """Begin with gain 1 and offset 0."""
        options = {
            "step": number("step", step),
            "least_motion": number("least_motion", least_motion),
            "most_motion": whole_number("most_motion", most_motion),
            "cutoff": number("cutoff", cutoff),
            "agreement": number("agreement", agreement),
        }
        super().__init__(shape, data_range, saturation, workers, options, mask)

    def _made(self) -> Native:
        return Native.registered(self._shape, self._range, **self._options)

"""Quality of frames and sensors: noise by its kinds, non-uniformity, linearity."""

from equipix.metrics.correctability import correctability, validity_interval
from equipix.metrics.emva import emva_spatial, emva_transfer
from equipix.metrics.maps import (
    block_means,
    netd,
    non_uniformity,
    planes,
    relative_error,
    roughness,
)
from equipix.metrics.three_d import three_d_noise

__all__ = [
    "block_means",
    "correctability",
    "emva_spatial",
    "emva_transfer",
    "netd",
    "non_uniformity",
    "planes",
    "relative_error",
    "roughness",
    "three_d_noise",
    "validity_interval",
]
__dir__ = __all__.copy

"""Quality of frames and sensors: noise by its kinds, non-uniformity, linearity."""

from equipix.metrics.correctability import Correctability, correctability, validity_interval
from equipix.metrics.emva import EmvaSpatial, Split, emva_spatial
from equipix.metrics.frames import netd, roughness
from equipix.metrics.planes import planes
from equipix.metrics.three_d import ThreeDNoise, three_d_noise
from equipix.metrics.transfer import EmvaTransfer, emva_transfer

__all__ = [
    "Correctability",
    "EmvaSpatial",
    "EmvaTransfer",
    "Split",
    "ThreeDNoise",
    "correctability",
    "emva_spatial",
    "emva_transfer",
    "netd",
    "planes",
    "roughness",
    "three_d_noise",
    "validity_interval",
]

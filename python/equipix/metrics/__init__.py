"""Quality of frames and sensors: noise by its kinds, non-uniformity, linearity."""

from equipix.metrics.correctability import Correctability, correctability, validity_interval
from equipix.metrics.emva import EmvaSpatial, EmvaTransfer, Split, emva_spatial, emva_transfer
from equipix.metrics.frame_noise import ThreeDNoise, three_d_noise
from equipix.metrics.maps import netd, planes, roughness

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

"""Virtual sensors, beams and cameras: experiments whose truth is known."""

from equipix.maps import block_means, relative_error
from equipix.simulate.accuracy import noise_prediction
from equipix.simulate.camera import Camera
from equipix.simulate.rig import Truth, VirtualExperiment, experiment
from equipix.simulate.signal import (
    Beam,
    cosine_sensitivity,
    exposures,
    gaussian_beam,
    paper_sensitivity,
    striped_beam,
    tilted_beam,
    wavy_beam,
)

__all__ = [
    "Beam",
    "Camera",
    "Truth",
    "VirtualExperiment",
    "block_means",
    "cosine_sensitivity",
    "experiment",
    "exposures",
    "gaussian_beam",
    "noise_prediction",
    "paper_sensitivity",
    "relative_error",
    "striped_beam",
    "tilted_beam",
    "wavy_beam",
]

"""Virtual sensors, beams and cameras: experiments whose truth is known."""

from equipix.metrics.maps import block_means, relative_error
from equipix.simulate.accuracy import noise_prediction
from equipix.simulate.beams import (
    Beam,
    cosine_sensitivity,
    exposures,
    filtered,
    gaussian_beam,
    paper_sensitivity,
    striped_beam,
    tilted_beam,
    wavy_beam,
)
from equipix.simulate.camera import Camera
from equipix.simulate.moving import Frame, MovingScene
from equipix.simulate.rig import Truth, VirtualExperiment, experiment
from equipix.simulate.staring import StaringArray

__all__ = [
    "Beam",
    "Camera",
    "Frame",
    "MovingScene",
    "StaringArray",
    "Truth",
    "VirtualExperiment",
    "block_means",
    "cosine_sensitivity",
    "experiment",
    "exposures",
    "filtered",
    "gaussian_beam",
    "noise_prediction",
    "paper_sensitivity",
    "relative_error",
    "striped_beam",
    "tilted_beam",
    "wavy_beam",
]

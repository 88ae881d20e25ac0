"""Virtual sensors, beams and cameras: experiments whose truth is known."""

from equipix.simulate.accuracy import noise_prediction
from equipix.simulate.beams import (
    cosine_sensitivity,
    exposures,
    filtered,
    gaussian_beam,
    paper_sensitivity,
    striped_beam,
    tilted_beam,
    wavy_beam,
)
from equipix.simulate.bolometers import BolometerArray
from equipix.simulate.camera import Camera
from equipix.simulate.moving import MovingScene
from equipix.simulate.rig import VirtualExperiment, experiment
from equipix.simulate.staring import StaringArray

__all__ = [
    "BolometerArray",
    "Camera",
    "MovingScene",
    "StaringArray",
    "VirtualExperiment",
    "cosine_sensitivity",
    "experiment",
    "exposures",
    "filtered",
    "gaussian_beam",
    "noise_prediction",
    "paper_sensitivity",
    "striped_beam",
    "tilted_beam",
    "wavy_beam",
]
__dir__ = __all__.copy

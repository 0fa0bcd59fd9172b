"""The answer: from a log to the frequency response of each joint."""

from pronk.response.delay import DelayFit, fit_delay
from pronk.response.distortion import Distortion, distortion, third_harmonic
from pronk.response.estimate import estimate, operators
from pronk.response.estimator import Estimator
from pronk.response.operator import H1Operator
from pronk.response.response import FrequencyResponse, load, save

__all__ = [
    "DelayFit",
    "Distortion",
    "Estimator",
    "FrequencyResponse",
    "H1Operator",
    "distortion",
    "estimate",
    "fit_delay",
    "load",
    "operators",
    "save",
    "third_harmonic",
]

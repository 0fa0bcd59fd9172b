"""Estimate the frequency response of each joint from a log."""

import sys
from types import ModuleType

from pronk.logs.joint_log import JointLog
from pronk.response.diagnostics import DelayFit, fit_delay, third_harmonic
from pronk.response.estimate import estimate, operators
from pronk.response.h1 import H1Operator
from pronk.response.response import Estimator, FrequencyResponse, load, save

__all__ = [
    "DelayFit",
    "Estimator",
    "FrequencyResponse",
    "H1Operator",
    "estimate",
    "fit_delay",
    "load",
    "operators",
    "save",
    "third_harmonic",
]


class _Package(ModuleType):
    """Make `pronk.response(log, joint)` call `estimate`."""

    def __call__(
        self, log: JointLog, joint: str, estimator: Estimator | None = None
    ) -> list[FrequencyResponse]:
        return estimate(log, joint, estimator)


sys.modules[__name__].__class__ = _Package

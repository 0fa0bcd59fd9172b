"""Estimate the frequency response of each joint from a log."""

import sys
from types import ModuleType

from pronk.logs.joint_log import JointLog
from pronk.response.estimate import estimate, operators
from pronk.response.h1 import H1Operator
from pronk.response.response import Estimator, FrequencyResponse, load, save

__all__ = ["Estimator", "FrequencyResponse", "H1Operator", "estimate", "load", "operators", "save"]


class _Package(ModuleType):
    """Make `pronk.response(log, joint)` call `estimate`."""

    def __call__(
        self, log: JointLog, joint: str, estimator: Estimator | None = None
    ) -> list[FrequencyResponse]:
        return estimate(log, joint, estimator)


sys.modules[__name__].__class__ = _Package

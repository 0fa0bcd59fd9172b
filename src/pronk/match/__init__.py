"""Find the parameters with which a simulated joint responds as the measured one does.

Start at `pipeline.match_frameworks`. In order: `measured_joint` (responses ready to be compared),
`simulated` (the same of the simulator), `grid` (the paper's search, whole or linearized),
`response_fit` (off the grid, and mode drive) or `arm` (joints that moved together), `result`,
`randomization` (what training randomizes), `gains`. The one list of parameters is `parameters`;
problems and solvers are in `fit`, confidence intervals in `uncertainty`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

from pronk.logs.joint_log import JointLog
from pronk.match.pipeline import match_logs
from pronk.match.predict import predict
from pronk.match.result import MatchResult
from pronk.match.settings import MatchSettings
from pronk.robots import RobotSpec

__all__ = ["MatchResult", "MatchSettings", "match_logs", "predict"]


class _Package(ModuleType):
    """Make `pronk.match(logs, robot)` call `match_logs`."""

    def __call__(self, logs: Sequence[JointLog], robot: RobotSpec, **options: Any) -> MatchResult:
        return match_logs(logs, robot, **options)


sys.modules[__name__].__class__ = _Package

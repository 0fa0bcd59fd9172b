"""The same question to the simulator: which gains make it answer like the real joint?

Start at `pipeline.match_logs`. What it uses, in order: `target` (measured responses, ready to be
compared), `grid` (the paper's search), `quick` (the same optimum by the linearized model),
`refine` (off the grid), `interval` (how far to believe it), `amplitude` (does friction show?),
`ranges` (what training randomizes). Arms whose joints all moved at once have a room of their own,
`arm`. Results are `result.MatchResult` and `gains.MatchedGains`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

from pronk.logs.joint_log import SweepLog
from pronk.match.pipeline import match_logs
from pronk.match.predict import predict
from pronk.match.result import MatchResult
from pronk.match.settings import MatchSettings
from pronk.robots import Robot

__all__ = ["MatchResult", "MatchSettings", "match_logs", "predict"]


class _Package(ModuleType):
    """Make `pronk.match(logs, robot)` call `match_logs`."""

    def __call__(self, logs: Sequence[SweepLog], robot: Robot, **options: Any) -> MatchResult:
        return match_logs(logs, robot, **options)


sys.modules[__name__].__class__ = _Package

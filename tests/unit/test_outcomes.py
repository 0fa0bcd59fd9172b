"""Outcomes of a study: which jumps have one."""

from __future__ import annotations

import math

from pronk.jump.study.outcomes import OUTCOMES
from pronk.jump.trial.jumps import JumpFigures
from pronk.jump.trial.results import TrialRun
from pronk.policy.script import Script


def run_of(figures: JumpFigures) -> TrialRun:
    """Return a run with some figures."""
    script = Script(command=(1.0, 0.0, 0.0))
    return TrialRun(policy="p", case="forward 1", number=0, seed=0, script=script, figures=figures)


def test_a_robot_that_never_stood_has_neither_fallen_nor_kept_from_falling() -> None:
    """Drives too soft for its weight: no falls would be the best outcome of the worst robot."""
    never_stood = run_of(JumpFigures(standing=False))
    fell_before_the_jump = run_of(JumpFigures(standing=False, fell=True))
    stood = run_of(JumpFigures(standing=True, fell=False))
    fell = OUTCOMES["fell"].value
    assert math.isnan(fell(never_stood))
    assert fell(fell_before_the_jump) == 1.0
    assert fell(stood) == 0.0
    # It was commanded to jump all the same.
    assert OUTCOMES["landed"].value(never_stood) == 0.0
    assert OUTCOMES["jumped"].value(never_stood) == 0.0

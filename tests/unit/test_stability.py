"""The stability limit: the step that a refusal names is stable."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from pronk.errors import PronkError
from pronk.identify.simulators.profiles import profile
from pronk.identify.simulators.stability import require_stable, stability_share
from sized_joint import JOINT, SIZES, sized_robot


@dataclass(frozen=True, kw_only=True)
class SameDrive:
    """A drive of the joint, as a match or an export has it."""

    joints: tuple[str, ...]
    stiffness: float
    damping: float
    armature: float


def test_the_step_that_is_named_is_stable(tmp_path: Path) -> None:
    framework = profile("mjlab")
    robot = framework.robot(sized_robot(SIZES["servo"], tmp_path))
    for damping in (1.0, 5.0, 20.0):
        drive = SameDrive(joints=(JOINT,), stiffness=50.0, damping=damping, armature=0.001)
        with pytest.raises(PronkError, match="timestep_s=") as caught:
            require_stable(framework, robot, [drive])
        step = float(str(caught.value).split("timestep_s=")[1].rstrip("."))
        assert stability_share(replace(robot, timestep_s=step), [drive]) < 1.0
        assert stability_share(replace(robot, timestep_s=2.0 * step), [drive]) >= 1.0


def test_no_step_is_named_where_none_is_stable(tmp_path: Path) -> None:
    framework = profile("mjlab")
    robot = framework.robot(sized_robot(SIZES["wrist of a stiff arm"], tmp_path))
    drive = SameDrive(joints=(JOINT,), stiffness=2e5, damping=2e4, armature=0.0)
    with pytest.raises(PronkError, match="implicit") as caught:
        require_stable(framework, robot, [drive])
    assert "timestep_s=" not in str(caught.value)

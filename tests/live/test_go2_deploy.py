"""A policy with a jump input on the virtual Go2, over DDS: stand up, run, jump, sit down."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnxruntime")
pytest.importorskip("cyclonedds")

from dds_domain import own_domain
from deploy_runs import FRESH, PATIENT, QUICK, hold, met, notified, simulated
from hopper import write_hopper
from pronk.deploy.links.address import Address
from pronk.deploy.runtime.deploy_log import read_deploy_log
from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.plan import Link, RunPlan
from pronk.deploy.runtime.run import Deployment
from pronk.robots import load_robot

pytestmark = pytest.mark.live
GO2 = load_robot("go2")
PUSH = 0.4
"""Share of the way to straight legs that the jump input commands."""


def go2_hopper(path: Path) -> Path:
    """Write a policy that stands and, at the jump input, stretches its legs."""
    return write_hopper(
        path,
        strength=-PUSH,
        robot="go2",
        joint_names=GO2.joint_names,
        default_position=tuple(joint.default_position for joint in GO2.joints),
        stiffness=(20.0,) * 12,
        damping=(0.5,) * 12,
    )


def test_a_go2_stands_up_jumps_and_sits_down(tmp_path: Path) -> None:
    domain = own_domain()
    words = ["go2", "--link", "dds", "--base", "ground", "--domain", str(domain), "--realtime"]
    with simulated(*words):
        plan = RunPlan(
            link=Link(robot="go2", address=Address.parse(f"dds://?domain={domain}"), fresh=FRESH),
            policy=go2_hopper(tmp_path / "policy.onnx"),
            timing=QUICK,
            ages=replace(PATIENT, hold_s=1.0),
            action_valid_s=2.0,
            operator_timeout_s=5.0,
            ignore_latency=True,
            log=tmp_path / "run.mcap",
        )
        with Deployment(plan) as deployment:
            hold(deployment, 20.0, Mode.STAND, OperatorRequest.STAND)
            hold(deployment, 20.0, Mode.POLICY, OperatorRequest.WALK)
            hold(deployment, 1.0)
            hold(deployment, 0.3, jump=True)
            hold(deployment, 1.0)
            assert deployment.mode is Mode.POLICY, notified(deployment)
            assert met(deployment, 20.0, (Mode.SIT,), OperatorRequest.SIT), notified(deployment)
            hold(deployment, 20.0, Mode.DAMP)
    log = read_deploy_log(tmp_path / "run.mcap")
    modes = [Mode(mode) for mode, _ in itertools.groupby(log.ticks.mode.tolist())]
    assert modes[-4:] == [Mode.POLICY, Mode.HALT, Mode.SIT, Mode.DAMP]
    # All knees follow the jump input, in the order of Unitree's messages and back.
    jumps = log.steps.begun[log.steps.jump & log.steps.live]
    assert len(jumps) > 5
    knees = log.ticks.state.position[:, 2::3]
    before = (log.ticks.mode == Mode.POLICY) & (log.ticks.begun < jumps[0])
    standing = knees[before][-1]
    meanwhile = (log.ticks.begun >= jumps[0]) & (log.ticks.begun < jumps[-1] + 0.1)
    assert (knees[meanwhile].max(axis=0) > standing + 0.5 * 1.3 * PUSH).all()
    assert np.abs(log.ticks.state.orientation[meanwhile][:, 1:3]).max() < 0.2

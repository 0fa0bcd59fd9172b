"""Another program commands the joints: refused before anything moves, damped while a policy runs.

The whole of `pronk deploy` against a `pronk simulate`, over LCM and over DDS. All that can damp
the robot but the other writer is given time, so that a slow computer cannot pass for one.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dds_domain import own_domain
from deploy_runs import DAMPED_S, FRESH, PATIENT, QUICK, free_port, hold, met, simulated
from hopper import write_hopper
from pronk.deploy.links.address import Address
from pronk.deploy.runtime.deploy_log import read_deploy_log
from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.plan import Link, RunPlan
from pronk.deploy.runtime.run import Deployment
from pronk.errors import HardwareError
from wire import ROBOT, Wire, over_dds, over_lcm

pytest.importorskip("onnxruntime")
pytest.importorskip("lcm")
pytest.importorskip("cyclonedds")


@pytest.fixture(scope="module", params=["lcm", "dds"])
def reached(request: pytest.FixtureRequest) -> Iterator[tuple[Address, Wire]]:
    """A virtual robot of its own, and another program's listener and sender at its wire."""
    lcm = request.param == "lcm"
    word, number = ("port", free_port()) if lcm else ("domain", own_domain())
    with (
        simulated("--realtime", "--link", request.param, f"--{word}", str(number)),
        over_lcm(number) if lcm else over_dds(number) as wire,
    ):
        yield Address.parse(f"{request.param}://?{word}={number}"), wire


def patient_plan(address: Address, folder: Path) -> RunPlan:
    """A plan whose filter takes nothing for a fault that a busy computer may cause."""
    return RunPlan(
        link=Link(robot=ROBOT.name, address=address, fresh=FRESH),
        policy=write_hopper(folder / "policy.onnx", strength=0.2),
        timing=QUICK,
        ages=replace(PATIENT, hold_s=1.0),
        action_valid_s=2.0,
        operator_timeout_s=2.0,
        ignore_latency=True,
    )


def test_another_writer_is_refused_before_and_damps_while_a_policy_runs(
    reached: tuple[Address, Wire], tmp_path: Path
) -> None:
    address, wire = reached
    plan = replace(patient_plan(address, tmp_path), log=tmp_path / "run.mcap", standby_s=2.0)
    # It is there before: nothing is written, and one line says why.
    wire.speak()
    refused = Deployment(plan)
    with pytest.raises(HardwareError, match="was not opened: another program commands the joints"):
        refused.__enter__()
    wire.hush()
    assert len(wire.received()[0]) == 0
    assert len(refused.summary.refusals) == 1

    # It comes up while the policy runs.
    with Deployment(plan) as deployment:
        hold(deployment, 20.0, Mode.STAND, OperatorRequest.STAND)
        hold(deployment, 20.0, Mode.POLICY, OperatorRequest.WALK)
        hold(deployment, 0.3)
        wire.speak()
        hold(deployment, 20.0, Mode.FAULT)
        # It does not come back by itself, nor by a request to stand.
        hold(deployment, 0.3, None, *[OperatorRequest.STAND] * 30)
        assert deployment.mode is Mode.FAULT
    wire.hush()
    when, damps = wire.received()
    assert not damps[(when < wire.began) & (when > wire.began - 0.2)].any()
    first = when[damps & (when > wire.began)][0]
    assert first - wire.began <= DAMPED_S
    # From there on nothing but damping, to the end.
    assert damps[when >= first].all()
    assert when[-1] - first > 1.0
    [why] = deployment.summary.faults
    assert why.startswith("another program commands the joints")
    assert "\n" not in why
    run_log = read_deploy_log(tmp_path / "run.mcap")
    assert run_log.complete, run_log.damage
    [event] = [event for event in run_log.events if event.kind == "fault"]
    assert (event.text, event.reason, event.level) == (why, "LINK", "LATCH")
    struck = np.flatnonzero(run_log.ticks.damped & (run_log.ticks.begun > wire.began))[0]
    assert run_log.ticks.begun[struck] - wire.began <= DAMPED_S
    assert run_log.ticks.damped[struck:].all()
    assert run_log.ticks.mode[struck - 5] == Mode.POLICY


def test_the_standby_damps_after_a_servo_that_stopped(
    reached: tuple[Address, Wire], tmp_path: Path
) -> None:
    address, wire = reached
    # A servo that is killed over LCM is in `test_sweep_link.py`.
    number = signal.SIGSTOP if address.scheme == "lcm" else signal.SIGKILL
    plan = patient_plan(address, tmp_path)
    late = []
    # A computer that is busy may be late once, or stop the servo by itself.
    for _ in range(3):
        with Deployment(plan) as deployment:
            if not met(deployment, 20.0, (Mode.STAND,), OperatorRequest.STAND):
                continue
            hold(deployment, 0.2)
            struck = time.monotonic()
            os.kill(deployment.servo.pid or 0, number)
            hold(deployment, 20.0, Mode.ENDED)
            went_on = np.inf
            if number == signal.SIGSTOP:
                went_on = time.monotonic()
                # One that goes on ends the tick in which it stopped, and names what has damped.
                os.kill(deployment.servo.pid or 0, signal.SIGCONT)
                hold(deployment, 0.2)
                events = deployment.events_seen()
                reasons = [event.reason for event in events if event.kind == "fault"]
                assert reasons == ["STANDBY"]
        assert deployment.summary.standby
        assert deployment.summary.servo == {}
        time.sleep(0.2)
        when, damps = wire.received()
        after = when > struck + 0.002
        assert damps[after].any()
        first = when[after & damps][0]
        # From there on nothing but damping, but for that tick, for long enough to come to rest.
        assert damps[(when >= first) & (when < went_on)].all()
        assert (~damps[when >= went_on]).sum() <= 1
        assert damps[when > went_on + 1.0].all()
        assert when[-1] - first > 2.0
        late.append(first - struck)
        if late[-1] <= DAMPED_S:
            break
    assert min(late) <= DAMPED_S, late

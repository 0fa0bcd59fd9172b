"""The real processes on the virtual robot in real time: what goes wrong, and what happens then."""

from __future__ import annotations

import itertools
import json
import os
import signal
import time
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import invoke
from deploy_faults import FaultyLink, writes
from deploy_runs import DAMPED_S, LATE, PATIENT, QUICK, hold, met, notified
from hopper import write_hopper

# Reading a log for the first time would keep this process from holding the stick.
from pronk.deploy.runtime.deploy_log import is_deploy_log, read_deploy_log
from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.plan import RunPlan
from pronk.deploy.runtime.reasons import Reason
from pronk.deploy.runtime.run import Deployment
from pronk.errors import ArtefactError, HardwareError
from pronk.jump.virtual.capture import load_capture

pytest.importorskip("onnxruntime")


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_hopper(tmp_path_factory.mktemp("policy") / "policy.onnx", strength=0.2)


@pytest.fixture
def faults() -> dict[str, Any]:
    context = get_context("spawn")
    return {name: context.Event() for name in ("nan", "freeze", "stuck")}


def recover(deployment: Deployment) -> None:
    """Reset a fault: a computer that is busy for a moment looks like one."""
    if deployment.mode is Mode.FAULT:
        hold(deployment, 1.1)
        hold(deployment, 5.0, Mode.DAMP, OperatorRequest.RESET)


def walk(deployment: Deployment, seconds: float = 0.3, **more: Any) -> None:
    """To where the policy decides, and on for a time; after a fault once more, as a person would.

    What is tested comes afterwards.
    """
    for _ in range(5):
        recover(deployment)
        for mode, request in (
            (Mode.STAND, OperatorRequest.STAND),
            (Mode.POLICY, OperatorRequest.WALK),
        ):
            if deployment.mode not in (Mode.POLICY, Mode.FAULT):
                assert met(deployment, 10.0, (mode, Mode.FAULT), request), notified(deployment)
        met(deployment, seconds, (Mode.FAULT,), command=(0.5, 0.0, 0.0), **more)
        if deployment.mode is Mode.POLICY:
            return
    pytest.fail(f"it never walked for {seconds:g} s: {notified(deployment)}")


def first_damping(wire: Path, after: float) -> float:
    """Time from a fault until the first damping that lasts [s]."""
    when, damped = writes(wire)
    later = when > after
    start = when[later & damped][0]
    assert damped[when > start].all() or (when[(when > start) & ~damped][0] - start) > 0.9
    return float(start - after)


Running = tuple[Deployment, Path, Path]
"""A deployment that runs, its wire and its log."""


@pytest.fixture
def running(
    policy: Path, faults: dict[str, Any], tmp_path: Path, request: pytest.FixtureRequest
) -> Iterator[Running]:
    wire = tmp_path / "wire.txt"
    log = tmp_path / "run.mcap"
    plan = RunPlan(
        link=FaultyLink(wire=wire, loss=request.param, faults=faults),
        policy=policy,
        log=log,
        timing=QUICK,
        ignore_latency=True,
        operator_timeout_s=5.0,
    )
    with Deployment(plan) as deployment:
        yield deployment, wire, log


@pytest.mark.parametrize("running", [0.3], indirect=True)
def test_loss_and_killed_processes(running: Running) -> None:
    deployment, wire, log = running
    # A third of the states lost: it walks.
    walk(deployment, 0.8, jump=True)
    # The logger dies: it walks on, and the file holds all but the last moment.
    assert deployment.logger is not None
    os.kill(deployment.logger.pid or 0, signal.SIGKILL)
    killed = time.monotonic()
    walk(deployment)
    assert is_deploy_log(log)
    run_log = read_deploy_log(log)
    assert not run_log.complete
    assert run_log.virtual
    assert killed - run_log.ticks.begun[-1] < 1.0
    assert (np.diff(run_log.ticks.tick) >= 1).all()
    assert Mode.POLICY in run_log.ticks.mode
    # It was there from the first tick on, but for those that the servo missed.
    assert run_log.ticks.tick[0] < 50
    # The policy's process dies: damping.
    walk(deployment)
    os.kill(deployment.policy.pid or 0, signal.SIGKILL)
    killed = time.monotonic()
    hold(deployment, 2.0, Mode.FAULT)
    hold(deployment, 0.2)
    assert first_damping(wire, killed) <= DAMPED_S
    # It does not come back by itself, nor by a request to stand: the fault is latched.
    hold(deployment, 1.2, None, OperatorRequest.STAND)
    assert deployment.mode is Mode.FAULT
    deployment.close()
    # Its last command is too old, by the clock or by the states that have come since.
    old = (Reason.EXPIRED.text, Reason.LAG.text)
    assert any(fault.startswith(old) for fault in deployment.summary.faults), notified(deployment)
    assert deployment.summary.servo["states_lost"] > 100
    assert deployment.summary.policy == {}
    assert "was killed" in deployment.summary.log_error
    assert f"{log} ends" in deployment.summary.log_error


@pytest.mark.parametrize("running", [0.0], indirect=True)
def test_states_that_cannot_be_believed(running: Running, faults: dict[str, Any]) -> None:
    deployment, wire, log = running
    strikes: dict[str, float] = {}
    for name in ("nan", "stuck", "freeze"):
        walk(deployment)
        strikes[name] = struck = time.monotonic()
        faults[name].set()
        hold(deployment, 2.0, Mode.FAULT)
        hold(deployment, 0.2)
        assert first_damping(wire, struck) <= DAMPED_S, name
        faults[name].clear()
        hold(deployment, 1.1)
        assert deployment.mode is Mode.FAULT, "a fault damps for a second at least"
        if name != "freeze":
            hold(deployment, 5.0, Mode.DAMP, OperatorRequest.RESET)
    deployment.close()
    # The log of a run that ended badly is whole.
    run_log = read_deploy_log(log)
    assert run_log.complete, (
        run_log.damage,
        run_log.figures["servo"]["dropped"],
        len(run_log.ticks.begun),
    )
    events = [event for event in run_log.events if event.kind == "fault"]
    assert [event.text for event in events] == deployment.summary.faults
    for name, struck in strikes.items():
        first = next(event for event in events if event.time > struck)
        old = {"NO_STATE", "STATE_LOST"}
        assert first.reason in ({"STATE_NOT_FINITE"} if name == "nan" else old), name
    # What the log says was sent is what was written: damping wherever no target was.
    driven = run_log.ticks.mode != Mode.PREFLIGHT
    assert (run_log.ticks.damped == np.isnan(run_log.ticks.sent[:, 0]))[driven].all()
    when, damped = writes(wire)
    assert abs(int(damped.sum()) - int(run_log.ticks.damped.sum())) <= 1
    assert abs(len(when) - int(driven.sum())) <= 1
    # The policy's actions were followed, once blended in.
    followed = (
        (run_log.ticks.mode == Mode.POLICY)
        & (run_log.ticks.blend == 1.0)
        & (run_log.ticks.level == 0)
    )
    assert followed.any()
    k = int(np.flatnonzero(followed)[0])
    np.testing.assert_allclose(
        run_log.ticks.sent[k], run_log.steps.target[int(run_log.ticks.action.number[k])]
    )
    assert np.isfinite(run_log.ticks.latency[run_log.ticks.mode == Mode.POLICY]).sum() > 10
    assert run_log.figures["servo"]["ticks"] >= len(run_log.ticks.tick)


def test_a_plan_that_cannot_run_is_refused_before_anything_starts(
    policy: Path, tmp_path: Path
) -> None:
    link = FaultyLink(wire=tmp_path / "w")
    names = tuple(f"joint_{i}" for i in range(12))
    other = write_hopper(tmp_path / "other.onnx", joint_names=names)
    with pytest.raises(ArtefactError, match="joint_names"):
        Deployment(RunPlan(link=link, policy=other))
    with pytest.raises(HardwareError, match="action_valid_s"):
        RunPlan(link=link, policy=policy, action_valid_s=0.0)


def test_an_operator_that_is_late_is_not_gone_and_one_that_is_stuck_is(
    policy: Path, tmp_path: Path
) -> None:
    plan = RunPlan(
        link=FaultyLink(wire=tmp_path / "wire.txt"), policy=policy, timing=QUICK, ages=PATIENT
    )
    with Deployment(plan) as deployment:
        # On a busy computer a sleep may last too long itself.
        for _ in range(5):
            recover(deployment)
            hold(deployment, 10.0, Mode.STAND, OperatorRequest.STAND)
            begun = time.monotonic()
            time.sleep(0.5)
            mode = deployment.mode
            slept = time.monotonic() - begun
            if slept < 0.6:
                break
        assert slept < 0.6
        assert mode is Mode.STAND
        time.sleep(1.5)
        assert deployment.mode is Mode.FAULT
        (fault,) = [event for event in deployment.events_seen() if event.kind == "fault"]
        assert fault.reason == Reason.ENDED.name


# --- From the command line ----------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_on_the_virtual_robot_on_the_ground(tmp_path: Path, policy: Path) -> None:
    log = tmp_path / "run.mcap"
    capture = tmp_path / "run.npz"
    figures = tmp_path / "run.json"
    words = ["deploy", str(policy), "--script", "0,0", "--seconds", "0.6", "--ignore-latency-check"]
    files = ["--log", str(log), "--capture", str(capture), "--json", str(figures)]
    # On a busy computer a run may end with a fault, because a process was stopped for too long.
    for _ in range(5):
        done = invoke(words + files)
        if done.exit_code == 0:
            break
        faults = json.loads(figures.read_text())["faults"]
        assert faults, done.output
        for fault in faults:
            assert fault.startswith(tuple(reason.text for reason in LATE)), done.output
        for path in (log, capture, figures):
            path.unlink()
    assert done.exit_code == 0, done.output
    assert "the virtual robot" in done.stdout
    run_log = read_deploy_log(log)
    assert run_log.complete
    assert run_log.virtual
    modes = [Mode(mode) for mode, _ in itertools.groupby(run_log.ticks.mode.tolist())]
    assert modes == [
        *(Mode.PREFLIGHT, Mode.DAMP, Mode.STAND, Mode.POLICY, Mode.HALT, Mode.SIT, Mode.DAMP)
    ]
    seen = load_capture(capture)
    height = seen.position[:, 2]
    standing = run_log.ticks.begun[run_log.ticks.mode == Mode.POLICY] - run_log.ticks.begun[0]
    upright = height[np.searchsorted(seen.time, standing[-1])]
    assert height[-1] < 0.15 < 0.22 < upright < 0.33
    assert json.loads(figures.read_text())["faults"] == []


REAL = ("--link", "dds", "--interface", "nowhere0", "--script")


@pytest.mark.parametrize(
    ("words", "typed", "word"),
    [
        (("--gamepad", "/dev/input/js77"), "", "js77"),
        # Beyond the training range: refused before the confirmation.
        ((*REAL, "0,-1.5"), "", "vy -1.5"),
        ((*REAL, "1,0"), "", "nothing was moved"),
        ((*REAL, "1,0"), "yes\n", "nothing was moved"),
    ],
)
def test_a_command_that_must_not_move_the_robot_is_refused(
    policy: Path, words: tuple[str, ...], typed: str, word: str
) -> None:
    done = invoke(["deploy", str(policy), *words], typed=typed)
    assert done.exit_code != 0
    assert word in done.stderr
    assert ("about to move" in done.stdout) is (word == "nothing was moved")

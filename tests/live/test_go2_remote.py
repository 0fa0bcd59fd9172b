"""A Go2 over DDS by its own remote: released, up, walking while L1 is held, damped without it.

The virtual Go2 runs in a process of its own, behind Unitree's bytes. The policy is one of another
framework that stands, and the two real ones where the folder `shared` lies beside the checkout. All
limits on time are wide, so that a busy computer is not taken for a fault.
"""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")

from dds_domain import own_domain
from deploy_runs import FRESH, PATIENT, QUICK
from foreign_policy import write_foreign
from pronk.deploy.bench.dds_server import DdsServerTransport
from pronk.deploy.bench.server import RobotServer
from pronk.deploy.links.address import Address
from pronk.deploy.links.dds.link import BENCH, REMOTE, DdsNetwork, Participant, ServiceClient
from pronk.deploy.links.realtime import RealTimeSettings, enter
from pronk.deploy.links.remote import RemoteButton, RemoteInput, encode_remote
from pronk.deploy.runtime.deploy_log import DeployLog, read_deploy_log
from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.plan import Link, RunPlan
from pronk.deploy.runtime.poses import RunTiming
from pronk.deploy.runtime.reasons import Reason
from pronk.deploy.runtime.remote_operator import Remote
from pronk.deploy.runtime.run import Deployment
from pronk.jump.virtual.robot import VirtualRobot, hold_of
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.policy.deployable import open_policy
from pronk.robots import load_robot

pytestmark = pytest.mark.live

GO2 = load_robot("go2")
SHARED = Path(__file__).parents[3] / "shared" / "data" / "go2_policies"
DOMAIN = own_domain()
"""Domain of this process: two test processes on one computer must not reach each other."""
LONGEST_S = 120.0
"""Longest wait for a mode [s]."""
NAME = "kaiwu2025_v6-2_124004"
RANGES = {"lin_vel_x": [-1.0, 2.0], "lin_vel_y": [-1.0, 1.0], "ang_vel_z": [-1.0, 1.0]}


def serve(domain: int, end: Connection) -> None:
    """Body of the process with the virtual Go2, which its own controller holds at first."""
    enter(RealTimeSettings(priority=30, lock=False))
    robot = VirtualRobot(GO2, load_sim_params(None, GO2), base="ground", capture_rate_hz=50.0)
    robot.connect()
    wire = DdsServerTransport(GO2, domain=domain, mode="normal")
    server = RobotServer(robot, wire, hold=hold_of(GO2))
    end.send("ready")
    server.run(end.poll)
    capture = robot.capture()
    end.send((server.figures(), capture.time, capture.position))


class Hands:
    """A person at the remote, and the deployment that it steers."""

    def __init__(self, deployment: Deployment) -> None:
        self.deployment = deployment
        self.service = ServiceClient(Participant(DdsNetwork(domain=DOMAIN)), BENCH)

    def hold(self, *buttons: RemoteButton, forward: float = 0.0) -> None:
        remote = RemoteInput(held=frozenset(buttons), left_forward=forward)
        data = encode_remote(remote)
        assert self.service.call(REMOTE, {"bytes": data.hex()}) == {"bytes": data.hex()}

    def press(self, button: RemoteButton, *held: RemoteButton) -> None:
        self.hold(button, *held)
        time.sleep(0.2)
        self.hold(*held)

    def until(self, *modes: Mode, again: RemoteButton | None = None) -> Mode:
        """Wait for a mode, pressing a button every three seconds, START where a fault lasts.

        A computer that is busy for a moment looks like a fault.
        """
        end = time.monotonic() + LONGEST_S
        pressed = -10.0
        while self.deployment.mode not in modes:
            seen = [event.text for event in self.deployment.summary.events_seen]
            assert time.monotonic() < end, f"{self.deployment.mode.name}, not {modes}: {seen}"
            if time.monotonic() - pressed > 3.0:
                pressed = time.monotonic()
                if self.deployment.mode is Mode.FAULT:
                    self.press(RemoteButton.START)
                elif again is not None:
                    self.press(again, RemoteButton.L1)
            time.sleep(0.02)
        return self.deployment.mode


@contextmanager
def virtual_go2() -> Iterator[Connection]:
    context = multiprocessing.get_context("spawn")
    end, other = context.Pipe()
    process = context.Process(target=serve, args=(DOMAIN, other), daemon=True)
    process.start()
    try:
        assert end.recv() == "ready"
        yield end
    finally:
        process.kill()


def steered(
    policy: Path, deploy: Path, log: Path, timing: RunTiming, course: Callable[[Hands], None]
) -> DeployLog:
    """Run a policy by the remote through a course of presses; return its log."""
    plan = RunPlan(
        link=Link(
            robot="go2", address=Address.parse("dds", domain=DOMAIN), release=True, fresh=FRESH
        ),
        policy=policy,
        deploy_yaml=deploy,
        log=log,
        timing=timing,
        ages=PATIENT,
        standby_s=2.0,
        operator_timeout_s=5.0,
        ignore_latency=True,
    )
    operator = Remote(open_policy(policy, GO2, deploy).command_ranges)
    errors: list[BaseException] = []
    with Deployment(plan) as deployment:
        hands = Hands(deployment)

        def act() -> None:
            try:
                course(hands)
            except BaseException as error:
                errors.append(error)
                operator.leave()

        thread = threading.Thread(target=act)
        thread.start()
        deployment.run(operator)
        thread.join()
    if errors:
        raise errors[0]
    return read_deploy_log(log)


def test_the_remote_is_dead_man_and_joystick(tmp_path: Path) -> None:
    policy, deploy = write_foreign(tmp_path, commands={"base_velocity": {"ranges": RANGES}})

    def course(hands: Hands) -> None:
        hands.hold()
        hands.until(Mode.DAMP)
        hands.until(Mode.STAND, again=RemoteButton.A)
        hands.until(Mode.POLICY, again=RemoteButton.Y)
        hands.hold(RemoteButton.L1, forward=0.5)
        time.sleep(1.0)
        # L1 is let go: damped, and A alone brings it back.
        hands.hold()
        hands.until(Mode.FAULT)
        hands.until(Mode.STAND, again=RemoteButton.A)
        hands.until(Mode.POLICY, again=RemoteButton.Y)
        hands.press(RemoteButton.X, RemoteButton.L1)
        hands.until(Mode.DAMP)
        hands.press(RemoteButton.SELECT)

    with virtual_go2() as end:
        log = steered(policy, deploy, tmp_path / "run.mcap", QUICK, course)
        end.send("stop")
        figures, _, position = end.recv()
    assert figures["wire"]["mode switches"] >= 1
    assert log.header["policy"]["deploy"]["file"] == str(deploy)
    # The stick at half of its way is half of the range, as a command in the policy's frame.
    commanded = log.steps.command[log.steps.live]
    assert commanded[:, 0].max() == pytest.approx(1.0, abs=0.01)
    assert np.abs(commanded[:, 1:]).max() == 0.0
    faults = [event.reason for event in log.events if event.kind == "fault"]
    assert Reason.DEAD_MAN.name in faults
    ticks = log.ticks
    # Damped from the first tick of the fault on, for a second at least.
    in_fault = ticks.mode == Mode.FAULT
    assert ticks.damped[in_fault].all()
    assert position[:, 2].max() > 0.24


@pytest.mark.skipif(not SHARED.exists(), reason=f"needs {SHARED}")
def test_a_real_policy_walks_through_the_safety_filter(tmp_path: Path) -> None:
    policy = SHARED / NAME / "policy.onnx"
    deploy = SHARED / NAME / "deploy.yaml"
    fastest = open_policy(policy, GO2, deploy).command_ranges["vx"][1]
    walked = []

    def course(hands: Hands) -> None:
        hands.hold()
        hands.until(Mode.DAMP)
        for _ in range(4):
            hands.until(Mode.STAND, again=RemoteButton.A)
            hands.until(Mode.POLICY, Mode.FAULT, again=RemoteButton.Y)
            for share in np.linspace(0.2, 1.0, 5):
                hands.hold(RemoteButton.L1, forward=share / fastest)
                time.sleep(0.2)
            time.sleep(3.0)
            # A computer that is busy for a moment looks like a fault; then once more.
            walked.append(hands.deployment.mode is Mode.POLICY)
            if walked[-1]:
                break
        hands.press(RemoteButton.X, RemoteButton.L1)
        hands.until(Mode.DAMP)
        hands.press(RemoteButton.SELECT)

    with virtual_go2() as end:
        log = steered(policy, deploy, tmp_path / "run.mcap", RunTiming(), course)
        end.send("stop")
        _, _, position = end.recv()
    faults = [event for event in log.events if event.kind == "fault"]
    assert walked[-1], [event.text for event in faults]
    reasons = {event.reason for event in faults}
    # Late commands of a busy computer can make it fall in a try that does not count; what its
    # wiring and its orientation are does not depend on the time.
    assert not reasons & {Reason.SWAPPED.name, Reason.ORIENTATION.name}
    assert np.ptp(position[:, :2], axis=0).max() > 2.0

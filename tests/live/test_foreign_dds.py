"""Two policies that ran on real Go2s walk on the virtual Go2, over DDS and in this process.

They are other people's and are not in the repository: the test is skipped without the folder
`shared` beside the checkout. The virtual robot runs in a process of its own.
"""

from __future__ import annotations

import multiprocessing
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
pytest.importorskip("onnxruntime")

from dds_domain import own_domain
from pronk.arrays import Array
from pronk.deploy.bench.dds_server import DdsServerTransport
from pronk.deploy.bench.server import RobotServer
from pronk.deploy.links.dds.link import DdsMachine
from pronk.deploy.links.link import Freshness, LinkSettings
from pronk.jump.trial.foreign_check import run_on_virtual_robot
from pronk.jump.virtual.ground import Start
from pronk.jump.virtual.robot import VirtualRobot, hold_of
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.policy.deploy_yaml import read_deploy_yaml
from pronk.policy.foreign import ForeignPolicy, load_foreign_network, run_foreign
from pronk.policy.rollout import projected_gravity
from pronk.policy.script import Velocity
from pronk.robots import load_robot
from pronk.robots.machine import Command, State

pytestmark = pytest.mark.live

GO2 = load_robot("go2")
FOLDER = Path(__file__).parents[3] / "shared" / "data" / "go2_policies"
FAST = "go2_moe_cts_fast_flat_v4_fz_54k"
OTHER = "kaiwu2025_v6-2_124004"
needs_policies = pytest.mark.skipif(not FOLDER.exists(), reason=f"needs {FOLDER}")
DOMAIN = own_domain()
"""Domain of this process: two test processes on one computer must not reach each other."""
PATIENT = Freshness(share=0.02, longest_gap_s=10.0)
"""A computer that runs tests side by side is busy; what is tested here is not that."""


def policy_of(name: str) -> ForeignPolicy:
    deploy = read_deploy_yaml(FOLDER / name / "deploy.yaml")
    return ForeignPolicy(load_foreign_network(FOLDER / name / "policy.onnx", deploy), deploy)


@needs_policies
@pytest.mark.parametrize(
    ("name", "command", "slowest"),
    [(FAST, (4.0, 0.0, 0.0), 3.5), (OTHER, (1.0, 0.0, 0.0), 0.85)],
)
def test_real_policies_walk_and_run_on_the_virtual_go2(
    name: str, command: Velocity, slowest: float
) -> None:
    run = run_on_virtual_robot(
        GO2, load_sim_params(None, GO2), policy_of(name), command, seconds=10.0, seed=3
    )
    assert run.fell_s is None
    assert run.velocity[0] >= slowest


class RobotTime:
    """A machine on the clock of the robot, which slips behind where the computer is busy."""

    def __init__(self, machine: DdsMachine) -> None:
        self.machine = machine

    def now(self) -> float:
        time = self.machine.latest().robot_time
        assert time is not None
        return time

    def latest(self) -> State:
        return self.machine.latest()

    def send(self, command: Command) -> None:
        self.machine.send(replace(command, made=self.machine.now()))

    def wait(self, until: float) -> list[State]:
        begun = self.machine.now()
        while self.now() < until - 1e-6:
            assert self.machine.now() < begun + 120.0, "the virtual robot stands still"
            self.machine.wait(self.machine.now() + 0.001)
        return []


def serve(name: str, domain: int, end: Connection) -> None:
    """Body of the process with the virtual robot, until it receives stop; sends where it went."""
    policy = policy_of(name)
    offset = policy.start_position - np.array([joint.default_position for joint in GO2.joints])
    robot = VirtualRobot(
        GO2,
        load_sim_params(None, GO2),
        base="ground",
        start=Start(joint_offset=tuple(offset)),
        capture_rate_hz=50.0,
    )
    robot.connect()
    wire = DdsServerTransport(GO2, domain=domain)
    server = RobotServer(robot, wire, hold=hold_of(GO2))
    end.send("ready")
    server.run(end.poll)
    capture = robot.capture()
    end.send((capture.time, capture.position, capture.orientation))


@needs_policies
@pytest.mark.parametrize("name", [FAST, OTHER])
def test_a_real_policy_walks_over_dds(name: str) -> None:
    context = multiprocessing.get_context("spawn")
    end, other = context.Pipe()
    process = context.Process(target=serve, args=(name, DOMAIN, other), daemon=True)
    process.start()
    try:
        assert end.recv() == "ready"
        settings = LinkSettings(exclusive_s=0.3, fresh=PATIENT)
        machine = DdsMachine(GO2, domain=DOMAIN, settings=settings)
        machine.connect()

        def command(time: float) -> Array:
            return np.array([min(1.0, max(0.0, time - 1.0)), 0.0, 0.0])

        run_foreign(RobotTime(machine), policy_of(name), command, seconds=6.0)
        upright = -projected_gravity(machine.latest().orientation)[2]
        end.send("stop")
        time, position, _ = end.recv()
        machine.close()
    finally:
        process.kill()
    assert upright > 0.9
    # It stood for a second, took one to reach 1 m/s, and walked for four.
    assert position[-1, 0] - position[0, 0] > 3.0
    assert position[:, 2].min() > 0.2
    assert time[-1] >= 6.0

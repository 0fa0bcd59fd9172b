"""The link against a real `pronk simulate` process, on loopback, in real time."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deploy_runs import free_port
from pronk.deploy.bench.lcm_server import LcmServerTransport
from pronk.deploy.links.lcm.codec import (
    decode_lcm_command,
    encode_lcm_command,
    encode_mode_request,
)
from pronk.deploy.links.lcm.layouts import CHEETAH
from pronk.deploy.links.lcm.link import LcmMachine, url_of
from pronk.deploy.links.lcm.messages import CONTROL_PARAMETER
from pronk.deploy.links.link import Freshness, LinkSettings, wait_for
from pronk.errors import HardwareError
from pronk.jump.virtual.robot import hold_of
from pronk.robots.machine import Command, State
from repetition import meanwhile
from virtual_robot import ROBOT, connected

pytestmark = pytest.mark.live

lcm = pytest.importorskip("lcm")

LIMIT_S = 300.0
"""A busy computer may take long; nothing here is a measure of speed."""
HOLD = hold_of(ROBOT)
KNEE = ROBOT.joint_names.index("FL_knee")


class Process:
    """A server of its own."""

    def __init__(self, layout: str, json_file: Path) -> None:
        self.layout = layout
        self.json = json_file
        self.port = free_port()
        code = "import sys; from pronk.cli.main import run; sys.exit(run(sys.argv[1:]))"
        words = ["simulate", "--layout", layout, "--port", str(self.port), "--json", str(json_file)]
        command = [sys.executable, "-c", code, *words]
        env = {**os.environ, "OMP_NUM_THREADS": "1"}
        self.running = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env)

    def machine(self, *, release: bool = False) -> LcmMachine:
        # A computer that runs tests side by side is busy; what is tested here is not that.
        fresh = Freshness(share=0.02, longest_gap_s=10.0)
        settings = LinkSettings(release=release, exclusive_s=0.3, fresh=fresh)
        return LcmMachine(ROBOT, layout=self.layout, port=self.port, settings=settings)


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Process]]:
    folder = tmp_path_factory.mktemp("servers")
    processes = {}
    for layout in ("cheetah", "wtw"):
        processes[layout] = Process(layout, folder / f"{layout}.json")
    try:
        for process in processes.values():
            assert process.running.stdout is not None
            assert process.running.stdout.readline().startswith("ready")
        yield processes
    finally:
        for process in processes.values():
            if process.running.poll() is None:
                process.running.kill()
            process.running.wait()


def follow(
    machine: LcmMachine, command: Command | None, arrived: Callable[[np.ndarray], bool]
) -> list[State]:
    """Command at 50 Hz until the joints are there, for LIMIT_S at most; the states met."""
    states: list[State] = []
    for k in range(round(LIMIT_S / 0.02)):
        if command is not None:
            machine.send(replace(command, made=machine.now(), valid_for=10.0, sequence=k))
        states += machine.wait(machine.now() + 0.02)
        if arrived(machine.latest().position):
            break
    return states


@pytest.mark.parametrize("layout", ["cheetah", "wtw"])
def test_joint_moves_and_is_left_damped(servers: dict[str, Process], layout: str) -> None:
    machine = servers[layout].machine()
    machine.connect()
    try:
        assert machine.virtual
        assert machine.torque_kind == ("absent" if layout == "cheetah" else "measured")
        before = machine.latest()
        np.testing.assert_allclose(before.position, HOLD.position, atol=0.1)
        assert (before.robot_time is None) == (layout == "cheetah")
        command = replace(HOLD, position=HOLD.position + 0.3 * (np.arange(12) == KNEE))
        states = follow(machine, command, lambda q: abs(q[KNEE] - command.position[KNEE]) < 0.03)
        times = [state.time for state in states]
        assert times == sorted(times)
        moved = machine.latest().position - before.position
        assert moved[KNEE] == pytest.approx(0.3, abs=0.05)
        assert np.abs(np.delete(moved, KNEE)).max() < 0.1
        machine.clamp(("FR_hip_roll", "FR_knee"))
        machine.clamp(())
    finally:
        machine.close()
    # Damped: the hip rolls, which gravity pulls at, have left their place.
    machine.connect()
    follow(machine, None, lambda q: np.abs(q - HOLD.position).max() > 0.3)
    assert np.abs(machine.latest().position - HOLD.position).max() > 0.3
    machine.close()
    with pytest.raises(HardwareError, match="call connect"):
        machine.latest()
    with pytest.raises(HardwareError, match="FR_knee"):
        machine.clamp(("FR_knee",))


def test_expired_commands_are_followed_by_damping(servers: dict[str, Process]) -> None:
    process = servers["cheetah"]
    machine = process.machine()
    listener = lcm.LCM(url_of(port=process.port))
    received: list[Command] = []
    listener.subscribe(
        CHEETAH.command.channel, lambda _, data: received.append(decode_lcm_command(CHEETAH, data))
    )
    machine.connect()
    machine.send(replace(HOLD, made=machine.now(), valid_for=0.5))
    until = time.monotonic() + LIMIT_S
    while len(received) < 6 and time.monotonic() < until:
        listener.handle_timeout(100)
    assert received[0].stiffness.min() > 1.0
    assert len(received) == 6
    for command in received[1:]:
        np.testing.assert_array_equal(command.stiffness, 0.0)
        np.testing.assert_allclose(command.damping, 1.0, rtol=1e-6)
    # One that is late already is not sent at all.
    machine.send(replace(HOLD, made=machine.now() - 1.0, valid_for=0.5))
    assert machine.counts["expired"] == 2
    machine.close()


def test_commands_of_other_programs_are_refused(servers: dict[str, Process]) -> None:
    process = servers["cheetah"]
    machine = process.machine()
    other = lcm.LCM(url_of(port=process.port))
    data = encode_lcm_command(CHEETAH, HOLD)
    with (
        meanwhile(lambda: other.publish(CHEETAH.command.channel, data), 0.02),
        pytest.raises(HardwareError, match="another program"),
    ):
        machine.connect()
    assert machine.counts["commands"] == 0
    machine.connect()
    machine.send(HOLD)
    foreign = replace(HOLD, position=HOLD.position + 0.01)
    other.publish(CHEETAH.command.channel, encode_lcm_command(CHEETAH, foreign))
    assert wait_for(lambda: machine.counts["foreign"] > 0, LIMIT_S)
    with pytest.raises(HardwareError, match="another program"):
        machine.send(HOLD)
    machine.close()


def test_a_second_robot_on_the_port_is_refused(servers: dict[str, Process]) -> None:
    process = servers["cheetah"]
    wire = LcmServerTransport(ROBOT, port=process.port)
    states = itertools.cycle(connected(legs=("FR",)).wait(1.0))
    machine = process.machine()
    with (
        meanwhile(lambda: wire.publish(next(states)), 0.002),
        pytest.raises(HardwareError, match="2 robots"),
    ):
        machine.connect()
    assert machine.counts["commands"] == 0
    # One that begins later stops the commands with its first state.
    machine.connect()
    machine.send(HOLD)
    wire.publish(next(states))
    assert wait_for(lambda: machine.sources == 2, LIMIT_S)
    with pytest.raises(HardwareError, match="2 robots"):
        machine.send(HOLD)
    machine.close()


def test_own_controller_is_released_and_other_layouts_are_refused(
    servers: dict[str, Process],
) -> None:
    process = servers["cheetah"]
    lcm.LCM(url_of(port=process.port)).publish(CONTROL_PARAMETER.channel, encode_mode_request(4, 1))
    with pytest.raises(HardwareError, match="another program"):
        process.machine().connect()
    machine = process.machine(release=True)
    machine.connect()
    machine.close()
    # Both stacks have a channel leg_control_data: what comes there is refused by its fingerprint.
    with pytest.raises(HardwareError, match="leg_control_data"):
        LcmMachine(ROBOT, layout="wtw", port=process.port).connect()


def test_link_closes_after_its_server_has_died(servers: dict[str, Process]) -> None:
    process = servers["wtw"]
    machine = process.machine()
    machine.connect()
    machine.send(HOLD)
    process.running.kill()
    process.running.wait()
    machine.wait(machine.now() + 0.1)
    assert machine.wait(machine.now() + 0.1) == []
    with pytest.raises(HardwareError, match="did not confirm its clamps"):
        machine.clamp(("FR_knee",))
    machine.damp()
    machine.close()
    with pytest.raises(HardwareError, match="sent no state"):
        machine.connect()


def test_server_ends_on_sigterm(servers: dict[str, Process]) -> None:
    process = servers["cheetah"]
    machine = process.machine()
    machine.connect()
    machine.send(HOLD)
    machine.close()
    process.running.send_signal(signal.SIGTERM)
    out, _ = process.running.communicate(timeout=LIMIT_S)
    assert process.running.returncode == 0
    assert "the virtual robot ran" in out
    figures = json.loads(process.json.read_text(encoding="utf-8"))
    assert figures["virtual"] is True
    # The command, and a second of damping after it.
    assert figures["wire"]["commands"] > 10
    assert figures["wire"]["states"] > 100
    assert figures["server"]["commands applied"] == figures["wire"]["commands"]

"""The DDS link on loopback: two processes, real bytes, on a domain of the tests' own."""

from __future__ import annotations

import itertools
import multiprocessing
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from multiprocessing.connection import Connection
from threading import Event

import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from dds_domain import own_domain
from pronk.deploy.bench.dds_server import DdsServerTransport
from pronk.deploy.bench.server import RobotServer
from pronk.deploy.links.dds.codec import decode_dds_command, encode_dds_command, joint_map
from pronk.deploy.links.dds.link import (
    COMMANDS,
    SWITCHER,
    DdsMachine,
    DdsNetwork,
    Participant,
    RawSample,
    ServiceClient,
    take_samples,
)
from pronk.deploy.links.dds.messages import LowCmd
from pronk.deploy.links.link import Freshness, LinkSettings, wait_for
from pronk.errors import HardwareError, RobotError
from pronk.jump.virtual.robot import hold_of
from pronk.robots.machine import Command
from repetition import meanwhile
from virtual_robot import ROBOT, connected

pytestmark = pytest.mark.live

JOINTS = joint_map(ROBOT)
# A computer that runs tests side by side is busy; what is tested here is not that.
FRESH = Freshness(share=0.02, longest_gap_s=10.0)
HOLD = hold_of(ROBOT)
PITCH = ROBOT.joint_names.index("FR_hip_pitch")


SERVED = DdsNetwork(domain=own_domain())
"""Where the server of the fixture is."""


def live(domain: int, end: Connection) -> None:
    """Body of the server's process, until it receives stop; it sends its figures."""
    robot = connected(legs=("FR",))
    wire = DdsServerTransport(ROBOT, domain=domain, mode="normal")
    server = RobotServer(robot, wire, hold=HOLD)
    end.send("ready")
    server.run(end.poll)
    end.send(server.figures())


@pytest.fixture
def server() -> Iterator[Connection]:
    """A server in another process, whose own controller holds the joints at first."""
    context = multiprocessing.get_context("spawn")
    end, other = context.Pipe()
    process = context.Process(target=live, args=(SERVED.domain, other), daemon=True)
    process.start()
    assert end.recv() == "ready"
    yield end
    process.kill()


def eventually(done: Callable[[], bool]) -> bool:
    return wait_for(done, 120.0)


def turned(angle: float) -> Command:
    """The default pose with the front right thigh turned."""
    return replace(HOLD, position=HOLD.position + angle * (np.arange(12) == PITCH))


def test_a_robot_behind_dds_from_preflight_to_close(server: Connection) -> None:
    network = SERVED
    # Its own controller holds the joints: refused, unless it may be released.
    with pytest.raises(HardwareError, match="normal"):
        DdsMachine(ROBOT, domain=network.domain).connect()
    settings = LinkSettings(release=True, exclusive_s=0.3, fresh=FRESH)
    machine = DdsMachine(ROBOT, domain=network.domain, settings=settings)
    machine.connect()
    assert machine.virtual
    begun = machine.latest()
    np.testing.assert_allclose(begun.position, HOLD.position, atol=0.1)
    assert begun.bus_voltage == pytest.approx(24.5, abs=0.5)
    assert machine.counts["commands"] == machine.counts["repeats"] == 0

    # What has a wrong checksum, or commands the impossible, moves nothing.
    other = Participant(network).writer(COMMANDS, LowCmd)
    assert eventually(lambda: len(other.get_matched_subscriptions()) >= 2)
    far = bytearray(encode_dds_command(JOINTS, turned(0.5)))
    far[-1] ^= 1
    for _ in range(20):
        other.write(RawSample(bytes(far)))
        time.sleep(0.002)
    states = machine.wait(machine.now() + 0.2)
    assert max(abs(state.position[PITCH] - begun.position[PITCH]) for state in states) < 0.01
    # But its sender is another writer: no commands beside it, and none after.
    with pytest.raises(HardwareError, match="rt/lowcmd"):
        machine.send(HOLD)
    machine.close()

    # While it is silent, a joint moves as commanded, for as long as the command is valid.
    machine.connect()
    machine.send(turned(-0.2))
    states = machine.wait(machine.now() + 0.5)
    assert states[-1].position[PITCH] == pytest.approx(HOLD.position[PITCH] - 0.2, abs=0.05)
    assert all(np.diff([state.time for state in states]) > 0.0)
    machine.clamp(("FR_knee",))
    with pytest.raises(RobotError, match="no joint 'XX_knee'"):
        machine.clamp(("XX_knee",))
    machine.clamp(())

    # A second pronk finds the first one writing.
    settings = LinkSettings(exclusive_s=0.3, fresh=FRESH)
    second = DdsMachine(ROBOT, domain=network.domain, settings=settings)
    with pytest.raises(HardwareError, match="another program"):
        second.connect()
    assert second.counts["commands"] == second.counts["repeats"] == 0

    # Expiry: damping on the wire, without a call.
    received = Participant(network).reader(COMMANDS, LowCmd)
    machine.send(replace(HOLD, made=machine.now(), valid_for=0.1))
    assert eventually(lambda: machine.counts["expired"] == 1)
    time.sleep(0.05)
    newest = take_samples(received, Counter())[-1]
    motor = LowCmd.deserialize(newest.data).motor_cmd[PITCH]
    assert (motor.kp, motor.kd, motor.q) == (0.0, 1.0, 2.146e9)

    # And another writer in the middle of it all is followed by damping.
    machine.send(HOLD)
    other.write(RawSample(encode_dds_command(JOINTS, HOLD)))
    assert eventually(lambda: machine.counts["foreign"] > 0)
    with pytest.raises(HardwareError, match="another program"):
        machine.send(HOLD)
    take_samples(received, Counter())
    assert eventually(
        lambda: any(
            decode_dds_command(JOINTS, sample.data).stiffness[PITCH] == 0.0
            for sample in take_samples(received, Counter())
        )
    )

    begun_closing = time.monotonic()
    machine.close()
    machine.close()
    assert time.monotonic() - begun_closing >= 1.0
    with pytest.raises(HardwareError, match="call connect"):
        machine.latest()
    server.send("stop")
    figures = server.recv()
    assert 0 < figures["wire"]["refused: checksum"] <= 20
    assert figures["wire"]["mode switches"] == 1
    assert figures["server"]["commands of others"] > 0


def test_mode_switcher_and_bench_services() -> None:
    network = DdsNetwork(domain=own_domain())
    wire = DdsServerTransport(ROBOT, domain=network.domain, mode="mcf")
    client, bench = (
        ServiceClient(Participant(network), name) for name in (SWITCHER, "pronk_bench")
    )
    with meanwhile(wire.poll, 0.0005):
        assert client.call(1001, {}) == {"form": "0", "name": "mcf"}
        assert client.call(1003, {}) == {}
        assert wire.mode == ""
        assert client.call(1002, {"name": "ai"}) == {}
        for parameter in ({"name": "dance"}, None, [1], "x"):
            with pytest.raises(HardwareError, match="3204"):
                client.call(1002, parameter)
        with pytest.raises(HardwareError, match="3203"):
            client.call(9, {})
        assert wire.mode == "ai"
        clamped = {"joints": ["FR_knee", "FL_knee"]}
        assert bench.call(1, {"joints": ["FL_knee", "FR_knee"]}) == clamped
        with pytest.raises(HardwareError, match="3204"):
            bench.call(1, {"joints": ["tail"]})
        assert wire.clamps == ("FR_knee", "FL_knee")


def test_rival_is_received() -> None:
    wire = DdsServerTransport(ROBOT, domain=own_domain())
    wire.contend(turned(0.1))
    met: list[Command] = []
    assert eventually(lambda: bool(met.extend(wire.poll()) or met))
    np.testing.assert_allclose(met[0].position, turned(0.1).position, atol=1e-6)


def test_a_second_robot_stops_the_commands_and_is_refused() -> None:
    network = DdsNetwork(domain=own_domain())
    wires = [DdsServerTransport(ROBOT, domain=network.domain) for _ in range(2)]
    states = itertools.cycle(connected(legs=("FR",)).wait(8.0))
    both_speak = Event()

    def speak() -> None:
        for wire in wires[: 2 if both_speak.is_set() else 1]:
            wire.poll()
            wire.publish(next(states))

    settings = LinkSettings(exclusive_s=0.0, fresh=FRESH)
    machine = DdsMachine(ROBOT, domain=network.domain, settings=settings)
    with meanwhile(speak, 0.002):
        machine.connect()
        machine.send(HOLD)
        both_speak.set()
        assert eventually(lambda: machine.sources == 2)
        with pytest.raises(HardwareError, match="2 robots"):
            machine.send(HOLD)
        with pytest.raises(HardwareError, match="2 robots"):
            machine.connect()


def test_networks() -> None:
    with pytest.raises(HardwareError, match="rt/lowstate"):
        DdsMachine(ROBOT, domain=own_domain()).connect()
    assert DdsNetwork().domain == 77
    assert DdsNetwork(interface="eth7").domain == 0
    for domain in (0, 233, -1):
        with pytest.raises(HardwareError, match=str(domain)):
            DdsNetwork(domain=domain)
    with pytest.raises(HardwareError, match="no_such_interface"):
        Participant(DdsNetwork(interface="no_such_interface", domain=150))
    with pytest.raises(HardwareError, match="dance"):
        DdsServerTransport(ROBOT, domain=own_domain(), mode="dance")

"""Every link alike, without a wire: addresses, fresh states, other programs, clamps, rest."""

from __future__ import annotations

import math
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import EntryPoint, EntryPoints
from typing import Any

import numpy as np
import pytest

from broken_message import some_state
from pronk.deploy.bench.paced import PacedRobot
from pronk.deploy.links import address as addresses
from pronk.deploy.links import link as links
from pronk.deploy.links.address import Address
from pronk.deploy.links.link import (
    Freshness,
    LinkSettings,
    NetworkLink,
    await_rest,
    wait_for,
)
from pronk.deploy.links.numbering import StateNumbering
from pronk.deploy.links.stream import StreamLink
from pronk.deploy.links.writer import CommandWriter, Encode, Publish
from pronk.errors import HardwareError, PronkError, RobotError
from pronk.robots import load_robot
from pronk.robots.machine import Command, RefusedError, State, TorqueKind, check_command
from pronk.robots.robot import RobotSpec
from pronk.testing import check_link

ROBOT = load_robot("mini_cheetah")
DEFAULT = np.array([joint.default_position for joint in ROBOT.joints])
HOLD = Command(position=DEFAULT, stiffness=np.full(12, 17.0), damping=np.full(12, 0.4))


class Clock:
    """A clock that only sleeping moves on."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def state(when: float = 0.0, speed: float = 0.0) -> State:
    return some_state(time=when, position=DEFAULT, velocity=np.full(12, -speed))


class Windows(NetworkLink):
    """A link that gives states at the given times in each window."""

    torque_kind: TorqueKind = "absent"
    state_rate_hz = 500.0

    def __init__(self, *windows: np.ndarray, settings: LinkSettings | None = None) -> None:
        super().__init__(ROBOT, settings)
        self.windows = list(windows)

    def wait(self, until: float) -> list[State]:
        # Before each window, what had come until then is dropped.
        if not until:
            return [state()]
        return [state(when) for when in self.windows.pop(0).tolist()]

    def _open(self) -> tuple[Encode, Publish]:
        raise NotImplementedError

    def _receive(self) -> None: ...
    def _shut(self) -> None: ...


REGULAR = np.arange(100) * 2e-3


@pytest.mark.parametrize(
    ("windows", "until", "fresh", "expected"),
    [
        ([REGULAR], 0.0, Freshness(), 100),
        ([REGULAR[:80]], 0.0, Freshness(), "80"),
        ([np.append(np.arange(95) * 1.7e-3, 0.1898)], 0.0, Freshness(), "30 ms"),
        ([np.arange(5) * 40e-3], 0.0, Freshness(share=0.05, longest_gap_s=1.0), 5),
        ([np.array([])], 0.0, Freshness(), "sent 0"),
        # A busy computer may miss windows for a while.
        ([REGULAR[:20], REGULAR[:0], REGULAR], math.inf, Freshness(), 100),
        ([REGULAR[:20], REGULAR], 0.0, Freshness(), "20"),
    ],
)
def test_states_must_come_often_and_without_gaps(
    windows: list[np.ndarray], until: float, fresh: Freshness, expected: int | str
) -> None:
    link = Windows(*windows, settings=LinkSettings(fresh=fresh))
    if isinstance(expected, int):
        assert len(link.fresh_states(until=until)) == expected
        return
    with pytest.raises(HardwareError, match=expected):
        link.fresh_states(until=until)


TICKS = {"per_state": 2, "bits": 32}  # a clock in ms


@pytest.mark.parametrize(
    ("options", "counts", "sequence", "counted"),
    [
        ({}, (10, 11, 15), [0, 1, 5], {}),
        ({}, (10, 12, 11, 12, 13), [0, 2, 3], {"out of order": 2}),
        ({}, (10, 10**9, 11), [0, 1, 2], {"clock jumps": 2}),
        (TICKS, (5000, 5002, 5004, 5006), [0, 1, 2, 3], {}),
        # A jitter of the robot's clock of a millisecond loses nothing.
        (TICKS, (5000, 5001, 5004, 5005, 5008), [0, 1, 3, 4, 6], {}),
        (TICKS, (5000, 5002, 5008, 5010), [0, 1, 4, 5], {}),
        (TICKS, (5000, 5002, 5002, 5006, 5004, 5008), [0, 1, 3, 4], {"out of order": 2}),
        (TICKS, (90_000, 90_002, 4, 6, 8000, 8002), [0, 1, 2, 3, 4, 5], {"clock jumps": 2}),
        (TICKS, (2**32 - 4, 2**32 - 2, 0, 2), [0, 1, 2, 3], {}),
    ],
)
def test_states_are_numbered_by_the_robots_count(
    options: dict[str, int], counts: tuple[int, ...], sequence: list[int], counted: dict[str, int]
) -> None:
    numbering = StateNumbering(Counter(), 500.0, **options)
    sequences = []
    for index, count in enumerate(counts):
        gyro = np.full(3, count % 1000)
        numbered = numbering.number(some_state(time=10.0 + 0.002 * index, gyro=gyro), count)
        if numbered is not None:
            sequences.append(numbered.sequence)
    assert sequences == sequence
    assert numbering.counts == counted


def test_values_that_repeat_make_no_states_and_times_increase() -> None:
    numbering = StateNumbering(Counter(), 500.0)
    assert numbering.number(some_state(time=7.0), 10) is not None
    for count in range(11, 60):
        assert numbering.number(some_state(time=7.0), count) is None
    assert numbering.counts == {"repeated": 49}
    later = numbering.number(some_state(time=7.0, gyro=np.zeros(3)), 60)
    assert later is not None
    assert later.time == pytest.approx(7.0 + 50e-6, abs=1e-8)


def test_clamps_need_a_person() -> None:
    requests: list[tuple[str, ...]] = []
    attended = LinkSettings(clamp_operator=requests.append)
    Windows(settings=attended).clamp(("FL_knee",))
    assert requests == [("FL_knee",)]
    Windows().clamp(())
    with pytest.raises(HardwareError, match="FL_knee, FR_knee"):
        Windows().clamp(("FL_knee", "FR_knee"))
    with pytest.raises(RobotError, match="tail"):
        Windows(settings=attended).clamp(("FR_knee", "tail"))
    assert len(requests) == 1


def test_rest_is_awaited(monkeypatch: pytest.MonkeyPatch) -> None:
    cases: list[tuple[Callable[[float], State | None], float]] = [
        (lambda now: None, 1.0),
        (lambda now: state(speed=0.4), 1.0),
        (lambda now: state(speed=5.0 if now < 1.7 else 0.0), 1.7),
        (lambda now: state(speed=0.6), 3.0),
        (lambda now: state(speed=math.nan), 3.0),
    ]
    for newest, takes in cases:
        clock = Clock()
        monkeypatch.setattr(links, "time", clock)
        await_rest(lambda newest=newest, clock=clock: newest(clock.now))
        assert clock.now == pytest.approx(takes, abs=0.01)


# --- The writer ---------------------------------------------------------------------------------


def writing(publish: Publish) -> CommandWriter:
    """A writer whose messages are one byte, 1 for a command with stiffness and 0 for damping."""
    return CommandWriter(
        lambda command: bytes([bool(command.stiffness.any())]),
        publish,
        damping=replace(HOLD, stiffness=np.zeros(12)),
        repeat_s=None,
        counts=Counter(),
    )


def test_the_writer_repeats_damping_and_nothing_else() -> None:
    written: list[bytes] = []
    hold = b"\x01"
    damped = b"\x00"
    writer = writing(written.append)
    writer.send(HOLD)
    time.sleep(0.05)
    assert written == [hold]
    writer.damp()
    assert wait_for(lambda: len(written) >= 5, 60.0)
    assert set(written[1:]) == {damped}
    writer.send(HOLD)
    count = len(written)
    time.sleep(0.05)
    assert len(written) == count
    writer.stop()
    writer.damp()
    assert len(written) == count


def test_damping_survives_a_failing_wire() -> None:
    wire: list[bytes] = []
    cut = threading.Event()

    def publish(data: bytes) -> None:
        if cut.is_set():
            raise OSError(101, "Network is unreachable")
        wire.append(data)

    writer = writing(publish)
    writer.send(replace(HOLD, made=time.monotonic(), valid_for=0.2))
    cut.set()
    # It expires while the wire takes nothing; only the writer can damp.
    assert wait_for(lambda: writer.counts["not written"] >= 5, 60.0)
    assert (len(wire), writer.counts["expired"]) == (1, 1)
    # The sender of a command gets the error; damping never raises.
    with pytest.raises(HardwareError, match="101"):
        writer.send(replace(HOLD, made=time.monotonic(), valid_for=0.2))
    writer.damp()
    cut.clear()
    assert wait_for(lambda: len(wire) >= 5, 60.0)
    assert set(wire[1:]) == {b"\x00"}
    assert writer.counts["commands"] == 1
    writer.stop()


# --- Addresses ----------------------------------------------------------------------------------


def test_addresses_are_read_and_written() -> None:
    cases: list[tuple[str, str | None, dict[str, Any], bool]] = [
        ("sim", None, {}, True),
        ("sim://ground?seed=3", "ground", {"seed": 3}, True),
        ("lcm", None, {}, True),
        ("lcm://lo?layout=wtw&port=7668", "lo", {"layout": "wtw", "port": 7668}, False),
        ("dds://eth0", "eth0", {}, False),
        ("dds://?domain=5", None, {"domain": 5}, True),
    ]
    for text, interface, options, local in cases:
        address = Address.parse(text)
        assert address.interface == interface
        assert address.options == options
        assert address.local == local
        assert Address.parse(str(address)) == address
        assert Address.parse(text.partition(":")[0], interface, **options) == address
    assert isinstance(Address.parse("sim://bench?seed=4").machine(ROBOT), PacedRobot)


@pytest.mark.parametrize(
    ("text", "interface", "words"),
    [
        ("can", None, "sim, lcm, dds"),
        ("dds://?port=3", None, "port"),
        ("lcm://?domain=3", None, "domain"),
        ("lcm://?port=many", None, "many"),
        ("dds://eth0", "eth1", "eth0"),
        ("sim://no_base", None, "no_base"),
        # What is passed over would choose another robot or another layout.
        ("dds://eth0/5", None, "/5"),
        ("dds://eth0#5", None, "5"),
        ("dds:///eth0", None, "/eth0"),
        ("lcm://eth0/layout=wtw", None, "layout=wtw"),
        ("dds://eth0?domain", None, "domain"),
        ("dds://eth0?domain=", None, "domain"),
        ("dds://?domain=3&domain=5", None, "3 and 5"),
        ("lcm://[", None, "lcm:"),
    ],
)
def test_addresses_that_are_refused(text: str, interface: str | None, words: str) -> None:
    with pytest.raises(HardwareError, match=words):
        Address.parse(text, interface).machine(ROBOT)


def test_an_option_that_contradicts_the_address_is_refused() -> None:
    assert Address.parse("dds://?domain=5", domain=5).options == {"domain": 5}
    with pytest.raises(HardwareError, match="5 and 6"):
        Address.parse("dds://?domain=5", domain=6)


@pytest.mark.parametrize(("scheme", "package"), [("dds", "cyclonedds"), ("lcm", "lcm")])
def test_a_library_that_is_missing_is_named(scheme: str, package: str) -> None:
    program = (
        f"import sys; sys.modules[{package!r}] = None\n"
        "from pronk.deploy.links.address import Address\n"
        "from pronk.errors import HardwareError\n"
        "from pronk.robots import load_robot\n"
        "try:\n"
        f"    machine = Address.parse({scheme!r}).machine(load_robot('mini_cheetah'))\n"
        "    machine.connect()\n"
        "except HardwareError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert package in done.stdout
    assert "pronk[hardware]" in done.stdout


# --- A link of another package --------------------------------------------------------------------


class Serial:
    """Position, velocity (12 floats each) and a checksum byte; commands have three times twelve."""

    name = "serial"
    state_rate_hz = 100.0
    torque_kind: TorqueKind = "absent"

    def encode(self, command: Command) -> bytes:
        check_command(command, 12)
        values = np.concatenate([command.position, command.stiffness, command.damping])
        return struct.pack("<36f", *values)

    def decode(self, data: bytes) -> State:
        if len(data) != 97 or sum(data[:-1]) % 251 != data[-1]:
            raise RefusedError("checksum", "a message is damaged.")
        values = np.array(struct.unpack("<24f", data[:-1]))
        return replace(state(), position=values[:12], velocity=values[12:])


def message(speed: float) -> bytes:
    body = struct.pack("<24f", *DEFAULT, *np.full(12, speed))
    return body + bytes([sum(body) % 251])


class Loop:
    """A transport without a robot."""

    local = True

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def receive(self, timeout_s: float) -> list[bytes]:
        return []

    def send(self, data: bytes) -> None:
        self.sent.append(data)

    def foreign_commands(self) -> int:
        return 0

    def close(self) -> None: ...


def serial(
    robot: RobotSpec,
    *,
    interface: str | None = None,
    settings: LinkSettings | None = None,
    speed: int = 9600,
) -> StreamLink:
    link = StreamLink(robot, Serial(), Loop, settings=settings)
    link.counts = Counter(speed=speed)
    return link


def test_a_link_is_found_by_its_entry_point_and_passes_the_check(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    point = EntryPoint("serial", f"{__name__}:serial", addresses.ENTRY_POINT_GROUP)
    monkeypatch.setattr(addresses, "entry_points", lambda group: EntryPoints([point]))
    monkeypatch.setattr(EntryPoint, "load", lambda self: serial)
    machine = Address.parse("serial://ttyUSB0?speed=115200").machine(ROBOT)
    assert isinstance(machine, StreamLink)
    assert machine.counts == {"speed": 115200}
    with pytest.raises(HardwareError, match="sim, lcm, dds, serial"):
        Address.parse("can")
    check_link(ROBOT, Serial(), [message(0.0), message(0.1)], Loop)
    monkeypatch.undo()
    broken = EntryPoint("serial", "no_such_package:serial", addresses.ENTRY_POINT_GROUP)
    monkeypatch.setattr(addresses, "entry_points", lambda group: EntryPoints([broken]))
    with pytest.raises(PronkError, match="no_such_package:serial"):
        Address.parse("serial://ttyUSB0")


@pytest.mark.parametrize(
    ("part", "method", "value"),
    [
        (Serial, "decode", lambda *_: state()),
        (Serial, "encode", lambda *_: b""),
        (Loop, "local", False),
    ],
)
def test_defects_fail_the_check(
    part: type, method: str, value: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(part, method, value)
    with pytest.raises(PronkError, match=method):
        check_link(ROBOT, Serial(), [message(0.0), message(0.1)], Loop)

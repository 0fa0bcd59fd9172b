"""A hundred thousand broken messages: no crash, no motion."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from broken_message import some_state
from pronk.links.lcm.codec import (
    BENCH_CHANNEL,
    CHEETAH,
    REQUEST_CHANNEL,
    WTW,
    Layout,
    StateDecoder,
    decode_command,
    encode_command,
    encode_state,
)
from pronk.links.lcm.messages import MESSAGES
from pronk.links.machine import RefusedError, State
from pronk.robots import load_robot
from pronk.virtual.faults import flip_bit
from pronk.virtual.lcm_server import LcmServerTransport
from pronk.virtual.robot import VirtualRobot
from pronk.virtual.server import RobotServer, hold_of
from pronk.virtual.sim_params import load_sim_params

lcm = pytest.importorskip("lcm")

MESSAGES_PER_LINK = 100_000
STEPS = 400
ROBOT = load_robot("mini_cheetah")
BOTH = pytest.mark.parametrize("layout", [CHEETAH, WTW], ids=["cheetah", "wtw"])


def good_command(layout: Layout) -> bytes:
    """A command that would move every joint by half a radian."""
    hold = hold_of(ROBOT)
    return encode_command(layout, replace(hold, position=hold.position + 0.5))


class Breaker:
    """Breaks a message so that it is no longer a possible command, in another way each time."""

    def __init__(self, layout: Layout, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.good = good_command(layout)
        self.layout = layout
        self.others = [m.encode() for m in MESSAGES if m is not layout.command]
        gains = ("kp_joint", "kd_joint") if layout.name == "cheetah" else ("kp", "kd")
        self.fields = ("q_des", *gains)
        self.ways = (
            self.fingerprint, self.cut, self.padded, self.value, self.noise, self.disguised,
            self.other,
        )  # fmt: skip

    def __call__(self) -> bytes:
        return self.ways[self.rng.integers(len(self.ways))]()

    def fingerprint(self) -> bytes:
        return flip_bit(self.good, int(self.rng.integers(64)))

    def cut(self) -> bytes:
        return self.good[: self.rng.integers(len(self.good))]

    def padded(self) -> bytes:
        return self.good + self.rng.bytes(int(self.rng.integers(1, 600)))

    def value(self) -> bytes:
        fields = np.frombuffer(self.good, self.layout.command.dtype)[0].copy()
        name = self.fields[self.rng.integers(len(self.fields))]
        bad = (math.nan, math.inf, -math.inf, 1e9, -1e9)[self.rng.integers(5)]
        fields[name][self.rng.integers(12)] = bad
        return fields.tobytes()

    def noise(self) -> bytes:
        return self.rng.bytes(int(self.rng.integers(700)))

    def disguised(self) -> bytes:
        """Noise behind the right fingerprint and of the right length."""
        return self.good[:8] + self.rng.bytes(len(self.good) - 8)

    def other(self) -> bytes:
        return self.others[self.rng.integers(len(self.others))]


def virtual_leg() -> VirtualRobot:
    machine = VirtualRobot(ROBOT, load_sim_params(None), seed=1, legs=("FR",))
    machine.connect()
    return machine


def served(layout: Layout) -> tuple[VirtualRobot, LcmServerTransport, RobotServer]:
    machine, wire = virtual_leg(), LcmServerTransport(ROBOT, layout, "memq://")
    return machine, wire, RobotServer(machine, wire, hold=hold_of(ROBOT))


@pytest.fixture(scope="module")
def undisturbed() -> list[State]:
    """What one leg of the virtual robot does without a command."""
    machine = virtual_leg()
    return [machine.latest(), *machine.wait(STEPS * 0.002)]


@BOTH
def test_a_hundred_thousand_broken_messages_move_nothing(
    layout: Layout, undisturbed: list[State]
) -> None:
    machine, wire, server = served(layout)
    states = [machine.latest()]
    broken = Breaker(layout, seed=2)
    # On the channels of requests, too, none of these may do anything.
    channels = (layout.command_channel,) * 8 + (BENCH_CHANNEL, REQUEST_CHANNEL)
    for step in range(STEPS):
        for k in range(MESSAGES_PER_LINK // STEPS):
            data = broken()
            # A whole message of a service is no broken one.
            channel = channels[0] if len(data) in (28, 146) else channels[k % len(channels)]
            wire.receive(channel, data)
        server.step((step + 1) * 0.002)
        states.append(machine.latest())
    assert wire.counts["commands"] == 0
    refused = {name: n for name, n in wire.counts.items() if name.startswith("refused")}
    assert sum(refused.values()) == MESSAGES_PER_LINK
    assert {"refused: fingerprint", "refused: length", "refused: not finite",
            "refused: out of range"} <= set(refused)  # fmt: skip
    assert (wire.mode, wire.clamps) == ("", ())
    # Not one bit of what the robot does is another.
    assert len(states) == len(undisturbed)
    for one, other in zip(states, undisturbed, strict=True):
        np.testing.assert_array_equal(one.position, other.position)
        np.testing.assert_array_equal(one.torque, other.torque)


@BOTH
def test_the_same_server_does_move_when_commanded(layout: Layout, undisturbed: list[State]) -> None:
    machine, wire, server = served(layout)
    wire.receive(layout.command_channel, good_command(layout))
    for step in range(STEPS):
        server.step((step + 1) * 0.002)
    moved = machine.latest().position[:3] - undisturbed[-1].position[:3]
    np.testing.assert_allclose(moved, 0.5, atol=0.15)


@BOTH
def test_one_flipped_bit_never_commands_the_impossible(layout: Layout) -> None:
    # Without a checksum a flipped bit may leave a possible command: then it is one the motors'
    # bus can carry, and nothing else.
    good = good_command(layout)
    left = 0
    for bit in range(8 * len(good)):
        try:
            got = decode_command(layout, flip_bit(good, bit))
        except RefusedError:
            continue
        left += 1
        assert np.abs(got.position).max() <= 12.5
        assert (got.stiffness * layout.gains).min() >= 0.0
        assert (got.stiffness * layout.gains).max() <= 500.0 * (1 + 1e-12)
        assert (got.damping * layout.gains).min() >= 0.0
        assert (got.damping * layout.gains).max() <= 5.0 * (1 + 1e-12)
    assert 0 < left < 8 * len(good) - 64


@BOTH
def test_broken_states_make_no_state(layout: Layout) -> None:
    decoder = StateDecoder(layout, Counter())
    (_, attitude), (_, joints) = encode_state(layout, some_state())
    decoder.attitude(attitude, 0.0)
    rng = np.random.default_rng(3)
    for k in range(20_000):
        take, good = ((decoder.attitude, attitude), (decoder.joints, joints))[k % 2]
        data = (
            flip_bit(good, int(rng.integers(64))),
            good[: rng.integers(len(good))],
            good[:8] + rng.bytes(int(rng.integers(len(good)))),
            rng.bytes(int(rng.integers(300))),
        )[rng.integers(4)]
        with pytest.raises(RefusedError):
            take(data, 0.001)
    assert decoder.joints(joints, 0.002) is not None

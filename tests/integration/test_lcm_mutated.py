"""A hundred thousand broken messages: no crash, no motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from broken_message import mutated
from pronk.links.lcm.codec import (
    CHEETAH,
    CONTROL_PARAMETER,
    MESSAGES,
    VIRTUAL_ROBOT,
    WTW,
    Layout,
    encode_command,
)
from pronk.links.machine import State
from pronk.robots import load_robot
from pronk.virtual.faults import flip_bit
from pronk.virtual.lcm_server import LcmServerTransport
from pronk.virtual.robot import VirtualRobot
from pronk.virtual.server import RobotServer, hold_of
from pronk.virtual.sim_params import load_sim_params

pytest.importorskip("lcm")

MESSAGES_PER_LINK, STEPS = 100_000, 400
ROBOT = load_robot("mini_cheetah")
HOLD = hold_of(ROBOT)
BOTH = pytest.mark.parametrize("layout", [CHEETAH, WTW], ids=["cheetah", "wtw"])


def good_command(layout: Layout) -> bytes:
    """A command that would move every joint by half a radian."""
    return encode_command(layout, replace(HOLD, position=HOLD.position + 0.5))


def broken(layout: Layout, good: bytes, rng: np.random.Generator) -> bytes:
    """A message that is no possible command, in another way each time."""
    kind = rng.integers(5)
    if kind == 0:
        return flip_bit(good, int(rng.integers(64)))
    if kind == 1:
        others = [message for message in MESSAGES if message is not layout.command]
        return others[rng.integers(len(others))].encode()
    if kind == 2:
        fields = np.frombuffer(good, layout.command.dtype)[0].copy()
        name = ("q_des", layout.fields["stiffness"], layout.fields["damping"])[rng.integers(3)]
        bad = (math.nan, math.inf, -math.inf, 1e9, -1e9)[rng.integers(5)]
        fields[name][rng.integers(12)] = bad
        return fields.tobytes()
    if kind == 3:  # noise behind the right fingerprint and of the right length
        return good[:8] + rng.bytes(len(good) - 8)
    data = mutated(good, rng)
    return data if len(data) != len(good) else data[:-1]


def virtual_leg() -> VirtualRobot:
    machine = VirtualRobot(ROBOT, load_sim_params(None), seed=1, legs=("FR",))
    machine.connect()
    return machine


@pytest.fixture(scope="module")
def undisturbed() -> list[State]:
    """What one leg of the virtual robot does without a command."""
    return virtual_leg().wait(STEPS * 0.002)


@BOTH
def test_broken_messages_move_nothing_and_a_whole_one_does(
    layout: Layout, undisturbed: list[State]
) -> None:
    machine, wire = virtual_leg(), LcmServerTransport(ROBOT, layout, "memq://")
    server = RobotServer(machine, wire, hold=HOLD)
    good, rng, states = good_command(layout), np.random.default_rng(2), []
    # On the channels of requests, too, none of these may do anything.
    channels = (layout.command.channel,) * 8 + (VIRTUAL_ROBOT.channel, CONTROL_PARAMETER.channel)
    for step in range(STEPS):
        for k in range(MESSAGES_PER_LINK // STEPS):
            data = broken(layout, good, rng)
            # A whole message of a service is no broken one.
            channel = channels[0] if len(data) in (28, 146) else channels[k % len(channels)]
            wire.receive(channel, data)
        server.step((step + 1) * 0.002)
        states.append(machine.latest())
    assert wire.counts["commands"] == 0
    refused = {name: n for name, n in wire.counts.items() if name.startswith("refused")}
    assert sum(refused.values()) == MESSAGES_PER_LINK
    reasons = ("fingerprint", "length", "not finite", "out of range")
    assert {f"refused: {reason}" for reason in reasons} <= set(refused)
    assert (wire.mode, wire.clamps) == ("", ())
    # Not one bit of what the robot does is another.
    for one, other in zip(states, undisturbed, strict=True):
        np.testing.assert_array_equal(one.position, other.position)
        np.testing.assert_array_equal(one.torque, other.torque)
    wire.receive(layout.command.channel, good)
    for step in range(STEPS, 2 * STEPS):
        server.step((step + 1) * 0.002)
    moved = machine.latest().position[:3] - undisturbed[-1].position[:3]
    np.testing.assert_allclose(moved, 0.5, atol=0.15)

"""The virtual robot behind a wire, step by step on its own clock."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from broken_message import mutated
from command_line import invoke
from pronk.deploy.bench.faults import parse_faults
from pronk.deploy.bench.server import TICK_S, RobotServer, ServerTransport, Watchdog
from pronk.deploy.links.lcm.codec import decode_lcm_command, encode_lcm_command
from pronk.deploy.links.lcm.layouts import CHEETAH, WTW, LcmLayout
from pronk.deploy.links.lcm.messages import CONTROL_PARAMETER, VIRTUAL_ROBOT
from pronk.jump.virtual.capture import load_capture
from pronk.jump.virtual.robot import VirtualRobot, hold_of
from pronk.robots.machine import Command, RefusedError, State
from virtual_robot import ROBOT, connected

HOLD = hold_of(ROBOT)
RAISED = replace(HOLD, position=HOLD.position + np.tile([0.0, 0.0, 0.3], 4))


class Wire(ServerTransport):
    """A wire without a network: `inbox` arrives, what is published is in `sent`."""

    def __init__(self) -> None:
        super().__init__(ROBOT, "", ("",))
        self.inbox: list[Command] = []
        self.sent: list[State] = []

    def poll(self) -> list[Command]:
        arrived = self.inbox
        self.inbox = []
        return arrived

    def publish(self, state: State) -> None:
        self.sent.append(state)

    def contend(self, command: Command) -> None:
        self.inbox.append(command)

    def close(self) -> None: ...


def leg() -> VirtualRobot:
    return connected(legs=("FR",), seed=3)


def served(faults: str = "", watchdog: Watchdog | None = None) -> tuple[RobotServer, Wire]:
    wire = Wire()
    server = RobotServer(
        leg(), wire, hold=HOLD, faults=parse_faults(faults), watchdog=watchdog, seed=1
    )
    return server, wire


def run(server: RobotServer, start: float, end: float) -> None:
    for tick in range(round(start / TICK_S) + 1, round(end / TICK_S) + 1):
        server.step(tick * TICK_S)


def test_states_and_commands_pass_unchanged() -> None:
    server, wire = served()
    run(server, 0.0, 0.2)
    expected = leg().wait(0.2)
    assert len(wire.sent) == len(expected) == 100
    for sent, measured in zip(wire.sent, expected, strict=True):
        np.testing.assert_array_equal(sent.position, measured.position)
        assert sent.sequence == measured.sequence
        assert sent.robot_time == sent.time == measured.time
    wire.inbox.append(RAISED)
    run(server, 0.2, 0.7)
    assert wire.sent[-1].position[2] - expected[-1].position[2] == pytest.approx(0.3, abs=0.1)
    assert server.figures()["server"] == {"commands applied": 1}


@pytest.mark.parametrize("silence", ["hold", "zero", "damp"])
def test_drives_act_on_silence_after_the_first_command(silence: Any) -> None:
    server, wire = served(watchdog=Watchdog(silence=silence, silence_after=0.1))
    run(server, 0.0, 0.5)
    assert "silences" not in server.counts

    def command(start: float) -> None:
        for k in range(20):
            wire.inbox.append(RAISED)
            run(server, start + 0.05 * k, start + 0.05 * (k + 1))

    def sunk() -> float:
        return float(np.abs(wire.sent[-1].position[:3] - RAISED.position[:3]).max())

    command(0.5)
    run(server, 1.5, 2.5)
    if silence == "hold":
        assert "silences" not in server.counts
        assert sunk() < 0.15
        return
    assert server.counts["silences"] == 1
    assert sunk() > 0.3
    # Nothing but noise is left of the torque, save for damping.
    assert np.abs(wire.sent[-1].torque[:3]).max() < (0.3 if silence == "zero" else 3.0)
    command(2.5)
    assert sunk() < 0.15


@pytest.mark.parametrize(("faults", "mode"), [("rival=0.2", ""), ("", "locomotion")])
def test_rivals_command_at_100_hz(faults: str, mode: str) -> None:
    server, wire = served(faults)
    run(server, 0.0, 0.19)
    assert server.counts["commands applied"] == 0
    wire.mode = mode
    run(server, 0.19, 0.4)
    assert 19 <= server.counts["commands applied"] <= 22
    if mode:
        before = server.counts["commands applied"]
        wire.mode = ""
        run(server, 0.4, 0.6)
        assert server.counts["commands applied"] == before


def test_frozen_values_have_a_live_count() -> None:
    server, wire = served("freeze=0.1:0.1")
    run(server, 0.0, 0.3)
    assert [state.sequence for state in wire.sent] == list(range(1, 151))
    assert np.diff([state.time for state in wire.sent]).min() > 0.0
    frozen_values = set()
    changing_values = []
    for state in wire.sent:
        if 0.102 < state.time < 0.198:
            frozen_values.add(state.position.tobytes() + state.gyro.tobytes())
        elif state.time < 0.098 or state.time > 0.202:
            changing_values.append(state.velocity.tobytes())
    assert len(frozen_values) == 1
    assert len(set(changing_values)) == len(changing_values)


def test_the_robots_clock_jumps() -> None:
    server, wire = served("clock=0.1:-5")
    run(server, 0.0, 0.2)
    offsets = []
    for state in wire.sent:
        assert state.robot_time is not None
        offsets.append(state.robot_time - state.time)
    np.testing.assert_allclose(offsets[:48], 0.0)
    np.testing.assert_allclose(offsets[50:], -5.0)


def test_one_number_of_a_state_is_broken_as_often_as_specified() -> None:
    server, wire = served("state.nan=0.2")
    run(server, 0.0, 1.0)
    broken_states = 0
    for state in wire.sent:
        measured = (
            state.position,
            state.velocity,
            state.gyro,
            state.accelerometer,
            state.orientation,
        )
        broken_numbers = np.isnan(np.concatenate(measured)).sum()
        assert broken_numbers in (0, 1)
        broken_states += int(broken_numbers)
    assert 60 < broken_states < 140
    assert server.figures()["state_faults"] == {"nan": broken_states}


def test_lost_commands_and_states_do_not_arrive() -> None:
    server, wire = served("loss=1,after=0.1")
    run(server, 0.0, 0.1)
    wire.inbox.append(RAISED)
    run(server, 0.1, 0.3)
    assert len(wire.sent) == 49  # the tick at 0.1 s itself has lost its state
    assert server.counts["commands applied"] == 0
    assert server.figures()["command_faults"] == {"lost": 1}


def test_one_bit_of_a_command_is_inverted() -> None:
    server, wire = served("command.flip=1")
    run(server, 0.0, 0.01)
    assert wire.corrupt_out(bytes(100)) == bytes(100)
    assert sum(byte.bit_count() for byte in wire.corrupt_in(bytes(100))) == 1
    assert wire.corrupt_in(b"") == b""


def test_clamps_hold_on_the_bench_and_are_refused_on_the_ground() -> None:
    server, wire = served()
    wire.clamps = ("FR_hip_roll", "FR_hip_pitch")
    run(server, 0.0, 0.1)
    wire.inbox.append(replace(HOLD, position=HOLD.position + 0.3))
    run(server, 0.1, 0.6)
    moved = wire.sent[-1].position[:3] - wire.sent[0].position[:3]
    # The clamp is on the link, the encoder on the rotor behind the belt.
    assert np.abs(moved[:2]).max() < 0.02
    assert moved[2] == pytest.approx(0.3, abs=0.1)

    wire = Wire()
    server = RobotServer(connected(base="ground"), wire, hold=HOLD)
    wire.clamps = ("FR_knee",)
    run(server, 0.0, 0.05)
    assert wire.clamps == ()
    assert server.counts["clamps refused"] == 1
    assert len(wire.sent) == 25


def test_real_time_run_ends_when_requested() -> None:
    server, wire = served()
    stops = iter([False] * 400 + [True])
    server.run(partial(next, stops))
    figures: Any = server.figures()
    assert figures["lateness"]["n"] == 400
    assert figures["duration_s"] == pytest.approx(400 * TICK_S)
    assert len(wire.sent) == 100


# --- Broken messages ----------------------------------------------------------------------------


def broken(layout: LcmLayout, good: bytes, rng: np.random.Generator) -> bytes:
    """A message that is no possible command, in another way each time."""
    while True:
        data = mutated(good, rng)
        try:
            decode_lcm_command(layout, data)
        except RefusedError:
            return data


@pytest.mark.parametrize("layout", [CHEETAH, WTW], ids=["cheetah", "wtw"])
def test_broken_lcm_messages_change_no_bit_of_the_motion(layout: LcmLayout) -> None:
    pytest.importorskip("lcm")
    from pronk.deploy.bench.lcm_server import LcmServerTransport

    steps = 200
    count = 50_000
    machine = leg()
    wire = LcmServerTransport(ROBOT, layout=layout.name, url="memq://")
    server = RobotServer(machine, wire, hold=HOLD)
    good = encode_lcm_command(layout, replace(HOLD, position=HOLD.position + 0.5))
    rng = np.random.default_rng(2)
    states = []
    # Nor may any of these have an effect on the channels of requests.
    channels = (layout.command.channel,) * 8 + (VIRTUAL_ROBOT.channel, CONTROL_PARAMETER.channel)
    for step in range(steps):
        for k in range(count // steps):
            wire.receive(channels[k % 10], broken(layout, good, rng))
        server.step((step + 1) * 0.002)
        states.append(machine.latest())
    assert wire.counts["commands"] == 0
    refused = 0
    for name, number in wire.counts.items():
        if name.startswith("refused"):
            refused += number
    assert refused == count
    for reason in ("fingerprint", "length", "not finite", "out of range"):
        assert wire.counts[f"refused: {reason}"] > 0
    assert (wire.mode, wire.clamps) == ("", ())
    undisturbed = leg().wait(steps * 0.002)
    for disturbed_state, undisturbed_state in zip(states, undisturbed, strict=True):
        np.testing.assert_array_equal(disturbed_state.position, undisturbed_state.position)
        np.testing.assert_array_equal(disturbed_state.torque, undisturbed_state.torque)
    wire.receive(layout.command.channel, good)
    run(server, steps * 0.002, steps * 0.002 + 0.8)
    moved = machine.latest().position[:3] - undisturbed[-1].position[:3]
    np.testing.assert_allclose(moved, 0.5, atol=0.15)


# --- The command --------------------------------------------------------------------------------


def test_simulate_ends_after_its_duration_and_writes_its_figures(tmp_path: Path) -> None:
    pytest.importorskip("lcm")
    capture = tmp_path / "capture.npz"
    figures = tmp_path / "figures.json"
    done = invoke(
        ["simulate", "--base", "ground", "--duration", "0.3", "--port", "7913",
         "--mode", "locomotion", "--capture", str(capture), "--json", str(figures)],
    )  # fmt: skip
    assert done.exit_code == 0
    assert "lcm://?layout=cheetah&port=7913" in done.output
    written = json.loads(figures.read_text(encoding="utf-8"))
    assert written["virtual"] is True
    # Its own controller commands over the wire itself.
    assert written["wire"]["commands"] > 0
    assert load_capture(capture).time[-1] == pytest.approx(written["duration_s"], abs=0.01)

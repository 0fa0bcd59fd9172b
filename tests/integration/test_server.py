"""The virtual robot behind a wire, step by step, without a clock on the wall."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import invoke
from pronk.errors import HardwareError
from pronk.links.machine import Command, State
from pronk.robots import load_robot
from pronk.virtual.capture import load
from pronk.virtual.faults import Faults, parse_faults
from pronk.virtual.robot import VirtualRobot
from pronk.virtual.server import TICK_S, Corrupt, RobotServer, Watchdog, hold_of
from pronk.virtual.sim_params import load_sim_params

ROBOT = load_robot("mini_cheetah")
HOLD = hold_of(ROBOT)
RAISED = replace(HOLD, position=HOLD.position + np.tile([0.0, 0.0, 0.3], 4))


class Wire:
    """A wire without a network: `inbox` arrives, what is published is in `sent`."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.mode = ""
        self.clamps: tuple[str, ...] = ()
        self.corrupt_in: Corrupt = bytes
        self.corrupt_out: Corrupt = bytes
        self.inbox: list[Command] = []
        self.sent: list[State] = []

    def poll(self) -> list[Command]:
        arrived, self.inbox = self.inbox, []
        return arrived

    def publish(self, state: State) -> None:
        self.sent.append(state)

    def contend(self, command: Command) -> None:
        self.inbox.append(command)

    def close(self) -> None:
        pass


def made(
    faults: str = "", watchdog: Watchdog | None = None, legs: tuple[str, ...] = ("FR",)
) -> tuple[RobotServer, Wire, VirtualRobot]:
    machine = VirtualRobot(ROBOT, load_sim_params(None), seed=3, legs=legs)
    machine.connect()
    wire = Wire()
    server = RobotServer(
        machine, wire, hold=HOLD, faults=parse_faults(faults), watchdog=watchdog, seed=1
    )  # fmt: skip
    return server, wire, machine


def live(server: RobotServer, start: float, end: float) -> None:
    for k in range(round(start / TICK_S) + 1, round(end / TICK_S) + 1):
        server.step(k * TICK_S)


def test_states_are_those_of_the_machine_at_its_rate() -> None:
    server, wire, _ = made()
    live(server, 0.0, 0.2)
    alone = VirtualRobot(ROBOT, load_sim_params(None), seed=3, legs=("FR",))
    alone.connect()
    expected = alone.wait(0.2)
    assert len(wire.sent) == len(expected) == 100
    for sent, known in zip(wire.sent, expected, strict=True):
        np.testing.assert_array_equal(sent.position, known.position)
        assert sent.sequence == known.sequence
        assert sent.robot_time == sent.time == known.time


def test_a_command_moves_the_machine() -> None:
    server, wire, _ = made()
    live(server, 0.0, 0.1)
    before = wire.sent[-1].position[2]
    wire.inbox.append(RAISED)
    live(server, 0.1, 0.6)
    assert wire.sent[-1].position[2] - before == pytest.approx(0.3, abs=0.1)
    assert server.figures()["server"] == {"commands applied": 1}


@pytest.mark.parametrize("action", ["hold", "zero", "damp"])
def test_what_the_drives_do_when_commands_stop(action: str) -> None:
    server, wire, _ = made(watchdog=Watchdog(action=action, after_s=0.1))  # type: ignore[arg-type]
    live(server, 0.0, 0.5)
    # Before the first command: the drives hold what they held.
    assert "silences" not in server.counts
    for k in range(20):
        wire.inbox.append(RAISED)
        live(server, 0.5 + 0.02 * k, 0.52 + 0.02 * k)
    live(server, 0.9, 1.9)
    sunk = np.abs(wire.sent[-1].position[:3] - RAISED.position[:3]).max()
    torque = np.abs(wire.sent[-1].torque[:3]).max()
    if action == "hold":
        assert "silences" not in server.counts
        assert sunk < 0.15
    else:
        assert server.counts["silences"] == 1
        assert sunk > 0.3
        # Nothing but noise is left of the torque, save for damping.
        assert torque < (0.3 if action == "zero" else 3.0)
        for k in range(20):
            wire.inbox.append(RAISED)
            live(server, 1.9 + 0.05 * k, 1.95 + 0.05 * k)
        assert np.abs(wire.sent[-1].position[:3] - RAISED.position[:3]).max() < 0.15


def test_a_rival_commands_from_its_time_on_and_the_robots_own_controller_until_released() -> None:
    server, wire, _ = made("rival=0.2")
    live(server, 0.0, 0.19)
    assert server.counts["commands applied"] == 0
    live(server, 0.19, 0.4)
    assert 19 <= server.counts["commands applied"] <= 21
    server, wire, _ = made()
    wire.mode = "locomotion"
    live(server, 0.0, 0.2)
    assert 19 <= server.counts["commands applied"] <= 21
    wire.mode = ""
    live(server, 0.2, 0.4)
    assert 19 <= server.counts["commands applied"] <= 21


def test_frozen_values_with_a_live_count() -> None:
    server, wire, _ = made("freeze=0.1:0.1")
    live(server, 0.0, 0.3)
    assert [state.sequence for state in wire.sent] == list(range(1, 151))
    times = np.diff([state.time for state in wire.sent])
    assert times.min() > 0.0
    frozen = [s for s in wire.sent if 0.102 < s.time < 0.198]
    assert len({s.position.tobytes() + s.gyro.tobytes() for s in frozen}) == 1
    live_ones = [s for s in wire.sent if s.time < 0.098 or s.time > 0.202]
    assert len({s.velocity.tobytes() for s in live_ones}) == len(live_ones)


def test_the_robots_clock_jumps() -> None:
    server, wire, _ = made("clock=0.1:-5")
    live(server, 0.0, 0.2)
    offsets = np.array([s.robot_time - s.time for s in wire.sent])  # type: ignore[operator]
    np.testing.assert_allclose(offsets[:48], 0.0)
    np.testing.assert_allclose(offsets[50:], -5.0)


def test_some_states_hold_no_number() -> None:
    server, wire, _ = made("state.nan=0.2")
    live(server, 0.0, 1.0)
    names = ("position", "velocity", "gyro", "accelerometer", "orientation")
    broken = [sum(int(np.isnan(getattr(s, n)).sum()) for n in names) for s in wire.sent]
    assert set(broken) == {0, 1}
    assert 60 < sum(broken) < 140
    assert server.figures()["state_faults"] == {"nan": sum(broken)}


def test_lost_commands_are_not_applied_and_lost_states_not_published() -> None:
    server, wire, _ = made("loss=1,after=0.1")
    live(server, 0.0, 0.1)
    wire.inbox.append(RAISED)
    live(server, 0.1, 0.3)
    # The tick at 0.1 s itself has lost its state.
    assert len(wire.sent) == 49
    assert server.counts["commands applied"] == 0
    assert server.figures()["command_faults"] == {"lost": 1}


def test_bits_are_flipped_where_the_wire_lets_them() -> None:
    server, wire, _ = made("command.flip=1")
    live(server, 0.0, 0.01)
    assert wire.corrupt_out is bytes
    data = bytes(100)
    changed = wire.corrupt_in(data)
    assert sum(byte.bit_count() for byte in changed) == 1
    assert wire.corrupt_in(b"") == b""


def test_clamps_of_the_bench() -> None:
    server, wire, _ = made(legs=("FR",))
    wire.clamps = ("FR_hip_roll", "FR_hip_pitch")
    live(server, 0.0, 0.1)
    wire.inbox.append(replace(HOLD, position=HOLD.position + 0.3))
    live(server, 0.1, 0.6)
    moved = wire.sent[-1].position[:3] - wire.sent[0].position[:3]
    # The clamp is on the link, the encoder on the rotor behind the belt.
    assert np.abs(moved[:2]).max() < 0.02
    assert moved[2] == pytest.approx(0.3, abs=0.1)


def test_on_the_ground_nothing_is_clamped_and_nothing_falls_over_it() -> None:
    machine = VirtualRobot(ROBOT, load_sim_params(None), base="ground")
    machine.connect()
    wire = Wire()
    server = RobotServer(machine, wire, hold=HOLD)
    wire.clamps = ("FR_knee",)
    live(server, 0.0, 0.05)
    assert wire.clamps == ()
    assert server.counts["clamps refused"] == 1
    assert len(wire.sent) == 25


def test_real_time_goes_on_and_ends() -> None:
    server, wire, machine = made()
    calls: list[int] = []

    def stop() -> bool:
        calls.append(1)
        return len(calls) > 400

    server.run(stop)
    figures = server.figures()
    assert figures["ticks"] == 400
    assert machine.now() == pytest.approx(400 * TICK_S)
    assert len(wire.sent) == 100
    assert Faults() == parse_faults("")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--faults", "los=1"], "los=1"),
        (["--capture", "there.npz"], "--base ground"),
        (["--silence-after", "0"], "0"),
        (["--domain", "3"], "--domain"),
        (["--link", "dds", "--port", "9000"], "--port"),
        (["--port", "7667"], "7667"),
    ],
)
def test_a_server_that_cannot_be_is_one_sentence(words: list[str], named: str) -> None:
    done = invoke(["simulate", *words])
    assert done.exit_code == 2
    assert named in done.stderr


@pytest.mark.parametrize("options", [{"action": "sleep"}, {"after_s": 0.0}])
def test_impossible_watchdogs_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(HardwareError, match="silence"):
        Watchdog(**options)


def test_a_server_ends_by_itself_and_writes_its_figures(tmp_path: Path) -> None:
    pytest.importorskip("lcm")
    seen, figures = tmp_path / "seen.npz", tmp_path / "figures.json"
    done = invoke(
        ["simulate", "--base", "ground", "--duration", "0.3", "--port", "7913",
         "--mode", "locomotion",
         "--capture", str(seen), "--json", str(figures)],
    )  # fmt: skip
    assert done.exit_code == 0
    assert "ready: the virtual mini_cheetah on the ground, seed 0, on LCM" in done.output
    written = json.loads(figures.read_text(encoding="utf-8"))
    assert written["virtual"] is True
    # Its own controller commands over the wire itself.
    assert written["wire"]["commands"] > 0
    assert load(seen).time[-1] == pytest.approx(written["duration_s"], abs=0.01)

"""A recording in which all joints of a quadruped move at once, matched leg by leg."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log
from pronk.identify.match.match import match
from pronk.identify.match.predict import predict, rmse
from pronk.jump.virtual.robot import VirtualRobot, hold_of
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.robots import load_robot

torch = pytest.importorskip("torch")

ROBOT = load_robot("mini_cheetah")
RATE_HZ = 200.0
LENGTH_S = 25.0
AMPLITUDE = 0.2


def record(path: Path) -> None:
    """Chirps up to 6 to 10 Hz on all joints of the virtual robot, base fixed, as PACE saves."""
    random = np.random.default_rng(0)
    last_hz = random.uniform(6.0, 10.0, 12)
    phase = random.uniform(0.0, 2.0 * np.pi, 12)
    machine = VirtualRobot(
        ROBOT, load_sim_params(None, ROBOT), seed=3, base="bench", log_rate_hz=RATE_HZ
    )
    machine.connect()
    hold = hold_of(ROBOT)
    begin = machine.now()
    times = []
    commands = []
    positions = []
    for k in range(round(LENGTH_S * RATE_HZ)):
        t = k / RATE_HZ
        state = machine.latest()
        turns = 0.2 * t + (last_hz - 0.2) * t**2 / (2.0 * LENGTH_S)
        target = hold.position + min(t, 1.0) * AMPLITUDE * np.sin(2.0 * np.pi * turns + phase)
        machine.send(replace(hold, position=target))
        times.append(begin + t)
        commands.append(target)
        positions.append(state.position)
        machine.wait(begin + (k + 1) / RATE_HZ)
    machine.close()
    recording = {
        "time": torch.tensor(np.array(times)),
        "des_dof_pos": torch.tensor(np.array(commands)),
        "dof_pos": torch.tensor(np.array(positions)),
    }
    torch.save(recording, path)


@pytest.mark.slow
def test_all_legs_at_once_are_matched_leg_by_leg(tmp_path: Path) -> None:
    record(tmp_path / "all.pt")
    log = read_log(tmp_path / "all.pt", robot=ROBOT, options=ReadOptions(joint_order="default"))
    middle = len(log.time) // 2
    halves = []
    for rows in (slice(None, middle), slice(middle, None)):
        half = replace(
            log, time=log.time[rows], command=log.command[rows], position=log.position[rows]
        )
        halves.append(half)
    gains = match(halves[:1], ROBOT, drive_gains="default").gains
    assert list(gains.joints) == list(ROBOT.joint_names)
    prediction = predict(halves[1], ROBOT, gains, drive_gains="default")
    later = slice(round(RATE_HZ), None)  # the second half begins in motion, the simulation at rest
    for joint in prediction.joints:
        measured = joint.measured[later]
        nominal = rmse(joint.nominal[later], measured)
        delayed = rmse(joint.nominal_delayed[later], measured)
        assert rmse(joint.matched[later], measured) < 0.8 * min(nominal, delayed)

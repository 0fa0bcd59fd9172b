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
RATE_HZ, LENGTH_S, AMPLITUDE = 200.0, 25.0, 0.2


def record(path: Path) -> None:
    """Chirps up to 6 to 10 Hz on all joints of the virtual robot, base fixed, as PACE saves."""
    random = np.random.default_rng(0)
    last_hz, phase = random.uniform(6.0, 10.0, 12), random.uniform(0.0, 2.0 * np.pi, 12)
    machine = VirtualRobot(
        ROBOT, load_sim_params(None, ROBOT), seed=3, base="bench", log_rate_hz=RATE_HZ
    )
    machine.connect()
    hold, begin, rows = hold_of(ROBOT), machine.now(), []
    for k in range(round(LENGTH_S * RATE_HZ)):
        t, state = k / RATE_HZ, machine.latest()
        turns = 0.2 * t + (last_hz - 0.2) * t**2 / (2.0 * LENGTH_S)
        target = hold.position + min(t, 1.0) * AMPLITUDE * np.sin(2.0 * np.pi * turns + phase)
        machine.send(replace(hold, position=target))
        rows.append((begin + t, target, state.position))
        machine.wait(begin + (k + 1) / RATE_HZ)
    machine.close()
    time, command, position = (torch.tensor(np.array(column)) for column in zip(*rows, strict=True))
    torch.save({"time": time, "des_dof_pos": command, "dof_pos": position}, path)


@pytest.mark.slow
def test_all_legs_at_once_are_matched_leg_by_leg(tmp_path: Path) -> None:
    record(tmp_path / "all.pt")
    log = read_log(tmp_path / "all.pt", robot=ROBOT, options=ReadOptions(joint_order="default"))
    halves = []
    for rows in (slice(None, len(log.time) // 2), slice(len(log.time) // 2, None)):
        columns = {name: getattr(log, name)[rows] for name in ("time", "command", "position")}
        halves.append(replace(log, **columns))
    gains = match(halves[:1], ROBOT, drive_gains="default").gains
    assert list(gains.joints) == list(ROBOT.joint_names)
    found = predict(halves[1], ROBOT, gains, drive_gains="default")
    later = slice(round(RATE_HZ), None)  # the second half begins in motion, the simulation at rest
    for one in found.joints:
        errors = [
            rmse(simulated[later], one.measured[later])
            for simulated in (one.nominal, one.nominal_delayed, one.matched)
        ]
        assert errors[2] < 0.8 * min(errors[:2])

"""Sweeps in real time: of robots over a link, against a `pronk simulate` process.

All limits on time are wide, so that a busy computer is not taken for a fault.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import invoke
from deploy_runs import DAMPED_S, FRESH, free_port, simulated
from pronk.cli.console import RigOperator
from pronk.cli.sweep import record_wire
from pronk.deploy.links.address import Address
from pronk.deploy.runtime.limits import AgeLimits
from pronk.deploy.runtime.plan import Link
from pronk.errors import HardwareError, LogError
from pronk.identify.excitation.plan import SweepPlan, make_plan
from pronk.identify.excitation.signals import Chirp
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.mcap_reader import read_mcap
from pronk.identify.logs.options import ReadOptions
from pronk.robots import load_robot
from wire import ROBOT, over_lcm

pytest.importorskip("lcm")

PATIENT = AgeLimits(hold_s=10.0, damp_s=10.0, latch_s=10.0, expiry_s=10.0, lag=10000.0)


@cache
def plan_of(joint: str, name: str = ROBOT.name, amplitude: float = 0.2) -> SweepPlan:
    # The hip's is always ended early, the others' are short.
    signal = Chirp(length_s=8.0 if joint == "FR_hip_roll" else 1.0, start_hz=0.5, stop_hz=5.0)
    return make_plan(
        load_robot(name), [joint], signal, amplitudes=(amplitude,), repeats=1, settle_s=0.1
    )


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """Address of a virtual robot of its own."""
    number = free_port()
    with simulated("--port", str(number)):
        yield number


def swept(plan: SweepPlan, out: Path, port: int, **more: Any) -> dict[str, Any]:
    link = Link(robot=plan.robot.name, address=Address.parse("lcm", port=port), fresh=FRESH)
    more = {"ages": PATIENT, "standby_s": 2.0, **more}
    return record_wire(plan, out, link, real_time=True, **more)


def await_(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.05)


def written(path: Path) -> JointLog | None:
    """What can be read of a log that is being written; None before its first half second."""
    try:
        return read_mcap(path, None, ReadOptions())
    except LogError:
        return None


def has_segment(path: Path) -> bool:
    """Whether a log that is being written has the begin of an excitation."""
    log = written(path)
    return log is not None and bool(log.segments)


def test_a_robot_with_another_number_of_joints_is_swept(tmp_path: Path) -> None:
    plan = plan_of("gripper", "so101", 0.05)
    link = Link(robot="so101", address=Address.parse("sim://bench"))
    recorded = record_wire(plan, tmp_path, link, ages=PATIENT, real_time=False)
    log = read_mcap(recorded["logs"][0], None, ReadOptions())
    assert recorded["virtual"]
    assert log.origin.complete
    assert log.joints == plan.robot.joint_names
    assert np.ptp(log.cut(log.segments[0]).position[:, log.column("gripper")]) > 0.02


def test_a_knee_is_swept_over_lcm(port: int, tmp_path: Path) -> None:
    with over_lcm(port) as wire:
        recorded = swept(plan_of("FR_knee"), tmp_path, port)
    assert recorded["virtual"]
    assert recorded["servo"]["n"] > 100
    assert [path.name for path in recorded["logs"]] == ["FR_knee.mcap"]
    log = read_mcap(recorded["logs"][0], None, ReadOptions())
    assert log.origin.complete
    assert log.virtual
    assert log.origin.metadata["link"] == f"lcm://?port={port}"
    # The spi messages carry no torque.
    assert log.origin.metadata["torque"] == "absent"
    assert log.torque is None
    part = log.cut(log.segments[0])
    knee = log.column("FR_knee")
    travel = np.ptp(part.position, axis=0)
    assert 0.15 < travel[knee] < 1.0
    # The virtual robot's own bench held the others.
    assert np.delete(travel, knee).max() < 0.05
    assert log.segments[0].clamped == ("FR_hip_roll", "FR_hip_pitch")
    assert np.unique(part.command[:, knee]).size > 20
    assert wire.received()[1][-1], "damped at the end"


@pytest.mark.parametrize("reason", ["rad/s", "was killed", "interrupted"])
def test_whatever_ends_a_sweep_damps_and_keeps_the_log(
    port: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], reason: str
) -> None:
    plan = plan_of("FR_hip_roll")
    begun: list[float] = []
    if reason == "rad/s":
        slow = (replace(j, drive=replace(j.drive, no_load_speed=3.0)) for j in ROBOT.joints)
        plan = replace(plan, robot=replace(ROBOT, joints=tuple(slow)))

    def progress(share: float) -> None:
        if share < 0.05 or begun:
            return
        # The joint is excited.
        begun.append(time.monotonic())
        if reason == "was killed":
            (servo,) = (child for child in active_children() if child.name == "pronk servo")
            servo.kill()
        elif reason == "interrupted":
            os.kill(os.getpid(), signal.SIGINT)

    ended = (HardwareError, KeyboardInterrupt)
    with over_lcm(port) as wire, pytest.raises(ended) as caught:
        swept(plan, tmp_path, port, progress=progress, operator_timeout_s=10.0)
    assert reason in str(caught.value) or caught.type is KeyboardInterrupt
    assert not active_children()
    # A killed servo's joints are damped by the standby.
    when, damps = wire.received()
    assert damps[-1]
    log = read_mcap(tmp_path / "FR_hip_roll.mcap", None, ReadOptions())
    assert not log.origin.complete
    assert reason in log.notes[0]
    assert "FR_hip_roll.mcap" in capsys.readouterr().err
    if reason == "was killed":  # the log holds the last of what it did
        assert when[~damps][-1] - log.time[-1] < 0.1
    if reason == "interrupted":  # it logs up to the tick in which it damps, by its own clock
        assert abs(log.time[-1] - begun[0]) < DAMPED_S


def test_without_a_robot_there_is_no_log(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match="spi_data"):
        swept(plan_of("FR_hip_roll"), tmp_path / "x", 7799)
    assert not (tmp_path / "x").exists()


def test_a_wire_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    address = Address.parse("lcm://no_such_interface")
    with pytest.raises(HardwareError, match=r"not opened.*expected no_such_interface"):
        record_wire(
            plan_of("FR_hip_roll"), tmp_path / "x", Link(robot="mini_cheetah", address=address)
        )
    assert not (tmp_path / "x").exists()


def owner(out: Path, port: int) -> None:
    """A `pronk sweep` of its own."""
    swept(plan_of("FR_hip_roll"), out, port)


def test_a_killed_program_leaves_the_joints_damped_and_a_log(port: int, tmp_path: Path) -> None:
    path = tmp_path / "FR_hip_roll.mcap"
    running = get_context("spawn").Process(target=owner, args=(tmp_path, port))
    with over_lcm(port) as wire:
        running.start()
        await_(lambda: has_segment(path))
        killed = time.monotonic()
        running.kill()
        running.join()
        # The system frees its memory before the end is noticed: 15 ms if it is not busy.
        gone = time.monotonic()
        # The servo has no parent now; when it is silent it has ended.
        await_(lambda: time.monotonic() - wire.received()[0][-1] > 0.2)
    when, damps = wire.received()
    first = when[damps & (when > killed)][0]
    assert when[~damps][-1] < first < gone + DAMPED_S
    assert when[-1] - first >= 0.95  # as far as this thread can tell
    log = read_mcap(path, None, ReadOptions())
    assert not log.origin.complete
    # The logger outlives the program that started it.
    assert killed - log.time[-1] < 0.7
    (segment,) = log.segments
    assert np.ptp(log.cut(segment).command[:, 0]) > 0.0


def test_a_person_clamps_joints_when_requested(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    reading, writing = os.pipe()
    person = RigOperator()
    with os.fdopen(reading) as stdin, os.fdopen(writing, "w") as keys:
        monkeypatch.setattr(sys, "stdin", stdin)
        for joints, printed in (
            ((), ""),
            (("FR_hip_roll", "FR_hip_pitch"), "fix FR_hip_roll, FR_hip_pitch"),
            (("FR_hip_pitch", "FR_hip_roll"), ""),
            ((), "free FR_hip_roll, FR_hip_pitch"),
        ):
            if printed:
                keys.write("\n")
                keys.flush()
            person(joints)
            out = capsys.readouterr().out
            assert printed in out
            assert bool(printed) is bool(out)
        keys.close()
        with pytest.raises(HardwareError, match="clamp"):
            person(("FR_knee",))


def test_real_hardware_must_be_confirmed_by_its_name(tmp_path: Path) -> None:
    words = ["sweep", "mini_cheetah", "--link", "lcm", "--interface", "lo", "--joints", "FR_knee"]
    done = invoke([*words, "--out", tmp_path / "x"], typed="yes\n")
    assert done.exit_code == 2
    assert "A real mini_cheetah at lcm://lo is about to move" in done.stdout
    assert "nothing was moved" in done.stderr
    assert not (tmp_path / "x").exists()

"""The page of a deployment's log: numbers known beforehand, and pages of runs that went wrong."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import accepted
from deploy_records import set_fields
from pronk.deploy.runtime.deploy_log import read_deploy_log
from pronk.deploy.runtime.log import DeployLogWriter
from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.reasons import FilterAction, Reason
from pronk.deploy.runtime.records import EVENT, REAL, STEP, TICK, VIRTUAL, event_record, put_state
from pronk.errors import LogError
from pronk.report import build, deploy_page, deploy_run
from pronk.report.deploy_page import deploy_part
from pronk.report.deploy_run import drive_delay, measured_delay, quantiles
from virtual_robot import KP, POSE, ROBOT, rolled, still

HEADER = {
    "robot": "mini_cheetah",
    "joints": list(ROBOT.joint_names),
    "link": "sim",
    "policy": {"file": "policy.onnx", "sha256": "ab" * 32, "delay_range_s": [0.0, 0.01]},
    "limits": {"operating": {"tilt": 0.8}, "ages": {"damp_s": 0.05}},
    "versions": {"pronk": "0"},
}
TICK_S = 0.002


def record(number: int, target: np.ndarray, **changes: Any) -> np.void:
    """A tick in which all goes well; the joints do not move."""
    tick = np.zeros((), dtype=TICK)
    begun = number * TICK_S
    put_state(tick, still(time=begun, sequence=number))
    tick["temperature"] = np.nan
    tick["tick"] = number
    tick["deadline"] = begun
    tick["begun"] = begun + 1e-4
    tick["done"] = begun + 4e-4
    tick["mode"] = Mode.POLICY
    tick["latency"] = np.nan
    tick["desired"] = target
    tick["sent"] = target
    set_fields(tick, **changes)
    return np.frombuffer(tick.tobytes(), dtype=TICK)[0]


def say(
    writer: DeployLogWriter,
    at: float,
    event_kind: str,
    text: str,
    *,
    reason: int = 0,
    level: int = 0,
) -> None:
    """Write an event."""
    event = event_record(at, event_kind, text, reason=reason, level=level)
    writer.write(np.frombuffer(event.tobytes(), dtype=EVENT)[0])


def flown(path: Path, count: int = 400, lag: int = 2, **changes: Any) -> Path:
    """A run with a step every 20 ms; torques obey the law of drives, `lag` ticks late."""
    steps = np.random.default_rng(1).uniform(-0.2, 0.2, (count // 10 + 1, 12))
    desired = POSE + np.repeat(steps, 10, axis=0)[:count]
    writer = DeployLogWriter(path, HEADER)
    say(writer, 0.0, "robot", VIRTUAL)
    for k in range(count):
        fields: dict[str, Any] = {"torque": KP * (desired[max(k - lag, 0)] - POSE)}
        if k % 10 == 0:
            fields["latency"] = 0.003
        fields.update(changes)
        writer.write(record(k, desired[k], **fields))
        if k % 10 == 0:
            step = np.zeros((), dtype=STEP)
            step["sequence"] = k // 10
            step["begun"] = k * TICK_S
            step["deadline"] = k * TICK_S
            step["inferred"] = 1e-4
            step["live"] = 1
            step["jump"] = 100 <= k < 200
            writer.write(np.frombuffer(step.tobytes(), dtype=STEP)[0])
    writer.end(complete=True, figures={})
    return path


def faulted(path: Path, *, end: bool = True) -> Path:
    """0.2 s standing, 0.2 s policy with moved targets, then a fault of the tilt."""
    writer = DeployLogWriter(path, HEADER)
    say(writer, 0.0, "robot", REAL)
    for k in range(100):
        writer.write(record(k, POSE + 0.01, mode=Mode.STAND))
    moved = POSE + np.eye(12)[5] * 0.25
    for k in range(100, 200):
        limited = record(k, moved, level=FilterAction.LIMIT, reason=Reason.POSITION, sent=POSE)
        writer.write(limited)
    say(writer, 0.4, "fault", "tilted", reason=Reason.TILT, level=FilterAction.LATCH)
    for k in range(200, 300):
        damped = record(
            k,
            POSE,
            mode=Mode.FAULT,
            level=FilterAction.LATCH,
            reason=Reason.TILT,
            orientation=rolled(1.0),
            desired=np.nan,
            sent=np.nan,
            damped=1,
        )
        writer.write(damped)
    if end:
        writer.end(complete=True, figures={})
    else:
        writer.flush()
    return path


def test_quantiles_are_those_of_the_sorted_values() -> None:
    thousand = quantiles(np.r_[np.arange(1000, 0, -1), np.nan])
    assert list(thousand.values()) == [1000, 500.0, 950.0, 990.0, 999.0, 1000.0]
    few = quantiles(np.arange(50.0))
    assert math.isnan(few["p99"])
    assert few["p95"] == 47.0
    assert quantiles(np.array([]))["n"] == 0


@pytest.mark.parametrize("lag", [1, 2, 4])
def test_the_drives_delay_is_found(tmp_path: Path, lag: int) -> None:
    path = flown(tmp_path / "run.mcap", lag=lag)
    log = read_deploy_log(path)
    page_part = deploy_part(path)
    # A state at tick k sees the target sent at tick k - lag, on the wire 0.4 ms after the tick:
    # right for every shift between (lag - 1) ticks and lag ticks, less 0.4 ms.
    latest = lag * TICK_S - 4e-4
    drives = drive_delay(log, ROBOT)
    np.testing.assert_allclose(drives, (max(latest - TICK_S, 0.0), latest), atol=2.6e-4)
    assert measured_delay(log, ROBOT).longest == pytest.approx(0.003 + drives[1])
    # A delay beyond that of training is a warning.
    assert page_part.figures["delay"]["within"] is (lag < 4)
    assert page_part.warning is (lag >= 4)


def test_torques_that_are_not_measured_leave_the_drives_out(tmp_path: Path) -> None:
    path = flown(tmp_path / "run.mcap", torque=np.full(12, np.nan))
    delay = measured_delay(read_deploy_log(path), ROBOT)
    assert np.isnan(delay.drives).all()
    assert delay.longest == pytest.approx(0.003)
    assert delay.within


def test_measures_of_a_fault(tmp_path: Path) -> None:
    log = read_deploy_log(faulted(tmp_path / "run.mcap"))
    stretches = deploy_run.stretches(log)
    assert [stretch.mode for stretch in stretches] == [Mode.STAND, Mode.POLICY, Mode.FAULT]
    np.testing.assert_allclose([stretch.seconds for stretch in stretches], 0.2, atol=1e-9)
    moved, latched = deploy_run.interventions(log)
    assert (moved.reason, moved.level, moved.ticks) == (Reason.POSITION, FilterAction.LIMIT, 100)
    assert (moved.largest, moved.joint) == (pytest.approx(0.25), ROBOT.joint_names[5])
    assert moved.first == pytest.approx(0.2)
    assert (latched.reason, latched.ticks, latched.joint) == (Reason.TILT, 100, "")
    np.testing.assert_allclose(deploy_run.tilt_angles(log)[[0, 250]], [0.0, 1.0], atol=1e-12)
    standing = deploy_run.tracking_error(log, log.ticks.mode == Mode.STAND)
    assert standing[0] == pytest.approx(0.01)
    margins = {margin.quantity: margin for margin in deploy_run.margins(log)}
    assert math.isnan(margins["joint torque"].largest)  # all zeros: this robot reports none
    tilt = margins["tilt of the trunk"]
    assert (tilt.largest, tilt.limit) == (pytest.approx(1.0), 0.8)
    parts = {timed.name: timed.seconds for timed in deploy_run.timed_parts(log)}
    assert len(parts["age of the state"]) == 201  # until the fault
    assert "0.40 s, after 0.2 s of the policy: tilted" in deploy_page.deploy_verdict(log)
    content = deploy_part(tmp_path / "run.mcap").content
    assert (content["moved"], content["given"], list(content["damped"])) == (100, 200, [True] * 100)


def test_the_hottest_motor_is_named(tmp_path: Path) -> None:
    path = flown(tmp_path / "hot.mcap", 5, temperature=np.arange(12.0) + 30.0)
    log = read_deploy_log(path)
    np.testing.assert_array_equal(log.ticks.state.temperature[4], np.arange(12.0) + 30.0)
    margins = {margin.quantity: margin for margin in deploy_run.margins(log)}
    hottest = margins["motor temperature"]
    assert (hottest.largest, hottest.joint) == (41.0, ROBOT.joint_names[11])


def test_a_cut_log_is_a_warning(tmp_path: Path) -> None:
    path = faulted(tmp_path / "run.mcap", end=False)
    path.write_bytes(path.read_bytes()[:-20])
    page_part = deploy_part(path)
    assert page_part.figures["complete"] is False
    assert page_part.warning
    assert "The log was cut" in build.page("cut", [page_part])


def test_the_page_of_a_refusal_with_missed_ticks(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = DeployLogWriter(path, HEADER | {"robot": "unheard_of"})
    for k in (0, 1, 2, 5, 6, 10):
        tick = record(
            k,
            POSE,
            mode=Mode.PREFLIGHT,
            desired=np.nan,
            sent=np.nan,
            bus_voltage=np.nan,
            orientation=np.zeros(4),
        )
        writer.write(tick)
    say(writer, 0.01, "refused", "the battery gives 12.0 V; charge it.")
    writer.end(complete=True, figures={})
    page_part = deploy_part(path)
    assert page_part.summary.endswith("the battery gives 12.0 V; charge it.")
    assert page_part.figures["delay"]["within"] is None
    assert page_part.figures["missed_ticks"] == 5


def test_a_log_and_a_folder_of_logs_become_pages(tmp_path: Path) -> None:
    accepted("report", faulted(tmp_path / "a.mcap"))
    written = (tmp_path / "a.html").read_text()
    assert "virtual robot</span>" not in written
    assert "at 0.40 s" in written
    (tmp_path / "deep").mkdir()
    flown(tmp_path / "deep" / "b.mcap")
    (tmp_path / "other.mcap").write_bytes(b"no log of anything")
    _, (upper, deep) = build.write_report(tmp_path)
    assert (upper.source, upper.virtual) == ("a.mcap", False)
    assert (deep.source, deep.virtual) == ("deep/b.mcap", True)
    assert deep.figures["delay"]["within"] is True
    with pytest.raises(LogError, match="not a log of a deployment"):
        build.write_report(tmp_path / "other.mcap")

"""Sweeps of the virtual robot in this process: logs, the safety filter, and interruptions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pronk.deploy.runtime.limits import SPEED_SHARE
from pronk.deploy.runtime.safety import SafetyFilter
from pronk.deploy.runtime.sweep import SweepController, SweepTask
from pronk.deploy.runtime.sweep_recorder import record_sweep
from pronk.errors import HardwareError, PlanError
from pronk.identify.excitation.plan import SweepPlan, make_plan
from pronk.identify.excitation.signals import Chirp
from pronk.identify.logs.mcap_reader import read_mcap
from pronk.identify.logs.options import ReadOptions
from pronk.identify.simulators.command_trace import command_clock
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.robots import load_robot
from pronk.robots.machine import Command, State

ROBOT = load_robot("mini_cheetah")
SIM_PARAMS = load_sim_params(None)
SHORT = Chirp(length_s=2.0, start_hz=0.5, stop_hz=10.0)


class Watched(VirtualRobot):
    """The virtual robot, with a note of when it was damped, clamped and closed."""

    def __init__(self) -> None:
        super().__init__(ROBOT, SIM_PARAMS, legs=("FR",))
        self.calls: list[str] = []

    def damp(self) -> None:
        self.calls.append("damp")
        super().damp()

    def close(self) -> None:
        self.calls.append("close")
        super().close()

    def clamp(self, joints: tuple[str, ...]) -> None:
        self.calls.append(" ".join(("clamp", *joints)))
        super().clamp(joints)


def plan_of(*joints: str, **options: object) -> SweepPlan:
    settings = {"amplitudes": (0.2, 0.1), "repeats": 1, **options}
    return make_plan(ROBOT, joints, SHORT, **settings)  # type: ignore[arg-type]


def sweep(machine: Watched, plan: SweepPlan, out_dir: Path, **options: Any) -> list[Path]:
    progress = options.pop("progress", lambda share: None)
    return record_sweep(machine, SweepTask(plan=plan, out_dir=out_dir, **options), progress)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Watched, SweepPlan, list[Path]]:
    machine = Watched()
    plan = plan_of("FR_hip_roll", "FR_knee")
    paths = sweep(machine, plan, tmp_path_factory.mktemp("sweep"))
    return machine, plan, paths


Recorded = tuple[Watched, SweepPlan, list[Path]]


def test_one_whole_log_for_each_joint(recorded: Recorded) -> None:
    machine, plan, paths = recorded
    assert [path.name for path in paths] == ["FR_hip_roll.mcap", "FR_knee.mcap"]
    for path, joint in zip(paths, plan.joints, strict=True):
        log = read_mcap(path, None, ReadOptions())
        assert log.origin.complete
        assert log.notes == ()
        assert log.virtual
        assert log.robot == "mini_cheetah"
        assert log.joints == ("FR_hip_roll", "FR_hip_pitch", "FR_knee")
        large, small = log.segments
        assert large.joints == small.joints == (joint,)
        assert large.amplitude == 0.2
        assert small.amplitude == 0.1
        assert log.stiffness is not None
        np.testing.assert_array_equal(log.stiffness, [17.0] * 3)
        assert log.rate_hz == pytest.approx(500.0, rel=1e-3)
    assert machine.calls == [
        *("clamp", "clamp", "clamp"),
        *("clamp", "clamp FR_hip_roll FR_hip_pitch", "clamp"),
        *("damp", "close", "damp"),
    ]


def test_the_logged_command_is_the_plans_at_exactly_50_hz(recorded: Recorded) -> None:
    _, plan, paths = recorded
    for path, joint in zip(paths, plan.joints, strict=True):
        log = read_mcap(path, None, ReadOptions())
        column = log.column(joint)
        assert log.pose is not None
        excitations = [planned for planned in plan.excitations if planned.joint == joint]
        for segment, excitation in zip(log.segments, excitations, strict=True):
            part = log.cut(segment)
            tick = np.floor((part.time - segment.start) * 50.0 + 0.05).astype(int)
            offsets = np.pad(excitation.offsets(50.0), (0, 26))
            # Every state carries the command of its tick: no edge is a sample late.
            np.testing.assert_allclose(
                part.command[:, column], log.pose[column] + offsets[tick], atol=1e-12
            )
            assert np.bincount(tick)[:-1].min() >= 9
            other_columns = np.arange(3) != column
            assert np.ptp(part.command[:, other_columns]) == np.ptp(log.pose[other_columns])


def test_frequency_and_motion_of_other_joints_are_logged(recorded: Recorded) -> None:
    _, _, paths = recorded
    hip = read_mcap(paths[0], None, ReadOptions())
    knee = read_mcap(paths[1], None, ReadOptions())
    assert len(paths) == 2
    assert hip.frequency is not None
    for segment in hip.segments:
        inside = (hip.time >= segment.start) & (hip.time <= segment.start + SHORT.length_s - 0.05)
        values = hip.frequency[inside]
        assert values[[0, -1]] == pytest.approx([0.5, 10.0], abs=0.3)
        assert (np.diff(values) >= 0.0).all()
    assert np.isnan(hip.frequency[hip.time < hip.segments[0].start - 0.01]).all()
    travel = np.ptp(hip.cut(hip.segments[0]).position, axis=0)
    assert travel[0] > 0.2
    assert 0.0 < travel[1] < 0.1
    clamped = np.ptp(knee.cut(knee.segments[0]).position, axis=0)
    assert clamped[:2].max() < 0.01
    assert clamped[2] > 0.2
    first, second = hip.segments
    assert first.stop < second.start


class Silent(Watched):
    """No state comes any more in the middle of a sweep."""

    def wait(self, until: float) -> list[State]:
        return super().wait(until) if until < 5.0 else []


class Interrupted(Watched):
    """The interrupt key is pressed in the middle of a sweep."""

    def wait(self, until: float) -> list[State]:
        if until > 5.0:
            raise KeyboardInterrupt
        return super().wait(until)


class Slipping(Watched):
    """A knee's encoder slips in the middle of a sweep."""

    def wait(self, until: float) -> list[State]:
        slip = np.zeros(12)
        if until > 5.0:
            slip[2] = 1.5
        states = []
        for state in super().wait(until):
            states.append(replace(state, position=state.position + slip))
        return states


def weak(**drive: float) -> SweepPlan:
    """A plan made for the robot, then carried out on one with weaker drives."""
    joints = []
    for joint in ROBOT.joints:
        joints.append(replace(joint, drive=replace(joint.drive, **drive)))
    return replace(plan_of("FR_knee"), robot=replace(ROBOT, joints=tuple(joints)))


@pytest.mark.parametrize(
    ("machine", "drive", "why"),
    [
        (Slipping, {}, "mechanical limits"),
        (Watched, {"no_load_speed": 1.0}, "rad/s"),
        (Watched, {"effort_limit": 0.5}, "torque"),
        (Silent, {}, "sent no state between"),
        (Interrupted, {}, "KeyboardInterrupt"),
    ],
    ids=["position", "speed", "torque", "silence", "interrupt"],
)
def test_whatever_ends_a_sweep_damps_and_keeps_the_log(
    tmp_path: Path, machine: type[Watched], drive: dict[str, float], why: str
) -> None:
    watched = machine()
    with pytest.raises((HardwareError, KeyboardInterrupt)) as caught:
        sweep(watched, weak(**drive), tmp_path)
    assert why in str(caught.value) or machine is Interrupted
    # At once where it happened, and again on the way out (closing damps too).
    assert watched.calls[-4:] == ["damp", "damp", "close", "damp"]
    log = read_mcap(tmp_path / "FR_knee.mcap", None, ReadOptions())
    assert not log.origin.complete
    assert why in log.notes[0]
    assert log.time[-1] > 4.9 or drive


def test_a_command_beyond_a_limit_is_clamped_by_the_filter(tmp_path: Path) -> None:
    """The plan excites by 0.2 rad about 1.6 rad; the filter keeps the command within the range."""
    joints = []
    for joint in ROBOT.joints:
        if "knee" in joint.name:
            joint = replace(joint, range=(1.5, 1.7))
        joints.append(joint)
    plan = replace(plan_of("FR_knee"), robot=replace(ROBOT, joints=tuple(joints)))
    sweep(Watched(), plan, tmp_path)
    log = read_mcap(tmp_path / "FR_knee.mcap", None, ReadOptions())
    commands = log.command[:, log.column("FR_knee")]
    np.testing.assert_allclose([commands.min(), commands.max()], [1.5, 1.7], atol=1e-5)


def test_every_command_of_a_sweep_passes_the_filter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    passed = []
    sent = []
    judge = SafetyFilter.judge

    def counted(*arguments: Any, **keywords: Any) -> Any:
        result = judge(*arguments, **keywords)
        passed.append(result[0])
        return result

    class Counted(Watched):
        def send(self, command: Command) -> None:
            sent.append(command)
            super().send(command)

    monkeypatch.setattr(SafetyFilter, "judge", counted)
    sweep(Counted(), plan_of("FR_knee"), tmp_path)
    assert sent
    for sent_command, passed_command in zip(sent, passed, strict=True):
        assert sent_command is passed_command


def test_several_processes_can_share_a_plan(tmp_path: Path) -> None:
    plan = plan_of("FR_hip_roll", "FR_knee", amplitudes=(0.1,))
    shares: list[float] = []
    paths = sweep(Watched(), plan, tmp_path, joints=("FR_knee",), progress=shares.append)
    assert [path.name for path in paths] == ["FR_knee.mcap"]
    assert list(tmp_path.iterdir()) == paths
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    with pytest.raises(HardwareError, match="none of FL_knee"):
        sweep(Watched(), plan, tmp_path, joints=("FL_knee",))


def test_a_task_that_cannot_be_carried_out_moves_nothing(tmp_path: Path) -> None:
    kept = tmp_path / "FR_knee.mcap"
    kept.write_bytes(b"a day's work")
    machine = Watched()
    with pytest.raises(HardwareError, match="FR_knee"):
        sweep(machine, plan_of("FR_knee"), tmp_path)
    with pytest.raises(PlanError, match="fits"):
        sweep(machine, plan_of("FR_knee", amplitudes=(1.5,)), tmp_path / "none")
    assert machine.calls == []
    arm = Watched()
    arm.robot = "so101"
    with pytest.raises(HardwareError, match="so101"):
        sweep(arm, plan_of("FR_knee"), tmp_path)
    assert arm.calls == []
    assert kept.read_bytes() == b"a day's work"
    assert list(tmp_path.iterdir()) == [kept]


def test_the_speed_limit_of_excitations_begins_at_the_pose() -> None:
    """A joint that hangs below its command steps when it is told to stay where it is."""
    plan = plan_of("FR_knee")
    task = SweepTask(plan=plan, out_dir=Path("unused"))
    machine = VirtualRobot(plan.robot, load_sim_params(None, plan.robot), legs=("FR",))
    machine.connect()
    strict = task.limits("measured")
    records: list[Any] = []
    state = machine.wait(0.01)[-1]
    controller = SweepController(
        task, machine, strict, records.append, state=state, start=0.01, real_time=False
    )
    no_load = np.array([joint.drive.no_load_speed for joint in plan.robot.joints])
    np.testing.assert_allclose(strict.joints.speed, no_load)
    np.testing.assert_allclose(controller.limits.joints.speed, SPEED_SHARE * no_load)


def test_after_a_pause_a_sweep_goes_on_at_its_own_rate() -> None:
    plan = plan_of("FR_knee", amplitudes=(0.2,))
    tick_s = 1.0 / plan.rate_hz
    task = SweepTask(plan=plan, out_dir=Path("unused"))
    machine = VirtualRobot(plan.robot, SIM_PARAMS, legs=("FR",))
    machine.connect()
    state = machine.wait(0.01)[-1]
    records: list[Any] = []
    controller = SweepController(
        task,
        machine,
        task.limits("measured"),
        records.append,
        state=state,
        start=0.01,
        real_time=True,
    )
    t = 0.01
    has_paused = False
    command = controller.command(t, [state], slack=0.001)
    while command is not None:
        machine.send(command)
        controller.sent(t, command.position)
        t += 0.002
        if not has_paused and records and records[-1]["frequency"] > 5.0:
            has_paused = True
            t += 0.084
        states = machine.wait(t)
        command = controller.command(t, states, slack=0.001)
    samples = [record for record in records if record["frequency"] > 0.0]
    knee = plan.robot.joint_names.index("FR_knee")
    time = np.array([record["time"] for record in samples])
    targets = np.array([record["command"][knee] for record in samples])
    changed = np.flatnonzero(np.diff(targets)) + 1
    offsets = plan.excitations[0].offsets(plan.rate_hz)
    # No command is left out, and none comes much sooner after another than planned.
    sent = targets[np.concatenate([[0], changed])] - plan.pose[knee]
    planned = offsets[np.concatenate([[0], np.flatnonzero(np.diff(offsets)) + 1])]
    np.testing.assert_allclose(sent, planned, atol=1e-6)
    intervals = np.diff(time[changed])
    assert intervals.min() > 0.5 * tick_s
    assert intervals.max() > 4.0 * tick_s
    clock = command_clock(time, changed)
    assert clock is not None
    assert clock.period == pytest.approx(tick_s, rel=1e-3)

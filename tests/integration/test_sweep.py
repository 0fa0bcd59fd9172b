"""Sweeps of the virtual robot in this process: logs, the safety filter, and interruptions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pronk.deploy.runtime.safety import SafetyFilter
from pronk.deploy.runtime.sweep import SweepTask
from pronk.deploy.runtime.sweep_recorder import record_sweep
from pronk.errors import HardwareError, PlanError
from pronk.identify.excitation.plan import SweepPlan, make_plan
from pronk.identify.excitation.signals import Chirp
from pronk.identify.logs.mcap_reader import read_mcap
from pronk.identify.logs.options import ReadOptions
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
    machine, plan = Watched(), plan_of("FR_hip_roll", "FR_knee")
    return machine, plan, sweep(machine, plan, tmp_path_factory.mktemp("sweep"))


Recorded = tuple[Watched, SweepPlan, list[Path]]


def test_one_whole_log_for_each_joint(recorded: Recorded) -> None:
    machine, plan, paths = recorded
    assert [path.name for path in paths] == ["FR_hip_roll.mcap", "FR_knee.mcap"]
    for path, joint in zip(paths, plan.joints, strict=True):
        log = read_mcap(path, None, ReadOptions())
        assert (log.origin.complete, log.notes, log.virtual) == (True, (), True)
        assert log.robot == "mini_cheetah"
        assert log.joints == ("FR_hip_roll", "FR_hip_pitch", "FR_knee")
        assert [s.joints for s in log.segments] == [(joint,)] * 2
        assert [s.amplitude for s in log.segments] == [0.2, 0.1]
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
        excitations = [each for each in plan.excitations if each.joint == joint]
        for segment, excitation in zip(log.segments, excitations, strict=True):
            part = log.cut(segment)
            tick = np.floor((part.time - segment.start) * 50.0 + 0.05).astype(int)
            offsets = np.pad(excitation.offsets(50.0), (0, 26))
            # Every state carries the command of its tick: no edge is a sample late.
            np.testing.assert_allclose(
                part.command[:, column], log.pose[column] + offsets[tick], atol=1e-12
            )
            assert np.bincount(tick)[:-1].min() >= 9
            others = [i for i in range(3) if i != column]
            assert np.ptp(part.command[:, others]) == np.ptp(log.pose[others])


def test_frequency_and_motion_of_other_joints_are_logged(recorded: Recorded) -> None:
    _, _, paths = recorded
    hip, knee = (read_mcap(path, None, ReadOptions()) for path in paths)
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
        slip = np.where(np.arange(12) == 2, 1.5 if until > 5.0 else 0.0, 0.0)
        return [replace(state, position=state.position + slip) for state in super().wait(until)]


def weak(**drive: float) -> SweepPlan:
    """A plan made for the robot, then carried out on one with weaker drives."""
    joints = tuple(replace(j, drive=replace(j.drive, **drive)) for j in ROBOT.joints)
    return replace(plan_of("FR_knee"), robot=replace(ROBOT, joints=joints))


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
    joints = tuple(replace(j, range=(1.5, 1.7)) if "knee" in j.name else j for j in ROBOT.joints)
    plan = replace(plan_of("FR_knee"), robot=replace(ROBOT, joints=joints))
    sweep(Watched(), plan, tmp_path)
    log = read_mcap(tmp_path / "FR_knee.mcap", None, ReadOptions())
    commands = log.command[:, log.column("FR_knee")]
    np.testing.assert_allclose([commands.min(), commands.max()], [1.5, 1.7], atol=1e-5)


def test_every_command_of_a_sweep_passes_the_filter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    passed, sent, judge = [], [], SafetyFilter.judge

    def counted(*given: Any, **more: Any) -> Any:
        result = judge(*given, **more)
        passed.append(result[0])
        return result

    class Counted(Watched):
        def send(self, command: Command) -> None:
            sent.append(command)
            super().send(command)

    monkeypatch.setattr(SafetyFilter, "judge", counted)
    sweep(Counted(), plan_of("FR_knee"), tmp_path)
    assert sent
    assert all(one is other for one, other in zip(sent, passed, strict=True))


def test_several_processes_can_share_a_plan(tmp_path: Path) -> None:
    plan = plan_of("FR_hip_roll", "FR_knee", amplitudes=(0.1,))
    shares: list[float] = []
    one = {"joints": ("FR_knee",), "progress": shares.append}
    paths = sweep(Watched(), plan, tmp_path, **one)
    assert [path.name for path in paths] == ["FR_knee.mcap"]
    assert list(tmp_path.iterdir()) == paths
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    with pytest.raises(HardwareError, match="none of FL_knee"):
        sweep(Watched(), plan, tmp_path, joints=("FL_knee",))


def test_a_task_that_cannot_be_carried_out_moves_nothing(tmp_path: Path) -> None:
    kept = tmp_path / "FR_knee.mcap"
    kept.write_bytes(b"a day's work")
    machine, other = Watched(), Watched()
    other.robot = "so101"
    too_much = plan_of("FR_knee", amplitudes=(1.5,))
    for each, plan, error, word in (
        (machine, plan_of("FR_knee"), HardwareError, "FR_knee"),
        (machine, too_much, PlanError, "fits"),
        (other, plan_of("FR_knee"), HardwareError, "so101"),
    ):
        folder = tmp_path if plan is not too_much else tmp_path / "none"
        with pytest.raises(error, match=word):
            sweep(each, plan, folder)
    assert machine.calls == other.calls == []
    assert kept.read_bytes() == b"a day's work"
    assert list(tmp_path.iterdir()) == [kept]

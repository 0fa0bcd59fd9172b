"""Ask the machine what the plan says, and write down what it answers, as it answers.

Commands go out at the ticks of the policy on the machine's own clock; every state the machine
measures is logged with the command in force. Whatever goes wrong, the joints are left damped and
the log of what happened until then stays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from pronk.errors import HardwareError
from pronk.excitation.plan import Ask, SweepPlan
from pronk.links.machine import Machine
from pronk.logs.joint_log import Segment
from pronk.logs.mcap_format import LogHeader
from pronk.logs.mcap_writer import McapLogWriter
from pronk.robots.robot import Robot
from pronk.runtime.sweep.log_subprocess import Log
from pronk.runtime.sweep.servo import Servo
from pronk.runtime.sweep.session import Session

Progress = Callable[[float, str], None]
"""Called with the share that is done, 0 to 1, and what is being done."""

_PROGRESS_TICKS = 25
"""Ticks between two reports of progress."""


def record(
    machine: Machine,
    robot: Robot,
    plan: SweepPlan,
    out_dir: Path,
    *,
    progress: Progress | None = None,
    prefix: str = "",
    joints: Sequence[str] | None = None,
    overwrite: bool = False,
    servo: Servo | None = None,
    metadata: Mapping[str, str] | None = None,
    open_log: Callable[[Path, LogHeader], Log] = McapLogWriter,
) -> list[Path]:
    """Carry out a plan; one MCAP file per joint, `<prefix><joint>.mcap`.

    The plan is checked first. The link is opened here and closed again. For each joint: free all
    clamps, move softly to the pose, clamp what the question wants clamped, ask, rest. The joints
    that are not asked are held at the pose with the plan's gains, and all joints of the same leg
    are logged, so that the log can answer who else moved.

    Args:
        machine: The machine; not connected.
        robot: The robot.
        plan: What to ask.
        out_dir: Folder for the logs; made if it is missing.
        progress: Called about twice a second of machine time.
        prefix: Begins the name of every file.
        joints: Record only the questions to these joints of the plan, so that several processes
            can share a plan.
        overwrite: Replace logs that are already there.
        servo: For a machine in real time: the command is written and every state checked at its
            ticks, and the joints are taken hold of softly first. None for a machine whose clock
            waits for whoever asks.
        metadata: What else the logs shall say, for instance of the link.
        open_log: Opens a log; here, or in another process.

    Returns:
        The files, in the order written.

    Raises:
        PlanError: The plan could exceed a limit.
        RobotError: A joint is unknown.
        HardwareError: A log is in the way, the machine does not answer, or a limit was breached.
            The joints are then damped, and the log up to that moment is whole and says why.
    """
    if machine.robot != robot.name or plan.robot.name != robot.name:
        raise HardwareError(
            f"the machine is {machine.robot!r}, the plan is for {plan.robot.name!r} and the robot "
            f"is {robot.name!r}; all three must be the same."
        )
    for name in joints or ():
        robot.joint(name)
    sets = [names for names in plan.sets if joints is None or set(names) & set(joints)]
    if not sets:
        raise HardwareError(
            f"the plan asks {', '.join(plan.joints)}, none of {', '.join(joints or ())}."
        )
    paths = [out_dir / f"{prefix}{_file_name(names)}.mcap" for names in sets]
    for path in paths:
        if path.exists() and not overwrite:
            raise HardwareError(
                f"{path} is already there; give another folder, remove it, or ask to overwrite it."
            )
    plan.check()
    total = sum(plan.ask_duration_s(ask) for ask in plan.asks if ask.joints in sets)
    done = 0.0
    machine.connect()
    try:
        session = Session(machine, robot, plan, servo)
        session.take_hold()
        for names, path in zip(sets, paths, strict=True):
            asks = [ask for ask in plan.asks if ask.joints == names]
            header = _header(machine, plan, asks[0].joints, metadata or {})
            done = _record_set(session, open_log(path, header), asks, progress, done, total)
            if progress:
                progress(done / total, f"wrote {path.name}")
    finally:
        # Every way out, the interrupt key included, leaves the joints damped.
        machine.damp()
        machine.close()
    return paths


def _header(
    machine: Machine, plan: SweepPlan, asked: tuple[str, ...], metadata: Mapping[str, str]
) -> LogHeader:
    """What is known of a log before its first sample; the machine is connected."""
    robot = plan.robot
    logged = logged_joints(robot, asked)
    columns = [robot.joint_names.index(name) for name in logged]
    return LogHeader(
        robot=robot.name,
        joints=logged,
        stiffness=plan.stiffness[columns].tolist(),
        damping=plan.damping[columns].tolist(),
        pose=plan.pose[columns].tolist(),
        units=("rad",) * len(logged),
        virtual=machine.virtual,
        metadata={
            "command_rate_hz": f"{plan.rate_hz:g}",
            "asked": ", ".join(asked),
            "torque": machine.torque_kind,
            **metadata,
        },
    )


def _record_set(
    session: Session,
    log: Log,
    asks: Sequence[Ask],
    progress: Progress | None,
    done: float,
    total: float,
) -> float:
    """Ask everything that goes into one log; returns the seconds done."""
    plan, machine = session.plan, session.machine
    names = plan.robot.joint_names
    with log as writer:
        session.log_to(
            writer, [names.index(name) for name in logged_joints(plan.robot, asks[0].joints)]
        )
        try:
            session.clamp(())
            session.move_softly(plan.pose)
            session.rest(plan.settle_s)
            session.check_at_pose(plan.pose)
            session.clamp(asks[0].clamped)
            session.rest(plan.settle_s)
            for ask in asks:
                _ask(session, writer, ask, progress, done, total)
                done += plan.ask_duration_s(ask)
            session.clamp(())
        except BaseException:
            # Damp before the file is finished: the joints come first.
            machine.damp()
            raise
        finally:
            session.finish()
    return done


def _ask(
    session: Session,
    writer: Log,
    ask: Ask,
    progress: Progress | None,
    done: float,
    total: float,
) -> None:
    """One question and the rest after it."""
    plan = session.plan
    names = plan.robot.joint_names
    asked = [names.index(name) for name in ask.joints]
    offsets, frequency = ask.offsets(plan.rate_hz), ask.frequency(plan.rate_hz)
    first = ask.signals[0]
    bands = [signal.band_hz for signal in ask.signals]
    # A question begins one tick after the last one's rest, so that no sample is in both.
    session.hold(plan.pose)
    number = writer.segment(
        Segment(
            kind=first.kind,
            joints=ask.joints,
            start=session.now,
            stop=session.now + plan.ask_duration_s(ask) - session.tick / 2.0,
            amplitude=ask.amplitude,
            repeat=ask.repeat,
            band_hz=(min(low for low, _ in bands), max(high for _, high in bands)),
            period_s=first.period_s,
            clamped=ask.clamped,
        )
    )
    words = f"{', '.join(ask.joints)}: {ask.amplitude:g} rad, repeat {ask.repeat + 1}"
    for k, offset in enumerate(offsets):
        target = plan.pose.copy()
        target[asked] += offset
        session.hold(target, float(frequency[k]), number)
        if progress and k % _PROGRESS_TICKS == 0:
            progress(min((done + k * session.tick) / total, 1.0), words)
    for _ in range(round(plan.settle_s / session.tick)):
        session.hold(plan.pose, np.nan, number)


def logged_joints(robot: Robot, asked: Sequence[str]) -> tuple[str, ...]:
    """Joints that can move with the asked ones, or are clamped for them: their leg, file order."""
    wanted: set[str] = set()
    for name in asked:
        joint = robot.joint(name)
        wanted |= {name, *joint.chain, *joint.clamped}
    return tuple(name for name in robot.joint_names if name in wanted)


def _file_name(joints: Sequence[str]) -> str:
    return joints[0] if len(joints) == 1 else f"together_{joints[0]}_and_{len(joints) - 1}_more"

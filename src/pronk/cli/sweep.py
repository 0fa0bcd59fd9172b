"""`pronk sweep`: plan, check, excite, record."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from pronk.cli import console
from pronk.cli.link_options import LinkOptions
from pronk.errors import HardwareError, PronkError
from pronk.files import locked_folder
from pronk.tables import Column, Table

if TYPE_CHECKING:
    from pronk.deploy.runtime.limits import AgeLimits
    from pronk.deploy.runtime.plan import Link
    from pronk.deploy.runtime.records import Event
    from pronk.identify.excitation.plan import SweepPlan
    from pronk.identify.excitation.signals import Signal

SignalName = Literal["chirp", "log-chirp", "multisine", "sine-steps"]
"""Names of the excitation signals, whose classes are in `pronk.identify.excitation.signals`."""
AMPLITUDES = (0.25, 0.125)
"""The paper's amplitude (F3) and half of it, so that friction shows [rad]."""


@dataclass(frozen=True, kw_only=True)
class ExcitationOptions:
    """What is excited, and how."""

    joints: tuple[str, ...] = ()
    """Joints to excite; with commas between several, or repeat it. All if left out."""
    signal: SignalName = "chirp"
    """Excitation signal."""
    amplitude: tuple[float, ...] = ()
    """Peak of the command in rad; repeat it for several. 0.25 and 0.125 if left out."""
    repeats: int = 3
    """Times each amplitude is repeated."""


def sweep(
    robot: tyro.conf.Positional[str],
    out: Path = Path("logs"),
    plan_only: bool = False,
    overwrite: bool = False,
    wide: bool = False,
    excitation: ExcitationOptions = ExcitationOptions(),
    machine: LinkOptions = LinkOptions(),  # noqa: B008
) -> console.Outcome:
    """Excite every joint: plan, check against the limits, excite, record.

    Example:
        pronk sweep mini_cheetah --joints FR_knee --out logs

    Args:
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        out: Folder for the logs, one MCAP file per joint.
        plan_only: Show what it would do to the robot and leave.
        overwrite: Replace logs that exist.
        wide: Print every column of the plan: limits of the positions, power and current as well.
        excitation: What is excited, and how.
        machine: The machine.
    """
    from pronk.deploy.bench.virtual_sweep import sweep_virtual
    from pronk.deploy.links.address import SIM
    from pronk.deploy.runtime.plan import Link
    from pronk.identify.excitation.plan import make_plan
    from pronk.jump.virtual.sim_params import load_sim_params
    from pronk.robots import load_robot

    spec = load_robot(robot)
    address = machine.address()
    virtual = address.scheme == SIM
    if virtual and (address.interface not in (None, "bench") or machine.release):
        raise HardwareError(
            f"{address}: the virtual robot of a sweep is on the bench, without a wire; leave out "
            "--interface and --disable-onboard-controller; give --seed and --sim-params."
        )
    names: list[str] = []
    for entry in excitation.joints:
        names += [name for name in entry.split(",") if name]
    if excitation.joints and not names:
        raise PronkError(
            f"--joints {','.join(excitation.joints)!r} names no joint; name one or more, or "
            "leave it out for all."
        )
    with console.progress() as report:
        report("forecast", 0.0)
        plan = make_plan(
            spec,
            names or None,
            _signal(excitation.signal),
            amplitudes=excitation.amplitude or AMPLITUDES,
            repeats=excitation.repeats,
        )
        report("forecast", 1.0)
    console.show(plan_table(plan), wide=wide)
    plan.check()
    for sentence in plan.warnings():
        console.warn(sentence)
    figures: dict[str, Any] = {
        "robot": spec.name,
        "link": str(address),
        # Whether a robot behind a wire is virtual is not known before its first state.
        "virtual": True if virtual else None,
        "duration_s": plan.duration_s,
        "plan": plan.rows(),
        "logs": [],
    }
    if plan_only:
        return console.Outcome(figures=figures, following=["the same command without --plan-only"])
    if not (address.local or machine.yes):
        console.confirm(spec.name, str(address))
    with console.progress() as report:
        progress = report.bar(f"excite over {address.scheme}")
        if virtual:
            stated_file = address.options.get("params")
            params_file = None if stated_file is None else str(stated_file)
            params = load_sim_params(params_file, spec)
            params.check_joints(spec.joint_names, params_file or "sim_params")
            with locked_folder(out), new_logs_removed_on_failure(out):
                figures["logs"] = sweep_virtual(
                    plan,
                    params,
                    out,
                    seed=int(address.options.get("seed", 0)),
                    processes=os.cpu_count() or 1,
                    overwrite=overwrite,
                    progress=progress,
                )
        else:
            link = Link(robot=spec.source or spec.name, address=address, release=machine.release)
            with locked_folder(out):
                figures |= record_wire(
                    plan,
                    out,
                    link,
                    real_time=machine.real_time,
                    overwrite=overwrite,
                    progress=progress,
                )
    recorded = "the virtual robot" if figures["virtual"] else "a robot that is not the virtual one"
    console.say(f"wrote {len(figures['logs'])} logs of {recorded} to {out}")
    lateness = figures.get("servo")
    if lateness is not None:
        console.say(
            f"servo: {lateness['n']} ticks, late by {lateness['p50_ms']:.2f} ms (median), "
            f"{lateness['p99_ms']:.2f} ms (99 %), {lateness['max_ms']:.1f} ms at most; "
            f"{lateness['missed']} missed"
        )
    return console.Outcome(
        figures=figures,
        following=[
            shlex.join(["pronk", "response", str(out), "--robot", robot]),
            shlex.join(
                ["pronk", "match", str(out), "--robot", robot, "--out", str(out / "gains.yaml")]
            ),
        ],
    )


@contextmanager
def new_logs_removed_on_failure(out: Path) -> Iterator[None]:
    """Remove the logs that a sweep of the virtual robot has begun if it fails.

    A sweep of the virtual robot can be repeated at will; one of a robot keeps what it recorded.

    Raises:
        PronkError: The logs cannot be written, as on a full disk.
    """
    before = set(out.glob("*.mcap"))
    try:
        yield
    except BaseException as error:
        for path in set(out.glob("*.mcap")) - before:
            path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise PronkError(
                f"{out}: the logs cannot be written ({error.strerror or error})."
            ) from error
        raise


def _signal(name: SignalName) -> Signal:
    """Return the signal of a name, with its own defaults."""
    from pronk.identify.excitation.signals import Chirp, LogChirp, Multisine, SineSteps

    signals: dict[str, Signal] = {
        "chirp": Chirp(),
        "log-chirp": LogChirp(),
        "multisine": Multisine(),
        "sine-steps": SineSteps(),
    }
    return signals[name]


def plan_table(plan: SweepPlan) -> Table:
    """Return the table of the worst case of each excited joint."""
    rows = []
    for worst in plan.forecasts:
        if worst.amplitude == 0.0:
            continue
        low, high = worst.range
        rows.append(
            (
                worst.joint,
                worst.amplitude,
                worst.lowest,
                low,
                worst.highest,
                high,
                worst.speed,
                worst.no_load_speed,
                worst.torque,
                worst.effort_limit,
                worst.electrical_power,
                worst.bus_current,
            )
        )
    return Table(
        title=(
            f"Plan: {plan.duration_s:.0f} s of the robot's time; worst case over what is uncertain"
        ),
        columns=(
            Column(heading="joint"),
            Column(heading="amplitude", unit="rad"),
            Column(heading="lowest", unit="rad", digits=2),
            Column(heading="of", digits=2, is_detail=True),
            Column(heading="highest", unit="rad", digits=2),
            Column(heading="of", digits=2, is_detail=True),
            Column(heading="speed", unit="rad/s", digits=1),
            Column(heading="of", digits=1),
            Column(heading="torque", unit="N m", digits=1),
            Column(heading="of", digits=1),
            Column(heading="power", unit="W", digits=0, is_detail=True),
            Column(heading="bus", unit="A", digits=1, is_detail=True),
        ),
        rows=tuple(rows),
    )


def record_wire(
    plan: SweepPlan,
    out: Path,
    link: Link,
    *,
    real_time: bool = True,
    ages: AgeLimits | None = None,
    standby_s: float = 0.04,
    operator_timeout_s: float = 0.3,
    overwrite: bool = False,
    progress: Callable[[float], None] = lambda share: None,
) -> dict[str, Any]:
    """Sweep a robot in real time, all joints over one connection of the servo's process.

    Args:
        plan: The sweep, which the caller has checked.
        out: Folder of the logs.
        link: The robot and how it is reached.
        real_time: True to ask the operating system for real-time scheduling.
        ages: Limits of the age of a state; those of the robot if None.
        standby_s: Silence of the servo after which the standby process damps the joints [s].
        operator_timeout_s: Silence of this program after which the servo damps the joints [s].
        overwrite: Replace logs that exist.
        progress: Called with the share of the sweep that is done, 0 to 1.

    Returns:
        The `logs`, whether the robot was `virtual`, and how late the `servo` was.

    Raises:
        PronkError: The robot may not be moved, the filter stopped the sweep, or a process was
            killed. What was recorded until then stays readable, with the reason.
        KeyboardInterrupt: The run was interrupted; the joints were damped.
    """
    from pronk.deploy.runtime.plan import RunPlan
    from pronk.deploy.runtime.run import run_plan
    from pronk.deploy.runtime.sweep import SweepTask
    from pronk.deploy.runtime.teleop import BenchOperator

    metadata = {"link": str(link.address), "servo_rate_hz": f"{RunPlan.servo_rate_hz:g}"}
    task = SweepTask(plan=plan, out_dir=out, overwrite=overwrite, metadata=metadata)
    run = RunPlan(
        link=link,
        sweep=task,
        real_time=real_time,
        ages=ages,
        standby_s=standby_s,
        operator_timeout_s=operator_timeout_s,
    )
    operator = BenchOperator(console.RigOperator())
    complete_logs: list[str] = []

    def notify(event: Event) -> None:
        if event.kind == "log":
            complete_logs.append(event.text)
        elif event.kind == "system" and real_time:
            console.say(event.text)

    try:
        summary = run_plan(run, operator, notify, progress)
        servo = summary.servo
        if summary.interrupted:
            raise KeyboardInterrupt
        if operator.error is not None:
            raise operator.error
        if summary.log_error:
            raise HardwareError(f"{summary.log_error}; the joints were damped.")
        reasons = summary.refusals or servo["faults"]
        if reasons:
            raise HardwareError(" ".join(reasons))
        if not servo["finished"]:
            raise HardwareError("the sweep was ended (SIGTERM); the joints were damped.")
    except BaseException:
        _warn_of_partial_logs(out, task.paths, complete_logs)
        raise
    lateness = {**servo["lateness"], "missed": servo["missed_ticks"]}
    return {"logs": task.paths, "virtual": bool(servo["virtual"]), "servo": lateness}


def _warn_of_partial_logs(out: Path, paths: Sequence[Path], complete_logs: Sequence[str]) -> None:
    """Say which logs of a sweep that ended early are complete, and which one was cut."""
    cut_logs = [path.name for path in paths if path.exists() and path.name not in complete_logs]
    if not complete_logs and not cut_logs:
        return
    text = f"ended early; in {out} are kept {', '.join(complete_logs) or 'no whole log'} whole"
    if cut_logs:
        text += f", and {cut_logs[0]} up to the end"
    console.warn(f"{text}; sweep the others with --joints")

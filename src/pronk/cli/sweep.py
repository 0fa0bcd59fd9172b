"""`pronk sweep`: plan, check, excite, record."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from pronk.cli import console
from pronk.cli.link_options import LinkOptions
from pronk.errors import HardwareError

if TYPE_CHECKING:
    from pronk.deploy.runtime.plan import Link
    from pronk.deploy.runtime.records import Event
    from pronk.identify.excitation.plan import SweepPlan

SignalName = Literal["chirp", "log-chirp", "multisine", "sine-steps"]
"""PlannedExcitation signals: classes of `pronk.identify.excitation.signals`, `log-chirp` for
`LogChirp`."""
AMPLITUDES = (0.25, 0.125)
"""The paper's amplitude (F3) and half of it, so that friction shows [rad]."""
COLUMNS = {
    "joint": "joint",
    "amplitude [rad]": "amplitude_rad",
    "lowest [rad];2": "lowest_rad",
    "of;2": "range_low_rad",
    "highest [rad];2": "highest_rad",
    "of ;2": "range_high_rad",
    "speed [rad/s];1": "speed_rad_s",
    "of no-load;1": "no_load_speed_rad_s",
    "torque [N m];1": "torque_nm",
    "of limit;1": "effort_limit_nm",
    "power [W];0": "electrical_power_w",
    "bus [A];1": "bus_current_a",
}
"""Heading to field of a row of the plan."""


def sweep(
    robot: tyro.conf.Positional[str],
    out: Path,
    machine: LinkOptions = LinkOptions(),  # noqa: B008
    joints: tuple[str, ...] = (),
    signal: SignalName = "chirp",
    amplitude: tuple[float, ...] = (),
    repeats: int = 3,
    plan_only: bool = False,
    overwrite: bool = False,
) -> console.Outcome:
    """Excite every joint: plan, check against the limits, excite, record.

    Args:
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        out: Folder for the logs, one MCAP per joint.
        machine: The machine.
        joints: Joints to excite; repeat it. All if left out.
        signal: PlannedExcitation signal.
        amplitude: Peak of the command in rad; repeat it for several.
        repeats: Times each amplitude is repeated.
        plan_only: Show what it would do to the robot and leave.
        overwrite: Replace logs that exist.
    """
    from pronk.deploy.bench.virtual_sweep import sweep_virtual
    from pronk.deploy.links.address import SIM
    from pronk.deploy.runtime.plan import Link
    from pronk.identify.excitation import signals
    from pronk.identify.excitation.plan import make_plan
    from pronk.jump.virtual.sim_params import load_sim_params
    from pronk.robots import load_robot

    known, address = load_robot(robot), machine.address()
    virtual = address.kind == SIM
    if virtual and (address.interface not in (None, "bench") or machine.release):
        raise HardwareError(
            f"{address}: the virtual robot of a sweep is on the bench, without a wire; leave out "
            "--interface and --disable-onboard-controller; give --seed and --sim-params."
        )
    names = [part for entry in joints for part in entry.split(",") if part]
    with console.progress() as report:
        report("forecast", 0.0)
        kind = getattr(signals, signal.title().replace("-", ""))
        sizes = amplitude or AMPLITUDES
        plan = make_plan(known, names or None, kind(), amplitudes=sizes, repeats=repeats)
        report("forecast", 1.0)
    title = (
        f"RunPlan: {plan.duration_s:.0f} s of the robot's time; worst case over what is uncertain"
    )
    console.show_rows(title, COLUMNS, plan.rows())
    plan.check()
    figures: dict[str, Any] = {
        "robot": known.name,
        "link": str(address),
        "virtual": virtual or None,  # by wire not known before the first state
        "duration_s": plan.duration_s,
        "plan": plan.rows(),
        "logs": [],
    }
    if plan_only:
        return console.Outcome(figures=figures, following=["the same command without --plan-only"])
    if not (address.local or machine.yes):
        console.confirm(known.name, str(address))
    with console.progress() as report:
        how: Any = {"overwrite": overwrite, "progress": report.bar(f"excite over {address.kind}")}
        if virtual:
            file = address.options.get("params")
            params = load_sim_params(None if file is None else str(file), known)
            params.check_joints(known.joint_names, str(file or "sim_params"))
            seed, cpus = int(address.options.get("seed", 0)), os.cpu_count() or 1
            logs = sweep_virtual(plan, params, out, seed=seed, processes=cpus, **how)
            figures["logs"] = logs
        else:
            link = Link(robot=known.source or known.name, address=address, release=machine.release)
            figures |= record_wire(plan, out, link, real_time=machine.real_time, **how)
    where = "the virtual robot" if figures["virtual"] else "a robot that is not the virtual one"
    console.say(f"wrote {len(figures['logs'])} logs of {where} to {out}")
    if late := figures.get("servo"):
        console.say(
            f"servo: {late['n']} ticks, late by {late['p50_ms']:.2f} ms (median), "
            f"{late['p99_ms']:.2f} ms (99 %), {late['max_ms']:.1f} ms at most; "
            f"{late['missed']} missed"
        )
    match = f"pronk match {out} --robot {robot} --out {out}/gains.yaml"
    return console.Outcome(figures=figures, following=[f"pronk response {out}", match])


def record_wire(
    plan: SweepPlan,
    out: Path,
    link: Link,
    *,
    overwrite: bool = False,
    progress: Callable[[float], None] = lambda share: None,
    **more: Any,
) -> dict[str, Any]:
    """Sweep a robot in real time, all joints over one connection of the servo's process.

    The caller has checked the plan; `more` is of the runtime's `Plan`. Returns the `logs`, whether
    the robot was `virtual`, and how late the `servo` was.

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
    job, operator = RunPlan(link=link, sweep=task, **more), BenchOperator(console.RigOperator())
    whole: list[str] = []

    def notify(event: Event) -> None:
        if event.kind == "log":
            whole.append(event.text)
        elif event.kind == "system" and job.real_time:
            console.say(event.text)

    try:
        summary = run_plan(job, operator, notify, progress)
        servo = summary.servo
        if summary.interrupted:
            raise KeyboardInterrupt
        if operator.error is not None:
            raise operator.error
        if summary.log_error:
            raise HardwareError(f"{summary.log_error}; the joints were damped.")
        if reasons := summary.refusals or servo["faults"]:
            raise HardwareError(" ".join(reasons))
        if not servo["finished"]:
            raise HardwareError("the sweep was ended (SIGTERM); the joints were damped.")
    except BaseException:
        cut = [path.name for path in task.paths if path.exists() and path.name not in whole]
        if whole or cut:
            console.warn(
                f"ended early; in {out} are kept {', '.join(whole) or 'no whole log'} whole"
                + (f", and {cut[0]} up to the end" if cut else "")
                + "; sweep the others with --joints"
            )
        raise
    late = {**servo["lateness"], "missed": servo["missed_ticks"]}
    return {"logs": task.paths, "virtual": bool(servo["virtual"]), "servo": late}

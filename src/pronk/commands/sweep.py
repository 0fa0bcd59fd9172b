"""`pronk sweep`: plan, check, ask, record."""

from __future__ import annotations

import os
import queue
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from enum import StrEnum
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pronk.commands import console
from pronk.errors import HardwareError, PlanError

if TYPE_CHECKING:
    from pronk.robots.robot import Robot
    from pronk.sweep.plan import SweepPlan
    from pronk.sweep.signals import Signal


class Link(StrEnum):
    """How the machine is reached."""

    TWIN = "twin"
    LCM = "lcm"
    DDS = "dds"


class SignalName(StrEnum):
    """What can be asked."""

    CHIRP = "chirp"
    LOG_CHIRP = "log-chirp"
    MULTISINE = "multisine"
    SINE_STEPS = "sine-steps"


AMPLITUDES = (0.25, 0.125)
"""The paper's amplitude (F3) and half of it, so that friction shows [rad]."""


def sweep(
    robot: Annotated[str, typer.Argument(help="Robot, for instance mini_cheetah.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the logs, one MCAP per joint.")],
    link: Annotated[Link, typer.Option(help="twin is the virtual robot.")] = Link.TWIN,
    truth: Annotated[
        Path | None, typer.Option(help="Truth of the virtual robot, instead of the shipped one.")
    ] = None,
    joints: Annotated[
        list[str] | None,
        typer.Option("--joints", help="Joints to ask; repeat it. All if left out."),
    ] = None,
    signal: Annotated[SignalName, typer.Option(help="What to ask.")] = SignalName.CHIRP,
    amplitude: Annotated[
        list[float] | None, typer.Option(help="Peak of the command [rad]; repeat it for several.")
    ] = None,
    repeats: Annotated[int, typer.Option(help="Times each amplitude is asked.")] = 3,
    seed: Annotated[int, typer.Option(help="Of the virtual robot's noise.")] = 0,
    plan_only: Annotated[
        bool, typer.Option("--plan-only", help="Show what it would do to the robot and leave.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace logs that are already there.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask before real hardware moves.")
    ] = False,
    json_file: console.JsonOption = None,
) -> None:
    """Ask every joint: plan, check against the limits, ask, record."""
    from pronk.robots import load_robot

    machine = load_robot(robot)
    if link is not Link.TWIN:
        raise HardwareError(
            f"--link {link.value} is not built yet: links to a real robot come with the issue "
            '"put it on the robot"; use --link twin, the virtual robot, until then.'
        )
    del yes  # only hardware is asked about
    names = [part for entry in joints or () for part in entry.split(",") if part]
    with console.progress() as report:
        report("forecast", 0.0)
        plan = make(machine, names or None, signal, tuple(amplitude or AMPLITUDES), repeats)
        report("forecast", 1.0)
    show_plan(plan)
    plan.check()
    figures: dict[str, Any] = {
        "robot": machine.name,
        "virtual": True,
        "duration_s": plan.duration_s,
        "plan": plan.rows(),
        "logs": [],
    }
    if plan_only:
        console.write_json(json_file, figures)
        console.following(f"pronk sweep {robot} --link {link.value} --out {out}")
        return
    with console.progress() as report:
        paths = record_twin(
            machine,
            plan,
            out,
            truth=truth,
            seed=seed,
            overwrite=overwrite,
            progress=report.bar("ask the virtual robot"),
        )
    figures["logs"] = paths
    console.say(f"wrote {len(paths)} logs of the virtual robot to {out}")
    console.write_json(json_file, figures)
    console.following(
        f"pronk response {out}",
        f"pronk match {out} --robot {robot} --out {out}/gains.yaml",
    )


def make_signal(name: SignalName) -> Signal:
    """The signal of that name with its usual settings."""
    from pronk.sweep import signals

    kinds = {
        SignalName.CHIRP: signals.Chirp,
        SignalName.LOG_CHIRP: signals.LogChirp,
        SignalName.MULTISINE: signals.Multisine,
        SignalName.SINE_STEPS: signals.SineSteps,
    }
    made: Signal = kinds[name]()
    return made


def make(
    robot: Robot,
    joints: Sequence[str] | None,
    signal: SignalName,
    amplitudes: Sequence[float],
    repeats: int | Sequence[int],
) -> SweepPlan:
    """The plan of a sweep, one joint after another."""
    from pronk.sweep.plan import make_plan

    return make_plan(robot, joints, make_signal(signal), amplitudes=amplitudes, repeats=repeats)


def show_plan(plan: SweepPlan) -> None:
    """Print what the sweep will do to each joint, against its limits."""
    made = console.table(
        f"Plan: {len(plan.asks)} questions, {plan.duration_s:.0f} s of the robot's time; "
        "worst case over what is uncertain",
        "joint",
        "amplitude [rad]",
        "position [rad]",
        "of",
        "speed [rad/s]",
        "of",
        "torque [N m]",
        "of",
        "power [W]",
        "bus [A]",
    )
    for row in plan.rows():
        low, high = float(row["lowest_rad"]), float(row["highest_rad"])
        console.row(
            made,
            str(row["joint"]),
            f"{row['amplitude_rad']:g}",
            f"{low:.2f} to {high:.2f}",
            f"{float(row['range_low_rad']):.2f} to {float(row['range_high_rad']):.2f}",
            f"{float(row['speed_rad_s']):.1f}",
            f"{float(row['no_load_speed_rad_s']):.1f}",
            f"{float(row['torque_nm']):.1f}",
            f"{float(row['effort_limit_nm']):.1f}",
            f"{float(row['electrical_power_w']):.0f}",
            f"{float(row['bus_current_a']):.1f}",
        )
    console.show(made)
    for warning in plan.warnings:
        console.warn(warning)


def record_twin(
    robot: Robot,
    plan: SweepPlan,
    out_dir: Path,
    *,
    truth: Path | None = None,
    seed: int = 0,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> list[Path]:
    """Ask the virtual robot, legs side by side in processes of their own.

    On a rigid bench legs do not feel each other, so each process simulates one leg.

    Args:
        robot: The robot.
        plan: What to ask; checked by the caller.
        out_dir: Folder for the logs.
        truth: Truth file; the shipped one if None.
        seed: Of all noise; each leg takes its own from it.
        overwrite: Replace logs that are already there.
        progress: Told the share done, 0 to 1.

    Returns:
        The logs, in the order of the robot's joints.
    """
    from pronk.hardware.plant import legs_of
    from pronk.hardware.truth import load_truth

    # Read it here once, so that a bad file is one message and not one per process.
    load_truth(truth).check_joints(robot.joint_names, str(truth or "truth"))
    if len(plan.sets) != len(plan.joints):
        raise PlanError("several joints asked at once: the virtual robot is asked one at a time.")
    jobs = []
    for index, leg in enumerate(legs_of(robot)):
        asked = tuple(name for name in plan.joints if name.split("_")[0] == leg)
        if asked:
            jobs.append((leg, asked, seed * 1000 + index))
    context = get_context("spawn")
    with (
        context.Manager() as manager,
        ProcessPoolExecutor(min(len(jobs), os.cpu_count() or 1), mp_context=context) as pool,
    ):
        told: queue.Queue[tuple[str, float]] = manager.Queue()
        running = {
            pool.submit(_record_leg, plan, leg, asked, out_dir, truth, s, overwrite, told)
            for leg, asked, s in jobs
        }
        shares = {leg: 0.0 for leg, _, _ in jobs}
        weight = {leg: len(asked) / len(plan.joints) for leg, asked, _ in jobs}
        done: list[Path] = []
        while running:
            finished, running = wait(running, timeout=0.2, return_when=FIRST_EXCEPTION)
            while not told.empty():
                leg, share = told.get()
                shares[leg] = share
            if progress is not None:
                progress(sum(weight[leg] * share for leg, share in shares.items()))
            for future in finished:
                done += future.result()
    if progress is not None:
        progress(1.0)
    order = {name: i for i, name in enumerate(robot.joint_names)}
    return sorted(done, key=lambda path: order.get(path.stem, len(order)))


def _record_leg(
    plan: SweepPlan,
    leg: str,
    joints: Sequence[str],
    out_dir: Path,
    truth: Path | None,
    seed: int,
    overwrite: bool,
    told: queue.Queue[tuple[str, float]],
) -> list[Path]:
    """Ask one leg; runs in a process of its own."""
    from pronk.hardware.truth import load_truth
    from pronk.hardware.virtual import VirtualRobot
    from pronk.sweep.record import record

    machine = VirtualRobot(plan.robot, load_truth(truth), seed=seed, legs=(leg,))
    return record(
        machine,
        plan.robot,
        plan,
        out_dir,
        progress=lambda share, _: told.put((leg, share)),
        joints=joints,
        overwrite=overwrite,
    )

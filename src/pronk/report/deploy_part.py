"""A deployment's log as a part of a page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.deploy.log import DeployLog, read_deploy_log
from pronk.deploy.reasons import Level
from pronk.errors import PronkError
from pronk.report import deploy_data, deploy_times, deploy_traces, deploy_words, shell
from pronk.report.deploy_delay import Delay, delay
from pronk.report.shell import Part, number
from pronk.report.trial_extra import Block
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.trial.tables import Sheet

Array = NDArray[np.float64]

_LEVEL_WORDS = {
    Level.LIMIT: "target moved",
    Level.HOLD: "last one held",
    Level.DAMP: "damped",
    Level.LATCH: "damped, latched",
}


@dataclass(frozen=True, kw_only=True)
class Material:
    """What the part is made of."""

    log: DeployLog
    robot: Robot | None
    """None if this pronk does not know it."""
    heat: tuple[Array, Array] | None
    delay: Delay


def read(path: Path) -> Material:
    """Read a log and measure its delays.

    Raises:
        LogError: As `read_deploy_log`.
    """
    log = read_deploy_log(path)
    try:
        robot = load_robot(str(log.header["robot"]))
    except PronkError:
        robot = None
    if robot is not None and robot.joint_names != log.joints:
        robot = None
    return Material(
        log=log,
        robot=robot,
        heat=deploy_data.temperatures(path),
        delay=delay(log, robot),
    )


def figures(material: Material) -> dict[str, Any]:
    """What `--json` gives of it; times in ms."""
    log, found = material.log, material.delay
    return {
        "kind": "deploy",
        "robot": log.header["robot"],
        "virtual": log.virtual,
        "complete": log.complete,
        "verdict": deploy_words.says(log),
        "modes": [
            {"mode": one.mode.name, "begin_s": one.begin, "seconds": one.seconds}
            for one in deploy_data.stretches(log)
        ],
        "faults": [event.text for event in log.events if event.kind == "fault"],
        "refusals": [event.text for event in log.events if event.kind == "refused"],
        "missed_ticks": deploy_data.missed(log),
        "times": {
            one.name: _milliseconds(deploy_data.spread(one.values))
            for one in deploy_times.times(log)
        },
        "delay": {
            "trained_ms": None if found.trained is None else [1e3 * one for one in found.trained],
            "state_to_command_ms": _milliseconds(found.answer),
            "drives_ms": [_known(1e3 * one) for one in found.drives],
            "within": found.within,
        },
        "interventions": [
            {
                "reason": one.reason.name,
                "level": one.level.name,
                "ticks": one.ticks,
                "largest_rad": _known(one.largest),
            }
            for one in deploy_data.interventions(log)
        ],
        "tracking_rms_rad": {one.joint: _known(one.error) for one in deploy_data.tracking(log)},
    }


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _milliseconds(of: deploy_data.Spread) -> dict[str, float | int | None]:
    names = {"p50": "p50", "p95": "p95", "p99": "p99", "p99_9": "p99_9", "largest": "max"}
    return {"n": of.n} | {
        f"{short}_ms": _known(1e3 * getattr(of, name)) for name, short in names.items()
    }


def part(material: Material, *, anchor: str, title: str = "Deployment") -> Part:
    """The log as a part of a page."""
    log = material.log
    policy = log.header.get("policy", {})
    versions = ", ".join(f"{k} {v}" for k, v in log.header.get("versions", {}).items())
    html = shell.fill(
        "deploy.html.j2",
        at=f"{anchor}-" if anchor else "",
        says=deploy_words.says(log),
        lines=list(deploy_words.lines(log, material.delay)),
        doubt=deploy_words.doubtful(log, material.delay),
        blocks=list(_blocks(material)),
        log=f"{Path(log.source).name}: {len(log.time)} ticks of the servo, {len(log.step_time)} "
        f"steps of the policy, over {log.header.get('link', 'an unknown link')}"
        f"{'' if log.complete else '; cut'}.",
        policy=f"{Path(policy.get('file', 'unknown')).name} {policy.get('sha256', '')}",
        sha256=log.sha256,
        versions=f"Written with {versions or 'unknown versions'}; trained with "
        f"{policy.get('gains', 'unknown')} gains {str(policy.get('gains_sha256', ''))[:12]}.",
    )
    return Part(anchor=anchor, title=title, html=html)


def _blocks(material: Material) -> Iterator[Block]:
    log = material.log
    yield Block(
        anchor="overview",
        title="The run",
        lines=(
            "Speeds are the policy's own estimate, which no camera has checked; turning is the "
            "gyro's. The dashed line is the tilt at which the safety filter damps.",
        ),
        picture=shell.picture(
            deploy_traces.overview(log, material.heat),
            "Modes, speeds asked and estimated, tilt and battery over the run",
            dense=True,
        ),
        folded=(said(log),),
    )
    yield _joints(material)
    yield _delay(material)
    yield Block(
        anchor="times",
        title="Late, old, slow",
        lines=("Counts and times on logarithmic axes.",),
        picture=shell.picture(
            deploy_times.histograms(log, material.delay.trained),
            "Histograms of lateness, ages of states and times from state to command",
        ),
        sheets=(times(log),),
    )
    yield Block(
        anchor="when",
        title="When it was late",
        picture=shell.picture(
            deploy_times.over_time(log, deploy_traces.faults(log)),
            "Lateness, age of the state and state to command over the run",
            dense=True,
        ),
    )
    yield _filter(log)


def _joints(material: Material) -> Block:
    log = material.log
    begin, end, words = deploy_traces.window(log)
    drawn = deploy_traces.joints(log, begin, end)
    return Block(
        anchor="joints",
        title="Joints",
        lines=(
            f"{end - begin:.1f} s {words}. These drives are springs: a target away from the joint "
            "is how the policy asks for torque, so an error is not a fault. While standing up and "
            "standing it is what weight and friction leave.",
        ),
        picture=None
        if drawn is None
        else shell.picture(drawn, f"Targets and positions of all joints, {words}"),
        sheets=(tracking(material),),
    )


def _delay(material: Material) -> Block:
    found = material.delay
    lines = [deploy_words.delaying(found)]
    if np.isfinite(found.drives).all():
        lines.append(
            "What the robot adds was found by fitting: torques follow from targets, positions, "
            "speeds and the gains of the drives, if the targets are taken this much earlier "
            "(torques above half the effort limits are left out). Targets change only from tick to "
            "tick, so it is known to about a tick."
        )
    elif found.answer.n:
        lines.append(
            "What the drives add could not be told: too short, torques not measured, or not "
            "explained by the targets and the gains of the drives."
        )
    return Block(
        anchor="delay",
        title="Delay, beside training",
        lines=tuple(lines),
        sheets=(delays(found),) if found.answer.n else (),
    )


def delays(found: Delay) -> Sheet:
    """The parts of the delay, their sum, and what was trained for."""
    trained = found.trained or (np.nan, np.nan)
    rows = (
        ("state to command", found.answer.p50, found.answer.p95, "median to 95 %, measured"),
        ("command to torque", *found.drives, "fitted: bus, drives, stamping of states"),
        ("whole", *found.whole, "their sum: what training calls the command delay"),
        ("trained for", *trained, "by the contract in the policy's file"),
    )
    return Sheet(
        title="Delay",
        columns=("[ms]", "from", "to", "what it is"),
        rows=tuple(
            (name, number(1e3 * low, 1), number(1e3 * high, 1), what)
            for name, low, high, what in rows
        ),
    )


def _filter(log: DeployLog) -> Block:
    done = deploy_data.interventions(log)
    if not done:
        return Block(
            anchor="filter", title="Safety filter", lines=("It changed nothing in this run.",)
        )
    rows = [(log.level == one.level) & (log.reason == one.reason) for one in done]
    names = [one.reason.name.lower().replace("_", " ") for one in done]
    return Block(
        anchor="filter",
        title="Safety filter",
        lines=("What it changed, and why. A tick counts for the last limit that moved a target.",),
        picture=shell.picture(
            deploy_traces.marked(log, names, rows), "When the filter did something, by reason"
        ),
        sheets=(
            Sheet(
                title="Safety filter",
                columns=("what was done", "ticks", "farthest [rad]", "joint", "why"),
                rows=tuple(
                    (
                        _LEVEL_WORDS[one.level],
                        str(one.ticks),
                        number(one.largest),
                        one.joint.replace("_", " ") or "-",
                        one.reason.text,
                    )
                    for one in done
                ),
                notes=("joint: the one whose target was moved most often for this reason.",),
            ),
        ),
    )


def tracking(material: Material) -> Sheet:
    """How each joint followed, and what it gave."""
    robot, limits = material.robot, material.log.header.get("limits", {})
    effort = {} if robot is None else {j.name: j.drive.effort_limit for j in robot.joints}
    speed = dict(zip(material.log.joints, limits.get("speed", ()), strict=False))
    rows = []
    for one in deploy_data.tracking(material.log):
        rows.append(
            (
                one.joint.replace("_", " "),
                number(one.standing),
                number(one.error),
                number(one.largest),
                number(one.torque, 1),
                _of(one.torque_largest, effort.get(one.joint)),
                _of(one.speed_largest, speed.get(one.joint)),
            )
        )
    return Sheet(
        title="Joints",
        columns=(
            "joint",
            "error standing, RMS [rad]",
            "error, RMS [rad]",
            "largest [rad]",
            "torque, RMS [N\u00a0m]",
            "largest [N\u00a0m]",
            "fastest [rad/s]",
        ),
        rows=tuple(rows),
        notes=(
            "error: the target in force less the measured position. All but the first column: "
            "while the policy decided. Torques as the robot tells them, of the drives' effort "
            "limits; speeds of those at which the filter sees a fault.",
        ),
    )


def _of(value: float, limit: float | None) -> str:
    return number(value, 1) + (f" of {limit:.0f}" if limit is not None else "")


def times(log: DeployLog) -> Sheet:
    """Quantiles of everything that was timed."""
    found = deploy_times.times(log)
    rows = []
    for one in found:
        at = deploy_data.spread(one.values)
        cells = (at.p50, at.p95, at.p99, at.p99_9, at.largest)
        rows.append((one.name, str(at.n), *(number(1e3 * value) for value in cells)))
    return Sheet(
        title="Times [ms]",
        columns=("[ms]", "n", "50 %", "95 %", "99 %", "99.9 %", "largest"),
        rows=tuple(rows),
        notes=(
            *(f"{one.name}: {one.says}." for one in found),
            "A quantile is left out where fewer than one value lies beyond it.",
        ),
    )


def said(log: DeployLog) -> Sheet:
    """All events, in their order."""
    rows = []
    for event in sorted(log.events, key=lambda event: event.time):
        at = float(deploy_data.seconds(log, event.time))
        rows.append((f"{at:.3f}", event.kind, event.text))
    return Sheet(
        title=f"Everything that was said ({len(rows)} lines)",
        columns=("time [s]", "kind", "text"),
        rows=tuple(rows),
        notes=("Before the first tick times are negative.",),
    )

"""A deployment's log as a part of a page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.report import shell
from pronk.report.deploy import data as deploy_data
from pronk.report.deploy import tables as deploy_tables
from pronk.report.deploy import times as deploy_times
from pronk.report.deploy import traces as deploy_traces
from pronk.report.deploy import words as deploy_words
from pronk.report.deploy.delay import Delay, delay
from pronk.report.shell import Part
from pronk.report.trial.extra import Block
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.runtime.log import DeployLog, read_deploy_log

Array = NDArray[np.float64]


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
        folded=(deploy_tables.said(log),),
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
        sheets=(deploy_tables.times(log),),
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
        sheets=(deploy_tables.tracking(log, material.robot),),
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
            "What the drives add could not be told: the run is too short, the robot tells no "
            "torques, or targets and the gains of the drives do not explain them."
        )
    return Block(
        anchor="delay",
        title="Delay, beside training",
        lines=tuple(lines),
        sheets=(deploy_tables.delays(found),) if found.answer.n else (),
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
        sheets=(deploy_tables.interventions(done),),
    )

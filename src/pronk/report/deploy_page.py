"""Page of a deployment's log: what ran, its delays, its margins, and what the safety filter did.

It is one screen of tables. Foxglove and PlotJuggler open the log itself.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from pronk.deploy.runtime.deploy_log import DeployLog, read_deploy_log
from pronk.deploy.runtime.modes import POLICY_MODES
from pronk.deploy.runtime.reasons import FilterAction
from pronk.deploy.runtime.records import REAL, VIRTUAL
from pronk.errors import PronkError
from pronk.report.deploy_run import (
    QUANTILES,
    Delay,
    fault_times,
    interventions,
    jump_inputs,
    margins,
    measured_delay,
    missed_ticks,
    policy_active,
    quantiles,
    since_start,
    stretches,
    timed_parts,
    tracking_error,
)
from pronk.report.page import Part
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from pronk.tables import Cell, Column, Table

_PROBLEMS = ("fault", "refused")
"""Kinds of events that are told in the summary."""


def deploy_verdict(log: DeployLog) -> str:
    """Return the outcome in one sentence."""
    robot = f"{log.header['robot']} (real or virtual unknown)"
    for event in log.events:
        if event.kind == "robot" and event.text == VIRTUAL:
            robot = f"Virtual {log.header['robot']}"
        elif event.kind == "robot" and event.text == REAL:
            robot = f"Real {log.header['robot']}"
    active_s = 0.0
    for stretch in stretches(log):
        if stretch.mode in POLICY_MODES:
            active_s += stretch.seconds
    for event in log.events:
        if event.kind == "fault":
            moment = "before the policy started"
            if active_s > 0.0:
                moment = f"after {active_s:.1f} s of the policy"
            seconds = float(since_start(log, event.time))
            return f"{robot}: a fault at {seconds:.2f} s, {moment}: {event.text}."
    for event in log.events:
        if event.kind == "refused":
            return f"{robot} was not moved: {event.text}"
    if active_s == 0.0:
        return f"{robot}: no fault; the policy was never active."
    jumps = len(jump_inputs(log))
    return f"{robot}: no fault; the policy was active for {active_s:.1f} s, jump inputs: {jumps}."


def deploy_part(path: Path) -> Part:
    """Make the part of a deployment's log; LogError if it is damaged, or of something else."""
    log = read_deploy_log(path)
    delay = measured_delay(log, _robot_of(log))
    problems = [event for event in log.events if event.kind in _PROBLEMS]
    later_problems = []
    for event in problems[1:]:
        later_problems.append((event.kind, float(since_start(log, event.time)), event.text))
    has_target = np.isfinite(log.ticks.desired).any(axis=1)
    was_moved = np.isin(log.ticks.level, (FilterAction.LIMIT, FilterAction.HOLD))
    summary = deploy_verdict(log)
    figures = _figures(log, delay, summary)
    content: dict[str, Any] = {
        "log": log,
        "file": path.name,
        "figures": figures,
        "later": later_problems,
        "given": int(has_target.sum()),
        "moved": int((has_target & was_moved).sum()),
        "dropped": sum(log.figures.get("servo", {}).get("dropped", {}).values()),
        "policy": log.header.get("policy", {}),
        "delay": delay,
        "tables": [
            table
            for table in (
                _timing_table(log),
                _delay_table(delay),
                _margin_table(log),
                _intervention_table(log),
                _event_table(log),
            )
            if table.rows
        ],
    }
    content.update(_damping_after_fault(log))
    return Part(
        kind="deploy",
        title="Deployment",
        virtual=log.virtual,
        summary=summary,
        warning=bool(problems) or not log.complete or delay.within is False,
        content=content,
        figures=figures,
    )


def _robot_of(log: DeployLog) -> RobotSpec | None:
    """Return the robot of a log; None for one that is unknown or has other joints."""
    with suppress(PronkError):
        robot = load_robot(str(log.header["robot"]))
        if robot.joint_names == log.joints:
            return robot
    return None


def _figures(log: DeployLog, delay: Delay, summary: str) -> dict[str, Any]:
    """Return the figures for `--json`; times in s."""
    modes = []
    for stretch in stretches(log):
        modes.append((stretch.mode.name, stretch.begin, stretch.seconds))
    times = {}
    for timed_part in timed_parts(log):
        times[timed_part.name] = quantiles(timed_part.seconds)
    filtered = []
    for intervention in interventions(log):
        filtered.append(
            {
                "level": intervention.level.name,
                "reason": intervention.reason.name,
                "why": intervention.reason.text,
                "ticks": intervention.ticks,
                "first": intervention.first,
                "largest": intervention.largest,
                "joint": intervention.joint,
            }
        )
    worst = {}
    for margin in margins(log):
        worst[margin.quantity] = {
            "unit": margin.unit,
            "largest": margin.largest,
            "limit": margin.limit,
            "joint": margin.joint,
        }
    errors = tracking_error(log, policy_active(log)).tolist()
    return {
        "kind": "deploy",
        "robot": log.header["robot"],
        "virtual": log.virtual,
        "complete": log.complete,
        "verdict": summary,
        "modes": modes,
        "faults": [event.text for event in log.events if event.kind == "fault"],
        "refusals": [event.text for event in log.events if event.kind == "refused"],
        "missed_ticks": missed_ticks(log),
        "times": times,
        "delay": {
            "trained": delay.trained,
            "command": delay.command,
            "drives": delay.drives,
            "within": delay.within,
        },
        "interventions": filtered,
        "margins": worst,
        "tracking_rms_rad": dict(zip(log.joints, errors, strict=True)),
    }


def _damping_after_fault(log: DeployLog) -> dict[str, Any]:
    """Return which commands were damping from the first fault on, and the age of its state."""
    is_fault = log.ticks.level >= FilterAction.DAMP
    if not fault_times(log) or not is_fault.any():
        return {"damped": None, "damped_age_ms": None}
    first = int(is_fault.argmax())
    return {
        "damped": log.ticks.damped[first:],
        "damped_age_ms": 1e3 * float(log.ticks.state_age[first]),
    }


def _timing_table(log: DeployLog) -> Table:
    """Return the quantiles of everything that was timed."""
    rows: list[tuple[Cell, ...]] = []
    notes = []
    for timed_part in timed_parts(log):
        values = quantiles(timed_part.seconds)
        quantiles_ms = [1e3 * values[name] for name in QUANTILES]
        rows.append((timed_part.name, int(values["n"]), *quantiles_ms, 1e3 * values["max"]))
        notes.append(f"{timed_part.name}: {timed_part.meaning}.")
    return Table(
        title="Timing",
        columns=(
            Column(heading="part"),
            Column(heading="n"),
            Column(heading="50 %", unit="ms"),
            Column(heading="95 %", unit="ms"),
            Column(heading="99 %", unit="ms"),
            Column(heading="99.9 %", unit="ms"),
            Column(heading="largest", unit="ms"),
        ),
        rows=tuple(rows),
        notes=tuple(notes),
    )


def _delay_table(delay: Delay) -> Table:
    """Return the delay from a state to its torque beside that of training."""
    trained = delay.trained or (np.nan, np.nan)
    ranges = (
        ("state to command", delay.command["p50"], delay.command["p95"], "median to 95 %"),
        ("command to torque", *delay.drives, "fitted: bus, drives, time stamps of states"),
        ("total", *delay.total, "their sum: the command delay of training"),
        ("training range", *trained, "contract in the policy's file"),
    )
    rows = []
    if delay.command["n"]:
        for name, low, high, source in ranges:
            rows.append((name, 1e3 * low, 1e3 * high, source))
    return Table(
        title="Delay",
        columns=(
            Column(heading="delay"),
            Column(heading="from", unit="ms", digits=1),
            Column(heading="to", unit="ms", digits=1),
            Column(heading="source"),
        ),
        rows=tuple(rows),
    )


def _margin_table(log: DeployLog) -> Table:
    """Return the largest values of the run beside their limits."""
    rows = []
    for margin in margins(log):
        name = f"{margin.quantity} [{margin.unit}]"
        rows.append((name, margin.largest, margin.limit, margin.joint or "-"))
    return Table(
        title="Margins",
        columns=(
            Column(heading="quantity"),
            Column(heading="largest"),
            Column(heading="limit"),
            Column(heading="joint"),
        ),
        rows=tuple(rows),
        notes=("Of the run up to the first fault. Torques are those that the robot reports.",),
    )


def _intervention_table(log: DeployLog) -> Table:
    """Return what the safety filter did."""
    rows = []
    for intervention in interventions(log):
        rows.append(
            (
                intervention.level.name.lower(),
                intervention.ticks,
                intervention.first,
                intervention.largest,
                intervention.joint or "-",
                intervention.reason.text,
            )
        )
    return Table(
        title="Safety filter",
        columns=(
            Column(heading="action"),
            Column(heading="ticks"),
            Column(heading="first at", unit="s", digits=2),
            Column(heading="largest change", unit="rad"),
            Column(heading="joint"),
            Column(heading="reason"),
        ),
        rows=tuple(rows),
        notes=("The joint is the one whose target was changed most often for this reason.",),
    )


def _event_table(log: DeployLog) -> Table:
    """Return the events in the order of their time."""
    rows = []
    for event in sorted(log.events, key=lambda event: event.time):
        rows.append((float(since_start(log, event.time)), event.kind, event.text))
    return Table(
        title="Events",
        columns=(
            Column(heading="time", unit="s"),
            Column(heading="kind"),
            Column(heading="text"),
        ),
        rows=tuple(rows),
    )

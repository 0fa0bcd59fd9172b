"""Page of a deployment's log: modes, delays, safety filter, tracking and timing."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from pronk.arrays import Array
from pronk.deploy.runtime.ipc import REAL, VIRTUAL
from pronk.deploy.runtime.log import DeployLog, read_deploy_log
from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.safety import FilterAction
from pronk.errors import PronkError
from pronk.jump.trial.tables import Sheet, table
from pronk.report import deploy_run as run
from pronk.report import style
from pronk.report.deploy_run import Delay, faults, jumps, seconds
from pronk.report.page import Part
from pronk.report.style import drawing, joint_words, key, legend, picture
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec

_MODE_COLOURS = {Mode.STAND: "#dcebf5", Mode.POLICY: "#9cc9e6", Mode.HALT: "#c3deef"}
_MODE_COLOURS |= {Mode.SIT: "#dcebf5", Mode.FAULT: "#f3b48a"}
_JUMP = "#fbe3a3"
_FAULT: dict[str, Any] = {"color": style.NAIVE, "linewidth": 1.4}
_LIMIT: dict[str, Any] = {"color": style.NAIVE, "linestyle": (0, (4, 2)), "linewidth": 1.0}
_DESIRED: dict[str, Any] = {"color": style.NAIVE, "linestyle": (0, (2, 1)), "linewidth": 1.2}
_ESTIMATE: dict[str, Any] = {"color": style.MEASURED_WIDE, "linewidth": 1.2}
_COMMAND: dict[str, Any] = {"color": style.MATCHED, "linewidth": 1.4}
_DOTS = {"color": style.MEASURED, "linestyle": "none", "marker": ".", "markersize": 2.5}
_PROBLEMS = ("fault", "refused")
_MOVED = 1e-6
"""Smaller differences of desired and sent targets are not drawn [rad]."""
WINDOW_S = 1.2
"""Length of the joints' close-up [s]."""


def _mark(axes: Axes, log: DeployLog) -> None:
    """Mark jump inputs and faults."""
    for begin, end in jumps(log):
        axes.axvspan(begin, end, color=_JUMP, zorder=0, linewidth=0.0)
    for at in faults(log):
        axes.axvline(at, **_FAULT)


def _mark_keys(log: DeployLog) -> list[Line2D | Patch]:
    keys: list[Line2D | Patch] = [Patch(color=_JUMP, label="jump input")] if jumps(log) else []
    return keys + ([key("fault", **_FAULT)] if faults(log) else [])


def overview(log: DeployLog) -> Figure:
    """Draw the run: modes, velocities, tilt, battery, motor temperatures, timing."""
    t, step = seconds(log, log.time), seconds(log, log.step_time)
    estimate, commanded = np.full((2, len(step), 3), np.nan)
    if len(step):
        estimate[log.step_live] = log.linear_velocity[log.step_live]
        commanded[log.step_live] = log.command[log.step_live]
    gyro = np.where(run.policy_active(log), log.gyro[:, 2], np.nan)
    volts = np.where(log.bus_voltage > 0.0, log.bus_voltage, np.nan)
    thin: dict[str, Any] = {"color": style.MEASURED, "linewidth": 0.9}
    tracks: list[tuple[str, Array, Array, dict[str, Any]]] = [
        ("forward [m/s]", step, estimate[:, 0], _ESTIMATE),
        ("left [m/s]", step, estimate[:, 1], _ESTIMATE),
        ("turn left [rad/s]", t, gyro, _ESTIMATE),
        ("tilt [rad]", t, run.tilt(log), thin),
        ("battery [V]", t, volts, thin),
        ("motors [°C]", t, log.temperature, {"linewidth": 0.9}),
        # A microsecond is about the resolution of the clock.
        ("tick late [ms]", t, np.maximum(1e3 * log.lateness, 1e-3), _DOTS),
        ("age of state [ms]", t, np.maximum(1e3 * log.state_age, 1e-3), _DOTS),
        ("latency [ms]", t, np.maximum(1e3 * log.latency, 1e-3), _DOTS),
    ]
    tracks = tracks[:4] + [one for one in tracks[4:] if np.isfinite(one[2]).any()]
    limit = log.header.get("limits", {}).get("tilt") or np.nan
    whole = sum(length for _, _, length in run.stretches(log))
    centred: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8.5}
    rows, ratios = len(tracks) + 1, [0.42, *[1.0] * len(tracks)]
    with drawing(rows, height=1.3 * rows + 0.5, sharex=True, height_ratios=ratios) as drawn:
        figure, panels = drawn[0], drawn[1][:, 0]
        axes = panels[0]
        for mode, begin, length in run.stretches(log):
            colour = _MODE_COLOURS.get(mode, "#ececec")
            axes.axvspan(begin, begin + length, facecolor=colour, edgecolor="white")
            if length >= 0.0075 * len(mode.name) * whole:  # the name fits
                axes.text(begin + 0.5 * length, 0.5, mode.name.lower(), **centred)
        axes.set(ylim=(0.0, 1.0), yticks=[], ylabel="mode")
        axes.grid(visible=False)
        for i, (label, time, values, look) in enumerate(tracks):
            axes = panels[i + 1]
            axes.plot(time, values, **look)
            if i < 3:
                axes.step(step, commanded[:, i], where="post", **_COMMAND)
                low, high = axes.get_ylim()
                axes.set_ylim(min(low, -0.5), max(high, 0.5))
            if label.endswith("[ms]"):
                low, high = np.log10(np.array(axes.get_ylim()).clip(1e-3))
                axes.set(yscale="log", ylim=(10.0 ** np.floor(low), 10.0 ** np.ceil(high)))
            axes.set_ylabel(label)
            _mark(axes, log)
        panels[4].axhline(limit, **_LIMIT)
        panels[4].set_ylim(bottom=0.0)
        xlim = (0.0, max(float(t[-1]), 1e-3))
        panels[-1].set(xlim=xlim, xlabel="time since the first tick [s]")
        figure.align_ylabels()
        keys = [key("command", **_COMMAND), key("policy's estimate; turning: gyro", **_ESTIMATE)]
        legend(figure, [*keys, key("tilt limit", **_LIMIT), *_mark_keys(log)])
    return figure


def window(log: DeployLog) -> tuple[float, float, str]:
    """Return begin and end of the close-up since the first tick [s], and what it is about.

    About the first fault, or else the first jump input, or else the begin of the policy's time.
    """
    if ends := faults(log):
        return max(ends[0] - 0.8 * WINDOW_S, 0.0), ends[0] + 0.2 * WINDOW_S, "about the first fault"
    if inputs := jumps(log):
        return inputs[0][0] - 0.15, inputs[0][0] + WINDOW_S - 0.15, "about the first jump input"
    active = run.policy_active(log)
    begin = float(seconds(log, log.time[active][0])) if active.any() else 0.0
    return begin, begin + WINDOW_S, "of the policy" if active.any() else "of the run"


def joints(log: DeployLog, begin: float, end: float) -> Figure:
    """Draw targets and positions of every joint between two times since the first tick [s]."""
    t, measured = seconds(log, log.time), seconds(log, log.state_time)
    there = (t >= begin) & (t <= end)
    with np.errstate(invalid="ignore"):
        filtered = np.where(np.abs(log.desired - log.sent) > _MOVED, log.desired, np.nan)[there]
    sent = run.in_force(log)
    options: dict[str, Any] = {"height": 1.55, "sharey": "row"}
    with style.joint_panels(log.joints, "time [s]", "[rad]", **options) as (figure, panels):
        for i, axes in enumerate(panels[name] for name in log.joints):
            axes.plot(measured[there], log.position[there, i], **style.MEASURED_LINE)
            axes.step(t[there], filtered[:, i], where="post", **_DESIRED)
            axes.step(t[there], sent[there, i], where="pre", **_COMMAND)
            _mark(axes, log)
            axes.set_xlim(begin, end)
        keys = [key("measured", **style.MEASURED_LINE), key("target sent", **_COMMAND)]
        legend(figure, [*keys, key("desired, where filtered", **_DESIRED), *_mark_keys(log)])
    return figure


def verdict(log: DeployLog) -> str:
    """Return the outcome in one sentence."""
    kinds = {event.text for event in log.events if event.kind == "robot"}
    robot = log.header["robot"]
    known = f"Virtual {robot}" if VIRTUAL in kinds else f"Real {robot}" if REAL in kinds else ""
    robot = known or f"{robot} (real or virtual unknown)"
    active = sum(length for mode, _, length in run.stretches(log) if mode in run.POLICY_MODES)
    first = {event.kind: event for event in reversed(log.events)}
    if fault := first.get("fault"):
        after = f"after {active:.1f} s of the policy" if active else "before the policy started"
        at = float(seconds(log, fault.time))
        return f"{robot}: a fault at {at:.2f} s, {after}: {fault.text}."
    if refusal := first.get("refused"):
        return f"{robot} was not moved: {refusal.text}"
    for_s = f"active for {active:.1f} s, jump inputs: {len(jumps(log))}"
    return f"{robot}: no fault; the policy was {for_s if active else 'never active'}."


def part(path: Path) -> Part:
    """Make the part of a deployment's log; LogError if it is damaged, or of something else."""
    log, robot = read_deploy_log(path), None
    with suppress(PronkError):  # drives and limits of an unknown robot are left out
        known = load_robot(str(log.header["robot"]))
        robot = known if known.joint_names == log.joints else None
    found, (begin, end, about) = run.delay(log, robot), window(log)
    times, tracking = run.times(log), run.tracking(log)
    problems = [event for event in log.events if event.kind in _PROBLEMS]
    summary, given = verdict(log), np.isfinite(log.desired).any(axis=1)
    bad = np.flatnonzero(log.level >= FilterAction.DAMP)
    damped = bad[:1].tolist() if faults(log) else []
    figures: dict[str, Any] = {  # of `--json`; times in s
        "kind": "deploy",
        "robot": log.header["robot"],
        "virtual": log.virtual,
        "complete": log.complete,
        "verdict": summary,
        "modes": [(mode.name, begin, length) for mode, begin, length in run.stretches(log)],
        "faults": [event.text for event in problems if event.kind == "fault"],
        "refusals": [event.text for event in problems if event.kind == "refused"],
        "missed_ticks": run.missed(log),
        "times": {name: run.quantiles(values) for name, (values, _) in times.items()},
        "delay": vars(found) | {"within": found.within},
        "interventions": run.interventions(log),
        "tracking_rms_rad": dict(zip(log.joints, tracking["error"], strict=True)),
    }
    events = [(float(seconds(log, one.time)), one.kind, one.text) for one in log.events]
    timing = [
        (name, one["n"], *(1e3 * one[of] for of in (*run.QUANTILES, "max")))
        for name, one in figures["times"].items()
    ]
    shown = ("ticks", "first", "largest", "joint", "why")
    filtered = [
        (one["level"].lower(), *(one[name] for name in shown)) for one in figures["interventions"]
    ]
    content = {
        "log": log,
        "file": path.name,
        "figures": figures,
        "later": [(one.kind, float(seconds(log, one.time)), one.text) for one in problems[1:]],
        "damped": log.damped[damped[0] :] if damped else None,
        "damped_age_ms": 1e3 * float(log.state_age[damped[0]]) if damped else None,
        "given": int(given.sum()),
        "moved": int((given & np.isin(log.level, (FilterAction.LIMIT, FilterAction.HOLD))).sum()),
        "dropped": sum(log.figures.get("servo", {}).get("dropped", {}).values()),
        "policy": log.header.get("policy", {}),
        "overview": picture(overview(log), dense=True),
        "events": table("time [s] | kind | text", sorted(events, key=lambda event: event[0])),
        "close_up": f"{end - begin:.1f} s {about}",
        "joints": picture(joints(log, begin, end)),
        "joint_table": _joint_table(log, tracking, robot),
        "delay": found,
        "delay_table": _delay_table(found),
        "timing": table(
            "[ms] | n | 50 % | 95 % | 99 % | 99.9 % | max",
            timing,
            *(f"{name}: {meaning}." for name, (_, meaning) in times.items()),
        ),
        "interventions": table(
            "action | ticks | first at [s];2 | largest change [rad] | joint | reason",
            filtered,
            "joint: the one whose target was changed most often for this reason.",
        ),
    }
    return Part(
        kind="deploy",
        title="Deployment",
        virtual=log.virtual,
        summary=summary,
        warning=bool(problems) or not log.complete or found.within is False,
        content=content,
        figures=figures,
    )


def _joint_table(log: DeployLog, tracking: dict[str, Array], robot: RobotSpec | None) -> Sheet:
    unknown = [np.nan] * len(log.joints)
    effort = [joint.drive.effort_limit for joint in robot.joints] if robot else unknown
    speed = log.header.get("limits", {}).get("speed", unknown)
    rows = zip(map(joint_words, log.joints), *tracking.values(), effort, speed, strict=True)
    columns = "joint | error standing, RMS [rad] | error, RMS [rad] | largest error [rad]"
    columns += " | torque, RMS [N m];1 | largest torque [N m];1 | largest speed [rad/s];1"
    return table(
        f"{columns} | effort limit [N m];0 | speed limit [rad/s];0",
        rows,
        "error: target in force less measured position; the policy commands torque by it. All but "
        "the first column: while the policy was active. Torques as the robot reports them.",
    )


def _delay_table(found: Delay) -> Sheet:
    p50, p95 = found.command["p50"], found.command["p95"]
    rows = (
        ("state to command", p50, p95, "median to 95 %, measured"),
        ("command to torque", *found.drives, "fitted: bus, drives, time stamps of states"),
        ("total", *found.total, "their sum: the command delay of training"),
        ("training range", *(found.trained or (np.nan, np.nan)), "contract in the policy's file"),
    )
    scaled = [(name, 1e3 * low, 1e3 * high, source) for name, low, high, source in rows]
    return table("delay | from [ms];1 | to [ms];1 | source", scaled if found.command["n"] else ())

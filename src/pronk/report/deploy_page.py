"""Page of a deployment's log: modes, delays, safety filter, tracking and timing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.report import style
from pronk.report.deploy_run import (
    POLICY_MODES,
    Delay,
    Quantiles,
    delay,
    faults,
    in_force,
    interventions,
    jumps,
    known,
    missed,
    policy_active,
    seconds,
    stretches,
    tilt,
    times,
    tracking,
)
from pronk.report.page import Fold, Part, Section, number, picture, table
from pronk.report.style import drawing, joint_words, key, legend
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.runtime.ipc import REAL, VIRTUAL, Mode
from pronk.runtime.log import DeployLog, read_deploy_log
from pronk.runtime.safety import FilterAction

Array = NDArray[np.float64]

_MODE_COLOURS = {Mode.STAND: "#dcebf5", Mode.POLICY: "#9cc9e6", Mode.HALT: "#c3deef"}
_MODE_COLOURS |= {Mode.SIT: "#dcebf5", Mode.FAULT: "#f3b48a"}
_LEVELS = {
    FilterAction.LIMIT: "target moved",
    FilterAction.HOLD: "last target held",
    FilterAction.DAMP: "damped",
    FilterAction.LATCH: "damped, latched",
}
_JUMP = "#fbe3a3"
_FAULT: dict[str, Any] = {"color": style.NAIVE, "linewidth": 1.4}
_LIMIT: dict[str, Any] = {"color": style.NAIVE, "linestyle": (0, (4, 2)), "linewidth": 1.0}
_DESIRED: dict[str, Any] = {"color": style.NAIVE, "linestyle": (0, (2, 1)), "linewidth": 1.2}
_ESTIMATE: dict[str, Any] = {"color": style.MEASURED_WIDE, "linewidth": 1.2}
_COMMAND: dict[str, Any] = {"color": style.MATCHED, "linewidth": 1.4}
_DOTS: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 2.5}
_LEAST_MS = 1e-3
"""Shorter times are drawn there [ms]: about the resolution of the clock."""
_MOVED = 1e-6
"""Smaller differences of desired and sent targets are not drawn [rad]."""
WINDOW_S = 1.2
"""Length of the joints' close-up [s]."""


def machine(log: DeployLog) -> str:
    """Return which robot it was, as far as the log holds it."""
    kinds = {event.text for event in log.events if event.kind == "robot"}
    name = log.header["robot"]
    if VIRTUAL in kinds:
        return f"virtual {name}"
    return f"real {name}" if REAL in kinds else f"{name} (real or virtual: not in the log)"


def _mode(mode: Mode) -> str:
    return mode.name.lower()


def _mark(axes: Axes, log: DeployLog) -> None:
    """Mark jump inputs and faults."""
    for begin, end in jumps(log):
        axes.axvspan(begin, end, color=_JUMP, zorder=0, linewidth=0.0)
    for at in faults(log):
        axes.axvline(at, **_FAULT)


def _mark_keys(log: DeployLog) -> list[Line2D | Patch]:
    keys: list[Line2D | Patch] = []
    keys += [Patch(color=_JUMP, label="jump input")] if jumps(log) else []
    return keys + ([key("fault", **_FAULT)] if faults(log) else [])


def overview(log: DeployLog) -> Figure:
    """Draw the run: modes, commanded and estimated velocities, tilt, battery, temperatures."""
    t, step = seconds(log, log.time), seconds(log, log.step_time)
    live, empty = log.step_live[:, None], np.full((len(step), 3), np.nan)
    estimate = np.where(live, log.linear_velocity, np.nan) if len(step) else empty
    commanded = np.where(live, log.command, np.nan) if len(step) else empty
    gyro = np.where(policy_active(log), log.gyro[:, 2], np.nan)
    volts = np.where(log.bus_voltage > 0.0, log.bus_voltage, np.nan)
    thin = {"color": style.MEASURED, "linewidth": 0.9}
    tracks: list[tuple[str, Array, Array, dict[str, Any]]] = [
        ("forward [m/s]", step, estimate[:, 0], _ESTIMATE),
        ("left [m/s]", step, estimate[:, 1], _ESTIMATE),
        ("turn left [rad/s]", t, gyro, _ESTIMATE),
        ("tilt [rad]", t, tilt(log), thin),
        ("battery [V]", t, volts, thin),
        ("motors [°C]", t, log.temperature, {"linewidth": 0.9}),
    ]
    tracks = tracks[:4] + [one for one in tracks[4:] if np.isfinite(one[2]).any()]
    limit = log.header.get("limits", {}).get("tilt")
    rows, ratios = len(tracks) + 1, [0.42, *[1.0] * len(tracks)]
    options: dict[str, Any] = {"sharex": True, "height_ratios": ratios}
    with drawing(rows, height=1.3 * rows + 0.5, **options) as (figure, grid):
        _draw_modes(grid[0, 0], log)
        for i, (axes, (label, time, values, look)) in enumerate(
            zip(grid[1:, 0], tracks, strict=True)
        ):
            axes.plot(time, values, **look)
            if i < 3:
                axes.step(step, commanded[:, i], where="post", **_COMMAND)
                low, high = axes.get_ylim()
                axes.set_ylim(min(low, -0.5), max(high, 0.5))
            if label.startswith("tilt"):
                axes.set_ylim(bottom=0.0)
                if limit is not None:
                    axes.axhline(limit, **_LIMIT)
            axes.set_ylabel(label)
            _mark(axes, log)
        _time_axis(grid[-1, 0], t)
        figure.align_ylabels()
        keys = [key("command", **_COMMAND), key("policy's estimate; turning: gyro", **_ESTIMATE)]
        keys += [key("tilt limit", **_LIMIT)] if limit is not None else []
        legend(figure, [*keys, *_mark_keys(log)])
    return figure


def _time_axis(axes: Axes, t: Array) -> None:
    axes.set_xlim(0.0, max(float(t[-1]), 1e-3))
    axes.set_xlabel("time since the first tick [s]")


def _draw_modes(axes: Axes, log: DeployLog) -> None:
    """Draw a bar for each mode, with its name where it fits."""
    found = stretches(log)
    whole = sum(one.seconds for one in found)
    for one in found:
        colour = _MODE_COLOURS.get(one.mode, "#ececec")
        axes.axvspan(one.begin, one.begin + one.seconds, facecolor=colour, edgecolor="white")
        if one.seconds >= 0.0075 * len(_mode(one.mode)) * whole:
            place = (one.begin + 0.5 * one.seconds, 0.5)
            axes.text(*place, _mode(one.mode), ha="center", va="center", fontsize=8.5)
    axes.set(ylim=(0.0, 1.0), yticks=[], ylabel="mode")
    axes.grid(visible=False)


def timing(log: DeployLog) -> Figure:
    """Draw lateness, age of the state and latency over the run, logarithmic."""
    t = seconds(log, log.time)
    tracks = {"tick late": log.lateness, "age of state": log.state_age}
    tracks["state to command"] = log.latency
    with drawing(3, height=5.2, sharex=True) as (figure, grid):
        for axes, (label, values) in zip(grid[:, 0], tracks.items(), strict=True):
            axes.plot(t, np.maximum(1e3 * values, _LEAST_MS), color=style.MEASURED, **_DOTS)
            axes.set_yscale("log")
            low, high = np.log10(axes.get_ylim())
            axes.set_ylim(10.0 ** np.floor(low), 10.0 ** np.ceil(high))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
            axes.set_ylabel(f"{label} [ms]")
            for at in faults(log):
                axes.axvline(at, **_FAULT)
        _time_axis(grid[-1, 0], t)
        figure.align_ylabels()
    return figure


def window(log: DeployLog) -> tuple[float, float, str]:
    """Return begin and end of the close-up since the first tick [s], and what it shows.

    The time before the first fault; else about the first jump input; else the middle of the time
    in which the policy was active, or of the whole run.
    """
    if ends := faults(log):
        begin = max(ends[0] - 0.8 * WINDOW_S, 0.0)
        return begin, ends[0] + 0.2 * WINDOW_S, "about the first fault"
    if inputs := jumps(log):
        begin = inputs[0][0] - 0.15
        return begin, begin + WINDOW_S, "about the first jump input"
    active = policy_active(log)
    t = seconds(log, log.time[active] if active.any() else log.time)
    words = "while the policy is active" if active.any() else "in the middle of the run"
    middle = 0.5 * float(t[0] + t[-1])
    return middle - 0.5 * WINDOW_S, middle + 0.5 * WINDOW_S, words


def joints(log: DeployLog, begin: float, end: float) -> Figure:
    """Draw targets and positions of every joint between two times since the first tick [s]."""
    t, measured = seconds(log, log.time), seconds(log, log.state_time)
    there = (t >= begin) & (t <= end)
    with np.errstate(invalid="ignore"):
        filtered = np.where(np.abs(log.desired - log.sent) > _MOVED, log.desired, np.nan)[there]
    sent = in_force(log)
    labels: dict[str, Any] = {"x_label": "time [s]", "y_label": "[rad]"}
    with style.joint_panels(log.joints, height=1.55, sharey="row", **labels) as (figure, panels):
        for i, name in enumerate(log.joints):
            axes = panels[name]
            axes.plot(measured[there], log.position[there, i], **style.MEASURED_LINE)
            axes.step(t[there], filtered[:, i], where="post", **_DESIRED)
            axes.step(t[there], sent[there, i], where="pre", **_COMMAND)
            _mark(axes, log)
            axes.set_xlim(begin, end)
        keys = [key("measured", **style.MEASURED_LINE), key("target sent", **_COMMAND)]
        keys += [key("desired, where filtered", **_DESIRED)] if np.isfinite(filtered).any() else []
        legend(figure, [*keys, *_mark_keys(log)])
    return figure


def has_problem(log: DeployLog, found: Delay) -> bool:
    """Return whether there was a fault, a refusal, a cut log or too long a delay."""
    bad = any(event.kind in ("fault", "refused") for event in log.events)
    return bad or not log.complete or found.within is False


def verdict(log: DeployLog) -> str:
    """Return the outcome in one sentence."""
    active = sum(one.seconds for one in stretches(log) if one.mode in POLICY_MODES)
    who = machine(log)
    head = f"{who[0].upper()}{who[1:]}"
    for event in log.events:
        if event.kind == "fault":
            at = float(seconds(log, event.time))
            after = f"after {active:.1f} s of the policy" if active else "before the policy started"
            return f"{head}: a fault at {at:.2f} s, {after}: {event.text}."
    for event in log.events:
        if event.kind == "refused":
            return f"{head} was not moved: {event.text}"
    if not active:
        return f"{head}: no fault; the policy was never active."
    count = len(jumps(log))
    commanded = f", {count} jump{'s' if count != 1 else ''} commanded" if count else ""
    return f"{head}: the policy was active for {active:.1f} s{commanded}, no fault."


def lines(log: DeployLog, found: Delay) -> Iterator[str]:
    """Yield what stands below the outcome."""
    events = [event for event in log.events if event.kind in ("fault", "refused")]
    for event in events[1:]:
        where = f"at {float(seconds(log, event.time)):.2f} s: " if event.kind == "fault" else ""
        yield f"Then {where}{event.text.removesuffix('.')}."
    if any(event.kind == "fault" for event in events):
        yield damping(log)
    modes = ", ".join(f"{_mode(one.mode)} {one.seconds:.1f} s" for one in stretches(log))
    yield f"Modes: {modes}."
    yield filtering(log)
    yield delay_words(found)
    if left_out := missed(log):
        yield f"{left_out} of {len(log.tick) + left_out} ticks were left out as too late."
    if dropped := sum(log.figures.get("servo", {}).get("dropped", {}).values()):
        yield f"{dropped} records were dropped on their way to the log; figures here lack them."
    if not log.complete:
        why = f" ({log.damage})" if log.damage else ""
        yield f"The log was cut{why}."
    if log.virtual:
        yield "Every number here is of pronk's virtual robot, a simulated machine."


def damping(log: DeployLog) -> str:
    """Return what the servo sent after the first fault."""
    bad = log.level >= FilterAction.DAMP
    if not bad.any():
        return "The log ends before a tick that was damped."
    first = int(bad.argmax())
    after = log.damped[first:]
    return (
        f"From that tick on, {after.sum()} of {len(after)} commands on the wire were damping; the "
        f"newest state was {1e3 * float(log.state_age[first]):.1f} ms old then."
    )


def filtering(log: DeployLog) -> str:
    """Return how many commands the safety filter changed."""
    given = np.isfinite(log.desired).any(axis=1)
    moved = int((given & np.isin(log.level, (FilterAction.LIMIT, FilterAction.HOLD))).sum())
    if not given.any():
        return "The safety filter received no target."
    share = 100.0 * moved / given.sum()
    return f"The safety filter moved targets in {moved} of {given.sum()} commands ({share:.1f} %)."


def delay_words(found: Delay) -> str:
    """Return the measured delay beside the training range."""
    if not found.command.n:
        return "No delay was measured: the policy was never active."
    low, high = (1e3 * bound for bound in found.total)
    if np.isfinite([low, high]).all():
        words = f"From a state to its torque {low:.1f} to {high:.1f} ms"
    else:
        # Fewer than twenty commands have no 95 %.
        most = 1e3 * found.longest
        upper = f", {most:.1f} ms (95 %)" if np.isfinite(most) else ""
        words = f"From a state to its command {1e3 * found.command.p50:.1f} ms (median){upper}"
        words += ", without the drives"
    if found.trained is None:
        return f"{words}; the log does not hold the delays of the policy's training."
    trained = f"{1e3 * found.trained[0]:g} to {1e3 * found.trained[1]:g} ms"
    if found.within is None:
        return f"{words}; the policy was trained for {trained}."
    return f"{words}: {'within' if found.within else 'BEYOND'} the training range of {trained}."


def read(path: Path) -> tuple[DeployLog, Robot | None]:
    """Read a log and load its robot; None for one that this pronk does not know.

    Raises:
        LogError: As `read_deploy_log`.
    """
    log = read_deploy_log(path)
    try:
        robot = load_robot(str(log.header["robot"]))
    except PronkError:
        return log, None
    return log, robot if robot.joint_names == log.joints else None


def part(path: Path, root: Path, *, anchor: str = "deploy", title: str = "Deployment") -> Part:
    """Make the part of a deployment's log.

    Raises:
        LogError: The log is damaged, or not a deployment's.
    """
    log, robot = read(path)
    found, policy = delay(log, robot), log.header.get("policy", {})
    versions = ", ".join(f"{k} {v}" for k, v in log.header.get("versions", {}).items())
    return Part(
        anchor=anchor,
        title=title,
        source=str(path.relative_to(root)),
        virtual=log.virtual,
        summary=verdict(log),
        lines=list(lines(log, found)),
        warning=has_problem(log, found),
        sections=[_overview(log), _joints(log, robot), _delay(found), _timing(log), _filter(log)],
        note=f"{path.name}: {len(log.time)} ticks of the servo, {len(log.step_time)} steps of the "
        f"policy, over {log.header.get('link', 'an unknown link')}; SHA-256 {log.sha256}. Policy "
        f"{Path(policy.get('file', 'unknown')).name} {policy.get('sha256', '')}, trained with "
        f"{policy.get('gains', 'unknown')} gains. Versions: {versions or 'unknown'}.",
        figures=_figures(log, found),
    )


def _figures(log: DeployLog, found: Delay) -> dict[str, Any]:
    """Return what `--json` gives; times in ms."""
    error = tracking(log)["error"]
    return {
        "kind": "deploy",
        "robot": log.header["robot"],
        "virtual": log.virtual,
        "complete": log.complete,
        "verdict": verdict(log),
        "modes": [
            {"mode": one.mode.name, "begin_s": one.begin, "seconds": one.seconds}
            for one in stretches(log)
        ],
        "faults": [event.text for event in log.events if event.kind == "fault"],
        "refusals": [event.text for event in log.events if event.kind == "refused"],
        "missed_ticks": missed(log),
        "times": {name: Quantiles.of(one).milliseconds() for name, (one, _) in times(log).items()},
        "delay": {
            "trained_ms": None if found.trained is None else [1e3 * one for one in found.trained],
            "state_to_command_ms": found.command.milliseconds(),
            "drives_ms": [known(1e3 * one) for one in found.drives],
            "within": found.within,
        },
        "interventions": [
            {
                "reason": one.reason.name,
                "level": one.level.name,
                "ticks": one.ticks,
                "largest_rad": known(one.largest),
            }
            for one in interventions(log)
        ],
        "tracking_rms_rad": dict(zip(log.joints, map(known, error), strict=True)),
    }


def _overview(log: DeployLog) -> Section:
    events = table(
        {"time [s]": f"{float(seconds(log, e.time)):.3f}", "kind": e.kind, "text": e.text}
        for e in sorted(log.events, key=lambda event: event.time)
    )
    return Section(
        "overview",
        "Overview",
        "Velocities are the policy's own estimate; turning is the gyro's.",
        picture(
            overview(log),
            "Modes, velocities commanded and estimated, tilt and battery over the run",
            dense=True,
        ),
        Fold("Events", events),
    )


def _of(value: float, limit: float | None) -> str:
    of = limit is not None and np.isfinite(value)
    return number(value, 1) + (f" of {limit:.0f}" if of else "")


def _joints(log: DeployLog, robot: Robot | None) -> Section:
    begin, end, words = window(log)
    effort = {} if robot is None else {j.name: j.drive.effort_limit for j in robot.joints}
    speed = dict(zip(log.joints, log.header.get("limits", {}).get("speed", ()), strict=False))
    found, rows = tracking(log), []
    for i, name in enumerate(log.joints):
        one = {what: float(values[i]) for what, values in found.items()}
        rows.append(
            {
                "joint": joint_words(name),
                "error standing, RMS [rad]": number(one["standing"]),
                "error, RMS [rad]": number(one["error"]),
                "largest error [rad]": number(one["largest"]),
                "torque, RMS [N m]": number(one["torque"], 1),
                "largest torque [N m]": _of(one["torque_largest"], effort.get(name)),
                "largest speed [rad/s]": _of(one["speed_largest"], speed.get(name)),
            }
        )
    notes = (
        "error: target in force less measured position; the policy commands torque by it. All but "
        "the first column: while the policy was active. Torques as the robot reports them.",
    )
    t = seconds(log, log.time)
    words = f"{end - begin:.1f} s {words}."
    drawn = (
        picture(joints(log, begin, end), f"Targets and positions of all joints, {words}")
        if ((t >= begin) & (t <= end)).any()
        else None
    )
    return Section("joints", "Joints", words, drawn, table(rows, notes=notes))


def _delay(found: Delay) -> Section:
    trained = found.trained or (np.nan, np.nan)
    parts = (
        ("state to command", (found.command.p50, found.command.p95), "median to 95 %, measured"),
        ("command to torque", found.drives, "fitted: bus, drives, time stamps of states"),
        ("total", found.total, "their sum: the command delay of training"),
        ("training range", trained, "by the contract in the policy's file"),
    )
    rows = [
        {"delay": name, "from [ms]": number(1e3 * low, 1), "to [ms]": number(1e3 * high, 1)}
        | {"source": source}
        for name, (low, high), source in parts
    ]
    if np.isfinite(found.drives).all():
        how = (
            "The delay of the drives is the one with which targets, positions, speeds and gains "
            "explain the torques best, to about a tick; torques above half the effort limits are "
            "left out."
        )
    else:
        how = (
            "The delay of the drives could not be estimated: the run is too short, the robot "
            "reports no torques, or targets and gains do not explain them."
        )
    content = (table(rows), how) if found.command.n else ()
    return Section("delay", "Delay", delay_words(found), *content)


def _timing(log: DeployLog) -> Section:
    rows, names = [], ("p50", "p95", "p99", "p99_9", "max")
    for name, (values, _) in times(log).items():
        found = Quantiles.of(values)
        cells = {
            f"{n[1:].replace('_', '.')} %" if n != "max" else n: number(1e3 * getattr(found, n))
            for n in names
        }
        rows.append({"[ms]": name, "n": str(found.n)} | cells)
    notes = tuple(f"{name}: {meaning}." for name, (_, meaning) in times(log).items())
    words = "Lateness, age of the state and state to command over the run"
    return Section(
        "timing", "Timing", picture(timing(log), words, dense=True), table(rows, notes=notes)
    )


def _filter(log: DeployLog) -> Section:
    rows = [
        {
            "action": _LEVELS[one.level],
            "ticks": str(one.ticks),
            "first at [s]": number(one.first, 2),
            "largest change [rad]": number(one.largest),
            "joint": joint_words(one.joint) or "-",
            "reason": one.reason.text,
        }
        for one in interventions(log)
    ]
    notes = ("joint: the one whose target was changed most often for this reason.",)
    return Section("filter", "Safety filter", filtering(log), table(rows, notes=notes))

"""Page of a deployment log: modes, delays, safety filter, tracking and timing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.evaluation.tables import Sheet
from pronk.logs.mcap import DamagedError, records
from pronk.report import shell, style
from pronk.report.shell import Block, Part, number
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.runtime.ipc import REAL, VIRTUAL, Mode
from pronk.runtime.log import DeployLog, read_deploy_log
from pronk.runtime.safety import FilterAction, Reason

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FLYING = (Mode.POLICY, Mode.HALT)
"""Modes in which the policy decides."""
_STATES = "/deploy/state"
_MOVED = 1e-9
"""Smaller changes of a target are rounding [rad]."""


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """A time in one mode."""

    mode: Mode
    begin: float
    """Since the first tick [s]."""
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Spread:
    """How long something took [s]; NaN where there are too few for a quantile."""

    n: int
    p50: float
    p95: float
    p99: float
    p99_9: float
    largest: float


@dataclass(frozen=True, kw_only=True)
class Intervention:
    """What the filter did for one reason."""

    reason: Reason
    level: FilterAction
    ticks: int
    largest: float
    """Farthest that it moved a target [rad]; NaN while damped."""
    joint: str
    """Whose target it moved most often; empty while damped."""


@dataclass(frozen=True, kw_only=True)
class Tracking:
    """One joint while the policy decided; NaN where there was no such time."""

    joint: str
    error: float
    """RMS of target less position [rad]; the target that was in force."""
    largest: float
    """Largest of it [rad]."""
    standing: float
    """RMS on the way up and standing [rad]."""
    torque: float
    """RMS as the robot reports it [N m]; NaN where it reports none."""
    torque_largest: float
    """[N m]"""
    speed_largest: float
    """[rad/s]"""


def seconds(log: DeployLog, time: Array | float) -> Array:
    """Times on the log's clock as times since its first tick [s]."""
    return np.asarray(np.asarray(time, dtype=float) - log.time[0])


def period(log: DeployLog) -> float:
    """Between two ticks [s]."""
    steps = np.diff(log.time)
    return float(np.median(steps)) if len(steps) else 0.0


def flying(log: DeployLog) -> Mask:
    """Ticks in which the policy decided. (T,)."""
    return np.asarray(np.isin(log.mode, FLYING))


def until_fault(log: DeployLog) -> int:
    """Number of ticks up to the first that damped for a fault, that one included."""
    bad = log.level >= FilterAction.DAMP
    return int(bad.argmax()) + 1 if bad.any() else len(bad)


def stretches(log: DeployLog) -> tuple[Stretch, ...]:
    """The modes one after the other."""
    edges = [0, *(np.flatnonzero(np.diff(log.mode)) + 1)]
    t = np.append(seconds(log, log.time), seconds(log, log.time[-1]) + period(log))
    return tuple(
        Stretch(mode=Mode(int(log.mode[a])), begin=float(t[a]), seconds=float(t[b] - t[a]))
        for a, b in zip(edges, [*edges[1:], len(log.time)], strict=True)
    )


def spread(values: Array) -> Spread:
    """Quantiles of times: the value that the given share does not exceed.

    A quantile is given where at least one value lies beyond it: the 99.9 % of fewer than a thousand
    are NaN.

    Args:
        values: [s]; those that are not finite do not count.
    """
    found = np.sort(values[np.isfinite(values)])
    n = len(found)

    def quantile(share: float) -> float:
        if n * (1.0 - share) < 1.0 - 1e-9:
            return float("nan")
        return float(found[int(np.ceil(share * n - 1e-9)) - 1])

    return Spread(
        n=n,
        p50=quantile(0.5),
        p95=quantile(0.95),
        p99=quantile(0.99),
        p99_9=quantile(0.999),
        largest=float(found[-1]) if n else float("nan"),
    )


def missed(log: DeployLog) -> int:
    """Ticks that were left out because their time had passed."""
    return int((np.diff(log.tick) - 1).sum())


def tilt(log: DeployLog) -> Array:
    """Angle of the trunk's z axis from the vertical [rad]; NaN without an attitude. (T,)."""
    size = np.linalg.norm(log.orientation, axis=1)
    x, y = log.orientation[:, 1], log.orientation[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y) / size**2, -1.0, 1.0)))


def interventions(log: DeployLog) -> tuple[Intervention, ...]:
    """What the filter did, by level and reason; the mildest first."""
    found = []
    with np.errstate(invalid="ignore"):
        moved = np.abs(log.sent - log.desired)
    for level in list(FilterAction)[1:]:
        for reason in Reason:
            there = (log.level == level) & (log.reason == reason)
            if not there.any():
                continue
            of = moved[there]
            known = bool(np.isfinite(of).any()) and level < FilterAction.DAMP
            often = (of > _MOVED).sum(axis=0)
            found.append(
                Intervention(
                    reason=reason,
                    level=level,
                    ticks=int(there.sum()),
                    largest=float(np.nanmax(of)) if known else float("nan"),
                    joint=log.joints[int(often.argmax())] if known and often.any() else "",
                )
            )
    return tuple(found)


def in_force(log: DeployLog) -> Array:
    """The target that the drives had when each tick's state was measured [rad]. (T, joints).

    The one of the tick before; NaN for the first tick and after a damped one.
    """
    return np.vstack([np.full((1, log.sent.shape[1]), np.nan), log.sent[:-1]])


def tracking(log: DeployLog) -> tuple[Tracking, ...]:
    """How each joint followed its targets."""
    error = in_force(log) - log.position
    up, live = log.mode == Mode.STAND, flying(log)
    torque = log.torque if log.torque.any() else np.full_like(log.torque, np.nan)
    return tuple(
        Tracking(
            joint=joint,
            error=_rms(error[live, i]),
            largest=_largest(error[live, i]),
            standing=_rms(error[up, i]),
            torque=_rms(torque[live, i]),
            torque_largest=_largest(torque[live, i]),
            speed_largest=_largest(log.velocity[live, i]),
        )
        for i, joint in enumerate(log.joints)
    )


def temperatures(path: Path) -> tuple[Array, Array] | None:
    """When [s, the log's clock], and of the motors [deg C], (N,) and (N, joints); None without.

    Read from the file itself; only its first state is looked at where none is measured.
    """
    time: list[float] = []
    values: list[list[float | None]] = []
    try:
        with path.open("rb") as file:
            for batch in records(file, path.stat().st_size):
                for record in batch:
                    if record.topic != _STATES:
                        continue
                    row = orjson.loads(record.data)
                    if not time and all(value is None for value in row["temperature"]):
                        return None
                    time.append(row["t"])
                    values.append(row["temperature"])
    except DamagedError:
        pass  # what came before counts, as it does for the rest of the page
    return (np.array(time), np.array(values, dtype=float)) if time else None


def _rms(values: Array) -> float:
    found = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(found**2))) if len(found) else float("nan")


def _largest(values: Array) -> float:
    found = np.abs(values[np.isfinite(values)])
    return float(found.max()) if len(found) else float("nan")


_SHIFTS = np.arange(0.0, 0.0305, 0.00025)
"""Tried, as multiples of the virtual robot's physics step [s]."""
_EXPLAINED = 0.8
"""Least share of the torque's variance that the law must explain to be believed."""
_GENTLE = 0.5
"""Share of its effort limit below which a drive follows the law whatever the battery gives."""
_AS_GOOD = 1.1
"""Residuals up to this multiple of the least are no worse."""
_LEAST = 250
"""Fewest ticks to fit: half a second."""
_UNKNOWN = (float("nan"), float("nan"))


@dataclass(frozen=True, kw_only=True)
class Delay:
    """Measured, beside what was trained for [s]."""

    trained: tuple[float, float] | None
    """None where the log does not say."""
    answer: Spread
    """From a state to the first command that answers it, while the policy decided."""
    drives: tuple[float, float]
    """From a command on the wire to its torque, bounds; NaN where it could not be estimated."""

    @property
    def whole(self) -> tuple[float, float]:
        """Median answer with the drives' least, 95 % of the answers with their most [s]."""
        return self.answer.p50 + self.drives[0], self.answer.p95 + self.drives[1]

    @property
    def longest(self) -> float:
        """The upper end of what is known [s]: of the whole, or else of the answers alone."""
        return self.whole[1] if np.isfinite(self.whole[1]) else self.answer.p95

    @property
    def within(self) -> bool | None:
        """Whether the delay is at most the longest trained for; None where it is unknown."""
        if self.trained is None or not np.isfinite(self.longest):
            return None
        return bool(self.longest <= self.trained[1])


def delay(log: DeployLog, robot: Robot | None) -> Delay:
    """What was measured.

    Args:
        log: Of the run.
        robot: With the gains of its drives; None leaves the drives' part unknown.
    """
    trained = log.header.get("policy", {}).get("delay_range_s")
    return Delay(
        trained=None if trained is None else (float(trained[0]), float(trained[1])),
        answer=spread(log.latency[flying(log)]),
        drives=_UNKNOWN if robot is None else shift(log, robot),
    )


def shift(log: DeployLog, robot: Robot) -> tuple[float, float]:
    """The shifts at which the targets explain the torques best, from the least to the most [s].

    NaN where there is too little to fit, where torques are not measured, where the law explains
    too little of them, or where the longest shift tried is among the best.
    """
    kp = np.array([joint.stiffness for joint in robot.joints])
    kd = np.array([joint.damping for joint in robot.joints])
    gentle = _GENTLE * np.array([joint.drive.effort_limit for joint in robot.joints])
    wire = log.time + log.work
    first = np.concatenate([[True], np.diff(log.state_sequence) > 0])  # each state once
    use = flying(log) & first & (log.state_time - _SHIFTS[-1] > wire[0])
    if use.sum() < _LEAST:
        return _UNKNOWN
    t, q, v, given = (
        values[use] for values in (log.state_time, log.position, log.velocity, log.torque)
    )
    lefts = []
    for by in _SHIFTS:
        target = log.sent[np.searchsorted(wire, t - by, side="right") - 1]
        desired = kp * (target - q) - kd * v
        there = np.isfinite(given) & (np.abs(desired) < gentle)  # false where damped
        if there.sum() < _LEAST or np.var(given[there]) == 0.0:
            return _UNKNOWN
        lefts.append(np.mean((given - desired)[there] ** 2) / np.var(given[there]))
    left = np.array(lefts)
    good = _SHIFTS[left <= _AS_GOOD * left.min()]
    if 1.0 - left.min() < _EXPLAINED or good[-1] == _SHIFTS[-1]:
        return _UNKNOWN
    return float(good[0]), float(good[-1])


_LEAST_MS = 1e-3
"""What is shorter is drawn there: a microsecond, about the resolution of the clock."""


@dataclass(frozen=True, kw_only=True)
class TimeLimit:
    """One kind of time."""

    name: str
    values: Array
    """[s] (N,)"""
    says: str
    """What it is, in one line."""


def times(log: DeployLog) -> tuple[TimeLimit, ...]:
    """Everything that was timed and happened at all."""
    live = flying(log)
    found = (
        TimeLimit(
            name="servo tick late",
            values=log.lateness,
            says="from a tick's deadline to its begin, every tick of the run",
        ),
        TimeLimit(
            name="age of the state at a tick",
            values=log.state_age[: until_fault(log)],
            says="from the newest state to the tick's begin, every tick until a fault",
        ),
        TimeLimit(
            name="state to command",
            values=log.latency[live],
            says="from the state that the policy read to the first command on the wire that "
            "answers it, while the policy decided",
        ),
        TimeLimit(
            name="servo's work",
            values=log.work,
            says="from a tick's begin until its command was on the wire, every tick",
        ),
        TimeLimit(
            name="policy step late",
            values=log.step_lateness[log.step_live],
            says="from a step's deadline to its begin, while the policy decided",
        ),
        TimeLimit(
            name="policy's decision",
            values=log.decision[log.step_live],
            says="observation built and network run, while the policy decided",
        ),
    )
    return tuple(one for one in found if np.isfinite(one.values).any())


def over_time(log: DeployLog, ends: tuple[float, ...]) -> Figure:
    """Lateness and age of the state at every tick, and each answer, over the run.

    Args:
        log: Of the run.
        ends: When faults began, since the first tick [s].
    """
    t = seconds(log, log.time)
    shown = (
        ("tick late [ms]", log.lateness),
        ("age of state [ms]", log.state_age),
        ("state to command [ms]", log.latency),
    )
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 5.2), layout="constrained")
        grid = drawn.subplots(3, 1, sharex=True)
        for axes, (words, values) in zip(grid, shown, strict=True):
            axes.plot(
                t,
                np.maximum(1e3 * values, _LEAST_MS),
                linestyle="none",
                marker=".",
                markersize=2.5,
                color=style.MEASURED,
            )
            axes.set_yscale("log")
            low, high = axes.get_ylim()
            axes.set_ylim(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
            axes.set_ylabel(words)
            for at in ends:
                axes.axvline(at, color=style.NAIVE, linewidth=1.4)
        grid[-1].set_xlim(0.0, max(float(t[-1]), 1e-3))
        grid[-1].set_xlabel("time since the first tick [s]")
        drawn.align_ylabels()
    return drawn


MODE_WORDS = {
    Mode.IDLE: "idle",
    Mode.PREFLIGHT: "pre-flight",
    Mode.DAMP: "damped",
    Mode.STAND: "stand up",
    Mode.POLICY: "policy",
    Mode.HALT: "halt",
    Mode.SIT: "sit down",
    Mode.FAULT: "fault",
    Mode.ENDED: "ended",
}
_MODE_COLOURS = {
    Mode.STAND: "#dcebf5",
    Mode.POLICY: "#9cc9e6",
    Mode.HALT: "#c3deef",
    Mode.SIT: "#dcebf5",
    Mode.FAULT: "#f3b48a",
}
_QUIET = "#ececec"
_JUMP = "#fbe3a3"
_FAULT = style.NAIVE
_SHOWN_MOVED = 1e-6
"""Smaller differences of desired and sent targets are not drawn [rad]."""
_LETTER = 0.0075
"""Width of a letter in a mode's bar, as a share of the axis."""
WINDOW_S = 1.2
"""Length of the joints' close-up [s]."""


def faults(log: DeployLog) -> tuple[float, ...]:
    """When faults began, since the first tick [s]."""
    return tuple(float(seconds(log, one.time)) for one in log.events if one.kind == "fault")


def jumps(log: DeployLog) -> tuple[tuple[float, float], ...]:
    """When the jump input was given, from and to, since the first tick [s]."""
    if not len(log.step_time):
        return ()
    t = seconds(log, log.step_time)
    edges = np.diff(np.concatenate([[0], (log.jump & log.step_live).astype(int), [0]]))
    ends = np.append(t, t[-1] + 0.02)
    return tuple(
        (float(ends[a]), float(ends[b]))
        for a, b in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True)
    )


def overview(log: DeployLog, heat: tuple[Array, Array] | None) -> Figure:
    """The whole run: modes, speeds commanded and estimated, tilt, bus voltage, motor temperatures.

    Args:
        log: Of the run.
        heat: When and how hot each motor was, where it is measured.
    """
    volts = np.where(log.bus_voltage > 0.0, log.bus_voltage, np.nan)
    names = ["modes", "forward", "left", "turn", "tilt"]
    names += ["volts"] if np.isfinite(volts).any() else []
    names += [] if heat is None else ["heat"]
    t = seconds(log, log.time)
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 1.3 * len(names) + 0.5), layout="constrained")
        ratios = [0.42, *[1.0] * (len(names) - 1)]
        grid = drawn.subplots(len(names), 1, sharex=True, height_ratios=ratios, squeeze=False)
        panels: dict[str, Axes] = dict(zip(names, grid[:, 0], strict=True))
        _modes(panels["modes"], log)
        _speeds(panels, log)
        limit = log.header.get("limits", {}).get("tilt")
        panels["tilt"].plot(t, tilt(log), color=style.MEASURED, linewidth=0.9)
        if limit is not None and np.isfinite(limit):
            panels["tilt"].axhline(limit, color=_FAULT, linewidth=1.0, linestyle=(0, (4, 2)))
        panels["tilt"].set_ylim(bottom=0.0)
        panels["tilt"].set_ylabel("tilt [rad]")
        if "volts" in panels:
            panels["volts"].plot(t, volts, color=style.MEASURED, linewidth=0.7)
            panels["volts"].set_ylabel("battery [V]")
        if heat is not None:
            for motor in heat[1].T:
                panels["heat"].plot(seconds(log, heat[0]), motor, linewidth=0.9)
            panels["heat"].set_ylabel("motors [°C]")
        for name, axes in panels.items():
            if name != "modes":
                for begin, end in jumps(log):
                    axes.axvspan(begin, end, color=_JUMP, zorder=0, linewidth=0.0)
            for at in faults(log):
                axes.axvline(at, color=_FAULT, linewidth=1.4)
        bottom = panels[names[-1]]
        bottom.set_xlim(0.0, max(float(t[-1]), 1e-3))
        bottom.set_xlabel("time since the first tick [s]")
        drawn.align_ylabels()
        drawn.legend(handles=_keys(log, limit), loc="outside lower center", ncols=5)
    return drawn


def _modes(axes: Axes, log: DeployLog) -> None:
    """A bar for each mode, with its name where it fits."""
    found = stretches(log)
    whole = sum(stretch.seconds for stretch in found)
    for stretch in found:
        colour = _MODE_COLOURS.get(stretch.mode, _QUIET)
        axes.axvspan(
            stretch.begin,
            stretch.begin + stretch.seconds,
            facecolor=colour,
            edgecolor="white",
            linewidth=1.0,
        )
        words = MODE_WORDS[stretch.mode]
        if stretch.seconds >= _LETTER * len(words) * whole:
            middle = stretch.begin + 0.5 * stretch.seconds
            axes.text(middle, 0.5, words, ha="center", va="center", fontsize=8.5)
    axes.set_ylim(0.0, 1.0)
    axes.set_yticks([])
    axes.grid(visible=False)
    axes.set_ylabel("mode")


def _speeds(panels: dict[str, Axes], log: DeployLog) -> None:
    """Excitation for, and what the estimator and the gyro say."""
    t, tick = seconds(log, log.step_time), seconds(log, log.time)
    live = log.step_live
    for i, (name, words) in enumerate(
        (("forward", "forward [m/s]"), ("left", "left [m/s]"), ("turn", "turn left [rad/s]"))
    ):
        axes = panels[name]
        if name == "turn":
            gyro = np.where(flying(log), log.gyro[:, 2], np.nan)
            axes.plot(tick, gyro, color=style.MEASURED_WIDE, linewidth=0.7)
        elif len(t):
            estimate = np.where(live, log.linear_velocity[:, i], np.nan)
            axes.plot(t, estimate, color=style.MEASURED_WIDE, linewidth=1.6)
        if len(t):
            commanded = np.where(live, log.command[:, i], np.nan)
            axes.step(t, commanded, where="post", color=style.MATCHED, linewidth=1.4)
        axes.axhline(0.0, color="#bbbbbb", linewidth=0.7)
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, -0.5), max(high, 0.5))
        axes.set_ylabel(words)


def _keys(log: DeployLog, limit: float | None) -> list[Line2D | Patch]:
    keys: list[Line2D | Patch] = [
        Line2D([], [], color=style.MATCHED, label="operator command"),
        Line2D([], [], color=style.MEASURED_WIDE, label="the policy's estimate; turning: gyro"),
    ]
    if jumps(log):
        keys.append(Patch(color=_JUMP, label="jump input"))
    if limit is not None and np.isfinite(limit):
        keys.append(Line2D([], [], color=_FAULT, linestyle=(0, (4, 2)), label="largest allowed"))
    if faults(log):
        keys.append(Line2D([], [], color=_FAULT, linewidth=1.4, label="fault"))
    return keys


def window(log: DeployLog) -> tuple[float, float, str]:
    """What the close-up shows: from and to since the first tick [s], and what it is, in words.

    The time before the first fault; else about the first jump input; else the middle of the time
    in which the policy decided, or of the whole run.
    """
    ends, desired = faults(log), jumps(log)
    if ends:
        return max(ends[0] - 0.8 * WINDOW_S, 0.0), ends[0] + 0.2 * WINDOW_S, "about the first fault"
    if desired:
        return desired[0][0] - 0.15, desired[0][0] - 0.15 + WINDOW_S, "about the first jump input"
    live = np.flatnonzero(flying(log))
    times = seconds(log, log.time[live] if len(live) else log.time)
    middle = 0.5 * float(times[0] + times[-1])
    words = "while the policy decides" if len(live) else "in the middle of the run"
    return middle - 0.5 * WINDOW_S, middle + 0.5 * WINDOW_S, words


def joints(log: DeployLog, begin: float, end: float) -> Figure | None:
    """Targets and positions of every joint in a short time; None if no tick lies in it.

    Args:
        log: Of the run.
        begin: Since the first tick [s].
        end: The same.
    """
    t = seconds(log, log.time)
    there = (t >= begin) & (t <= end)
    if not there.any():
        return None
    rows = style.grid_of_joints(log.joints)
    with np.errstate(invalid="ignore"):
        moved = bool((np.abs(log.desired - log.sent)[there] > _SHOWN_MOVED).any())
    shown = [(max(a, begin), min(b, end)) for a, b in jumps(log) if a < end and b > begin]
    with style.styled():
        drawn, panels = style.small_multiples(rows, height=1.55, sharey="row")
        lowest = style.bottom_row(rows)
        for i, name in enumerate(log.joints):
            axes = panels[name]
            _joint(axes, log, i, there)
            for at in faults(log):
                if begin <= at <= end:
                    axes.axvline(at, color=_FAULT, linewidth=1.4)
            for a, b in shown:
                axes.axvspan(a, b, color=_JUMP, zorder=0, linewidth=0.0)
            axes.set_title(style.joint_words(name), fontsize=9)
            axes.set_xlim(begin, end)
            if name in lowest:
                axes.set_xlabel("time [s]")
        for row in rows:
            panels[row[0]].set_ylabel("[rad]")
        keys: list[Line2D | Patch] = [
            Line2D([], [], **style.MEASURED_LINE, label="measured"),
            Line2D([], [], color=style.MATCHED, linewidth=1.2, label="target sent"),
        ]
        if moved:
            keys.append(Line2D([], [], **_DESIRED, label="desired, where filtered"))
        if shown:
            keys.append(Patch(color=_JUMP, label="jump input"))
        if any(begin <= at <= end for at in faults(log)):
            keys.append(Line2D([], [], color=_FAULT, linewidth=1.4, label="fault"))
        drawn.legend(handles=keys, loc="outside lower center", ncols=len(keys))
    return drawn


_DESIRED: dict[str, Any] = {"color": _FAULT, "linestyle": (0, (2, 1)), "linewidth": 1.2}


def _joint(axes: Axes, log: DeployLog, i: int, there: NDArray[np.bool_]) -> None:
    t = seconds(log, log.time)[there]
    axes.plot(
        seconds(log, log.state_time)[there],
        log.position[there, i],
        color=style.MEASURED_WIDE,
        linewidth=2.6,
    )
    desired, sent = log.desired[there, i], in_force(log)[there, i]
    now = log.sent[there, i]
    with np.errstate(invalid="ignore"):
        moved = np.where(np.abs(desired - now) > _SHOWN_MOVED, desired, np.nan)
        axes.step(t, moved, where="post", **_DESIRED)
    axes.step(t, sent, where="pre", color=style.MATCHED, linewidth=1.0)


def marked(log: DeployLog, names: Sequence[str], rows: Sequence[NDArray[np.bool_]]) -> Figure:
    """When something was the case: a row of marks for each thing.

    Args:
        log: Of the run.
        names: Of the things.
        rows: Ticks in which each was the case. Each (T,).
    """
    t = seconds(log, log.time)
    with style.styled():
        drawn = Figure(figsize=(style.PAGE_WIDTH_IN, 0.7 + 0.32 * len(rows)), layout="constrained")
        axes = drawn.subplots()
        for i, row in enumerate(rows):
            axes.plot(
                t[row], np.full(row.sum(), i), linestyle="none", marker="|", markersize=11.0,
                color=style.MATCHED,
            )  # fmt: skip
        for at in faults(log):
            axes.axvline(at, color=_FAULT, linewidth=1.4)
        axes.set_yticks(range(len(rows)), names)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlim(0.0, max(float(t[-1]), 1e-3))
        axes.set_xlabel("time since the first tick [s]")
    return drawn


_LEVEL_WORDS = {
    FilterAction.LIMIT: "target moved",
    FilterAction.HOLD: "last one held",
    FilterAction.DAMP: "damped",
    FilterAction.LATCH: "damped, latched",
}


def delays_sheet(found: Delay) -> Sheet:
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


def interventions_sheet(done: Sequence[Intervention]) -> Sheet:
    """What the filter changed, and why."""
    return Sheet(
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
    )


def tracking_sheet(log: DeployLog, robot: Robot | None) -> Sheet:
    """How each joint followed, and what it gave."""
    limits = log.header.get("limits", {})
    effort = {} if robot is None else {j.name: j.drive.effort_limit for j in robot.joints}
    speed = dict(zip(log.joints, limits.get("speed", ()), strict=False))
    rows = []
    for one in tracking(log):
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
            "while the policy decided. Torques as the robot reports them, of the drives' effort "
            "limits; speeds of those at which the filter sees a fault.",
        ),
    )


def _of(value: float, limit: float | None) -> str:
    known = limit is not None and np.isfinite(value)
    return number(value, 1) + (f" of {limit:.0f}" if known else "")


def times_sheet(log: DeployLog) -> Sheet:
    """Quantiles of everything that was timed."""
    found = times(log)
    rows = []
    for one in found:
        at = spread(one.values)
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


def events_sheet(log: DeployLog) -> Sheet:
    """All events, in their order."""
    rows = []
    for event in sorted(log.events, key=lambda event: event.time):
        at = float(seconds(log, event.time))
        rows.append((f"{at:.3f}", event.kind, event.text))
    return Sheet(
        title=f"Events ({len(rows)} lines)",
        columns=("time [s]", "kind", "text"),
        rows=tuple(rows),
        notes=("Before the first tick times are negative.",),
    )


def machine(log: DeployLog) -> str:
    """What robot it was, as far as the log says."""
    said = {event.text for event in log.events if event.kind == "robot"}
    name = log.header["robot"]
    if VIRTUAL in said:
        return f"virtual {name}"
    return f"real {name}" if REAL in said else f"{name} (the log does not say whether virtual)"


def has_problem(log: DeployLog, delay: Delay) -> bool:
    """Whether something is not as it should be: faults, refusals, a cut log, too long a delay."""
    bad = any(event.kind in ("fault", "refused") for event in log.events)
    return bad or not log.complete or delay.within is False


def verdict(log: DeployLog) -> str:
    """The verdict, one sentence."""
    flown = sum(one.seconds for one in stretches(log) if one.mode in FLYING)
    faults = [event for event in log.events if event.kind == "fault"]
    refused = [event for event in log.events if event.kind == "refused"]
    who = machine(log)
    head = f"{who[0].upper()}{who[1:]}"
    if faults:
        at = float(seconds(log, faults[0].time))
        after = f"after {flown:.1f} s of the policy" if flown else "before the policy decided"
        return f"{head}: a fault at {at:.2f} s, {after}: {faults[0].text}."
    if refused:
        return f"{head} was not moved: {refused[0].text}"
    if not flown:
        return f"{head}: no fault; the policy was never in charge."
    count = len(jumps(log))
    commanded = f", {count} jump{'s' if count != 1 else ''} commanded" if count else ""
    return f"{head}: the policy decided for {flown:.1f} s{commanded}, no fault."


def verdict_lines(log: DeployLog, delay: Delay) -> Iterator[str]:
    """What stands below the verdict."""
    events = [event for event in log.events if event.kind in ("fault", "refused")]
    for event in events[1:]:
        where = f"at {float(seconds(log, event.time)):.2f} s: " if event.kind == "fault" else ""
        yield f"Then {where}{event.text}{'' if event.text.endswith('.') else '.'}"
    if any(event.kind == "fault" for event in events):
        yield damping(log)
    yield (
        "Modes: "
        + ", ".join(f"{MODE_WORDS[one.mode]} {one.seconds:.1f} s" for one in stretches(log))
        + "."
    )
    yield filtering(log)
    yield delaying(delay)
    left_out = missed(log)
    if left_out:
        whole = len(log.tick) + left_out
        yield f"{left_out} of {whole} ticks were left out because their time had passed."
    dropped = sum(log.figures.get("servo", {}).get("dropped", {}).values())
    if dropped:
        yield f"{dropped} records were dropped on their way to the log; figures here lack them."
    if not log.complete:
        why = f" ({log.damage})" if log.damage else ""
        yield f"The log was cut{why}: what came later is not in it."
    if log.virtual:
        yield "Every number here is of pronk's virtual robot, a simulated machine."


def damping(log: DeployLog) -> str:
    """What the servo did after the first fault."""
    bad = log.level >= FilterAction.DAMP
    if not bad.any():
        return "The log ends before a tick that was damped."
    first = int(bad.argmax())
    after = slice(first, None)
    share = float(np.mean(log.damped[after]))
    age = 1e3 * float(log.state_age[first])
    return (
        f"From that tick on, {log.damped[after].sum()} of {len(log.damped[after])} commands on the "
        f"wire were damping{'' if share == 1.0 else ': somebody mended the fault'}; the newest "
        f"state was {age:.1f} ms old then."
    )


def filtering(log: DeployLog) -> str:
    """How much the filter had to do."""
    wanted = np.isfinite(log.desired).any(axis=1)
    moved = int((wanted & np.isin(log.level, (FilterAction.LIMIT, FilterAction.HOLD))).sum())
    if not wanted.any():
        return "The safety filter got no target."
    if not moved:
        return f"The safety filter let all {wanted.sum()} commands through as they were."
    return (
        f"The safety filter moved targets in {moved} of {wanted.sum()} commands "
        f"({100 * moved / wanted.sum():.1f} %)."
    )


def delaying(delay: Delay) -> str:
    """The measured delay beside what the policy was trained for."""
    if not delay.answer.n:
        return "No delay was measured: the policy was never in charge."
    low, high = (1e3 * bound for bound in delay.whole)
    if np.isfinite(delay.whole).all():
        found = f"From a state to the torque that answers it {low:.1f} to {high:.1f} ms"
    else:
        # Fewer than twenty answers have no 95 %.
        least = 1e3 * delay.answer.p50
        most = 1e3 * delay.longest
        upper = f", {most:.1f} ms (95 %)" if np.isfinite(most) else ""
        found = f"From a state to its command {least:.1f} ms (median){upper}, without the drives"
    if delay.trained is None:
        return f"{found}; the log does not say what delays the policy was trained for."
    trained = f"{1e3 * delay.trained[0]:g} to {1e3 * delay.trained[1]:g} ms"
    if delay.within is None:
        return f"{found}; the policy was trained for {trained}."
    where = "within" if delay.within else "BEYOND"
    return f"{found}: {where} the {trained} that the policy was trained for."


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
        heat=temperatures(path),
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
        "verdict": verdict(log),
        "modes": [
            {"mode": one.mode.name, "begin_s": one.begin, "seconds": one.seconds}
            for one in stretches(log)
        ],
        "faults": [event.text for event in log.events if event.kind == "fault"],
        "refusals": [event.text for event in log.events if event.kind == "refused"],
        "missed_ticks": missed(log),
        "times": {one.name: _milliseconds(spread(one.values)) for one in times(log)},
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
            for one in interventions(log)
        ],
        "tracking_rms_rad": {one.joint: _known(one.error) for one in tracking(log)},
    }


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _milliseconds(of: Spread) -> dict[str, float | int | None]:
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
        says=verdict(log),
        lines=list(verdict_lines(log, material.delay)),
        warning=has_problem(log, material.delay),
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
            overview(log, material.heat),
            "Modes, speeds commanded and estimated, tilt and battery over the run",
            dense=True,
        ),
        folded=(events_sheet(log),),
    )
    yield _joints_block(material)
    yield _delay_block(material)
    yield Block(
        anchor="times",
        title="Timing",
        picture=shell.picture(
            over_time(log, faults(log)),
            "Lateness, age of the state and state to command over the run",
            dense=True,
        ),
        sheets=(times_sheet(log),),
    )
    yield _filter_block(log)


def _joints_block(material: Material) -> Block:
    log = material.log
    begin, end, words = window(log)
    drawn = joints(log, begin, end)
    return Block(
        anchor="joints",
        title="Joints",
        lines=(
            f"{end - begin:.1f} s {words}. These drives are springs: a target away from the joint "
            "is how the policy commands torque, so an error is not a fault. While standing up and "
            "standing it is what weight and friction leave.",
        ),
        picture=None
        if drawn is None
        else shell.picture(drawn, f"Targets and positions of all joints, {words}"),
        sheets=(tracking_sheet(log, material.robot),),
    )


def _delay_block(material: Material) -> Block:
    found = material.delay
    lines = [delaying(found)]
    if np.isfinite(found.drives).all():
        lines.append(
            "What the robot adds was found by fitting: torques follow from targets, positions, "
            "speeds and the gains of the drives, if the targets are taken this much earlier "
            "(torques above half the effort limits are left out). Targets change only from tick to "
            "tick, so it is known to about a tick."
        )
    elif found.answer.n:
        lines.append(
            "What the drives add could not be estimated: the run is too short, the robot "
            "reports no torques, or targets and the gains of the drives do not explain them."
        )
    return Block(
        anchor="delay",
        title="Delay, beside training",
        lines=tuple(lines),
        sheets=(delays_sheet(found),) if found.answer.n else (),
    )


def _filter_block(log: DeployLog) -> Block:
    done = interventions(log)
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
        picture=shell.picture(marked(log, names, rows), "When the filter did something, by reason"),
        sheets=(interventions_sheet(done),),
    )

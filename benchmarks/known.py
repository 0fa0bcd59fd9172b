"""`python -m benchmarks known`: pronk and its peers on the same logs with known gains.

The logs come from the training simulator itself with gains that the tools must find, at the
physics steps (200 Hz), with coloured noise and one disturbance a scenario. Every tool gets the
same logs, bench model (armature and friction in it), two free parameters and start; the bounds of
the peers are the edges of pronk's grid. Rows marked `+ delay` give a peer its own delay parameter
in the scenario where commands act late: whole steps for CMA-ES in PACE's manner, a continuous one
for mujoco.sysid, realized by linear interpolation between its 5 ms steps.

Read a bias against its standard error, `sd / sqrt(n)`, and a coverage against its own small number:
95 % of 10 intervals are 9.5.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks.peers import POPULATION, Estimate, fit_cma, fit_sysid, import_peers
from benchmarks.runner import Progress, machine
from pronk.cli import console
from pronk.errors import PronkError
from pronk.identify.excitation.signals import Chirp
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.match import match
from pronk.identify.match.settings import MatchSettings
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from pronk.tables import Cell, Column, Table
from tests.synthetic_log import Excitation, coloured_noise, synthetic_log

ROBOT = "mini_cheetah"
JOINT = "FR_knee"
"""The excited joint: thigh clamped, hip_roll held by its drive."""
KNOWN = (21.8, 0.541)
"""Stiffness [N m/rad] and damping [N m s/rad] to find: FR knee in Table I of the paper."""
MAX_DELAY_S = 0.04
"""Largest delay a tool with such a parameter may find [s]."""


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """Noise and one disturbance."""

    name: str
    words: str
    """One line for the table."""
    noise_rad: float = 3e-3
    """Standard deviation of the measurement noise, with a corner at 2 Hz [rad]."""
    delay_s: float = 0.0
    """From a command to its effect [s]; in no tool's model."""
    friction_factor: float = 1.0
    """Dry friction over that of the model which every tool is given."""
    gain_spread: float = 0.0
    """Relative standard deviation of stiffness and damping, each, from one repeat to the next."""


SCENARIOS = (
    Scenario(name="noise", words="coloured noise: 3 mrad, 2 Hz corner"),
    # 7 ms is between one and two physics steps, so that whole steps cannot express it.
    Scenario(name="delay", words="noise, and commands act 7 ms late", delay_s=0.007),
    Scenario(name="friction", words="noise, and twice the modelled friction", friction_factor=2.0),
    # A warming drive. Repeat runs of one Go2 gave parameters that vary by 3 to 14 % (issue 8 of
    # iit-DLSLab/sim2real-robot-identification); the mildest of these.
    Scenario(name="repeats", words="noise, and gains 3 % apart between repeats", gain_spread=0.03),
)


def known_log(
    robot: RobotSpec,
    scenario: Scenario,
    rng: np.random.Generator,
    *,
    repeats: int = 5,
    length_s: float = 20.0,
    threads: int = 2,
) -> JointLog:
    """Return a log of `JOINT` with the gains `KNOWN`: the same chirp `repeats` times."""
    signal = Chirp(length_s=length_s)
    rate_hz = 1.0 / robot.timestep_s
    chirp = Excitation(
        offsets=signal.samples(robot.policy_rate_hz), band_hz=signal.band_hz, repeats=repeats
    )
    factors = 1.0 + scenario.gain_spread * rng.standard_normal((repeats, 2))
    shape = (repeats, round((length_s + 2.0) * rate_hz))
    noise = coloured_noise(rng, shape, deviation=scenario.noise_rad, corner_hz=2.0, rate_hz=rate_hz)
    stiffness, damping = KNOWN
    return synthetic_log(
        robot,
        JOINT,
        [chirp],
        stiffness * factors[:, 0],
        damping * factors[:, 1],
        rate_hz=rate_hz,
        noise=list(noise),
        delay_s=scenario.delay_s,
        frictionloss=scenario.friction_factor * robot.joint(JOINT).drive.frictionloss,
        threads=threads,
    )


def fit_pronk(
    log: JointLog, *, robot: RobotSpec, threads: int = 2, grid_points: int = 50
) -> Estimate:
    """Match a log the way `pronk match --method paper` does, whose grid has 50 points an axis."""
    before = time.perf_counter()
    settings = MatchSettings(zero_armature=False, threads=threads, grid_points=grid_points)
    result = match([log], robot, method="paper", settings=settings)
    gains = result.gains.joints[JOINT]
    return Estimate(
        stiffness=gains.stiffness.value,
        damping=gains.damping.value,
        interval=(gains.stiffness.repeat95, gains.damping.repeat95),
        seconds=time.perf_counter() - before,
    )


def tools(
    robot: RobotSpec, scenario: Scenario, *, seed: int, threads: int
) -> dict[str, Callable[[JointLog], Estimate]]:
    """Return the tools of a scenario by name."""
    joint = robot.joint(JOINT)
    shared: dict[str, Any] = {"joint": JOINT, "robot": robot, "threads": threads}
    shared["bounds"] = robot.grid_stiffness, robot.grid_damping
    shared["start"] = joint.stiffness, joint.damping
    sysid = partial(fit_sysid, **shared)
    cma = partial(fit_cma, seed=seed + 1, **shared)
    chosen: dict[str, Callable[[JointLog], Estimate]] = {
        "pronk": partial(fit_pronk, robot=robot, threads=threads),
        "mujoco.sysid": sysid,
        "CMA-ES as PACE": cma,
    }
    if scenario.delay_s:
        steps = round(MAX_DELAY_S / robot.timestep_s)
        chosen["mujoco.sysid + delay"] = partial(sysid, delay_bounds_s=(0.0, MAX_DELAY_S))
        chosen["CMA-ES as PACE + delay"] = partial(cma, delay_steps=steps)
    return chosen


def run(
    trials: int,
    seed: int,
    progress: Progress,
    *,
    scenarios: Sequence[Scenario] = SCENARIOS,
    repeats: int = 5,
    length_s: float = 20.0,
    threads: int = 2,
) -> list[dict[str, Any]]:
    """Run every tool on `trials` logs of each scenario, of `repeats` chirps of `length_s` [s].

    Raises:
        PronkError: A peer is not installed, or a number is impossible.
    """
    if trials < 1 or repeats < 1:
        raise PronkError(f"{trials} trials of {repeats} repeats; expected 1 or more of each.")
    import_peers()
    robot = load_robot(ROBOT)
    estimates: dict[tuple[str, str], list[Estimate]] = {}
    for index, scenario in enumerate(scenarios):
        for trial in range(trials):
            rng = np.random.default_rng([seed, index, trial])
            log = known_log(
                robot, scenario, rng, repeats=repeats, length_s=length_s, threads=threads
            )
            for name, fit in tools(robot, scenario, seed=seed, threads=threads).items():
                estimates.setdefault((scenario.name, name), []).append(fit(log))
            progress("known", (index * trials + trial + 1) / (trials * len(scenarios)))
    rows = []
    for (scenario_name, tool), tool_estimates in estimates.items():
        rows.append(summary(scenario_name, tool, tool_estimates))
    return rows


def summary(scenario: str, tool: str, estimates: Sequence[Estimate]) -> dict[str, Any]:
    """Return errors and coverage of one tool in one scenario; NaN where there is no average.

    Pairs are for stiffness and damping, relative to the known gains [%]: `bias`, `sd` over the
    trials, `half_width` of the 95 % intervals. `intervals` were given, `covered` of them hold the
    known gain. Means of `seconds` and `delay_ms`; `estimates` in N m/rad, N m s/rad.
    """
    gains = []
    bounds = []
    delays_s = []
    seconds = []
    for estimate in estimates:
        gains.append((estimate.stiffness, estimate.damping))
        seconds.append(estimate.seconds)
        if estimate.interval:
            bounds.append(estimate.interval)
        if estimate.delay_s is not None:
            delays_s.append(estimate.delay_s)
    known_gains = np.array(KNOWN)
    error_percent = 100.0 * (np.array(gains) / known_gains - 1.0)
    unknown = np.full(2, np.nan)
    intervals = np.array(bounds).reshape(-1, 2, 2)
    covered = (intervals[..., 0] <= known_gains) & (known_gains <= intervals[..., 1])
    half_widths = 50.0 * (intervals[..., 1] - intervals[..., 0]) / known_gains
    return {
        "scenario": scenario,
        "tool": tool,
        "trials": len(estimates),
        "bias": error_percent.mean(axis=0),
        "sd": error_percent.std(axis=0, ddof=1) if len(estimates) > 1 else unknown,
        "intervals": 2 * len(intervals),
        "covered": int(covered.sum()),
        "half_width": half_widths.mean(axis=0) if len(intervals) else unknown,
        "seconds": float(np.mean(seconds)),
        "delay_ms": 1e3 * float(np.mean(delays_s)) if delays_s else float("nan"),
        "estimates": np.array(gains),
    }


def make_table(rows: Sequence[dict[str, Any]], title: str, notes: Sequence[str] = ()) -> Table:
    """Make a table of the rows of `summary`."""
    cells: list[tuple[Cell, ...]] = []
    for row in rows:
        errors = []
        for bias, deviation in zip(row["bias"], row["sd"], strict=True):
            spread = "" if np.isnan(deviation) else f" +/- {deviation:.2f}"
            errors.append(f"{bias:+.2f}{spread}")
        coverage = "no intervals"
        half_widths = ""
        if row["intervals"]:
            coverage = f"{row['covered']} of {row['intervals']}"
            half_widths = "{:.2f} / {:.2f}".format(*row["half_width"])
        cells.append(
            (
                row["scenario"],
                row["tool"],
                row["trials"],
                *errors,
                coverage,
                half_widths,
                row["seconds"],
                row["delay_ms"],
            )
        )
    columns = (
        Column(heading="scenario"),
        Column(heading="tool"),
        Column(heading="logs"),
        Column(heading="stiffness", unit="%"),
        Column(heading="damping", unit="%"),
        Column(heading="coverage"),
        Column(heading="half-widths", unit="%"),
        Column(heading="fit", unit="s", digits=2),
        Column(heading="delay", unit="ms", digits=1),
    )
    return Table(title=title, columns=columns, rows=tuple(cells), notes=tuple(notes))


def known(trials: int = 5, seed: int = 0) -> console.Outcome:
    """Match logs with known gains by pronk, mujoco.sysid and CMA-ES; bias, coverage, time.

    Args:
        trials: Logs of each scenario, about 20 s each on two cores.
        seed: Of the noise.
    """
    begin = time.perf_counter()
    with console.progress() as report:
        rows = run(trials, seed, report)
    seconds = time.perf_counter() - begin
    computer = machine("mujoco")
    title = (
        f"{JOINT}, known gains {KNOWN[0]:g} N m/rad and {KNOWN[1]:g} N m s/rad; {trials} logs of 5 "
        f"chirps a scenario, seed {seed}"
    )
    notes = [f"{scenario.name}: {scenario.words}" for scenario in SCENARIOS]
    notes.append(
        "Free: stiffness and damping, and a delay where the name has it. Errors: estimate over "
        "known gain, mean +/- sd over the logs. Coverage: 95 % intervals, of stiffness and of "
        "damping, that hold the known gain. Half-widths: of stiffness / damping."
    )
    notes.append(
        f"CMA-ES in PACE's manner: {POPULATION} simulations a generation on this CPU; PACE runs "
        f"4,096 on a GPU. {computer['cores']} cores ({computer['processor']}), MuJoCo "
        f"{computer['mujoco']}, Python {computer['python']}; {seconds:.0f} s in all."
    )
    console.show(make_table(rows, title, notes))
    figures = {
        "schema": "pronk/bench-known/3",
        "rows": rows,
        "joint": JOINT,
        "known": KNOWN,
        "scenarios": [asdict(scenario) for scenario in SCENARIOS],
        "trials": trials,
        "seed": seed,
        "machine": computer,
        "seconds": seconds,
    }
    return console.Outcome(figures=figures)

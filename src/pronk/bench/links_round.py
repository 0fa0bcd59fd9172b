"""One round: the virtual robot stands up behind a link, is asked every command, and sits down.

The robot of `twin` lives in the servo's process, that of `lcm` and `dds` in a process of its own
(`pronk twin`), the same robot by truth and seed. What the cameras saw is written by whoever has the
robot; when what was asked is read from the deployment's log, as the policy's process met it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.bench.links_clock import Clock, disturbance, own_clock
from pronk.bench.twin_apart import TwinApart
from pronk.deploy.links import Link
from pronk.deploy.log import DeployLog, read_deploy_log
from pronk.deploy.operators import Scripted
from pronk.deploy.outcome import Outcome
from pronk.deploy.plan import Plan
from pronk.deploy.run import fly
from pronk.errors import ArtefactError, HardwareError
from pronk.hardware import capture as captures
from pronk.hardware.capture import Capture
from pronk.jumps import JumpRules
from pronk.robots import load_robot
from pronk.trial.metrics import JumpFigures, measure
from pronk.trial.protocol import Script

Array = NDArray[np.float64]

PAUSE_S = 1.0
"""Of standing still between two commands [s]."""
_STICK_S = 2.0
"""How long the operator's program may be silent [s]: it is this one, which nothing here is about,
and it has no real-time scheduling."""
_BEFORE_S = 0.05
"""Kept of what was seen before a script begins [s]."""


@dataclass(frozen=True, kw_only=True)
class Way:
    """How the robot is reached, and which robot it is."""

    kind: str
    """`twin`, `lcm` or `dds`."""
    robot: str
    truth: Path | None
    """None for the shipped one."""
    port: int
    """Of LCM, on loopback."""
    domain: int
    """Of DDS, on loopback."""
    real_time: bool

    def link(self, seed: int) -> Link:
        """What `pronk deploy` opens."""
        return Link(
            kind=self.kind,
            robot=self.robot,
            port=self.port if self.kind == "lcm" else None,
            domain=self.domain if self.kind == "dds" else None,
            truth=self.truth,
            seed=seed,
            base="ground",
        )

    def twin(self, seed: int, seen: Path, figures: Path) -> list[str]:
        """The words of `pronk twin` for the robot at the other end."""
        words = ["twin", self.robot, "--link", self.kind, "--base", "ground", "--seed", str(seed)]
        words += ["--port", str(self.port)] if self.kind == "lcm" else []
        words += ["--domain", str(self.domain)] if self.kind == "dds" else []
        words += ["--truth", str(self.truth)] if self.truth is not None else []
        words += ["--realtime"] if self.real_time else []
        return [*words, "--capture", str(seen), "--json", str(figures)]


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What came of one command of a round."""

    figures: JumpFigures
    fault: str
    """What damped the robot during it; empty if nothing did."""
    disturbed: str
    """What this computer was late with meanwhile, so that it tells nothing of the link; empty if
    everything was on time."""


@dataclass(frozen=True, kw_only=True)
class Round:
    """What came of a round."""

    asked: tuple[Asked, ...]
    """One for each script begun, in their order; fewer than were given if a fault ended it."""
    health: dict[str, Any]
    """How punctual everything was [ms], and what the safety filter did."""


def fly_round(
    way: Way,
    policy: Path,
    scripts: Sequence[Script],
    *,
    seed: int,
    folder: Path,
    mass: float,
    rules: JumpRules,
) -> Round:
    """Stand up, ask every script, sit down, and measure what was seen.

    Args:
        way: To which robot.
        policy: `policy.onnx`.
        scripts: What is asked, one after the other.
        seed: Of the virtual robot's noise.
        folder: For the deployment's log (`run.mcap`) and what was seen (`seen.npz`).
        mass: Of the robot [kg].
        rules: Of the definitions.

    Raises:
        HardwareError: Nothing was asked at all.
        PronkError: As `pronk.deploy.run.fly`.
    """
    log, seen, told = (folder / name for name in ("run.mcap", "seen.npz", "twin.json"))
    apart = way.kind != "twin"
    plan = Plan(
        link=way.link(seed),
        policy=policy,
        log=log,
        capture=None if apart else seen,
        stick_valid_s=_STICK_S,
        real_time=way.real_time,
    )
    operator = Scripted(scripts, pause_s=PAUSE_S)
    twin: dict[str, Any] = {}
    if apart:
        with TwinApart(way.twin(seed, seen, told), folder) as robot:
            outcome = fly(plan, operator, lambda notice: None)
            robot.stop()
        twin = json.loads(told.read_text(encoding="utf-8"))
    else:
        outcome = fly(plan, operator, lambda notice: None)
    found = read_deploy_log(log)
    if not found.step_live.any():
        why = (*outcome.refusals, *outcome.faults, *(n.text for n in outcome.notices))
        raise HardwareError(f"the policy never took over: {why[0] if why else 'nobody said why'}")
    clock = (
        Clock(zero=twin["zero_s"], hitches=tuple(tuple(each) for each in twin["hitches"]))
        if apart
        else own_clock(found)
    )
    return Round(
        asked=_measured(
            captures.load(seen),
            found,
            scripts[: _begun(found, scripts)],
            clock=clock,
            fault="" if operator.finished else "; ".join(outcome.faults) or "ended early",
            way=way,
            mass=mass,
            rules=rules,
        ),
        health=_health(outcome, twin),
    )


def _begun(log: DeployLog, scripts: Sequence[Script]) -> int:
    """How many scripts were begun while the policy was in charge."""
    live = log.step_time[log.step_live]
    return int((_starts(scripts) <= live[-1] - live[0]).sum())


def _starts(scripts: Sequence[Script]) -> Array:
    """When each script begins, since the policy took over [s]."""
    return np.cumsum([0.0] + [script.seconds + PAUSE_S for script in scripts[:-1]])


def _measured(
    capture: Capture,
    log: DeployLog,
    scripts: Sequence[Script],
    *,
    clock: Clock,
    fault: str,
    way: Way,
    mass: float,
    rules: JumpRules,
) -> tuple[Asked, ...]:
    """The figures of every script; a fault belongs to the last."""
    told = log.jump & log.step_live
    rises = log.step_time[1:][told[1:] & ~told[:-1]]
    starts = log.step_time[log.step_live][0] + _starts(scripts)
    robot, found = load_robot(way.robot), []
    for k, script in enumerate(scripts):
        figures, start = JumpFigures(told=False), float(starts[k])
        if k < len(rises):
            start = float(rises[k]) - script.on
            began = start - clock.zero_at(start + script.seconds)
            seen = between(capture, began - _BEFORE_S, began + script.seconds)
            figures = measure(seen, script, robot, began=began, mass=mass, rules=rules)
        found.append(
            Asked(
                figures=figures,
                fault=fault if k == len(scripts) - 1 else "",
                disturbed=disturbance(
                    start,
                    start + script.seconds,
                    ticks=log.time,
                    # Those after it lost charge too: a stall ends with one of them.
                    steps=log.step_time,
                    hitches=clock.hitches,
                ),
            )
        )
    return tuple(found)


def between(capture: Capture, start: float, end: float) -> Capture:
    """The part of what was seen from `start` to `end` [s].

    Raises:
        ArtefactError: Nothing was seen then.
    """
    first, last = np.searchsorted(capture.time, (start, end))
    if last - first < 2:
        raise ArtefactError(
            f"nothing was seen from {start:.2f} to {end:.2f} s, of {capture.time[0]:.2f} to "
            f"{capture.time[-1]:.2f} s."
        )
    part = slice(int(first), int(last))
    return Capture(**{f.name: getattr(capture, f.name)[part] for f in fields(Capture)})


def _health(outcome: Outcome, twin: dict[str, Any]) -> dict[str, Any]:
    servo, policy = outcome.servo, outcome.policy
    return {
        "state_to_command": servo["state_to_command"],
        "servo_lateness": servo["lateness"],
        "state_age": servo["state_age"],
        "missed_ticks": servo["missed_ticks"],
        "states_lost": servo["states_lost"],
        "interventions": servo["interventions"],
        "policy_lateness": policy.get("lateness", {}),
        "twin_lateness": twin.get("lateness_ms", {}),
    }

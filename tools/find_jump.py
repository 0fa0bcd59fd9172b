r"""Search for the jump that training shows to a policy, `jump_demonstration_*.yaml`.

    python tools/find_jump.py walk1.onnx walk2.onnx --gains policies/gains.yaml --out jump.yaml
    python tools/find_jump.py walk3.onnx --gains naive --like policies/gains.yaml --out naive.yaml

CMA-ES over joint targets from the jump command until touchdown, command by command: first those up
to lift-off, then those of the flight, then all of them together. A quarter of the robots is told
what lies half way to the command before, and shown the mean of both jumps.
A candidate is tried on robots that walk by the policies given, each told to jump at another moment
of its stride and with a battery of its own; from then on all targets are the candidate's, until a
foot is on the ground again and the policies, which know of no jump, land it and walk on.

What counts is the ground covered in flight and the height; tilting, turning, a late lift-off,
anything but feet on the ground, jumps that are not alike, falls, and not walking on cost. A policy
comes to jump as it was shown, with what is shown wrong as well, so the search knows of all that a
jump is judged by. Physics is that of `cpu_engine.py`; what does not wait for another is searched
side by side, a process each. Needs `pronk[bench]` for `cma`.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cma
import cpu_engine
import mjlab.envs.manager_based_rl_env as mjlab_env
import numpy as np
import torch
import yaml
from tensordict import TensorDict

from pronk.evaluation.training_sim.subject import Subject, load_subject
from pronk.files import sha256
from pronk.robots import load_robot
from pronk.robots.mini_cheetah.constants import LEG_JOINTS as PARTS
from pronk.robots.robot import Joint
from pronk.train.gains import TrainingGains, training_gains
from pronk.train.mdp.commands import MotionCommandCfg, motion_command
from pronk.train.mdp.demonstration import JOINTS, SCHEMA_VERSION
from pronk.train.mdp.randomization import Randomization
from pronk.train.phases import phase
from pronk.train.runner.state import environment_state, restore_environment
from pronk.train.tasks import env_cfg

STAND = (0.0, 0.0)
CHAINS = (((1.0, 0.0), (2.0, 0.0)), ((-1.0, 0.0), (-2.0, 0.0)), ((0.0, -1.0),))
"""Forward and left [m/s]: the paper's, and those on the way there from a standing robot; to the
left it is the mirror image. Each search begins with what the one before it found."""
LEAP = float(MotionCommandCfg.__dataclass_fields__["leap"].default)
"""How much faster than told a jump may go [m/s], for commands below 1 m/s in proportion: ground
covered faster is not paid in training either."""
STEP_S = 0.02
PUSH_S, WHOLE_S = 0.26, 0.8
"""From the command to lift-off, and to the latest touchdown [s]."""
PUSH, ROWS = (round(seconds / STEP_S) + 1 for seconds in (PUSH_S, WHOLE_S))
KNOTS = np.concatenate([np.linspace(0.0, PUSH_S, 9), [0.36, 0.48, 0.6, 0.7, WHOLE_S]])
"""Moments between which targets go evenly [s]."""
PUSH_KNOTS = 9
GUESS = {"hip_pitch": (-0.35, 0.5), "knee": (0.8, -1.0)}
"""What the search begins with, beyond standing [rad]: legs fold for 0.1 s, and then stretch; in
flight they stand."""
FARTHEST = 1.6
"""No target is farther from standing [rad]: drives give all they have for less."""
FASTEST = 2.6
"""More speed upwards is worth nothing [m/s]: 2.5 is asked for."""
HIGHEST = 0.48
"""More height is worth nothing [m], nor is what the landing adds by going deep."""
DEEP, KNEE = 0.2, 0.07
"""A trunk [m] and knees [m] lower than this cost: what is near the ground touches it at times."""
VOLTAGE, RESISTANCE = (23.6, 24.4), (0.085, 0.055)
"""Batteries, a weak and a strong one [V], with wires [ohm]: training draws 22.2 to 25.2 and 0.03 to
0.1."""
DRAWN = Randomization(
    decimation=(0, 0),
    friction=(0.5, 1.2),
    shank_length=(0.187, 0.193),
    base_mass=(-0.2, 0.6),
    push_velocity=0.0,
    push_yaw_rate=0.0,
)
"""Robots that differ a little, so that jumps are landed by others as well. Batteries are not drawn
but dealt out."""
WALK, STRIDE, JUMP, AFTER = 60, 16, 18, 30
"""Policy steps to get under way, over which robots begin to, of a jump up to lift-off, and after
what is shown."""
MOMENTS = 16
"""Robots that try a candidate."""
BETWEEN = torch.tensor([(i + i // 4) % 4 == 3 for i in range(MOMENTS)])
"""Which of them are told what lies between the command and the one before."""
STANDING = 0.30
"""Trunk over ground [m]."""


@dataclass(frozen=True)
class Series:
    """What robots did, policy step by policy step. Shape (steps, robots) each."""

    x: torch.Tensor
    y: torch.Tensor
    height: torch.Tensor
    up: torch.Tensor
    """[m/s]"""
    along: torch.Tensor
    """Along the command [m/s]."""
    turn: torch.Tensor
    """[rad/s]"""
    tilt: torch.Tensor
    """Sine."""
    stands: torch.Tensor
    """A foot is on the ground: 1."""
    lowest_foot: torch.Tensor
    """Over ground [m]."""
    foot_up: torch.Tensor
    """Velocity of that foot upwards [m/s]."""
    lowest_knee: torch.Tensor
    """Over ground [m]."""
    touching: torch.Tensor
    """Something else than a foot is on the ground: 1."""
    fell: torch.Tensor
    """The episode ended: 1."""

    def top(self) -> Top:
        """When they were fastest upwards, up to `JUMP` steps on."""
        step = self.up[:JUMP].argmax(dim=0)
        robot = torch.arange(len(step))
        return Top(
            step=step,
            **{n: getattr(self, n)[step, robot] for n in ("up", "along", "turn", "tilt", "height")},
        )

    def flight(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Ground covered in flight [m], and height over the lowest trunk before it [m]. (robots,).

        Touchdown and lift-off lie between two steps; where, the lowest foot tells, which was or
        will be on the ground. Ground is 0 without a flight.
        """
        rows, robot = torch.arange(len(self.up))[:, None], torch.arange(self.up.shape[1])
        airborne = self.stands < 0.5
        # The flight that the trunk is highest in.
        highest = torch.where(airborne, self.height, -1.0).argmax(dim=0)
        grounded = ~airborne
        first = torch.where(grounded & (rows < highest), rows, -1).amax(dim=0) + 1
        last = torch.where(grounded & (rows > highest), rows, len(rows)).amin(dim=0) - 1
        way = []
        for step, sign in ((first, -1.0), (last, 1.0)):
            speed = (-sign * self.foot_up[step, robot]).clamp_min(0.5)
            time = (self.lowest_foot[step, robot] / speed).clamp(0.0, STEP_S)
            way.append(time * self.along[step, robot].abs())
        far = torch.hypot(*(v[last, robot] - v[first, robot] for v in (self.x, self.y)))
        flew = airborne.any(dim=0)
        high = self.height[:ROWS].amax(dim=0) - self.height[:JUMP].amin(dim=0)
        return (far + way[0] + way[1]) * flew, high


@dataclass(frozen=True)
class Top:
    """What robots had when they were fastest upwards. Shape (robots,) each."""

    step: torch.Tensor
    up: torch.Tensor
    along: torch.Tensor
    turn: torch.Tensor
    tilt: torch.Tensor
    height: torch.Tensor

    def way(self, fastest: torch.Tensor) -> torch.Tensor:
        """Ground covered until the trunk is at standing height again, no faster than that [m]."""
        root = (self.up.square() + 2.0 * 9.81 * (self.height - STANDING)).clamp_min(0.0).sqrt()
        return self.along.minimum(fastest) * (self.up + root) / 9.81


def fastest(told: torch.Tensor) -> torch.Tensor:
    """Speed that ground covered in flight is worth something up to [m/s]."""
    return (told + LEAP * told.clamp_max(1.0)) * (told > 0.0)


def push_score(seen: Series, told: torch.Tensor) -> torch.Tensor:
    """How good jumps are by what they were at lift-off. (robots,).

    Args:
        seen: Up to lift-off.
        told: Commanded speeds [m/s]. (robots,)
    """
    top = seen.top()
    after = (top.step + 1) * STEP_S
    return (
        top.way(fastest(told))
        + 0.4 * top.up.clamp_max(FASTEST)
        - 0.15 * (top.turn - 0.2).clamp_min(0.0)
        - (top.tilt - 0.05).clamp_min(0.0)
        - 3.0 * (after - 0.26).clamp_min(0.0)
        - 3.0 * (0.17 - seen.height[:JUMP].amin(dim=0)).clamp_min(0.0)
        - 3.0 * (KNEE - seen.lowest_knee[:JUMP].amin(dim=0)).clamp_min(0.0)
        - _touches(seen.touching[:JUMP])
        - seen.fell[:JUMP].amax(dim=0)
    )


def whole_score(seen: Series, told: torch.Tensor) -> torch.Tensor:
    """How good jumps are that were landed. (robots,).

    Args:
        seen: Until they walk on.
        told: Commanded speeds [m/s]. (robots,)
    """
    top = seen.top()
    way, high = seen.flight()
    lost = (told - seen.along[-10:].mean(dim=0)).clamp_min(0.0)
    return (
        1.5 * way.minimum(0.5 * fastest(told))
        + 2.0 * high.clamp_max(HIGHEST)
        - 0.3 * (top.up - FASTEST).clamp_min(0.0)
        - 0.1 * seen.turn[PUSH:ROWS].amax(dim=0)
        - seen.tilt[:ROWS].amax(dim=0)
        - seen.tilt[-1]
        - 0.1 * seen.turn[-1]
        - 0.2 * lost
        - 3.0 * ((top.step + 1) * STEP_S - 0.28).clamp_min(0.0)
        - 3.0 * (0.17 - seen.height[:JUMP].amin(dim=0)).clamp_min(0.0)
        - 4.0 * (DEEP - seen.height[JUMP:].amin(dim=0)).clamp_min(0.0)
        - 5.0 * (KNEE - seen.lowest_knee.amin(dim=0)).clamp_min(0.0)
        - _touches(seen.touching)
        - 2.0 * seen.fell.amax(dim=0)
    )


def unlike(seen: Series, told: torch.Tensor) -> torch.Tensor:
    """Standard deviations of way [m] and speed upwards [0.3 m/s] over the robots of a candidate.

    Those that are told something else are left out. (candidates,)
    """
    top = seen.top()
    kinds = (top.way(told + LEAP) * (told > 0.0), 0.3 * top.up)
    return sum((kind.view(-1, MOMENTS)[:, ~BETWEEN].std(dim=1) for kind in kinds), torch.zeros(()))


def _touches(touching: torch.Tensor) -> torch.Tensor:
    """Once is bad, long is worse."""
    return 0.3 * touching.amax(dim=0) + 0.1 * touching.sum(dim=0)


class Stand:
    """Robots that try candidates for one command."""

    def __init__(
        self,
        told: tuple[float, float],
        before: tuple[float, float],
        policies: list[Path],
        gains: TrainingGains,
        candidates: int,
    ) -> None:
        mjlab_env.Simulation = cpu_engine.CpuSimulation
        cpu_engine.CpuSimulation.threads = 1
        torch.set_num_threads(1)
        self.count = candidates * MOMENTS
        cfg = env_cfg(
            gains=gains,
            num_envs=self.count,
            phase=phase("jump_a"),
            randomization=DRAWN,
        )
        self.env = mjlab_env.ManagerBasedRlEnv(cfg, device="cpu")
        self.command = motion_command(self.env)
        self.command.scripted = True
        self.subjects: list[Subject] = [load_subject(path, "cpu") for path in policies]
        self.asks = torch.arange(self.count) % len(policies)
        self.between = BETWEEN.repeat(candidates)
        half = torch.tensor([told, before]).mean(dim=0)
        self.told = torch.where(self.between[:, None], half, torch.tensor(told))
        """(robots, 2)"""
        self.speed = self.told.norm(dim=1)
        """(robots,)"""
        self.way = torch.tensor(told) / max(float(np.hypot(*told)), 1e-6)
        self.start = self._walk()

    @torch.no_grad()
    def _walk(self) -> dict[str, Any]:
        """Robots under way, each at another moment of its stride, those of all candidates alike."""
        torch.manual_seed(0)  # mjlab's own seed would be that of the search as well
        observed, _ = self.env.reset()
        moment = torch.arange(self.count) % MOMENTS
        rated = load_robot("mini_cheetah").joints[0].drive.bus_voltage
        # Neither moment nor policy shall have batteries of one kind.
        strength = ((moment * 7) % MOMENTS)[:, None] / (MOMENTS - 1)
        volts, ohms = (low + (high - low) * strength for low, high in (VOLTAGE, RESISTANCE))
        held: Any = self.env.action_manager.get_term("joint_position")
        held.supply.set(volts, ohms, rated)
        begins = moment // len(self.subjects) * STRIDE * len(self.subjects) // MOMENTS
        under_way = torch.nn.functional.pad(self.told, (0, 1))
        for step in range(WALK + STRIDE):
            self.command.velocity[:] = under_way * (step >= begins)[:, None]
            observed = self.env.step(self._decide(observed))[0]
        return {name: self._alike(value) for name, value in environment_state(self.env).items()}

    def _alike(self, value: Any) -> Any:
        """What is remembered of robots, of those of all candidates as of the first one's."""
        if not isinstance(value, torch.Tensor) or self.count not in value.shape:
            return value
        dim = value.shape.index(self.count)
        times = [1] * value.ndim
        times[dim] = self.count // MOMENTS
        return value.narrow(dim, 0, MOMENTS).repeat(times)

    def _decide(self, observed: Any) -> torch.Tensor:
        """What the policies do."""
        untold = {**observed, "jump": torch.zeros(self.count, 1)}
        groups = TensorDict(untold, batch_size=[self.count])
        action = torch.zeros(self.count, len(JOINTS))
        for number, subject in enumerate(self.subjects):
            asked = self.asks == number
            action[asked] = subject.act(groups[asked])
        return action

    @torch.no_grad()
    def jump(self, targets: torch.Tensor, steps: int, before: torch.Tensor | None = None) -> Series:
        """Try candidates.

        Args:
            targets: Joint targets until touchdown, (candidates, rows, 12) [rad].
            steps: So many, from the command on.
            before: Those of the command before, (rows, 12); None: those between are shown
                `targets` as well.
        """
        env, motions = self.env, []
        held: Any = env.action_manager.get_term("joint_position")
        restore_environment(env, self.start)
        env.sim._given = False  # what was drawn has changed
        mine = targets.repeat_interleave(self.count // len(targets), dim=0)
        if before is not None:
            mine = torch.where(self.between[:, None, None], 0.5 * (mine + before), mine)
        asked = (mine - held._offset[:, None]) / held._scale
        observed, tracker = env.obs_buf, self.command.tracker
        # Commands and their tracker know of the jump, which policies are not told of.
        self.command.jump[:] = True
        for step in range(steps):
            landed = tracker.landed
            if step >= asked.shape[1]:
                action = self._decide(observed)
            elif landed.any():
                action = torch.where(landed[:, None], self._decide(observed), asked[:, step])
            else:
                action = asked[:, step]
            observed = env.step(action)[0]
            motions.append(self._seen())
        return Series(*torch.stack(motions).unbind(dim=1))

    def _seen(self) -> torch.Tensor:
        motion, robot = self.command.motion, torch.arange(self.count)
        low, foot = motion.foot_height.min(dim=1)
        place = self.env.sim.data.qpos
        return torch.stack(
            (
                place[:, 0],
                place[:, 1],
                motion.height,
                motion.velocity_world[:, 2],
                motion.velocity_heading @ self.way,
                motion.angular_velocity.norm(dim=1),
                motion.gravity[:, :2].norm(dim=1),
                motion.contact.any(dim=1).float(),
                low,
                motion.foot_velocity[robot, foot, 2],
                motion.knee_height.amin(dim=1),
                (motion.touching > 0).float(),
                self.env.termination_manager.terminated.float(),
            )
        )


def table(aside: bool, knots: np.ndarray) -> torch.Tensor:
    """Joint targets of candidates [rad]. (candidates, rows, 12).

    Args:
        aside: To a side, right legs and left legs have targets of their own, else fore and hind
            legs, left as right.
        knots: Beyond `GUESS`, (candidates, 2 * 3 * knots), as many as `KNOTS` or only the first.
    """
    legs = knots.reshape(len(knots), 2, 3, -1)
    moments = KNOTS[: legs.shape[-1]]
    time = STEP_S * np.arange(round(moments[-1] / STEP_S) + 1)
    found = np.empty((len(knots), len(time), len(JOINTS)))
    for i, (joint, pair, part, sign) in enumerate(_places(aside)):
        folds, stretches = GUESS.get(PARTS[part], (0.0, 0.0))
        guess = np.interp(
            moments, (0.0, 0.04, 0.1, 0.14, PUSH_S, 0.36), (0, folds, folds, 0, stretches, 0.0)
        )
        for one in range(len(knots)):
            beyond = np.interp(time, moments, guess + legs[one, pair, part])
            found[one, :, i] = joint.default_position + sign * beyond
    return torch.tensor(found, dtype=torch.float32)


def _places(aside: bool) -> Iterator[tuple[Joint, int, int, float]]:
    """Of every joint: it, where a candidate has it (pair of legs, part of a leg), and its sign."""
    for joint in load_robot("mini_cheetah").joints:
        leg, name = joint.name.split("_", 1)
        pair = int(leg[1] == "L") if aside else int(leg[0] == "H")
        sign = -1.0 if not aside and name == "hip_roll" and leg[1] == "R" else 1.0
        yield joint, pair, PARTS.index(name), sign


def climb(
    begin: np.ndarray,
    step: float,
    generations: int,
    seed: int,
    score: Callable[[np.ndarray, bool], torch.Tensor],
    candidates: int,
) -> np.ndarray:
    """CMA-ES: the mean it comes to. `score` is told every twentieth time to say how it is."""
    options = {"popsize": candidates - 1, "seed": seed, "verbose": -9, "CMA_diagonal": 30}
    strategy = cma.CMAEvolutionStrategy(begin, step, options)
    for generation in range(generations):
        asked = strategy.ask()
        scores = score(np.vstack([strategy.mean, *asked]), generation % 20 == 0)
        strategy.tell(asked, [-float(found) for found in scores[1:]])
    mean: np.ndarray = strategy.mean
    score(np.tile(mean, (candidates, 1)), True)
    return mean


def search(
    told: tuple[float, float],
    before: tuple[float, float],
    nearby: torch.Tensor | None,
    begin: torch.Tensor | None,
    *,
    policies: list[Path],
    gains: TrainingGains,
    generations: tuple[int, int, int],
    seed: int,
) -> torch.Tensor:
    """The best for a command: joint targets, (rows, 12) [rad].

    Args:
        told: The command [m/s].
        before: The command that was searched before.
        nearby: Targets that were found there; None: it is the first search.
        begin: Targets to begin with, of an earlier search; None: with `nearby`, or `GUESS`.
        policies: Who walks.
        gains: Nominal gains of the drives.
        generations: As of the command line.
        seed: Of CMA.
    """
    candidates = 20
    stand = Stand(told, before, policies, gains, candidates)
    aside = told[1] != 0.0
    guess = table(aside, np.zeros((1, 2 * 3 * len(KNOTS))))[0]
    first = next(targets for targets in (begin, nearby, guess) if targets is not None)
    step = 0.15 if first is guess else 0.1
    rest = torch.tensor([joint.default_position for joint in load_robot("mini_cheetah").joints])

    def targets(knots: np.ndarray) -> torch.Tensor:
        """Of candidates, who change the first: (candidates, 2, 3, knots)."""
        found = first + table(aside, knots.reshape(len(knots), -1)) - guess
        return rest + (found - rest).clamp(-FARTHEST, FARTHEST)

    def score(
        knots: np.ndarray,
        says: bool,
        steps: int,
        good: Callable[[Series, torch.Tensor], torch.Tensor],
    ) -> torch.Tensor:
        tried = targets(knots)
        seen = stand.jump(tried, steps, nearby)
        # Far from standing, what is shown is hard to follow; far from its neighbour, what is shown
        # between them is not what either of them does.
        far = 0.02 * (tried - rest).square().mean(dim=(1, 2))
        if nearby is not None:
            far = far + 0.02 * (tried - nearby).square().mean(dim=(1, 2))
        scores = good(seen, stand.speed).view(-1, MOMENTS).mean(dim=1)
        scores = scores - unlike(seen, stand.speed) - far
        if says:
            say(told, seen, scores)
        return scores

    def pushes(knots: np.ndarray, says: bool) -> torch.Tensor:
        changes = knots.reshape(len(knots), 2, 3, PUSH_KNOTS)
        later = ((0, 0), (0, 0), (0, 0), (0, len(KNOTS) - PUSH_KNOTS))
        return score(np.pad(changes, later), says, JUMP, push_score)

    push = climb(np.zeros(6 * PUSH_KNOTS), step, generations[0], seed, pushes, candidates)

    def together(knots: np.ndarray, says: bool) -> torch.Tensor:
        whole = knots.reshape(len(knots), 2, 3, -1)
        return score(whole, says, ROWS + AFTER, whole_score)

    def after_push(knots: np.ndarray) -> np.ndarray:
        """Candidates of the flight, each after the push that was found."""
        changes = knots.reshape(len(knots), 2, 3, -1)
        pushed = np.tile(push.reshape(1, 2, 3, -1), (len(knots), 1, 1, 1))
        return np.concatenate((pushed, changes), axis=-1)

    def flies(knots: np.ndarray, says: bool) -> torch.Tensor:
        return together(after_push(knots), says)

    later = 6 * (len(KNOTS) - PUSH_KNOTS)
    flight = climb(np.zeros(later), step, generations[1], seed, flies, candidates)
    whole = after_push(flight[None]).ravel()
    found = climb(whole, 0.03, generations[2], seed, together, candidates)
    return targets(found.reshape(1, 2, 3, -1))[0]


def say(told: tuple[float, float], seen: Series, scores: torch.Tensor) -> None:
    """How the first candidate is; where it jumps as told, then between."""
    (way, high), top = seen.flight(), seen.top()
    for name, who in (("", ~BETWEEN), (" between", BETWEEN)):
        one = torch.cat((who, torch.zeros(len(way) - MOMENTS, dtype=torch.bool)))
        figures = {
            "way": way[one],
            "high": high[one],
            "up": top.up[one],
            "along": top.along[one],
            "after": (top.step[one] + 1) * STEP_S,
            "touched": seen.touching[:, one].amax(dim=0),
            "fell": seen.fell[:, one].amax(dim=0),
            "turn": top.turn[one],
            "tilt": seen.tilt[:ROWS, one].amax(dim=0),
        }
        text = ", ".join(f"{what} {f.mean():.3f} +- {f.std():.3f}" for what, f in figures.items())
        print(f"{told}{name}: score {scores[0]:.3f}, {text}", file=sys.stderr, flush=True)


def chain(
    commands: tuple[tuple[float, float], ...],
    nearby: torch.Tensor,
    begins: dict[tuple[float, float], torch.Tensor],
    **settings: Any,
) -> list[torch.Tensor]:
    """Search one command after the other, from a standing robot's jump on: targets of each."""
    found, before = [], STAND
    for told in commands:
        nearby = search(told, before, nearby, begins.get(told), **settings)
        found.append(nearby)
        before = told
    return found


def earlier(path: Path) -> dict[tuple[float, float], torch.Tensor]:
    """What an earlier search wrote: targets by command."""
    jumps = yaml.safe_load(path.read_text(encoding="utf-8"))["jumps"]
    return {(jump["forward"], jump["left"]): torch.tensor(jump["targets"])[:ROWS] for jump in jumps}


def _rounded(targets: torch.Tensor) -> list[list[float]]:
    return [[round(float(target), 3) for target in row] for row in targets]


def main() -> None:
    """Search all commands, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policies", type=Path, nargs="+", help="walk.onnx of one run or several.")
    parser.add_argument("--gains", required=True, help="gains.yaml, or naive, --like one.")
    parser.add_argument("--like", type=Path)
    parser.add_argument(
        "--generations",
        type=int,
        nargs=3,
        default=(100, 40, 20),
        help="Of the push, of the flight, of all together.",
    )
    parser.add_argument("--begin", type=Path, help="Go on from what this tool wrote.")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    settings: dict[str, Any] = {
        "policies": asked.policies,
        "gains": training_gains(asked.gains, load_robot("mini_cheetah"), like=asked.like),
        "generations": tuple(asked.generations),
        "seed": asked.seed,
    }
    begins = earlier(asked.begin) if asked.begin else {}
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        first = (STAND, STAND, None, begins.get(STAND))
        standing = pool.submit(search, *first, **settings).result()
        one = partial(chain, nearby=standing, begins=begins, **settings)
        chains = list(pool.map(one, CHAINS))
    commands = (STAND, *(told for several in CHAINS for told in several))
    tables = (standing, *(targets for several in chains for targets in several))
    words = " ".join(str(number) for number in asked.generations)
    content = {
        "schema_version": SCHEMA_VERSION,
        "found_by": f"tools/find_jump.py --generations {words} --seed {asked.seed}",
        "gains": settings["gains"].name,
        "with": [{"policy": sha256(path)} for path in asked.policies],
        "step_s": STEP_S,
        "joints": list(JOINTS),
        "jumps": [
            {"forward": forward, "left": left, "targets": _rounded(targets)}
            for (forward, left), targets in zip(commands, tables, strict=True)
        ],
    }
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)
    asked.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
